"""Checks: begin and end of a session, and messages outside of a session."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from smartcam.conformance._dialects import SMART_DIALECTS
from smartcam.conformance.camera._observations import inspection_time
from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._raw_client import LinkClosedError
from smartcam.conformance.camera._results import check
from smartcam.conformance.camera._verdicts import Differs, NotObserved
from smartcam.conformance.camera._wire import frames_with_id
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera._session_under_test import CameraUnderTest
    from smartcam.conformance.camera._wire import ReceivedFrame

TRANSIT_TIME = 0.02
"""Seconds after a Disconnect in which messages that the camera had sent before may still arrive."""

PIECE_INTERVAL = 0.005
"""Seconds between the bytes of a message, so that TCP sends each byte in a segment of its own."""

_B16 = "bodies as in the dialects of 32 bits, with numbers of 16 bits, inferred"


@check({"": "SC-A29, published", "b16": _B16, "bid": "ID-a 226, published"})
def connect_is_answered(camera: CameraUnderTest) -> None:
    """Connect is answered with the protocol version, 1."""
    started_at = time.monotonic()
    try:
        try:
            with camera.link() as client:
                answer = client.ask(m.Connect())
        except (Differs, LinkClosedError):
            # the first attempt after an old session may fail (T 3.1.4, published)
            with camera.link() as client:
                client.send(m.Disconnect())
                answer = client.ask(m.Connect())
    except (Differs, LinkClosedError, NotObserved) as exc:
        camera.gone_reason = str(exc)
        outcome = exc.observed if isinstance(exc, Differs) else str(exc)
        raise Differs("an answer to Connect", outcome) from exc
    camera.measured_times["connect"] = answer.at - started_at
    numbers = camera.codec.read_numbers(answer.body)
    has_code = camera.codec.is_bid or (camera.dialect == "b16" and len(answer.body) == 4)
    expected = (0, 1) if has_code else (1,)
    size = len(expected) * camera.codec.word_size
    if numbers != expected or len(answer.body) != size:
        raise Differs(
            f"the version 1{' after the code 0' if has_code else ''}, {size} bytes",
            camera.codec.describe(answer),
        )


@check({"": "SC-A28, SC-A30, published", "b16": "SC-C40, published"}, dialects=SMART_DIALECTS)
def status_follows_connect(camera: CameraUnderTest) -> None:
    """A status comes after the answer to Connect."""
    with camera.link() as client:
        client.ask(m.Connect())
        status = client.wait_for_frame(
            MessageId.STATUS,
            camera.options.timeout,
            "a status after the answer to Connect",
            start_index=0,
        )
        flaw = camera.codec.find_flaw(status)
        if flaw is not None:
            raise Differs("a status as documented", f"{flaw}: {camera.codec.describe(status)}")


@check("SC-A30, SC-B33, published", dialects=("handbook", "thesis"))
def endian_field_is_0(camera: CameraUnderTest) -> None:
    """The second word of the status is 0: result containers are little endian."""
    with camera.session() as client:
        status = frames_with_id(client.received, MessageId.STATUS)[0]
    if camera.codec.read_numbers(status.body)[1:2] != (0,):
        raise Differs("the endian field 0: little endian", camera.codec.describe(status))


@check({"": "SC-B34, published", "b16": _B16, "bid": "ID-b 216, published"})
def query_is_answered(camera: CameraUnderTest) -> None:
    """Query is answered with the id of the active application."""
    with camera.session() as client:
        answer = client.ask(m.Query())
    numbers = camera.codec.read_numbers(answer.body)
    has_code = camera.codec.dialect.coded
    if camera.codec.find_flaw(answer) or not numbers[-1] or (has_code and numbers[0] != 2):
        code = "the code 2 and " if has_code else ""
        raise Differs(f"{code}the id of an application, 1 or more", camera.codec.describe(answer))


@check("SC-A28, SC-C40, published")
def silent_before_connect(camera: CameraUnderTest) -> None:
    """Before Connect neither results nor statuses come."""
    with camera.link() as client:
        if client.listen(camera.options.silence):
            raise Differs("nothing before Connect", client.describe_received())


@check("no document, inferred")
def deaf_before_connect(camera: CameraUnderTest) -> None:
    """Requests before Connect are ignored."""
    with camera.link() as client:
        client.send(m.Query())
        if client.listen(camera.options.silence):
            raise Differs("no answer to a Query before Connect", client.describe_received())


@check({"": "SC-A28, SC-A29, published", "b16": "KB-msg, published"}, contradictions=("C3",))
def silent_after_disconnect(camera: CameraUnderTest) -> None:
    """After Disconnect nothing comes; a smart camera does not even answer the Disconnect."""
    with camera.session() as client:
        client.round_trip()
        start_index = len(client.received)
        client.send(m.Disconnect())
        frames = _without_answer(camera, client.listen(camera.options.silence))
        if frames:
            raise Differs("nothing after Disconnect", client.describe_received(start_index))


@check("no document, inferred")
def deaf_after_disconnect(camera: CameraUnderTest) -> None:
    """Requests after Disconnect are ignored."""
    with camera.session() as client:
        client.round_trip()
        start_index = len(client.received)
        client.send(m.Disconnect())
        client.send(m.Query())
        if _without_answer(camera, client.listen(camera.options.silence)):
            raise Differs(
                "no answer to a Query after Disconnect", client.describe_received(start_index)
            )


def _without_answer(camera: CameraUnderTest, frames: list[ReceivedFrame]) -> list[ReceivedFrame]:
    """Return the frames without the answer to Disconnect that ``bid`` may give (C3)."""
    if not camera.codec.is_bid:
        return frames
    return [frame for frame in frames if frame.message_id != MessageId.DISCONNECT]


@check("SC-A29, published", needs=Allow.TRIGGER)
def no_result_after_disconnect(camera: CameraUnderTest) -> None:
    """The result of a trigger before Disconnect does not come after it."""
    inspection_seconds = inspection_time(camera)
    with camera.session() as client:
        camera.ensure_ready(client)
        start_index = len(client.received)
        client.send(m.Trigger())
        ended_at = client.send(m.Disconnect())
        frames = client.listen(inspection_seconds + camera.options.silence)
        grace = max(TRANSIT_TIME, 2 * camera.measured_times.get("query", 0.0))
        results = frames_with_id(frames, MessageId.RESULT_CONTAINER)
        if any(result.at - ended_at > grace for result in results):
            raise Differs("no result after Disconnect", client.describe_received(start_index))
    if results:
        raise NotObserved("the result was on its way already")


@check("T 3.1.1, published")
def disconnect_without_session_is_harmless(camera: CameraUnderTest) -> None:
    """A Disconnect without a session does no harm."""
    with camera.link() as client:
        client.send(m.Disconnect())
        try:
            client.ask(m.Connect())
        except LinkClosedError as exc:
            raise Differs("a session after a Disconnect without one", str(exc)) from exc


@check("no document, inferred")
def state_survives_session(camera: CameraUnderTest) -> None:
    """Application and run mode stay when a session ends."""
    with camera.session() as client:
        before = (camera.active_application(client), camera.is_running(client))
    with camera.session() as client:
        after = (camera.active_application(client), camera.is_running(client))
    if before != after:
        raise Differs(f"application and run mode as before: {before}", str(after))


@check("SC-A28, MV24, published", transports=("udp",))
def newcomer_wins(camera: CameraUnderTest) -> None:
    """The Connect of a second client ends the session of the first."""
    with camera.session() as first, camera.link() as second:
        second.ask(m.Connect())
        start_index = len(first.received)
        first.write(camera.codec.encode_request(m.Query()))
        if first.listen(camera.options.silence):
            raise Differs("silence for the first client", first.describe_received(start_index))
        second.round_trip()


@check("SC-C40, derived", transports=("tcp",))
def messages_share_a_segment(camera: CameraUnderTest) -> None:
    """Several requests in one segment are all answered."""
    with camera.session() as client:
        start_index = len(client.received)
        client.send(m.Query(), m.Query(), m.Query())
        client.wait_for_frame(
            lambda _: (
                len(frames_with_id(client.received[start_index:], MessageId.QUERY_APPLICATION)) == 3
            ),
            camera.options.timeout,
            "three answers to three Queries in one segment",
        )


@check("SC-C40, derived", transports=("tcp",))
def a_message_may_come_in_pieces(camera: CameraUnderTest) -> None:
    """A request that comes byte by byte is answered."""
    with camera.session() as client:
        start_index = len(client.received)
        for byte in camera.codec.encode_request(m.Query()):
            client.write(bytes([byte]))
            client.listen(PIECE_INTERVAL)
        client.wait_for_frame(
            MessageId.QUERY_APPLICATION,
            camera.options.timeout,
            "an answer to a Query that is sent byte by byte",
            start_index=start_index,
        )
