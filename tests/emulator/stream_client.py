"""A plain TCP client of an emulated camera, whatever it speaks; no code of the library."""

from __future__ import annotations

import asyncio
from typing import Protocol, Self

TIMEOUT = 5.0
"""Seconds that an answer may take."""


class Place(Protocol):
    """The address on which an emulated camera listens."""

    @property
    def host(self) -> str: ...

    @property
    def port(self) -> int: ...


class StreamClient:
    """A connection to an emulated camera."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer

    @classmethod
    async def open(cls, emulator: Place) -> Self:
        """Connect, say nothing."""
        async with asyncio.timeout(TIMEOUT):
            return cls(*await asyncio.open_connection(emulator.host, emulator.port))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.writer.transport.abort()
        # the transport lets go of its socket in the loop's next round
        await asyncio.sleep(0)

    def send(self, *data: bytes) -> None:
        self.writer.write(b"".join(data))

    async def expect(self, *said: bytes) -> None:
        """Read exactly these bytes."""
        for expected in said:
            async with asyncio.timeout(TIMEOUT):
                got = await self.reader.readexactly(len(expected))
            assert got.hex(" ") == expected.hex(" "), got

    async def expect_end(self) -> None:
        """See that the camera closes the connection and says nothing more."""
        async with asyncio.timeout(TIMEOUT):
            try:
                rest = await self.reader.read()
            except ConnectionResetError:
                rest = b""
        assert rest == b""
