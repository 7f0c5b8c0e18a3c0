"""What programs may call at an agent: each call's name, whether it is a command, what it does."""

from __future__ import annotations

import asyncio
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._client.triggering import TriggerRequest
from smartcam.exceptions import ConfigurationError
from smartcam.fleet._frame_stream import FrameOrder
from smartcam.fleet._frame_wire import FrameForm
from smartcam.fleet._keys import COMMANDS
from smartcam.fleet._shared import Carrier, Owner
from smartcam.fleet._wire import TriggerOrder, encode_runs

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.fleet._host import Host

Answer = tuple[dict[str, Any], list[bytes]]
NOTHING: Answer = ({}, [])
MOST_FILLED = 1 << 20
"""Bytes of results, or states, that one reply brings."""


class ProgramCall(NamedTuple):
    """A call under way.

    Attributes:
        host: the camera that it is for.
        program: who calls.
        owner: the same as numbers.
        arguments: what is said, by name.
        blobs: byte strings that came with it.
        timeout: seconds that it may take.
        entered: applications to go back to of this program's temporary switches, by their call.
        order: a trigger that came in numbers; in place of arguments.
    """

    host: Host
    program: str
    owner: Owner
    arguments: dict[str, Any]
    blobs: list[bytes]
    timeout: float
    entered: dict[tuple[str, int], Any]
    order: TriggerOrder | None = None

    def argument(self, name: str, *kinds: type) -> Any:
        """Return an argument; None where it is not said.

        Raises:
            ConfigurationError: it is of another kind.
        """
        value = self.arguments.get(name)
        good = isinstance(value, kinds) and (not isinstance(value, bool) or bool in kinds)
        if value is None or good:
            return value
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise ConfigurationError(f"{self.host.name}: {name} is {value!r:.80}, no {wanted}")

    def wanted(self, name: str, *kinds: type) -> Any:
        """Return an argument that has to be there."""
        value = self.argument(name, *kinds)
        if value is None:
            raise ConfigurationError(f"{self.host.name}: {name} is missing")
        return value


_PLAIN = Carrier()


async def _trigger(call: ProgramCall) -> Answer:
    order = call.order
    layouts = None
    if order is not None:
        data, wanted, wait, each = order.data, order.results, order.wait, order.by_application
        application, expected = order.application, order.expected
    else:
        layouts = call.argument("layouts", str, dict)
        if isinstance(layouts, dict):
            layouts = {int(key): text for key, text in layouts.items()}
        data = call.blobs[0] if call.blobs else None
        wanted, wait = call.wanted("results", int), call.wanted("wait", bool)
        each = bool(call.argument("by_application", bool))
        application, expected = call.argument("application", int), call.argument("expected", int)
    if layouts is None and not each:
        carrier = _PLAIN.of(call.owner)
    else:
        carrier = Carrier(call.owner, layouts, by_application=each)
    request = TriggerRequest(carrier, data, wanted, wait, expected)
    runs = await outcomes(call.host, call.owner, request, application, call.timeout)
    return {}, [encode_runs(0, call.host.results.following, runs)]


async def outcomes(
    host: Host,
    owner: Owner,
    request: TriggerRequest,
    application: int | None,
    timeout: float,
) -> list[bytes]:
    """Trigger for somebody, and return the runs that came of it.

    The arguments are those of :meth:`SharedCamera.trigger_for`; ``owner`` is whose trigger it is.
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
    await camera.switch_application(call.wanted("application", int, str), timeout=call.timeout)
    return {"application": camera.active_application}, []


async def _ensure(call: ProgramCall) -> Answer:
    await call.host.require().ensure(call.wanted("application", int), call.timeout)
    return NOTHING


async def _enter(call: ProgramCall) -> Answer:
    before = await call.host.require().enter(call.wanted("application", int), call.timeout)
    call.entered[call.host.name, call.owner.call] = (call.host.camera, before)
    return {"before": before.application, "wanted": before.wanted.application}, []


async def _leave(call: ProgramCall) -> Answer:
    found = call.entered.pop((call.host.name, call.wanted("entered", int)), None)
    if found is not None:
        camera, before = found
        if call.argument("wait", bool) is False:
            camera.leave(before)  # a failure is told by the next command
        else:
            await camera.leave_and_wait(before)
    return NOTHING


async def _start(call: ProgramCall) -> Answer:
    await call.host.require().start(timeout=call.timeout)
    return NOTHING


async def _stop(call: ProgramCall) -> Answer:
    await call.host.require().stop(timeout=call.timeout)
    return NOTHING


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
    text = call.wanted("when", str)
    try:
        when = datetime.fromisoformat(text)
    except ValueError as exc:
        raise ConfigurationError(f"{call.host.name}: {text!r:.80} is no time") from exc
    await call.host.require().set_clock(when)
    return NOTHING


async def _set_input(call: ProgramCall) -> Answer:
    await call.host.require().set_input(call.blobs[0] if call.blobs else b"")
    return NOTHING


async def _set_sequence_number(call: ProgramCall) -> Answer:
    await call.host.require().set_sequence_number(call.wanted("number", int))
    return NOTHING


async def _reboot(call: ProgramCall) -> Answer:
    await call.host.require().reboot()
    return NOTHING


async def _request(call: ProgramCall) -> Answer:
    answer = await call.host.require().request(
        call.wanted("message_id", int, str),
        call.blobs[0] if call.blobs else b"",
        answered=call.argument("answered", bool),
        timeout=call.timeout,
    )
    return {}, [] if answer is None else [answer]


MOST_REST = 3600.0
"""Seconds from one frame of a stream to the next that one may ask for."""


def _frame_order(call: ProgramCall, *, stream: bool = False) -> FrameOrder:
    encoding = FrameForm.checked(
        call.argument("encoding", str) or "raw",
        call.argument("quality", int),
        call.host.name,
        bitrate=call.argument("bitrate", int),
        stream=stream,
    )
    rest = min(MOST_REST, max(0.0, call.argument("rest", int, float) or 0.0))
    have = call.argument("have", int) or 0
    return FrameOrder(call.program, call.owner.call, encoding, call.timeout, rest, have)


async def _frame(call: ProgramCall) -> Answer:
    return await call.host.frames.one(
        _frame_order(call),
        max_age=call.argument("max_age", int, float),
        after=call.argument("after", int, float),
        fresh=bool(call.argument("fresh", bool)),
    ), []


async def _next_frame(call: ProgramCall) -> Answer:
    return await call.host.frames.next(
        _frame_order(call, stream=True), call.wanted("stream", int)
    ), []


async def _leave_frames(call: ProgramCall) -> Answer:
    call.host.frames.leave(call.program, call.wanted("stream", int))
    return NOTHING


async def _about_frames(call: ProgramCall) -> Answer:
    return await call.host.frames.about(call.timeout), []


async def _lens(call: ProgramCall) -> Answer:
    return call.host.frames.lens(call.wanted("lens", int)), []


async def _refresh(call: ProgramCall) -> Answer:
    return {"asked": await call.host.require().refresh(call.timeout)}, []


async def _wait_connected(call: ProgramCall) -> Answer:
    await call.host.require().wait_connected(call.timeout)
    return NOTHING


async def _reserve(call: ProgramCall) -> Answer:
    reservation = (call.program, call.owner.call)
    await call.host.reserve(call.program, reservation, call.timeout)
    return NOTHING


async def _release(call: ProgramCall) -> Answer:
    call.host.gate.release((call.program, call.wanted("reservation", int)))
    return NOTHING


async def _hello(call: ProgramCall) -> Answer:
    host = call.host
    return {
        **host.about(),
        **host.state(),
        "program": call.owner.program,
        "frames": host.frames.make is not None,
        "results": host.results.following,
        "began": host.began,
        "states": host.states.following,
    }, []


async def _find(call: ProgramCall) -> Answer:
    """Say which result came first since a time of the agent's clock."""
    results = call.host.results
    since = float(call.wanted("since", int, float))
    return {"first": results.first_since(since), "following": results.following}, []


async def _results(call: ProgramCall) -> Answer:
    part = call.host.results.part(call.wanted("first", int), MOST_FILLED)
    return {"first": part.first, "following": part.following}, [
        encode_runs(0, part.following, part.data)
    ]


async def _states(call: ProgramCall) -> Answer:
    part = call.host.states.part(call.wanted("first", int), MOST_FILLED)
    return {"first": part.first, "following": part.following}, part.data


ACTIONS: dict[str, Callable[[ProgramCall], Awaitable[Answer]]] = {
    "hello": _hello,
    "find": _find,
    "results": _results,
    "states": _states,
    "refresh": _refresh,
    "reserve": _reserve,
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
    "request": _request,
}
"""What each call does."""

PASSES_GATE = COMMANDS - {"reserve", "release", "leave"}
"""Commands that wait while another program has the camera reserved."""


def now() -> float:
    """Return the agent's clock, its loop's, seconds; only differences mean anything."""
    return asyncio.get_running_loop().time()
