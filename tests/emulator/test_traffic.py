"""The emulator's log: entries are made when they are read, and their memory is bounded."""

from __future__ import annotations

import tracemalloc

import pytest

from smartcam.emulator import EmulatedCamera
from smartcam.emulator._inside import LogEntry
from smartcam.emulator._traffic import MAX_BYTES, MAX_ENTRIES, MAX_IDS, Log, TrafficLog
from smartcam.exceptions import FrameError, ResponseTimeoutError
from smartcam.protocols import Frame
from smartcam.protocols import messages as m
from smartcam.protocols._inside import HANDBOOK
from tests.emulator import camera_wire as wire
from tests.emulator.camera_wire import TcpClient
from tests.emulator.inside import MAX_INPUT_BYTES

QUERY = Frame(0x30, b"")
PEER = "127.0.0.1:5"


def make(*numbers: int, maxlen: int = 3) -> Log:
    """Return a log of answers to Query, each with another application."""
    log = Log(HANDBOOK, maxlen)
    for number in numbers:
        put(log, number)
    return log


def put(log: Log, number: int) -> None:
    frame = Frame(0x30, number.to_bytes(4, "little"))
    log.append((0.5, PEER, m.Sender.CAMERA, frame, None, None))


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


@pytest.mark.parametrize("look_after", range(11))
def test_log_is_bounded_in_bytes_and_tells_what_went(look_after: int) -> None:
    log = Log(HANDBOOK, max_bytes=20_000)
    for number in range(10):
        if number == look_after:
            assert len(list(log)) == len(log)
        log.append(
            (
                0.5,
                PEER,
                m.Sender.CAMERA,
                Frame(0x20, bytes([number, 0, 0, 0, *1000 * [1]])),
                None,
                None,
            )
        )
        assert log.size <= 20_000
    kept, count = log.since(0)
    assert [int(entry.hex[:2], 16) for entry in kept] == [6, 7, 8, 9]
    assert (len(log), log.dropped_count, count) == (4, 6, 10)
    assert count - len(kept) == 6  # missed


def test_log_keeps_the_last_entry_however_large() -> None:
    log = Log(HANDBOOK, max_bytes=1000)
    log.append((0.5, PEER, m.Sender.CLIENT, Frame(0x21, bytes(5000)), None, None))
    assert (len(log), log.dropped_count) == (1, 0)
    put(log, 1)
    assert (numbers(log), log.dropped_count) == ([1], 1)


def test_log_counts_all_that_an_entry_says() -> None:
    log = make()
    log.append(LogEntry(0.5, "in", PEER, None, None, "00 00", 1000 * "e", 100 * "f", 3000 * "w"))
    assert 4100 < log.size < 6000
    log.popleft()
    assert (log.size, log.dropped_count) == (0, 0)


@pytest.mark.parametrize("reads", [False, True])
def test_log_holds_no_more_memory_than_it_says(reads: bool) -> None:
    tracemalloc.start()
    try:
        traffic = TrafficLog(HANDBOOK)
        for number in range(500):
            frame = Frame(0x20, number.to_bytes(4, "little") + bytes(MAX_INPUT_BYTES - 4))
            traffic.add(0.0, PEER, m.Sender.CAMERA, frame)
            if reads and not number % 50:
                list(traffic.entries)
        held, _ = tracemalloc.get_traced_memory()
        entries = list(traffic.entries)
        read, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < 1.1 * MAX_BYTES
    assert read < 1.1 * MAX_BYTES
    assert len(entries) + traffic.entries.dropped_count == 500


async def test_log_of_large_frames_is_bounded_on_the_wire() -> None:
    async with EmulatedCamera() as emulator, await TcpClient.open(emulator) as client:
        large = wire.MAGIC + MAX_INPUT_BYTES.to_bytes(4, "little") + bytes([0x77, 0, 0, 0])
        for _ in range(200):
            client.send(large + bytes(MAX_INPUT_BYTES))
        await emulator.wait_received(0x77, count=200)
        log = emulator.log
        entries, count = log.since(0)
        assert log.size <= MAX_BYTES
        assert log.dropped_count == count - len(entries) > 0
        frame, reason = entries[-2:]
        assert frame.hex == bytes(MAX_INPUT_BYTES).hex(" ")
        assert reason.error is not None


def test_log_counts_what_nobody_read() -> None:
    log = make(0, 1)
    _, before = log.since(0)
    for number in range(2, 9):
        put(log, number)
    new, count = log.since(before)
    assert (before, count, len(new), log.dropped_count) == (2, 9, 3, 6)


def test_log_gives_no_more_than_asked_for() -> None:
    log = make(1, 2, 3, 4)
    assert [entry.hex[:2] for entry in log.since(0, 2)[0]] == ["02", "03"]
    assert [entry.hex[:2] for entry in log.since(3, 2)[0]] == ["04"]
    assert log.since(2**63 - 1, 1000) == ([], 4)
    assert log.since(-5, 0) == ([], 4)


def test_log_that_is_emptied_begins_anew() -> None:
    log = make(1, 2, 3, 4)
    assert log.dropped_count == 1
    log.clear()
    assert (len(log), log.size, log.dropped_count) == (0, 0, 0)
    put(log, 5)
    assert log.since(4) == (list(log), 5)


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
        traffic.count(Frame(0x31, bytes(size)))
    traffic.count(Frame(0x77, b"?"))
    await traffic.wait_received(0x31, count=4)
    await traffic.wait_received(m.SwitchApplication, count=1)
    await traffic.wait_received(0x77)
    for what, count in ((m.SwitchApplication, 2), (m.UnknownMessage, 1)):
        with pytest.raises(ResponseTimeoutError, match=f"received {count - 1} of {count}"):
            await traffic.wait_received(what, count=count, timeout=0.0)


async def test_ids_that_are_none_are_counted_within_a_bound() -> None:
    traffic = TrafficLog(HANDBOOK)
    for number in range(2 * MAX_IDS):
        traffic.add(0.0, PEER, m.Sender.CLIENT, Frame(0x1000 + number, b""))
        traffic.count(Frame(0x1000 + number, b""))
    assert len(traffic._received) <= MAX_IDS + 1
    traffic.count(QUERY)
    await traffic.wait_received(m.Query)
    await traffic.wait_received(0x30)
    assert len(traffic.entries) <= MAX_ENTRIES
