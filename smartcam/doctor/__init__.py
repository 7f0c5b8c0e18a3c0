"""Find out what is wrong with a camera or with the connection to the camera, and the cure.

:func:`examine` runs one check after the other, beginning with the basics: the name, the session,
status, application, round trip, run state, triggers, layout, clock. It changes nothing on the
camera and triggers nothing unless that is allowed. :func:`find` searches networks for cameras.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, NamedTuple

from smartcam._arguments import (
    check_application,
    check_callable,
    check_flag,
    check_integer,
    check_number,
    check_seconds_or_none,
)
from smartcam._extras import from_part
from smartcam.doctor import _result_checks as result_checks
from smartcam.doctor import _session_checks as session_checks
from smartcam.doctor import _state_checks as state_checks
from smartcam.doctor import _trigger_checks as trigger_checks
from smartcam.doctor._context import CameraRecorder, DoctorOptions, Examination
from smartcam.doctor._findings import Exit, Finding
from smartcam.doctor._found import may_serve_one_client
from smartcam.doctor._search import find
from smartcam.exceptions import (
    CameraFaultError,
    CommandRejectedError,
    ConfigurationError,
    LinkError,
    ResponseTimeoutError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.interpreters import resolve
from smartcam.protocols._inside import load_protocol
from smartcam.settings import is_fleet, parse_address

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable

    from smartcam.interpreters._inside import Spec
    from smartcam.observers import TraceEntry
    from smartcam.settings import Address

__all__ = [
    "examine",
    "find",
]

EXCLUSIVE_NOTICE = Finding(
    check="notice",
    severity="ok",
    text="the camera serves one client: another one that is connected now loses its session",
    cure="A program that uses smartcam takes the camera back by itself.",
)

SHARED_NOTICE = Finding(
    check="notice",
    severity="ok",
    text="a fleet's agent shares the camera: no other program loses its session",
)
SEVERAL_CLIENTS_NOTICE = Finding(
    check="notice",
    severity="ok",
    text="the camera serves several clients: none of them loses its session",
)


MAX_SECONDS = 86_400
"""Largest number of seconds for which a camera is watched: a day."""

MAX_TRIGGERS = 10_000
"""Largest number of triggers of an examination, which keeps the time of each."""


class _DoctorCheck(NamedTuple):
    """One check of an examination."""

    name: str  # name of the check in its findings
    # function that checks, and reports its findings to the examination
    run: Callable[[Examination], Awaitable[None]]
    limit: Callable[[DoctorOptions], float]  # seconds that it may take with these options
    in_session: bool = True  # whether the check needs a session


def _limit_of_requests(options: DoctorOptions) -> float:
    return options.step_timeout(5.0) + state_checks.MAX_QUERYING_SECONDS


def _limit_of_application_switch(options: DoctorOptions) -> float:
    return 2 * options.step_timeout(10.0)  # waiting for a free camera, and the switch


def _limit_of_one_step(options: DoctorOptions) -> float:
    return options.step_timeout(10.0) + 1.0


_NAME_CHECK = _DoctorCheck("name", session_checks.resolve, _limit_of_one_step, in_session=False)

_WIRE_CHECKS = (
    _NAME_CHECK,
    _DoctorCheck(
        "session",
        session_checks.connect,
        # 4 steps: a session that fails, the other dialects and transports, a session with one of
        # them, more sessions to measure; then closing each session
        lambda options: (
            4 * options.step_timeout(10.0)
            + session_checks.MAX_CONNECTING_SECONDS
            + session_checks.SESSION_COUNT
        ),
        in_session=False,
    ),
)


def _checks_of_fleet_camera(url: str) -> tuple[tuple[_DoctorCheck, ...], Address]:
    """Return the checks up to a session with a camera of a fleet, and the camera's address."""
    with from_part("fleet", "an examination of a camera of a fleet needs"):
        from smartcam.doctor import _fleet_checks as checks

    fleet_checks = (
        _NAME_CHECK,
        _DoctorCheck("bus", checks.reach_bus, _limit_of_application_switch, in_session=False),
        _DoctorCheck(
            "agent",
            checks.find_agent,
            lambda options: 5 * checks.AGENT_SEARCH_SECONDS,
            in_session=False,
        ),
        _DoctorCheck("session", checks.connect, _limit_of_application_switch, in_session=False),
        _DoctorCheck("reservation", checks.reserve, _limit_of_one_step),
    )
    return fleet_checks, checks.fleet_camera_address(url)


_CHECKS = (
    _DoctorCheck("status", state_checks.look_at_status, _limit_of_requests),
    _DoctorCheck(
        "application",
        trigger_checks.look_at_application,
        lambda options: _limit_of_requests(options) + _limit_of_application_switch(options),
    ),
    _DoctorCheck("round trip", state_checks.measure_round_trip, _limit_of_requests),
    _DoctorCheck("run state", state_checks.watch, lambda options: options.seconds + 1.0),
    _DoctorCheck(
        "trigger",
        trigger_checks.send_triggers,
        lambda options: options.count * options.step_timeout(5.0) + 1.0,
    ),
    _DoctorCheck("application", trigger_checks.restore_application, _limit_of_application_switch),
    _DoctorCheck("layout", result_checks.look_at_results, lambda options: 10.0),
    _DoctorCheck("clock", state_checks.look_at_clock, _limit_of_requests),
)
"""The checks in a session, in order, after the checks of the connection. A check's limit only
matters after an internal error, since each step of a check has its own time limit. The whole
examination takes at most the sum of all limits, and a second for the end of the session."""


async def examine(
    url: str,
    *,
    application: int | None = None,
    interpret_as: Spec = None,
    y_down: bool = False,
    trigger: bool = False,
    timeout: float | None = None,
    seconds: float = 3.0,
    count: int = 10,
    trace: Callable[[TraceEntry], None] | None = None,
) -> AsyncGenerator[Finding]:
    """Examine a camera and yield each finding at once.

    Another client may lose the camera: the first finding says whether it may. Without
    ``trigger``, nothing on the camera is started, stopped, switched, set or triggered.

    Args:
        url: the camera's address; for ``gige://HOST``, a source of frames, the network, the
            control, the packets and the pictures are examined.
        application: id that is expected to be active. With ``trigger`` it is loaded and started
            for the triggers, and the one that was active before is loaded again at the end.
        interpret_as: interpretation of the results; None does not compare them with anything.
        y_down: whether the camera's y axis points down.
        trigger: whether to send triggers.
        timeout: seconds for each step: connect (default 10), request (5), switch (10), trigger (5).
        seconds: time for which a camera that sends results unasked is watched.
        count: number of triggers.
        trace: function that is called with every protocol message that is sent or received.

    Raises:
        ConfigurationError: an address, a layout or a number cannot work; nothing was tried.

    Cancellation: the session is closed properly, and the application that was active before is
    loaded again. The same happens when the generator is closed: use :func:`contextlib.aclosing`.
    """
    if application is not None:
        application = check_application(application, owner="doctor")
    is_gige_camera = _is_gige(url)
    if is_gige_camera and (trigger or application is not None or interpret_as is not None):
        raise ConfigurationError(
            "doctor: a GigE camera has no applications and no results: trigger, application and "
            "interpret_as are for smart cameras"
        )
    seconds = check_number(seconds, "seconds", 0, MAX_SECONDS, "doctor", exclusive=True)
    count = check_integer(count, "count", 1, MAX_TRIGGERS, "doctor")
    timeout = check_seconds_or_none(timeout, "timeout", "doctor", exclusive=True)
    y_down = check_flag(y_down, "y_down", "doctor")
    trigger = check_flag(trigger, "trigger", "doctor")
    if trace is not None:
        check_callable(trace, "trace", "doctor")
    if is_gige_camera:
        with from_part("frames", "an examination of a GigE camera needs"):
            from smartcam.doctor._gige_checks import examine_gige

        async with contextlib.aclosing(
            examine_gige(url, seconds=seconds, timeout=timeout)
        ) as findings:
            async for finding in findings:
                yield finding
        return
    interpreter = None if interpret_as is None else resolve(interpret_as)
    options = DoctorOptions(
        application=application,
        interpreter=interpreter,
        y_down=y_down,
        trigger=trigger,
        timeout=timeout,
        seconds=seconds,
        count=count,
    )
    in_fleet = is_fleet(url)
    first_checks, address = (
        _checks_of_fleet_camera(url) if in_fleet else (_WIRE_CHECKS, parse_address(url))
    )
    exam = Examination(options, address, trace, CameraRecorder(), wants_trigger=trigger)
    exam.make_camera()  # checks the options
    is_exclusive = not in_fleet and may_serve_one_client(load_protocol(address.protocol))
    yield (
        SHARED_NOTICE if in_fleet else EXCLUSIVE_NOTICE if is_exclusive else SEVERAL_CLIENTS_NOTICE
    )
    async with exam.cleanup, exam.application_cleanup:
        for check in (*first_checks, *_CHECKS):
            continues = await _run(check, exam)
            for finding in exam.take_findings():
                yield finding
            if not continues:
                return


def _is_gige(url: object) -> bool:
    return isinstance(url, str) and url.strip().lower().startswith("gige://")


async def _run(check: _DoctorCheck, exam: Examination) -> bool:
    """Run a check within its limit; return whether to run the next one."""
    limit, exam.check = check.limit(exam.options), check.name
    try:
        async with asyncio.timeout(limit):
            await check.run(exam)
            if not check.in_session:
                failed = any(finding.exit_code for finding in exam.pending_findings)
                return not failed or exam.camera is not None
            if not exam.connected_camera.connected and check.name != "clock":
                await exam.connected_camera.query_application()  # raises the reason
    except LinkError as exc:
        await _explain_loss(exam, exc)
        return False
    except ResponseTimeoutError as exc:
        if not exam.connected_camera.connected:  # a request without an answer has ended the session
            await _explain_loss(exam, exc)
            return False
        exam.fail(
            f"the camera did not get ready in time: {exc}",
            "Give it more time (--timeout), and see whether somebody uses the camera's web page.",
            exit_code=Exit.TIMED_OUT,
        )
    except SmartCamError as exc:
        refused = isinstance(exc, (CameraFaultError, CommandRejectedError, UnsupportedError))
        exam.fail(
            f"this check failed: {exc}", exit_code=Exit.REFUSED if refused else Exit.NO_SESSION
        )
    except TimeoutError:
        exam.fail(
            f"this check did not end within {limit:g} s",
            "Try again; then please tell us, with --trace.",
            exit_code=Exit.TIMED_OUT,
        )
    return exam.camera is not None and exam.camera.connected


async def _explain_loss(exam: Examination, error: SmartCamError) -> None:
    if exam.in_fleet:
        with from_part("fleet", "an examination of a camera of a fleet needs"):
            from smartcam.doctor import _fleet_checks as checks
        checks.explain_loss(exam, error)
    else:
        await session_checks.explain_loss(exam, error)
