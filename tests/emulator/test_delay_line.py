"""Transmissions on their way, on a clock moved by hand: no socket."""

from __future__ import annotations

from typing import Any

import pytest

from smartcam.emulator import ManualClock, faults
from smartcam.emulator._inside import DelayLine, Ending, Transmission
from smartcam.protocols import Frame
from smartcam.protocols._inside import HANDBOOK, Framer
from tests.emulator.inside import WireMessage, apply_faults, parse, parse_one
from tests.machines import THESIS


class Line:
    """A delay line that writes down what happens: writes as text, ends and losses in brackets."""

    def __init__(self, *, ordered: bool = True) -> None:
        self.clock = ManualClock()
        self.seen: list[str] = []
        self.close_at: str | None = None
        self.delayed = DelayLine[Transmission](
            self.clock,
            keeps_order=ordered,
            wake=lambda: self.delayed.run(),
            carry=self.carry,
            end=lambda ending: self.seen.append(f"[{ending.how}]"),
            on_dropped=lambda sent: self.seen.append(f"[lost {sent.effects[0]}]"),
        )

    def carry(self, batch: list[tuple[Transmission, bytes]]) -> None:
        text = b"".join(data for _, data in batch).decode()
        self.seen.append(text)
        if text == self.close_at:
            self.delayed.close()

    def put(self, text: str, **changes: Any) -> None:
        parts = changes.pop("parts", [text.encode()])
        self.delayed.put([Transmission(parts, effects=[text], **changes)])

    def at(self, seconds: float) -> list[str]:
        """Return the events until ``seconds``, and forget them."""
        self.delayed.run()
        self.clock.advance(seconds - self.clock.now)
        seen, self.seen = self.seen, []
        return seen


def test_ordered_what_is_ready_goes_in_one_write() -> None:
    line = Line()
    line.put("a")
    line.put("b")
    assert line.at(0) == ["ab"]
    assert not line.delayed
    assert line.delayed.size == 0


def test_unordered_each_goes_for_itself() -> None:
    line = Line(ordered=False)
    line.put("a", delay=1)
    line.put("b")
    line.put("c", delay=1)
    assert line.at(0) == ["b"]
    assert line.at(1) == ["a", "c"]


def test_delay_holds_what_is_behind() -> None:
    line = Line()
    line.put("a", delay=1.5)
    line.put("b", delay=1)
    line.put("c", delay=2)
    assert line.delayed.size == 3
    assert line.at(1.499) == []
    assert line.at(1.5) == ["ab"]
    assert line.at(2) == ["c"]


def test_overtaken_goes_after_what_waits_when_it_is_time() -> None:
    line = Line()
    line.put("a", delay=1, overtaken=True)
    line.put("b", delay=2)
    line.put("c")
    assert line.at(1.9) == []
    assert line.at(2) == ["bca"]


def test_parts_are_writes_of_their_own_with_pauses_between() -> None:
    line = Line()
    line.put("abc", parts=[b"a", b"b", b"c"], pauses=[0.0, 1.0])
    line.put("d")
    assert line.at(0) == ["a", "b"]
    assert line.at(1) == ["cd"]


@pytest.mark.parametrize("ordered", [True, False])
def test_gather_waits_for_messages(ordered: bool) -> None:
    line = Line(ordered=ordered)
    line.put("a", gather=(2, 5.0))
    line.put("b")
    assert line.at(4.9) == []
    line.put("c")
    assert line.at(4.9) == ["abc"]
    assert not line.delayed


@pytest.mark.parametrize("ordered", [True, False])
def test_gather_waits_no_longer_than_its_time(ordered: bool) -> None:
    line = Line(ordered=ordered)
    line.put("a", gather=(2, 5.0))
    line.put("b")
    assert line.at(5) == ["ab"]
    line.put("c")
    assert line.at(5) == ["c"]


def test_gather_with_parts_keeps_its_pause() -> None:
    line = Line()
    line.put("ab", gather=(1, 5.0), parts=[b"a", b"b"], pauses=[2.0])
    assert line.at(5) == ["a"]
    line.put("c")
    assert line.at(6.9) == []
    assert line.at(7) == ["bc"]


def test_gather_unordered_with_a_delayed_one_between() -> None:
    line = Line(ordered=False)
    line.put("a", gather=(2, 5.0))
    line.put("b", delay=1)
    line.put("c", end=Ending("stall", "truncate"))
    assert line.at(0) == ["ac", "[stall]"]
    assert line.at(1) == ["b"]


def test_end_comes_after_its_bytes_and_before_the_next() -> None:
    line = Line()
    line.put("a")
    line.put("b", end=Ending("close", "close"))
    line.put("c")
    assert line.at(0) == ["ab", "[close]", "c"]


def test_gather_unordered_with_parts_is_one_datagram() -> None:
    line = Line(ordered=False)
    line.put("ab", gather=(1, 5.0), parts=[b"a", b"b"], pauses=[2.0])
    line.put("c")
    assert line.at(0) == ["abc"]


def test_close_after_the_last_part_is_not_told_of_it() -> None:
    line = Line()
    line.close_at = "a"
    line.put("a")
    assert line.at(0) == ["a"]


@pytest.mark.parametrize("ordered", [True, False])
def test_close_tells_what_is_lost_and_cancels_the_timer(ordered: bool) -> None:
    line = Line(ordered=ordered)
    line.put("a", delay=1)
    line.put("b", delay=1, overtaken=True)
    line.delayed.run()
    line.delayed.close()
    line.delayed.close()
    assert [timer for _, _, timer in line.clock._timers if timer.callback is not None] == []
    assert line.at(2) == ["[lost a]", "[lost b]"]
    assert not line.delayed
    assert line.delayed.size == 0


@pytest.mark.parametrize("ordered", [True, False])
def test_close_while_it_runs_lets_nothing_more_pass(ordered: bool) -> None:
    line = Line(ordered=ordered)
    line.close_at = "a"
    line.put("ab", parts=[b"a", b"b"], pauses=[0.0])
    line.put("c")
    line.put("d", gather=(1, 0.0))
    assert line.at(1) == ["a", "[lost ab]", "[lost c]", "[lost d]"]


def test_delay_that_is_no_whole_nanosecond_comes_once() -> None:
    line = Line()
    line.clock.advance(0.1)
    line.put("a", delay=0.2)
    assert line.at(0.3) == ["a"]


# ---------------------------------------------------------------------- cutting


def test_faults_leaves_no_pause_after_what_is_cut_off() -> None:
    given: list[faults.Fault] = [
        faults.Split(after=2, pause=1),
        faults.Split(after=4, pause=2),
        faults.Truncate(keep=3, then="continue"),
    ]
    (message,) = apply_faults(WireMessage.of(b"abcdef", b"abcdef"), given, HANDBOOK)
    assert (message.parts, message.pauses) == ([b"ab", b"c"], [1.0])


@pytest.mark.parametrize("dialect", [HANDBOOK, THESIS], ids=["handbook", "thesis"])
def test_cutting_gives_back_every_byte(dialect: Any) -> None:
    frame = dialect.encode_frame(Frame(0x31, b"\x15\0\0\0"))
    data = b"??" + frame + frame + b"PSV!" + frame + frame[:5]
    for at in range(len(data)):
        framer = Framer(dialect.header, 100)
        messages = parse(data[:at], framer, dialect) + parse(data[at:], framer, dialect)
        assert b"".join(one.original for one in messages) + framer.unfinished_bytes == data
        assert [one.content for one in messages if isinstance(one.content, Frame)] == [
            Frame(0x31, b"\x15\0\0\0")
        ] * 3


def test_cutting_refuses_a_length_as_the_machine_does() -> None:
    data = bytes.fromhex("50535642 0b000000 30000000")
    messages = parse(data, Framer(HANDBOOK.header, 10), HANDBOOK)
    assert [type(one.content) for one in messages] == [bytes]


@pytest.mark.parametrize("data", [b"", b"?", bytes.fromhex("50535642 00000000 30000000") * 2])
def test_datagram_that_is_not_one_frame_stays_whole(data: bytes) -> None:
    message = parse_one(data, HANDBOOK)
    assert (message.content, message.original, message.parts) == (data, data, [data])
