"""Cameras without asyncio: the same methods, which return when they are done.

::

    with smartcam.sync.connect("bvs://192.168.0.10", interpret_as="localizations") as camera:
        print(camera.trigger().value)

One thread of the process has an event loop for all cameras; the calls of any other thread are done
there. Names, outcomes, timeouts and accounts are those of :class:`smartcam.Camera`, and a test
holds the signatures against it.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import sys
import threading
import warnings
import weakref
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, overload

from smartcam._loop_thread import LoopThread
from smartcam.camera import (
    DEFAULT_MAX_QUEUE,
    DEFAULT_MAX_QUEUE_BYTES,
    DEFAULT_RECONNECT_TIMEOUT,
    DEFAULT_TRIGGER_TIMEOUT,
    FRAME_TIMEOUT,
    Camera,
)
from smartcam.connecting import connect as connect_async
from smartcam.exceptions import ConnectionClosedError, LocalProtocolError, ResponseTimeoutError
from smartcam.models import ValueT

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Generator, Iterable, Iterator
    from datetime import datetime
    from types import TracebackType
    from typing import Literal, NoReturn, Self, Unpack

    from smartcam.camera import FrameEncoding, StreamEncoding
    from smartcam.frames import Frame, FrameReader, ReaderStatistics
    from smartcam.interpreters._base import AnySpec, TypedSpec
    from smartcam.models import (
        CameraEvent,
        Capabilities,
        Localization,
        Result,
        Statistics,
        Status,
        SubscriberStatistics,
    )
    from smartcam.observers import Observer
    from smartcam.settings import CameraOptions, CameraSettings, OtherOptions
    from smartcam.streams import BatchSubscription, Subscription

__all__ = ["SyncCamera", "SyncFrameReader", "SyncSubscription", "connect"]

T = TypeVar("T")
ItemT = TypeVar("ItemT")

_starting = threading.Lock()
_cameras: weakref.WeakSet[SyncCamera[Any]] = weakref.WeakSet()  # that are open
_thread = LoopThread("smartcam.sync")


def _started_thread() -> LoopThread:
    """Return the thread of all cameras, which is started where a camera is first made."""
    global _thread  # one of a process; in a fork of it a new one
    with _starting:
        if not _thread.running:
            _thread = LoopThread("smartcam.sync")
            _thread.start()
        return _thread


@atexit.register
def _close_all() -> None:
    for camera in tuple(_cameras):
        with contextlib.suppress(Exception):
            camera.close()
    if _thread.running:
        _thread.stop()


def _in_event_loop() -> bool:
    """Return whether waiting here would hold up an event loop that runs in this thread.

    A notebook has one, too, which does nothing while a cell runs.
    """
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return False
    ipython = sys.modules.get("IPython")
    return ipython is None or cast("Any", ipython).get_ipython() is None


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    interpret_as: None = None,
    **options: Unpack[OtherOptions],
) -> SyncCamera[bytes]: ...


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    interpret_as: Literal["localizations"],
    **options: Unpack[OtherOptions],
) -> SyncCamera[list[Localization]]: ...


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    interpret_as: AnySpec,
    **options: Unpack[OtherOptions],
) -> SyncCamera[Any]: ...


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    interpret_as: TypedSpec[T],
    **options: Unpack[OtherOptions],
) -> SyncCamera[T]: ...


@overload
def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    **options: Unpack[CameraOptions],
) -> SyncCamera[Any]: ...


def connect(
    url: str,
    *,
    model: str | None = None,
    observers: Iterable[Observer] = (),
    **options: Unpack[CameraOptions],
) -> SyncCamera[Any]:
    """Return a camera to be opened with ``with`` (or :meth:`SyncCamera.open`).

    Everything is as for :func:`smartcam.connect`. Observers, predicates and interpreters are called
    in the thread of the event loop.

    Raises:
        ConfigurationError: an address or option cannot work; nothing was tried.
    """
    return SyncCamera(connect_async(url, model=model, observers=observers, **options))


class SyncCamera(Generic[ValueT]):
    """A :class:`~smartcam.Camera` for programs without asyncio; made by :func:`connect`.

    Any thread may call any method, at the same time as others. A call raises
    :exc:`~smartcam.LocalProtocolError` in an event loop (there the async form is at hand), in a
    predicate or observer, and in a fork of the process that made the camera. Ctrl-C ends any call
    as a cancellation does, of which each method of :class:`~smartcam.Camera` tells.

    Args:
        camera: what it is the face of, not opened yet.
    """

    def __init__(self, camera: Camera[ValueT]) -> None:
        self._camera = camera
        self._thread = _started_thread()

    # ------------------------------------------------------------------ life

    def open(self) -> Self:
        """Connect: :meth:`smartcam.Camera.open`."""
        self._wait(self._camera.open)
        _cameras.add(self)
        return self

    def close(self) -> None:
        """Disconnect; idempotent: :meth:`smartcam.Camera.close`."""
        self._wait(self._camera.close)
        _cameras.discard(self)

    def wait_connected(self, timeout: float = DEFAULT_RECONNECT_TIMEOUT) -> None:
        """Wait until there is a session: :meth:`smartcam.Camera.wait_connected`."""
        self._wait(lambda: self._camera.wait_connected(timeout))

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()

    def __aenter__(self) -> NoReturn:
        raise TypeError("smartcam.sync is without asyncio: async with smartcam.connect(...)")

    async def __aexit__(self, *_: object) -> None: ...

    def __del__(self) -> None:
        if self in _cameras and self._thread.running:
            warnings.warn(f"{self!r} was not closed", ResourceWarning, source=self, stacklevel=2)
            camera = self._camera
            self._thread.post(lambda: _keep(asyncio.ensure_future(camera.close())))

    def __repr__(self) -> str:
        return f"<SyncCamera {self.name} {self.url}>"

    # ------------------------------------------------------------------ what is known

    @property
    def settings(self) -> CameraSettings:
        """The validated options."""
        return self._camera.settings

    @property
    def name(self) -> str:
        """The camera's name in logs and results."""
        return self._camera.name

    @property
    def url(self) -> str:
        """Its address, with the dialect pinned once it was found out."""
        return self._camera.url

    @property
    def connected(self) -> bool:
        """Whether there is a session."""
        return self._camera.connected

    @property
    def status(self) -> Status:
        """The last status: :attr:`smartcam.Camera.status`."""
        return self._camera.status

    @property
    def active_application(self) -> int | None:
        """The active application: :attr:`smartcam.Camera.active_application`."""
        return self._camera.active_application

    @property
    def protocol_version(self) -> int | None:
        """Version from the answer to Connect; None before ``open()``."""
        return self._camera.protocol_version

    @property
    def capabilities(self) -> Capabilities:
        """What it can do: :attr:`smartcam.Camera.capabilities`."""
        return self._camera.capabilities

    def statistics(self) -> Statistics:
        """Return everything counted so far: :meth:`smartcam.Camera.statistics`."""
        return self._do(self._camera.statistics)

    # ------------------------------------------------------------------ streams and waits

    @overload
    def results(
        self,
        *,
        batch: Literal[False] = False,
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        max_queue_bytes: int = DEFAULT_MAX_QUEUE_BYTES,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> SyncSubscription[Result[ValueT]]: ...

    @overload
    def results(
        self,
        *,
        batch: Literal[True],
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        max_queue_bytes: int = DEFAULT_MAX_QUEUE_BYTES,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> SyncSubscription[list[Result[ValueT]]]: ...

    def results(
        self,
        *,
        batch: bool = False,
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        max_queue_bytes: int = DEFAULT_MAX_QUEUE_BYTES,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> SyncSubscription[Any]:
        """Subscribe to everything the camera sends: :meth:`smartcam.Camera.results`."""
        subscribe = cast("Callable[..., Subscription[Any]]", self._camera.results)
        return self._subscribed(
            lambda: subscribe(
                batch=batch,
                min_interval=min_interval,
                max_queue=max_queue,
                max_queue_bytes=max_queue_bytes,
                overflow=overflow,
            )
        )

    def statuses(
        self,
        *,
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> SyncSubscription[Status]:
        """Subscribe to every status: :meth:`smartcam.Camera.statuses`."""
        return self._subscribed(
            lambda: self._camera.statuses(
                min_interval=min_interval, max_queue=max_queue, overflow=overflow
            )
        )

    def events(
        self,
        *,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> SyncSubscription[CameraEvent]:
        """Subscribe to what happens to the camera: :meth:`smartcam.Camera.events`."""
        return self._subscribed(lambda: self._camera.events(max_queue=max_queue, overflow=overflow))

    def wait_status(self, predicate: Callable[[Status], bool], timeout: float = 10.0) -> Status:
        """Return the first status that is accepted: :meth:`smartcam.Camera.wait_status`."""
        return self._wait(lambda: self._camera.wait_status(predicate, timeout))

    def wait_ready(self, timeout: float = 10.0) -> Status:
        """Wait until it is not BUSY: :meth:`smartcam.Camera.wait_ready`."""
        return self._wait(lambda: self._camera.wait_ready(timeout))

    def next_result(self, *, timeout: float = DEFAULT_TRIGGER_TIMEOUT) -> Result[ValueT]:
        """Wait for the next result, whoever triggers it: :meth:`smartcam.Camera.next_result`.

        Where what causes it is started by the same thread, subscribe first::

            with camera.results() as results:
                start_conveyor()
                result = results.get(timeout=5)
        """
        return self._wait(lambda: self._camera.next_result(timeout=timeout))

    # ------------------------------------------------------------------ commands

    @overload
    def trigger(
        self,
        application: int | None = None,
        *,
        interpret_as: None = None,
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: None = None,
    ) -> Result[ValueT]: ...

    @overload
    def trigger(
        self,
        application: int | None = None,
        *,
        interpret_as: None = None,
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: int,
    ) -> list[Result[ValueT]]: ...

    @overload
    def trigger(
        self,
        application: int | None = None,
        *,
        interpret_as: Literal["localizations"],
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: None = None,
    ) -> Result[list[Localization]]: ...

    @overload
    def trigger(
        self,
        application: int | None = None,
        *,
        interpret_as: Literal["localizations"],
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: int,
    ) -> list[Result[list[Localization]]]: ...

    @overload
    def trigger(
        self,
        application: int | None = None,
        *,
        interpret_as: AnySpec,
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: None = None,
    ) -> Result[Any]: ...

    @overload
    def trigger(
        self,
        application: int | None = None,
        *,
        interpret_as: AnySpec,
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: int,
    ) -> list[Result[Any]]: ...

    @overload
    def trigger(
        self,
        application: int | None = None,
        *,
        interpret_as: TypedSpec[T],
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: None = None,
    ) -> Result[T]: ...

    @overload
    def trigger(
        self,
        application: int | None = None,
        *,
        interpret_as: TypedSpec[T],
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: int,
    ) -> list[Result[T]]: ...

    def trigger(
        self,
        application: int | None = None,
        *,
        interpret_as: Any = None,
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: int | None = None,
    ) -> Any:
        """Trigger one inspection and return its result: :meth:`smartcam.Camera.trigger`."""
        trigger = cast("Callable[..., Coroutine[Any, Any, Any]]", self._camera.trigger)
        return self._wait(
            lambda: trigger(
                application,
                interpret_as=interpret_as,
                input=input,
                timeout=timeout,
                when_busy=when_busy,
                results_per_trigger=results_per_trigger,
            )
        )

    def switch_application(self, application: int | str, *, timeout: float | None = None) -> None:
        """Load another application: :meth:`smartcam.Camera.switch_application`."""
        self._wait(lambda: self._camera.switch_application(application, timeout=timeout))

    @contextlib.contextmanager
    def application(self, application: int) -> Generator[Self]:
        """Have an application running inside the ``with``, then go back to the one before.

        As :meth:`smartcam.Camera.application`.
        """
        inside = self._camera.application(application)
        self._wait(inside.__aenter__)
        try:
            yield self
        except BaseException as exc:
            self._leave(inside, exc)
            raise
        self._leave(inside, None)

    def start(self, *, timeout: float = 10.0) -> None:
        """Enter run mode: :meth:`smartcam.Camera.start`."""
        self._wait(lambda: self._camera.start(timeout=timeout))

    def stop(self, *, timeout: float = 10.0) -> None:
        """Leave run mode: :meth:`smartcam.Camera.stop`."""
        self._wait(lambda: self._camera.stop(timeout=timeout))

    def query_application(self, *, timeout: float | None = None) -> int:
        """Ask which application is active: :meth:`smartcam.Camera.query_application`."""
        return self._wait(lambda: self._camera.query_application(timeout=timeout))

    def query_status(self, *, timeout: float | None = None) -> Status:
        """Ask for the status: :meth:`smartcam.Camera.query_status`."""
        return self._wait(lambda: self._camera.query_status(timeout=timeout))

    def reset_errors(self, *, timeout: float | None = None) -> Status:
        """Clear error bits: :meth:`smartcam.Camera.reset_errors`."""
        return self._wait(lambda: self._camera.reset_errors(timeout=timeout))

    def read_image(self, *, timeout: float | None = None) -> bytes:
        """Return the last picture: :meth:`smartcam.Camera.read_image`."""
        return self._wait(lambda: self._camera.read_image(timeout=timeout))

    @contextlib.contextmanager
    def frames(
        self,
        *,
        encoding: StreamEncoding = "raw",
        quality: int | None = None,
        bitrate: float | None = None,
        latency: float | None = None,
        decode: bool = True,
        timeout: float | None = FRAME_TIMEOUT,
    ) -> Generator[SyncFrameReader]:
        """Read what the camera sees, in a ``with``: :meth:`smartcam.Camera.frames`."""
        inside = self._camera.frames(
            encoding=encoding,
            quality=quality,
            bitrate=bitrate,
            latency=latency,
            decode=decode,
            timeout=timeout,
        )
        reader = self._wait(inside.__aenter__)
        try:
            yield SyncFrameReader(reader, self)
        except BaseException as exc:
            self._leave(inside, exc)
            raise
        self._leave(inside, None)

    def newest_frame(
        self,
        *,
        max_age: float = 1.0,
        encoding: FrameEncoding = "raw",
        quality: int | None = None,
        timeout: float = FRAME_TIMEOUT,
    ) -> Frame:
        """Return the newest frame: :meth:`smartcam.Camera.newest_frame`."""
        return self._wait(
            lambda: self._camera.newest_frame(
                max_age=max_age, encoding=encoding, quality=quality, timeout=timeout
            )
        )

    def frame_after(
        self,
        moment: float | None = None,
        *,
        encoding: FrameEncoding = "raw",
        quality: int | None = None,
        timeout: float = FRAME_TIMEOUT,
    ) -> Frame:
        """Return the first frame exposed after a moment: :meth:`smartcam.Camera.frame_after`."""
        return self._wait(
            lambda: self._camera.frame_after(
                moment, encoding=encoding, quality=quality, timeout=timeout
            )
        )

    def get_clock(self, *, timeout: float | None = None) -> datetime:
        """Return the camera's clock: :meth:`smartcam.Camera.get_clock`."""
        return self._wait(lambda: self._camera.get_clock(timeout=timeout))

    def set_clock(self, when: datetime) -> None:
        """Set the camera's clock: :meth:`smartcam.Camera.set_clock`."""
        self._wait(lambda: self._camera.set_clock(when))

    def set_input(self, data: bytes) -> None:
        """Send input data for the next inspection: :meth:`smartcam.Camera.set_input`."""
        self._wait(lambda: self._camera.set_input(data))

    def set_sequence_number(self, number: int) -> None:
        """Set the number of the next run: :meth:`smartcam.Camera.set_sequence_number`."""
        self._wait(lambda: self._camera.set_sequence_number(number))

    def reboot(self) -> None:
        """Restart the camera: :meth:`smartcam.Camera.reboot`."""
        self._wait(self._camera.reboot)

    def request(
        self,
        message_id: int | str,
        payload: bytes = b"",
        *,
        answered: bool | None = None,
        timeout: float | None = None,
    ) -> bytes | None:
        """Send any message: :meth:`smartcam.Camera.request`."""
        return self._wait(
            lambda: self._camera.request(message_id, payload, answered=answered, timeout=timeout)
        )

    # ------------------------------------------------------------------ inside

    def _wait(self, function: Callable[[], Coroutine[Any, Any, T]]) -> T:
        """Do something in the event loop; it has deadlines of its own."""
        if _in_event_loop() and not self._thread.inside:
            raise LocalProtocolError(
                f"{self.name}: smartcam.sync would hold up the event loop that runs here; "
                f'in it: async with smartcam.connect("{self.url}") as camera'
            )
        return self._thread.call(function)

    def _do(self, function: Callable[[], T]) -> T:
        """Do something in the event loop that does not wait."""
        return self._thread.run(function)

    def _subscribed(self, subscribe: Callable[[], Any]) -> SyncSubscription[Any]:
        return SyncSubscription(self._do(subscribe), self._thread, self)

    def _leave(
        self, inside: contextlib.AbstractAsyncContextManager[Any], exc: BaseException | None
    ) -> None:
        kind = None if exc is None else type(exc)
        trace = None if exc is None else exc.__traceback__
        self._wait(lambda: _exit(inside, kind, exc, trace))


async def _exit(
    inside: contextlib.AbstractAsyncContextManager[Any],
    kind: type[BaseException] | None,
    exc: BaseException | None,
    trace: TracebackType | None,
) -> None:
    """Leave a context; what was raised inside is raised by who called."""
    try:
        await inside.__aexit__(kind, exc, trace)
    except BaseException as raised:
        if raised is not exc:
            raise


_closing: set[asyncio.Future[None]] = set()


def _keep(task: asyncio.Future[None]) -> None:
    _closing.add(task)
    task.add_done_callback(_closing.discard)


class SyncSubscription(Generic[ItemT]):
    """A bounded stream of items: ``for item in subscription``, and ``with`` to close it.

    As :class:`smartcam.streams.Subscription`: it subscribes when it is made, and its account always
    balances. One thread takes each item.
    """

    def __init__(
        self,
        subscription: Subscription[ItemT] | BatchSubscription[Any],
        thread: LoopThread,
        camera: SyncCamera[Any],
    ) -> None:
        self._subscription = subscription
        self._thread = thread
        self._camera = camera  # lives as long as somebody listens

    @property
    def ended(self) -> bool:
        """Whether nothing more will come."""
        return self._subscription.ended

    def statistics(self) -> SubscriberStatistics:
        """Return the account as it is now."""
        return self._thread.run(self._subscription.statistics)

    def close(self) -> None:
        """Unsubscribe; what is queued counts as dropped. Idempotent."""
        self._thread.run(self._subscription.close)

    def get(self, timeout: float) -> ItemT:
        """Return the next item.

        Args:
            timeout: seconds.

        Raises:
            ResponseTimeoutError: none came in time.
            ConnectionClosedError: the stream has ended in order.
            SmartCamError: an item that is an error (the stream stays usable), or how it ended.
        """
        try:
            return self._next(timeout)
        except StopIteration:
            raise ConnectionClosedError(
                f"{self._camera.name}: the subscription has ended, nothing more will come"
            ) from None

    def __iter__(self) -> Iterator[ItemT]:
        return self

    def __next__(self) -> ItemT:
        """Return the next item; waits as long as the stream lives.

        Raises:
            StopIteration: closed.
            SmartCamError: an item that is an error (the stream stays usable), or how it ended.
        """
        return self._next(None)

    def _next(self, timeout: float | None) -> ItemT:
        if _in_event_loop() and not self._thread.inside:
            raise LocalProtocolError(
                f"{self._camera.name}: smartcam.sync would hold up the event loop that runs here; "
                "in it: async for item in a stream of smartcam.connect(...)"
            )
        item = self._thread.call(lambda: self._take(timeout))
        if item is _END:
            raise StopIteration
        return cast("ItemT", item)

    async def _take(self, timeout: float | None) -> Any:
        try:
            async with asyncio.timeout(timeout):
                return await anext(self._subscription)
        except StopAsyncIteration:
            return _END
        except TimeoutError as exc:
            raise ResponseTimeoutError(
                f"{self._camera.name}: nothing came within {timeout:g} s",
                message_id=None,
                waited=timeout or 0.0,
            ) from exc

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()

    def __del__(self) -> None:
        # in the loop's thread, which goes through the subscribers
        self._thread.post(self._subscription.close)


class SyncFrameReader:
    """A reader of frames: ``for frame in frames``; as :class:`smartcam.frames.FrameReader`."""

    def __init__(self, reader: FrameReader, camera: SyncCamera[Any]) -> None:
        self._reader, self._camera = reader, camera

    def statistics(self) -> ReaderStatistics:
        """Return the account as it is now."""
        return self._camera._do(self._reader.statistics)  # noqa: SLF001 - the two are one

    def newest(self, *, max_age: float = 1.0, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the newest frame: :meth:`smartcam.frames.FrameReader.newest`."""
        return self._camera._wait(  # noqa: SLF001
            lambda: self._reader.newest(max_age=max_age, timeout=timeout)
        )

    def after(self, moment: float, *, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the first frame after a moment: :meth:`smartcam.frames.FrameReader.after`."""
        return self._camera._wait(  # noqa: SLF001
            lambda: self._reader.after(moment, timeout=timeout)
        )

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        """Return the newest frame that was not returned yet.

        Raises:
            StopIteration: the source ended in order.
            FrameTimeoutError: none came in time; it may be waited for again.
            FrameSourceError: how the source ended.
        """
        frame = self._camera._wait(self._take)  # noqa: SLF001
        if frame is None:
            raise StopIteration
        return frame

    async def _take(self) -> Frame | None:
        return await anext(self._reader, None)


_END: Any = object()
