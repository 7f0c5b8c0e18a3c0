"""Checks: switching applications, the clock, the sequence number, input data, a restart."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from smartcam.conformance.camera.observations import downtime, inspection_time, no_id, switch
from smartcam.conformance.camera.options import Allow
from smartcam.conformance.camera.results import SMART, Check, Differs, NotObserved
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera.raw_client import Line
    from smartcam.conformance.camera.session_under_test import Bench
    from smartcam.conformance.camera.wire import Heard

__all__ = ["CHECKS", "REBOOT_CHECKS", "UNKNOWN_APPLICATION", "next_number"]

UNKNOWN_APPLICATION = 0xFFFD
"""An id that no application has, in all probability; it fits 16 bits."""

SECONDS_APART = timedelta(seconds=3)
"""How far a clock may be off right after it was set: what the way and the next full second take."""

A_DATE = datetime(2016, 6, 25, 10, 11, 12, tzinfo=UTC)
"""The one of the published examples (MV30, ID-b 218). The camera has no time zone."""


# ---------------------------------------------------------------------- switching


def _refuses_0(bench: Bench) -> None:
    _refuses(bench, 0)


def _refuses_unknown(bench: Bench) -> None:
    _refuses(bench, UNKNOWN_APPLICATION)


def _refuses(bench: Bench, application: int) -> None:
    with bench.session() as line:
        code = 0x1A if bench.wire.dialect.coded else 1
        active = bench.active(line)
        bench.stop(line)
        answer = line.answer(m.SwitchApplication(application=application))
        if bench.wire.numbers(answer.body) != (code, active):
            raise Differs(
                f"the code {code:#x} and the application that stays active, {active}",
                bench.wire.spell(answer),
            )
        if bench.active(line) != active:
            raise Differs(f"application {active} stays active", line.words())


def _switches(bench: Bench) -> str:
    seen = switch(bench)
    if bench.wire.numbers(seen.answer.body) != (0, seen.application):
        raise Differs(f"the code 0 and the id {seen.application}", bench.wire.spell(seen.answer))
    if seen.active != seen.application:
        raise Differs(
            f"application {seen.application} is active", f"Query tells application {seen.active}"
        )
    return f"{seen.seconds:.3f} s"


def _busy_meanwhile(bench: Bench) -> None:
    seen = switch(bench)
    busy = bench.wire.bits.busy
    words = [
        bench.wire.numbers(one.body)[0] for one in seen.came if one.message_id == MessageId.STATUS
    ]
    if not any(word & busy for word in words) or words[-1] & busy:
        shown = "; ".join(map(bench.wire.spell, seen.came))
        raise Differs("a status with BUSY during the switch, and one without it behind", shown)


def _second_meanwhile(bench: Bench) -> None:
    """Ask for a second switch, and for the active application, while the first is under way."""
    other = switch(bench).application
    with bench.session() as line:
        active = bench.active(line)
        if active == other:
            bench.load(line, bench.application)
            active = bench.active(line)
        bench.stop(line)
        mark = len(line.heard)
        request = m.SwitchApplication(application=other)
        line.say(request, request, m.Query())
        first = line.until(
            lambda one: one.message_id == MessageId.QUERY_APPLICATION,
            bench.plan.switch_timeout,
            "an answer to a Query during a switch",
            mark=mark,
        )
        done = (0, other)
        line.until(
            lambda one: (
                bench.wire.numbers(one.body) == done
                and one.message_id == MessageId.SWITCH_APPLICATION
            ),
            bench.plan.switch_timeout,
            "the answer to the first switch",
            mark=mark,
        )
        line.listen(bench.plan.quiet)
        _judge_second(bench, line, mark, first, active)


def _judge_second(bench: Bench, line: Line, mark: int, query: Heard, active: int) -> None:
    answers = [
        bench.wire.numbers(one.body)
        for one in line.heard[mark:]
        if one.message_id == MessageId.SWITCH_APPLICATION
    ]
    told = bench.wire.numbers(query.body)
    if bench.wire.is_bid:
        if told != (0x16, 0) or answers[0] != (0x16, active) or len(answers) != 2:
            raise Differs(
                f"the code 0x16 and 0 to the Query, 0x16 and {active} to the second switch",
                line.words(mark),
            )
    elif told[-1] != active or len(answers) != 1:
        raise Differs(
            f"the id of before, {active}, and no answer to the second switch", line.words(mark)
        )


# ---------------------------------------------------------------------- clock


def _read_clock(bench: Bench, line: Line) -> datetime:
    answer = line.answer(m.GetClock())
    numbers = bench.wire.numbers(answer.body)
    if bench.wire.dialect.coded:
        code, numbers = numbers[0], numbers[1:]
        if code != 6:
            raise Differs("the code 6", bench.wire.spell(answer))
    try:
        year, month, day, hour, minute, second = numbers
        return datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError as exc:
        raise Differs("year, month, day, hour, minute, second", bench.wire.spell(answer)) from exc


def _set_clock(bench: Bench, line: Line, when: datetime) -> None:
    request = m.SetClock(
        year=when.year,
        month=when.month,
        day=when.day,
        hour=when.hour,
        minute=when.minute,
        second=when.second,
    )
    _tell(bench, line, request, (0,))


def _tell(bench: Bench, line: Line, request: m.Request, code: tuple[int, ...]) -> None:
    """Send a request that a BVS ID acknowledges and a smart camera does not answer."""
    if not bench.wire.is_bid:
        message_id = bench.wire.dialect.message_id(request)
        line.say(request)
        if any(one.message_id == message_id for one in line.fence()):
            raise Differs(f"no answer to {type(request).__name__}", line.words())
        return
    answer = line.answer(request)
    if bench.wire.numbers(answer.body) != code:
        raise Differs(f"the code {code[0]:#x}", bench.wire.spell(answer))


def _clock_is_told(bench: Bench) -> str:
    with bench.session() as line:
        return f"{_read_clock(bench, line):%Y-%m-%d %H:%M:%S}"


def _clock_is_set(bench: Bench) -> None:
    with bench.session() as line:
        was, began = _read_clock(bench, line), time.monotonic()
        try:
            _set_clock(bench, line, A_DATE)
            now = _read_clock(bench, line)
        finally:
            _set_clock(bench, line, was + timedelta(seconds=time.monotonic() - began))
        if not A_DATE <= now < A_DATE + SECONDS_APART:
            raise Differs(f"{A_DATE:%Y-%m-%d %H:%M:%S} or a moment later", f"{now:%c}")


def _impossible_date(bench: Bench) -> None:
    request = m.SetClock(year=2016, month=13, day=32, hour=25, minute=61, second=61)
    with bench.session() as line:
        was, began = _read_clock(bench, line), time.monotonic()
        try:
            _tell(bench, line, request, (0x10,))
            _read_clock(bench, line)  # which is a date
        finally:
            _set_clock(bench, line, was + timedelta(seconds=time.monotonic() - began))


# ---------------------------------------------------------------------- number, input, reboot


def next_number(bench: Bench, line: Line) -> bytes:
    """Trigger once and return the four bytes of the sequence number in the result.

    Raises:
        NotObserved: it is not known where it stands, or no result comes.
    """
    offset = bench.plan.sequence_offset
    if offset is None:
        raise NotObserved(
            "it is not known where the sequence number stands in a result: --camera-sequence-offset"
        )
    bench.once_waiting(line)
    mark = len(line.heard)
    line.say(m.Trigger())
    result = line.until(
        lambda one: one.message_id == MessageId.RESULT_CONTAINER,
        bench.plan.timeout,
        "a result",
        mark=mark,
    )
    begin = offset + (0 if "no_id" in bench.wire.dialect.quirks else bench.wire.word)
    field = result.body[begin : begin + 4]
    if len(field) < 4:
        raise NotObserved(f"a result has no four bytes at {offset}: {bench.wire.spell(result)}")
    return field


def _number_is_set(bench: Bench) -> None:
    number = 0x01020304
    no_id(bench)  # which tells where the number stands
    little, big = number.to_bytes(4, "little"), number.to_bytes(4, "big")
    with bench.session() as line:
        bench.ready(line)
        line.write(bench.wire.frame(MessageId.SET_SEQUENCE_NUMBER, little))
        first = next_number(bench, line)
        second = next_number(bench, line)
    if bench.dialect == "b16" and first == big:
        return  # the question big_endian_number tells it
    following = (number + 1).to_bytes(4, "little")
    if (first, second) != (little, following):
        raise Differs(
            f"{little.hex(' ')} and, in the run behind, {following.hex(' ')}",
            f"{first.hex(' ')} and {second.hex(' ')}",
        )


def _input_is_taken(bench: Bench) -> None:
    data = bench.plan.input_data
    if data is None:
        raise NotObserved("it is not known what input data the application takes: --camera-input")
    takes = inspection_time(bench)
    bits = bench.wire.bits
    with bench.session() as line:
        bench.ready(line)
        mark = len(line.heard)
        for _ in range(2):  # what the bit says of the time before is over then
            _tell(bench, line, m.SetInput(data=data), (0,))
            bench.once_waiting(line)
            mark = len(line.heard)
            line.say(m.Trigger())
            line.until(
                lambda one: one.message_id == MessageId.RESULT_CONTAINER,
                takes + bench.plan.timeout,
                "a result of a trigger with input data",
                mark=mark,
            )
        if line.look() & bits.input_container:
            raise Differs(
                "no Input Container where each trigger had its input data", line.words(mark)
            )


def _reboots(bench: Bench) -> str:
    return f"{downtime(bench).seconds:.1f} s"


def _state_after_reboot(bench: Bench) -> None:
    seen = downtime(bench)
    if seen.running:
        raise Differs("the last application, stopped", f"application {seen.application} runs")


_NARROWED = "the bodies of the dialects with 32 bits narrowed, inferred"
_SWITCH = {"": "SC-B34, published", "b16": _NARROWED, "bid": "ID-a 229, published"}

CHECKS: tuple[Check, ...] = (
    Check(
        name="application-0-is-refused",
        about="a switch to the id 0 is refused, and the active application stays",
        sources=_SWITCH,
        run=_refuses_0,
        needs=Allow.SWITCH,
    ),
    Check(
        name="unknown-application-is-refused",
        about="a switch to an id that no application has is refused, and the active one stays",
        sources=_SWITCH,
        run=_refuses_unknown,
        needs=Allow.SWITCH,
    ),
    Check(
        name="switch-loads-the-application",
        about="a switch is answered when it is done, with the id that is active then",
        sources=_SWITCH,
        run=_switches,
        needs=Allow.SWITCH,
    ),
    Check(
        name="busy-during-a-switch",
        about="BUSY is set during a switch",
        sources={"": "SC-B33, published"},
        run=_busy_meanwhile,
        needs=Allow.SWITCH,
        dialects=SMART,
    ),
    Check(
        name="second-switch-meanwhile",
        about="during a switch a second one is not answered and Query tells the old application; "
        "a BVS ID answers both with Busy",
        sources={"": "no document, inferred", "bid": "ID-a 229, ID-b 216, published"},
        run=_second_meanwhile,
        needs=Allow.SWITCH,
    ),
    Check(
        name="clock-is-told",
        about="Get the time stamp is answered with a date and a time",
        sources={"": "MV29, published", "b16": _NARROWED, "bid": "ID-b 218, published"},
        run=_clock_is_told,
    ),
    Check(
        name="clock-is-set",
        about="the clock goes on from the time that is set",
        sources={"": "MV29, MV30, published", "b16": _NARROWED, "bid": "ID-a 231, published"},
        run=_clock_is_set,
        needs=Allow.CLOCK,
    ),
    Check(
        name="impossible-date-is-harmless",
        about="a time that is none is dropped or converted; a BVS ID refuses it",
        sources={"": "MV30, published", "bid": "ID-a 52, derived"},
        run=_impossible_date,
        needs=Allow.CLOCK,
    ),
    Check(
        name="sequence-number-is-set",
        about="Set sequence number is the number of the next run; the run behind has one more",
        sources={"": "SC-C50, inferred", "b16": "SC-C50, published"},
        run=_number_is_set,
        needs=Allow.NUMBER | Allow.TRIGGER,
        dialects=SMART,
        documents=("C6",),
    ),
    Check(
        name="input-data-is-taken",
        about="input data before each trigger keeps containers and inspections in step",
        sources={"": "SC-A30, SC-B33, MV30, published", "bid": "ID-a 232, ID-b 220, published"},
        run=_input_is_taken,
        needs=Allow.INPUT | Allow.TRIGGER,
    ),
)
"""In the order in which they are run."""

REBOOT_CHECKS: tuple[Check, ...] = (
    Check(
        name="reboot-restarts-the-camera",
        about="0x43 restarts the camera: the session ends, and it comes back",
        sources={"": "MV31, published"},
        run=_reboots,
        needs=Allow.REBOOT,
        dialects=SMART,
        documents=("C9",),
    ),
    Check(
        name="stopped-after-a-reboot",
        about="a camera that has restarted is stopped",
        sources={"": "no document, inferred"},
        run=_state_after_reboot,
        needs=Allow.REBOOT,
        dialects=SMART,
    ),
)
"""Behind nearly all others."""
