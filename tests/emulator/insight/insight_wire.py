"""Native mode on the wire, written down by hand: no code of the library makes or reads it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

from tests.emulator.stream_client import StreamClient

if TYPE_CHECKING:
    from smartcam.emulator import EmulatedInSight

GREETING = b"Welcome to In-Sight(tm)  8502P Session 0\r\nUser: "  # derived: a record of an 8502P
PASSWORD = b"Password: "
LOGGED_IN = b"User Logged In\r\n"
REFUSED = b"Invalid Password\r\n"
DONE = b"1\r\n"
UNKNOWN = b"0\r\n"
INVALID = b"-1\r\n"
FAILED = b"-2\r\n"
HELD = b"-5\r\n"


class TelnetClient(StreamClient):
    """A plain TCP client."""

    @classmethod
    async def log_in(cls, emulator: EmulatedInSight, number: int = 0) -> Self:
        """Connect and log in."""
        client = await cls.open(emulator)
        await client.expect(GREETING.replace(b"0\r", b"%d\r" % number))
        await client.ask(b"admin\r\n", PASSWORD)
        await client.ask(b"\r\n", LOGGED_IN)
        return client

    async def ask(self, command: bytes, answer: bytes) -> None:
        self.send(command)
        await self.expect(answer)

    async def expect_nothing(self) -> None:
        """See that nothing was on its way: the next bytes answer what is asked now."""
        await self.ask(b"XX\r\n", UNKNOWN)
