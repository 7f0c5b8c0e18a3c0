"""Whatever comes in whatever order: devices, links and the emulator keep their promises."""

from __future__ import annotations

import asyncio
import contextlib
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.emulator import Application, EmulatedCamera, ManualClock, Quirks, faults
from smartcam.emulator._inside import Device
from smartcam.models import Status
from smartcam.protocols import Frame, Machine, Role
from smartcam.protocols import Transport as CarriedBy
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK
from tests.emulator import camera_wire as wire
from tests.emulator.builtins import BUILTIN_APPLICATIONS
from tests.emulator.camera_wire import RawClient, UdpClient
from tests.emulator.inside import (
    MAX_INPUT_BYTES,
    FaultQueue,
    TcpListener,
    WireFault,
    WireMessage,
    _TcpLink,
    apply_faults,
)
from tests.handmade import until
from tests.machines import MESSAGES, THESIS

if TYPE_CHECKING:
    from smartcam.emulator._inside import ClientLink, Clock
    from tests.emulator.inside import Trace

ECHO = Application(
    id=4, layout="s: string[2], b: bool", input="s: string[2], b: bool", generator="input"
)
UINT32 = st.integers(0, 0xFFFFFFFF)
RECEIVED = st.one_of(
    st.sampled_from(
        [
            m.Connect(),
            m.Disconnect(),
            m.Query(),
            m.GetClock(),
            m.Trigger(),
            m.Start(),
            m.Stop(),
            m.Reboot(),
            m.UnknownMessage(message_id=0x99, payload=b"?"),
        ]
    ),
    st.builds(
        m.SwitchApplication, application=st.sampled_from([0, 1, 3, 4, 7, 9, 21, 22, 0xFFFFFFFF])
    ),
    st.builds(m.SetInput, data=st.binary(max_size=4)),
    st.builds(m.SetSequenceNumber, number=UINT32),
    st.builds(
        m.SetClock,
        year=UINT32 | st.integers(1970, 9999),
        month=st.integers(0, 13),
        day=st.integers(0, 32),
        hour=st.integers(0, 24),
        minute=st.integers(0, 60),
        second=st.integers(0, 60),
    ),
)
STEPS = st.lists(
    st.one_of(
        RECEIVED,
        st.floats(0, 2.0),
        st.sampled_from(["trigger", "start", "stop", "reboot", "hot", "error", "big", "switch"]),
    ),
    max_size=40,
)


def operate(device: Device, action: str) -> None:
    actions: dict[str, Any] = {
        "trigger": device.trigger,
        "start": device.start,
        "stop": device.stop,
        "reboot": device.reboot,
        "hot": lambda: device.set_condition(Status.OVERHEAT, not device.status & Status.OVERHEAT),
        "error": lambda: device.set_condition(
            Status.SYSTEM_ERROR, not device.status & Status.SYSTEM_ERROR
        ),
        "big": lambda: device.set_endian(1 - device.endian),
        "switch": lambda: device.switch_application(9, running=True),
    }
    actions[action]()


def drive(device: Device, steps: list[Any]) -> None:
    last: m.StatusReport | None = None
    for step in steps:
        session = device.connected
        match step:
            case str():
                operate(device, step)
            case float():
                device.tick(step)
            case _:
                device.handle(step)
        output = device.take_output()
        if output:
            assert session or isinstance(output[0], m.ConnectAnswer)
        for message in output:
            match message:
                case m.ConnectAnswer():
                    last = None
                case m.StatusReport():
                    assert message != last
                    last = message
                    both = Status.BUSY | Status.WAITING_FOR_TRIGGER
                    assert message.status & both != both
        due = device.next_event_in()
        assert due is None or due >= 0
        if device.connected:
            assert last is not None
            assert (last.status, last.endian) == (device.status, device.endian)


@given(steps=STEPS, reboot_time=st.floats(0, 3), depth=st.integers(1, 3))
def test_device_any_messages_and_ticks_keep_the_promises(
    steps: list[Any], reboot_time: float, depth: int
) -> None:
    quirks = Quirks(reboot_time=reboot_time, input_queue_depth=depth)
    device = Device([*BUILTIN_APPLICATIONS, ECHO], active=4, quirks=quirks)
    device.handle(m.Connect())
    device.take_output()
    drive(device, [m.Connect(), *steps])


@given(
    steps=STEPS,
    quirks=st.builds(
        Quirks,
        switch_while_running=st.sampled_from(["refuse", "ignore", "allow"]),
        switch_answer=st.sampled_from(["after_status", "before_status"]),
        waiting_before_result=st.booleans(),
        busy_while_processing=st.booleans(),
        overtriggered_time=st.sampled_from([0.0, 0.5]),
    ),
)
def test_device_with_any_quirks_keeps_the_promises(steps: list[Any], quirks: Quirks) -> None:
    drive(Device([*BUILTIN_APPLICATIONS, ECHO], quirks=quirks), steps)


@given(cuts=st.lists(st.floats(0, 0.3), max_size=30))
def test_device_ticks_cut_anyhow_give_the_same(cuts: list[float]) -> None:
    one, other = (Device(BUILTIN_APPLICATIONS, active=9, running=True) for _ in range(2))
    for device in (one, other):
        device.handle(m.Connect())
        device.take_output()
    for cut in cuts:
        one.tick(cut)
    other.tick(one.time)
    assert other.time == one.time
    assert other.take_output() == one.take_output()


# ----------------------------------------------------------------------
# Whatever bytes come, in whatever pieces: a link passes on the same messages and never fails.


PIECES = st.one_of(
    st.sampled_from(
        [
            wire.CONNECT,
            wire.QUERY,
            wire.DISCONNECT,
            wire.SWITCH_21,
            wire.SET_CLOCK,
            wire.MAGIC,
            wire.MAGIC[:3],
            wire.thesis(wire.QUERY),
            bytes.fromhex("50535642 FFFFFFFF 30000000"),
            bytes.fromhex("50535642 03000000 34000000 010203"),
        ]
    ),
    st.binary(max_size=20),
)


class Transport(asyncio.Transport):
    """Takes everything and remembers that it was ended."""

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        return ("127.0.0.1", 1) if name == "peername" else self

    def setsockopt(self, *args: object) -> None:
        raise OSError("the client is gone")

    def get_write_buffer_size(self) -> int:
        return 0

    def write(self, data: Any) -> None:
        pass

    def abort(self) -> None:
        pass


class Owner:
    """Answers a Connect and writes down the rest."""

    codec = HANDBOOK
    max_links = 32
    write_limit = 1 << 20

    def __init__(self) -> None:
        self.clock: Clock = ManualClock()
        self.queue = FaultQueue(HANDBOOK, self.clock)
        self.messages: list[m.Message] = []

    def step(self) -> nullcontext[None]:
        return nullcontext()

    def make_machine(self, transport: CarriedBy, trace: Trace) -> Machine:
        return Machine(HANDBOOK, Role.CAMERA, transport, max_length=MAX_INPUT_BYTES, trace=trace)

    def connection_begun(self, link: ClientLink) -> None:
        pass

    def handle_message(self, link: ClientLink, message: m.Message) -> None:
        self.messages.append(message)
        if isinstance(message, m.Connect):
            link.send(m.ConnectAnswer(version=1))

    def serves(self, link: ClientLink) -> bool:
        return True

    def connection_ended(self, link: ClientLink, *, by_client: bool, reset: bool) -> None:
        pass

    def forget_link(self, link: ClientLink) -> None:
        pass

    def note_frame(self, link: ClientLink, sender: m.Sender, what: object) -> None:
        pass

    def note_message(self, link: ClientLink, sender: m.Sender, message: WireMessage) -> None:
        pass


class OpenHouse(TcpListener):
    """Has room for every client, and no event loop."""

    def enter(self, link: _TcpLink) -> str:
        return ""

    def leave(self, link: _TcpLink) -> None:
        pass


def open_link() -> tuple[_TcpLink, Owner]:
    owner = Owner()
    listener = OpenHouse(owner)
    listener.is_down = False
    link = _TcpLink(listener, owner)
    link.connection_made(Transport())
    return link, owner


def deliver(link: _TcpLink, data: bytes) -> None:
    """Write bytes into a link's buffer, as a transport does."""
    while data:
        room = link.get_buffer(-1)
        count = min(len(room), len(data))
        room[:count], data = data[:count], data[count:]
        link.buffer_updated(count)


@given(pieces=st.lists(PIECES, max_size=15), cuts=st.lists(st.integers(1, 30)))
def test_link_any_bytes_in_any_chunks_give_the_same_messages(
    pieces: list[bytes], cuts: list[int]
) -> None:
    data = wire.CONNECT + b"".join(pieces)
    whole, one = open_link()
    deliver(whole, data)
    cut, other = open_link()
    rest = data
    for size in cuts:
        if rest:
            deliver(cut, rest[:size])
        rest = rest[size:]
    if rest:
        deliver(cut, rest)
    assert one.messages == other.messages
    assert one.messages[0] == m.Connect()
    assert whole.machine.buffered == cut.machine.buffered < MAX_INPUT_BYTES


def test_link_every_split_point_of_a_conversation() -> None:
    data = wire.CONNECT + wire.SET_CLOCK + b"??" + wire.SWITCH_21 + wire.QUERY
    for at in range(1, len(data)):
        link, owner = open_link()
        deliver(link, data[:at])
        deliver(link, data[at:])
        kinds = [type(message) for message in owner.messages]
        assert kinds == [m.Connect, m.SetClock, m.SwitchApplication, m.Query]


@pytest.mark.parametrize("times", [1, 2])
def test_link_closed_is_closed_once(times: int) -> None:
    link, owner = open_link()
    for _ in range(times):
        link.close("enough")
    assert link.closed
    assert not link.write(b"?")
    deliver(link, wire.CONNECT)
    assert owner.messages == []


# ----------------------------------------------------------------------
# Whatever faults are given, in whatever order: the emulator lives, leaks nothing, and recovers.


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
FAULT_STEPS = st.lists(
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
        """Handle the sent bytes."""
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
@given(first=FAULT_LISTS, second=FAULT_LISTS, steps=FAULT_STEPS)
async def test_any_faults_leave_an_emulator_that_recovers(
    transport: Literal["tcp", "udp"],
    first: list[dict[str, Any]],
    second: list[dict[str, Any]],
    steps: list[Any],
) -> None:
    await run(transport, first, second, steps)


WIRE_KINDS = tuple(kind for kind, made in faults.FAULTS.items() if issubclass(made, WireFault))


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
    messages = apply_faults(WireMessage.of(Frame(0x20, payload), data), given_faults, dialect)
    assert messages
    for message in messages:
        assert len(message.pauses) == max(0, len(message.parts) - 1)
        assert all(message.parts)
        assert message.changeable <= bool(message.parts)
    changing = {"drop", "truncate", "corrupt", "insert", "half_open", "reset", "close"}
    if not changing & {fault.kind for fault in given_faults}:
        assert all(b"".join(message.parts) == data for message in messages)
