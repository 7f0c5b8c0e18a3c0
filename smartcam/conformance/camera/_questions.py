"""Questions: an experiment for each field of Quirks, and where docs/sources.md disagree."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from smartcam.conformance._dialects import SMART_DIALECTS
from smartcam.conformance.camera import _observations as observations
from smartcam.conformance.camera._message_checks import UNKNOWN_ID, wrong_magic
from smartcam.conformance.camera._observations import (
    inspection_time,
    observe_double_trigger,
    observe_inspections,
    observe_restart,
    observe_stopped_trigger,
    observe_switch,
    observe_unasked_statuses,
)
from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._raw_client import LinkClosedError
from smartcam.conformance.camera._results import question
from smartcam.conformance.camera._setting_checks import read_next_number
from smartcam.conformance.camera._verdicts import Differs, NotObserved, Undescribed
from smartcam.conformance.camera._wire import frames_with_id
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera._raw_client import RawClient
    from smartcam.conformance.camera._session_under_test import CameraUnderTest

MAX_CONTAINERS = 1024
"""Largest number of input containers sent to find the length of the queue."""

MAX_LEFT_CONTAINERS = 64
"""Largest number of triggers sent to empty the input queue that another client has filled."""

_NO_DOCUMENT = {"": "no document, open"}


@question("SC-A28, SC-C40, T 3.1.1, published", contradictions=("C1", "C7"))
def dialect(camera: CameraUnderTest) -> str:
    """Dialect that the camera speaks, and its transport."""
    with camera.session():
        return f"{camera.dialect} over {camera.transport.upper()}"


@question("no document, inferred", dialects=("b16",))
def code(camera: CameraUnderTest) -> bool:
    """Answers begin with a result code."""
    with camera.link() as client:
        answer = client.ask(m.Connect())
    has_code = {(1,): False, (0, 1): True}.get(camera.codec.read_numbers(answer.body))
    if has_code is None:
        raise Undescribed(
            "the version 1, or the code 0 and the version", camera.codec.describe(answer)
        )
    return has_code


@question(
    "SC-C45 (its table against its example), published",
    needs=Allow.TRIGGER,
    dialects=("b16",),
    contradictions=("C2",),
)
def no_id(camera: CameraUnderTest) -> bool:
    """Result containers do not begin with the application's id."""
    return observations.has_no_id(camera)


# ---------------------------------------------------------------------- inspections


@question(_NO_DOCUMENT, needs=Allow.TRIGGER)
def waiting_before_result(camera: CameraUnderTest) -> bool:
    """Waiting for Trigger rises before the result comes."""
    inspection_time(camera)  # raises if there are no results
    orders: set[bool] = set()
    for run in (
        [observe_unasked_statuses(camera)] if camera.codec.is_bid else observe_inspections(camera)
    ):
        _, result, rose = run.transition_indices()
        if result is None or rose is None:
            raise NotObserved("a status with Waiting for Trigger did not come by itself")
        orders.add(rose < result)
    if len(orders) > 1:
        raise Undescribed("the same order each time", "sometimes the result is first")
    return orders.pop()


@question(_NO_DOCUMENT, needs=Allow.TRIGGER)
def busy_while_processing(camera: CameraUnderTest) -> bool:
    """BUSY is set during an inspection (BVS ID: Ready is not)."""
    bits, seen = camera.codec.bits, set[bool]()
    for inspection in observe_inspections(camera):
        if inspection.status_under_way is not None:
            words = [inspection.status_under_way]
        else:
            end = inspection.transition_indices()[2]
            words = camera.codec.status_words(inspection.frames[:end])
        words = [word for word in words if not word & bits.waiting]
        if words and camera.codec.is_bid:
            seen.add(not words[0] & bits.ready)
        elif words:
            seen.add(any(word & bits.busy for word in words))
    if not seen:
        raise NotObserved("no status came during an inspection")
    if len(seen) > 1:
        raise Undescribed("the same each time", "BUSY in some inspections only")
    return seen.pop()


@question(_NO_DOCUMENT, needs=Allow.TRIGGER, dialects=SMART_DIALECTS)
def hidden_triggers(camera: CameraUnderTest) -> bool:
    """Waiting for Trigger stays set during an inspection, which hides that a trigger was taken."""
    seen = set[bool]()
    for inspection in observe_inspections(camera):
        fell, result, _ = inspection.transition_indices()
        if result is None:
            raise NotObserved("no result came")
        seen.add(fell is None)
    if len(seen) > 1:
        raise Undescribed("the same each time", "it falls in some inspections only")
    return seen.pop()


@question(_NO_DOCUMENT, needs=Allow.TRIGGER, dialects=SMART_DIALECTS)
def overtriggered_time(camera: CameraUnderTest) -> float:
    """Time for which Overtriggered stays set, seconds."""
    seen = observe_double_trigger(camera)
    if seen.rose_at is None:
        raise NotObserved("no trigger was reported as dropped")
    if seen.fell_at is None:
        raise Undescribed(f"it falls within {camera.options.timeout:g} s", "it stays set")
    return round(seen.fell_at - seen.rose_at, 3)


@question(
    "SC-A30 against SC-B33, published",
    needs=Allow.RUN | Allow.TRIGGER,
    dialects=SMART_DIALECTS,
    contradictions=("C8",),
)
def overtriggered_when_stopped(camera: CameraUnderTest) -> bool:
    """Overtriggered rises for a trigger to a stopped camera, too."""
    seen, bit = observe_stopped_trigger(camera), camera.codec.bits.overtriggered
    return any(word & bit for word in camera.codec.status_words(seen.frames))


@question(_NO_DOCUMENT, needs=Allow.RUN | Allow.TRIGGER, dialects=SMART_DIALECTS)
def stop_during_inspection(camera: CameraUnderTest) -> str:
    """Outcome of an inspection that Stop falls into."""
    inspection_seconds = inspection_time(camera)
    with camera.session() as client:
        camera.ensure_ready(client)
        start_index = len(client.received)
        client.send(m.Trigger(), m.Stop())
        client.round_trip()
        client.listen(inspection_seconds + camera.silence_timeout)
        frames = client.received[start_index:]
        if all(word & camera.codec.bits.running for word in camera.codec.status_words(frames)):
            raise Differs(
                "a status without Running after Stop", client.describe_received(start_index)
            )
    results = len(frames_with_id(frames, MessageId.RESULT_CONTAINER))
    return f"{results or 'no'} result{'' if results == 1 else 's'}"


@question("ID-b 210, published", needs=Allow.TRIGGER, dialects=("bid",))
def push_status(camera: CameraUnderTest) -> bool:
    """A status comes by itself with every change."""
    return bool(frames_with_id(observe_unasked_statuses(camera).frames, MessageId.STATUS))


@question("ID-a 227 against ID-b 216, published", dialects=("bid",), contradictions=("C4",))
def ready_bit(camera: CameraUnderTest) -> str:
    """Bit of the status that is Ready."""
    with camera.session() as client:
        camera.wait_until_waiting(client)
        word = client.read_status()
    bits = [number for number in (4, 5) if word >> number & 1]
    if len(bits) != 1:
        raise Undescribed("bit 4 or bit 5 in the status of a camera that waits", f"{word:#06x}")
    return f"bit {bits[0]}"


# ---------------------------------------------------------------------- switching, settings


@question(_NO_DOCUMENT, needs=Allow.SWITCH, dialects=SMART_DIALECTS)
def switch_answer(camera: CameraUnderTest) -> str:
    """The answer to a switch comes before or after the status without BUSY."""
    seen, busy = observe_switch(camera), camera.codec.bits.busy
    answer_index = seen.frames.index(seen.answer)
    was_busy = False
    for index, frame in enumerate(seen.frames):
        if frame.message_id != MessageId.STATUS:
            continue
        if camera.codec.read_numbers(frame.body)[0] & busy:
            was_busy = True
        elif was_busy:
            return "after_status" if answer_index > index else "before_status"
    raise NotObserved("no status with BUSY came during the switch, and one without it after")


@question(_NO_DOCUMENT, needs=Allow.RUN | Allow.SWITCH, dialects=SMART_DIALECTS)
def switch_while_running(camera: CameraUnderTest) -> str:
    """Outcome of a switch while the application runs."""
    with camera.session() as client:
        camera.load_application(client, camera.application)
        camera.ensure_running(client)
        target = camera.options.other_application or camera.application
        start_index = len(client.received)
        client.send(m.SwitchApplication(application=target))
        client.round_trip()
        answer_codes = _switch_answers(client, start_index)
        if not answer_codes and not _was_busy(camera, client, start_index):
            client.listen(camera.silence_timeout)
            answer_codes = _switch_answers(client, start_index)
        if not answer_codes and _was_busy(camera, client, start_index):
            client.wait_for_frame(
                MessageId.SWITCH_APPLICATION,
                camera.options.switch_timeout,
                "an answer to a switch that has begun",
                start_index=start_index,
            )
            answer_codes = _switch_answers(client, start_index)
    if not answer_codes:
        return "ignore"
    return "refuse" if answer_codes[0] else "allow"


def _switch_answers(client: RawClient, start_index: int) -> list[int]:
    """Return the codes of the answers to a switch, -1 for an answer without one."""
    answers = frames_with_id(client.received[start_index:], MessageId.SWITCH_APPLICATION)
    return [(*client.codec.read_numbers(answer.body), -1)[0] for answer in answers]


def _was_busy(camera: CameraUnderTest, client: RawClient, start_index: int) -> bool:
    statuses = camera.codec.status_words(client.received[start_index:])
    return any(word & camera.codec.bits.busy for word in statuses)


@question(
    "SC-C50 (its example against its rule), published",
    needs=Allow.NUMBER | Allow.TRIGGER,
    dialects=("b16",),
    contradictions=("C6",),
)
def big_endian_number(camera: CameraUnderTest) -> bool:
    """The number of Set sequence number is big endian."""
    little = (0x01020304).to_bytes(4, "little")
    observations.has_no_id(camera)  # raises if the number's offset is unknown
    with camera.session() as client:
        camera.ensure_ready(client)
        client.write(camera.codec.make_frame(MessageId.SET_SEQUENCE_NUMBER, little))
        field = read_next_number(camera, client)
    is_big = {little: False, little[::-1]: True}.get(field)
    if is_big is None:
        raise Undescribed(
            f"{little.hex(' ')}, as it was set, or the other way round", field.hex(" ")
        )
    camera.learn_quirk("big_endian_number", is_present=is_big)
    return is_big


@question(_NO_DOCUMENT, needs=Allow.INPUT | Allow.TRIGGER, dialects=SMART_DIALECTS)
def input_queue_depth(camera: CameraUnderTest) -> int:
    """Number of input containers that are kept."""
    data = camera.options.input_data
    if data is None:
        raise NotObserved("it is not known what input data the application takes: --camera-input")
    bit = camera.codec.bits.input_container
    inspection_time(camera)  # raises if there are no results
    with camera.session() as client:
        camera.ensure_ready(client)
        _empty_input_queue(camera, client, MAX_LEFT_CONTAINERS)
        client.send(m.SetInput(data=data))
        _trigger_once(camera, client)
        if client.read_status() & bit:
            raise NotObserved("Input Container stays set: perhaps the data does not fit")
        sent = 0
        while sent <= MAX_CONTAINERS and not client.read_status() & bit:
            client.send(m.SetInput(data=data))
            sent += 1
        full = client.read_status() & bit
        _empty_input_queue(camera, client, sent + 1)
        client.send(m.SetInput(data=data))
        _trigger_once(camera, client)
    if not full:
        raise NotObserved(f"the camera accepted {sent} containers without setting Input Container")
    return sent - 1


def _empty_input_queue(camera: CameraUnderTest, client: RawClient, max_triggers: int) -> None:
    """Trigger until Input Container is set: the queue is empty, so a run had no container."""
    for _ in range(max_triggers):
        _trigger_once(camera, client)
        if client.read_status() & camera.codec.bits.input_container:
            return
    raise NotObserved(
        f"Input Container did not rise in {max_triggers} triggers without input data: "
        'perhaps the application has no "Receive data" tool'
    )


def _trigger_once(camera: CameraUnderTest, client: RawClient) -> None:
    camera.wait_until_waiting(client)
    client.trigger()
    camera.wait_until_waiting(client)


# ---------------------------------------------------------------------- clients, frames, reboot


@question("ID-a 58 against ID-a 227, published", dialects=("bid",), contradictions=("C3",))
def disconnect_answer(camera: CameraUnderTest) -> str:
    """Answer to Disconnect, if there is one."""
    with camera.session() as client:
        client.round_trip()
        start_index = len(client.received)
        client.send(m.Disconnect())
        client.listen(camera.silence_timeout)
        answers = frames_with_id(client.received[start_index:], MessageId.DISCONNECT)
        if not answers:
            return "silent"
        if [camera.codec.read_numbers(answer.body) for answer in answers] != [(0,)]:
            raise Undescribed("the code 0, once", client.describe_received(start_index))
        return "code"


@question("ID-a 52 against ID-b 206, published", dialects=("bid",), contradictions=("C5",))
def bad_message(camera: CameraUnderTest) -> str:
    """Answers to unknown ids and wrong lengths: a code, or none."""
    with camera.session() as client:
        client.round_trip()
        start_index = len(client.received)
        client.write(
            camera.codec.make_frame(UNKNOWN_ID, bytes(2)),
            camera.codec.make_frame(MessageId.SWITCH_APPLICATION),
        )
        client.round_trip()
        answers = [
            (message.message_id, camera.codec.read_numbers(message.body))
            for message in client.received[start_index:-1]
            if message.message_id in {UNKNOWN_ID, MessageId.SWITCH_APPLICATION}
        ]
        if answers == [(UNKNOWN_ID, (0x13,)), (MessageId.SWITCH_APPLICATION, (0x10,))]:
            return "code"
        if not answers:
            return "ignore"
        raise Undescribed(
            "0x13 and 0x10, or no answer to either", client.describe_received(start_index)
        )


@question(_NO_DOCUMENT, transports=("tcp",))
def second_client(camera: CameraUnderTest) -> str:
    """Answer to a second TCP client's Connect."""
    with camera.session() as first, contextlib.ExitStack() as stack:
        try:
            second = stack.enter_context(camera.link())
            second.ask(m.Connect())
            outcome = "answered"
        except (NotObserved, LinkClosedError):
            outcome = "ended"
        except Differs:
            outcome = "left without an answer"
        try:
            first.round_trip()
            first_continues = True
        except (Differs, LinkClosedError):
            first_continues = False
    policy = {("answered", False): "takeover", ("ended", True): "refuse"}.get(
        (outcome, first_continues)
    )
    if policy is None:
        raise Undescribed(
            "one of two clients is served",
            f"the second client's Connect was {outcome}; the first client is "
            f"{'served on' if first_continues else 'not served any more'}",
        )
    return policy


@question(_NO_DOCUMENT, dialects=("handbook", "thesis"), transports=("tcp",))
def bad_frame(camera: CameraUnderTest) -> str:
    """Course of a TCP stream after bytes that are no frame."""
    longest = camera.codec.dialect.header.max_payload
    outcomes = {
        "a wrong magic number": _react_to_bad_bytes(camera, wrong_magic(camera)),
        "an impossible length": _react_to_bad_bytes(
            camera, camera.codec.make_frame(MessageId.QUERY_APPLICATION, length=longest)
        ),
    }
    reactions = set(outcomes.values())
    if len(reactions) == 1 and reactions <= {"skip", "close"}:
        return reactions.pop()
    raise Undescribed(
        "the same after both: skip or close",
        "; ".join(f"after {data}: {reaction}" for data, reaction in outcomes.items()),
    )


def _react_to_bad_bytes(camera: CameraUnderTest, data: bytes) -> str:
    """Send bytes that are no frame, then a Query; return the camera's reaction in words."""
    with camera.session() as client:
        client.round_trip()
        start_index = len(client.received)
        try:
            client.write(data, camera.codec.encode_request(m.Query()))
            client.wait_for_frame(
                MessageId.QUERY_APPLICATION,
                camera.options.timeout,
                "an answer to a Query",
                start_index=start_index,
            )
            client.listen(camera.options.silence)
        except Differs:
            return "the stream is stuck"
        except LinkClosedError:
            return "close"
        if client.ended:
            return "close"
        answers = [
            each for each in client.received[start_index:] if each.message_id != MessageId.STATUS
        ]
        return "skip" if len(answers) == 1 else "it is taken for a frame"


@question("MV31, published", needs=Allow.REBOOT, dialects=SMART_DIALECTS)
def reboot_time(camera: CameraUnderTest) -> float:
    """Time for which a restart keeps the camera off the network, seconds."""
    return round(observe_restart(camera).seconds, 2)
