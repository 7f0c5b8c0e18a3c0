"""Checks: messages that a camera has to ignore, or may send. Sources: docs/sources.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.conformance._dialects import SMART_DIALECTS
from smartcam.conformance.camera._results import check
from smartcam.conformance.camera._verdicts import Differs
from smartcam.conformance.camera._wire import frames_with_id
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera._session_under_test import CameraUnderTest

UNKNOWN_ID = 0x7F
"""A message id that is in no table."""

_IGNORED_SOURCES = {
    "": "SC-A28, MV25, published",
    "b16": "KB-seq, published",
    "bid": "ID-b 206, published",
}
_BODY_SOURCES = {
    "": "SC-A29 to SC-B34, MV27, MV29, published",
    "b16": "bodies as in the dialects of 32 bits, with numbers of 16 bits, inferred",
    "bid": "ID-a 226 to 232, ID-b 210 to 221, published",
}


def wrong_magic(camera: CameraUnderTest) -> bytes:
    """Return a Query with every bit of its magic number inverted."""
    frame = camera.codec.encode_request(m.Query())
    size = len(camera.codec.magic)
    return bytes(byte ^ 0xFF for byte in frame[:size]) + frame[size:]


def _check_ignored(camera: CameraUnderTest, label: str, *data: bytes) -> None:
    """Check that the camera does not answer these bytes, and answers the next Query once."""
    with camera.session() as client:
        client.round_trip()
        start_index = len(client.received)
        client.write(*data)
        client.round_trip()
        client.listen(camera.options.silence)
        frames = [
            each for each in client.received[start_index:] if each.message_id != MessageId.STATUS
        ]
        results = frames_with_id(frames, MessageId.RESULT_CONTAINER)
        if len(frames) - len(results) != 1:
            raise Differs(
                f"no answer to {label}, one to the Query after it",
                client.describe_received(start_index),
            )


@check(_IGNORED_SOURCES, dialects=SMART_DIALECTS)
def unknown_id_is_ignored(camera: CameraUnderTest) -> None:
    """A message with an unknown id is not answered; the next message is."""
    _check_ignored(
        camera, "an unknown id", camera.codec.make_frame(UNKNOWN_ID, bytes(camera.codec.word_size))
    )


@check(_IGNORED_SOURCES, dialects=SMART_DIALECTS)
def long_body_is_ignored(camera: CameraUnderTest) -> None:
    """A Query with a body is not answered; the next message is."""
    body = bytes(camera.codec.word_size)
    _check_ignored(
        camera, "a Query with a body", camera.codec.make_frame(MessageId.QUERY_APPLICATION, body)
    )


@check(_IGNORED_SOURCES, dialects=SMART_DIALECTS)
def short_body_is_ignored(camera: CameraUnderTest) -> None:
    """A switch without an id is not answered; the next message is."""
    _check_ignored(
        camera, "a switch without an id", camera.codec.make_frame(MessageId.SWITCH_APPLICATION)
    )


@check(_IGNORED_SOURCES, dialects=("handbook", "thesis"), transports=("udp",))
def wrong_magic_is_ignored(camera: CameraUnderTest) -> None:
    """A datagram with a wrong magic number is not answered; the next message is."""
    _check_ignored(camera, "a wrong magic number", wrong_magic(camera))


@check(_IGNORED_SOURCES, transports=("udp",))
def broken_datagram_is_ignored(camera: CameraUnderTest) -> None:
    """Datagrams that are cut, or whose length is wrong, are not answered."""
    _check_ignored(
        camera,
        "datagrams that are not one whole frame",
        camera.codec.make_frame(MessageId.QUERY_APPLICATION, length=camera.codec.word_size),
        camera.codec.encode_request(m.Query())[:-1],
    )


@check(
    _BODY_SOURCES,
    about="every message that came has a known id and the documented length; commands that "
    "have no answer have none",
)
def only_documented_messages_came(camera: CameraUnderTest) -> None:
    """Messages and their lengths are documented ones."""
    with camera.session() as client:
        client.round_trip()
    if camera.flaws:
        raise Differs(
            "only messages and lengths that are documented",
            "; ".join(f"{flaw} ({frame_text})" for flaw, frame_text in camera.flaws.items()),
        )
