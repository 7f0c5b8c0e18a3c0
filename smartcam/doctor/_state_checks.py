"""Check status, application, run state and clock, without changing anything."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.doctor._context import Diagnosis, called
from smartcam.doctor._findings import Exit
from smartcam.doctor._timing import Figures, figures
from smartcam.exceptions import InterpretationError, ResponseTimeoutError
from smartcam.models import Status

if TYPE_CHECKING:
    from smartcam.doctor._context import Examination, Witness
    from smartcam.doctor._findings import Severity

QUERY_COUNT = 30
"""Number of requests for the round-trip time: enough for a median, and fast."""

QUERIES_WITHIN = 3.0
"""Seconds after which no further request is sent: on a slow link fewer must suffice."""

SLOW_ROUND_TRIP_TIME = 0.05
"""A round trip of this many seconds gives a hint: on a local network it takes milliseconds."""

MAX_WATCHED_STATUSES = 1000
"""Largest number of statuses kept while watching; the last ones stay."""

CLOCK_MAY_DIFFER = timedelta(minutes=1)
"""Time by which a camera's clock may be off: a day or two of drift since it was set."""


# ---------------------------------------------------------------------- status


class _Complaint(NamedTuple):
    """A status bit that reports trouble."""

    bit: Status
    severity: Severity
    text: str
    cure: str
    exit_code: Exit = Exit.DONE


_CONDITIONS = (
    _Complaint(
        Status.SYSTEM_ERROR,
        "error",
        "the camera reports a System Error: it does not work until it is restarted",
        "Switch it off and on (or camera.reboot() in Python). If it comes back, its log and the "
        "maker's support are next.",
        Exit.REFUSED,
    ),
    _Complaint(
        Status.OVERHEAT,
        "warning",
        "the camera is too hot; inspections may get worse",
        "Cool it: a mount that takes the heat away, more air, less light time, fewer images.",
    ),
    _Complaint(
        Status.INPUT_CONTAINER,
        "warning",
        "input data and inspections are out of step: more containers than inspections (one was "
        "dropped), or fewer (one was used again)",
        "Send one container for each trigger: camera.trigger(input=...) does. Loading the "
        "application again empties the camera's queue.",
    ),
    _Complaint(
        Status.OVERTRIGGERED,
        "hint",
        "the camera has just dropped a trigger: it came while it could not take it",
        "Trigger more slowly, or from one place only: a sensor or a program.",
    ),
    _Complaint(
        Status.SIMULATION_MODE,
        "hint",
        "the camera takes its images from files, not from its sensor",
        "Choose the sensor as the image source, on the camera's pages.",
    ),
)

_STICKY = " The bit stays set until the errors are reset: await camera.reset_errors()."


async def look_at_status(exam: Examination) -> None:
    """Check ``status``: the bits that report trouble."""
    camera = exam.connected_camera
    capable = camera.capabilities
    status = await camera.query_status() if capable.get_status else camera.status
    wrong = [condition for condition in _CONDITIONS if condition.bit in status]
    for condition in wrong:
        sticky = condition.bit is Status.OVERTRIGGERED and capable.reset_errors
        cure = condition.cure + (_STICKY if sticky else "")
        exam.report(
            condition.severity, condition.text, cure, exit_code=condition.exit_code, status=status
        )
    if not wrong:
        exam.report("ok", f"no fault is reported: {status}", status=status)


# ---------------------------------------------------------------------- round trip


async def measure_round_trip(exam: Examination) -> None:
    """Check ``round trip``: the time from a Query to its answer."""
    camera, loop = exam.connected_camera, asyncio.get_running_loop()
    begin, times = loop.time(), list[float]()
    while len(times) < QUERY_COUNT and loop.time() - begin < QUERIES_WITHIN:
        sent_at = loop.time()
        await camera.query_application()
        times.append(loop.time() - sent_at)
    measured = figures(times)
    slow = measured.median > SLOW_ROUND_TRIP_TIME
    text = f"{measured.times} requests: {measured}"
    exam.report(
        "hint" if slow else "ok",
        f"{text}; that is slow for a local network" if slow else text,
        "Look at what is between: Wi-Fi, VPN, a busy switch, a busy machine." if slow else "",
        round_trip=measured._asdict(),
    )


# ---------------------------------------------------------------------- run state


_RUN_STATES: tuple[Diagnosis[list[Status]], ...] = (
    Diagnosis(
        lambda seen: _is_stopped(seen[-1]),
        "{application} is stopped, so no result comes",
        "Start it: smartcam start '{url}', or await camera.start(), or name the application "
        "(smartcam trigger --application, connect(application=...)), which starts it.",
        Exit.REFUSED,
    ),
    Diagnosis(
        lambda seen: all(Status.BUSY in status for status in seen),
        "the camera was BUSY for all of the {seconds:g} s",
        "It loads an application, or somebody works on its pages. If it stays so for minutes, "
        "restart it.",
        Exit.RAN_OUT,
    ),
    Diagnosis(
        lambda seen: True,
        "{application} runs, does not wait for a trigger, and sent nothing in {seconds:g} s",
        'It runs free without a "send results" tool, or an inspection takes longer than that: '
        "watch longer (--seconds), or look at the application on the camera.",
        Exit.RAN_OUT,
    ),
)
"""Diagnoses of a camera that sends no result while it is watched; the first that fits holds."""


async def watch(exam: Examination) -> None:
    """Check ``run state``: stopped, busy, waiting for triggers, or running free.

    A camera that waits for a trigger is watched only if none will be sent.
    """
    camera, witness, seconds = exam.connected_camera, exam.witness, exam.options.seconds
    application, status = camera.active_application, camera.status
    if Status.SYSTEM_ERROR in status:
        return  # this was reported already, and explains the rest
    settled = _is_stopped(status) or (_waits(status) and exam.wants_trigger)
    seen = [status] if settled else await _watch(exam, seconds)
    details: dict[str, Any] = {"application": application, "status": camera.status}
    stopped = _is_stopped(seen[-1])  # the camera may have stopped since
    if any(_waits(status) for status in seen) and not stopped:
        exam.may_trigger = True
        text = f"{called(application)} runs and waits for triggers"
        text += f"; {witness.results} results came in {seconds:g} s" if witness.results else ""
        exam.report("ok", text, **details, **_rate(witness))
    elif witness.results and not stopped:
        _report_free_run(exam, details)
    else:
        state = next(state for state in _RUN_STATES if state.fits(seen))
        exam.fail(
            state.text.format(application=called(application), seconds=seconds),
            state.cure.format(url=camera.url),
            exit_code=state.exit_code,
            **details,
        )


def _report_free_run(exam: Examination, details: dict[str, Any]) -> None:
    witness, rate = exam.witness, _rate(exam.witness)
    text = (
        f"{called(exam.connected_camera.active_application)} runs free: {witness.results} results "
    )
    text += f"in {exam.options.seconds:g} s"
    if rate:
        text += f", {rate['results_per_second']:.1f} a second; intervals: {_intervals(witness)}"
    wanted = exam.wants_trigger
    exam.report(
        "error" if wanted else "ok",
        text + ("; a trigger to it would get no result" if wanted else ""),
        "Take its results with camera.results() or smartcam watch; or have the application "
        "triggered, on the camera."
        if wanted
        else "",
        exit_code=Exit.RAN_OUT if wanted else Exit.DONE,
        **details,
        **rate,
    )


async def _watch(exam: Examination, seconds: float) -> list[Status]:
    """Return every status within some seconds, the present one first."""
    seen: deque[Status] = deque(maxlen=MAX_WATCHED_STATUSES)

    def note(status: Status) -> bool:
        seen.append(status)
        return False

    exam.witness.forget_arrivals()
    # open while watching, since results are made only if there is a subscriber
    async with exam.connected_camera.results(max_queue=1):
        with contextlib.suppress(ResponseTimeoutError):
            await exam.connected_camera.wait_status(note, timeout=seconds)
    return list(seen)


def _intervals(witness: Witness) -> Figures:
    return figures([after - before for before, after in pairwise(witness.arrivals)])


def _rate(witness: Witness) -> dict[str, Any]:
    """Return rate and spread of unasked results; nothing for a single one."""
    arrivals = witness.arrivals
    if len(arrivals) < 2:
        return {}
    span = arrivals[-1] - arrivals[0]
    return {
        "results": witness.results,
        "results_per_second": (len(arrivals) - 1) / span if span else 0.0,
        "interval": _intervals(witness)._asdict(),
    }


def _is_stopped(status: Status) -> bool:
    return not status & (Status.RUNNING | Status.BUSY | Status.WAITING_FOR_TRIGGER)


def _waits(status: Status) -> bool:
    return Status.WAITING_FOR_TRIGGER in status and Status.BUSY not in status


# ---------------------------------------------------------------------- clock


async def look_at_clock(exam: Examination) -> None:
    """Check ``clock``: whether it shows this machine's time, local or UTC.

    The clock has no time zone, and a restart loses it.

    Source: BVS ID guide p. 231 (published); for the others inferred.
    """
    camera = exam.connected_camera
    if not camera.capabilities.get_clock:
        exam.report("ok", f"{camera.capabilities.dialect} has no message for a clock")
        return
    try:
        shown = await camera.get_clock()
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
    clocks = {"local time": shown - local, "UTC": shown - now.replace(tzinfo=None)}
    zone, difference = min(clocks.items(), key=lambda item: abs(item[1]))
    text = f"the camera's clock shows {shown:%Y-%m-%d %H:%M:%S}"
    details: dict[str, Any] = {
        "clock": shown,
        "seconds_off": difference.total_seconds(),
        "compared_with": zone,
    }
    if abs(difference) <= CLOCK_MAY_DIFFER:
        exam.report("ok", f"{text}, which is this machine's {zone}", **details)
        return
    behind = "behind" if difference < timedelta(0) else "ahead of"
    exam.report(
        "warning",
        f"{text}, {_rounded(abs(difference))} {behind} this machine's "
        f"{zone}; it carries no time zone, and a restart of the camera loses it",
        _SET_CLOCK,
        **details,
    )


def _rounded(difference: timedelta) -> str:
    """Return a time in whole seconds, or in whole days if it is more than a week."""
    if difference > timedelta(days=7):
        return f"{difference.days} days"
    return str(timedelta(seconds=round(difference.total_seconds())))


_SET_CLOCK = (
    "await camera.set_clock(datetime.now()) after each restart of the camera, or an NTP server in "
    "its settings if it has them. Results of smartcam carry this machine's time."
)
