"""Faults that the soak does to a camera: one table, each with its share of the chance."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import Callable, Coroutine, Sequence
from random import Random
from typing import Any, Literal, Protocol

from smartcam.emulator import EmulatedCamera
from smartcam.emulator import faults as f
from smartcam.models import Status
from smartcam.testing import proxy as rules
from smartcam.testing.proxy import LinkProxy

CAMERA_MESSAGES = ("StatusReport", "ResultContainer", "QueryAnswer", "SwitchAnswer", "ClockAnswer")
CLIENT_MESSAGES = ("Trigger", "SetSequenceNumber", "Query", "Stop", "Start", "SwitchApplication")
CONNECT_FRAME = struct.Struct("<4sII").pack(bytes.fromhex("50535642"), 0, 1)  # handbook


class Victim(Protocol):
    """A camera as the faults see it."""

    proxy: LinkProxy
    sets_number: bool

    @property
    def emulator(self) -> EmulatedCamera: ...

    def later(self, seconds: float, action: Callable[[], None]) -> None:
        """Do something then, unless the soak is over."""
        ...

    def spawn(self, what: str, job: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a coroutine function beside."""
        ...

    def external_trigger(self) -> None:
        """Trigger by the digital input, where the soak can tell whose the run is."""
        ...


# ---------------------------------------------------------------------- the link


def _reset(victim: Victim, chance: Random) -> None:
    victim.proxy.reset()


def _cut(victim: Victim, chance: Random) -> None:
    victim.proxy.cut()


def _stall(victim: Victim, chance: Random) -> None:
    victim.proxy.stall(chance.choice([None, "up", "down"]))
    victim.later(chance.choice([0.05, 0.3, 2.0]), victim.proxy.resume)


def _refuse(victim: Victim, chance: Random) -> None:
    victim.proxy.refuse()
    victim.proxy.reset()
    victim.later(chance.uniform(0.05, 0.5), lambda: victim.proxy.refuse(False))


def _bad_link(victim: Victim, chance: Random) -> None:
    """The next links are slow, cut into pieces, or break in the middle of a frame."""
    chosen: Sequence[rules.Rule] = chance.choice(
        [
            [rules.DelayBytes(seconds=0.002, jitter=0.01, seed=chance.randrange(1000))],
            [rules.SplitBytes(at=at) for at in sorted(chance.sample(range(1, 400), 20))],
            [rules.Drip(count=200)],
            [rules.CoalesceBytes(at=chance.randrange(60, 200), size=100, seconds=0.05)],
            [rules.Rate(bytes_per_second=20_000)],
            [rules.ResetConnection(at=chance.randrange(24, 600))],
            [rules.Cut(at=chance.randrange(24, 600))],
            [rules.Stall(at=chance.randrange(60, 600), both=True)],
        ]
    )
    victim.proxy.rules[:] = chosen
    victim.proxy.reset()
    victim.later(chance.uniform(0.2, 1.0), lambda: _good_link(victim))


def _good_link(victim: Victim) -> None:
    victim.proxy.rules.clear()
    victim.proxy.resume()


def _bad_datagrams(victim: Victim, chance: Random) -> None:
    way: Literal["up", "down"] = chance.choice(("up", "down"))
    seed, share = chance.randrange(1000), chance.uniform(0.02, 0.3)
    picked: dict[str, Any] = {"direction": way, "probability": share, "seed": seed}
    chosen: rules.Rule = chance.choice(
        [
            rules.DropDatagrams(**picked),
            rules.DuplicateDatagrams(**picked),
            rules.DelayDatagrams(**picked, seconds=0.005, jitter=0.02),
            rules.Reorder(**picked, seconds=0.02),
        ]
    )
    victim.proxy.rules[:] = [chosen]
    victim.proxy.cut()
    victim.later(chance.uniform(0.2, 1.0), lambda: _good_datagrams(victim))


def _good_datagrams(victim: Victim) -> None:
    victim.proxy.rules.clear()
    victim.proxy.cut()  # its clients are made anew, without rules


# ---------------------------------------------------------------------- the camera's wire


def _delay(victim: Victim, chance: Random) -> None:
    on = chance.choice(CAMERA_MESSAGES)
    victim.emulator.inject(f.Delay(on=on, seconds=chance.uniform(0.001, 0.1)))


def _split(victim: Victim, chance: Random) -> None:
    on, pause = chance.choice(CAMERA_MESSAGES), chance.choice([0.0, 0.005])
    victim.emulator.inject(f.Split(on=on, after=chance.randrange(1, 24), pause=pause, times=3))


def _coalesce(victim: Victim, chance: Random) -> None:
    victim.emulator.inject(f.Coalesce(on=chance.choice(CAMERA_MESSAGES), count=2, seconds=0.02))


def _corrupt(victim: Victim, chance: Random) -> None:
    """The magic number is broken: nothing behind it may be believed."""
    # A number without its trigger would be the next run's, whoever begins it; and a trigger without
    # its number has none to be known by.
    alone = CLIENT_MESSAGES[:1] * victim.sets_number + CLIENT_MESSAGES[2:]
    on = chance.choice(CAMERA_MESSAGES + alone)
    victim.emulator.inject(
        f.Corrupt(on=on, offset=chance.randrange(4), xor=chance.randrange(1, 256))
    )


def _truncate(victim: Victim, chance: Random) -> None:
    endings: tuple[Literal["close", "reset", "stall"], ...] = ("close", "reset", "stall")
    then = chance.choice(endings)
    keep = chance.randrange(12)
    victim.emulator.inject(f.Truncate(on=chance.choice(CAMERA_MESSAGES), keep=keep, then=then))


def _hang_up(victim: Victim, chance: Random) -> None:
    on = chance.choice(CAMERA_MESSAGES + CLIENT_MESSAGES)
    endings: tuple[f.Fault, ...] = (
        f.Reset(on=on),
        f.Reset(on=on, when="after"),
        f.Close(on=on),
        f.Close(on=on, when="after"),
    )
    victim.emulator.inject(chance.choice(endings))


def _half_open(victim: Victim, chance: Random) -> None:
    victim.emulator.inject(f.HalfOpen(seconds=chance.uniform(0.2, 2.0)))


def _drop(victim: Victim, chance: Random) -> None:
    victim.emulator.inject(f.Drop(on=chance.choice(CAMERA_MESSAGES + CLIENT_MESSAGES)))


def _duplicate(victim: Victim, chance: Random) -> None:
    victim.emulator.inject(f.Duplicate(on=chance.choice(CAMERA_MESSAGES + CLIENT_MESSAGES)))


# ---------------------------------------------------------------------- the camera


def _reboot(victim: Victim, chance: Random) -> None:
    victim.emulator.inject(f.PowerCycle(seconds=chance.uniform(0.1, 0.5)))


def _operator(victim: Victim, chance: Random) -> None:
    application = chance.choice([1, 2, 3])
    choices: tuple[f.Fault, ...] = (
        f.OperatorStop(),
        f.OperatorStart(),
        f.OperatorSwitch(application=application, running=True),
        f.OperatorSwitch(application=application),
    )
    victim.emulator.inject(chance.choice(choices))


def _stranger(victim: Victim, chance: Random) -> None:
    victim.emulator.inject(f.SecondClient())


def _rival(victim: Victim, chance: Random) -> None:
    """A second client on a real socket, for a moment; it speaks one frame and reads."""
    emulator, stays = victim.emulator, chance.uniform(0.0, 0.1)
    if emulator.dialect != "handbook":
        return

    async def visit() -> None:
        with contextlib.suppress(OSError, TimeoutError):
            async with asyncio.timeout(2 + stays):
                reader, writer = await asyncio.open_connection(emulator.host, emulator.port)
                try:
                    writer.write(CONNECT_FRAME)
                    await reader.read(16)
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(stays):
                            while await reader.read(4096):
                                pass
                finally:
                    writer.transport.abort()

    victim.spawn("rival", visit)


def _system_error(victim: Victim, chance: Random) -> None:
    victim.emulator.inject(f.Condition(condition="system_error"))
    victim.later(chance.uniform(0.02, 0.3), lambda: _mend(victim))


def _mend(victim: Victim) -> None:
    victim.emulator.device.set_condition(Status.SYSTEM_ERROR, False)


def _busy(victim: Victim, chance: Random) -> None:
    victim.emulator.inject(f.BusyForEver(seconds=chance.uniform(0.02, 0.5)))


def _odd_run(victim: Victim, chance: Random) -> None:
    late = f.LateResult(seconds=chance.uniform(0.01, 0.3))
    choices: tuple[f.Fault, ...] = (late, f.NoResult(), f.ExtraResult(), f.Overtrigger())
    victim.emulator.inject(chance.choice(choices))


def _external(victim: Victim, chance: Random) -> None:
    for _ in range(10):
        victim.later(chance.uniform(0, 0.2), victim.external_trigger)


Fault = tuple[str, float, "Callable[[Victim, Random], None]"]

_CAMERA_FAULTS: tuple[Fault, ...] = (
    ("reboot", 1, _reboot),
    ("operator", 3, _operator),
    ("system error", 1, _system_error),
    ("busy", 2, _busy),
    ("odd run", 4, _odd_run),
    ("external", 2, _external),
    ("delay", 3, _delay),
    ("stranger", 0.5, _stranger),
)
TCP_FAULTS: tuple[Fault, ...] = (
    *_CAMERA_FAULTS,
    ("reset", 1, _reset),
    ("cut", 1, _cut),
    ("stall", 1, _stall),
    ("refuse", 0.5, _refuse),
    ("bad link", 2, _bad_link),
    ("split", 2, _split),
    ("coalesce", 1, _coalesce),
    ("corrupt", 1, _corrupt),
    ("truncate", 1, _truncate),
    ("hang up", 1, _hang_up),
    ("half open", 0.5, _half_open),
    ("rival", 0.5, _rival),
)
"""Name, share, and what is done, over TCP."""

UDP_FAULTS: tuple[Fault, ...] = (
    *_CAMERA_FAULTS,
    ("drop", 3, _drop),
    ("duplicate", 3, _duplicate),
    ("bad datagrams", 3, _bad_datagrams),
    ("hang up", 0.5, _hang_up),
    ("stall", 1, _stall),
)


def heal(victim: Victim) -> None:
    """End every fault."""
    victim.emulator.clear_faults()
    victim.proxy.rules.clear()
    victim.proxy.refuse(False)
    victim.proxy.resume()
    _mend(victim)
