"""Collect the bytes of frames at a program, from parts in order, while a call waits for them."""

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
"""Seconds without a further part after which the rest of a frame counts as dropped."""


class Incoming:
    """A frame whose bytes are being received.

    Args:
        collector: collector of the frame's parts.
        caller: caller that reports to the agent which bytes have come.
        call: number of the call that the frame answers.
    """

    def __init__(self, collector: FrameCollector, caller: Caller, call: int) -> None:
        self._collector, self._caller, self._call = collector, caller, call
        self._data: Data = b""
        self._total: int | None = None
        self._torn = False
        self._wanted = False
        self._stirred = asyncio.Event()

    def take(self, part: FramePart, data: Data) -> None:
        """Add a part; a part that does not follow the last one ends the frame."""
        if self._torn or self.complete:
            return
        have = len(self._data)
        fits = part.offset == have and have + len(data) <= part.total
        if not fits or self._total not in {None, part.total} or (not data and part.total):
            self._torn = True
        elif len(data) == part.total:
            self._total, self._data = part.total, data
        else:
            if not isinstance(self._data, bytearray):
                self._data = bytearray()
            self._total = part.total
            self._data += data
        over = self._torn or self.complete
        room = MAX_UNCOUNTED_BYTES if over else WINDOW_BYTES
        if part.total > room and not self._caller.program.bus.local:
            self._caller.come(self._call, None if over else len(self._data))
        self._stirred.set()

    @property
    def complete(self) -> bool:
        """True once the frame is complete."""
        return self._total is not None and len(self._data) == self._total

    async def complete_data(self, size: int) -> Data | None:
        """Return the frame's bytes; None if some were lost, or do not come in time.

        Args:
            size: number of bytes of the frame.
        """
        self._wanted = True
        try:
            while not self.complete and not self._torn:
                self._stirred.clear()
                async with asyncio.timeout(PART_TIMEOUT):
                    await self._stirred.wait()
        except TimeoutError:
            return None
        return self._data if self.complete and len(self._data) == size else None

    def forget(self) -> None:
        """Drop the frame, since no call waits for it any more."""
        self._collector.forget(self._call)
        if (self._wanted or self._total is not None) and not self.complete and not self._torn:
            self._caller.come(self._call, None)


class FrameCollector:
    """Receives the bytes of frames for a program.

    Args:
        program: the program.
    """

    def __init__(self, program: Program) -> None:
        self._program = program
        self._handle: Handle | None = None
        self._incoming: dict[int, Incoming] = {}

    def expect(self, caller: Caller, call: int) -> Incoming:
        """Return the incoming frame for the bytes that answer a call."""
        if self._handle is None:
            program = self._program
            key = program.keys.frames(program.name)
            self._handle = program.bus.subscribe_parts(key, self._take_part)
        incoming = self._incoming[call] = Incoming(self, caller, call)
        return incoming

    def forget(self, call: int) -> None:
        """Drop a frame for which no call waits any more, and further parts of it."""
        self._incoming.pop(call, None)

    def close(self) -> None:
        """Stop receiving. Idempotent."""
        handle, self._handle = self._handle, None
        if handle is not None:
            handle.close()

    def _take_part(self, key: str, head: bytes, data: Data) -> None:
        try:
            part = decode_part(head)
        except ProtocolError as exc:
            logger.warning("%s ! %s", self._program.name, exc)
            return
        incoming = self._incoming.get(part.call)
        if incoming is not None:
            incoming.take(part, data)
