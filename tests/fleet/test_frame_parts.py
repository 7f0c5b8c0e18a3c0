"""Frames in parts: within a window, complete or dropped, without delaying other programs."""

from __future__ import annotations

import asyncio
import signal
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import smartcam
from smartcam.exceptions import RemoteProtocolError
from smartcam.fleet._frames.features import feature_fields, read_feature
from smartcam.fleet._frames.sender import (
    CONFIRMATION_TIMEOUT,
    MAX_UNCOUNTED_BYTES,
    MAX_WAITING_BYTES,
    PART_BYTES,
    WINDOW_BYTES,
    FrameSender,
)
from smartcam.fleet._inside import Keys
from smartcam.frames import Feature
from tests.client.clientkit import gone
from tests.fleet.fleetkit import FLEET, PATIENCE, until
from tests.fleet.framekit import FramePlant, looking
from tests.fleet.inside import (
    MAX_FRAME_BYTES,
    Data,
    FrameCollector,
    FramePart,
    IncomingFrame,
    MemoryConnection,
    decode_part,
    encode_part,
)
from tests.fleet.inside import collector as _frame_collector
from tests.fleet.lossy_bus import LossyBus, only
from tests.fleet.partner import partner
from tests.frames.drivers import frame

LARGE = {"width": 2000, "height": 1000, "stride": 2000}


def noise(seed: int, size: int) -> bytes:
    return np.random.default_rng(seed).bytes(size)


def large(number: int) -> dict[str, Any]:
    """Return what makes a frame a large one whose bytes are all its own."""
    return {**LARGE, "data": noise(number, 2_000_000)}


# ---------------------------------------------------------------------- the sender


class Wire(MemoryConnection):
    """An end that keeps the parts that are said, by program."""

    local = False

    def __init__(self) -> None:
        self.said: dict[str, list[tuple[FramePart, bytes]]] = {}

    def put_part(self, key: str, head: bytes, data: Data) -> None:
        said = self.said.setdefault(key.rpartition("/")[2], [])
        said.append((decode_part(head), bytes(data)))

    def bytes_of(self, program: str) -> int:
        return sum(len(data) for _, data in self.said.get(program, ()))


async def test_no_more_is_under_way_than_the_window() -> None:
    wire = Wire()
    sender = FrameSender(wire, Keys(FLEET))
    data = noise(1, 3 * WINDOW_BYTES + 7)
    sender.send("one", 1, data)
    taken = 0
    while len(wire.said["one"]) > taken:
        assert (
            wire.bytes_of("one") - sum(len(d) for _, d in wire.said["one"][:taken]) <= WINDOW_BYTES
        )
        part, said = wire.said["one"][taken]
        assert (part.call, part.total) == (1, len(data))
        assert said == data[part.offset : part.offset + len(said)]
        taken += 1
        sender.confirm("one", 1, part.offset + len(said))
    assert b"".join(said for _, said in wire.said["one"]) == data
    assert not sender._windows


async def test_program_that_takes_nothing_holds_up_no_other() -> None:
    wire = Wire()
    sender = FrameSender(wire, Keys(FLEET))
    data = bytes(2 * WINDOW_BYTES)
    for call in range(200):
        sender.send("dead", call, data)
    assert wire.bytes_of("dead") <= WINDOW_BYTES
    assert sender._windows["dead"].waiting_bytes <= MAX_WAITING_BYTES + 2 * WINDOW_BYTES
    sender.send("other", 1, bytes(WINDOW_BYTES))
    assert wire.bytes_of("other") == WINDOW_BYTES
    sender.forget_program("dead")
    assert "dead" not in sender._windows


async def test_frame_that_does_not_move_is_given_up() -> None:
    wire = Wire()
    sender = FrameSender(wire, Keys(FLEET))
    sender.send("one", 1, bytes(2 * WINDOW_BYTES))
    sender.send("one", 2, bytes(PART_BYTES))
    assert {part.call for part, _ in wire.said["one"]} == {1}
    await asyncio.sleep(CONFIRMATION_TIMEOUT + 0.1)
    sender.send("one", 3, bytes(PART_BYTES))
    assert wire.said["one"][-1][0].call == 3


async def test_frame_that_is_wanted_no_more_makes_room() -> None:
    wire = Wire()
    sender = FrameSender(wire, Keys(FLEET))
    sender.send("one", 1, bytes(2 * WINDOW_BYTES))
    sender.send("one", 2, bytes(PART_BYTES))
    sender.confirm("one", 1, None)
    assert wire.said["one"][-1][0].call == 2
    sender.confirm("one", 9, 5)  # one that nobody has
    sender.confirm("two", 1, 5)
    sender.confirm("one", 2, 1 << 60)  # more than was sent
    assert not sender._windows


async def test_small_frame_is_one_part_that_nobody_counts() -> None:
    wire = Wire()
    sender = FrameSender(wire, Keys(FLEET))
    for call in range(5):
        sender.send("one", call, bytes(MAX_UNCOUNTED_BYTES))
    assert wire.bytes_of("one") == 5 * MAX_UNCOUNTED_BYTES
    assert not sender._windows


# ---------------------------------------------------------------------- the collector


class Told:
    """In the place of what tells the agent."""

    def __init__(self) -> None:
        self.program: Any = type("P", (), {"bus": type("B", (), {"local": False})})
        self.come_to: list[int | None] = []

    def confirm_bytes(self, number: int, offset: int | None) -> None:
        self.come_to.append(offset)


def incoming() -> tuple[IncomingFrame, Told]:
    told: Any = Told()
    return IncomingFrame(FrameCollector(_nobody()), told, 1), told


def _nobody() -> Any:
    return None


def parts(data: bytes, size: int) -> list[tuple[FramePart, bytes]]:
    places = range(0, max(1, len(data)), size)
    return [(FramePart(1, place, len(data)), data[place : place + size]) for place in places]


@given(
    size=st.integers(0, 300),
    each=st.integers(1, 120),
    fates=st.lists(st.sampled_from(["come", "come", "come", "lost", "twice", "swapped"])),
)
async def test_frame_comes_whole_or_not_at_all(size: int, each: int, fates: list[str]) -> None:
    data = noise(size, size)
    came = parts(data, each)
    for place, fate in enumerate(fates[: len(came)]):
        if fate == "lost":
            came[place] = (came[place][0], b"")
        elif fate == "twice":
            came.insert(place, came[place])
        elif fate == "swapped" and place:
            came[place - 1], came[place] = came[place], came[place - 1]
    one, _ = incoming()
    for part, said in came:
        if said or not data:
            one.add_part(part, said)
    assert await one.complete_data(size) in [None, data]
    if not fates or set(fates) == {"come"}:
        assert await one.complete_data(size) == data
    assert await one.complete_data(size + 1) is None


async def test_rest_that_does_not_come_is_given_up_and_told() -> None:
    data = bytes(2 * WINDOW_BYTES)
    one, told = incoming()
    one.add_part(*parts(data, PART_BYTES)[0])
    begun = asyncio.get_running_loop().time()
    assert await one.complete_data(len(data)) is None
    waited = asyncio.get_running_loop().time() - begun
    assert waited == pytest.approx(_frame_collector.PART_TIMEOUT, abs=0.1)
    one.forget()
    assert told.come_to == [PART_BYTES, None]


@pytest.mark.parametrize(
    "head", [b"", b"scf1", b"x" * 28, encode_part(FramePart(1, 0, MAX_FRAME_BYTES + 1))]
)
def test_broken_part_is_none(head: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        decode_part(head)


# ---------------------------------------------------------------------- both together


class Chance:
    """Loses a share of the parts."""

    def __init__(self, share: float) -> None:
        self._chance, self._share = np.random.default_rng(1), share

    def __call__(self, key: str, payload: bytes) -> tuple[float, ...]:
        return () if self._chance.random() < self._share else (0.0,)


async def test_lost_parts_cost_frames_that_are_counted_and_no_frame_is_mixed() -> None:
    bus = LossyBus(only("frames", Chance(0.02)), local=False)
    pictures = [large(number) for number in range(4)]
    async with looking(bus=bus) as (plant, camera):
        async with camera.frames(timeout=PATIENCE) as frames:
            given = 0
            for number in range(1, 40):
                async with asyncio.timeout(PATIENCE):
                    await plant.waits()
                plant.driver.give(frame(number, **pictures[number % 4]))
                given += 1
                await asyncio.sleep(0)
                await until(lambda: not plant.shared._pending_calls or frames.statistics().waiting)
                if frames.statistics().waiting:
                    got = await anext(frames)
                    assert bytes(got.data) == pictures[got.sequence % 4]["data"]
            bus.fate = lambda key, payload: (0.0,)
            await plant.waits()
            plant.driver.give(frame(given + 1, **pictures[0]))
            while (await anext(frames)).sequence != given + 1:
                pass
            account = frames.statistics()
            assert bus.lost > 5
            assert account.lost > 0
            assert account.offered + account.lost == given + 1
        async with asyncio.timeout(PATIENCE):
            while plant.agent._sender._windows:  # noqa: ASYNC110 - what is said goes its way
                await asyncio.sleep(0.001)


async def test_frame_on_request_is_asked_for_again_where_a_part_was_lost() -> None:
    lost: list[str] = []

    def first_one(key: str, payload: bytes) -> tuple[float, ...]:
        lost.append(key)
        return () if len(lost) == 2 else (0.0,)

    bus = LossyBus(only("frames", first_one), local=False)
    async with looking(bus=bus, source={"linger": 60.0}) as (plant, camera):
        asking = asyncio.create_task(camera.newest_frame(max_age=3600.0, timeout=30.0))
        await plant.driver.streams()
        plant.driver.give(frame(1, **large(1)))
        assert bytes((await asking).data) == large(1)["data"]
        assert bus.lost == 1


async def test_way_that_loses_all_parts_ends_with_an_error() -> None:
    bus = LossyBus(only("frames", lambda *_: ()), local=False)
    async with looking(bus=bus, source={"linger": 60.0}) as (plant, camera), plant.streaming():
        error = await gone(camera.newest_frame(timeout=10.0))
        assert isinstance(error, smartcam.FrameTimeoutError)
        assert "whole" in str(error)
        async with camera.frames(timeout=PATIENCE) as frames:
            assert "did not come here whole" in str(await gone(anext(frames)))


SIZES = [
    0,
    1,
    MAX_UNCOUNTED_BYTES,
    MAX_UNCOUNTED_BYTES + 1,
    PART_BYTES,
    WINDOW_BYTES,
    WINDOW_BYTES + 1,
    5_000_000,
]


@pytest.mark.real_time
async def test_frames_of_any_size_arrive() -> None:
    async with looking() as (plant, camera), camera.frames(timeout=PATIENCE) as frames:
        for number, size in enumerate([*SIZES, *reversed(SIZES)]):
            data = noise(size, size)
            await plant.waits()
            plant.driver.give(frame(number, width=1, height=1, stride=1, data=data))
            assert bytes((await anext(frames)).data) == data
            again = await camera.newest_frame(max_age=3600.0, timeout=PATIENCE)
            assert (bytes(again.data), again.sequence) == (data, number)


@pytest.mark.real_time
@pytest.mark.parametrize(
    "number", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.long)]
)
async def test_program_that_ends_without_a_word_stops_its_stream_and_no_other(number: int) -> None:
    async with (
        FramePlant() as plant,
        plant.camera() as camera,
        plant.streaming(**large(1)),
        partner("viewer", plant.address.url) as viewer,
    ):
        await until(lambda: len(plant.shared._streams) == 1)
        async with camera.frames(timeout=PATIENCE) as frames:
            await anext(frames)
            await until(lambda: len(plant.shared._streams) == 2)
            viewer.signal(number)
            triggered = 0
            while len(plant.shared._streams) > 1:
                await anext(frames)  # as before
                assert (await camera.trigger(timeout=PATIENCE)).value.run
                triggered += 1
                theirs = plant.agent._sender._windows.values()
                assert all(one.unconfirmed_bytes <= WINDOW_BYTES for one in theirs)
            assert triggered > 1 or number != signal.SIGSTOP  # none had to wait for its end
        await plant.driver.rests()
        viewer.signal(signal.SIGCONT)


FEATURE = Feature("Gain", "float", "rw", 1.0, 0, 24.5, None, "dB", (), ("GainSelector",), "x", "y")


def test_a_feature_crosses_whole() -> None:
    assert read_feature(feature_fields(FEATURE), "cam") == FEATURE


@pytest.mark.parametrize(
    "wrong",
    [
        {"kind": "register"}, {"access": "x"}, {"value": [1]}, {"minimum": "0"}, {"maximum": True},
        {"entries": 3}, {"selectors": None},
    ],
)  # fmt: skip
def test_what_is_no_feature_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(RemoteProtocolError):
        read_feature({**feature_fields(FEATURE), **wrong}, "cam")
    with pytest.raises(RemoteProtocolError):
        read_feature(None, "cam")
