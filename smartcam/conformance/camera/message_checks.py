"""Checks: messages that a camera is to ignore, and what it may say at all."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.conformance.camera.results import SMART, Check, Differs
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera.session_under_test import Bench

__all__ = ["CHECKS", "LAST_CHECKS", "UNKNOWN_ID", "wrong_magic"]

UNKNOWN_ID = 0x7F
"""A message id that is in no table."""


def wrong_magic(bench: Bench) -> bytes:
    """Return a Query whose magic number has every bit turned over."""
    frame = bench.wire.request(m.Query())
    size = len(bench.wire.magic)
    return bytes(byte ^ 0xFF for byte in frame[:size]) + frame[size:]


def _ignored(bench: Bench, what: str, *data: bytes) -> None:
    """See that the camera says nothing to these bytes and answers a Query behind them once."""
    with bench.session() as line:
        line.fence()
        mark = len(line.heard)
        line.write(*data)
        line.fence()
        line.listen(bench.plan.quiet)
        came = [one for one in line.heard[mark:] if one.message_id != MessageId.STATUS]
        results = [one for one in came if one.message_id == MessageId.RESULT_CONTAINER]
        if len(came) - len(results) != 1:
            raise Differs(f"no answer to {what}, one to the Query behind it", line.words(mark))


def _unknown_id(bench: Bench) -> None:
    _ignored(bench, "an unknown id", bench.wire.frame(UNKNOWN_ID, bytes(bench.wire.word)))


def _wrong_length(bench: Bench) -> None:
    body = bytes(bench.wire.word)
    _ignored(bench, "a Query with a body", bench.wire.frame(MessageId.QUERY_APPLICATION, body))


def _short_body(bench: Bench) -> None:
    _ignored(bench, "a switch without an id", bench.wire.frame(MessageId.SWITCH_APPLICATION))


def _wrong_magic(bench: Bench) -> None:
    _ignored(bench, "a wrong magic number", wrong_magic(bench))


def _wrong_datagram(bench: Bench) -> None:
    _ignored(
        bench,
        "datagrams that are not one whole frame",
        bench.wire.frame(MessageId.QUERY_APPLICATION, length=bench.wire.word),
        bench.wire.request(m.Query())[:-1],
    )


def _only_documented(bench: Bench) -> None:
    with bench.session() as line:
        line.fence()
    if bench.flaws:
        raise Differs(
            "only messages and lengths that are documented",
            "; ".join(f"{flaw} ({shown})" for flaw, shown in bench.flaws.items()),
        )


_IGNORED = {"": "SC-A28, MV25, published", "b16": "KB-seq, published", "bid": "ID-b 206, published"}
_BODIES = {
    "": "SC-A29 to SC-B34, MV27, MV29, published",
    "b16": "the bodies of the dialects with 32 bits narrowed, inferred",
    "bid": "ID-a 226 to 232, ID-b 210 to 221, published",
}

CHECKS: tuple[Check, ...] = (
    Check(
        name="unknown-id-is-ignored",
        about="a message with an unknown id is not answered, and what follows it is",
        sources=_IGNORED,
        run=_unknown_id,
        dialects=SMART,
    ),
    Check(
        name="long-body-is-ignored",
        about="a Query with a body is not answered, and what follows it is",
        sources=_IGNORED,
        run=_wrong_length,
        dialects=SMART,
    ),
    Check(
        name="short-body-is-ignored",
        about="a switch without an id is not answered, and what follows it is",
        sources=_IGNORED,
        run=_short_body,
        dialects=SMART,
    ),
    Check(
        name="wrong-magic-is-ignored",
        about="a datagram with a wrong magic number is not answered, and what follows it is",
        sources=_IGNORED,
        run=_wrong_magic,
        dialects=("handbook", "thesis"),
        transports=("udp",),
    ),
    Check(
        name="broken-datagram-is-ignored",
        about="datagrams that are cut, or whose length is wrong, are not answered",
        sources=_IGNORED,
        run=_wrong_datagram,
        transports=("udp",),
    ),
)
"""In the order in which they are run."""

LAST_CHECKS: tuple[Check, ...] = (
    Check(
        name="only-documented-messages-came",
        about="every message that came has a known id and the documented length; commands that "
        "have no answer have none",
        sources=_BODIES,
        run=_only_documented,
    ),
)
"""Behind all others."""
