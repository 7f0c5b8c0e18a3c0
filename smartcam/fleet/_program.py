"""A program on the bus: its calls, and the replies to them."""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import socket
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import ConnectionClosedError, ProtocolError
from smartcam.fleet._wire import Message, decode, encode

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Self

    from smartcam.exceptions import SmartCamError
    from smartcam.fleet._bus import Bus, Handle
    from smartcam.fleet._keys import Keys

logger: logging.Logger = logging.getLogger("smartcam.fleet")


class Pending(NamedTuple):
    """A call whose reply has not come."""

    camera: object
    reply: asyncio.Future[Message]


class Program:
    """One program's end of the bus.

    Args:
        bus: an end of its own.
        keys: of the fleet.

    Attributes:
        name: which no other program has; it begins with what a person would call it.
    """

    def __init__(self, bus: Bus, keys: Keys) -> None:
        self.bus, self.keys = bus, keys
        self.name: str = f"{_own_name()}-{secrets.token_hex(6)}"
        self._calls = 0
        self._pending: dict[int, Pending] = {}
        self._declared: list[Handle] = []

    async def open(self, timeout: float) -> Self:
        """Come to the bus.

        Raises:
            ConnectFailedError: there is none within ``timeout`` seconds.
        """
        await self.bus.open(timeout)
        self._declared = [
            self.bus.subscribe(self.keys.reply(self.name), self._on_reply),
            self.bus.be_present(self.keys.program(self.name)),
        ]
        return self

    async def close(self) -> None:
        """Leave the bus; calls under way end. Idempotent."""
        for _, reply in [*self._pending.values()]:
            if not reply.done():
                reply.set_exception(ConnectionClosedError("closed"))
        declared, self._declared = self._declared, []
        for handle in declared:
            handle.close()
        await self.bus.close()

    def next_call(self) -> int:
        """Return the number of the next call; each is given once."""
        self._calls += 1
        return self._calls

    def send(self, camera: str, fields: dict[str, Any], blobs: Sequence[bytes] = ()) -> int:
        """Say something to a camera's agent; return how many bytes."""
        payload = encode({"program": self.name, **fields}, blobs)
        self.bus.put(self.keys.call(camera), payload)
        return len(payload)

    def expect(self, number: int, camera: object) -> asyncio.Future[Message]:
        """Return what gets the reply to a call; :meth:`forget` it when it is done."""
        reply: asyncio.Future[Message] = asyncio.get_running_loop().create_future()
        self._pending[number] = Pending(camera, reply)
        return reply

    def forget(self, number: int) -> None:
        """Nobody waits for a reply any more."""
        self._pending.pop(number, None)

    def fail(self, camera: object, error: Callable[[], SmartCamError]) -> None:
        """End all calls to a camera: there will be no replies."""
        for owner, reply in self._pending.values():
            if owner is camera and not reply.done():
                reply.set_exception(error())

    def _on_reply(self, key: str, payload: bytes) -> None:
        try:
            message = decode(payload, "a reply")
            pending = self._pending.get(message.fields["call"])
        except (ProtocolError, KeyError, TypeError) as exc:
            logger.warning("%s ! a reply that cannot be read: %s", self.name, exc)
            return
        if pending is not None and not pending.reply.done():
            pending.reply.set_result(message)


def _own_name() -> str:
    """Return what a person would call this process: its script, host and number."""
    script = Path(sys.argv[0] if sys.argv else "").stem or "python"
    text = f"{script}-{socket.gethostname().partition('.')[0]}-{os.getpid()}".lower()
    return "".join(one if one.isascii() and (one.isalnum() or one == "-") else "_" for one in text)
