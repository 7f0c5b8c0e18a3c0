"""Checks of the expected application, and of triggers if these are allowed."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from smartcam.doctor._context import application_text
from smartcam.doctor._findings import Exit
from smartcam.doctor._timing import time_statistics
from smartcam.exceptions import (
    CommandRejectedError,
    InterpretationError,
    LinkError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.models import Status

if TYPE_CHECKING:
    from smartcam.doctor._context import Examination


async def look_at_application(exam: Examination) -> None:
    """Check ``application``: whether the expected one is active; if triggers are allowed, load it.

    The protocol cannot ask whether an application exists, only load it.
    """
    camera, wanted = exam.connected_camera, exam.options.application
    active = await camera.query_application()
    details: dict[str, Any] = {"active": active, "wanted": wanted}
    if wanted is None or (wanted == active and not exam.wants_trigger):
        exam.report("ok", f"{application_text(active)} is active", **details)
    elif wanted == 0:
        exam.wants_trigger = False  # triggers would run another application
        exam.fail(
            f"no application has the id 0; {application_text(active)} is active",
            "Name another id: the camera's pages show them.",
            exit_code=Exit.REFUSED,
            **details,
        )
    elif exam.wants_trigger:
        await _load_for_triggers(exam, active, wanted)
    else:
        exam.report(
            "warning",
            f"{application_text(active)} is active, not {wanted}; whether the camera has {wanted} "
            "cannot be known without loading it",
            f"smartcam switch '{camera.url}' {wanted} loads it. With --trigger the doctor loads "
            "it, and at the end the present one again.",
            **details,
        )


async def _load_for_triggers(exam: Examination, active: int, wanted: int) -> None:
    camera = exam.connected_camera
    details: dict[str, Any] = {"active": active, "wanted": wanted}
    exam.wants_trigger = False  # until the wanted application is loaded
    try:
        await exam.application_cleanup.enter_async_context(camera.application(wanted))
    except CommandRejectedError as exc:
        exam.fail(
            f"the camera has no application {wanted}: {exc}",
            "Look up the id on the camera's web page. The camera refuses a damaged one, too.",
            exit_code=Exit.REFUSED,
            **details,
        )
        return
    exam.wants_trigger = True
    text = f"application {wanted} is loaded and runs, for the triggers"
    exam.report("ok", text, **details)


async def restore_application(exam: Examination) -> None:
    """Restore the application and the run state from before the triggers."""
    try:
        await exam.application_cleanup.aclose()
    except LinkError:
        raise
    except SmartCamError as exc:
        exam.report(
            "warning",
            f"the camera did not go back to how it was: {exc}",
            "Look with smartcam status, and load or start with smartcam switch and start.",
        )


# ---------------------------------------------------------------------- triggers


async def send_triggers(exam: Examination) -> None:
    """Check ``trigger``: send triggers one by one until one has no result."""
    if not (exam.wants_trigger and exam.may_trigger):
        return
    camera, loop, options = exam.connected_camera, asyncio.get_running_loop(), exam.options
    times: list[float] = []
    start = end = loop.time()
    async with camera.results(max_queue=1):
        for _ in range(options.count):
            exam.recorder.statuses.clear()
            sent_at = loop.time()
            try:
                result = await camera.trigger(timeout=options.step_timeout(5.0))
            except LinkError:
                raise
            except InterpretationError:
                break  # the result is not readable, which the check of the layout reports
            except SmartCamError as exc:
                _report_failure(exam, exc, len(times))
                break
            end = loop.time()
            times.append(end - sent_at if result.latency is None else result.latency)
    if not times:
        return
    measured = time_statistics(times)
    rate = len(times) / max(end - start, sum(times))
    text = f"{measured.samples} triggers, to the result: {measured}; {rate:.1f} results a second"
    exam.report("ok", text, trigger_time=measured._asdict(), results_per_second=rate)
    extra_count = camera.statistics().extra_results
    if extra_count:
        exam.report(
            "hint",
            f"{extra_count} more results than triggers came: the application sends several for "
            "each",
            "Tell the client how many: camera.trigger(results_per_trigger=...).",
            extra_results=extra_count,
        )


def _report_failure(exam: Examination, error: SmartCamError, result_count: int) -> None:
    trigger_text = f"trigger {result_count + 1}"
    if not isinstance(error, TriggerTimeoutError):
        exam.fail(
            f"{trigger_text} gave no result: {error}",
            "docs/troubleshooting.md explains this error.",
            exit_code=Exit.REFUSED,
            error=type(error).__name__,
        )
        return
    was_waiting = [Status.WAITING_FOR_TRIGGER in status for status in exam.recorder.statuses]
    fell = False in was_waiting
    rose = fell and True in was_waiting[was_waiting.index(False) :]
    timeout = exam.options.step_timeout(5.0)
    if rose:
        text = (
            f"{trigger_text} was inspected and nothing was sent: Waiting for Trigger fell and rose "
            f"again, and no result came within {timeout:g} s"
        )
        cure = (
            'The application has no "send results" tool, or sends to another interface: add one '
            "for the process interface, on the camera."
        )
    elif fell:
        text = f"the inspection of {trigger_text} was not done within {timeout:g} s"
        cure = "Give it more time: --timeout, or trigger(timeout=...)."
    elif not exam.connected_camera.capabilities.unasked_status:
        text = f"{trigger_text} was taken, and no result came within {timeout:g} s"
        cure = (
            'Does the application send results to the process interface ("send results", '
            '"Outputs")? Does an inspection take longer than that (--timeout)?'
        )
    else:
        text = f"{trigger_text} was not taken: the camera went on waiting for a trigger"
        cure = (
            "It is set to another trigger source (a sensor, an encoder): look at the application's "
            "camera settings. Over UDP the trigger may have been lost."
        )
    exam.fail(text, cure, exit_code=Exit.TIMED_OUT, error=type(error).__name__, inspected=rose)
