"""Connections of the emulated In-Sight camera: lines in, bytes out."""

from __future__ import annotations

import asyncio
import enum
import logging
from typing import TYPE_CHECKING, cast

from smartcam.exceptions import FrameError
from smartcam.protocols._insight import words

if TYPE_CHECKING:
    from smartcam.emulator._insight.camera import EmulatedInSight

_log = logging.getLogger("smartcam.emulator")

MAX_SESSIONS = 16
"""Connections at a time. For a newcomer the one makes room that waits for its login for longest;
where all are logged in, it is closed at once. The real camera's bound is not published."""

MAX_WAITING = 1 << 16
"""Bytes of commands that wait behind one under way; more are left to the network."""

WRITE_LIMIT = 1 << 25
"""Bytes kept for a client that does not read; more end its connection. An image of 8 megapixels
makes 17 million."""

MAX_LOGGED = 200
"""Characters of a line or an answer that the log shows."""


class _LoginState(enum.Enum):
    """How far a client has come."""

    USER = "user"
    PASSWORD = "password"  # noqa: S105 - a state
    COMMANDS = "commands"


class TelnetConnection(asyncio.Protocol):
    """One client: it logs in, then its commands are done one after the other (decided)."""

    _transport: asyncio.Transport

    def __init__(self, emulator: EmulatedInSight) -> None:
        self.peer: str = "?"  # address and port of the client
        self.number: int = -1  # of the session, from 0
        self._emulator = emulator
        self._reader = words.command_reader()
        self._state = _LoginState.USER
        self._user = ""
        self._busy = False  # a command is under way
        self._closed = False
        self._going = False  # lines are taken

    @property
    def logged_in(self) -> bool:
        """Whether its commands are done."""
        return self._state is _LoginState.COMMANDS

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Greet the client, or send it away."""
        self._transport = cast("asyncio.Transport", transport)
        address = transport.get_extra_info("peername")
        self.peer = f"{address[0]}:{address[1]}" if address else "?"
        number = self._emulator.enter(self)
        if number is None:
            self.close("no place is free")
            return
        self.number = number
        self._say(self._emulator.greeting(number))

    def data_received(self, data: bytes) -> None:
        """Take what the client says."""
        self._reader.feed(data)
        self._go_on()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the client; what it asked for goes on."""
        self._closed = True
        self._emulator.leave(self)

    def answer(self, data: bytes, *, more: bool = False) -> None:
        """Answer the command under way; without ``more`` it is done."""
        self._say(data)
        if not more:
            self._busy = False
            self._go_on()

    def close(self, reason: str) -> None:
        """End the connection at once."""
        if not self._closed:
            self._closed = True
            _log.info("= %s: connection closed: %s", self.peer, reason)
        self._emulator.leave(self)
        self._transport.abort()

    def _go_on(self) -> None:
        if self._going:
            return  # answered at once: the loop below goes on
        self._going = True
        try:
            while not self._busy and not self._closed:
                line = self._reader.next_line()
                if line is None:
                    break
                self._hear(line)
        except FrameError as exc:
            self.close(str(exc))
        finally:
            self._going = False
        if self._closed:
            return
        if len(self._reader) > MAX_WAITING:
            self._transport.pause_reading()
        else:
            self._transport.resume_reading()

    def _hear(self, line: str) -> None:
        shown = "***" if self._state is _LoginState.PASSWORD else line
        self._emulator.note("in", self.peer, shown)
        if self._state is _LoginState.USER:
            self._user = line
            self._state = _LoginState.PASSWORD
            self._say(words.PASSWORD_PROMPT)
        elif self._state is _LoginState.PASSWORD:
            self._log_in(line)
        else:
            self._busy = True
            self._emulator.execute(self, line)

    def _log_in(self, password: str) -> None:
        if self._emulator.admits(self._user, password):
            self._state = _LoginState.COMMANDS
            self._say(words.LOGGED_IN.encode("ascii") + words.LINE_END)
            return
        self._say(words.INVALID_PASSWORD.encode("ascii") + words.LINE_END)
        _log.info("= %s: connection closed: the login was refused", self.peer)
        self._closed = True
        self._transport.close()

    def _say(self, data: bytes) -> None:
        if self._closed or self._emulator.silent:
            return
        if self._transport.get_write_buffer_size() + len(data) > WRITE_LIMIT:
            self.close(f"it does not read: more than {WRITE_LIMIT} bytes wait for it")
            return
        self._emulator.note("out", self.peer, data[:MAX_LOGGED].decode(words.ENCODING))
        self._transport.write(data)
