"""One encoder for all viewers of a source."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from smartcam.exceptions import FrameFormatError, FrameSourceError, FrameTimeoutError
from smartcam.frames import Codecs
from tests.frames.drivers import GoneError, scripted
from tests.frames.inside import KEY_FRAME_INTERVAL, LINGER, MAX_FAILURES, SharedH264
from tests.frames.pictures import frame_of, stamped
from tests.handmade import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.frames import Frame, FrameSource
    from tests.frames.drivers import ScriptedDriver


def drawn(number: int) -> Frame:
    return frame_of(stamped(number), "Mono8", number)


class Viewer:
    """Keeps its frames."""

    def __init__(self) -> None:
        self.units: list[tuple[int, bool]] = []
        self.error: FrameSourceError | None = None

    def on_frame(self, unit: Frame, is_key_frame: bool) -> None:
        self.units.append((unit.sequence, is_key_frame))

    def on_stream_end(self, error: FrameSourceError) -> None:
        self.error = error


class Stream:
    """A shared stream of a scripted device."""

    def __init__(self, driver: ScriptedDriver, source: FrameSource, codecs: Codecs) -> None:
        self.driver = driver
        self.shared = SharedH264(source, codecs.h264_encoder())

    async def give(self, *numbers: int) -> None:
        """Give frames, each after the encoding of the last one."""
        await self.driver.streams()
        for number in numbers:
            before = self.shared.counts.encoded + self.shared.counts.failed
            self.driver.give(drawn(number))
            await until(
                lambda b=before: self.shared.counts.encoded + self.shared.counts.failed > b  # type: ignore[misc]
            )


@pytest.fixture
async def stream(no_leaks: None) -> AsyncIterator[Stream]:
    driver, source = scripted(stall=None)
    async with source, Codecs(threads=1) as codecs:
        made = Stream(driver, source, codecs)
        try:
            yield made
        finally:
            await made.shared.close()


async def test_twenty_viewers_are_one_encoder(stream: Stream) -> None:
    viewers = [Viewer() for _ in range(20)]
    for viewer in viewers:
        stream.shared.add_viewer(viewer)
    await stream.give(1, 2, 3)
    assert [viewer.units for viewer in viewers] == [[(1, True), (2, False), (3, False)]] * 20
    assert (stream.shared.counts.encoded, stream.shared.counts.key_frames) == (3, 1)


async def test_without_viewers_the_source_does_not_stream(stream: Stream) -> None:
    assert stream.driver.calls == ["open"]
    viewer = Viewer()
    stream.shared.add_viewer(viewer)
    await stream.give(1)
    stream.shared.remove_viewer(viewer)
    await asyncio.sleep(LINGER - 0.1)
    assert stream.driver.calls == ["open", "start"]
    await asyncio.sleep(0.2)
    await stream.driver.rests()
    stream.shared.add_viewer(viewer)
    await stream.give(2)
    assert viewer.units == [(1, True), (2, True)]


async def test_returning_viewer_joins_a_running_stream_that_encoded_nothing(
    stream: Stream,
) -> None:
    viewer = Viewer()
    stream.shared.add_viewer(viewer)
    await stream.give(1)
    stream.shared.remove_viewer(viewer)
    stream.driver.give(drawn(2))
    await asyncio.sleep(LINGER / 2)
    stream.shared.add_viewer(viewer)
    await asyncio.sleep(LINGER * 2)
    await stream.give(3)
    assert viewer.units == [(1, True), (3, True)]
    assert stream.shared.counts.encoded == 2
    assert stream.driver.calls == ["open", "start"]


async def test_key_frames_for_new_viewers_keep_the_least_interval(
    stream: Stream,
) -> None:
    first, second, third = Viewer(), Viewer(), Viewer()
    stream.shared.add_viewer(first)
    await stream.give(1, 2)
    stream.shared.add_viewer(second)
    await stream.give(3)
    stream.shared.add_viewer(third)
    stream.shared.request_key_frame()
    await stream.give(4)
    await asyncio.sleep(KEY_FRAME_INTERVAL)
    await stream.give(5, 6)
    assert [number for number, key in first.units if key] == [1, 5]
    assert second.units == [(3, False), (4, False), (5, True), (6, False)]
    assert third.units[1:] == [(5, True), (6, False)]


async def test_a_slow_encoder_skips_and_never_lags(stream: Stream) -> None:
    viewer = Viewer()
    stream.shared.add_viewer(viewer)
    await stream.driver.streams()
    for number in (1, 2, 3, 4):
        stream.driver.give(drawn(number))
        await asyncio.sleep(0)
    await until(lambda: len(viewer.units) == 2)
    assert [number for number, _ in viewer.units] == [1, 4]


async def test_description_is_made_once_before_the_first_viewer(
    stream: Stream,
) -> None:
    asking = [asyncio.create_task(stream.shared.first_key_frame(5.0)) for _ in range(3)]
    await stream.give(1)
    units = [await one for one in asking]
    assert [unit.sequence for unit in units] == [1, 1, 1]
    assert (await stream.shared.first_key_frame(0.0)).sequence == 1
    assert stream.shared.counts.encoded == 1
    await asyncio.sleep(LINGER + 0.1)
    await stream.driver.rests()


async def test_silent_source_is_reported_in_time(stream: Stream) -> None:
    before = asyncio.get_running_loop().time()
    with pytest.raises(FrameTimeoutError, match="scripted: no frame came within 5 s"):
        await stream.shared.first_key_frame(5.0)
    assert asyncio.get_running_loop().time() - before == pytest.approx(5.0, abs=0.1)


async def test_ended_source_ends_its_viewers_and_is_reopened(
    stream: Stream,
) -> None:
    viewer = Viewer()
    stream.shared.add_viewer(viewer)
    await stream.give(1)
    assert stream.driver.sink is not None
    stream.driver.sink.ended(GoneError("it was unplugged"))
    await until(lambda: viewer.error)
    assert isinstance(viewer.error, GoneError)
    assert stream.shared.viewer_count == 0
    stream.driver.fails["start"] = GoneError("it is not there")
    with pytest.raises(GoneError, match="not there"):
        await stream.shared.first_key_frame(5.0)
    del stream.driver.fails["start"]
    asking = asyncio.create_task(stream.shared.first_key_frame(5.0))
    await stream.give(2)
    assert (await asking).sequence == 2


async def test_the_end_of_a_recording_is_an_end(stream: Stream) -> None:
    viewer = Viewer()
    stream.shared.add_viewer(viewer)
    await stream.give(1)
    assert stream.driver.sink is not None
    stream.driver.sink.ended(None)
    await until(lambda: viewer.error)
    assert str(viewer.error) == "scripted: the source has ended"


async def test_one_damaged_frame_is_left_out_but_not_all(stream: Stream) -> None:
    viewer = Viewer()
    stream.shared.add_viewer(viewer)
    await stream.give(1)
    await stream.driver.streams()
    for _ in range(MAX_FAILURES - 1):
        failed = stream.shared.counts.failed
        stream.driver.give(replace(drawn(2), data=b"cut off"))
        await until(lambda f=failed: stream.shared.counts.failed > f)  # type: ignore[misc]
    await stream.give(3)
    assert viewer.units == [(1, True), (3, True)]
    for _ in range(MAX_FAILURES):
        failed = stream.shared.counts.failed
        stream.driver.give(replace(drawn(4), data=b"cut off"))
        await until(lambda f=failed: stream.shared.counts.failed > f)  # type: ignore[misc]
    await until(lambda: viewer.error)
    assert isinstance(viewer.error, FrameFormatError)


async def test_closed_source_is_reported(no_leaks: None) -> None:
    _, source = scripted()
    async with Codecs(threads=1) as codecs:
        shared = SharedH264(source, codecs.h264_encoder())
        with pytest.raises(FrameSourceError, match="is not open"):
            await shared.first_key_frame(5.0)
        await shared.close()


async def test_closing_answers_waiting_requests(stream: Stream) -> None:
    asking = asyncio.create_task(stream.shared.first_key_frame(5.0))
    await stream.driver.streams()
    await stream.shared.close()
    with pytest.raises(FrameSourceError, match="its stream was closed"):
        await asking
