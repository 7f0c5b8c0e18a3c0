"""In a program that uses a shared camera, receive its H.264: encoded frames, or pictures."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import FrameFormatError, RemoteProtocolError
from smartcam.frames import Codecs

if TYPE_CHECKING:
    from smartcam.fleet._frames.wire import FleetFrame
    from smartcam.frames import FrameSink

logger: logging.Logger = logging.getLogger("smartcam.fleet")

TAKE_TIMEOUT = 1.0
"""Seconds to wait for readers before they get the next encoded frame of the same answer."""


class VideoReceiver:
    """Receives encoded frames, and gives decoded pictures to the readers.

    Args:
        decode: False to give the encoded frames without decoding them.

    Attributes:
        last_number: number of the last encoded frame that was given on; 0: the next frame must be
            a key frame.

    Raises:
        MissingExtraError: the package that decodes is not installed.
    """

    def __init__(self, *, decode: bool) -> None:
        self.last_number = 0
        self._codecs = Codecs(threads=1)
        self._codecs.begin()
        self._decoder = self._codecs.h264_decoder() if decode else None

    async def close(self) -> None:
        """End the thread. Idempotent."""
        await self._codecs.close()

    async def give_frames(
        self, sink: FrameSink, answer: dict[str, Any], frames: list[FleetFrame]
    ) -> None:
        """Give received frames in order; frames that cannot be decoded count as lost.

        Raises:
            RemoteProtocolError: the agent's numbers of the frames are not valid.
        """
        try:
            numbers = [int(unit["number"]) for unit in answer["units"]]
        except (KeyError, TypeError, ValueError) as exc:
            raise RemoteProtocolError(f"the agent's reply on H.264 is not valid: {exc!r}") from exc
        for index, (number, frame) in enumerate(zip(numbers, frames, strict=True)):
            if self._decoder is None:
                self.last_number = number
                await self._give_encoded(sink, frame, is_last=index == len(frames) - 1)
                continue
            try:
                if number != self.last_number + 1:
                    self._decoder.note_loss()
                picture = await self._decoder.decode(frame)
            except FrameFormatError as exc:
                logger.warning("%s", exc)
                picture = None
            if picture is None:  # ask for a key frame next
                self.last_number = 0
                sink.lost(len(frames) - index)
                return
            self.last_number = number
            sink.frame(picture)

    async def _give_encoded(self, sink: FrameSink, frame: FleetFrame, *, is_last: bool) -> None:
        """Give an encoded frame; unless it is the last, wait until the readers have taken it."""
        sink.frame(frame)
        if not is_last:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(TAKE_TIMEOUT):
                    await sink.wait_taken()
