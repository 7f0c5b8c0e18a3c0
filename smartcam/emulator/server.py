"""The emulated camera on a port: sockets, a clock and the device between them.

Bytes of a client go ``socket -> Link -> Machine -> EmulatedCamera.received -> Device.handle``; what
the device says goes ``Device.take_output -> Machine -> one write``. Everything that happens is a
*step*: bring the device's time up, do it, deliver, set one timer for the device's next event.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal, cast

from pydantic import ValidationError

from smartcam.emulator.application import Application, make_application
from smartcam.emulator.clock import Clock, RealClock
from smartcam.emulator.device import Device
from smartcam.emulator.links import MAX_LINKS, TcpListener, UdpListener
from smartcam.emulator.quirks import Quirks
from smartcam.emulator.scenario import Scenario, load_scenario
from smartcam.emulator.scene import TableScene
from smartcam.emulator.traffic import LogEntry, TrafficLog
from smartcam.exceptions import ConfigurationError
from smartcam.protocols import messages as m
from smartcam.protocols.base import Transport
from smartcam.registry import PROTOCOLS
from smartcam.settings import validation_text

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Generator, Iterable
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    from smartcam.emulator.clock import TimerHandle
    from smartcam.emulator.links import Link, Listener
    from smartcam.exceptions import RemoteProtocolError
    from smartcam.protocols.base import Dialect, Protocol
    from smartcam.protocols.framing import Frame

__all__ = ["EmulatedCamera"]

_log = logging.getLogger("smartcam.emulator")

_RETRY = 0.2  # seconds between tries to get the port back after a reboot
_LISTENERS: dict[Transport, type[TcpListener | UdpListener]] = {
    Transport.TCP: TcpListener,
    Transport.UDP: UdpListener,
}


class EmulatedCamera:
    """A camera made of software, on a real port.

    ::

        async with EmulatedCamera(applications=[...]) as emulator:
            async with smartcam.connect(emulator.url) as camera:
                ...

    The applications given come beside the built-in ones (1, 3, 7, 9, 21) and replace those of the
    same id. It is stopped at first, unless ``running``.

    Args:
        applications: programs of the camera: :class:`Application` or mappings of its fields.
        scenario: a scenario or the path of its file; what is given here beside it goes before it.
        host: address to listen on; nothing but this.
        port: port to listen on, 0 for a free one.
        transport: ``"tcp"`` or ``"udp"``.
        dialect: name of the wire dialect.
        clock: its time; a :class:`ManualClock` in tests. Default: real time.
        quirks: what is not known of real cameras: :class:`Quirks` or a mapping of its fields.
        name: for logs.
        active: id of the application that is loaded at first; default the first given, else 1.
        running: in run mode from the beginning.
        seed: of the scene's noise; default 0.
        builtins: have the built-in applications.

    Attributes:
        host: as given.
        transport: as given.
        dialect: as given.
        name: as given.
        clock: its clock.
        device: the camera behind the wire. Its operator's methods (``trigger()``,
            ``set_condition()``, ...) may be called at any time in the event loop's thread; what
            they cause is sent. Its time is brought up whenever something happens.
        seed: seed of the scene's noise.

    Raises:
        ConfigurationError: something given is wrong.
    """

    def __init__(
        self,
        applications: Iterable[Application | dict[str, Any]] = (),
        *,
        scenario: Scenario | str | Path | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        transport: Literal["tcp", "udp"] = "tcp",
        dialect: str = "handbook",
        clock: Clock | None = None,
        quirks: Quirks | dict[str, Any] | None = None,
        name: str | None = None,
        active: int | None = None,
        running: bool | None = None,
        seed: int | None = None,
        builtins: bool | None = None,
    ) -> None:
        plan = _plan(
            scenario,
            applications,
            {
                "quirks": _make_quirks(quirks) if isinstance(quirks, dict) else quirks,
                "name": name,
                "active": active,
                "running": running,
                "seed": seed,
                "builtins": builtins,
            },
        )
        self.host = host
        self.transport: Literal["tcp", "udp"] = transport
        self.dialect = dialect
        self.name: str = plan.name
        self.clock: Clock = clock if clock is not None else RealClock()
        self.seed: int = plan.seed
        self.device: Device = Device(
            plan.all_applications,
            active=plan.active,
            running=plan.running,
            quirks=plan.quirks,
            scene=TableScene(seed=plan.seed),
        )
        self.device.around = self.step
        self._protocol = cast("Protocol", PROTOCOLS.load("bvs"))
        self.spoken: Dialect = _known(self._protocol.dialects, "dialect", dialect)
        kind = _known({t.value: t for t in Transport}, "transport", transport)
        self._scheme = next(s for s, t in self._protocol.schemes.items() if t is kind)
        self._listener: Listener = _LISTENERS[kind](self)
        self._traffic = TrafficLog(self.spoken)
        self._port = port
        self._address: tuple[int, Any] = (socket.AF_INET, (host, port))
        self._socket: socket.socket | None = None
        self._opening: asyncio.Task[None] | None = None
        self._active: Link | None = None
        self._started = False
        self._down = False
        self._moved_at = 0.0
        self._timer: TimerHandle | None = None
        self._timer_at: float | None = None

    # ------------------------------------------------------------------ what it is

    @property
    def port(self) -> int:
        """The port it listens on; the one given until it is started."""
        return self._port

    @property
    def url(self) -> str:
        """Its address with the dialect pinned."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self._scheme}://{host}:{self._port}?dialect={self.dialect}"

    @property
    def scene(self) -> TableScene:
        """The table it looks at, with the ground truth."""
        return self.device.scene

    @property
    def quirks(self) -> Quirks:
        """Its quirks."""
        return self.device.quirks

    @property
    def log(self) -> deque[LogEntry]:
        """The last frames in both directions, oldest first."""
        return self._traffic.entries

    @property
    def has_session(self) -> bool:
        """Whether a client has the session."""
        return self._active is not None

    @property
    def sessions(self) -> list[str]:
        """Address and port of the client that has the session, or nothing."""
        return [] if self._active is None else [self._active.peer]

    @property
    def links(self) -> list[str]:
        """Address and port of all clients that are connected, with a session or without."""
        return [link.peer for link in self._listener.all_links]

    async def wait_received(
        self, what: int | type[m.Message], *, count: int = 1, timeout: float = 5.0
    ) -> None:
        """Wait until clients have sent ``count`` whole frames of a kind since the beginning.

        When it returns, the device has handled them. The timeout runs in real time, whatever the
        emulator's clock is.

        Args:
            what: a message id, or a message type.
            count: how many, those that came before this call included.
            timeout: seconds.

        Raises:
            ResponseTimeoutError: they did not come in time.

        Cancellation: safe.
        """
        await self._traffic.wait_received(what, count=count, timeout=timeout)

    # ------------------------------------------------------------------ life

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.stop()

    async def start(self) -> None:
        """Open the port; does nothing if it is started already.

        Raises:
            ConfigurationError: it cannot listen there.

        Cancellation: leaves it stopped.
        """
        if self._started:
            return
        try:
            self._address = await self._resolve()
            self._socket = self._bind()
            self._port = self._socket.getsockname()[1]
            await self._listener.serve(self._socket)
        except (OSError, ValueError, OverflowError) as exc:
            self._shut()
            raise ConfigurationError(
                f"emulator: cannot listen on {self.transport} {self.host}:{self._port}: {exc}"
            ) from exc
        except BaseException:
            self._shut()
            raise
        self._started = True
        self._down = False
        self._moved_at = self.clock.now
        self._arm()
        _log.info("= %s: listening on %s", self.name, self.url)

    async def stop(self) -> None:
        """Close the port and every connection; the device stands still. Does nothing if stopped.

        Cancellation: everything is closed nevertheless.
        """
        if self._started:
            self._started = False
            self._disarm()
            self._shut()
            opening, self._opening = self._opening, None
            if opening is not None:
                await asyncio.wait({opening})
            await self._listener.wait_closed()

    # ------------------------------------------------------------------ steps

    @contextmanager
    def step(self) -> Generator[None]:
        """Bring the device's time up, do the body, deliver what came of it, set the timer."""
        if not self._started:
            yield
            return
        self._move()
        try:
            yield
        finally:
            if self._started:
                self._settle()

    def received(self, link: Link, message: m.Message) -> None:
        """A link received a message; who has no session is heard with Connect only."""
        if isinstance(message, m.Connect):
            self._connect(link)
        elif link is self._active:
            self.device.handle(message)
            if isinstance(message, m.Disconnect):
                self._active = None
        self._collect()

    def serves(self, link: Link) -> bool:
        """Whether the link has the session."""
        return link is self._active

    def lost(self, link: Link) -> None:
        """A link is gone; if it had the session, that is over."""
        if link is self._active:
            self._active = None
            self.device.disconnect()

    def traced(self, link: Link, sender: m.Sender, what: Frame | RemoteProtocolError) -> None:
        """A machine saw a frame, or bytes that make none."""
        entry = self._traffic.add(self.clock.now, link.peer, sender, what)
        if _log.isEnabledFor(logging.DEBUG):
            mark = "!" if entry.error else "<" if entry.direction == "in" else ">"
            _log.debug("%s %s: %s", mark, link.peer, entry.error or entry.message or what)

    def _connect(self, link: Link) -> None:
        """Give the session to ``link``: the newcomer wins, unless a quirk says otherwise."""
        old = self._active
        if old is not None and old is not link:
            if self.transport == "tcp" and self.quirks.second_client == "refuse":
                link.close(f"{old.peer} has the session")
                return
            self._active = None
            self.device.disconnect()
            old.close(f"{link.peer} takes the session over")
        self._active = link
        self.device.handle(m.Connect())

    def _wake(self) -> None:
        self._timer = self._timer_at = None
        with self.step():
            pass

    def _move(self) -> None:
        now = self.clock.now
        passed, self._moved_at = now - self._moved_at, now
        self.device.tick(max(0.0, passed))

    def _collect(self) -> None:
        """Put what the device said into the active link's next write."""
        output = self.device.take_output()
        if self._active is not None:
            for message in output:
                self._active.say(message)

    def _settle(self) -> None:
        self._collect()
        if self._active is not None:
            self._active.flush()
        if self.device.rebooting and not self._down:
            self._go_down()
        elif self._down and not self.device.rebooting:
            self._come_up()
        self._arm()

    def _arm(self) -> None:
        """Set one timer for the device's next event."""
        delay = self.device.next_event_in()
        when = None if delay is None else self._moved_at + delay
        if when == self._timer_at:
            return
        self._disarm()
        if when is not None:
            self._timer, self._timer_at = self.clock.call_at(when, self._wake), when

    def _disarm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._timer_at = None

    # ------------------------------------------------------------------ the port

    async def _resolve(self) -> tuple[int, Any]:
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(self.host, self._port, type=self._listener.kind)
        return found[0][0], found[0][4]

    def _bind(self) -> socket.socket:
        family, address = self._address
        sock = socket.socket(family, self._listener.kind)
        try:
            sock.setblocking(False)
            if self._listener.kind is socket.SOCK_STREAM and os.name == "posix":
                # the camera comes up on its old port while old connections linger
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((address[0], self._port, *address[2:]))
            if self._listener.kind is socket.SOCK_STREAM:
                sock.listen(MAX_LINKS)
        except BaseException:
            sock.close()
            raise
        return sock

    def _go_down(self) -> None:
        """The camera restarts: every connection is lost, the port is shut."""
        _log.info("= %s: rebooting", self.name)
        self._down = True
        self._shut()

    def _come_up(self) -> None:
        """Open the port again, at once if possible."""
        _log.info("= %s: up again", self.name)
        self._down = False
        try:
            self._socket = self._bind()
        except OSError:
            self._socket = None  # another program took it, or the loop has not let go of it yet
        self._opening = asyncio.get_running_loop().create_task(
            self._reopen(), name=f"smartcam.emulator[{self.name}].reopen"
        )

    async def _reopen(self) -> None:
        while True:
            try:
                self._socket = self._socket or self._bind()
                await self._listener.serve(self._socket)
            except OSError as exc:
                _log.warning("! %s: port %d is not to be had: %s", self.name, self._port, exc)
                await asyncio.sleep(_RETRY)
            else:
                return

    def _shut(self) -> None:
        if self._opening is not None:
            self._opening.cancel()
        self._listener.shut()
        sock, self._socket = self._socket, None
        if sock is not None:
            sock.close()  # serves nothing yet, or is closed already


def _known(table: Any, what: str, name: str) -> Any:
    if name not in table:
        raise ConfigurationError(
            f"emulator: {what} {name!r} is unknown; known are {', '.join(table)}"
        )
    return table[name]


def _make_quirks(fields: dict[str, Any]) -> Quirks:
    try:
        return Quirks(**fields)
    except ValidationError as exc:
        raise ConfigurationError(f"quirks: {validation_text(exc)}") from exc


def _plan(
    scenario: Scenario | str | Path | None,
    applications: Iterable[Application | dict[str, Any]],
    given: dict[str, Any],
) -> Scenario:
    """Return the scenario with what was given beside it."""
    if scenario is None:
        base = Scenario()
    elif isinstance(scenario, Scenario):
        base = scenario
    else:
        base = load_scenario(scenario)
    changes = {key: value for key, value in given.items() if value is not None}
    added = [make_application(application) for application in applications]
    ids = {application.id for application in added}
    changes["applications"] = (*added, *(a for a in base.applications if a.id not in ids))
    return base.model_copy(update=changes)
