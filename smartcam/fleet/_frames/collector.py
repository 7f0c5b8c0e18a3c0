"""In the calling program, put frames together from their parts while the call waits."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from smartcam.exceptions import ProtocolError
from smartcam.fleet._frames.sender import MAX_UNCOUNTED_BYTES, WINDOW_BYTES
from smartcam.fleet._frames.wire import decode_part

if TYPE_CHECKING:
    from smartcam.fleet._bus.bus import Data, Handle
    from smartcam.fleet._frames.wire import FramePart
    from smartcam.fleet._program.caller import Caller
    from smartcam.fleet._program.program import Program

logger: logging.Logger = logging.getLogger("smartcam.fleet")

PART_TIMEOUT = 2.0
"""Seconds without a further part after which a frame counts as broken."""


class IncomingFrame:
    """A frame whose bytes are being received.

    Args:
        collector: collector of the frame's parts.
        caller: caller that confirms received bytes to the agent.
        call: number of the call that the frame answers.
    """

    def __init__(self, collector: FrameCollector, caller: Caller, call: int) -> None:
        self._collector, self._caller, self._call = collector, caller, call
        self._data: Data = b""
        self._total: int | None = None
        self._is_broken = False
        self._is_awaited = False
        self._changed = asyncio.Event()

    def add_part(self, part: FramePart, data: Data) -> None:
        """Add a part; if it does not follow the last one, the frame is broken."""
        if self._is_broken or self.complete:
            return
        size = len(self._data)
        fits = part.offset == size and size + len(data) <= part.total
        if not fits or self._total not in {None, part.total} or (not data and part.total):
            self._is_broken = True
        elif len(data) == part.total:
            self._total, self._data = part.total, data
        else:
            if not isinstance(self._data, bytearray):
                self._data = bytearray()
            self._total = part.total
            self._data += data
        is_finished = self._is_broken or self.complete
        unconfirmed_limit = MAX_UNCOUNTED_BYTES if is_finished else WINDOW_BYTES
        if part.total > unconfirmed_limit and not self._caller.program.bus.local:
            self._caller.confirm_bytes(self._call, None if is_finished else len(self._data))
        self._changed.set()

    @property
    def complete(self) -> bool:
        """True once the frame is complete."""
        return self._total is not None and len(self._data) == self._total

    async def complete_data(self, size: int) -> Data | None:
        """Wait for the frame's bytes, and return them; None if parts are lost or come too late.

        Args:
            size: number of bytes that the frame must have.
        """
        self._is_awaited = True
        try:
            while not self.complete and not self._is_broken:
                self._changed.clear()
                async with asyncio.timeout(PART_TIMEOUT):
                    await self._changed.wait()
        except TimeoutError:
            return None
        return self._data if self.complete and len(self._data) == size else None

    def forget(self) -> None:
        """Drop the frame, since no call waits for it any more."""
        self._collector.forget(self._call)
        if (
            (self._is_awaited or self._total is not None)
            and not self.complete
            and not self._is_broken
        ):
            self._caller.confirm_bytes(self._call, None)


class FrameCollector:
    """Receives the bytes of frames for a program.

    Args:
        program: the program.
    """

    def __init__(self, program: Program) -> None:
        self._program = program
        self._handle: Handle | None = None
        self._incoming: dict[int, IncomingFrame] = {}

    def expect_frame(self, caller: Caller, call: int) -> IncomingFrame:
        """Return a new incoming frame, which collects the bytes that answer a call."""
        if self._handle is None:
            program = self._program
            key = program.keys.frames(program.name)
            self._handle = program.bus.subscribe_parts(key, self._on_part)
        incoming = self._incoming[call] = IncomingFrame(self, caller, call)
        return incoming

    def forget(self, call: int) -> None:
        """Drop a frame for which no call waits any more; its further parts are ignored."""
        self._incoming.pop(call, None)

    def close(self) -> None:
        """Stop receiving. Idempotent."""
        handle, self._handle = self._handle, None
        if handle is not None:
            handle.close()

    def _on_part(self, key: str, head: bytes, data: Data) -> None:
        try:
            part = decode_part(head)
        except ProtocolError as exc:
            logger.warning("%s ! %s", self._program.name, exc)
            return
        incoming = self._incoming.get(part.call)
        if incoming is not None:
            incoming.add_part(part, data)
