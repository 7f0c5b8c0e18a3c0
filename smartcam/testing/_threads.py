"""Emulated cameras in a thread with an event loop of its own.

Any test or program can use them: synchronous, with asyncio, with trio, or in another language. All
methods except one are synchronous and may be called in any thread::

    with ThreadedCamera(active=21, running=True) as emulator:
        socket.create_connection((emulator.host, emulator.port))
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

from smartcam._arguments import check_callable, check_flag, check_seconds, check_text
from smartcam._loop_thread import CALL_TIMEOUT, LoopThread
from smartcam.emulator import EmulatedCamera, EmulatedFleet, ManualClock
from smartcam.emulator._inside import check_options, emulated_class
from smartcam.exceptions import ConfigurationError, UnsupportedError
from smartcam.testing._logs import CameraLog

if TYPE_CHECKING:
    from types import TracebackType
    from typing import Self

    from smartcam.emulator import Scenario, TableScene, WireCamera
    from smartcam.emulator._inside import BaseFault, Device, EndedConnection, FiredFault
    from smartcam.emulator.faults import Fault
    from smartcam.protocols.messages import Message

T = TypeVar("T")


@dataclass(eq=False)
class _ThreadProxy:
    """Stands for an object: reads its attributes, and calls its methods, in another thread."""

    _thread: LoopThread
    _target: object

    def __getattr__(self, name: str) -> Any:
        value = self._thread.call_function(getattr, self._target, name)
        if not callable(value):
            return value
        return lambda *args, **kwargs: self._thread.call_function(value, *args, **kwargs)


@dataclass(eq=False, repr=False)
class _HostedInThread:
    """Base of objects that start and stop an emulator in a thread's event loop."""

    _thread: LoopThread
    _hosted: WireCamera | EmulatedFleet
    _owns_thread: bool  # True if the thread starts and ends with this object

    def start(self) -> None:
        """Start the object in the thread; do nothing if it runs.

        Raises:
            ConfigurationError: the server cannot listen; nothing is started.
        """
        if self._owns_thread:
            self._thread.start()
        try:
            self._thread.run_coroutine(self._hosted.start, CALL_TIMEOUT)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Stop the object in the thread; the log can still be read. Harmless when called twice."""
        try:
            self._thread.run_coroutine(self._hosted.stop, CALL_TIMEOUT)
        except ConfigurationError:
            return  # the object does not run
        finally:
            if self._owns_thread:
                self._thread.stop()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()


class ThreadedCamera(_HostedInThread):
    """An emulated camera in a thread; a context manager.

    ``scene``, ``scenario`` and ``wait_received`` with ids work for a BVS camera only.

    Args:
        protocol: name of a protocol that brings an emulated camera.
        manual_clock: True if the camera's time stands still until :meth:`advance` moves it.
        options: options of :class:`~smartcam.emulator.EmulatedCamera`, or of the class that the
            protocol brings.

    Attributes:
        log: the messages on the wire, with expectations.

    Raises:
        ConfigurationError: an argument is wrong; the error names the possible ones.
        UnsupportedError: the protocol brings no emulated camera.
    """

    def __init__(
        self, *, protocol: str = "bvs", manual_clock: bool = False, **options: Any
    ) -> None:
        protocol = check_text(protocol, "protocol", "ThreadedCamera", least=1, most=100)
        manual_clock = check_flag(manual_clock, "manual_clock", "ThreadedCamera")
        kind: Any = emulated_class(protocol)
        check_options(kind, options)
        emulator: WireCamera = kind(clock=ManualClock() if manual_clock else None, **options)
        self._set_up(LoopThread(f"smartcam.emulator[{emulator.name}]"), emulator, owns_thread=True)

    @classmethod
    def in_thread(cls, thread: LoopThread, emulator: WireCamera) -> Self:
        """Return the synchronous object for an emulator that runs in a thread already."""
        self = cls.__new__(cls)
        self._set_up(thread, emulator, owns_thread=False)
        return self

    def _set_up(self, thread: LoopThread, emulator: WireCamera, *, owns_thread: bool) -> None:
        super().__init__(thread, emulator, owns_thread)
        self._emulator: WireCamera = emulator
        self.log: CameraLog = CameraLog(
            read=lambda: self._call_in_thread(lambda: list(emulator.log)),
            ended_connections=lambda: self.ended_connections,
            links=lambda: self.links if self.transport == "tcp" else [],
            dropped_count=lambda: self._call_in_thread(lambda: emulator.log.dropped_count),
        )

    def __repr__(self) -> str:
        return f"<ThreadedCamera {self.name} {self.url}>"

    # ------------------------------------------------------------------ properties

    @property
    def url(self) -> str:
        """The camera's address with its dialect."""
        return self._emulator.url

    @property
    def host(self) -> str:
        """The address that the camera listens on."""
        return self._emulator.host

    @property
    def port(self) -> int:
        """The port that the camera listens on."""
        return self._emulator.port

    @property
    def transport(self) -> Literal["tcp", "udp"]:
        """``tcp`` or ``udp``."""
        return self._emulator.transport

    @property
    def dialect(self) -> str:
        """Name of the camera's wire dialect."""
        return self._emulator.dialect

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._emulator.name

    @property
    def seed(self) -> int:
        """Seed of all random numbers."""
        return self._emulator.seed

    @property
    def scenario(self) -> Scenario:
        """Scenario that the camera was made of."""
        return self._require_bvs("scenario").scenario

    @property
    def device(self) -> Device:
        """The camera itself; its methods and properties work in any thread."""
        return cast("Device", _ThreadProxy(self._thread, self._emulator.device))

    @property
    def scene(self) -> TableScene:
        """The table that the camera sees; ``scene.pieces`` may be changed in any thread."""
        return self._require_bvs("scene").scene

    @property
    def has_session(self) -> bool:
        """True while a client has the session."""
        return self._call_in_thread(lambda: self._emulator.has_session)

    @property
    def links(self) -> list[str]:
        """Address and port of all clients that are connected."""
        return self._call_in_thread(lambda: self._emulator.links)

    @property
    def ended_connections(self) -> list[EndedConnection]:
        """The last connections that have ended, oldest first; over UDP there are none."""
        return self._call_in_thread(lambda: list(self._emulator.ended_connections))

    @property
    def faults(self) -> list[Fault]:
        """The faults that have not happened yet."""
        return self._call_in_thread(lambda: self._emulator.faults)

    @property
    def fired(self) -> list[FiredFault]:
        """The last faults that have happened, oldest first."""
        return self._call_in_thread(lambda: list(self._emulator.fired))

    @property
    def commands(self) -> tuple[str, ...]:
        """The commands of the camera's timeline."""
        return self._emulator.commands

    @property
    def cue_counts(self) -> list[int]:
        """Number of times that each cue of the timeline has happened."""
        return self._call_in_thread(lambda: self._emulator.cue_counts)

    # ------------------------------------------------------------------ actions

    def inject(self, *faults: BaseFault | Mapping[str, Any]) -> None:
        """Add faults; as :meth:`~smartcam.emulator.EmulatedCamera.inject`."""
        self._thread.call_function(self._emulator.inject, *faults)

    def clear_faults(self) -> None:
        """Remove waiting faults, and end lasting ones."""
        self._thread.call_function(self._emulator.clear_faults)

    def command(self, name: str) -> None:
        """Give a command of the timeline.

        Raises:
            ConfigurationError: no cue has it.
        """
        self._thread.call_function(self._emulator.command, name)

    def advance(self, seconds: float) -> None:
        """Advance the camera's manual clock; all events until the new time have happened on return.

        Raises:
            ConfigurationError: the clock runs in real time, or the time is negative.
        """
        clock = self._emulator.clock
        if not isinstance(clock, ManualClock):
            raise ConfigurationError("the emulator runs in real time: give it manual_clock=True")
        self._thread.call_function(clock.advance, seconds)

    def run(self, function: Callable[..., T]) -> T:
        """Call ``function`` with the emulated camera, in its thread."""
        checked = check_callable(function, "function", "run")
        return self._thread.call_function(checked, self._emulator)

    def wait_received(
        self, what: int | type[Message], *, count: int = 1, timeout: float = 5.0
    ) -> None:
        """Wait until the device has handled ``count`` messages of a kind from clients.

        In a coroutine use :meth:`received`, since this method blocks the calling event loop.

        Raises:
            ResponseTimeoutError: the messages did not come in time.
        """
        timeout = check_seconds(timeout, "timeout", "wait_received")
        self._thread.run_coroutine(
            lambda: self._emulator.wait_received(what, count=count, timeout=timeout),
            timeout + CALL_TIMEOUT,
        )

    async def received(
        self, what: int | type[Message], *, count: int = 1, timeout: float = 5.0
    ) -> None:
        """Wait as :meth:`wait_received` does, in a coroutine of asyncio or, with anyio, of trio.

        Raises:
            ResponseTimeoutError: the messages did not come in time.

        Cancellation: safe.
        """
        work = self._emulator.wait_received(what, count=count, timeout=timeout)
        future = self._thread.submit(work)
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            import anyio.to_thread  # a test with trio and without asyncio has anyio

            await anyio.to_thread.run_sync(future.result, abandon_on_cancel=True)
        else:
            await asyncio.wrap_future(future)

    def _require_bvs(self, ability: str) -> EmulatedCamera:
        """Return the emulator; raise UnsupportedError if it is not an EmulatedCamera."""
        if isinstance(self._emulator, EmulatedCamera):
            return self._emulator
        raise UnsupportedError(f"{self._emulator!r} has no {ability}; an EmulatedCamera has")

    def _call_in_thread(self, function: Callable[[], T]) -> T:
        """Call a function in the emulator's thread, or in this thread if that one has ended."""
        try:
            return self._thread.call_function(function)
        except ConfigurationError:
            return function()


class ThreadedFleet(_HostedInThread, Mapping[str, ThreadedCamera]):
    """An :class:`~smartcam.emulator.EmulatedFleet` in a thread; a context manager.

    Args:
        scenarios: the path of a scenario file, or scenarios.
        options: options of :class:`~smartcam.emulator.EmulatedFleet`.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    def __init__(self, scenarios: Any, **options: Any) -> None:
        self._fleet = EmulatedFleet(scenarios, **options)
        super().__init__(LoopThread("smartcam.emulator[fleet]"), self._fleet, True)
        self._cameras = {
            name: ThreadedCamera.in_thread(self._thread, emulator)
            for name, emulator in self._fleet.cameras.items()
        }

    def __getitem__(self, name: str) -> ThreadedCamera:
        """Return a camera.

        Raises:
            KeyError: no camera has this name.
        """
        return self._cameras[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._cameras)

    def __len__(self) -> int:
        return len(self._cameras)

    @property
    def urls(self) -> dict[str, str]:
        """The cameras' addresses by name."""
        return self._fleet.urls
