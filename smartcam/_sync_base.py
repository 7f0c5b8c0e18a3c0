"""The base of ``smartcam.sync``: the thread of all cameras, and calls into it.

The methods that only call a method of the asynchronous camera are in ``sync.py``, which
``python -m scripts.write_sync`` writes from the signatures of that camera.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import functools
import os
import sys
import warnings
import weakref
from typing import TYPE_CHECKING, Any, Generic, ParamSpec, TypeVar, cast

from smartcam._arguments import check_seconds, check_seconds_or_none
from smartcam._loop_thread import LoopThread, start_task
from smartcam.exceptions import ConnectionClosedError, LocalProtocolError, ResponseTimeoutError
from smartcam.models import ValueT

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Generator, Iterator
    from types import TracebackType
    from typing import NoReturn, Self

    from smartcam.camera import Camera
    from smartcam.frames import Frame, FrameReader
    from smartcam.models import SubscriberStatistics
    from smartcam.settings import CameraSettings
    from smartcam.streams import BatchSubscription, Subscription

T = TypeVar("T")
P = ParamSpec("P")
ItemT = TypeVar("ItemT")

_cameras: weakref.WeakSet[SyncCameraBase[Any]] = weakref.WeakSet()  # open cameras
_threads: dict[str, LoopThread] = {}  # at most one


def _started_thread() -> LoopThread:
    """Return the thread of all cameras; the first camera starts it.

    Each process has one thread; a fork has its own. No lock is held, since a fork
    might inherit it. If two threads are started at once, one of them is ended again.
    """
    existing = _threads.get(_NAME)
    if existing is not None and existing.running:
        return existing
    new = LoopThread(_NAME)
    new.start()
    thread = _threads.setdefault(_NAME, new)
    if thread is not new:
        new.stop()
    return thread


_NAME = "smartcam.sync"

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_threads.clear)


@atexit.register
def _close_all() -> None:
    for camera in tuple(_cameras):
        with contextlib.suppress(Exception):
            camera.close()
    for thread in _threads.values():
        thread.stop()
    _threads.clear()


def _in_event_loop() -> bool:
    """Return True if this thread runs an event loop that waiting would block.

    A notebook has an event loop, too, but that loop does nothing while a cell runs.
    """
    if asyncio._get_running_loop() is None:  # noqa: SLF001 - in asyncio.__all__
        return False
    ipython = sys.modules.get("IPython")
    return ipython is None or cast("Any", ipython).get_ipython() is None


class SyncCameraBase(Generic[ValueT]):
    """The base of a camera without asyncio: all except the methods that ``write_sync`` writes.

    Args:
        camera: asynchronous camera that this class wraps, not opened yet.
    """

    def __init__(self, camera: Camera[ValueT]) -> None:
        self._camera = camera
        self._thread = _started_thread()

    # ------------------------------------------------------------------ life

    def open(self) -> Self:
        """Connect, as :meth:`smartcam.Camera.open` does."""
        camera, opened = self._camera, False

        async def open_camera() -> None:  # keeps no reference to this object
            nonlocal opened
            await camera.open()
            opened = True

        try:
            self._wait(open_camera)
            _cameras.add(self)
        except BaseException:
            if opened:  # Ctrl-C came after the camera was opened
                self._thread.post(lambda: _start_closing(camera.close()))
            raise
        return self

    def close(self) -> None:
        """Disconnect, as :meth:`smartcam.Camera.close` does. Idempotent."""
        self._wait(self._camera.close)
        _cameras.discard(self)

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
            self._thread.post(lambda: _start_closing(camera.close()))

    def __repr__(self) -> str:
        return f"<SyncCamera {self.name} {self.url}>"

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
        """The camera's address, with the dialect once it is known."""
        return self._camera.url

    # ------------------------------------------------------------------ inside

    def _wait(
        self, function: Callable[P, Coroutine[Any, Any, T]], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Run a coroutine, which has its own deadlines, in the event loop."""
        if _in_event_loop() and not self._thread.is_current_thread:
            raise LocalProtocolError(
                f"{self.name}: smartcam.sync would hold up the event loop that runs here; "
                f'in it: async with smartcam.connect("{self.url}") as camera'
            )
        return self._thread.run_coroutine(lambda: function(*args, **kwargs))

    def _do(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Call a function, which does not wait, in the event loop."""
        return self._thread.call_function(function, *args, **kwargs)

    def _subscribed(
        self, subscribe: Callable[P, Any], *args: P.args, **kwargs: P.kwargs
    ) -> SyncSubscription[Any]:
        # made in the loop's thread; if Ctrl-C keeps the caller from getting it, __del__ closes it
        return self._do(lambda: SyncSubscription(subscribe(*args, **kwargs), self._thread, self))

    @contextlib.contextmanager
    def _enter_in_loop(
        self,
        function: Callable[P, contextlib.AbstractAsyncContextManager[T]],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> Generator[T]:
        """Enter a context in the loop's thread, and leave it after the block, also after Ctrl-C."""
        context = _LoopContext(function(*args, **kwargs))
        try:
            yield self._wait(context.enter)
        except BaseException as exc:
            if context.is_entered:
                self._wait(functools.partial(context.leave, exc))
            raise
        else:
            self._wait(functools.partial(context.leave, None))
        finally:
            if context.is_entered:  # Ctrl-C came before leaving began
                self._thread.post(lambda: _start_closing(context.leave(None)))


class _LoopContext(Generic[T]):
    """A context that is entered and left in the loop's thread.

    Attributes:
        is_entered: True after the context was entered, until leaving it begins.
    """

    def __init__(self, context: contextlib.AbstractAsyncContextManager[T]) -> None:
        self._context = context
        self.is_entered: bool = False

    async def enter(self) -> T:
        """Enter the context."""
        value = await self._context.__aenter__()
        self.is_entered = True
        return value

    async def leave(self, exc: BaseException | None) -> None:
        """Leave the context; an error raised inside reaches the caller."""
        self.is_entered = False
        kind, trace = (None, None) if exc is None else (type(exc), exc.__traceback__)
        try:
            await self._context.__aexit__(kind, exc, trace)
        except BaseException as raised:
            if raised is not exc:
                raise


_closing: set[asyncio.Future[None]] = set()


def _start_closing(work: Coroutine[Any, Any, None]) -> None:
    """Start a coroutine that closes something; called in the loop's thread, it does not wait."""
    task = start_task(work)
    _closing.add(task)
    task.add_done_callback(_closing.discard)


class SyncSubscription(Generic[ItemT]):
    """A bounded stream of items: ``for item in subscription``, and ``with`` to close it.

    Like :class:`smartcam.streams.Subscription`, it subscribes when it is made, and offered items
    are always those taken, dropped and queued. If several threads iterate, each item goes to one.
    """

    def __init__(
        self,
        subscription: Subscription[ItemT] | BatchSubscription[Any],
        thread: LoopThread,
        camera: SyncCameraBase[Any],
    ) -> None:
        self._subscription = subscription
        self._thread = thread
        self._camera = camera  # lives as long as its subscriptions

    @property
    def ended(self) -> bool:
        """True once no more items will come."""
        return self._subscription.ended

    def statistics(self) -> SubscriberStatistics:
        """Return the numbers of offered, taken, dropped and queued items so far."""
        return self._thread.call_function(self._subscription.statistics)

    def close(self) -> None:
        """Unsubscribe; queued items count as dropped. Idempotent."""
        self._thread.call_function(self._subscription.close)

    def get(self, timeout: float) -> ItemT:
        """Return the next item.

        Args:
            timeout: seconds.

        Raises:
            ResponseTimeoutError: no item came in time.
            ConnectionClosedError: the stream has ended normally.
            SmartCamError: an item that is an error (the stream stays usable), or the stream's end.
        """
        check_seconds(timeout, "timeout", self._camera.name)
        try:
            return self._next(timeout)
        except StopIteration:
            raise ConnectionClosedError(
                f"{self._camera.name}: the subscription has ended, nothing more will come"
            ) from None

    def __iter__(self) -> Iterator[ItemT]:
        return self

    def __next__(self) -> ItemT:
        """Return the next item; wait until there is one or the stream ends.

        Raises:
            StopIteration: the subscription is closed.
            SmartCamError: an item that is an error (the stream stays usable), or the stream's end.
        """
        return self._next(None)

    def _next(self, timeout: float | None) -> ItemT:
        timeout = check_seconds_or_none(timeout, "timeout", self._camera.name)
        if _in_event_loop() and not self._thread.is_current_thread:
            raise LocalProtocolError(
                f"{self._camera.name}: smartcam.sync would hold up the event loop that runs here; "
                "in it: async for item in a stream of smartcam.connect(...)"
            )
        item = self._thread.run_coroutine(lambda: self._next_item(timeout))
        if item is _END:
            raise StopIteration
        return cast("ItemT", item)

    async def _next_item(self, timeout: float | None) -> Any:
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
        # posted, since only the loop's thread may change the subscribers
        self._thread.post(self._subscription.close)


class SyncFrameReaderBase:
    """The part of a synchronous frame reader that ``write_sync`` does not write.

    Args:
        reader: asynchronous reader that this class wraps.
        camera: camera of the frames.
    """

    def __init__(self, reader: FrameReader, camera: SyncCameraBase[Any]) -> None:
        self._reader = reader
        self._wait, self._do = camera._wait, camera._do  # noqa: SLF001 - as the camera's own part

    def __iter__(self) -> Iterator[Frame]:
        return self

    def __next__(self) -> Frame:
        """Return the newest frame that was not returned yet.

        Raises:
            StopIteration: the source ended normally.
            FrameTimeoutError: no frame came in time; the next call waits again.
            FrameSourceError: the source has failed.
        """
        frame = self._wait(self._next_item)
        if frame is None:
            raise StopIteration
        return frame

    async def _next_item(self) -> Frame | None:
        return await anext(self._reader, None)


_END: Any = object()
