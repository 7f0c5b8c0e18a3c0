"""Checks: run mode and triggers."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from smartcam.conformance.camera.observations import (
    inspection_time,
    inspections,
    overtrigger,
    stopped_trigger,
)
from smartcam.conformance.camera.options import Allow
from smartcam.conformance.camera.results import SMART, Check, Differs, NotObserved
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera.session_under_test import Bench
    from smartcam.protocols.messages import Message

__all__ = ["CHECKS"]


def _start(bench: Bench) -> str:
    bits = bench.wire.bits
    with bench.session() as line:
        bench.load(line, bench.application)
        bench.stop(line)
        began = line.say(m.Start())
        line.wait_status(
            lambda word: word & bits.running, bench.plan.timeout, "a status with Running"
        )
        try:
            bench.once_waiting(line)
        except NotObserved as exc:
            return str(exc)
    bench.measured["start until waiting"] = time.monotonic() - began
    return ""


def _stop(bench: Bench) -> None:
    bits = bench.wire.bits
    with bench.session() as line:
        bench.load(line, bench.application)
        bench.start(line)
        line.say(m.Stop())
        word = line.wait_status(
            lambda word: not word & bits.running, bench.plan.timeout, "a status without Running"
        )
        if word & bits.waiting:
            raise Differs("a stopped camera that does not wait for triggers", f"{word:#x}")


def _start_again(bench: Bench) -> None:
    with bench.session() as line:
        bench.start(line)
    _changes_nothing(bench, m.Start())


def _stop_again(bench: Bench) -> None:
    with bench.session() as line:
        bench.stop(line)
    _changes_nothing(bench, m.Stop())


def _changes_nothing(bench: Bench, message: Message) -> None:
    with bench.session() as line:
        was = bench.running(line)
        mark = len(line.heard)
        line.say(message)
        line.fence()
        line.listen(bench.plan.quiet)
        now = bench.running(line)
        name = type(message).__name__
        if any(one.message_id == bench.wire.dialect.message_id(message) for one in line.heard):
            raise Differs(f"no answer to {name}", line.words(mark))
        if was != now:
            raise Differs(f"a second {name} changes nothing", line.words(mark))


def _free_run(bench: Bench) -> None:
    with bench.session() as line:
        try:
            bench.ready(line)
        except NotObserved:
            if not bench.running(line):
                raise
        else:
            raise NotObserved(f"application {bench.application} waits for triggers")
        line.until(
            lambda one: one.message_id == MessageId.RESULT_CONTAINER,
            bench.plan.timeout,
            "a result of the application that runs without triggers",
        )
        bench.stop(line)
        line.fence()
        mark = len(line.heard)
        came = line.listen(2 * bench.plan.quiet)
        if any(one.message_id == MessageId.RESULT_CONTAINER for one in came):
            raise Differs("no result after Stop", line.words(mark))


def _one_result(bench: Bench) -> str:
    inspection_time(bench)  # there are results
    word = bench.wire.word
    for one in inspections(bench):
        if len(one.results) != 1:
            raise Differs("one result for each trigger", f"{len(one.results)} results")
        body = one.results[0].body
        named = int.from_bytes(body[:word], "little")
        if bench.dialect != "b16" and named != bench.application:
            raise Differs(
                f"the id {bench.application} in front of the result",
                bench.wire.spell(one.results[0]),
            )
    return f"{len(inspections(bench))} triggers"


def _waiting_falls(bench: Bench) -> None:
    for one in inspections(bench):
        if one.under_way is not None:
            fell = not one.under_way & one.waiting
            if not fell and one.results and one.results[0].at - one.sent_at < bench.plan.quiet:
                continue  # it was over before the status was asked for
            rose = True  # observing has waited for it
        else:
            places = one.places()
            fell, rose = places[0] is not None, places[2] is not None
        if not (fell and rose):
            shown = "; ".join(map(bench.wire.spell, one.came)) or "nothing"
            raise Differs("Waiting for Trigger falls with a trigger and rises again", shown)


def _acknowledged(bench: Bench) -> None:
    for one in inspections(bench):
        answers = [heard for heard in one.came if heard.message_id == MessageId.TRIGGER]
        if [bench.wire.numbers(heard.body) for heard in answers] != [(0,)]:
            shown = "; ".join(map(bench.wire.spell, one.came)) or "nothing"
            raise Differs("one answer to the trigger, the code 0", shown)


def _overtriggered(bench: Bench) -> None:
    seen = overtrigger(bench)
    if seen.rose_at is None:
        if seen.results >= 2:
            raise NotObserved("the camera took both of two triggers at once")
        raise Differs("Overtriggered for a trigger that was dropped", seen.text)
    if seen.results != 1:
        raise Differs("one result for two triggers of which one was dropped", seen.text)


def _overtriggered_falls(bench: Bench) -> None:
    seen = overtrigger(bench)
    if seen.rose_at is None:
        raise NotObserved("no trigger was reported as dropped")
    if seen.fell_at is None:
        raise Differs("a status without Overtriggered later, by itself", seen.text)


def _trigger_error(bench: Bench) -> None:
    takes = inspection_time(bench)
    error = bench.wire.bits.overtriggered
    with bench.session() as line:
        bench.ready(line)
        mark = len(line.heard)
        line.say(m.Trigger(), m.Trigger())
        line.listen(2 * takes + bench.plan.quiet)
        word = line.look()
        results = sum(one.message_id == MessageId.RESULT_CONTAINER for one in line.heard[mark:])
        if not word & error and results >= 2:
            raise NotObserved("the camera took both of two triggers at once")
        if not word & error:
            raise Differs("Trigger Error, which stays", line.words(mark))
        line.answer(m.ResetErrors())
        if line.look() & error:
            raise Differs("no Trigger Error after Reset errors", line.words(mark))


def _reset_errors(bench: Bench) -> None:
    with bench.session() as line:
        line.fence()
        mark = len(line.heard)
        answer = line.answer(m.ResetErrors())
        if bench.wire.numbers(answer.body) != (0,):
            raise Differs("the code 0", bench.wire.spell(answer))
        behind = line.heard.index(answer) + 1
        line.until(
            lambda one: one.message_id == MessageId.STATUS,
            bench.plan.timeout,
            f"a status behind the answer ({line.words(mark)})",
            mark=behind,
        )


def _trigger_stopped(bench: Bench) -> None:
    seen = stopped_trigger(bench)
    if any(one.message_id == MessageId.RESULT_CONTAINER for one in seen.came):
        raise Differs("no result of a stopped camera", seen.text)


CHECKS: tuple[Check, ...] = (
    Check(
        name="start-begins-run-mode",
        about="Start sets Running, and a triggered application begins to wait",
        sources={"": "MV31, SC-A30, published"},
        run=_start,
        needs=Allow.RUN,
        dialects=SMART,
    ),
    Check(
        name="second-start-is-harmless",
        about="Start is not answered, and changes nothing in run mode",
        sources={"": "SC-A28, published"},
        run=_start_again,
        needs=Allow.RUN,
        dialects=SMART,
    ),
    Check(
        name="trigger-gives-one-result",
        about="a trigger gives one result container, of the active application",
        sources={"": "SC-B33, MV27, published", "bid": "ID-b 213, ID-b 221, published"},
        run=_one_result,
        needs=Allow.TRIGGER,
    ),
    Check(
        name="trigger-is-acknowledged",
        about="a trigger is answered with the code 0",
        sources={"": "ID-b 221, published"},
        run=_acknowledged,
        needs=Allow.TRIGGER,
        dialects=("bid",),
    ),
    Check(
        name="waiting-falls-and-rises",
        about="Waiting for Trigger falls with a trigger and rises when the next would be taken",
        sources={"": "SC-A30, SC-C50, published", "bid": "ID-b 210, published"},
        run=_waiting_falls,
        needs=Allow.TRIGGER,
    ),
    Check(
        name="dropped-trigger-is-told",
        about="of two triggers at once one is dropped, and a status with Overtriggered says so",
        sources={"": "SC-A30, SC-B33, published"},
        run=_overtriggered,
        needs=Allow.TRIGGER,
        dialects=SMART,
    ),
    Check(
        name="overtriggered-falls-by-itself",
        about="a status without Overtriggered comes later",
        sources={"": "SC-A30, published"},
        run=_overtriggered_falls,
        needs=Allow.TRIGGER,
        dialects=SMART,
    ),
    Check(
        name="reset-errors-brings-a-status",
        about="Reset errors is answered with the code 0, and a status follows",
        sources={"": "ID-a 227, published"},
        run=_reset_errors,
        needs=Allow.ERRORS,
        dialects=("bid",),
    ),
    Check(
        name="trigger-error-stays-until-reset",
        about="a dropped trigger shows as Trigger Error, which stays until the errors are reset",
        sources={"": "ID-a 227, published"},
        run=_trigger_error,
        needs=Allow.TRIGGER | Allow.ERRORS,
        dialects=("bid",),
    ),
    Check(
        name="free-run-needs-no-trigger",
        about="an application without triggers sends results in run mode, and none after Stop",
        sources={"": "MV31, published"},
        run=_free_run,
        needs=Allow.RUN,
        dialects=SMART,
    ),
    Check(
        name="stop-ends-run-mode",
        about="Stop takes Running and Waiting for Trigger away",
        sources={"": "MV31, SC-A30, published"},
        run=_stop,
        needs=Allow.RUN,
        dialects=SMART,
    ),
    Check(
        name="second-stop-is-harmless",
        about="Stop is not answered, and changes nothing out of run mode",
        sources={"": "SC-A28, published"},
        run=_stop_again,
        needs=Allow.RUN,
        dialects=SMART,
    ),
    Check(
        name="stopped-camera-ignores-triggers",
        about="a trigger to a stopped camera gives no result",
        sources={"": "MV31, published"},
        run=_trigger_stopped,
        needs=Allow.RUN | Allow.TRIGGER,
        dialects=SMART,
    ),
)
"""In the order in which they are run."""
