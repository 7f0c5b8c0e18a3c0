"""Questions: an experiment for each field of Quirks, and for what the documents contradict."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from smartcam.conformance.camera.message_checks import UNKNOWN_ID, wrong_magic
from smartcam.conformance.camera.observations import (
    downtime,
    inspection_time,
    inspections,
    no_id,
    overtrigger,
    stopped_trigger,
    switch,
    unasked,
)
from smartcam.conformance.camera.options import Allow
from smartcam.conformance.camera.raw_client import EndedError
from smartcam.conformance.camera.results import (
    SMART,
    Differs,
    NotObserved,
    Question,
    Undescribed,
)
from smartcam.conformance.camera.setting_checks import next_number
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera.raw_client import Line
    from smartcam.conformance.camera.session_under_test import Bench

__all__ = ["MAX_CONTAINERS", "MAX_LEFT", "QUESTIONS", "REBOOT_QUESTIONS"]

MAX_CONTAINERS = 1024
"""Input containers sent at most, to find how many are queued."""

MAX_LEFT = 64
"""Triggers at most to use up the input containers that somebody else has left."""


def _dialect(bench: Bench) -> str:
    with bench.session():
        return f"{bench.dialect} over {bench.transport.upper()}"


# ---------------------------------------------------------------------- switching


def _switch_while_running(bench: Bench) -> str:
    with bench.session() as line:
        bench.load(line, bench.application)
        bench.start(line)
        target = bench.plan.other_application or bench.application
        mark = len(line.heard)
        line.say(m.SwitchApplication(application=target))
        line.fence()
        answered = _switch_answers(line, mark)
        if not answered and not _was_busy(bench, line, mark):
            line.listen(bench.patience)
            answered = _switch_answers(line, mark)
        if not answered and _was_busy(bench, line, mark):
            line.until(
                lambda one: one.message_id == MessageId.SWITCH_APPLICATION,
                bench.plan.switch_timeout,
                "an answer to a switch that has begun",
                mark=mark,
            )
            answered = _switch_answers(line, mark)
    if not answered:
        return "ignore"
    return "refuse" if answered[0] else "allow"


def _switch_answers(line: Line, mark: int) -> list[int]:
    """Return the codes of the answers to a switch."""
    return [
        (*line.wire.numbers(one.body), -1)[0]
        for one in line.heard[mark:]
        if one.message_id == MessageId.SWITCH_APPLICATION
    ]


def _was_busy(bench: Bench, line: Line, mark: int) -> bool:
    return any(
        bench.wire.numbers(one.body)[0] & bench.wire.bits.busy
        for one in line.heard[mark:]
        if one.message_id == MessageId.STATUS
    )


def _switch_answer(bench: Bench) -> str:
    seen, busy = switch(bench), bench.wire.bits.busy
    answered = seen.came.index(seen.answer)
    was_busy = False
    for place, one in enumerate(seen.came):
        if one.message_id != MessageId.STATUS:
            continue
        if bench.wire.numbers(one.body)[0] & busy:
            was_busy = True
        elif was_busy:
            return "after_status" if answered > place else "before_status"
    raise NotObserved("no status with BUSY came during the switch, and one without it behind")


# ---------------------------------------------------------------------- inspections


def _waiting_before_result(bench: Bench) -> bool:
    inspection_time(bench)  # there are results
    orders: set[bool] = set()
    for one in [unasked(bench)] if bench.wire.is_bid else inspections(bench):
        _, result, rose = one.places()
        if result is None or rose is None:
            raise NotObserved("a status with Waiting for Trigger did not come by itself")
        orders.add(rose < result)
    if len(orders) > 1:
        raise Undescribed("the same order each time", "sometimes the result is first")
    return orders.pop()


def _busy_while_processing(bench: Bench) -> bool:
    bits, seen = bench.wire.bits, set[bool]()
    for one in inspections(bench):
        if one.under_way is not None:
            words = [one.under_way]
        else:
            end = one.places()[2]
            words = [
                bench.wire.numbers(heard.body)[0]
                for heard in one.came[:end]
                if heard.message_id == MessageId.STATUS
            ]
        words = [word for word in words if not word & bits.waiting]
        if words and bench.wire.is_bid:
            seen.add(not words[0] & bits.ready)
        elif words:
            seen.add(any(word & bits.busy for word in words))
    if not seen:
        raise NotObserved("no status came during an inspection")
    if len(seen) > 1:
        raise Undescribed("the same each time", "BUSY in some inspections only")
    return seen.pop()


def _overtriggered_time(bench: Bench) -> float:
    seen = overtrigger(bench)
    if seen.rose_at is None:
        raise NotObserved("no trigger was reported as dropped")
    if seen.fell_at is None:
        raise Undescribed(f"it falls within {bench.plan.timeout:g} s", "it stays set")
    return round(seen.fell_at - seen.rose_at, 3)


def _told_when_stopped(bench: Bench) -> bool:
    seen, bit = stopped_trigger(bench), bench.wire.bits.overtriggered
    return any(
        bench.wire.numbers(one.body)[0] & bit
        for one in seen.came
        if one.message_id == MessageId.STATUS
    )


def _stop_in_the_middle(bench: Bench) -> str:
    takes = inspection_time(bench)
    with bench.session() as line:
        bench.ready(line)
        mark = len(line.heard)
        line.say(m.Trigger(), m.Stop())
        line.fence()
        line.listen(takes + bench.patience)
        came = line.heard[mark:]
        if not any(
            one.message_id == MessageId.STATUS
            and not bench.wire.numbers(one.body)[0] & bench.wire.bits.running
            for one in came
        ):
            raise Differs("a status without Running after Stop", line.words(mark))
    results = sum(one.message_id == MessageId.RESULT_CONTAINER for one in came)
    return f"{results or 'no'} result{'' if results == 1 else 's'}"


# ---------------------------------------------------------------------- bad messages, clients


def _bad_frame(bench: Bench) -> str:
    longest = bench.wire.dialect.header.max_payload
    found = {
        "a wrong magic number": _after(bench, wrong_magic(bench)),
        "an impossible length": _after(
            bench, bench.wire.frame(MessageId.QUERY_APPLICATION, length=longest)
        ),
    }
    ways = set(found.values())
    if len(ways) == 1 and ways <= {"skip", "close"}:
        return ways.pop()
    raise Undescribed(
        "the same after both: skip or close",
        "; ".join(f"after {what}: {way}" for what, way in found.items()),
    )


def _after(bench: Bench, data: bytes) -> str:
    """Return what the camera does after bytes that are no frame, and a Query."""
    with bench.session() as line:
        line.fence()
        mark = len(line.heard)
        try:
            line.write(data, bench.wire.request(m.Query()))
            line.until(
                lambda one: one.message_id == MessageId.QUERY_APPLICATION,
                bench.plan.timeout,
                "an answer to a Query",
                mark=mark,
            )
            line.listen(bench.plan.quiet)
        except Differs:
            return "the stream is stuck"
        except EndedError:
            return "close"
        if line.ended:
            return "close"
        answers = [one for one in line.heard[mark:] if one.message_id != MessageId.STATUS]
        return "skip" if len(answers) == 1 else "it is taken for a frame"


def _second_client(bench: Bench) -> str:
    with bench.session() as first, contextlib.ExitStack() as stack:
        try:
            second = stack.enter_context(bench.link())
            second.answer(m.Connect())
            came = "answered"
        except (NotObserved, EndedError):
            came = "ended"
        except Differs:
            came = "left without an answer"
        try:
            first.fence()
            goes_on = True
        except (Differs, EndedError):
            goes_on = False
    way = {("answered", False): "takeover", ("ended", True): "refuse"}.get((came, goes_on))
    if way is None:
        raise Undescribed(
            "one of two clients is served",
            f"the second client's Connect was {came}; the first client is "
            f"{'served on' if goes_on else 'not served any more'}",
        )
    return way


def _disconnect_answer(bench: Bench) -> str:
    with bench.session() as line:
        line.fence()
        mark = len(line.heard)
        line.say(m.Disconnect())
        line.listen(bench.patience)
        answers = [one for one in line.heard[mark:] if one.message_id == MessageId.DISCONNECT]
        if not answers:
            return "silent"
        if [bench.wire.numbers(one.body) for one in answers] != [(0,)]:
            raise Undescribed("the code 0, once", line.words(mark))
        return "code"


def _bad_message(bench: Bench) -> str:
    with bench.session() as line:
        line.fence()
        mark = len(line.heard)
        line.write(
            bench.wire.frame(UNKNOWN_ID, bytes(2)),
            bench.wire.frame(MessageId.SWITCH_APPLICATION),
        )
        line.fence()
        answers = [
            (one.message_id, bench.wire.numbers(one.body))
            for one in line.heard[mark:-1]
            if one.message_id in {UNKNOWN_ID, MessageId.SWITCH_APPLICATION}
        ]
        if answers == [(UNKNOWN_ID, (0x13,)), (MessageId.SWITCH_APPLICATION, (0x10,))]:
            return "code"
        if not answers:
            return "ignore"
        raise Undescribed("0x13 and 0x10, or no answer to either", line.words(mark))


# ---------------------------------------------------------------------- the bytes


def _code(bench: Bench) -> bool:
    with bench.link() as line:
        answer = line.answer(m.Connect())
    found = {(1,): False, (0, 1): True}.get(bench.wire.numbers(answer.body))
    if found is None:
        raise Undescribed("the version 1, or the code 0 and the version", bench.wire.spell(answer))
    return found


def _big_endian_number(bench: Bench) -> bool:
    little = (0x01020304).to_bytes(4, "little")
    no_id(bench)  # which tells where the number stands
    with bench.session() as line:
        bench.ready(line)
        line.write(bench.wire.frame(MessageId.SET_SEQUENCE_NUMBER, little))
        field = next_number(bench, line)
    found = {little: False, little[::-1]: True}.get(field)
    if found is None:
        raise Undescribed(
            f"{little.hex(' ')}, as it was set, or the other way round", field.hex(" ")
        )
    bench.learn_quirk("big_endian_number", on=found)
    return found


def _push_status(bench: Bench) -> bool:
    return any(one.message_id == MessageId.STATUS for one in unasked(bench).came)


def _ready_bit(bench: Bench) -> str:
    with bench.session() as line:
        bench.once_waiting(line)
        word = line.look()
    bits = [number for number in (4, 5) if word >> number & 1]
    if len(bits) != 1:
        raise Undescribed("bit 4 or bit 5 in the status of a camera that waits", f"{word:#06x}")
    return f"bit {bits[0]}"


# ---------------------------------------------------------------------- input data, reboot


def _input_queue_depth(bench: Bench) -> int:
    data = bench.plan.input_data
    if data is None:
        raise NotObserved("it is not known what input data the application takes: --camera-input")
    bit = bench.wire.bits.input_container
    inspection_time(bench)  # there are results
    with bench.session() as line:
        bench.ready(line)
        _use_up(bench, line, MAX_LEFT)
        line.say(m.SetInput(data=data))
        _inspect(bench, line)
        if line.look() & bit:
            raise NotObserved("Input Container stays set: perhaps the data does not fit")
        sent = 0
        while sent <= MAX_CONTAINERS and not line.look() & bit:
            line.say(m.SetInput(data=data))
            sent += 1
        full = line.look() & bit
        _use_up(bench, line, sent + 1)
        line.say(m.SetInput(data=data))
        _inspect(bench, line)
    if not full:
        raise NotObserved(f"{sent} containers were taken without a word")
    return sent - 1


def _use_up(bench: Bench, line: Line, most: int) -> None:
    """Trigger until the queue of input containers is empty."""
    for _ in range(most):
        _inspect(bench, line)
        if line.look() & bench.wire.bits.input_container:
            return
    raise NotObserved(
        f"Input Container did not rise in {most} triggers without input data: "
        'perhaps the application has no "Receive data" tool'
    )


def _inspect(bench: Bench, line: Line) -> None:
    bench.once_waiting(line)
    mark = len(line.heard)
    line.say(m.Trigger())
    line.until(
        lambda one: one.message_id == MessageId.RESULT_CONTAINER,
        bench.plan.timeout,
        "a result",
        mark=mark,
    )
    bench.once_waiting(line)


def _reboot_time(bench: Bench) -> float:
    return round(downtime(bench).seconds, 2)


_OPEN = {"": "no document, open"}

QUESTIONS: tuple[Question, ...] = (
    Question(
        name="dialect",
        about="which dialect the camera speaks, over what",
        sources={"": "SC-A28, SC-C40, T 3.1.1, published"},
        run=_dialect,
        documents=("C1", "C7"),
    ),
    Question(
        name="code",
        about="answers begin with a result code",
        sources={"": "no document, inferred"},
        run=_code,
        dialects=("b16",),
        quirk="code",
    ),
    Question(
        name="no_id",
        about="result containers do not begin with the application's id",
        sources={"": "SC-C45 (its table against its example), published"},
        run=no_id,
        needs=Allow.TRIGGER,
        dialects=("b16",),
        quirk="no_id",
        documents=("C2",),
    ),
    Question(
        name="waiting_before_result",
        about="Waiting for Trigger rises before the result comes",
        sources=_OPEN,
        run=_waiting_before_result,
        needs=Allow.TRIGGER,
        quirk="waiting_before_result",
    ),
    Question(
        name="busy_while_processing",
        about="BUSY is set during an inspection (BVS ID: Ready is not)",
        sources=_OPEN,
        run=_busy_while_processing,
        needs=Allow.TRIGGER,
        quirk="busy_while_processing",
    ),
    Question(
        name="overtriggered_time",
        about="how long Overtriggered stays set, seconds",
        sources=_OPEN,
        run=_overtriggered_time,
        needs=Allow.TRIGGER,
        dialects=SMART,
        quirk="overtriggered_time",
    ),
    Question(
        name="overtriggered_when_stopped",
        about="Overtriggered rises for a trigger to a stopped camera, too",
        sources={"": "SC-A30 against SC-B33, published"},
        run=_told_when_stopped,
        needs=Allow.RUN | Allow.TRIGGER,
        dialects=SMART,
        documents=("C8",),
    ),
    Question(
        name="stop_during_inspection",
        about="what comes of an inspection that Stop falls into",
        sources=_OPEN,
        run=_stop_in_the_middle,
        needs=Allow.RUN | Allow.TRIGGER,
        dialects=SMART,
    ),
    Question(
        name="push_status",
        about="a status comes by itself with every change",
        sources={"": "ID-b 210, published"},
        run=_push_status,
        needs=Allow.TRIGGER,
        dialects=("bid",),
        quirk="push_status",
    ),
    Question(
        name="ready_bit",
        about="which bit of the status is Ready",
        sources={"": "ID-a 227 against ID-b 216, published"},
        run=_ready_bit,
        dialects=("bid",),
        documents=("C4",),
    ),
    Question(
        name="switch_answer",
        about="the answer to a switch comes before or after the status without BUSY",
        sources=_OPEN,
        run=_switch_answer,
        needs=Allow.SWITCH,
        dialects=SMART,
        quirk="switch_answer",
    ),
    Question(
        name="switch_while_running",
        about="what becomes of a switch while the application runs",
        sources=_OPEN,
        run=_switch_while_running,
        needs=Allow.RUN | Allow.SWITCH,
        dialects=SMART,
        quirk="switch_while_running",
    ),
    Question(
        name="big_endian_number",
        about="the number of Set sequence number is big endian",
        sources={"": "SC-C50 (its example against its rule), published"},
        run=_big_endian_number,
        needs=Allow.NUMBER | Allow.TRIGGER,
        dialects=("b16",),
        quirk="big_endian_number",
        documents=("C6",),
    ),
    Question(
        name="input_queue_depth",
        about="how many input containers are kept",
        sources=_OPEN,
        run=_input_queue_depth,
        needs=Allow.INPUT | Allow.TRIGGER,
        dialects=SMART,
        quirk="input_queue_depth",
    ),
    Question(
        name="disconnect_answer",
        about="whether Disconnect is answered",
        sources={"": "ID-a 58 against ID-a 227, published"},
        run=_disconnect_answer,
        dialects=("bid",),
        quirk="disconnect_answer",
        documents=("C3",),
    ),
    Question(
        name="bad_message",
        about="whether unknown ids and wrong lengths are answered with a code",
        sources={"": "ID-a 52 against ID-b 206, published"},
        run=_bad_message,
        dialects=("bid",),
        quirk="bad_message",
        documents=("C5",),
    ),
    Question(
        name="second_client",
        about="what a second TCP client's Connect meets",
        sources=_OPEN,
        run=_second_client,
        transports=("tcp",),
        quirk="second_client",
    ),
    Question(
        name="bad_frame",
        about="how a TCP stream goes on after bytes that are no frame",
        sources=_OPEN,
        run=_bad_frame,
        dialects=("handbook", "thesis"),
        transports=("tcp",),
        quirk="bad_frame",
    ),
)
"""In the order in which they are asked."""

REBOOT_QUESTIONS: tuple[Question, ...] = (
    Question(
        name="reboot_time",
        about="how long a restart keeps the camera off the network, seconds",
        sources={"": "MV31, published"},
        run=_reboot_time,
        needs=Allow.REBOOT,
        dialects=SMART,
        quirk="reboot_time",
    ),
)
"""Behind nearly all others."""
