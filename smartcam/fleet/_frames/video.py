"""Encode a camera's frames as H.264 at its agent: one encoder per setting for all programs.

A frame of H.264 needs those before it. So the last few are kept, and a request gets all frames
since the program's last one; a program that is too late gets nothing until the next key frame,
which is made for it, but at most once in :data:`KEY_EVERY` seconds.
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

LATE_SECONDS = 0.3
"""Seconds for which an encoded frame is kept for programs that have the frames before it."""

MAX_UNITS_KEPT = 64

KEY_EVERY = 1.0
"""Least seconds from one key frame to the next."""


class VideoUnit(NamedTuple):
    """An encoded frame.

    Attributes:
        number: number of the unit, one more than the number of the unit before.
        frame: the encoded frame.
        took: seconds to encode it.
        key: whether the unit can be decoded without the units before it.
        made: time of the loop's clock at which the unit was made.
        offered: number of frames that the source gave until then.
        lost: number of frames that the source lost until then.
    """

    number: int
    frame: Frame
    took: float
    key: bool
    made: float
    offered: int
    lost: int


class SharedVideo:
    """One stream of H.264.

    Args:
        source: source of the frames.
        encoder: encoder for this stream alone.
        name: name of the camera.
    """

    def __init__(self, source: FrameSource, encoder: H264Encoder, name: str) -> None:
        self._encoder = encoder
        self._reader = source.reader(timeout=None)
        self._units: collections.deque[VideoUnit] = collections.deque(maxlen=MAX_UNITS_KEPT)
        self._stirred = asyncio.Event()
        self._over: tuple[Exception | None] | None = None
        self._name = name
        self._last_key = -KEY_EVERY
        self._key_wanted = False
        self.viewers = 0
        self._task = asyncio.get_running_loop().create_task(
            self._run(), name=f"smartcam.fleet.{name}.h264"
        )
        self._task.add_done_callback(self._ended)

    def _ended(self, _: asyncio.Task[None]) -> None:
        """Wake the readers at the task's end, even of a task that was cancelled before it began."""
        if self._over is None:
            self._over = (FrameSourceError(f"{self._name}: its video ended", source=self._name),)
        self._reader.close()
        self._units.clear()
        self._stirred.set()

    @property
    def over(self) -> bool:
        """True once no more frames come."""
        return self._over is not None

    async def close(self) -> None:
        """Stop encoding, and wake waiting readers. Idempotent."""
        await asyncio.wait([self.end()])

    def end(self) -> asyncio.Task[None]:
        """Start to close; return the task, which then ends."""
        if self._over is None:
            self._over = (FrameSourceError(f"{self._name}: its video ended", source=self._name),)
        self._reader.close()
        self._stirred.set()
        self._task.cancel()
        return self._task

    async def after(self, have: int) -> list[VideoUnit]:
        """Wait for encoded frames after a frame, or from a key frame on; return them.

        Args:
            have: number of the last frame that the reader has; 0: none.

        Raises:
            FrameSourceError: the source ended with this error.
            FrameFormatError: its frames cannot become video.
            StopAsyncIteration: the video ended.
        """
        while True:
            if following := self._following(have):
                return following
            if self._over is not None:
                if self._over[0] is not None:
                    raise self._over[0]
                raise StopAsyncIteration
            self._stirred.clear()
            await self._stirred.wait()

    def _following(self, have: int) -> list[VideoUnit]:
        kept = self._units
        if not kept or kept[-1].number == have:
            return []
        fresh = asyncio.get_running_loop().time() - LATE_SECONDS
        units: list[VideoUnit] = []
        for unit in reversed(kept):
            if unit.made < fresh and units:
                break  # the reader is too late for all of these
            units.append(unit)
            if unit.key or unit.number == have + 1:
                return units[::-1]
        self._key_wanted = True
        return []

    async def _run(self) -> None:
        try:
            async for frame in self._reader:
                account = self._reader.statistics()
                await self._encode(frame, account.offered, account.lost)
            self._over = self._over or (None,)
        except asyncio.CancelledError:
            raise
        except Exception as error:  # noqa: BLE001 - passed to the viewers
            self._over = (error,)

    async def _encode(self, frame: Frame, offered: int, lost: int) -> None:
        from smartcam.frames._inside import entry_point

        loop = asyncio.get_running_loop()
        if self._key_wanted and loop.time() - self._last_key >= KEY_EVERY:
            self._encoder.begin_anew()
        began = time.perf_counter()
        made = await self._encoder.encode(frame)
        took = time.perf_counter() - began
        key, _ = entry_point(bytes(made.data))
        if key:
            self._last_key, self._key_wanted = loop.time(), False
        number = self._units[-1].number + 1 if self._units else secrets.randbits(31) + 1
        unit = VideoUnit(number, made, took, key, loop.time(), offered, lost)
        self._units.append(unit)
        self._stirred.set()
