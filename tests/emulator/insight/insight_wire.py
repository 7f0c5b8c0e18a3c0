"""Native mode on the wire, written down by hand: no code of the library makes or reads it."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.emulator._insight.camera import EmulatedInSight

GREETING = b"Welcome to In-Sight(tm)  8502P Session 0\r\nUser: "  # derived: a record of an 8502P
PASSWORD = b"Password: "
LOGGED_IN = b"User Logged In\r\n"
REFUSED = b"Invalid Password\r\n"
DONE = b"1\r\n"
UNKNOWN = b"0\r\n"
INVALID = b"-1\r\n"
FAILED = b"-2\r\n"
HELD = b"-5\r\n"

TIMEOUT = 5.0


async def until(condition: Callable[[], bool]) -> None:
    """Let the loop turn until ``condition`` holds."""
    async with asyncio.timeout(TIMEOUT):
        while not condition():  # noqa: ASYNC110  what is waited for has no event to set
            await asyncio.sleep(0)


class TelnetClient:
    """A plain TCP client."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    @classmethod
    async def open(cls, emulator: EmulatedInSight) -> Self:
        """Connect, say nothing."""
        async with asyncio.timeout(TIMEOUT):
            return cls(*await asyncio.open_connection(emulator.host, emulator.port))

    @classmethod
    async def log_in(cls, emulator: EmulatedInSight, number: int = 0) -> Self:
        """Connect and log in."""
        client = await cls.open(emulator)
        await client.expect(GREETING.replace(b"0\r", b"%d\r" % number))
        await client.ask(b"admin\r\n", PASSWORD)
        await client.ask(b"\r\n", LOGGED_IN)
        return client

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.writer.transport.abort()
        # the transport lets go of its socket in the loop's next round
        await asyncio.sleep(0)

    def send(self, data: bytes) -> None:
        self.writer.write(data)

    async def expect(self, expected: bytes) -> None:
        """Read exactly these bytes."""
        async with asyncio.timeout(TIMEOUT):
            got = await self.reader.readexactly(len(expected))
        assert got == expected

    async def ask(self, command: bytes, answer: bytes) -> None:
        self.send(command)
        await self.expect(answer)

    async def expect_nothing(self) -> None:
        """See that nothing was on its way: the next bytes answer what is asked now."""
        await self.ask(b"XX\r\n", UNKNOWN)

    async def expect_end(self) -> None:
        """See that the camera closes the connection and says nothing more."""
        async with asyncio.timeout(TIMEOUT):
            try:
                rest = await self.reader.read()
            except ConnectionResetError:
                rest = b""
        assert rest == b""
