"""Replay a recording's pictures as a source of frames, with their times and gaps."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final

from smartcam.exceptions import (
    ConfigurationError,
    FrameFormatError,
    FrameSourceError,
    RecordingError,
)
from smartcam.frames import Frame, StreamFormat
from smartcam.frames._inside import TaskDriver
from smartcam.recording._mcap.form import GAP, RecordedError, RecordedPicture
from smartcam.recording._reader import each_item, frame_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.frames import FrameAddress, FrameSink

_log = logging.getLogger(__name__)

MAX_DELAY: Final = 0.5
"""Largest delay of a picture, seconds, that later pictures catch up; longer delays shift them."""

MAX_LOOKAHEAD: Final = 100
"""Number of items after the first picture that are searched for pictures of other cameras."""

STOP_TIMEOUT: Final = 5.0
"""Seconds to wait for the disk to read a picture after the replay has stopped."""

MAX_SPEED: Final = 1000.0

_PARAMETERS: Final = ("camera", "name", "pace", "speed")


class RecordedDriver(TaskDriver):
    """Replays the pictures of a recording: ``run.mcap``, or a folder of consecutive recordings.

    Parameters follow after ``#``: ``run.mcap#camera=left&pace=none``.

    ========== ====================================================================================
    ``camera`` name of the camera in the recording; needed if several cameras have pictures
    ``pace``   ``real`` (default): with the recorded times between pictures; or ``none``: each
               picture as soon as the readers have taken the last one, without skips
    ``speed``  factor by which to replay faster than recorded, 0.001 to 1000; default 1
    ``name``   name of the source; default: the name of the camera
    ========== ====================================================================================

    A frame has the recorded bytes, number, ``utc``, ``device_time``, ``moment`` and ``duration``;
    ``lost`` counts frames right before it that were lost or not recorded. Only ``captured`` is a
    time of the replay, on ``time.monotonic()``, with the recorded intervals. If a recording is
    silent for longer than a source allows, open the source with ``stall=None``.
    """

    sets_captured: ClassVar[bool] = True

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        path, fragment = address.path, address.fragment
        match = re.fullmatch(r"(.*?)#(\w+=[^#]*)", path, re.DOTALL)
        if match is not None and "://" not in address.url:
            path, fragment = match[1], match[2]
        self._path = Path(path)
        parameters = address.parameters(_PARAMETERS, fragment)
        self._camera = parameters.get("camera")
        self._given_name = parameters.get("name")
        pace = parameters.get("pace", "real")
        if pace not in ("real", "none"):
            raise address.wrong("pace", "real or none", pace)
        self._keeps_pace = pace == "real"
        self._speed = address.number(
            "speed", parameters.get("speed", "1"), 1 / MAX_SPEED, MAX_SPEED
        )
        self._reading: asyncio.Future[RecordedPicture | None] | None = None

    @property
    def name(self) -> str:
        """The name in the URL, or the camera's name; without both, before opening, the path."""
        return self._given_name or self._camera or str(self._path)

    async def open(self) -> StreamFormat:
        """Find the first picture.

        Raises:
            FrameFormatError: the recording has no pictures, or pictures of several cameras.
            FrameSourceError: the path does not exist, or is no recording of smartcam.
        """
        first = await asyncio.to_thread(self._find_first)
        self._camera = first.camera
        frame = first.frame
        return StreamFormat(frame.format, frame.width, frame.height)

    def _find_first(self) -> RecordedPicture:
        first: RecordedPicture | None = None
        items_from_first = 0
        cameras: dict[str, None] = {}
        try:
            for item in each_item(self._path, lambda _: None):
                if isinstance(item, RecordedPicture):
                    cameras[item.camera] = None
                    if first is None and self._camera in (None, item.camera):
                        first = item
                items_from_first += first is not None
                if first is not None and (
                    self._camera is not None or items_from_first > MAX_LOOKAHEAD
                ):
                    break
        except (ConfigurationError, RecordingError) as exc:
            raise FrameSourceError(str(exc), source=self.name) from exc
        if self._camera is None and len(cameras) > 1:
            raise self._several_cameras_error(cameras)
        if first is None:
            cameras_text = f"; it has pictures of {', '.join(cameras)}" if cameras else ""
            whose = f" of camera {self._camera!r}" if self._camera is not None else ""
            raise FrameFormatError(
                f"{self._path}: it has no picture{whose}{cameras_text}", source=self.name
            )
        return first

    def _several_cameras_error(self, cameras: dict[str, None]) -> FrameFormatError:
        return FrameFormatError(
            f"{self._path}: it has pictures of {', '.join(cameras)}: choose a camera, such as "
            f"{self._path}#camera={next(iter(cameras))}",
            source=self.name,
            available=tuple(cameras),
        )

    async def stop(self) -> None:
        """Stop the replay."""
        await super().stop()
        reading, self._reading = self._reading, None
        if reading is not None:
            await asyncio.wait([reading], timeout=STOP_TIMEOUT)

    # ------------------------------------------------------------------ playing

    def _pictures(self) -> Iterator[RecordedPicture]:
        """Yield the camera's pictures; pictures of a gap count as left out."""
        gap = 0
        for item in each_item(self._path, lambda text: _log.warning("%s", text)):
            if item.camera != self._camera:
                continue
            if isinstance(item, RecordedError) and item.error == GAP:
                gap += item.records or 0
            elif isinstance(item, RecordedPicture):
                yield item._replace(left_out=item.left_out + gap)
                gap = 0

    async def _read_next(self, pictures: Iterator[RecordedPicture]) -> RecordedPicture | None:
        """Return the next picture, read in a thread; None at the end."""
        reading = asyncio.get_running_loop().run_in_executor(None, next, pictures, None)
        self._reading = reading
        reading.add_done_callback(_retrieve_exception)
        return await asyncio.shield(reading)

    async def deliver(self, sink: FrameSink) -> None:
        """Replay the recording from its beginning."""
        pictures = self._pictures()
        loop = asyncio.get_running_loop()
        last: Frame | None = None
        due = loop.time()
        try:
            while (picture := await self._read_next(pictures)) is not None:
                frame = frame_of(picture)
                if self._keeps_pace:
                    due += 0.0 if last is None else _seconds_between(last, frame) / self._speed
                    due = max(due, loop.time() - MAX_DELAY)
                    await asyncio.sleep(due - loop.time())
                now = time.monotonic()
                captured = min(now, due) if self._keeps_pace else now
                sink.frame(dataclasses.replace(frame, captured=captured, source=self.name))
                if not self._keeps_pace:
                    await sink.wait_taken()
                last = frame
        except (ConfigurationError, RecordingError) as exc:
            sink.ended(FrameSourceError(str(exc), source=self.name))
        except Exception as exc:  # noqa: BLE001 - readers get every error
            error = FrameSourceError(f"{self.name}: {exc!r}", source=self.name)
            error.__cause__ = exc
            sink.ended(error)
        else:
            sink.ended(None)


def _seconds_between(last: Frame, frame: Frame) -> float:
    """Return the seconds between two captures, by the monotonic clock if both are from one run."""
    by_clock, by_utc = frame.captured - last.captured, frame.utc - last.utc
    same_clock = by_clock >= 0 and abs(by_clock - by_utc) < 1 + 0.01 * by_clock
    return by_clock if same_clock else max(0.0, by_utc)


def _retrieve_exception(done: asyncio.Future[RecordedPicture | None]) -> None:
    if not done.cancelled():
        done.exception()  # mark the error as retrieved: the caller may be cancelled
