"""Encode a camera's frames as H.264 at its agent.

Programs that request the same settings share one encoder. To decode a frame of H.264, a program
needs all frames since the last key frame. So the agent keeps the last few encoded frames, and a
program gets all frames after the last one that it has. A program that lags too far gets nothing
until the next key frame. The agent then requests a key frame from the encoder, at most once in
:data:`MIN_KEY_INTERVAL` seconds.
"""

from __future__ import annotations

import asyncio
import collections
import secrets
import time
from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import FrameSourceError

if TYPE_CHECKING:
    from smartcam.frames import Frame, FrameSource
    from smartcam.frames._inside import H264Encoder

MAX_LAG = 0.3
"""Largest age, seconds, of an encoded frame that is still sent; the newest frame may be older."""

MAX_UNITS_KEPT = 64

MIN_KEY_INTERVAL = 1.0
"""Least time from one key frame to the next, seconds."""


class VideoUnit(NamedTuple):
    """An encoded frame.

    Attributes:
        number: number of this encoded frame; each is one more than the previous number.
        frame: the encoded frame.
        encoding_time: seconds to encode the frame.
        is_key_frame: whether the frame can be decoded without earlier frames.
        encoded_at: time of the loop's clock at which the frame was encoded.
        offered_count: number of frames that the source had given at that time.
        lost_count: number of frames that the source had lost at that time.
    """

    number: int
    frame: Frame
    encoding_time: float
    is_key_frame: bool
    encoded_at: float
    offered_count: int
    lost_count: int


class SharedVideo:
    """One stream of H.264.

    Args:
        source: source of the frames.
        encoder: encoder that no other stream uses.
        name: name of the camera.
    """

    def __init__(self, source: FrameSource, encoder: H264Encoder, name: str) -> None:
        self._encoder = encoder
        self._reader = source.reader(timeout=None)
        self._units: collections.deque[VideoUnit] = collections.deque(maxlen=MAX_UNITS_KEPT)
        self._changed = asyncio.Event()
        self._end_cause: tuple[Exception | None] | None = None  # (None,): the source ended
        self._name = name
        self._last_key_at = -MIN_KEY_INTERVAL
        self._needs_key_frame = False
        self.viewer_count = 0
        self._task = asyncio.get_running_loop().create_task(
            self._run(), name=f"smartcam.fleet.{name}.h264"
        )
        self._task.add_done_callback(self._on_task_done)

    def _on_task_done(self, _: asyncio.Task[None]) -> None:
        """Wake the waiting programs, even if the task was cancelled before its first step."""
        if self._end_cause is None:
            self._end_cause = (
                FrameSourceError(f"{self._name}: its video ended", source=self._name),
            )
        self._reader.close()
        self._units.clear()
        self._changed.set()

    @property
    def has_ended(self) -> bool:
        """True once no more frames come."""
        return self._end_cause is not None

    async def close(self) -> None:
        """Stop encoding, and wake waiting programs. Idempotent."""
        await asyncio.wait([self.start_closing()])

    def start_closing(self) -> asyncio.Task[None]:
        """Cancel the encoding task without waiting for its end; return the task."""
        if self._end_cause is None:
            self._end_cause = (
                FrameSourceError(f"{self._name}: its video ended", source=self._name),
            )
        self._reader.close()
        self._changed.set()
        self._task.cancel()
        return self._task

    async def next_units(self, last_number: int) -> list[VideoUnit]:
        """Return the encoded frames for a program, which can decode them all; wait for the first.

        The first one follows the program's last frame, or is a key frame.

        Args:
            last_number: number of the last frame that the program has; 0: none.

        Raises:
            FrameSourceError: the source ended with this error.
            FrameFormatError: the source's frames cannot be encoded.
            StopAsyncIteration: the video ended.
        """
        while True:
            if units := self._kept_units(last_number):
                return units
            if self._end_cause is not None:
                if self._end_cause[0] is not None:
                    raise self._end_cause[0]
                raise StopAsyncIteration
            self._changed.clear()
            await self._changed.wait()

    def _kept_units(self, last_number: int) -> list[VideoUnit]:
        kept = self._units
        if not kept or kept[-1].number == last_number:
            return []
        oldest_allowed = asyncio.get_running_loop().time() - MAX_LAG
        units: list[VideoUnit] = []
        for unit in reversed(kept):
            if unit.encoded_at < oldest_allowed and units:
                break  # the program lags too far
            units.append(unit)
            if unit.is_key_frame or unit.number == last_number + 1:
                return units[::-1]
        self._needs_key_frame = True
        return []

    async def _run(self) -> None:
        try:
            async for frame in self._reader:
                counts = self._reader.statistics()
                await self._encode(frame, counts.offered, counts.lost)
            self._end_cause = self._end_cause or (None,)
        except asyncio.CancelledError:
            raise
        except Exception as error:  # noqa: BLE001 - next_units() raises it
            self._end_cause = (error,)

    async def _encode(self, frame: Frame, offered_count: int, lost_count: int) -> None:
        from smartcam.frames._inside import random_access_point

        loop = asyncio.get_running_loop()
        if self._needs_key_frame and loop.time() - self._last_key_at >= MIN_KEY_INTERVAL:
            self._encoder.request_key_frame()
        started_at = time.perf_counter()
        encoded = await self._encoder.encode(frame)
        encoding_time = time.perf_counter() - started_at
        is_key_frame, _ = random_access_point(bytes(encoded.data))
        if is_key_frame:
            self._last_key_at, self._needs_key_frame = loop.time(), False
        number = self._units[-1].number + 1 if self._units else secrets.randbits(31) + 1
        unit = VideoUnit(
            number, encoded, encoding_time, is_key_frame, loop.time(), offered_count, lost_count
        )
        self._units.append(unit)
        self._changed.set()
