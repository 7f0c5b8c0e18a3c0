"""An emulated Cognex In-Sight camera on a real port: native mode over telnet.

::

    async with EmulatedInSight(jobs=[{"file": "7bolts.job", "cells": {"B2": 12.5}}]) as emulator:
        emulator.url    # insight://127.0.0.1:PORT

What it answers, and what is known of that, stands in ``docs/insight.md``.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections import deque
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from smartcam._accepting import Acceptor
from smartcam._server import Server
from smartcam.emulator._clock import Clock, OneTimer, RealClock, nanoseconds
from smartcam.emulator._insight.commands import InSightCommands, InSightQuirks
from smartcam.emulator._insight.connection import MAX_LOGGED, MAX_SESSIONS, TelnetConnection
from smartcam.emulator._insight.device import InSightDevice
from smartcam.emulator._tally import Tally
from smartcam.exceptions import ConfigurationError, ResponseTimeoutError
from smartcam.protocols._insight import words
from smartcam.settings import validated

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from smartcam.emulator._insight.job import Job

_log = logging.getLogger("smartcam.emulator")

MAX_ENTRIES = 10_000
"""Entries of the log; the oldest go first."""

MAX_ORDERED = 1000
"""Answers that may be ordered in advance."""


class InSightLogEntry(NamedTuple):
    """What was heard or said.

    Attributes:
        time: of the emulator's clock, seconds.
        direction: ``in`` a line from a client, ``out`` bytes to it.
        peer: address and port of the client.
        text: the line without its end; the bytes with theirs, cut after 200. Passwords are not
            shown.
    """

    time: float
    direction: Literal["in", "out"]
    peer: str
    text: str


class _Ordered(NamedTuple):
    """An answer that was ordered in advance."""

    code: int
    command: str | None


class EmulatedInSight(Server):
    """An In-Sight camera made of software, on a real port.

    Several clients may be logged in at a time: that a camera has several users at once is
    published, how many is not.

    Args:
        jobs: those on it: :class:`Job` or mappings of its fields.
        host: address to listen on; nothing but this.
        port: port to listen on, 0 for a free one.
        users: password of each user; published is that a new camera has ``admin`` without one.
        model: named in the first line it says.
        active: file of the job that is loaded at first; default the first of the jobs, without any
            an empty one that was never saved.
        online: whether it is online at first.
        image: what it sees: an 8 bit grey image; default a pattern.
        evaluations: answers to ``EV``: expression to the text that is sent; others fail.
        info: what ``GI`` tells, instead of the emulator's own.
        quirks: what is not known of real cameras: :class:`InSightQuirks` or a mapping.
        clock: its time; a :class:`~smartcam.emulator.ManualClock` in tests. Default: real.
        name: for logs.

    Attributes:
        host: as given.
        name: as given.
        clock: its clock.
        device: the camera behind the wire, for looking; to make it do something, use the methods
            of the emulator.
        log: what was heard and said, the last 10,000.
        crowded_out: clients that were sent away because too many were connected.
        refuse_login: refuse every user.
        silent: hear commands and do them, but say nothing.

    Raises:
        ConfigurationError: something given is wrong.
    """

    def __init__(
        self,
        jobs: Iterable[Job | Mapping[str, Any]] = (),
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        users: Mapping[str, str] | None = None,
        model: str = "8502P",
        active: str | None = None,
        online: bool = False,
        image: Any = None,
        evaluations: Mapping[str, str] | None = None,
        info: Mapping[str, str] | None = None,
        quirks: InSightQuirks | Mapping[str, Any] | None = None,
        clock: Clock | None = None,
        name: str = "insight",
    ) -> None:
        self.host: str = host
        self.name: str = name
        self.clock: Clock = RealClock() if clock is None else clock
        self.device: InSightDevice = InSightDevice(jobs, active=active, online=online, image=image)
        self.log: deque[InSightLogEntry] = deque(maxlen=MAX_ENTRIES)
        self.crowded_out: int = 0
        self.refuse_login: bool = False
        self.silent: bool = False
        self._users = {"admin": ""} if users is None else dict(users)
        self._model = model
        self._commands = InSightCommands(
            self.device,
            evaluations=evaluations,
            info=info,
            quirks=validated(InSightQuirks, quirks or {}, "quirks"),
        )
        self._port = port
        self._socket: socket.socket | None = None
        self._acceptor = Acceptor(lambda: TelnetConnection(self), _log, name="smartcam.insight")
        self._connections: dict[TelnetConnection, None] = {}  # the oldest stands first
        self._ordered: deque[_Ordered] = deque()
        self._heard: Tally[str] = Tally()
        self._timer = OneTimer(self.clock, lambda: self._act(lambda: None))
        self._offset = 0  # nanoseconds from the device's time, which stands still while stopped

    # ------------------------------------------------------------------ what it is

    @property
    def port(self) -> int:
        """The port it listens on; the one given until it is started."""
        return self._port

    @property
    def url(self) -> str:
        """Its address."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"insight://{host}:{self.port}"

    def __repr__(self) -> str:
        return f"<EmulatedInSight {self.url}>"

    @property
    def online(self) -> bool:
        """Whether it is online."""
        return self.device.online

    @property
    def active(self) -> str | None:
        """File of the active job, None for one that was never saved."""
        return None if self.device.job is None else self.device.job.file

    @property
    def quirks(self) -> InSightQuirks:
        """Its quirks."""
        return self._commands.quirks

    @property
    def sessions(self) -> list[str]:
        """Address and port of the clients that are logged in, the oldest session first."""
        return [one.peer for one in self._by_number() if one.logged_in]

    @property
    def links(self) -> list[str]:
        """Address and port of all clients that are connected."""
        return [one.peer for one in self._by_number()]

    # ------------------------------------------------------------------ the operator

    def set_online(self, online: bool) -> None:
        """Go online, or be held offline by hand or an input: then ``SO1`` is answered with -5."""
        self._act(lambda: self.device.set_online(online))

    def set_image(self, image: NDArray[np.uint8]) -> None:
        """Have it see another image.

        Raises:
            ConfigurationError: it is no 8 bit grey image.
        """
        self.device.image = image

    def trigger(self) -> bool:
        """Trigger by the input; False if the camera does not take it."""
        taken: list[bool] = []
        self._act(lambda: taken.append(self.device.trigger()))
        return taken[0]

    def load(self, job: str | int) -> None:
        """Load a job by hand, at once and in either mode; a run under way ends without a result.

        Args:
            job: its file name or id.

        Raises:
            ConfigurationError: there is none, or another one is being loaded.
        """
        self._act(lambda: self.device.load(job))

    def answer_next(self, code: int, *, command: str | None = None) -> None:
        """Answer a command with a status code instead of doing it; the oldest order goes first.

        Args:
            code: the code.
            command: the two letters of the command that is meant; default the next one, whichever.

        Raises:
            ConfigurationError: 1000 answers are ordered already.
        """
        if len(self._ordered) >= MAX_ORDERED:
            raise ConfigurationError(f"{MAX_ORDERED} answers are ordered already")
        self._ordered.append(_Ordered(code, None if command is None else command.upper()))

    def drop_connections(self) -> None:
        """End every connection at once, as a broken network does. What is under way goes on."""
        for one in list(self._connections):
            one.close("dropped")

    async def wait_heard(self, command: str, *, count: int = 1, timeout: float = 5.0) -> None:
        """Wait until clients have sent a command, since the beginning.

        When it returns, the camera has begun to do it. The timeout runs in real time, whatever the
        emulator's clock is.

        Args:
            command: its two letters.
            count: how often, what came before this call included.
            timeout: seconds.

        Raises:
            ResponseTimeoutError: it did not come in time.

        Cancellation: safe.
        """
        mnemonic = command.upper()
        try:
            await self._heard.wait(mnemonic, count, timeout)
        except TimeoutError as exc:
            raise ResponseTimeoutError(
                f"the emulator heard {self._heard[mnemonic]} of {count} {mnemonic} in {timeout} s",
                waited=timeout,
            ) from exc

    # ------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open the port; does nothing if it is started already.

        Raises:
            ConfigurationError: it cannot listen there.

        Cancellation: leaves it stopped.
        """
        if self._socket is not None:
            return
        loop = asyncio.get_running_loop()
        try:
            found = await loop.getaddrinfo(self.host, self._port, type=socket.SOCK_STREAM)
            family, address = found[0][0], found[0][4]
            listener = socket.create_server(
                (str(address[0]), self._port), family=family, backlog=MAX_SESSIONS
            )
        except (OSError, ValueError, OverflowError) as exc:
            raise ConfigurationError(
                f"emulator: cannot listen on {self.host}:{self._port}: {exc}"
            ) from exc
        listener.setblocking(False)
        self._socket = listener
        self._port = listener.getsockname()[1]
        self._acceptor.open(listener)
        self._offset = self._clock_time() - self.device.now
        self._act(lambda: None)
        _log.info("= %s: listening on %s", self.name, self.url)

    async def stop(self) -> None:
        """Close the port and every connection; the camera stands still. Nothing if stopped.

        Cancellation: everything is closed nevertheless.
        """
        if self._socket is None:
            return
        self._act(lambda: None)  # what was due happens
        listener, self._socket = self._socket, None
        self._acceptor.close()
        listener.close()
        self._timer.set(None)
        for one in list(self._connections):
            one.close("the emulator stops")
        await self._acceptor.wait_closed()
        await asyncio.sleep(0)  # transports that were aborted let go of their sockets now
        _log.info("= %s: stopped", self.name)

    # ------------------------------------------------------------------ for connections

    def enter(self, connection: TelnetConnection) -> int | None:
        """Take a connection; return its number, None if there are too many or it is too late."""
        if self._socket is None:
            return None
        if len(self._connections) >= MAX_SESSIONS:
            self.crowded_out += 1
            waiting = next((one for one in self._connections if not one.logged_in), None)
            if waiting is None:
                return None
            waiting.close(f"{MAX_SESSIONS} others are open, it waited for its login for longest")
        taken = {one.number for one in self._connections}
        number = next(one for one in range(MAX_SESSIONS) if one not in taken)
        self._connections[connection] = None
        return number

    def leave(self, connection: TelnetConnection) -> None:
        """Forget a connection that is gone; harmless when done twice."""
        self._connections.pop(connection, None)

    def greeting(self, number: int) -> bytes:
        """Return a new connection's greeting; two spaces before the model (clients, derived)."""
        text = f"{words.WELCOME}(tm)  {self._model} Session {number}"
        return text.encode(words.ENCODING) + words.LINE_END + words.USER_PROMPT

    def admits(self, user: str, password: str) -> bool:
        """Return whether a login is right; user names are case sensitive (manual, published)."""
        known = self._users.get(user)
        return known is not None and known == password and not self.refuse_login

    def execute(self, connection: TelnetConnection, line: str) -> None:
        """Do what a line of a logged-in client says."""
        mnemonic = line[:2].upper()
        code = self._take_ordered(mnemonic)
        if code is not None:
            connection.answer(str(code).encode("ascii") + words.LINE_END)
        else:
            self._act(lambda: self._commands.execute(line, connection.answer))
        self._heard.add(mnemonic if mnemonic in words.COMMANDS else "")

    def note(self, direction: Literal["in", "out"], peer: str, text: str) -> None:
        """Put an entry into the log."""
        self.log.append(InSightLogEntry(self.clock.now, direction, peer, text[:MAX_LOGGED]))

    # ------------------------------------------------------------------ inside

    def _take_ordered(self, mnemonic: str) -> int | None:
        for index, ordered in enumerate(self._ordered):
            if ordered.command in {None, mnemonic}:
                del self._ordered[index]
                return ordered.code
        return None

    def _by_number(self) -> list[TelnetConnection]:
        return sorted(self._connections, key=lambda one: one.number)

    def _act(self, action: Callable[[], object]) -> None:
        """Do something to the device, its time brought up, and see to what follows by itself."""
        if self._socket is not None:
            self.device.advance_to(self._clock_time() - self._offset)
        try:
            action()
        finally:
            if self._socket is not None:
                due = self.device.due
                self._timer.set(None if due is None else due + self._offset)

    def _clock_time(self) -> int:
        return nanoseconds(self.clock.now)
