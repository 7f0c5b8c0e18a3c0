"""Questions: an experiment for each field of Quirks, and for each contradiction of documents."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from smartcam.conformance._dialects import SMART
from smartcam.conformance.camera import _observations as observations
from smartcam.conformance.camera._message_checks import UNKNOWN_ID, wrong_magic
from smartcam.conformance.camera._observations import (
    downtime,
    inspection_time,
    inspections,
    overtrigger,
    stopped_trigger,
    switch,
    unasked,
)
from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._raw_client import EndedError
from smartcam.conformance.camera._results import question
from smartcam.conformance.camera._setting_checks import next_number
from smartcam.conformance.camera._verdicts import Differs, NotObserved, Undescribed
from smartcam.conformance.camera._wire import of_kind
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera._raw_client import RawClient
    from smartcam.conformance.camera._session_under_test import CameraUnderTest

MAX_CONTAINERS = 1024
"""Largest number of input containers sent to find the length of the queue."""

MAX_LEFT = 64
"""Largest number of triggers that use up input containers of another client."""

_OPEN = {"": "no document, open"}


@question("SC-A28, SC-C40, T 3.1.1, published", documents=("C1", "C7"))
def dialect(camera: CameraUnderTest) -> str:
    """Dialect that the camera speaks, and its transport."""
    with camera.session():
        return f"{camera.dialect} over {camera.transport.upper()}"


@question("no document, inferred", dialects=("b16",))
def code(camera: CameraUnderTest) -> bool:
    """Answers begin with a result code."""
    with camera.link() as client:
        answer = client.answer(m.Connect())
    has_code = {(1,): False, (0, 1): True}.get(camera.wire.numbers(answer.body))
    if has_code is None:
        raise Undescribed("the version 1, or the code 0 and the version", camera.wire.spell(answer))
    return has_code


@question(
    "SC-C45 (its table against its example), published",
    needs=Allow.TRIGGER,
    dialects=("b16",),
    documents=("C2",),
)
def no_id(camera: CameraUnderTest) -> bool:
    """Result containers do not begin with the application's id."""
    return observations.no_id(camera)


# ---------------------------------------------------------------------- inspections


@question(_OPEN, needs=Allow.TRIGGER)
def waiting_before_result(camera: CameraUnderTest) -> bool:
    """Waiting for Trigger rises before the result comes."""
    inspection_time(camera)  # raises if there are no results
    orders: set[bool] = set()
    for run in [unasked(camera)] if camera.wire.is_bid else inspections(camera):
        _, result, rose = run.places()
        if result is None or rose is None:
            raise NotObserved("a status with Waiting for Trigger did not come by itself")
        orders.add(rose < result)
    if len(orders) > 1:
        raise Undescribed("the same order each time", "sometimes the result is first")
    return orders.pop()


@question(_OPEN, needs=Allow.TRIGGER)
def busy_while_processing(camera: CameraUnderTest) -> bool:
    """BUSY is set during an inspection (BVS ID: Ready is not)."""
    bits, seen = camera.wire.bits, set[bool]()
    for inspection in inspections(camera):
        if inspection.under_way is not None:
            words = [inspection.under_way]
        else:
            end = inspection.places()[2]
            words = camera.wire.statuses(inspection.frames[:end])
        words = [word for word in words if not word & bits.waiting]
        if words and camera.wire.is_bid:
            seen.add(not words[0] & bits.ready)
        elif words:
            seen.add(any(word & bits.busy for word in words))
    if not seen:
        raise NotObserved("no status came during an inspection")
    if len(seen) > 1:
        raise Undescribed("the same each time", "BUSY in some inspections only")
    return seen.pop()


@question(_OPEN, needs=Allow.TRIGGER, dialects=SMART)
def hidden_triggers(camera: CameraUnderTest) -> bool:
    """Waiting for Trigger stays set during an inspection."""
    seen = set[bool]()
    for inspection in inspections(camera):
        fell, result, _ = inspection.places()
        if result is None:
            raise NotObserved("no result came")
        seen.add(fell is None)
    if len(seen) > 1:
        raise Undescribed("the same each time", "it falls in some inspections only")
    return seen.pop()


@question(_OPEN, needs=Allow.TRIGGER, dialects=SMART)
def overtriggered_time(camera: CameraUnderTest) -> float:
    """Time for which Overtriggered stays set, seconds."""
    seen = overtrigger(camera)
    if seen.rose_at is None:
        raise NotObserved("no trigger was reported as dropped")
    if seen.fell_at is None:
        raise Undescribed(f"it falls within {camera.options.timeout:g} s", "it stays set")
    return round(seen.fell_at - seen.rose_at, 3)


@question(
    "SC-A30 against SC-B33, published",
    needs=Allow.RUN | Allow.TRIGGER,
    dialects=SMART,
    documents=("C8",),
)
def overtriggered_when_stopped(camera: CameraUnderTest) -> bool:
    """Overtriggered rises for a trigger to a stopped camera, too."""
    seen, bit = stopped_trigger(camera), camera.wire.bits.overtriggered
    return any(word & bit for word in camera.wire.statuses(seen.frames))


@question(_OPEN, needs=Allow.RUN | Allow.TRIGGER, dialects=SMART)
def stop_during_inspection(camera: CameraUnderTest) -> str:
    """Outcome of an inspection that Stop falls into."""
    takes = inspection_time(camera)
    with camera.session() as client:
        camera.ready(client)
        mark = len(client.received)
        client.send(m.Trigger(), m.Stop())
        client.fence()
        client.listen(takes + camera.patience)
        frames = client.received[mark:]
        if all(word & camera.wire.bits.running for word in camera.wire.statuses(frames)):
            raise Differs("a status without Running after Stop", client.words(mark))
    results = len(of_kind(frames, MessageId.RESULT_CONTAINER))
    return f"{results or 'no'} result{'' if results == 1 else 's'}"


@question("ID-b 210, published", needs=Allow.TRIGGER, dialects=("bid",))
def push_status(camera: CameraUnderTest) -> bool:
    """A status comes by itself with every change."""
    return bool(of_kind(unasked(camera).frames, MessageId.STATUS))


@question("ID-a 227 against ID-b 216, published", dialects=("bid",), documents=("C4",))
def ready_bit(camera: CameraUnderTest) -> str:
    """Bit of the status that is Ready."""
    with camera.session() as client:
        camera.once_waiting(client)
        word = client.look()
    bits = [number for number in (4, 5) if word >> number & 1]
    if len(bits) != 1:
        raise Undescribed("bit 4 or bit 5 in the status of a camera that waits", f"{word:#06x}")
    return f"bit {bits[0]}"


# ---------------------------------------------------------------------- switching, settings


@question(_OPEN, needs=Allow.SWITCH, dialects=SMART)
def switch_answer(camera: CameraUnderTest) -> str:
    """The answer to a switch comes before or after the status without BUSY."""
    seen, busy = switch(camera), camera.wire.bits.busy
    answered = seen.frames.index(seen.answer)
    was_busy = False
    for place, frame in enumerate(seen.frames):
        if frame.message_id != MessageId.STATUS:
            continue
        if camera.wire.numbers(frame.body)[0] & busy:
            was_busy = True
        elif was_busy:
            return "after_status" if answered > place else "before_status"
    raise NotObserved("no status with BUSY came during the switch, and one without it after")


@question(_OPEN, needs=Allow.RUN | Allow.SWITCH, dialects=SMART)
def switch_while_running(camera: CameraUnderTest) -> str:
    """Outcome of a switch while the application runs."""
    with camera.session() as client:
        camera.load(client, camera.application)
        camera.start(client)
        target = camera.options.other_application or camera.application
        mark = len(client.received)
        client.send(m.SwitchApplication(application=target))
        client.fence()
        answered = _switch_answers(client, mark)
        if not answered and not _was_busy(camera, client, mark):
            client.listen(camera.patience)
            answered = _switch_answers(client, mark)
        if not answered and _was_busy(camera, client, mark):
            client.until(
                MessageId.SWITCH_APPLICATION,
                camera.options.switch_timeout,
                "an answer to a switch that has begun",
                mark=mark,
            )
            answered = _switch_answers(client, mark)
    if not answered:
        return "ignore"
    return "refuse" if answered[0] else "allow"


def _switch_answers(client: RawClient, mark: int) -> list[int]:
    """Return the codes of the answers to a switch."""
    answers = of_kind(client.received[mark:], MessageId.SWITCH_APPLICATION)
    return [(*client.wire.numbers(answer.body), -1)[0] for answer in answers]


def _was_busy(camera: CameraUnderTest, client: RawClient, mark: int) -> bool:
    statuses = camera.wire.statuses(client.received[mark:])
    return any(word & camera.wire.bits.busy for word in statuses)


@question(
    "SC-C50 (its example against its rule), published",
    needs=Allow.NUMBER | Allow.TRIGGER,
    dialects=("b16",),
    documents=("C6",),
)
def big_endian_number(camera: CameraUnderTest) -> bool:
    """The number of Set sequence number is big endian."""
    little = (0x01020304).to_bytes(4, "little")
    observations.no_id(camera)  # raises if the number's place is unknown
    with camera.session() as client:
        camera.ready(client)
        client.write(camera.wire.frame(MessageId.SET_SEQUENCE_NUMBER, little))
        field = next_number(camera, client)
    is_big = {little: False, little[::-1]: True}.get(field)
    if is_big is None:
        raise Undescribed(
            f"{little.hex(' ')}, as it was set, or the other way round", field.hex(" ")
        )
    camera.learn_quirk("big_endian_number", on=is_big)
    return is_big


@question(_OPEN, needs=Allow.INPUT | Allow.TRIGGER, dialects=SMART)
def input_queue_depth(camera: CameraUnderTest) -> int:
    """Number of input containers that are kept."""
    data = camera.options.input_data
    if data is None:
        raise NotObserved("it is not known what input data the application takes: --camera-input")
    bit = camera.wire.bits.input_container
    inspection_time(camera)  # raises if there are no results
    with camera.session() as client:
        camera.ready(client)
        _use_up(camera, client, MAX_LEFT)
        client.send(m.SetInput(data=data))
        _inspect(camera, client)
        if client.look() & bit:
            raise NotObserved("Input Container stays set: perhaps the data does not fit")
        sent = 0
        while sent <= MAX_CONTAINERS and not client.look() & bit:
            client.send(m.SetInput(data=data))
            sent += 1
        full = client.look() & bit
        _use_up(camera, client, sent + 1)
        client.send(m.SetInput(data=data))
        _inspect(camera, client)
    if not full:
        raise NotObserved(f"{sent} containers were taken without a word")
    return sent - 1


def _use_up(camera: CameraUnderTest, client: RawClient, most: int) -> None:
    """Trigger until the queue of input containers is empty."""
    for _ in range(most):
        _inspect(camera, client)
        if client.look() & camera.wire.bits.input_container:
            return
    raise NotObserved(
        f"Input Container did not rise in {most} triggers without input data: "
        'perhaps the application has no "Receive data" tool'
    )


def _inspect(camera: CameraUnderTest, client: RawClient) -> None:
    camera.once_waiting(client)
    client.trigger()
    camera.once_waiting(client)


# ---------------------------------------------------------------------- clients, frames, reboot


@question("ID-a 58 against ID-a 227, published", dialects=("bid",), documents=("C3",))
def disconnect_answer(camera: CameraUnderTest) -> str:
    """Answer to Disconnect, if there is one."""
    with camera.session() as client:
        client.fence()
        mark = len(client.received)
        client.send(m.Disconnect())
        client.listen(camera.patience)
        answers = of_kind(client.received[mark:], MessageId.DISCONNECT)
        if not answers:
            return "silent"
        if [camera.wire.numbers(answer.body) for answer in answers] != [(0,)]:
            raise Undescribed("the code 0, once", client.words(mark))
        return "code"


@question("ID-a 52 against ID-b 206, published", dialects=("bid",), documents=("C5",))
def bad_message(camera: CameraUnderTest) -> str:
    """Answers to unknown ids and wrong lengths: a code, or none."""
    with camera.session() as client:
        client.fence()
        mark = len(client.received)
        client.write(
            camera.wire.frame(UNKNOWN_ID, bytes(2)),
            camera.wire.frame(MessageId.SWITCH_APPLICATION),
        )
        client.fence()
        answers = [
            (message.message_id, camera.wire.numbers(message.body))
            for message in client.received[mark:-1]
            if message.message_id in {UNKNOWN_ID, MessageId.SWITCH_APPLICATION}
        ]
        if answers == [(UNKNOWN_ID, (0x13,)), (MessageId.SWITCH_APPLICATION, (0x10,))]:
            return "code"
        if not answers:
            return "ignore"
        raise Undescribed("0x13 and 0x10, or no answer to either", client.words(mark))


@question(_OPEN, transports=("tcp",))
def second_client(camera: CameraUnderTest) -> str:
    """Answer to a second TCP client's Connect."""
    with camera.session() as first, contextlib.ExitStack() as stack:
        try:
            second = stack.enter_context(camera.link())
            second.answer(m.Connect())
            outcome = "answered"
        except (NotObserved, EndedError):
            outcome = "ended"
        except Differs:
            outcome = "left without an answer"
        try:
            first.fence()
            goes_on = True
        except (Differs, EndedError):
            goes_on = False
    policy = {("answered", False): "takeover", ("ended", True): "refuse"}.get((outcome, goes_on))
    if policy is None:
        raise Undescribed(
            "one of two clients is served",
            f"the second client's Connect was {outcome}; the first client is "
            f"{'served on' if goes_on else 'not served any more'}",
        )
    return policy


@question(_OPEN, dialects=("handbook", "thesis"), transports=("tcp",))
def bad_frame(camera: CameraUnderTest) -> str:
    """Course of a TCP stream after bytes that are no frame."""
    longest = camera.wire.dialect.header.max_payload
    outcomes = {
        "a wrong magic number": _after(camera, wrong_magic(camera)),
        "an impossible length": _after(
            camera, camera.wire.frame(MessageId.QUERY_APPLICATION, length=longest)
        ),
    }
    ways = set(outcomes.values())
    if len(ways) == 1 and ways <= {"skip", "close"}:
        return ways.pop()
    raise Undescribed(
        "the same after both: skip or close",
        "; ".join(f"after {data}: {way}" for data, way in outcomes.items()),
    )


def _after(camera: CameraUnderTest, data: bytes) -> str:
    """Send bytes that are no frame, and a Query; return the camera's reaction in words."""
    with camera.session() as client:
        client.fence()
        mark = len(client.received)
        try:
            client.write(data, camera.wire.request(m.Query()))
            client.until(
                MessageId.QUERY_APPLICATION,
                camera.options.timeout,
                "an answer to a Query",
                mark=mark,
            )
            client.listen(camera.options.quiet)
        except Differs:
            return "the stream is stuck"
        except EndedError:
            return "close"
        if client.ended:
            return "close"
        answers = [each for each in client.received[mark:] if each.message_id != MessageId.STATUS]
        return "skip" if len(answers) == 1 else "it is taken for a frame"


@question("MV31, published", needs=Allow.REBOOT, dialects=SMART)
def reboot_time(camera: CameraUnderTest) -> float:
    """Time for which a restart keeps the camera off the network, seconds."""
    return round(downtime(camera).seconds, 2)
