"""Whatever faults are given, in whatever order: the emulator lives, leaks nothing, and recovers."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any, Literal

import camera_wire as wire
import pytest
from camera_wire import RawClient, UdpClient, until
from hypothesis import given
from hypothesis import strategies as st

from smartcam.emulator import EmulatedCamera, ManualClock, faults
from smartcam.emulator.faults.wire_effects import Parcel, mangle
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import HANDBOOK, MESSAGES, THESIS
from smartcam.protocols.framed.framing import Frame

SECONDS = st.sampled_from([0.0, 0.05, 1.0, 30.0])
CAMERA = [row.type.__name__ for row in MESSAGES if row.type.sender is m.Sender.CAMERA]
CLIENT = [row.type.__name__ for row in MESSAGES if row.type.sender is m.Sender.CLIENT]
WHEN = st.sampled_from(["before", "after"])
EXTRA: dict[str, dict[str, st.SearchStrategy[Any]]] = {
    "delay": {"seconds": SECONDS, "overtaken": st.booleans()},
    "split": {"after": st.integers(1, 20), "pause": SECONDS},
    "coalesce": {"count": st.integers(1, 3), "seconds": SECONDS},
    "truncate": {
        "keep": st.integers(0, 20),
        "then": st.sampled_from(["close", "reset", "stall", "continue"]),
    },
    "corrupt": {"offset": st.integers(-20, 20), "xor": st.integers(1, 255)},
    "duplicate": {"copies": st.integers(1, 3)},
    "insert": {
        "data": st.binary(min_size=1, max_size=20).map(bytes.hex),
        "where": st.sampled_from(["before", "after", "instead"]),
    },
    "half_open": {"when": WHEN, "seconds": st.none() | SECONDS},
    "reset": {"when": WHEN},
    "close": {"when": WHEN},
    "refuse": {"when": WHEN, "seconds": SECONDS},
    "busy_for_ever": {"when": WHEN, "seconds": st.none() | SECONDS},
    "overtrigger": {"when": WHEN, "count": st.integers(1, 3)},
    "reboot": {"when": WHEN, "seconds": st.none() | SECONDS},
    "switch_application": {"application": st.sampled_from([1, 9, 21]), "running": st.booleans()},
    "condition": {
        "condition": st.sampled_from(["system_error", "overheat"]),
        "active": st.booleans(),
    },
    "late_result": {"seconds": SECONDS},
    "extra_result": {"count": st.integers(1, 3)},
    "digital_input": {"when": WHEN},
    "byte_order": {"when": WHEN, "endian": st.sampled_from([0, 1])},
    "move_part": {"part": st.sampled_from(["square", "new"]), "x": SECONDS, "y": SECONDS},
    "remove_part": {"part": st.sampled_from(["square", "no part"])},
    "clear_faults": {"when": WHEN},
}


@st.composite
def any_fault(draw: st.DrawFn, kinds: tuple[str, ...] = tuple(faults.FAULTS)) -> dict[str, Any]:
    """Draw a fault as a mapping."""
    kind = draw(st.sampled_from(kinds))
    made = faults.FAULTS[kind]
    names: list[str | None] = [None, *CAMERA]
    if m.Sender.CLIENT in made.senders:
        names += CLIENT
    fault: dict[str, Any] = {"kind": kind, "on": draw(st.sampled_from(names))}
    if fault["on"] is not None or not made.can_act_at_once:
        fault["nth"] = draw(st.integers(1, 3))
        fault["times"] = draw(st.sampled_from([1, 2, None]))
    return fault | {name: draw(values) for name, values in EXTRA.get(kind, {}).items()}


FAULT_LISTS = st.lists(any_fault(), max_size=6)
FRAMES = [
    wire.CONNECT, wire.QUERY, wire.GET_CLOCK, wire.SWITCH_21, wire.START, wire.STOP, wire.TRIGGER,
    wire.DISCONNECT, wire.REBOOT, wire.CONNECT + wire.QUERY + wire.TRIGGER, wire.QUERY[:7],
]  # fmt: skip
STEPS = st.lists(
    st.sampled_from([*FRAMES, 0.05, 0.5, 40.0, "new client", "trigger", "clear"]), max_size=15
)


class Bench:
    """An emulator, and one client after the other."""

    def __init__(self, transport: Literal["tcp", "udp"], given: list[dict[str, Any]]) -> None:
        self.clock = ManualClock()
        self.emulator = EmulatedCamera(
            transport=transport, clock=self.clock, active=21, running=True, faults=given
        )
        self.make = RawClient if transport == "tcp" else UdpClient
        self.client: RawClient | UdpClient | None = None
        self.received = b""

    async def turn(self) -> None:
        """Let what was sent be handled."""
        for _ in range(6):
            await asyncio.sleep(0)

    def connect(self) -> None:
        """Put a new client in the place of the old one, if the port is open."""
        if self.client is not None:
            self.read()
            self.client.socket.close()
        self.client = None
        with contextlib.suppress(ConnectionRefusedError):
            self.client = self.make(self.emulator)

    def read(self) -> None:
        """Take what has come; its end too."""
        if self.client is not None:
            with contextlib.suppress(OSError):
                while data := self.client.socket.recv(1 << 16):
                    self.received += data

    async def do(self, step: bytes | float | str) -> None:
        """Do one step of a script."""
        match step:
            case bytes() if self.client is not None:
                with contextlib.suppress(OSError):
                    self.client.send(step)
            case float():
                self.clock.advance(step)
            case "new client":
                self.connect()
            case "trigger":
                self.emulator.device.trigger()
            case "clear":
                self.emulator.clear_faults()
        await self.turn()
        self.read()

    async def recover(self) -> None:
        """See that a new client is served as ever."""
        self.emulator.clear_faults()
        assert self.emulator.faults == []
        self.clock.advance(100)
        opening = self.emulator._port._opening
        if opening is not None:
            await until(opening.done)
        self.connect()
        client = self.client
        assert client is not None
        client.send(wire.CONNECT)
        await client.expect(wire.CONNECTED)
        got = await asyncio.get_running_loop().sock_recv(client.socket, 20)
        assert got.startswith(wire.NO_BIT[:12])
        self.emulator.device.stop()
        self.emulator.device.switch_application(1)
        self.clock.advance(1)
        await self.turn()
        self.read()
        client.send(wire.QUERY)
        await client.expect(wire.ACTIVE_1)


async def run(
    transport: Literal["tcp", "udp"],
    first: list[dict[str, Any]],
    second: list[dict[str, Any]],
    steps: list[Any],
) -> bytes:
    """Run a script with faults; return what its clients received."""
    broken: list[dict[str, Any]] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: broken.append(context))
    bench = Bench(transport, first)
    async with bench.emulator:
        bench.connect()
        await bench.do(wire.CONNECT)
        for number, step in enumerate(steps):
            if number == 5:
                bench.emulator.inject(*second)
            await bench.do(step)
        received = bench.received
        await bench.recover()
        assert bench.client is not None
    bench.client.socket.close()
    await asyncio.sleep(0)
    assert broken == []
    assert bench.emulator.links == []
    assert [timer for _, _, timer in bench.clock._timers if timer.callback is not None] == []
    assert asyncio.all_tasks() == {asyncio.current_task()}
    return received


@pytest.mark.parametrize("transport", ["tcp", "udp"])
@given(first=FAULT_LISTS, second=FAULT_LISTS, steps=STEPS)
async def test_any_faults_leave_an_emulator_that_recovers(
    transport: Literal["tcp", "udp"],
    first: list[dict[str, Any]],
    second: list[dict[str, Any]],
    steps: list[Any],
) -> None:
    await run(transport, first, second, steps)


WIRE_KINDS = tuple(
    kind for kind, made in faults.FAULTS.items() if issubclass(made, faults.WireFault)
)


@given(
    rows=st.lists(any_fault(WIRE_KINDS), max_size=6),
    payload=st.binary(max_size=20),
    thesis=st.booleans(),
)
def test_any_wire_faults_keep_the_account_of_a_message(
    rows: list[dict[str, Any]], payload: bytes, thesis: bool
) -> None:
    dialect = THESIS if thesis else HANDBOOK
    given_faults = faults.make_faults(rows)
    data = dialect.encode_frame(Frame(0x20, payload))
    parcels = mangle(Parcel.of(Frame(0x20, payload), data), given_faults, dialect)
    assert parcels
    for parcel in parcels:
        assert len(parcel.pauses) == max(0, len(parcel.parts) - 1)
        assert all(parcel.parts)
        assert parcel.changeable <= bool(parcel.parts)
    changing = {"drop", "truncate", "corrupt", "insert", "half_open", "reset", "close"}
    if not changing & {fault.kind for fault in given_faults}:
        assert all(b"".join(parcel.parts) == data for parcel in parcels)
