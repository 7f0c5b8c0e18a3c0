"""Check status, application, run state and clock, without changing anything."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.doctor._context import Diagnosis, application_text
from smartcam.doctor._findings import Exit
from smartcam.doctor._timing import TimeStatistics, time_statistics
from smartcam.exceptions import InterpretationError, ResponseTimeoutError
from smartcam.models import Status

if TYPE_CHECKING:
    from smartcam.doctor._context import CameraRecorder, Examination
    from smartcam.doctor._findings import Severity

QUERY_COUNT = 30
"""Number of requests for the round-trip time: enough for a median, and fast."""

MAX_QUERYING_SECONDS = 3.0
"""Seconds after which no further request is sent, so that a slow link gets fewer requests."""

SLOW_ROUND_TRIP_TIME = 0.05
"""A round trip of more than this many seconds gives a hint: on a local network one takes
milliseconds."""

MAX_WATCHED_STATUSES = 1000
"""Largest number of statuses kept while watching; the last ones stay."""

MAX_CLOCK_DIFFERENCE = timedelta(minutes=1)
"""Time by which a camera's clock may be off: a day or two of drift since it was set."""


# ---------------------------------------------------------------------- status


class _StatusFault(NamedTuple):
    """A status bit that reports trouble."""

    bit: Status
    severity: Severity
    text: str
    cure: str
    exit_code: Exit = Exit.DONE


_STATUS_FAULTS = (
    _StatusFault(
        Status.SYSTEM_ERROR,
        "error",
        "the camera reports a System Error: it does not work until it is restarted",
        "Switch it off and on (or camera.reboot() in Python). If it comes back, look at its log, "
        "then ask the maker's support.",
        Exit.REFUSED,
    ),
    _StatusFault(
        Status.OVERHEAT,
        "warning",
        "the camera is too hot; inspections may get worse",
        "Cool it: a mount that takes the heat away, more air, less light time, fewer images.",
    ),
    _StatusFault(
        Status.INPUT_CONTAINER,
        "warning",
        "input data and inspections are out of step: more containers than inspections (one was "
        "dropped), or fewer (one was used again)",
        "Send one container for each trigger: camera.trigger(input=...) does. Loading the "
        "application again empties the camera's queue.",
    ),
    _StatusFault(
        Status.OVERTRIGGERED,
        "hint",
        "the camera has just dropped a trigger: it came while the camera could not take one",
        "Trigger more slowly, or from one place only: a sensor or a program.",
    ),
    _StatusFault(
        Status.SIMULATION_MODE,
        "hint",
        "the camera takes its images from files, not from its sensor",
        "Choose the sensor as the image source, on the camera's web page.",
    ),
)

_STICKY_BIT_CURE = " The bit stays set until the errors are reset: await camera.reset_errors()."


async def look_at_status(exam: Examination) -> None:
    """Check ``status``: the bits that report trouble."""
    camera = exam.connected_camera
    capabilities = camera.capabilities
    status = await camera.query_status() if capabilities.get_status else camera.status
    faults = [fault for fault in _STATUS_FAULTS if fault.bit in status]
    for fault in faults:
        is_sticky = fault.bit is Status.OVERTRIGGERED and capabilities.reset_errors
        cure = fault.cure + (_STICKY_BIT_CURE if is_sticky else "")
        exam.report(fault.severity, fault.text, cure, exit_code=fault.exit_code, status=status)
    if not faults:
        exam.report("ok", f"no fault is reported: {status}", status=status)


# ---------------------------------------------------------------------- round trip


async def measure_round_trip(exam: Examination) -> None:
    """Check ``round trip``: the time from a Query to its answer."""
    camera, loop = exam.connected_camera, asyncio.get_running_loop()
    start, times = loop.time(), list[float]()
    while len(times) < QUERY_COUNT and loop.time() - start < MAX_QUERYING_SECONDS:
        sent_at = loop.time()
        await camera.query_application()
        times.append(loop.time() - sent_at)
    measured = time_statistics(times)
    is_slow = measured.median > SLOW_ROUND_TRIP_TIME
    text = f"{measured.samples} requests: {measured}"
    exam.report(
        "hint" if is_slow else "ok",
        f"{text}; that is slow for a local network" if is_slow else text,
        "Look at what is between: Wi-Fi, VPN, a busy switch, a busy machine." if is_slow else "",
        round_trip=measured._asdict(),
    )


# ---------------------------------------------------------------------- run state


_DIAGNOSES: tuple[Diagnosis[list[Status]], ...] = (
    Diagnosis(
        lambda statuses: _is_stopped(statuses[-1]),
        "{application} is stopped, so no result comes",
        "Start it: smartcam start '{url}', or await camera.start(), or name the application "
        "(smartcam trigger --application, connect(application=...)), which starts it.",
        Exit.REFUSED,
    ),
    Diagnosis(
        lambda statuses: all(Status.BUSY in status for status in statuses),
        "the camera was BUSY for all of the {seconds:g} s",
        "It loads an application, or somebody uses its web page. If it stays so for minutes, "
        "restart it.",
        Exit.TIMED_OUT,
    ),
    Diagnosis(
        lambda statuses: True,
        "{application} runs, does not wait for a trigger, and sent nothing in {seconds:g} s",
        'It runs free without a "send results" tool, or an inspection takes longer than that: '
        "watch longer (--seconds), or look at the application on the camera.",
        Exit.TIMED_OUT,
    ),
)
"""Diagnoses of a camera that sends no result while it is watched; the first that fits is
reported."""


async def watch(exam: Examination) -> None:
    """Check ``run state``: stopped, busy, waiting for triggers, or running free.

    A camera that waits for a trigger is watched only if none will be sent.
    """
    camera, recorder, seconds = exam.connected_camera, exam.recorder, exam.options.seconds
    application, status = camera.active_application, camera.status
    if Status.SYSTEM_ERROR in status:
        return  # reported already, and the reason for a missing result
    is_decided = _is_stopped(status) or (_waits_for_trigger(status) and exam.wants_trigger)
    statuses = [status] if is_decided else await _watch_status(exam, seconds)
    details: dict[str, Any] = {"application": application, "status": camera.status}
    is_stopped = _is_stopped(statuses[-1])  # the camera may have stopped since
    if any(_waits_for_trigger(status) for status in statuses) and not is_stopped:
        exam.may_trigger = True
        text = f"{application_text(application)} runs and waits for triggers"
        text += (
            f"; {recorder.result_count} results came in {seconds:g} s"
            if recorder.result_count
            else ""
        )
        exam.report("ok", text, **details, **_rate_details(recorder))
    elif recorder.result_count and not is_stopped:
        _report_free_run(exam, details)
    else:
        diagnosis = next(diagnosis for diagnosis in _DIAGNOSES if diagnosis.fits(statuses))
        exam.fail(
            diagnosis.text.format(application=application_text(application), seconds=seconds),
            diagnosis.cure.format(url=camera.url),
            exit_code=diagnosis.exit_code,
            **details,
        )


def _report_free_run(exam: Examination, details: dict[str, Any]) -> None:
    recorder, rate = exam.recorder, _rate_details(exam.recorder)
    application = application_text(exam.connected_camera.active_application)
    text = f"{application} runs free: {recorder.result_count} results in {exam.options.seconds:g} s"
    if rate:
        intervals = _interval_statistics(recorder)
        text += f", {rate['results_per_second']:.1f} a second; intervals: {intervals}"
    wants_trigger = exam.wants_trigger
    exam.report(
        "error" if wants_trigger else "ok",
        text + ("; a trigger to it would get no result" if wants_trigger else ""),
        "Take its results with camera.results() or smartcam watch; or have the application "
        "triggered, on the camera."
        if wants_trigger
        else "",
        exit_code=Exit.TIMED_OUT if wants_trigger else Exit.DONE,
        **details,
        **rate,
    )


async def _watch_status(exam: Examination, seconds: float) -> list[Status]:
    """Return every status within some seconds, the present one first."""
    statuses: deque[Status] = deque(maxlen=MAX_WATCHED_STATUSES)

    def keep(status: Status) -> bool:
        statuses.append(status)
        return False

    exam.recorder.forget_arrivals()
    # keep a subscription open while watching, since results are made only for subscribers
    async with exam.connected_camera.results(max_queue=1):
        with contextlib.suppress(ResponseTimeoutError):
            await exam.connected_camera.wait_status(keep, timeout=seconds)
    return list(statuses)


def _interval_statistics(recorder: CameraRecorder) -> TimeStatistics:
    return time_statistics([after - before for before, after in pairwise(recorder.arrival_times)])


def _rate_details(recorder: CameraRecorder) -> dict[str, Any]:
    """Return the rate of unasked results and the spread of their intervals; {} for one result."""
    arrival_times = recorder.arrival_times
    if len(arrival_times) < 2:
        return {}
    span = arrival_times[-1] - arrival_times[0]
    return {
        "results": recorder.result_count,
        "results_per_second": (len(arrival_times) - 1) / span if span else 0.0,
        "interval": _interval_statistics(recorder)._asdict(),
    }


def _is_stopped(status: Status) -> bool:
    return not status & (Status.RUNNING | Status.BUSY | Status.WAITING_FOR_TRIGGER)


def _waits_for_trigger(status: Status) -> bool:
    return Status.WAITING_FOR_TRIGGER in status and Status.BUSY not in status


# ---------------------------------------------------------------------- clock


async def look_at_clock(exam: Examination) -> None:
    """Check ``clock``: whether the camera's clock shows this machine's time, local or UTC.

    The clock has no time zone, and loses its time at a restart.

    Source: BVS ID guide p. 231 (published); for the others inferred.
    """
    camera = exam.connected_camera
    if not camera.capabilities.get_clock:
        exam.report("ok", f"{camera.capabilities.dialect} has no message for a clock")
        return
    try:
        camera_time = await camera.get_clock()
    except InterpretationError as exc:
        exam.report("warning", f"the camera's clock is no date: {exc.got}", _SET_CLOCK)
        return
    except ResponseTimeoutError as exc:
        exam.report(
            "warning",
            f"the camera does not tell its clock: {exc}",
            "Nothing but the clock depends on this. The missing answer ended the session.",
        )
        return
    now = datetime.now(UTC)
    local = now.astimezone().replace(tzinfo=None)
    clocks = {"local time": camera_time - local, "UTC": camera_time - now.replace(tzinfo=None)}
    zone, difference = min(clocks.items(), key=lambda item: abs(item[1]))
    text = f"the camera's clock shows {camera_time:%Y-%m-%d %H:%M:%S}"
    details: dict[str, Any] = {
        "clock": camera_time,
        "seconds_off": difference.total_seconds(),
        "compared_with": zone,
    }
    if abs(difference) <= MAX_CLOCK_DIFFERENCE:
        exam.report("ok", f"{text}, which is this machine's {zone}", **details)
        return
    direction = "behind" if difference < timedelta(0) else "ahead of"
    exam.report(
        "warning",
        f"{text}, {_duration_text(abs(difference))} {direction} this machine's "
        f"{zone}; it carries no time zone, and a restart of the camera loses it",
        _SET_CLOCK,
        **details,
    )


def _duration_text(difference: timedelta) -> str:
    """Return a time in whole seconds, or in whole days if it is more than a week."""
    if difference > timedelta(days=7):
        return f"{difference.days} days"
    return str(timedelta(seconds=round(difference.total_seconds())))


_SET_CLOCK = (
    "await camera.set_clock(datetime.now()) after each restart of the camera, or an NTP server in "
    "its settings if it has them. Results of smartcam carry this machine's time."
)
