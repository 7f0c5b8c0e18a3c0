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
from smartcam.fleet._agent.client import AgentInterpretation, Owner
from smartcam.fleet._bus.keys import COMMANDS
from smartcam.fleet._bus.wire import TriggerCall, encode_groups
from smartcam.fleet._frames.stream import FrameCall
from smartcam.fleet._frames.wire import MAX_BITRATE, MIN_BITRATE, FrameForm

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.fleet._agent.client import AgentClient
    from smartcam.fleet._agent.shared_camera import SharedCamera

T = TypeVar("T")

Answer = tuple[dict[str, Any], list[bytes]]
EMPTY_ANSWER: Answer = ({}, [])
MAX_REPLY_BYTES = 1 << 20
"""Largest number of bytes of requested results, or of requested states, in one reply."""


class ProgramCall(NamedTuple):
    """A running call.

    Attributes:
        camera: the camera.
        program: name of the calling program.
        owner: number of the program, and number of the call among the program's calls.
        arguments: arguments of the call, by name.
        blobs: byte strings that came with the call.
        timeout: seconds of the call's timeout.
        switches: client and state to restore after each temporary switch of the application, by the
            camera's name and the call's number.
        binary_trigger: the trigger, if the call came in binary form, without ``arguments``.
        reservation: number of the call that reserved the camera; None outside of a reservation.
    """

    camera: SharedCamera
    program: str
    owner: Owner
    arguments: dict[str, Any]
    blobs: list[bytes]
    timeout: float
    switches: dict[tuple[str, int], Any]
    binary_trigger: TriggerCall | None = None
    reservation: int | None = None

    @property
    def client(self) -> AgentClient:
        """The client of the camera.

        Raises:
            LinkError: there is no session; the text has the reason.
        """
        return self.camera.require_client()

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
        return None if value is None else check(value, name, *bounds, owner=self.camera.name)

    def required(self, name: str, check: Callable[..., T], *bounds: Any) -> T:
        """Return a required argument."""
        value = self.argument(name, check, *bounds)
        if value is None:
            raise ConfigurationError(f"{self.camera.name}: {name} is missing")
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


_RAW_INTERPRETATION = AgentInterpretation()


async def _trigger(call: ProgramCall) -> Answer:
    binary = call.binary_trigger
    layouts = None
    if binary is not None:
        data, wait, by_application = binary.data, binary.wait, binary.by_application
        count: object = binary.results
        application, expected_id = binary.application, binary.expected
    else:
        layouts = call.argument("layouts", _check_layouts)
        data = call.blobs[0] if call.blobs else None
        count, wait = call.arguments.get("results"), call.required("wait", check_flag)
        by_application = bool(call.argument("by_application", check_flag))
        application, expected_id = call.arguments.get("application"), call.arguments.get("expected")
    result_count = check_integer(count, "results", 1, MAX_RESULTS_PER_TRIGGER, call.camera.name)
    if application is not None:
        application = check_application(application, "application", call.camera.name)
    if expected_id is not None:  # below 0 if the camera does not report its application
        name = call.camera.name
        expected_id = check_integer(expected_id, "expected", -1, MAX_APPLICATION_ID, name)
    if layouts is None and not by_application:
        interpretation = _RAW_INTERPRETATION.for_owner(call.owner)
    else:
        interpretation = AgentInterpretation(call.owner, layouts, by_application=by_application)
    request = TriggerRequest(interpretation, data, result_count, wait, expected_id)
    groups = await trigger_encoded(call.camera, call.owner, request, application, call.timeout)
    return {}, [encode_groups(0, call.camera.results.next_number, groups)]


async def trigger_encoded(
    camera: SharedCamera,
    owner: Owner,
    request: TriggerRequest,
    application: int | None,
    timeout: float,
) -> list[bytes]:
    """Trigger for a program, and return the groups of its results as bytes.

    The arguments are those of :meth:`AgentClient.trigger_for`; ``owner`` is the trigger's owner.
    """
    groups: list[bytes] = []
    camera.outcomes[owner] = groups
    try:
        await camera.require_client().trigger_for(request, application, timeout)
    finally:
        del camera.outcomes[owner]
    return groups


async def _switch_application(call: ProgramCall) -> Answer:
    client = call.client
    await client.switch_application(
        call.required("application", check_application_or_name), timeout=call.timeout
    )
    return {"application": client.active_application}, []


async def _ensure_application(call: ProgramCall) -> Answer:
    await call.client.ensure_application(
        call.required("application", check_application), call.timeout
    )
    return EMPTY_ANSWER


async def _enter_application(call: ProgramCall) -> Answer:
    before = await call.client.enter_application(
        call.required("application", check_application), call.timeout
    )
    call.switches[call.camera.name, call.owner.call] = (call.camera.client, before)
    return {"before": before.application, "wanted": before.wanted.application}, []


async def _leave_application(call: ProgramCall) -> Answer:
    key = call.camera.name, call.required("entered", check_integer, 0)
    switch = call.switches.pop(key, None)
    if switch is not None:
        client, before = switch
        if call.argument("wait", check_flag) is False:
            client.leave_application(before)  # the next command reports a failure
        else:
            await client.leave_application_and_wait(before)
    return EMPTY_ANSWER


async def _start(call: ProgramCall) -> Answer:
    await call.client.start(timeout=call.timeout)
    return EMPTY_ANSWER


async def _stop(call: ProgramCall) -> Answer:
    await call.client.stop(timeout=call.timeout)
    return EMPTY_ANSWER


async def _query_application(call: ProgramCall) -> Answer:
    return {"application": await call.client.query_application(timeout=call.timeout)}, []


async def _query_status(call: ProgramCall) -> Answer:
    return {"status": int(await call.client.query_status(timeout=call.timeout))}, []


async def _wait_ready(call: ProgramCall) -> Answer:
    return {"status": int(await call.client.wait_ready(timeout=call.timeout))}, []


async def _reset_errors(call: ProgramCall) -> Answer:
    return {"status": int(await call.client.reset_errors(timeout=call.timeout))}, []


async def _read_image(call: ProgramCall) -> Answer:
    return {}, [await call.client.read_image(timeout=call.timeout)]


async def _get_clock(call: ProgramCall) -> Answer:
    return {"clock": (await call.client.get_clock(timeout=call.timeout)).isoformat()}, []


async def _set_clock(call: ProgramCall) -> Answer:
    text = call.required("when", check_text)
    try:
        when = datetime.fromisoformat(text)
    except ValueError as exc:
        raise ConfigurationError(f"{call.camera.name}: {text!r:.80} is no time") from exc
    await call.client.set_clock(when)
    return EMPTY_ANSWER


async def _set_input(call: ProgramCall) -> Answer:
    await call.client.set_input(call.blobs[0] if call.blobs else b"")
    return EMPTY_ANSWER


async def _set_sequence_number(call: ProgramCall) -> Answer:
    await call.client.set_sequence_number(
        call.required("number", check_integer, 0, MAX_SEQUENCE_NUMBER)
    )
    return EMPTY_ANSWER


async def _reboot(call: ProgramCall) -> Answer:
    await call.client.reboot()
    return EMPTY_ANSWER


async def _take_back(call: ProgramCall) -> Answer:
    """Try now to take back a camera from another client, and wait for the session."""
    client = call.client
    client.try_take_back()
    await client.wait_connected(call.timeout)
    return EMPTY_ANSWER


async def _request(call: ProgramCall) -> Answer:
    answer = await call.client.request(
        call.required("message_id", check_message_id),
        call.blobs[0] if call.blobs else b"",
        answered=call.argument("answered", check_flag),
        timeout=call.timeout,
    )
    return {}, [] if answer is None else [answer]


MAX_FRAME_INTERVAL = 3600.0
"""Largest number of seconds between two frames of a stream that a program may request."""


def _frame_request(call: ProgramCall, *, stream: bool = False) -> FrameCall:
    encoding = FrameForm.checked(
        call.argument("encoding", check_text) or "raw",
        call.argument("quality", check_integer, 1, 100),
        call.camera.name,
        bitrate=call.argument("bitrate", check_integer, MIN_BITRATE, MAX_BITRATE),
        stream=stream,
    )
    min_interval = min(MAX_FRAME_INTERVAL, call.argument("min_interval", check_age) or 0.0)
    last_number = call.argument("last_number", check_integer, 0) or 0
    owner_call, timeout = call.owner.call, call.timeout
    return FrameCall(call.program, owner_call, encoding, timeout, min_interval, last_number)


async def _frame(call: ProgramCall) -> Answer:
    return await call.camera.frames.send_frame(
        _frame_request(call),
        max_age=call.argument("max_age", check_age),
        after=call.argument("after", check_clock_seconds),
        fresh=bool(call.argument("fresh", check_flag)),
    ), []


async def _next_frame(call: ProgramCall) -> Answer:
    return await call.camera.frames.send_next_frames(
        _frame_request(call, stream=True), call.required("stream", check_integer, 0)
    ), []


async def _end_stream(call: ProgramCall) -> Answer:
    call.camera.frames.end_stream(call.program, call.required("stream", check_integer, 0))
    return EMPTY_ANSWER


async def _about_frames(call: ProgramCall) -> Answer:
    return await call.camera.frames.format_fields(call.timeout), []


async def _trigger_frame(call: ProgramCall) -> Answer:
    wait = call.argument("wait", check_flag)
    return await call.camera.frames.send_triggered_frame(
        _frame_request(call), wait=wait is not False
    ), []


async def _features(call: ProgramCall) -> Answer:
    return await call.camera.frames.features(
        call.argument("name", check_text),
        call.timeout,
        names_only=bool(call.argument("names_only", check_flag)),
        value_only=bool(call.argument("value_only", check_flag)),
    ), []


async def _set_feature(call: ProgramCall) -> Answer:
    name, value = call.required("name", check_text), call.arguments.get("value")
    return await call.camera.frames.set_feature(name, value, call.timeout), []


async def _execute_feature(call: ProgramCall) -> Answer:
    await call.camera.frames.execute_feature(call.required("name", check_text), call.timeout)
    return EMPTY_ANSWER


async def _lens(call: ProgramCall) -> Answer:
    return call.camera.frames.lens_fields(call.required("lens", check_integer, 0)), []


async def _refresh_status(call: ProgramCall) -> Answer:
    return {"asked": await call.client.refresh_status(call.timeout)}, []


async def _wait_connected(call: ProgramCall) -> Answer:
    await call.client.wait_connected(call.timeout)
    return EMPTY_ANSWER


async def _reserve(call: ProgramCall) -> Answer:
    reservation = (call.program, call.owner.call)
    await call.camera.reserve(call.program, reservation, call.timeout)
    return EMPTY_ANSWER


async def _release(call: ProgramCall) -> Answer:
    call.camera.gate.release((call.program, call.required("reservation", check_integer, 0)))
    return EMPTY_ANSWER


async def _reserved(call: ProgramCall) -> Answer:
    reservation = (call.program, call.required("reservation", check_integer, 0))
    return {"reserved": await call.camera.still_holds(reservation, call.timeout)}, []


async def _hello(call: ProgramCall) -> Answer:
    camera = call.camera
    return {
        **camera.camera_fields(),
        **camera.state_fields(),
        "program": call.owner.program,
        "frames": camera.frames.make is not None,
        "results": camera.results.next_number,
        "first_result": camera.first_result,
        "states": camera.states.next_number,
    }, []


async def _find_first_result(call: ProgramCall) -> Answer:
    """Return the number of the first result since a time of the agent's clock."""
    results = call.camera.results
    since = call.required("since", check_clock_seconds)
    return {"first": results.first_since(since), "next_number": results.next_number}, []


async def _results(call: ProgramCall) -> Answer:
    part = call.camera.results.read_part(call.required("first", check_integer, 0), MAX_REPLY_BYTES)
    return {"first": part.first, "next_number": part.next_number}, [
        encode_groups(0, part.next_number, part.data)
    ]


async def _states(call: ProgramCall) -> Answer:
    part = call.camera.states.read_part(call.required("first", check_integer, 0), MAX_REPLY_BYTES)
    return {"first": part.first, "next_number": part.next_number}, part.data


ACTIONS: dict[str, Callable[[ProgramCall], Awaitable[Answer]]] = {
    "hello": _hello,
    "find_first_result": _find_first_result,
    "results": _results,
    "states": _states,
    "refresh_status": _refresh_status,
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
    "end_stream": _end_stream,
    "lens": _lens,
    "trigger_frame": _trigger_frame,
    "features": _features,
    "set_feature": _set_feature,
    "execute_feature": _execute_feature,
    "leave_application": _leave_application,
    "trigger": _trigger,
    "switch_application": _switch_application,
    "ensure_application": _ensure_application,
    "enter_application": _enter_application,
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

GATED_COMMANDS = COMMANDS - {"reserve", "release", "leave_application"}
"""Commands that wait at the gate while another program has reserved the camera."""


def agent_clock() -> float:
    """Return the time of the agent's clock, seconds: the clock of the agent's event loop."""
    return asyncio.get_running_loop().time()
