"""What is under test in the fault matrix: every command, its bound, and what it may end with."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

from matrix_world import AWAY, HOME, PATIENT, READING, Bench, bench, come_true

from smartcam import exceptions as e
from smartcam.models import Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from matrix_world import BenchBase, Bounds, Heard, World

__all__ = ["OPS", "TRIGGER_OUTCOMES", "Op", "ends_of", "ops_of", "scout"]

TOKEN = (4711).to_bytes(4, "little")

Errors = tuple[type[e.SmartCamError], ...]

TRIGGER_OUTCOMES: Errors = (
    e.OvertriggeredError,
    e.NotRunningError,
    e.CameraBusyError,
    e.CameraFaultError,
    e.InputContainerError,
    e.TriggerTimeoutError,
    e.WrongApplicationError,
    e.InterpretationError,
    e.CommandRejectedError,
    e.UnsupportedError,
    e.ConnectionLostError,
    e.ConnectionTakenError,
    e.ConnectionClosedError,
)
"""What a trigger may end with beside a result; the list is closed."""

LINK: Errors = (e.ConnectionLostError, e.ConnectionTakenError, e.ConnectionClosedError)
REQUEST: Errors = (e.ResponseTimeoutError, *LINK)
CLOCK: Errors = (e.InterpretationError, *REQUEST)
SWITCH: Errors = (e.CommandRejectedError, *REQUEST)
HALFWAY: Errors = (e.NotRunningError, e.WrongApplicationError)
REFUSED: Errors = (e.CommandRejectedError, e.UnsupportedError)
"""What any answer may say in a dialect with result codes."""


@dataclass(frozen=True)
class Op:
    """A command.

    Attributes:
        run: it; what it gives is looked at on the way.
        bound: seconds that it may take, of the client's bounds.
        ends: errors that it may ever end with.
        before: what brings the camera there.
        opened: whether the client is open at first.
        home: the application it begins in.
        triggers: whether results matter to it, so that it is done with and without numbers.
        stops: the camera may be stopped afterwards because it was told so.
        closes: the client is closed afterwards.
        mends: errors that a user mends who was told that this command failed.
        needs: messages that a dialect must have for it.
    """

    run: Callable[[BenchBase], Awaitable[object]]
    bound: Callable[[Bounds], float]
    ends: Errors
    before: Callable[[BenchBase], Awaitable[object]] | None = None
    opened: bool = True
    home: int = HOME
    triggers: bool = False
    stops: bool = False
    closes: bool = False
    mends: Errors = ()
    needs: tuple[type[m.Message], ...] = ()


async def _switch(bench: BenchBase) -> None:
    await bench.camera.switch_application(AWAY)
    really = bench.really_active()
    bench.demand_value(really == AWAY, f"switched to {AWAY}, {really} is active")


async def _set_clock(bench: BenchBase) -> None:
    await bench.camera.set_clock(datetime(2024, 5, 6, 7, 8, 9))  # noqa: DTZ001 - it has no zone
    await bench.ask_clock()


async def _start(bench: BenchBase) -> None:
    await bench.camera.start(timeout=bench.bounds.switch)


async def _stop(bench: BenchBase) -> None:
    await bench.camera.stop(timeout=bench.bounds.switch)


async def _stopped(bench: BenchBase) -> None:
    bench.stop_camera()


async def _failing(bench: BenchBase) -> None:
    """Have a trigger dropped, which its camera shows until it is told not to."""
    assert isinstance(bench, Bench)
    device = bench.box.device
    assert [device.trigger(), device.trigger()] == [True, False]
    await come_true(lambda: not device.processing)


async def _reset_errors(bench: BenchBase) -> None:
    assert isinstance(bench, Bench)
    told = await bench.camera.reset_errors()
    for status in (told, bench.box.device.status):
        bench.demand_value(Status.OVERTRIGGERED not in status, f"not reset: {status}")


async def _ask_status(bench: BenchBase) -> None:
    assert isinstance(bench, Bench)
    bits, device = bench.world.spoken.status_bits, bench.box.device
    right = [device.status]
    told = await bench.camera.query_status()
    right.append(device.status)
    words = [bits.read(bits.write(status)) for status in right]
    bench.demand_value(told in words, f"status {told}, {words} is right")


async def _visit(bench: BenchBase) -> None:
    async with bench.camera.application(AWAY):
        await bench.trigger()


OPS: dict[str, Op] = {
    "open": Op(
        lambda b: b.camera.open(),
        lambda t: t.connect + 2 * t.switch + t.close,
        (e.ConnectFailedError, *SWITCH),
        opened=False,
    ),
    "open stopped": Op(
        lambda b: b.camera.open(),
        lambda t: t.connect + 2 * t.switch + t.close,
        (e.ConnectFailedError, *SWITCH),
        before=_stopped,
        opened=False,
        needs=(m.Start,),
    ),
    "trigger": Op(lambda b: b.trigger(), lambda t: t.trigger, TRIGGER_OUTCOMES, triggers=True),
    "input": Op(
        lambda b: b.trigger(input=TOKEN),
        lambda t: t.trigger,
        TRIGGER_OUTCOMES,
        home=READING,
        triggers=True,
    ),
    "elsewhere": Op(
        lambda b: b.trigger(AWAY),
        lambda t: 2 * t.switch + t.trigger,
        TRIGGER_OUTCOMES,
        triggers=True,
        mends=HALFWAY,
    ),
    "visit": Op(
        _visit,
        lambda t: 2 * t.switch + t.trigger,
        (*TRIGGER_OUTCOMES, e.ResponseTimeoutError),
        triggers=True,
        mends=HALFWAY,
    ),
    "switch": Op(_switch, lambda t: t.switch, SWITCH, mends=HALFWAY),
    "query": Op(lambda b: b.ask_application(), lambda t: t.request, REQUEST),
    "clock": Op(lambda b: b.ask_clock(), lambda t: t.request, CLOCK),
    "set clock": Op(_set_clock, lambda t: 2 * t.request, CLOCK),
    "start": Op(_start, lambda t: t.switch, REQUEST, before=_stop, mends=HALFWAY, needs=(m.Start,)),
    "stop": Op(_stop, lambda t: t.switch, REQUEST, stops=True, needs=(m.Stop,)),
    "reboot": Op(
        lambda b: b.camera.reboot(),
        lambda t: t.request + t.close,
        REQUEST,
        needs=(m.Reboot,),
    ),
    "status": Op(_ask_status, lambda t: t.request, REQUEST, needs=(m.GetStatus,)),
    "reset errors": Op(
        _reset_errors,
        lambda t: t.request,
        REQUEST,
        before=_failing,
        needs=(m.ResetErrors,),
    ),
    "set input": Op(
        lambda b: b.camera.set_input(TOKEN),
        lambda t: t.request,
        REQUEST,
        home=READING,
        needs=(m.SetInputAnswer,),
    ),
    "close": Op(lambda b: b.close(), lambda t: t.switch + t.close, (), closes=True),
}


def ops_of(world: World) -> dict[str, Op]:
    """Return the commands that a dialect has."""
    spoken = world.spoken
    return {name: op for name, op in OPS.items() if all(spoken.has(one) for one in op.needs)}


def ends_of(name: str, world: World) -> Errors:
    """Return the errors that a command may ever end with in a dialect."""
    ends = OPS[name].ends
    return (*ends, *REFUSED) if ends and world.spoken.capabilities.result_codes else ends


async def scout(world: World, name: str) -> list[Heard]:
    """Return the frames of an undisturbed command, in the order in which the client sees them."""
    op = OPS[name]
    async with bench(world, PATIENT, op.home) as one:
        begin = await prepare(one, op)
        async with asyncio.timeout(10):
            await op.run(one)
        asked = len(one.ear.frames)
        heard = one.ear.frames
        if not op.closes and name != "reboot":
            await one.camera.query_application()  # so that what came last was heard
            assert (heard[asked].message, heard[-1].message) == ("Query", "QueryAnswer")
            heard = [*heard[:asked], *heard[asked + 1 : -1]]
        assert one.wrong == [], one.wrong
        frames = heard[begin:]
    return [one for one in frames if name != "reboot" or one.message == "Reboot"]


async def prepare(one: BenchBase, op: Op) -> int:
    """Bring client and camera to where the command begins; return how many frames went by."""
    if op.opened:
        await one.camera.open()
    if op.before is not None:
        await op.before(one)
    if op.opened:
        await one.camera.query_application()  # nothing is under way in either direction
    return len(one.ear.frames)
