"""Cameras without asyncio: the same methods, which return when they are done.

::

    with smartcam.sync.connect("bvs://192.168.0.10", interpret_as="localizations") as camera:
        print(camera.trigger().value)

One thread of the process has an event loop for all cameras; the calls of any other thread are done
there. Names, outcomes, timeouts and accounts are those of :class:`smartcam.Camera`, from which this
module is written by ``python -m scripts.write_sync``.
"""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, TypeVar, overload

from smartcam._sync_base import SyncCameraBase, SyncFrameReaderBase, SyncSubscription
from smartcam.camera import (
    DEFAULT_MAX_QUEUE,
    DEFAULT_MAX_QUEUE_BYTES,
    DEFAULT_RECONNECT_TIMEOUT,
    DEFAULT_TRIGGER_TIMEOUT,
    FRAME_TIMEOUT,
)
from smartcam.connecting import connect as connect_async
from smartcam.models import ValueT

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable
    from datetime import datetime
    from typing import Literal, Self, Unpack

    from smartcam.camera import FrameEncoding, StreamEncoding
    from smartcam.exceptions import SmartCamError
    from smartcam.fleet import FleetFrame
    from smartcam.frames import Frame
    from smartcam.frames._inside import ReaderStatistics
    from smartcam.interpreters._inside import AnySpec, TypedSpec
    from smartcam.models import (
        CameraEvent,
        Capabilities,
        Localization,
        Result,
        Statistics,
        Status,
    )
    from smartcam.observers import Observer
    from smartcam.settings import CameraOptions, OtherOptions

__all__ = ["SyncCamera", "SyncFrameReader", "SyncSubscription", "connect"]

T = TypeVar("T")


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
    interpret_as: Literal["raw"],
    **options: Unpack[OtherOptions],
) -> SyncCamera[bytes]: ...


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


class SyncCamera(SyncCameraBase[ValueT]):
    """A :class:`~smartcam.Camera` for programs without asyncio; made by :func:`connect`.

    Any thread may call any method, at the same time as others. A call raises
    :exc:`~smartcam.LocalProtocolError` in an event loop (there the async form is at hand), in a
    predicate or observer, and in a fork of the process that made the camera. Ctrl-C ends any call
    as a cancellation does, of which each method of :class:`~smartcam.Camera` tells.

    Args:
        camera: asynchronous camera that this class wraps, not opened yet.
    """

    def wait_connected(self, timeout: float = DEFAULT_RECONNECT_TIMEOUT) -> None:
        """Wait until there is a session, and the camera has the state that ``restore`` asks for.

        As :meth:`smartcam.Camera.wait_connected`.
        """
        self._wait(self._camera.wait_connected, timeout)

    @property
    def connected(self) -> bool:
        """True while there is a session, as :attr:`smartcam.Camera.connected`."""
        return self._camera.connected

    @property
    def trouble(self) -> SmartCamError | None:
        """The error that a call would raise now, as :attr:`smartcam.Camera.trouble`."""
        return self._camera.trouble

    @property
    def status(self) -> Status:
        """The last status the camera sent, also after the session was lost.

        As :attr:`smartcam.Camera.status`.
        """
        return self._camera.status

    @property
    def active_application(self) -> int | None:
        """Id of the active application as last reported by the camera.

        As :attr:`smartcam.Camera.active_application`.
        """
        return self._camera.active_application

    @property
    def protocol_version(self) -> int | None:
        """Version from the answer to Connect, as :attr:`smartcam.Camera.protocol_version`."""
        return self._camera.protocol_version

    @property
    def capabilities(self) -> Capabilities:
        """The abilities of the camera in the dialect that it speaks.

        As :attr:`smartcam.Camera.capabilities`.
        """
        return self._camera.capabilities

    def statistics(self) -> Statistics:
        """Return all counters, over all sessions: :meth:`smartcam.Camera.statistics`."""
        return self._do(self._camera.statistics)

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
    ) -> Any:
        """Subscribe to every result, triggered or not: :meth:`smartcam.Camera.results`."""
        results: Callable[..., Any] = self._camera.results
        return self._subscribed(
            results,
            batch=batch,
            min_interval=min_interval,
            max_queue=max_queue,
            max_queue_bytes=max_queue_bytes,
            overflow=overflow,
        )

    def statuses(
        self,
        *,
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> SyncSubscription[Status]:
        """Subscribe to every status the camera sends from now on.

        As :meth:`smartcam.Camera.statuses`.
        """
        return self._subscribed(
            self._camera.statuses, min_interval=min_interval, max_queue=max_queue, overflow=overflow
        )

    def events(
        self,
        *,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> SyncSubscription[CameraEvent]:
        """Subscribe to the camera's events, in order: :meth:`smartcam.Camera.events`."""
        return self._subscribed(self._camera.events, max_queue=max_queue, overflow=overflow)

    def wait_status(self, predicate: Callable[[Status], bool], timeout: float = 10.0) -> Status:
        """Return the first status that ``predicate`` accepts, beginning with the present status.

        As :meth:`smartcam.Camera.wait_status`.
        """
        return self._wait(self._camera.wait_status, predicate, timeout)

    def wait_ready(self, timeout: float = 10.0) -> Status:
        """Wait until the camera is not BUSY, and is Running if it was started.

        As :meth:`smartcam.Camera.wait_ready`.
        """
        return self._wait(self._camera.wait_ready, timeout)

    def next_result(self, *, timeout: float = DEFAULT_TRIGGER_TIMEOUT) -> Result[ValueT]:
        """Wait for the next result, whatever triggers it: :meth:`smartcam.Camera.next_result`.

        If the same thread starts what causes the result, subscribe first::

            with camera.results() as results:
                start_conveyor()
                result = results.get(timeout=5)
        """
        return self._wait(self._camera.next_result, timeout=timeout)

    @overload
    def trigger(
        self,
        application: int | str | None = None,
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
        application: int | str | None = None,
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
        application: int | str | None = None,
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
        application: int | str | None = None,
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
        application: int | str | None = None,
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
        application: int | str | None = None,
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
        application: int | str | None = None,
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
        application: int | str | None = None,
        *,
        interpret_as: TypedSpec[T],
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: int,
    ) -> list[Result[T]]: ...

    def trigger(
        self,
        application: int | str | None = None,
        *,
        interpret_as: object = None,
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: int | None = None,
    ) -> Any:
        """Trigger one inspection and return its result: :meth:`smartcam.Camera.trigger`."""
        trigger: Callable[..., Any] = self._camera.trigger
        return self._wait(
            trigger,
            application,
            interpret_as=interpret_as,
            input=input,
            timeout=timeout,
            when_busy=when_busy,
            results_per_trigger=results_per_trigger,
        )

    def switch_application(self, application: int | str, *, timeout: float | None = None) -> None:
        """Load another application, and wait until the camera is ready.

        As :meth:`smartcam.Camera.switch_application`.
        """
        self._wait(self._camera.switch_application, application, timeout=timeout)

    @contextlib.contextmanager
    def application(self, application: int | str) -> Generator[Self]:
        """Run an application inside the ``with``, then return to the previous application.

        As :meth:`smartcam.Camera.application`.
        """
        with self._enter_in_loop(self._camera.application, application):
            yield self

    def start(self, *, timeout: float = 10.0) -> None:
        """Enter run mode: :meth:`smartcam.Camera.start`."""
        self._wait(self._camera.start, timeout=timeout)

    def stop(self, *, timeout: float = 10.0) -> None:
        """Leave run mode: :meth:`smartcam.Camera.stop`."""
        self._wait(self._camera.stop, timeout=timeout)

    def query_application(self, *, timeout: float | None = None) -> int:
        """Ask the camera which application is active: :meth:`smartcam.Camera.query_application`."""
        return self._wait(self._camera.query_application, timeout=timeout)

    def query_status(self, *, timeout: float | None = None) -> Status:
        """Ask the camera for its status: :meth:`smartcam.Camera.query_status`."""
        return self._wait(self._camera.query_status, timeout=timeout)

    def reset_errors(self, *, timeout: float | None = None) -> Status:
        """Clear the error bits that stay set until a reset.

        As :meth:`smartcam.Camera.reset_errors`.
        """
        return self._wait(self._camera.reset_errors, timeout=timeout)

    def read_image(self, *, timeout: float | None = None) -> bytes:
        """Return the last picture, as a file's bytes: :meth:`smartcam.Camera.read_image`."""
        return self._wait(self._camera.read_image, timeout=timeout)

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
        """Read the camera's frames: :meth:`smartcam.Camera.frames`."""
        with self._enter_in_loop(
            self._camera.frames,
            encoding=encoding,
            quality=quality,
            bitrate=bitrate,
            latency=latency,
            decode=decode,
            timeout=timeout,
        ) as reader:
            yield SyncFrameReader(reader, self)

    def newest_frame(
        self,
        *,
        max_age: float = 1.0,
        encoding: FrameEncoding = "raw",
        quality: int | None = None,
        timeout: float = FRAME_TIMEOUT,
    ) -> FleetFrame:
        """Return the newest frame: :meth:`smartcam.Camera.newest_frame`."""
        return self._wait(
            self._camera.newest_frame,
            max_age=max_age,
            encoding=encoding,
            quality=quality,
            timeout=timeout,
        )

    def frame_after(
        self,
        moment: float | None = None,
        *,
        encoding: FrameEncoding = "raw",
        quality: int | None = None,
        timeout: float = FRAME_TIMEOUT,
    ) -> FleetFrame:
        """Return the first frame whose exposure began after ``moment``, or after this call.

        As :meth:`smartcam.Camera.frame_after`.
        """
        return self._wait(
            self._camera.frame_after, moment, encoding=encoding, quality=quality, timeout=timeout
        )

    @contextlib.contextmanager
    def reserve(self, timeout: float = 10.0) -> Generator[Self]:
        """Keep the commands of other programs out while the body of the block runs.

        As :meth:`smartcam.Camera.reserve`.
        """
        with self._enter_in_loop(self._camera.reserve, timeout):
            yield self

    def take_back(self, *, timeout: float | None = None) -> None:
        """Make the agent take the camera back from another client, and wait for the session.

        As :meth:`smartcam.Camera.take_back`.
        """
        self._wait(self._camera.take_back, timeout=timeout)

    def get_clock(self, *, timeout: float | None = None) -> datetime:
        """Return the camera's clock: :meth:`smartcam.Camera.get_clock`."""
        return self._wait(self._camera.get_clock, timeout=timeout)

    def set_clock(self, when: datetime) -> None:
        """Set the camera's clock to the fields of ``when``: :meth:`smartcam.Camera.set_clock`."""
        self._wait(self._camera.set_clock, when)

    def set_input(self, data: bytes) -> None:
        """Send input data for the next inspection: :meth:`smartcam.Camera.set_input`."""
        self._wait(self._camera.set_input, data)

    def set_sequence_number(self, number: int) -> None:
        """Set the number of the next run (0 to 4294967295).

        As :meth:`smartcam.Camera.set_sequence_number`.
        """
        self._wait(self._camera.set_sequence_number, number)

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
            self._camera.request, message_id, payload, answered=answered, timeout=timeout
        )


class SyncFrameReader(SyncFrameReaderBase):
    """A reader of frames: ``for frame in frames``; as :class:`smartcam.frames.FrameReader`."""

    def statistics(self) -> ReaderStatistics:
        """Return the current counts: :meth:`smartcam.frames.FrameReader.statistics`."""
        return self._do(self._reader.statistics)

    def newest(self, *, max_age: float = 1.0, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the newest frame that is not older than ``max_age``.

        As :meth:`smartcam.frames.FrameReader.newest`.
        """
        return self._wait(self._reader.newest, max_age=max_age, timeout=timeout)

    def after(self, moment: float, *, timeout: float | None = FRAME_TIMEOUT) -> Frame:
        """Return the first frame whose exposure began after a moment.

        As :meth:`smartcam.frames.FrameReader.after`.
        """
        return self._wait(self._reader.after, moment, timeout=timeout)
