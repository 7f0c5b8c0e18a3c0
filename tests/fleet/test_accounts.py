"""Every result is counted once in each subscriber's account."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
from collections.abc import AsyncIterator
from random import Random
from typing import Any

import pytest

from smartcam.fleet import Fleet, FleetCamera
from smartcam.models import Result, SubscriberStatistics
from smartcam.streams import Subscription
from tests.fleet.fleetkit import NAME, PATIENCE, NumberedCamera, Plant, end_of, until
from tests.fleet.lossy_bus import LossyBus, as_said, chance_of

RESULTS_INTERVAL = 0.002


RATE = 500.0
"""Results in a second."""

EARLY = 3
"""Results of before that a subscriber may get: clocks of two processes are not known to agree
better than a few milliseconds."""

SETTLED = 30.0
"""Seconds after which the last result's number was told often enough."""


class Reader:
    """Reads results, and sees that what it gets is in order and comes once."""

    def __init__(self, camera: FleetCamera[Any], pause: float = 0.0) -> None:
        self.stream: Subscription[Result[Any]] = camera.results(max_queue=100_000)
        self.numbers: list[int] = []
        self.task = asyncio.create_task(self._read(pause))

    async def _read(self, pause: float) -> None:
        async for result in self.stream:
            assert result.value.run == result.number  # the emulator's own number
            if self.numbers:
                assert result.number > self.numbers[-1]
            self.numbers.append(result.number)
            if pause:
                await asyncio.sleep(pause)

    async def end(self) -> None:
        self.stream.close()
        await self.task


class Sender:
    """A plant whose camera sends by itself; ``sent`` are the results that its agent got."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant

    @property
    def sent(self) -> int:
        return self.plant.agent.shared_cameras[NAME].results.next_number - 1

    async def stop(self) -> None:
        """Have it send no more, and everybody hear of what it sent."""
        self.plant.box.device.stop()
        await asyncio.sleep(SETTLED)
        assert self.sent == self.plant.box.runs


@contextlib.asynccontextmanager
async def sending(bus: LossyBus | None = None, **options: Any) -> AsyncIterator[Sender]:
    """Give a plant whose camera will send, once it runs."""
    box = NumberedCamera(rate=RATE, running=False)
    async with Plant(box, bus=bus, **options) as plant:
        yield Sender(plant)


def check(stream: Subscription[Any], sent: int, early: int = 0) -> SubscriberStatistics:
    """See that a subscriber's account has everything that was sent since it subscribed."""
    got = stream.statistics()
    assert got.offered == got.taken + got.dropped + got.queued
    assert sent <= got.offered + got.missed <= sent + early, got
    return got


def check_no_gap(numbers: list[int]) -> None:
    assert numbers == [*range(numbers[0], numbers[0] + len(numbers))]


@pytest.mark.parametrize(
    ("seed", "seconds"),
    [(1, 1.25), pytest.param(2, 15, marks=[pytest.mark.long, pytest.mark.widest])],
)
async def test_results_over_a_bad_bus_come_all_in_order_to_each(seed: int, seconds: float) -> None:
    """Losses, doubles, delays and disorder; subscribers that come late, or are slow."""
    chance = Random(seed)  # noqa: S311
    bus = LossyBus()
    history = (100_000, 1 << 26)  # more than ever is sent while lost questions are asked again
    async with sending(bus, history=history) as sender, sender.plant.cameras(5) as cameras:
        bus.fate = chance_of(chance, lost=0.1, doubled=0.1, late=0.2, by=0.03)
        first = [Reader(cameras[0]), Reader(cameras[0], 0.0005)]
        idle = cameras[1].results(max_queue=10)
        await asyncio.sleep(5.0)  # the way to where they begin may be lost, too
        sender.plant.box.device.start()
        late: list[tuple[Reader, int]] = []
        for camera in cameras[2:]:
            await asyncio.sleep(seconds / 5)
            late.append((Reader(camera), sender.sent))
        await asyncio.sleep(2 * seconds / 5)
        bus.fate = as_said
        await sender.stop()
        sent = sender.sent
        assert sent > 0.9 * RATE * seconds
        assert min(bus.lost, bus.doubled, bus.late) > 10
        for reader in first:
            got = check(reader.stream, sent)
            assert (got.missed, got.dropped) == (0, 0)
            assert reader.numbers == [*range(1, sent + 1)]
        got = check(idle, sent)
        assert (got.queued, got.dropped, got.missed) == (10, sent - 10, 0)
        for reader, before in late:
            assert check(reader.stream, sent - before, EARLY).missed == 0
            check_no_gap(reader.numbers)
            assert reader.numbers[-1] == sent
        for reader in (*first, *(one for one, _ in late)):
            await reader.end()


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("cut", [0.05, 0.5, pytest.param(3.0, marks=pytest.mark.long)])
async def test_cut_off_for_less_than_the_history_misses_none(cut: float) -> None:
    async with sending(history=(4000, 1 << 24)) as sender, sender.plant.cameras(2) as cameras:
        readers = [Reader(camera) for camera in cameras]
        sender.plant.box.device.start()
        await asyncio.sleep(0.5)
        for _ in range(2):
            end_of(cameras[0]).detach()
            await asyncio.sleep(cut)
            assert not cameras[0].connected
            end_of(cameras[0]).attach()
            await cameras[0].wait_connected()
            await asyncio.sleep(0.5)
        await sender.stop()
        for reader in readers:
            assert check(reader.stream, sender.sent).missed == 0
            assert reader.numbers == [*range(1, sender.sent + 1)]
            await reader.end()


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("slow", [False, True])
async def test_cut_off_for_longer_knows_how_many_were_missed(slow: bool) -> None:
    async with sending(history=(150, 1 << 24)) as sender, sender.plant.cameras(2) as cameras:
        reader, other = Reader(cameras[0]), Reader(cameras[1])
        idle = cameras[0].results(max_queue=5)
        sender.plant.box.device.start()
        await asyncio.sleep(0.5)
        end_of(cameras[0]).detach()
        await asyncio.sleep(1.5)
        if slow:  # the camera has stopped: nothing new tells of the gap
            sender.plant.box.device.stop()
            await asyncio.sleep(SETTLED)
        end_of(cameras[0]).attach()
        await cameras[0].wait_connected()
        await sender.stop()
        sent = sender.sent
        got = check(reader.stream, sent)
        assert got.missed == sent - len(reader.numbers) > RATE
        # it was missed in one piece, and all that was kept has come
        gaps = [(a, b) for a, b in itertools.pairwise(reader.numbers) if b != a + 1]
        ((last, again),) = gaps
        assert again - last - 1 == got.missed
        assert check(idle, sent).missed == got.missed
        assert check(other.stream, sent).missed == 0
        for one in (reader, other):
            await one.end()


async def test_who_subscribes_after_it_was_cut_off_has_missed_nothing_of_before() -> None:
    async with sending(history=(150, 1 << 24)) as sender, sender.plant.cameras(1) as (camera,):
        first = Reader(camera)
        sender.plant.box.device.start()
        await asyncio.sleep(0.5)
        end_of(camera).detach()
        await asyncio.sleep(1.5)
        end_of(camera).attach()
        second = Reader(camera)  # before what was missed is known
        before = sender.sent
        await camera.wait_connected()
        await asyncio.sleep(0.5)
        await sender.stop()
        assert check(first.stream, sender.sent).missed > RATE
        assert check(second.stream, sender.sent - before, EARLY).missed == 0
        for one in (first, second):
            await one.end()


async def test_who_left_and_subscribes_again_begins_there() -> None:
    async with sending(history=(150, 1 << 24)) as sender, sender.plant.cameras(1) as (camera,):
        sender.plant.box.device.start()
        for _ in range(3):
            reader = Reader(camera)
            before = sender.sent
            await asyncio.sleep(0.3)
            await reader.end()
            gathered = 1 + math.ceil(RESULTS_INTERVAL * RATE)  # not said yet
            assert (
                check(reader.stream, sender.sent - before - gathered, EARLY + gathered).missed == 0
            )
            await asyncio.sleep(1.0)
        await sender.stop()


async def test_who_does_not_read_harms_nobody() -> None:
    """Neither others' accounts, nor the agent's memory, nor its own beyond its bounds."""
    history = (500, 1 << 24)
    async with sending(history=history) as sender, sender.plant.cameras(3) as cameras:
        readers = [Reader(camera) for camera in cameras[:2]]
        idle = [
            cameras[0].results(max_queue=7),
            cameras[2].results(max_queue_bytes=200),
            cameras[2].results(max_queue=7, overflow="error"),
        ]
        host = sender.plant.agent.shared_cameras[NAME]
        sender.plant.box.device.start()
        most = [0, 0]
        for _ in range(30):
            await asyncio.sleep(0.1)
            most = [
                max(most[0], host.results.next_number - host.results.first),
                max(most[1], len(host.results._entries)),
            ]
        await sender.stop()
        assert sender.sent > 0.8 * RATE * 3
        assert most[0] <= history[0] + 10
        assert most[1] <= history[0] + 10
        assert not host._unsent_groups
        for reader in readers:
            assert check(reader.stream, sender.sent).missed == 0
            assert reader.numbers == [*range(1, sender.sent + 1)]
            await reader.end()
        assert check(idle[0], sender.sent).queued == 7
        assert check(idle[1], sender.sent).queued_bytes <= 200
        assert idle[2].statistics().offered == 8  # it wanted to know, and has ended


async def test_results_of_many_come_to_a_fleet_in_the_same_way() -> None:
    """Streams of all cameras of a fleet have an account for each camera."""
    bus = LossyBus()
    async with sending(bus) as sender:
        fleet = Fleet(bus.new_connection(), None, "plant", None, 10.0, {"interpret_as": "raw"})
        async with fleet, fleet.results("line1/*") as results:
            await asyncio.sleep(0.1)
            sender.plant.box.device.start()
            await until(lambda: sender.sent > 200)
            await sender.stop()
            (account,) = results.statistics().values()
            assert account.offered == account.queued == sender.sent
            numbers = [(await anext(results)).number for _ in range(account.queued)]
            assert numbers == [*range(1, sender.sent + 1)]


async def test_session_is_seen_though_the_word_of_it_is_lost() -> None:
    bus = LossyBus()
    async with sending(bus) as sender, sender.plant.cameras(1) as (camera,):
        plant = sender.plant
        await plant.box.stop()
        await until(lambda: not camera.connected)
        bus.fate = lambda key, _: () if "/states/" in key else (0.0,)
        await plant.box.start()
        await until(lambda: plant.agent.shared_cameras[NAME].connected)
        await asyncio.sleep(0.1)  # of the loop's time: every word of the session is lost
        assert bus.lost
        bus.fate = as_said
        await camera.wait_connected(timeout=PATIENCE)


def free_memory(camera: FleetCamera[Any]) -> int:
    """Return how much a program holds back of what came too early."""
    return len(camera._receiver._results._held)


async def test_what_a_program_holds_back_is_bounded() -> None:
    """Nothing grows for ever where an agent does not answer for what is missing."""
    bus = LossyBus()
    async with sending(bus) as sender, sender.plant.cameras(1) as (camera,):
        reader = Reader(camera)
        await asyncio.sleep(0.1)
        feed = camera._receiver._results
        feed._max_held_bytes = 1000
        lost = iter([True])
        bus.fate = lambda key, _: (
            () if "/ask/" in key or ("/results/" in key and next(lost, False)) else (0.0,)
        )
        sender.plant.box.device.start()
        await asyncio.sleep(0.5)
        assert 0 < free_memory(camera) <= 1000 / 8
        bus.fate = as_said
        await asyncio.sleep(6.0)
        await sender.stop()
        assert free_memory(camera) == 0
        assert check(reader.stream, sender.sent).missed == 0
        await reader.end()
