"""Parcels on their way, on a clock moved by hand: no socket."""

from __future__ import annotations

from typing import Any

import pytest

from smartcam.emulator import ManualClock, faults
from smartcam.emulator.faults.delay_line import Conveyor, Piece
from smartcam.emulator.faults.wire_effects import Cutter, Ending, Parcel, cut_datagram, mangle
from smartcam.protocols.bvs import HANDBOOK, THESIS
from smartcam.protocols.framed.framing import Frame


class Belt:
    """A conveyor that writes down what happens: writes as text, ends and losses in brackets."""

    def __init__(self, *, ordered: bool = True) -> None:
        self.clock = ManualClock()
        self.seen: list[str] = []
        self.close_at: str | None = None
        self.conveyor = Conveyor(
            self.clock,
            ordered=ordered,
            wake=lambda: self.conveyor.run(),
            carry=self.carry,
            end=lambda ending: self.seen.append(f"[{ending.how}]"),
            lost=lambda parcel: self.seen.append(f"[lost {parcel.original.decode()}]"),
        )

    def carry(self, batch: list[Piece]) -> None:
        text = b"".join(piece.data for piece in batch).decode()
        self.seen.append(text)
        if text == self.close_at:
            self.conveyor.close()

    def put(self, text: str, **changes: Any) -> None:
        parcel = Parcel.of(text.encode(), text.encode())
        for name, value in changes.items():
            setattr(parcel, name, value)
        self.conveyor.put([parcel])

    def at(self, seconds: float) -> list[str]:
        """Return what has happened by ``seconds``, and forget it."""
        self.conveyor.run()
        self.clock.advance(seconds - self.clock.now)
        seen, self.seen = self.seen, []
        return seen


def test_ordered_what_is_ready_goes_in_one_write() -> None:
    belt = Belt()
    belt.put("a")
    belt.put("b")
    assert belt.at(0) == ["ab"]
    assert belt.conveyor.idle
    assert belt.conveyor.size == 0


def test_unordered_each_goes_for_itself() -> None:
    belt = Belt(ordered=False)
    belt.put("a", delay=1)
    belt.put("b")
    belt.put("c", delay=1)
    assert belt.at(0) == ["b"]
    assert belt.at(1) == ["a", "c"]


def test_delay_holds_what_is_behind() -> None:
    belt = Belt()
    belt.put("a", delay=1.5)
    belt.put("b", delay=1)
    belt.put("c", delay=2)
    assert belt.conveyor.size == 3
    assert belt.at(1.499) == []
    assert belt.at(1.5) == ["ab"]
    assert belt.at(2) == ["c"]


def test_overtaken_goes_behind_what_waits_when_it_is_time() -> None:
    belt = Belt()
    belt.put("a", delay=1, overtaken=True)
    belt.put("b", delay=2)
    belt.put("c")
    assert belt.at(1.9) == []
    assert belt.at(2) == ["bca"]


def test_parts_are_writes_of_their_own_with_pauses_between() -> None:
    belt = Belt()
    belt.put("abc", parts=[b"a", b"b", b"c"], pauses=[0.0, 1.0])
    belt.put("d")
    assert belt.at(0) == ["a", "b"]
    assert belt.at(1) == ["cd"]


@pytest.mark.parametrize("ordered", [True, False])
def test_gather_waits_for_messages(ordered: bool) -> None:
    belt = Belt(ordered=ordered)
    belt.put("a", gather=(2, 5.0))
    belt.put("b")
    assert belt.at(4.9) == []
    belt.put("c")
    assert belt.at(4.9) == ["abc"]
    assert belt.conveyor.idle


@pytest.mark.parametrize("ordered", [True, False])
def test_gather_waits_no_longer_than_its_time(ordered: bool) -> None:
    belt = Belt(ordered=ordered)
    belt.put("a", gather=(2, 5.0))
    belt.put("b")
    assert belt.at(5) == ["ab"]
    belt.put("c")
    assert belt.at(5) == ["c"]


def test_gather_with_parts_keeps_its_pause() -> None:
    belt = Belt()
    belt.put("ab", gather=(1, 5.0), parts=[b"a", b"b"], pauses=[2.0])
    assert belt.at(5) == ["a"]
    belt.put("c")
    assert belt.at(6.9) == []
    assert belt.at(7) == ["bc"]


def test_gather_unordered_with_a_delayed_one_between() -> None:
    belt = Belt(ordered=False)
    belt.put("a", gather=(2, 5.0))
    belt.put("b", delay=1)
    belt.put("c", end=Ending("stall", "truncate"))
    assert belt.at(0) == ["ac", "[stall]"]
    assert belt.at(1) == ["b"]


def test_end_comes_behind_its_bytes_and_before_the_next() -> None:
    belt = Belt()
    belt.put("a")
    belt.put("b", end=Ending("close", "close"))
    belt.put("c")
    assert belt.at(0) == ["ab", "[close]", "c"]


def test_gather_unordered_with_parts_is_one_datagram() -> None:
    belt = Belt(ordered=False)
    belt.put("ab", gather=(1, 5.0), parts=[b"a", b"b"], pauses=[2.0])
    belt.put("c")
    assert belt.at(0) == ["abc"]


def test_close_behind_the_last_part_is_not_told_of_it() -> None:
    belt = Belt()
    belt.close_at = "a"
    belt.put("a")
    assert belt.at(0) == ["a"]


@pytest.mark.parametrize("ordered", [True, False])
def test_close_tells_what_is_lost_and_cancels_the_timer(ordered: bool) -> None:
    belt = Belt(ordered=ordered)
    belt.put("a", delay=1)
    belt.put("b", delay=1, overtaken=True)
    belt.conveyor.run()
    belt.conveyor.close()
    belt.conveyor.close()
    assert [timer for _, _, timer in belt.clock._timers if timer.callback is not None] == []
    assert belt.at(2) == ["[lost a]", "[lost b]"]
    assert belt.conveyor.idle
    assert belt.conveyor.size == 0


@pytest.mark.parametrize("ordered", [True, False])
def test_close_while_it_runs_lets_nothing_more_pass(ordered: bool) -> None:
    belt = Belt(ordered=ordered)
    belt.close_at = "a"
    belt.put("ab", parts=[b"a", b"b"], pauses=[0.0])
    belt.put("c")
    belt.put("d", gather=(1, 0.0))
    assert belt.at(1) == ["a", "[lost ab]", "[lost c]", "[lost d]"]


def test_delay_that_is_no_whole_nanosecond_comes_once() -> None:
    belt = Belt()
    belt.clock.advance(0.1)
    belt.put("a", delay=0.2)
    assert belt.at(0.3) == ["a"]


# ---------------------------------------------------------------------- cutting


def test_mangle_leaves_no_pause_behind_what_is_cut_off() -> None:
    given: list[faults.Fault] = [
        faults.Split(after=2, pause=1),
        faults.Split(after=4, pause=2),
        faults.Truncate(keep=3, then="continue"),
    ]
    (parcel,) = mangle(Parcel.of(b"abcdef", b"abcdef"), given, HANDBOOK)
    assert (parcel.parts, parcel.pauses) == ([b"ab", b"c"], [1.0])


@pytest.mark.parametrize("dialect", [HANDBOOK, THESIS], ids=["handbook", "thesis"])
def test_cutter_gives_back_every_byte(dialect: Any) -> None:
    frame = dialect.encode_frame(Frame(0x31, b"\x15\0\0\0"))
    data = b"??" + frame + frame + b"PSV!" + frame + frame[:5]
    for at in range(len(data)):
        cutter = Cutter(dialect, 100)
        parcels = cutter.cut(data[:at]) + cutter.cut(data[at:])
        assert b"".join(one.original for one in parcels) + cutter.pending == data
        assert [one.what for one in parcels if isinstance(one.what, Frame)] == [
            Frame(0x31, b"\x15\0\0\0")
        ] * 3


def test_cutter_refuses_a_length_as_the_machine_does() -> None:
    parcels = Cutter(HANDBOOK, 10).cut(bytes.fromhex("50535642 0b000000 30000000"))
    assert [type(one.what) for one in parcels] == [bytes]


@pytest.mark.parametrize("data", [b"", b"?", bytes.fromhex("50535642 00000000 30000000") * 2])
def test_datagram_that_is_not_one_frame_stays_whole(data: bytes) -> None:
    parcel = cut_datagram(data, HANDBOOK)
    assert (parcel.what, parcel.original, parcel.parts) == (data, data, [data])
