"""The emulator's log: entries are made when somebody reads them."""

from __future__ import annotations

import pytest

from smartcam.emulator import LogEntry
from smartcam.emulator.traffic import Log, TrafficLog
from smartcam.exceptions import FrameError, ResponseTimeoutError
from smartcam.protocols import messages as m
from smartcam.protocols.bvs import HANDBOOK
from smartcam.protocols.framing import Frame

QUERY = Frame(0x30, b"")
PEER = "127.0.0.1:5"


def make(*numbers: int, maxlen: int = 3) -> Log:
    """Return a log of answers to Query, told apart by their application."""
    log = Log(HANDBOOK, maxlen)
    for number in numbers:
        put(log, number)
    return log


def put(log: Log, number: int) -> None:
    frame = Frame(0x30, number.to_bytes(4, "little"))
    log.append((0.5, PEER, m.Sender.CAMERA, frame, None))


def numbers(log: Log) -> list[int]:
    return [e.message.application for e in log if isinstance(e.message, m.QueryAnswer)]


def test_entry_says_all_of_a_frame() -> None:
    message = m.QueryAnswer(application=7)
    assert list(make(7)) == [LogEntry(0.5, "out", PEER, 0x30, message, "07 00 00 00")]


@pytest.mark.parametrize("look_after", range(7))
def test_log_keeps_the_last_whenever_it_is_read(look_after: int) -> None:
    log = make()
    for number in range(6):
        if number == look_after:
            numbers(log)
        put(log, number)
        assert len(log) == min(number + 1, 3)
    assert numbers(log) == [3, 4, 5]
    assert len(log) == 3


def test_log_shows_what_comes_after_it_was_taken() -> None:
    log = make(1)
    assert numbers(log) == [1]
    put(log, 2)
    assert numbers(log) == [1, 2]
    assert log[-1] is log[1]


def test_log_gives_entries_by_place_and_a_list_for_a_slice() -> None:
    log = make(1, 2, 3)
    assert log[0].hex == "01 00 00 00"
    assert log[1:] == list(log)[1:]
    with pytest.raises(IndexError):
        _ = log[3]
    assert repr(log) == f"Log({list(log)!r})"


def test_log_is_emptied_from_the_front_or_at_once() -> None:
    log = make(1, 2)
    assert log.popleft().hex == "01 00 00 00"
    put(log, 3)
    assert numbers(log) == [2, 3]
    put(log, 4)
    log.clear()
    assert not log
    with pytest.raises(IndexError):
        log.popleft()


def test_frames_and_what_makes_none_stay_in_order() -> None:
    traffic = TrafficLog(HANDBOOK)
    traffic.add(1.0, PEER, m.Sender.CLIENT, QUERY, "delay")
    traffic.add(2.0, PEER, m.Sender.CLIENT, FrameError("no magic", data=b"\x01\x02"))
    traffic.add(3.0, PEER, m.Sender.CLIENT, QUERY)
    assert list(traffic.entries) == [
        LogEntry(1.0, "in", PEER, 0x30, m.Query(), "", None, "delay"),
        LogEntry(2.0, "in", PEER, None, None, "01 02", "no magic"),
        LogEntry(3.0, "in", PEER, 0x30, m.Query(), ""),
    ]


async def test_frames_of_a_wrong_size_count_by_id_only() -> None:
    traffic = TrafficLog(HANDBOOK)
    for size in (0, 3, 4, 5):
        traffic.add(0.0, PEER, m.Sender.CLIENT, Frame(0x31, bytes(size)))
    traffic.add(0.0, PEER, m.Sender.CLIENT, Frame(0x77, b"?"))
    await traffic.wait_received(0x31, count=4)
    await traffic.wait_received(m.SwitchApplication, count=1)
    await traffic.wait_received(0x77)
    for what, count in ((m.SwitchApplication, 2), (m.UnknownMessage, 1)):
        with pytest.raises(ResponseTimeoutError, match=f"received {count - 1} of {count}"):
            await traffic.wait_received(what, count=count, timeout=0.0)
