"""Checks: how a session begins and ends, and what a camera says outside of one."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from smartcam.conformance.camera.observations import inspection_time
from smartcam.conformance.camera.options import Allow
from smartcam.conformance.camera.raw_client import EndedError
from smartcam.conformance.camera.results import SMART, Check, Differs, NotObserved
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera.session_under_test import Bench
    from smartcam.conformance.camera.wire import Heard

__all__ = ["CHECKS"]

ON_THE_WAY = 0.02
"""Seconds that what was said before a Disconnect may be on its way at least."""


BETWEEN_PIECES = 0.005
"""Seconds between the bytes of a message that comes in pieces, so that each has a segment."""


def _connect_is_answered(bench: Bench) -> None:
    began = time.monotonic()
    try:
        try:
            with bench.link() as line:
                answer = line.answer(m.Connect())
        except (Differs, EndedError):
            # the first attempt after an old session may fail (T 3.1.4, published)
            with bench.link() as line:
                line.say(m.Disconnect())
                answer = line.answer(m.Connect())
    except (Differs, EndedError, NotObserved) as exc:
        bench.gone = str(exc)
        came = exc.came if isinstance(exc, Differs) else str(exc)
        raise Differs("an answer to Connect", came) from exc
    bench.measured["connect"] = answer.at - began
    numbers = bench.wire.numbers(answer.body)
    coded = bench.wire.is_bid or (bench.dialect == "b16" and len(answer.body) == 4)
    expected = (0, 1) if coded else (1,)
    size = len(expected) * bench.wire.word
    if numbers != expected or len(answer.body) != size:
        raise Differs(
            f"the version 1{' behind the code 0' if coded else ''}, {size} bytes",
            bench.wire.spell(answer),
        )


def _status_follows_connect(bench: Bench) -> None:
    with bench.link() as line:
        line.answer(m.Connect())
        status = line.until(
            lambda heard: heard.message_id == MessageId.STATUS,
            bench.plan.timeout,
            "a status after the answer to Connect",
            mark=0,
        )
        flaw = bench.wire.flaw(status)
        if flaw is not None:
            raise Differs("a status as documented", f"{flaw}: {bench.wire.spell(status)}")


def _endian_is_little(bench: Bench) -> None:
    with bench.session() as line:
        status = next(one for one in line.heard if one.message_id == MessageId.STATUS)
    if bench.wire.numbers(status.body)[1:2] != (0,):
        raise Differs("the endian field 0: little endian", bench.wire.spell(status))


def _query_is_answered(bench: Bench) -> None:
    with bench.session() as line:
        answer = line.answer(m.Query())
    numbers = bench.wire.numbers(answer.body)
    coded = bench.wire.dialect.coded
    if bench.wire.flaw(answer) or not numbers[-1] or (coded and numbers[0] != 2):
        code = "the code 2 and " if coded else ""
        raise Differs(f"{code}the id of an application, 1 or more", bench.wire.spell(answer))


def _silent_before_connect(bench: Bench) -> None:
    with bench.link() as line:
        if line.listen(bench.plan.quiet):
            raise Differs("nothing before Connect", line.words())


def _deaf_before_connect(bench: Bench) -> None:
    with bench.link() as line:
        line.say(m.Query())
        if line.listen(bench.plan.quiet):
            raise Differs("no answer to a Query before Connect", line.words())


def _silent_after_disconnect(bench: Bench) -> None:
    with bench.session() as line:
        line.fence()
        mark = len(line.heard)
        line.say(m.Disconnect())
        came = _without_answer(bench, line.listen(bench.plan.quiet))
        if came:
            raise Differs("nothing after Disconnect", line.words(mark))


def _deaf_after_disconnect(bench: Bench) -> None:
    with bench.session() as line:
        line.fence()
        mark = len(line.heard)
        line.say(m.Disconnect())
        line.say(m.Query())
        if _without_answer(bench, line.listen(bench.plan.quiet)):
            raise Differs("no answer to a Query after Disconnect", line.words(mark))


def _without_answer(bench: Bench, came: list[Heard]) -> list[Heard]:
    """Return what came, without what ``bid`` may answer to Disconnect (C3)."""
    if not bench.wire.is_bid:
        return came
    return [one for one in came if one.message_id != MessageId.DISCONNECT]


def _no_result_after_disconnect(bench: Bench) -> None:
    takes = inspection_time(bench)
    with bench.session() as line:
        bench.ready(line)
        mark = len(line.heard)
        line.say(m.Trigger())
        ended_at = line.say(m.Disconnect())
        came = line.listen(takes + bench.plan.quiet)
        grace = max(ON_THE_WAY, 2 * bench.measured.get("query", 0.0))
        results = [one for one in came if one.message_id == MessageId.RESULT_CONTAINER]
        if any(one.at - ended_at > grace for one in results):
            raise Differs("no result after Disconnect", line.words(mark))
    if results:
        raise NotObserved("the result was on its way already")


def _disconnect_without_session(bench: Bench) -> None:
    with bench.link() as line:
        line.say(m.Disconnect())
        try:
            line.answer(m.Connect())
        except EndedError as exc:
            raise Differs("a session after a Disconnect without one", str(exc)) from exc


def _state_survives(bench: Bench) -> None:
    with bench.session() as line:
        was = (bench.active(line), bench.running(line))
    with bench.session() as line:
        now = (bench.active(line), bench.running(line))
    if was != now:
        raise Differs(f"application and run mode as before: {was}", str(now))


def _newcomer_wins(bench: Bench) -> None:
    with bench.session() as first, bench.link() as second:
        second.answer(m.Connect())
        mark = len(first.heard)
        first.write(bench.wire.request(m.Query()))
        if first.listen(bench.plan.quiet):
            raise Differs("silence for the client that was there before", first.words(mark))
        second.fence()


def _one_segment(bench: Bench) -> None:
    with bench.session() as line:
        mark = len(line.heard)
        line.say(m.Query(), m.Query(), m.Query())
        line.until(
            lambda _: _count(line.heard[mark:], MessageId.QUERY_APPLICATION) == 3,
            bench.plan.timeout,
            "three answers to three Queries in one segment",
        )


def _byte_by_byte(bench: Bench) -> None:
    with bench.session() as line:
        mark = len(line.heard)
        for byte in bench.wire.request(m.Query()):
            line.write(bytes([byte]))
            line.listen(BETWEEN_PIECES)
        line.until(
            lambda heard: heard.message_id == MessageId.QUERY_APPLICATION,
            bench.plan.timeout,
            "an answer to a Query that is sent byte by byte",
            mark=mark,
        )


def _count(came: list[Heard], message_id: int) -> int:
    return sum(one.message_id == message_id for one in came)


_NARROWED = "the bodies of the dialects with 32 bits narrowed, inferred"

CHECKS: tuple[Check, ...] = (
    Check(
        name="connect-is-answered",
        about="Connect is answered with the protocol version, 1",
        sources={"": "SC-A29, published", "b16": _NARROWED, "bid": "ID-a 226, published"},
        run=_connect_is_answered,
    ),
    Check(
        name="status-follows-connect",
        about="a status comes after the answer to Connect",
        sources={"": "SC-A28, SC-A30, published", "b16": "SC-C40, published"},
        run=_status_follows_connect,
        dialects=SMART,
    ),
    Check(
        name="endian-field-is-0",
        about="the second word of the status is 0: result containers are little endian",
        sources={"": "SC-A30, SC-B33, published"},
        run=_endian_is_little,
        dialects=("handbook", "thesis"),
    ),
    Check(
        name="query-is-answered",
        about="Query is answered with the id of the active application",
        sources={"": "SC-B34, published", "b16": _NARROWED, "bid": "ID-b 216, published"},
        run=_query_is_answered,
    ),
    Check(
        name="silent-before-connect",
        about="before Connect neither results nor statuses come",
        sources={"": "SC-A28, SC-C40, published"},
        run=_silent_before_connect,
    ),
    Check(
        name="deaf-before-connect",
        about="requests before Connect are ignored",
        sources={"": "no document, inferred"},
        run=_deaf_before_connect,
    ),
    Check(
        name="silent-after-disconnect",
        about="after Disconnect nothing comes, of a smart camera not even an answer to it",
        sources={"": "SC-A28, SC-A29, published", "b16": "KB-msg, published"},
        run=_silent_after_disconnect,
        documents=("C3",),
    ),
    Check(
        name="deaf-after-disconnect",
        about="requests after Disconnect are ignored",
        sources={"": "no document, inferred"},
        run=_deaf_after_disconnect,
    ),
    Check(
        name="no-result-after-disconnect",
        about="the result of a trigger before Disconnect does not come after it",
        sources={"": "SC-A29, published"},
        run=_no_result_after_disconnect,
        needs=Allow.TRIGGER,
    ),
    Check(
        name="disconnect-without-session-is-harmless",
        about="a Disconnect without a session does no harm",
        sources={"": "T 3.1.1, published"},
        run=_disconnect_without_session,
    ),
    Check(
        name="state-survives-session",
        about="application and run mode stay when a session ends",
        sources={"": "no document, inferred"},
        run=_state_survives,
    ),
    Check(
        name="newcomer-wins",
        about="the Connect of a second client ends the session of the first",
        sources={"": "SC-A28, MV24, published"},
        run=_newcomer_wins,
        transports=("udp",),
    ),
    Check(
        name="messages-share-a-segment",
        about="several requests in one segment are all answered",
        sources={"": "SC-C40, derived"},
        run=_one_segment,
        transports=("tcp",),
    ),
    Check(
        name="a-message-may-come-in-pieces",
        about="a request that comes byte by byte is answered",
        sources={"": "SC-C40, derived"},
        run=_byte_by_byte,
        transports=("tcp",),
    ),
)
"""In the order in which they are run."""
