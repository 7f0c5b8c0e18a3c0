"""What is wrong with a camera, or with the way to it, in plain words and with the cure.

:func:`examine` runs one check after the other, from the ground up: the name, the session, status,
application, round trip, run state, triggers, layout, clock. It changes nothing on the camera and
triggers nothing unless that is allowed.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NamedTuple

from smartcam.doctor import result_checks, session_checks, state_checks, trigger_checks
from smartcam.doctor.context import Plan, Visit, Witness
from smartcam.doctor.findings import Exit, Finding, Severity, summary
from smartcam.exceptions import (
    CameraFaultError,
    CommandRejectedError,
    ConfigurationError,
    LinkError,
    ResponseTimeoutError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.interpreters.base import resolve
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Awaitable, Callable

    from smartcam._client.link import TraceEntry
    from smartcam.interpreters.base import Spec

__all__ = ["Exit", "Finding", "Severity", "examine", "summary"]

NOTICE = Finding(
    check="notice",
    severity="ok",
    text="connecting takes the camera from another client, where it serves one: the newcomer wins",
    cure="A program that uses smartcam takes it back by itself.",
)


MAX_SECONDS = 86_400
"""Seconds that a camera is watched at most: a day."""

MAX_TRIGGERS = 10_000
"""Triggers at most: their times are kept."""


class _Check(NamedTuple):
    """One check.

    Attributes:
        name: as its findings call it.
        run: looks, and reports to the visit.
        limit: seconds that it may take, by what was asked for.
        in_session: whether it needs a session.
    """

    name: str
    run: Callable[[Visit], Awaitable[None]]
    limit: Callable[[Plan], float]
    in_session: bool = True


def _requests(plan: Plan) -> float:
    return plan.step(5.0) + state_checks.QUERIES_WITHIN


def _switch(plan: Plan) -> float:
    return 2 * plan.step(10.0)  # the turn, and what is done in it


_CHECKS = (
    _Check("name", session_checks.resolve, lambda plan: plan.step(10.0) + 1.0, in_session=False),
    _Check(
        "session",
        session_checks.connect,
        # a session that fails, every other way, and a session by one of them; and their ends
        lambda plan: 4 * plan.step(10.0) + session_checks.CONNECTS_WITHIN + session_checks.CONNECTS,
        in_session=False,
    ),
    _Check("status", state_checks.look_at_status, _requests),
    _Check(
        "application",
        trigger_checks.look_at_application,
        lambda plan: _requests(plan) + _switch(plan),
    ),
    _Check("round trip", state_checks.measure_round_trip, _requests),
    _Check("run state", state_checks.watch, lambda plan: plan.seconds + 1.0),
    _Check("trigger", trigger_checks.trigger, lambda plan: plan.count * plan.step(5.0) + 1.0),
    _Check("application", trigger_checks.give_back, _switch),
    _Check("layout", result_checks.look_at_results, lambda plan: 10.0),
    _Check("clock", state_checks.look_at_clock, _requests),
)
"""In their order. The limits are there for a fault of ours: each step has a bound of its own. Their
sum, and a second for the end of the session, bounds the whole."""


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
    """Examine a camera and yield what is found, as it is found.

    Connecting takes the camera from another client, which is the first thing that is said. Nothing
    is started, stopped, switched or set, and nothing is triggered, unless ``trigger`` says so.

    Args:
        url: the camera's address.
        application: id that is expected to be active. With ``trigger`` it is loaded and started
            for the triggers, and what was before is back afterwards.
        interpret_as: how results are to be read; None does not compare them with anything.
        y_down: the camera's y axis points down.
        trigger: send triggers.
        timeout: seconds for each step: connect (default 10), request (5), switch (10), trigger (5).
        seconds: how long a camera is watched that sends results by itself.
        count: how many triggers.
        trace: called with everything that goes over the wire.

    Raises:
        ConfigurationError: an address, a layout or a number cannot work; nothing was tried.

    Cancellation: the session is ended in order, an application that was loaded goes back. So is it
    when the generator is closed: use :func:`contextlib.aclosing`.
    """
    if not 0 < seconds <= MAX_SECONDS or not 0 < count <= MAX_TRIGGERS:
        raise ConfigurationError(
            f"doctor: seconds={seconds!r} and count={count!r}: expected more than 0, and at most "
            f"{MAX_SECONDS} seconds and {MAX_TRIGGERS} triggers"
        )
    interpreter = None if interpret_as is None else resolve(interpret_as)
    plan = Plan(
        application=application,
        interpreter=interpreter,
        y_down=y_down,
        trigger=trigger,
        timeout=timeout,
        seconds=seconds,
        count=count,
    )
    visit = Visit(plan, parse_address(url), trace, Witness(), wants_trigger=trigger)
    visit.make_camera()  # which sees to it that the options can work
    yield NOTICE
    async with visit.stack, visit.borrowed:
        for check in _CHECKS:
            goes_on = await _run(check, visit)
            for finding in visit.take():
                yield finding
            if not goes_on:
                return


async def _run(check: _Check, visit: Visit) -> bool:
    """Run a check within its limit; return whether the next ones make sense."""
    limit = check.limit(visit.plan)
    try:
        async with asyncio.timeout(limit):
            await check.run(visit)
            if not check.in_session:
                return not any(one.exit_code for one in visit.pending) or visit.camera is not None
            if not visit.patient.connected and check.name != "clock":
                await visit.patient.query_application()  # raises why
    except LinkError as exc:
        await session_checks.explain_loss(visit, exc)
        return False
    except ResponseTimeoutError as exc:
        if not visit.patient.connected:  # an answer that did not come costs the session
            await session_checks.explain_loss(visit, exc)
            return False
        visit.say(
            check.name,
            "error",
            f"the camera did not get ready in time: {exc}",
            "Give it more time (--timeout), and see whether somebody works on its pages.",
            exit_code=Exit.RAN_OUT,
        )
    except SmartCamError as exc:
        refused = isinstance(exc, (CameraFaultError, CommandRejectedError, UnsupportedError))
        visit.say(
            check.name,
            "error",
            f"this check failed: {exc}",
            exit_code=Exit.REFUSED if refused else Exit.NO_SESSION,
        )
    except TimeoutError:
        visit.say(
            check.name,
            "error",
            f"this check did not end within {limit:g} s",
            "Try again; then please tell us, with --trace.",
            exit_code=Exit.RAN_OUT,
        )
    return visit.camera is not None and visit.camera.connected
