"""Whatever bytes come, in whatever pieces: a link passes on the same messages and never fails."""

from __future__ import annotations

import asyncio
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import camera_wire as wire
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.emulator import Application, Device, ManualClock, Quirks
from smartcam.emulator.faults.matching import FaultQueue
from smartcam.emulator.links import MAX_INPUT, TcpListener, _TcpLink
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import HANDBOOK

if TYPE_CHECKING:
    from smartcam.emulator.faults.wire_effects import Parcel
    from smartcam.emulator.links import Link

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


class Station:
    """Answers a Connect and writes down the rest."""

    spoken = HANDBOOK
    quirks = Quirks()
    device = Device([Application(id=1)])

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.queue = FaultQueue(HANDBOOK, self.clock)
        self.messages: list[m.Message] = []

    def step(self) -> nullcontext[None]:
        return nullcontext()

    def received(self, link: Link, message: m.Message) -> None:
        self.messages.append(message)
        if isinstance(message, m.Connect):
            link.say(m.ConnectAnswer(version=1))

    def serves(self, link: Link) -> bool:
        return True

    def parted(self, link: Link, *, by_client: bool, reset: bool) -> None:
        pass

    def lost(self, link: Link) -> None:
        pass

    def traced(self, link: Link, sender: m.Sender, what: object) -> None:
        pass

    def traced_parcel(self, link: Link, sender: m.Sender, parcel: Parcel) -> None:
        pass


def open_link() -> tuple[_TcpLink, Station]:
    station = Station()
    listener = TcpListener(station)
    listener.down = False
    link = _TcpLink(listener, station)
    link.connection_made(Transport())
    return link, station


@given(pieces=st.lists(PIECES, max_size=15), cuts=st.lists(st.integers(1, 30)))
def test_link_any_bytes_in_any_chunks_give_the_same_messages(
    pieces: list[bytes], cuts: list[int]
) -> None:
    data = wire.CONNECT + b"".join(pieces)
    whole, one = open_link()
    whole.data_received(data)
    cut, other = open_link()
    rest = data
    for size in cuts:
        if rest:
            cut.data_received(rest[:size])
        rest = rest[size:]
    if rest:
        cut.data_received(rest)
    assert one.messages == other.messages
    assert one.messages[0] == m.Connect()
    assert whole._machine.buffered == cut._machine.buffered < MAX_INPUT


def test_link_every_split_point_of_a_conversation() -> None:
    data = wire.CONNECT + wire.SET_CLOCK + b"??" + wire.SWITCH_21 + wire.QUERY
    for at in range(1, len(data)):
        link, station = open_link()
        link.data_received(data[:at])
        link.data_received(data[at:])
        kinds = [type(message) for message in station.messages]
        assert kinds == [m.Connect, m.SetClock, m.SwitchApplication, m.Query]


@pytest.mark.parametrize("times", [1, 2])
def test_link_closed_is_closed_once(times: int) -> None:
    link, station = open_link()
    for _ in range(times):
        link.close("enough")
    assert link.closed
    assert not link.write(b"?")
    link.data_received(wire.CONNECT)
    assert station.messages == []
