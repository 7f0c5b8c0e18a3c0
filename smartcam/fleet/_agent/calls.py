"""Carry out the calls of programs at an agent."""

from __future__ import annotations

import asyncio
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

from smartcam._arguments import (
    MAX_APPLICATION_ID,
    check_age,
    check_application,
    check_application_or_name,
    check_clock_seconds,
    check_flag,
    check_integer,
    check_message_id,
    check_text,
    wrong_argument,
)
from smartcam._client._inside import TriggerRequest
from smartcam.camera import MAX_RESULTS_PER_TRIGGER, MAX_SEQUENCE_NUMBER
from smartcam.exceptions import ConfigurationError
from smartcam.fleet._agent.shared import AgentInterpretation, Owner
from smartcam.fleet._bus.keys import COMMANDS
from smartcam.fleet._bus.wire import TriggerOrder, encode_runs
from smartcam.fleet._frames.stream import FrameOrder
from smartcam.fleet._frames.wire import MAX_BITRATE, MIN_BITRATE, FrameForm

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.fleet._agent.host import Host

T = TypeVar("T")

Answer = tuple[dict[str, Any], list[bytes]]
EMPTY_ANSWER: Answer = ({}, [])
MAX_REPLY_BYTES = 1 << 20
"""Largest number of bytes of requested results, or of requested states, in one reply."""


class ProgramCall(NamedTuple):
    """A running call.

    Attributes:
        host: camera of the call.
        program: name of the calling program.
        owner: number of the program, and number of the call among the program's calls.
        arguments: arguments of the call, by name.
        blobs: byte strings that came with the call.
        timeout: seconds of the call's timeout.
        entered: state to restore after each temporary switch of the program, by the call's number.
        order: the trigger, if the call came in binary form; such a call has no ``arguments``.
        reservation: number of the call that reserved the camera; None outside of a reservation.
    """

    host: Host
    program: str
    owner: Owner
    arguments: dict[str, Any]
    blobs: list[bytes]
    timeout: float
    entered: dict[tuple[str, int], Any]
    order: TriggerOrder | None = None
    reservation: int | None = None

    def argument(self, name: str, check: Callable[..., T], *bounds: Any) -> T | None:
        """Return a checked argument; None if the call does not have it.

        Args:
            name: name of the argument.
            check: function of :mod:`smartcam._arguments` that checks the value.
            bounds: further arguments of ``check``.

        Raises:
            ConfigurationError: the value is not valid.
        """
        value = self.arguments.get(name)
        return None if value is None else check(value, name, *bounds, owner=self.host.name)

    def required(self, name: str, check: Callable[..., T], *bounds: Any) -> T:
        """Return a required argument."""
        value = self.argument(name, check, *bounds)
        if value is None:
            raise ConfigurationError(f"{self.host.name}: {name} is missing")
        return value


def _check_layouts(value: object, name: str, owner: str) -> Any:
    """Return layouts with a sequence number: one for all applications, or a mapping by id."""
    if not isinstance(value, dict):
        return check_text(value, name, owner)
    try:
        return {
            int(key): check_text(text, name, owner)
            for key, text in cast("dict[str, object]", value).items()
        }
    except ValueError as exc:
        raise wrong_argument(name, "layouts by application id", value, owner) from exc


_CARRIER = AgentInterpretation()


async def _trigger(call: ProgramCall) -> Answer:
    order = call.order
    layouts = None
    if order is not None:
        data, wait, by_application = order.data, order.wait, order.by_application
        results: object = order.results
        application, expected = order.application, order.expected
    else:
        layouts = call.argument("layouts", _check_layouts)
        data = call.blobs[0] if call.blobs else None
        results, wait = call.arguments.get("results"), call.required("wait", check_flag)
        by_application = bool(call.argument("by_application", check_flag))
        application, expected = call.arguments.get("application"), call.arguments.get("expected")
    result_count = check_integer(results, "results", 1, MAX_RESULTS_PER_TRIGGER, call.host.name)
    if application is not None:
        application = check_application(application, "application", call.host.name)
    if expected is not None:  # below 0 if the camera does not report its application
        expected = check_integer(expected, "expected", -1, MAX_APPLICATION_ID, call.host.name)
    if layouts is None and not by_application:
        interpretation = _CARRIER.for_owner(call.owner)
    else:
        interpretation = AgentInterpretation(call.owner, layouts, by_application=by_application)
    request = TriggerRequest(interpretation, data, result_count, wait, expected)
    runs = await trigger_runs(call.host, call.owner, request, application, call.timeout)
    return {}, [encode_runs(0, call.host.results.following, runs)]


async def trigger_runs(
    host: Host,
    owner: Owner,
    request: TriggerRequest,
    application: int | None,
    timeout: float,
) -> list[bytes]:
    """Trigger for a program, and return the trigger's runs as bytes.

    The arguments are those of :meth:`SharedCamera.trigger_for`; ``owner`` is the trigger's owner.
    """
    runs: list[bytes] = []
    host.outcomes[owner] = runs
    try:
        await host.require().trigger_for(request, application, timeout)
    finally:
        del host.outcomes[owner]
    return runs


async def _switch_application(call: ProgramCall) -> Answer:
    camera = call.host.require()
    await camera.switch_application(
        call.required("application", check_application_or_name), timeout=call.timeout
    )
    return {"application": camera.active_application}, []


async def _ensure(call: ProgramCall) -> Answer:
    await call.host.require().ensure_application(
        call.required("application", check_application), call.timeout
    )
    return EMPTY_ANSWER


async def _enter(call: ProgramCall) -> Answer:
    before = await call.host.require().enter_application(
        call.required("application", check_application), call.timeout
    )
    call.entered[call.host.name, call.owner.call] = (call.host.camera, before)
    return {"before": before.application, "wanted": before.wanted.application}, []


async def _leave(call: ProgramCall) -> Answer:
    entered = call.entered.pop((call.host.name, call.required("entered", check_integer, 0)), None)
    if entered is not None:
        camera, before = entered
        if call.argument("wait", check_flag) is False:
            camera.leave_application(before)  # the next command reports a failure
        else:
            await camera.leave_application_and_wait(before)
    return EMPTY_ANSWER


async def _start(call: ProgramCall) -> Answer:
    await call.host.require().start(timeout=call.timeout)
    return EMPTY_ANSWER


async def _stop(call: ProgramCall) -> Answer:
    await call.host.require().stop(timeout=call.timeout)
    return EMPTY_ANSWER


async def _query_application(call: ProgramCall) -> Answer:
    return {"application": await call.host.require().query_application(timeout=call.timeout)}, []


async def _query_status(call: ProgramCall) -> Answer:
    return {"status": int(await call.host.require().query_status(timeout=call.timeout))}, []


async def _wait_ready(call: ProgramCall) -> Answer:
    return {"status": int(await call.host.require().wait_ready(timeout=call.timeout))}, []


async def _reset_errors(call: ProgramCall) -> Answer:
    return {"status": int(await call.host.require().reset_errors(timeout=call.timeout))}, []


async def _read_image(call: ProgramCall) -> Answer:
    return {}, [await call.host.require().read_image(timeout=call.timeout)]


async def _get_clock(call: ProgramCall) -> Answer:
    return {"clock": (await call.host.require().get_clock(timeout=call.timeout)).isoformat()}, []


async def _set_clock(call: ProgramCall) -> Answer:
    text = call.required("when", check_text)
    try:
        when = datetime.fromisoformat(text)
    except ValueError as exc:
        raise ConfigurationError(f"{call.host.name}: {text!r:.80} is no time") from exc
    await call.host.require().set_clock(when)
    return EMPTY_ANSWER


async def _set_input(call: ProgramCall) -> Answer:
    await call.host.require().set_input(call.blobs[0] if call.blobs else b"")
    return EMPTY_ANSWER


async def _set_sequence_number(call: ProgramCall) -> Answer:
    await call.host.require().set_sequence_number(
        call.required("number", check_integer, 0, MAX_SEQUENCE_NUMBER)
    )
    return EMPTY_ANSWER


async def _reboot(call: ProgramCall) -> Answer:
    await call.host.require().reboot()
    return EMPTY_ANSWER


async def _take_back(call: ProgramCall) -> Answer:
    """Try now to take back a camera from another client, and wait for the session."""
    camera = call.host.require()
    camera.try_take_back()
    await camera.wait_connected(call.timeout)
    return EMPTY_ANSWER


async def _request(call: ProgramCall) -> Answer:
    answer = await call.host.require().request(
        call.required("message_id", check_message_id),
        call.blobs[0] if call.blobs else b"",
        answered=call.argument("answered", check_flag),
        timeout=call.timeout,
    )
    return {}, [] if answer is None else [answer]


MAX_FRAME_INTERVAL = 3600.0
"""Largest number of seconds between two frames of a stream that a program may request."""


def _frame_order(call: ProgramCall, *, stream: bool = False) -> FrameOrder:
    encoding = FrameForm.checked(
        call.argument("encoding", check_text) or "raw",
        call.argument("quality", check_integer, 1, 100),
        call.host.name,
        bitrate=call.argument("bitrate", check_integer, MIN_BITRATE, MAX_BITRATE),
        stream=stream,
    )
    min_interval = min(MAX_FRAME_INTERVAL, call.argument("rest", check_age) or 0.0)
    have = call.argument("have", check_integer, 0) or 0
    return FrameOrder(call.program, call.owner.call, encoding, call.timeout, min_interval, have)


async def _frame(call: ProgramCall) -> Answer:
    return await call.host.frames.send_frame(
        _frame_order(call),
        max_age=call.argument("max_age", check_age),
        after=call.argument("after", check_clock_seconds),
        fresh=bool(call.argument("fresh", check_flag)),
    ), []


async def _next_frame(call: ProgramCall) -> Answer:
    return await call.host.frames.send_next_frames(
        _frame_order(call, stream=True), call.required("stream", check_integer, 0)
    ), []


async def _leave_frames(call: ProgramCall) -> Answer:
    call.host.frames.end_stream(call.program, call.required("stream", check_integer, 0))
    return EMPTY_ANSWER


async def _about_frames(call: ProgramCall) -> Answer:
    return await call.host.frames.format_fields(call.timeout), []


async def _trigger_frame(call: ProgramCall) -> Answer:
    wait = call.argument("wait", check_flag)
    return await call.host.frames.send_triggered_frame(
        _frame_order(call), wait=wait is not False
    ), []


async def _features(call: ProgramCall) -> Answer:
    return await call.host.frames.features(
        call.argument("name", check_text),
        call.timeout,
        names_only=bool(call.argument("names_only", check_flag)),
        value_only=bool(call.argument("value_only", check_flag)),
    ), []


async def _set_feature(call: ProgramCall) -> Answer:
    name, value = call.required("name", check_text), call.arguments.get("value")
    return await call.host.frames.set_feature(name, value, call.timeout), []


async def _execute_feature(call: ProgramCall) -> Answer:
    await call.host.frames.execute_feature(call.required("name", check_text), call.timeout)
    return EMPTY_ANSWER


async def _lens(call: ProgramCall) -> Answer:
    return call.host.frames.lens_fields(call.required("lens", check_integer, 0)), []


async def _refresh(call: ProgramCall) -> Answer:
    return {"asked": await call.host.require().refresh_status(call.timeout)}, []


async def _wait_connected(call: ProgramCall) -> Answer:
    await call.host.require().wait_connected(call.timeout)
    return EMPTY_ANSWER


async def _reserve(call: ProgramCall) -> Answer:
    reservation = (call.program, call.owner.call)
    await call.host.reserve(call.program, reservation, call.timeout)
    return EMPTY_ANSWER


async def _release(call: ProgramCall) -> Answer:
    call.host.gate.release((call.program, call.required("reservation", check_integer, 0)))
    return EMPTY_ANSWER


async def _reserved(call: ProgramCall) -> Answer:
    reservation = (call.program, call.required("reservation", check_integer, 0))
    return {"reserved": await call.host.still_holds(reservation, call.timeout)}, []


async def _hello(call: ProgramCall) -> Answer:
    host = call.host
    return {
        **host.camera_fields(),
        **host.state_fields(),
        "program": call.owner.program,
        "frames": host.frames.make is not None,
        "results": host.results.following,
        "began": host.first_result,
        "states": host.states.following,
    }, []


async def _find(call: ProgramCall) -> Answer:
    """Return the number of the first result since a time of the agent's clock."""
    results = call.host.results
    since = call.required("since", check_clock_seconds)
    return {"first": results.first_since(since), "following": results.following}, []


async def _results(call: ProgramCall) -> Answer:
    part = call.host.results.read_part(call.required("first", check_integer, 0), MAX_REPLY_BYTES)
    return {"first": part.first, "following": part.following}, [
        encode_runs(0, part.following, part.data)
    ]


async def _states(call: ProgramCall) -> Answer:
    part = call.host.states.read_part(call.required("first", check_integer, 0), MAX_REPLY_BYTES)
    return {"first": part.first, "following": part.following}, part.data


ACTIONS: dict[str, Callable[[ProgramCall], Awaitable[Answer]]] = {
    "hello": _hello,
    "find": _find,
    "results": _results,
    "states": _states,
    "refresh": _refresh,
    "reserve": _reserve,
    "reserved": _reserved,
    "release": _release,
    "query_application": _query_application,
    "query_status": _query_status,
    "wait_connected": _wait_connected,
    "wait_ready": _wait_ready,
    "read_image": _read_image,
    "get_clock": _get_clock,
    "about_frames": _about_frames,
    "frame": _frame,
    "next_frame": _next_frame,
    "leave_frames": _leave_frames,
    "lens": _lens,
    "trigger_frame": _trigger_frame,
    "features": _features,
    "set_feature": _set_feature,
    "execute_feature": _execute_feature,
    "leave": _leave,
    "trigger": _trigger,
    "switch_application": _switch_application,
    "ensure": _ensure,
    "enter": _enter,
    "start": _start,
    "stop": _stop,
    "reset_errors": _reset_errors,
    "set_clock": _set_clock,
    "set_input": _set_input,
    "set_sequence_number": _set_sequence_number,
    "reboot": _reboot,
    "take_back": _take_back,
    "request": _request,
}
"""The function of each call, by the call's name."""

GATED_COMMANDS = COMMANDS - {"reserve", "release", "leave"}
"""Commands that wait at the gate while another program has reserved the camera."""


def agent_clock() -> float:
    """Return the time of the agent's clock, seconds: the clock of the agent's event loop."""
    return asyncio.get_running_loop().time()
