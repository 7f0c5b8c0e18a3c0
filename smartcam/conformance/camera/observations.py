"""What is done to the camera once and looked at by several checks: inspections, switches, a reboot.

Each is made at most once for a camera
(:meth:`~smartcam.conformance.camera.session_under_test.Bench.once`), so that a part on the machine
is not inspected twenty times.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NamedTuple

from smartcam.conformance.camera.options import Allow
from smartcam.conformance.camera.raw_client import EndedError, Line
from smartcam.conformance.camera.results import Differs, NotObserved, Undescribed
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera.session_under_test import Bench
    from smartcam.conformance.camera.wire import Heard

__all__ = [
    "INSPECTIONS",
    "Downtime",
    "Inspection",
    "Overtrigger",
    "Stopped",
    "Switch",
    "downtime",
    "inspection_time",
    "inspections",
    "no_id",
    "overtrigger",
    "stopped_trigger",
    "switch",
    "unasked",
]

INSPECTIONS = 3
"""Inspections that are looked at: an order that changes shows."""

REBOOT_POLL = 0.25
"""Seconds between two Connects to a camera that restarts, at most."""


class Inspection(NamedTuple):
    """One trigger and what came of it.

    Attributes:
        sent_at: when it was sent.
        came: the frames from then on until the camera waited for the next one.
        under_way: status word that was asked for right behind the trigger; ``bid`` only.
        word: size of a number, bytes.
        waiting: mask of Waiting for Trigger.
    """

    sent_at: float
    came: list[Heard]
    under_way: int | None
    word: int
    waiting: int

    @property
    def results(self) -> list[Heard]:
        """The result containers."""
        return [one for one in self.came if one.message_id == MessageId.RESULT_CONTAINER]

    def places(self) -> tuple[int | None, int | None, int | None]:
        """Return where Waiting fell, the first result came, and Waiting rose again."""
        fell = result = rose = None
        for place, heard in enumerate(self.came):
            if heard.message_id == MessageId.RESULT_CONTAINER and result is None:
                result = place
            elif heard.message_id == MessageId.STATUS:
                set_ = int.from_bytes(heard.body[: self.word], "little") & self.waiting
                if not set_ and fell is None:
                    fell = place
                elif set_ and fell is not None and rose is None:
                    rose = place
        return fell, result, rose


def inspections(bench: Bench) -> list[Inspection]:
    """Trigger a few times, one after the other.

    Raises:
        NotObserved: nothing may be triggered, or the application runs without triggers.
        Differs: the camera takes no trigger.
    """
    return bench.once("inspections", lambda: _inspect(bench))


def _inspect(bench: Bench) -> list[Inspection]:
    bench.require(Allow.TRIGGER)
    found: list[Inspection] = []
    with bench.session() as line:
        for _ in range(INSPECTIONS):
            bench.ready(line)
            found.append(_inspect_once(bench, line))
    times = [one.results[0].at - one.sent_at for one in found if one.results]
    if times:
        bench.measured["trigger until result"] = max(times)
    return found


def _inspect_once(bench: Bench, line: Line) -> Inspection:
    mark, under_way = len(line.heard), None
    waiting, word = bench.wire.bits.waiting, bench.wire.word
    sent_at = line.say(m.Trigger())
    if bench.wire.is_bid:
        line.say(m.GetStatus())
        answer = line.until(
            lambda one: one.message_id == MessageId.STATUS,
            bench.plan.timeout,
            "an answer to Get status",
            mark=mark,
        )
        under_way = bench.wire.numbers(answer.body)[0]
        _wait_result(bench, line, mark)
        line.wait_status(
            lambda status: status & waiting, bench.plan.timeout, "a status with Waiting for Trigger"
        )
        return Inspection(sent_at, line.heard[mark:], under_way, word, waiting)
    deadline = sent_at + bench.plan.timeout
    while (left := deadline - time.monotonic()) > 0:
        so_far = Inspection(sent_at, line.heard[mark:], under_way, word, waiting)
        if None not in so_far.places():
            break
        inspected = so_far.places()[2] is not None  # without a result so far: one may still come
        if line.next(min(left, bench.plan.quiet) if inspected else left) is None:
            break
    return Inspection(sent_at, line.heard[mark:], under_way, word, waiting)


def _wait_result(bench: Bench, line: Line, mark: int) -> None:
    """Wait for a result as long as one may take."""
    deadline = time.monotonic() + bench.plan.timeout
    while (left := deadline - time.monotonic()) > 0:
        if any(one.message_id == MessageId.RESULT_CONTAINER for one in line.heard[mark:]):
            return
        line.next(left)


def unasked(bench: Bench) -> Inspection:
    """Trigger once and ask for nothing: statuses in it came by themselves.

    For ``bid``, where :func:`inspections` asks. Raises as they do; NotObserved where no result
    comes.
    """
    return bench.once("unasked", lambda: _inspect_unasked(bench))


def _inspect_unasked(bench: Bench) -> Inspection:
    inspection_time(bench)  # there are results
    with bench.session() as line:
        bench.ready(line)
        mark = len(line.heard)
        sent_at = line.say(m.Trigger())
        _wait_result(bench, line, mark)
        line.listen(bench.patience)
        seen = Inspection(
            sent_at, line.heard[mark:], None, bench.wire.word, bench.wire.bits.waiting
        )
        if not seen.results:
            raise NotObserved(f"no result came of a trigger: {line.words(mark)}")
        return seen


def inspection_time(bench: Bench) -> float:
    """Return how long the longest inspection took, from trigger to result, seconds.

    Raises:
        NotObserved: no result comes from this application.
    """
    inspections(bench)
    longest = bench.measured.get("trigger until result")
    if longest is None:
        raise NotObserved(f"application {bench.application} sends no results")
    return longest


def no_id(bench: Bench) -> bool:
    """Return whether result containers begin without the application's id: perhaps in ``b16``.

    Raises:
        NotObserved: as :func:`inspection_time`.
        Undescribed: some have it.
    """
    inspection_time(bench)  # there are results
    if bench.dialect != "b16":
        return False
    first = [
        int.from_bytes(one.results[0].body[: bench.wire.word], "little")
        for one in inspections(bench)
        if one.results
    ]
    found = bench.application not in first
    if not found and len(set(first)) > 1:
        raise Undescribed("the same id in front of each result", str(first))
    bench.learn_quirk("no_id", on=found)
    return found


# ---------------------------------------------------------------------- too many, or none wanted


class Overtrigger(NamedTuple):
    """Two triggers at once and what came of them.

    Attributes:
        results: how many results came.
        rose_at: when the status with Overtriggered came, None where none did.
        fell_at: when the status without it came.
        text: what came, in words.
    """

    results: int
    rose_at: float | None
    fell_at: float | None
    text: str


def overtrigger(bench: Bench) -> Overtrigger:
    """Trigger twice at once and watch Overtriggered rise and fall; raises as :func:`inspections`.

    For cameras whose statuses come by themselves.
    """
    return bench.once("overtrigger", lambda: _overtrigger(bench))


def _overtrigger(bench: Bench) -> Overtrigger:
    takes = inspection_time(bench)
    bits, rose_at, fell_at = bench.wire.bits, None, None
    with bench.session() as line:
        bench.ready(line)
        mark = len(line.heard)
        line.say(m.Trigger(), m.Trigger())
        line.fence()
        deadline, place = time.monotonic() + 2 * takes + bench.plan.quiet, mark
        while fell_at is None:
            if place == len(line.heard):
                left = deadline - time.monotonic()
                if left <= 0 or line.next(left) is None:
                    break
            heard, place = line.heard[place], place + 1
            if heard.message_id != MessageId.STATUS:
                continue
            if not bench.wire.numbers(heard.body)[0] & bits.overtriggered:
                fell_at = None if rose_at is None else heard.at
            elif rose_at is None:
                rose_at = heard.at
                deadline = rose_at + bench.plan.timeout
        line.listen(takes)
        results = sum(one.message_id == MessageId.RESULT_CONTAINER for one in line.heard[mark:])
        return Overtrigger(results, rose_at, fell_at, line.words(mark))


class Stopped(NamedTuple):
    """A trigger to a stopped camera and what came of it.

    Attributes:
        came: the frames.
        text: what came, in words.
    """

    came: list[Heard]
    text: str


def stopped_trigger(bench: Bench) -> Stopped:
    """Trigger a stopped camera; raises as :func:`inspections`."""
    return bench.once("stopped trigger", lambda: _trigger_stopped(bench))


def _trigger_stopped(bench: Bench) -> Stopped:
    bench.require(Allow.RUN | Allow.TRIGGER)
    takes = inspection_time(bench)
    with bench.session() as line:
        bench.stop(line)
        mark = len(line.heard)
        line.say(m.Trigger())
        came = line.listen(takes + bench.plan.quiet)
        return Stopped(came, line.words(mark))


# ---------------------------------------------------------------------- switch, reboot


class Switch(NamedTuple):
    """A switch and what came of it.

    Attributes:
        application: the one that was asked for.
        came: the frames until the answer and the status that is not busy.
        answer: the answer.
        active: what Query told afterwards.
        seconds: from the request to the answer.
    """

    application: int
    came: list[Heard]
    answer: Heard
    active: int
    seconds: float


def switch(bench: Bench) -> Switch:
    """Load the other application, of a stopped camera.

    Raises:
        NotObserved: none was named, or it may not be loaded.
        Differs: no answer comes.
    """
    return bench.once("switch", lambda: _switch(bench))


def _switch(bench: Bench) -> Switch:
    bench.require(Allow.SWITCH)
    other = bench.plan.other_application
    if other is None:
        raise NotObserved("no other application was named: --camera-other-application")
    with bench.session() as line:
        if bench.active(line) == other:
            bench.load(line, bench.application)
        if bench.active(line) == other:
            raise NotObserved(f"application {other} is the active one: name another application")
        bench.stop(line)
        mark, began = len(line.heard), time.monotonic()
        answer = line.answer(
            m.SwitchApplication(application=other), within=bench.plan.switch_timeout
        )
        took = answer.at - began
        _wait_not_busy(bench, line, mark)
        came = line.heard[mark:]
        bench.measured["switch"] = took
        return Switch(other, came, answer, bench.active(line), took)


def _wait_not_busy(bench: Bench, line: Line, mark: int) -> None:
    """Where a status with BUSY came, wait for the one without it."""
    busy, word = bench.wire.bits.busy, bench.wire.word
    words = [
        int.from_bytes(one.body[:word], "little")
        for one in line.heard[mark:]
        if one.message_id == MessageId.STATUS
    ]
    if busy and any(one & busy for one in words) and words[-1] & busy:
        line.until(
            lambda one: (
                one.message_id == MessageId.STATUS and not bench.wire.numbers(one.body)[0] & busy
            ),
            bench.plan.timeout,
            "a status without BUSY after the switch",
        )


class Downtime(NamedTuple):
    """A restart.

    Attributes:
        seconds: from the request to the first answered Connect.
        application: the active one afterwards.
        running: run mode afterwards.
    """

    seconds: float
    application: int
    running: bool


def downtime(bench: Bench) -> Downtime:
    """Restart the camera and wait until it answers again.

    Raises:
        NotObserved: that is not allowed.
        Differs: it does not go away, or does not come back.
    """
    return bench.once("reboot", lambda: _reboot(bench))


def _reboot(bench: Bench) -> Downtime:
    bench.require(Allow.REBOOT)
    with bench.session() as line:
        began = line.say(m.Reboot())
        _wait_gone(bench, line)
    deadline = began + bench.plan.reboot_timeout
    while time.monotonic() < deadline:
        tried_at = time.monotonic()
        if _answers(bench):
            seconds = time.monotonic() - began
            with bench.session() as line:
                return Downtime(seconds, bench.active(line), bench.running(line))
        time.sleep(max(0.0, tried_at + min(REBOOT_POLL, bench.plan.quiet) - time.monotonic()))
    bench.gone = f"it did not come back within {bench.plan.reboot_timeout:g} s of a reboot"
    raise Differs("the camera is back after a reboot", bench.gone)


def _wait_gone(bench: Bench, line: Line) -> None:
    deadline = time.monotonic() + bench.plan.timeout
    try:
        while time.monotonic() < deadline:
            line.say(m.Query())
            if line.next(bench.patience) is None:
                return
    except EndedError:
        return
    raise Differs(
        "the camera restarts: the session ends", f"it still answers after {bench.plan.timeout:g} s"
    )


def _answers(bench: Bench) -> bool:
    """Whether a Connect is answered now."""
    try:
        with bench.link() as line:
            line.answer(m.Connect(), within=max(bench.plan.quiet, REBOOT_POLL))
    except (NotObserved, Differs, EndedError):
        return False
    return True
