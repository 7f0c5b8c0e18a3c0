"""The interface of every camera: connected to this program, or shared by a fleet.

:class:`Camera` has the methods of every camera. :class:`~smartcam.SmartCamera` is the one with its
own session.
"""

from __future__ import annotations

import abc
import asyncio
import warnings
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, TypeAlias, TypeVar, overload

from smartcam._arguments import (
    check_age,
    check_application,
    check_application_or_name,
    check_bytes,
    check_callable,
    check_choice,
    check_clock_seconds,
    check_datetime,
    check_flag,
    check_integer,
    check_message_id,
    check_number,
    check_seconds,
    check_seconds_or_none,
    wrong_argument,
)
from smartcam._client._inside import ClientCounters, Interpretation, Listeners, TriggerRequest
from smartcam.exceptions import (
    SmartCamError,
    TriggerTimeoutError,
    UnsupportedError,
)
from smartcam.models import CameraEvent, Capabilities, Result, Statistics, Status, ValueT
from smartcam.observers import Observer, Observers
from smartcam.settings import id_of
from smartcam.streams import BatchSubscription, Queue, Subscribers, Subscription

if TYPE_CHECKING:
    import contextlib
    from collections.abc import Callable, Collection, Coroutine, Generator, Iterable
    from types import TracebackType
    from typing import NoReturn, Self

    from smartcam.fleet import FleetFrame
    from smartcam.frames import FrameReader
    from smartcam.interpreters._inside import AnySpec, TypedSpec
    from smartcam.models import Localization
    from smartcam.settings import Address, CameraSettings


__all__ = ["Camera"]

QueueT = TypeVar("QueueT", bound=Queue[Any])
T = TypeVar("T")

DEFAULT_MAX_QUEUE = 1024
"""Items that a subscriber's queue holds: half a minute of results at 30 a second, about 1 MB."""

DEFAULT_MAX_QUEUE_BYTES = 1 << 26
"""Bytes of containers that a subscriber's queue holds: 1024 containers of 64 kB, the largest that
known cameras send. The interpreted values may need several times as many bytes."""

MAX_INTERPRETATIONS = 32
"""Largest number of interpreters that a client caches, by the text of ``interpret_as``."""

DEFAULT_TRIGGER_TIMEOUT = 5.0
"""Seconds for a trigger: inspections take tens to hundreds of milliseconds, some a few seconds."""

WAIT = "wait"
"""Value of ``when_busy`` with which a trigger waits until the camera is ready for it."""

DEFAULT_RECONNECT_TIMEOUT = 60.0
"""Seconds to wait for a new session: a reboot takes about 30 (mvBlueGEMINI manual p. 31, about a
similar camera)."""


FRAME_TIMEOUT = 5.0
"""Seconds to wait for a frame."""

FrameEncoding: TypeAlias = Literal["raw", "jpeg", "png", "jpegxl"]
StreamEncoding: TypeAlias = Literal["raw", "jpeg", "png", "jpegxl", "h264"]
"""Encodings of frames: of a single frame, and in a stream."""

FRAME_ENCODINGS = ("raw", "jpeg", "png", "jpegxl")
STREAM_ENCODINGS = (*FRAME_ENCODINGS, "h264")

MAX_SEQUENCE_NUMBER = 0xFFFFFFFF
"""Largest number of a run that a request can hold, 32 bits."""

MAX_RESULTS_PER_TRIGGER = 10_000
"""Largest number of results of one trigger that a caller may ask for: a camera has only a few "send
results" tools."""


class FrameRequest(NamedTuple):
    """The encoding and quality in which a caller wants frames.

    Attributes:
        encoding: name of the encoding.
        quality: quality of JPEGs; None for the agent's default.
    """

    encoding: str
    quality: int | None


class StreamRequest(NamedTuple):
    """The stream of frames that a caller wants; fields as the arguments of :meth:`Camera.frames`.

    Attributes:
        encoding: name of the encoding.
        quality: quality of JPEGs; None for the agent's default.
        bitrate: bits per second; None for no limit.
        latency: seconds; None for no limit.
        decode: True if this program decodes H.264 frames.
        timeout: seconds that an iteration waits for a frame; None for no limit.
    """

    encoding: str
    quality: int | None
    bitrate: float | None
    latency: float | None
    decode: bool
    timeout: float | None


class Camera(abc.ABC, Generic[ValueT]):
    """A camera; :func:`smartcam.connect` makes it.

    The object stays usable after its link was lost: the option ``reconnect`` says when it tries to
    make a new link. Until then every method that talks to the camera raises
    :exc:`~smartcam.ConnectionLostError` at once, with the first cause chained. No command is sent
    again by itself. Before ``open()`` and after ``close()`` the error is
    :exc:`~smartcam.ConnectionClosedError`.

    Args:
        settings: validated options.
        observers: objects that are called with its messages, events, results and errors.
    """

    def __init__(self, settings: CameraSettings, *, observers: Iterable[Observer] = ()) -> None:
        self.settings: CameraSettings = settings
        self._observers = Observers(observers)
        self._has_observers = bool(self._observers)
        # interpretations by the text of ``interpret_as``
        self._interpretations: dict[str, Interpretation] = {}
        self._counters = ClientCounters()
        self._listeners = self._make_listeners()
        self._default_spec: object = settings.interpret_as
        self._default = self._interpretation(self._default_spec, of_camera=True)
        self._default_request = TriggerRequest(self._default, None, 1, wait=True)

    # ------------------------------------------------------------------ for each kind of camera

    @abc.abstractmethod
    def _require_session(self) -> object:
        """Do nothing while there is a session; else raise the error that says why there is none."""

    @abc.abstractmethod
    def _deadline(self, timeout: float) -> float:
        """Return the loop time in ``timeout`` seconds; ConfigurationError for a wrong timeout."""

    @abc.abstractmethod
    def _on_listener_added(self, subscribers: object) -> None:
        """Note that there is a new subscriber, or a new caller that waits for the next item."""

    def _release_unreferenced(self) -> bool:
        """Release a camera to which nothing refers; return True if it was open.

        Any thread may call it, also after ``__init__`` has failed.
        """
        return False

    @abc.abstractmethod
    def _end_of_streams(self) -> tuple[SmartCamError | None] | None:
        """Return None while streams go on; else a tuple of their error, (None,) without one."""

    @abc.abstractmethod
    async def _trigger(
        self, application: int | None, request: TriggerRequest, timeout: float
    ) -> list[Result]: ...

    # ------------------------------------------------------------------ life

    @abc.abstractmethod
    async def open(self) -> Self:
        """Connect; with ``application=`` in the options also start that application.

        Raises:
            ConnectFailedError: no session could be made; the error lists each attempt.
            CommandRejectedError: the camera does not have the application.
            ResponseTimeoutError: the camera did not become ready within ``switch_timeout``.
            ConnectionLostError: the session was lost again before the application was ready.

        Cancellation: the link is dropped.
        """

    @abc.abstractmethod
    async def close(self) -> None:
        """Send Disconnect, end the link, wait for the client's tasks. Idempotent, bounded.

        The return from a temporary switch is finished first, within ``switch_timeout``. Otherwise
        the camera's application and run state are left as they are.
        Cancellation: the link is dropped at once.
        """

    async def wait_connected(self, timeout: float = DEFAULT_RECONNECT_TIMEOUT) -> None:
        """Wait until there is a session, and the camera has the state that ``restore`` asks for.

        Args:
            timeout: seconds.

        Raises:
            ResponseTimeoutError: there was no session in time; the error names the last loss.
            ConnectionLostError: ``reconnect`` is None, or it gave up.
            ConnectionTakenError: another client has the camera.
            ConnectionClosedError: the camera was not opened, or was closed.

        Cancellation: safe.
        """
        await self._wait_connected(check_seconds(timeout, "timeout", self.name))

    @abc.abstractmethod
    async def _wait_connected(self, timeout: float) -> None: ...

    async def __aenter__(self) -> Self:
        return await self.open()

    async def __aexit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        await self.close()

    def __await__(self) -> Generator[Any, None, Self]:
        return self.open().__await__()

    def __enter__(self) -> NoReturn:
        raise TypeError(
            "a camera is opened by `async with smartcam.connect(...) as camera`; "
            "without asyncio: `with smartcam.sync.connect(...) as camera`"
        )

    def __exit__(self, *_: object) -> None: ...

    def __del__(self) -> None:
        if self._release_unreferenced():
            warnings.warn(f"{self!r} was not closed", ResourceWarning, source=self, stacklevel=2)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.name} {self.url}>"

    # ------------------------------------------------------------------ state

    @property
    def name(self) -> str:
        """The camera's name in logs and results."""
        return self.settings.name

    @property
    @abc.abstractmethod
    def url(self) -> str:
        """The camera's address, with the dialect once it is known."""

    @property
    @abc.abstractmethod
    def connected(self) -> bool:
        """True while there is a session."""

    @property
    def trouble(self) -> SmartCamError | None:
        """The error that a call would raise now; None while there is a session.

        The error has no traceback; its cause is in ``__cause__``.
        """
        try:
            self._require_session()
        except SmartCamError as error:
            return error.with_traceback(None)
        return None

    @property
    @abc.abstractmethod
    def status(self) -> Status:
        """The last status the camera sent, also after the session was lost.

        Raises:
            ConnectionClosedError: there was no session yet.
        """

    @property
    @abc.abstractmethod
    def active_application(self) -> int | None:
        """Id of the active application as last reported by the camera; None before ``open()``."""

    @property
    @abc.abstractmethod
    def protocol_version(self) -> int | None:
        """Version from the answer to Connect; None before ``open()``."""

    @property
    @abc.abstractmethod
    def capabilities(self) -> Capabilities:
        """The abilities of the camera in the dialect that it speaks.

        Raises:
            ConnectionClosedError: there was no session yet, so the dialect is not known.
        """

    def statistics(self) -> Statistics:
        """Return all counters, over all sessions: see :class:`~smartcam.models.Statistics`."""
        streams = self._listeners.streams()
        return self._counters.statistics(s.statistics() for s in streams if not s.ended)

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
    ) -> Subscription[Result[ValueT]]: ...

    @overload
    def results(
        self,
        *,
        batch: Literal[True],
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        max_queue_bytes: int = DEFAULT_MAX_QUEUE_BYTES,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> BatchSubscription[Result[ValueT]]: ...

    def results(
        self,
        *,
        batch: bool = False,
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        max_queue_bytes: int = DEFAULT_MAX_QUEUE_BYTES,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> Subscription[Result[ValueT]] | BatchSubscription[Result[ValueT]]:
        """Subscribe to every result, triggered or not; the call subscribes, not the iteration.

        The stream goes on after a reconnect; results of the time without a session are lost.

        For a container that cannot be interpreted, or not be calibrated, the iterator raises
        :exc:`~smartcam.InterpretationError`; it stays usable. Results of another application than
        the last one named, by the option or a switch, are counted, but not delivered.

        Args:
            batch: return lists of all waiting results, at least one, instead of single results: for
                a camera that sends thousands a second. ``max_queue`` counts results, not lists.
            min_interval: seconds; results that come sooner after the last kept result are dropped.
            max_queue: results kept for a slow reader; best at least as many as fit into 32 KiB,
                which may arrive at once.
            max_queue_bytes: largest number of bytes of the kept containers together
                (``Result.raw``; values may be larger). A larger single container is kept if the
                queue is empty.
            overflow: what to do when one of these two limits is reached.
        """
        check_flag(batch, "batch", self.name)
        kind = BatchSubscription[Result[ValueT]] if batch else Subscription[Result[ValueT]]
        stream = kind(
            "results",
            max_queue=max_queue,
            max_queue_bytes=max_queue_bytes,
            size_of=_size_of,
            overflow=overflow,
            min_interval=min_interval,
        )
        return self._subscribed(self._listeners.results, stream)

    def statuses(
        self,
        *,
        min_interval: float = 0.0,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> Subscription[Status]:
        """Subscribe to every status the camera sends from now on; arguments as in `results`."""
        stream = Subscription[Status](
            "statuses", max_queue=max_queue, overflow=overflow, min_interval=min_interval
        )
        return self._subscribed(self._listeners.statuses, stream)

    def events(
        self,
        *,
        max_queue: int = DEFAULT_MAX_QUEUE,
        overflow: Literal["drop_oldest", "error"] = "drop_oldest",
    ) -> Subscription[CameraEvent]:
        """Subscribe to the camera's events, in order.

        The events are ``Connected``, ``Disconnected``, ``Reconnected``, ``StatusChanged``,
        ``ApplicationChanged`` and ``NoticeReceived``. Subscribe before :meth:`open` to get the
        first ones.
        """
        stream = Subscription[CameraEvent]("events", max_queue=max_queue, overflow=overflow)
        return self._subscribed(self._listeners.events, stream)

    async def wait_status(
        self, predicate: Callable[[Status], bool], timeout: float = 10.0
    ) -> Status:
        """Return the first status that ``predicate`` accepts, beginning with the present status.

        The predicate is called with every status in order, not only with the last.

        Raises:
            ResponseTimeoutError: after ``timeout`` seconds.

        Cancellation: safe.
        """
        check_callable(predicate, "predicate", self.name)
        return await self._wait_status(predicate, check_seconds(timeout, "timeout", self.name))

    @abc.abstractmethod
    async def _wait_status(self, predicate: Callable[[Status], bool], timeout: float) -> Status: ...

    async def wait_ready(self, timeout: float = 10.0) -> Status:
        """Wait until the camera is not BUSY, and is Running if it was started.

        Raises:
            ResponseTimeoutError: after ``timeout`` seconds.

        Cancellation: safe.
        """
        return await self._wait_ready(check_seconds(timeout, "timeout", self.name))

    @abc.abstractmethod
    async def _wait_ready(self, timeout: float) -> Status: ...

    def next_result(
        self, *, timeout: float = DEFAULT_TRIGGER_TIMEOUT
    ) -> Coroutine[Any, Any, Result[ValueT]]:
        """Wait for the next result, whatever triggers it; the call registers, not the ``await``.

        A result that certainly belongs to a trigger that was given up is left out.

        ``waiting = camera.next_result(); start_conveyor(); result = await waiting``

        Args:
            timeout: seconds from the call.

        Raises:
            TriggerTimeoutError: no result came in time.
            InterpretationError: the container does not fit its layout, or its calibration.

        Cancellation: safe; the result still goes to the streams.
        """
        timeout = check_seconds(timeout, "timeout", self.name)
        self._require_session()
        deadline = self._deadline(timeout)
        future = self._listeners.next_result()
        self._on_listener_added(self._listeners.results)
        return self._await_next(future, deadline, timeout)

    # ------------------------------------------------------------------ commands

    @overload
    async def trigger(
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
    async def trigger(
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
    async def trigger(
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
    async def trigger(
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
    async def trigger(
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
    async def trigger(
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
    async def trigger(
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
    async def trigger(
        self,
        application: int | str | None = None,
        *,
        interpret_as: TypedSpec[T],
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: int,
    ) -> list[Result[T]]: ...

    async def trigger(
        self,
        application: int | str | None = None,
        *,
        interpret_as: object = None,
        input: bytes | None = None,
        timeout: float = DEFAULT_TRIGGER_TIMEOUT,
        when_busy: Literal["wait", "refuse"] = "wait",
        results_per_trigger: int | None = None,
    ) -> Result[Any] | list[Result[Any]]:
        """Trigger one inspection and return its result.

        The method waits until the camera is ready for a trigger, and then sends one. There is one
        trigger at a time: a second caller waits for its turn, within its own ``timeout``. A trigger
        is never sent twice.

        If the layout has an ``@sequence`` field, the number of the run is set right before the
        trigger, and only the container with this number is the result. Otherwise, over TCP, a Query
        is sent before the trigger: containers that arrive before its answer are older than the
        trigger. Before that, the client handles an earlier trigger that was given up: it waits a
        moment for the result, or prevents it (Stop, Query, Start; that a stopped inspection has no
        result is concluded, not documented). Over UDP without ``@sequence`` a late result can be
        mistaken for that of the next trigger: no message tells them apart.

        Args:
            application: id, or name in ``application_names``, of the application to run for this
                trigger. The camera returns to the present application afterwards, also after an
                error or a cancellation. Each of the switches may take ``switch_timeout``.
            interpret_as: how to interpret this result; by default as given to :func:`connect`.
            input: input data for this inspection, sent right before the trigger.
            timeout: seconds for the turn, the readiness and the result together.
            when_busy: with ``refuse`` raise CameraBusyError instead of waiting for readiness.
            results_per_trigger: number of results that the application sends for a trigger (one for
                each "send results" tool); a list of them is returned. By default one result is
                expected, and further ones are counted as ``extra_results``.

        Raises:
            ConfigurationError: an argument cannot work; nothing was sent.
            NotRunningError: the application is stopped (neither BUSY nor Running), or was stopped
                from elsewhere during the inspection.
            TriggerTimeoutError: no result in time; the error names the status. This is also raised
                for an application that runs free, which never waits for a trigger, and if the
                switch to ``application`` takes too long. If other callers had the camera for so
                long that no time is left for a result, no trigger was sent.
            OvertriggeredError: the camera dropped a trigger meanwhile.
            CameraBusyError: with ``when_busy="refuse"``.
            CameraFaultError: the camera reports System Error.
            InputContainerError: with ``input``: the data did not belong to this inspection, or the
                input of an earlier trigger without a result may still be queued in the camera;
                loading an application (:meth:`switch_application`) empties its queue (inferred).
            InterpretationError: the result does not fit its layout, or its calibration.
            WrongApplicationError: the result is of another application, or another application is
                active than the one that was named.
            CommandRejectedError: with ``application``: the camera does not have it.
            ConnectionLostError: the link was lost; whether the camera got the trigger is unknown.

        Cancellation: safe. A result that comes later is never taken for that of the next trigger;
        it is counted as late.
        """
        interpretation = (
            self._default if interpret_as is None else self._interpretation(interpret_as)
        )
        owner = self.settings.name
        if application is not None:
            application = check_application(self._application_id(application), owner=owner)
        wait = (
            when_busy is WAIT
            or check_choice(when_busy, "when_busy", (WAIT, "refuse"), owner) == WAIT
        )
        result_count = 1
        if results_per_trigger is not None:
            result_count = check_integer(
                results_per_trigger, "results_per_trigger", 1, MAX_RESULTS_PER_TRIGGER, owner
            )
        data = None if input is None else check_bytes(input, "input", owner)
        if timeout is not DEFAULT_TRIGGER_TIMEOUT:
            timeout = check_seconds(timeout, "timeout", owner)
        request = self._default_request
        if (
            data is not None
            or result_count != 1
            or not wait
            or request.interpretation is not interpretation
        ):
            request = TriggerRequest(interpretation, data, result_count, wait)
        called_at = datetime.now(UTC) if self._has_observers else None
        try:
            results = await self._trigger(application, request, timeout)
        except SmartCamError as error:
            self._observers.error(self.name, error, called_at)
            raise
        return results[0] if results_per_trigger is None else results

    async def switch_application(
        self, application: int | str, *, timeout: float | None = None
    ) -> None:
        """Load another application, and wait until the camera is ready.

        A running application is stopped first (the camera demands it), and the new one is started.
        From then on, results are expected from the new application. If the camera refuses, the old
        application is started again, if it ran, before the error is raised.

        Args:
            application: id of the application, its name in ``application_names``, or the name of
                its file if the camera can load an application by such a name.
            timeout: seconds for all steps together; default ``switch_timeout``.

        Raises:
            UnsupportedError: a name was given, and the camera knows only ids.
            CommandRejectedError: the id is unknown, or 0; the error names the active id.
            ResponseTimeoutError: the camera did not answer, or stayed BUSY.

        Cancellation: safe; the camera may have either application, and may be stopped.
        Source: SC manual p. 34 (published).
        """
        application = check_application_or_name(
            self._application_id(application, file=True), owner=self.name
        )
        limit = self._limit(timeout, self.settings.switch_timeout)
        await self._switch_application(application, limit)

    @abc.abstractmethod
    async def _switch_application(self, application: int | str, timeout: float) -> None: ...

    def application(self, application: int | str) -> contextlib.AbstractAsyncContextManager[Self]:
        """Run an application inside the ``async with``, then return to the previous application.

        Raises:
            CommandRejectedError, ResponseTimeoutError: as :meth:`switch_application`.

        Cancellation: the return is finished in the background; the next call waits for it.
        """
        return self._in_application(
            check_application(self._application_id(application), owner=self.name)
        )

    def _application_id(self, application: object, *, file: bool = False) -> object:
        """Return the id for an application's name; any other value unchanged.

        Args:
            application: the user's value.
            file: True if an unknown name may be the name of a file.

        Raises:
            ConfigurationError: ``application_names`` has names, but not this one.
        """
        names = self.settings.application_names
        if not names or not isinstance(application, str) or (file and application not in names):
            return application
        return id_of(application, names)

    @abc.abstractmethod
    def _in_application(self, application: int) -> contextlib.AbstractAsyncContextManager[Self]: ...

    async def start(self, *, timeout: float = 10.0) -> None:
        """Enter run mode; return when the camera reports Running and is not BUSY.

        Raises:
            UnsupportedError: with this dialect the camera always runs (``bid``).
            ResponseTimeoutError: the camera did not report this within ``timeout`` seconds.

        Cancellation: safe; the command may have been sent.
        """
        await self._start(check_seconds(timeout, "timeout", self.name))

    @abc.abstractmethod
    async def _start(self, timeout: float) -> None: ...

    async def stop(self, *, timeout: float = 10.0) -> None:
        """Leave run mode; return when the camera no longer reports Running.

        A running inspection gives no result (concluded, not documented).

        Raises:
            UnsupportedError: with this dialect the camera always runs (``bid``).
            ResponseTimeoutError: the camera did not report this within ``timeout`` seconds.

        Cancellation: safe; the command may have been sent.
        """
        await self._stop(check_seconds(timeout, "timeout", self.name))

    @abc.abstractmethod
    async def _stop(self, timeout: float) -> None: ...

    async def query_application(self, *, timeout: float | None = None) -> int:
        """Ask the camera which application is active.

        Raises:
            ResponseTimeoutError: no answer. The next request first waits for the late answer, so
                that it is not taken for its own; after ``request_timeout`` the link is dropped.

        Cancellation: safe; the answer is dropped when it comes.
        """
        return await self._query_application(self._limit(timeout, self.settings.request_timeout))

    @abc.abstractmethod
    def _query_application(self, timeout: float) -> Coroutine[Any, Any, int]: ...

    async def query_status(self, *, timeout: float | None = None) -> Status:
        """Ask the camera for its status.

        Raises:
            UnsupportedError: the camera has no such request; it sends its status by itself.
            ResponseTimeoutError: no answer, as for :meth:`query_application`.

        Cancellation: safe.
        """
        return await self._query_status(self._limit(timeout, self.settings.request_timeout))

    @abc.abstractmethod
    async def _query_status(self, timeout: float) -> Status: ...

    async def reset_errors(self, *, timeout: float | None = None) -> Status:
        """Clear the error bits that stay set until a reset; return the status after the reset.

        :meth:`trigger` does this by itself if an earlier Trigger Error would hide a new one.

        Raises:
            UnsupportedError: the camera clears its bits by itself.
            ResponseTimeoutError: no answer, as for :meth:`query_application`.

        Cancellation: safe; the command may have been sent.
        Source: BVS ID guide p. 227 (published).
        """
        return await self._reset_errors(self._limit(timeout, self.settings.request_timeout))

    @abc.abstractmethod
    async def _reset_errors(self, timeout: float) -> Status: ...

    async def read_image(self, *, timeout: float | None = None) -> bytes:
        """Return the last picture, as a file's bytes.

        Raises:
            UnsupportedError: the protocol, such as BVS, has no message for it.
            CommandRejectedError: the camera refused.
            ResponseTimeoutError: no answer, as for :meth:`query_application`.

        Cancellation: safe; the answer is dropped when it comes.
        """
        return await self._read_image(self._limit(timeout, self.settings.request_timeout))

    @abc.abstractmethod
    async def _read_image(self, timeout: float) -> bytes: ...

    def frames(
        self,
        *,
        encoding: StreamEncoding = "raw",
        quality: int | None = None,
        bitrate: float | None = None,
        latency: float | None = None,
        decode: bool = True,
        timeout: float | None = FRAME_TIMEOUT,
    ) -> contextlib.AbstractAsyncContextManager[FrameReader]:
        """Read the camera's frames: ``async with camera.frames() as frames``, then iterate.

        The reader is a :class:`smartcam.frames.FrameReader`: it returns the newest frame, and
        counts skipped and lost frames. The device streams while there is a reader. Only one frame
        at a time is sent to each reader.

        Only a camera of a fleet has frames, if its entry in the fleet file has ``frames``.

        Args:
            encoding: ``raw`` for frames as the device sends them; ``jpeg``; or ``png`` and
                ``jpegxl``, without loss. Frames stay encoded until their pixels are read. ``h264``
                is decoded in this program, and only whole pictures are returned.
            quality: quality of JPEG, 1 to 100.
            bitrate: largest number of bits per second of JPEGs: first their quality is reduced for
                it, then the frame rate (each frame's ``rate`` says how); for H.264 the bit rate of
                its encoder.
            latency: largest number of seconds from a JPEG's capture to its arrival, kept in the
                same way.
            decode: False: return H.264 frames encoded. A reader that skips a frame has no picture
                until the next key frame.
            timeout: seconds that an iteration waits for a frame; None: without limit.

        Raises:
            UnsupportedError: the camera has no frames.
            FrameSourceError: the device is not there, in use, or was unplugged; or the agent is
                gone. The reader ends then; a new reader tries again.

        Cancellation: safe; nothing stays open.
        """
        frame_request = self._check_encoding(encoding, quality, STREAM_ENCODINGS)
        limits = self._check_limits(bitrate, latency)
        decode = check_flag(decode, "decode", self.name)
        timeout = check_seconds_or_none(timeout, "timeout", self.name, exclusive=True)
        return self._frames(StreamRequest(*frame_request, *limits, decode, timeout))

    async def newest_frame(
        self,
        *,
        max_age: float = 1.0,
        encoding: FrameEncoding = "raw",
        quality: int | None = None,
        timeout: float = FRAME_TIMEOUT,
    ) -> FleetFrame:
        """Return the newest frame.

        Args:
            max_age: largest age of the frame in seconds; ``inf``: any age.
            encoding: as for :meth:`frames`.
            quality: as for :meth:`frames`.
            timeout: seconds.

        Raises:
            UnsupportedError: the camera has no frames.
            FrameTimeoutError: no frame came in time.
            FrameSourceError: the device is not there, in use, or was unplugged.
            ConnectionLostError: the agent is gone.

        Cancellation: safe.
        """
        frame_request = self._check_encoding(encoding, quality, FRAME_ENCODINGS)
        max_age = check_age(max_age, "max_age", self.name)
        timeout = check_seconds(timeout, "timeout", self.name)
        return await self._newest_frame(max_age, frame_request, timeout)

    async def frame_after(
        self,
        moment: float | None = None,
        *,
        encoding: FrameEncoding = "raw",
        quality: int | None = None,
        timeout: float = FRAME_TIMEOUT,
    ) -> FleetFrame:
        """Return the first frame whose exposure began after ``moment``, or after this call.

        If clocks or the source make that uncertain, return the first frame that certainly did.

        Args:
            moment: a time of ``time.monotonic()``; None: now.
            encoding: as for :meth:`frames`.
            quality: as for :meth:`frames`.
            timeout: seconds.

        Raises:
            SmartCamError: as :meth:`newest_frame`.

        Cancellation: safe.
        """
        frame_request = self._check_encoding(encoding, quality, FRAME_ENCODINGS)
        if moment is not None:
            moment = check_clock_seconds(moment, "moment", self.name)
        timeout = check_seconds(timeout, "timeout", self.name)
        return await self._frame_after(moment, frame_request, timeout)

    def _frames(self, wanted: StreamRequest) -> contextlib.AbstractAsyncContextManager[FrameReader]:
        raise self._no_frames_error()

    async def _newest_frame(
        self, max_age: float, frame_request: FrameRequest, timeout: float
    ) -> FleetFrame:
        raise self._no_frames_error()

    async def _frame_after(
        self, moment: float | None, frame_request: FrameRequest, timeout: float
    ) -> FleetFrame:
        raise self._no_frames_error()

    # ------------------------------------------------------------------ reservations

    def reserve(self, timeout: float = 10.0) -> contextlib.AbstractAsyncContextManager[Self]:
        """Keep the commands of other programs out while the body of the block runs.

        Other programs wait within their own timeouts, and then fail with an error that names this
        program. The reservation ends with the block or with this program. If the program is killed
        or cut off, it ends after the lease time of the bus at the latest. The tasks of this program
        use the camera as before, and may reserve it, too.

        Only a camera of a fleet can be reserved. A camera without a fleet serves one client, and a
        new client takes it from the old one.

        Args:
            timeout: seconds to wait for the reservation; earlier requests come first.

        A reservation may be lost before the block ends: its agent ends or is restarted, another
        agent takes over the camera, or this program was cut off or stopped for longer than the
        lease. Then every command of this object raises ReservationLostError until the block has
        ended. The end of the block raises it, too, unless the block raises another error.

        Raises:
            UnsupportedError: the camera is not in a fleet.
            ResponseTimeoutError: another program has the camera; the error names it.
            ConnectionLostError: the agent cannot be reached, or was restarted meanwhile.
            ReservationLostError: the reservation was lost, or may have been lost.

        Cancellation: safe; the reservation ends.
        """
        return self._reserved(check_seconds(timeout, "timeout", self.name))

    def _reserved(self, timeout: float) -> contextlib.AbstractAsyncContextManager[Self]:
        raise self._not_shared_error("it cannot be reserved")

    async def take_back(self, *, timeout: float | None = None) -> None:
        """Make the agent take the camera back from another client, and wait for the session.

        By itself an agent tries to get a taken camera back after 30 s, then less and less often.
        This method does nothing if the agent has a session.

        Args:
            timeout: seconds, ``request_timeout`` by default.

        Raises:
            UnsupportedError: the camera is not in a fleet; a new connection takes it back.
            LinkError: there is no agent.
            ResponseTimeoutError: there was no session within ``timeout``.
        """
        await self._take_back(self._limit(timeout, self.settings.request_timeout))

    async def _take_back(self, timeout: float) -> None:
        raise self._not_shared_error("a new connection takes it back")

    def _not_shared_error(self, then: str) -> UnsupportedError:
        return UnsupportedError(
            f"{self.name}: this camera is connected directly and serves one client: {then}; "
            "smartcam serve shares it, and fleet://HOST/NAME is its address then"
        )

    def _no_frames_error(self) -> UnsupportedError:
        return UnsupportedError(
            f"{self.name}: a camera that is connected directly gives results, no frames: open the "
            "source of its pictures by smartcam.frames.open(URL), or share the camera by a fleet "
            "file with frames: URL"
        )

    async def get_clock(self, *, timeout: float | None = None) -> datetime:
        """Return the camera's clock: a naive datetime, since it carries no time zone.

        Raises:
            ResponseTimeoutError: no answer, as for :meth:`query_application`.
            InterpretationError: the answer is no date.

        Cancellation: safe; the answer is dropped when it comes.
        """
        return await self._get_clock(self._limit(timeout, self.settings.request_timeout))

    @abc.abstractmethod
    async def _get_clock(self, timeout: float) -> datetime: ...

    async def set_clock(self, when: datetime) -> None:
        """Set the camera's clock to the fields of ``when``; confirmed only by result codes, if any.

        Raises:
            CommandRejectedError: the camera refused.

        Source: mvBlueGEMINI manual p. 29, about a similar camera: invalid values may be dropped.
        """
        await self._set_clock(check_datetime(when, "when", self.name))

    @abc.abstractmethod
    async def _set_clock(self, when: datetime) -> None: ...

    async def set_input(self, data: bytes) -> None:
        """Send input data for the next inspection; confirmed only by result codes, if any.

        ``trigger(input=...)`` sends the data of its own trigger. The camera queues input containers
        for its inspections; the Input Container bit shows that inputs and inspections are not
        equally many.
        """
        await self._set_input(check_bytes(data, "data", self.name))

    @abc.abstractmethod
    async def _set_input(self, data: bytes) -> None: ...

    async def set_sequence_number(self, number: int) -> None:
        """Set the number of the next run (0 to 4294967295); nothing confirms it.

        If the layout has an ``@sequence`` field, the next :meth:`trigger` uses this number; without
        this call, :meth:`trigger` chooses its own numbers. Do not call it if anything else may
        trigger the camera: the next run gets the number, whatever triggered it.

        Raises:
            ConfigurationError: the number has more than 32 bits.
            UnsupportedError: the dialect has no such request (``bid``).
            LocalProtocolError: the dialect's field is too small for the number.
        """
        number = check_integer(number, "number", 0, MAX_SEQUENCE_NUMBER, self.name)
        await self._set_sequence_number(number)

    @abc.abstractmethod
    async def _set_sequence_number(self, number: int) -> None: ...

    @abc.abstractmethod
    async def reboot(self) -> None:
        """Restart the camera; return when the session has ended.

        A restart takes about 30 seconds (with a similar camera); then the last application is
        loaded, but stopped. :meth:`wait_connected` waits for the new session.

        Raises:
            UnsupportedError: the dialect has no such request (``bid``).

        Cancellation: the command may have been sent.
        """

    async def request(
        self,
        message_id: int | str,
        payload: bytes = b"",
        *,
        answered: bool | None = None,
        timeout: float | None = None,
    ) -> bytes | None:
        """Send any message; for requests without a method of their own.

        Args:
            message_id: id of the message; a command's text if the protocol has commands.
            payload: body of the message.
            answered: True to wait for an answer with the same id; default: as in the
                message table, True for an unknown id.
            timeout: seconds for the answer.

        Returns:
            The answer's body; None, once the message is written, if no answer is expected.

        Raises:
            LocalProtocolError: the message is Connect or Disconnect, which only the client sends.
            UnsupportedError: the protocol has no ids of this kind.
            ResponseTimeoutError: no answer, as for :meth:`query_application`.

        Cancellation: safe; the answer is dropped when it comes.
        """
        message_id = check_message_id(message_id, owner=self.name)
        payload = check_bytes(payload, "payload", self.name)
        if answered is not None:
            answered = check_flag(answered, "answered", self.name)
        return await self._request(
            message_id, payload, answered, self._limit(timeout, self.settings.request_timeout)
        )

    @abc.abstractmethod
    async def _request(
        self, message_id: int | str, payload: bytes, answered: bool | None, timeout: float
    ) -> bytes | None: ...

    # ------------------------------------------------------------------ small helpers

    def _limit(self, timeout: float | None, default: float) -> float:
        """Return the timeout of a call in seconds: as given, or the default."""
        return default if timeout is None else check_seconds(timeout, "timeout", self.name)

    def _check_encoding(
        self, encoding: str, quality: int | None, encodings: Collection[str]
    ) -> FrameRequest:
        """Check encoding and quality of frames; the agent checks if they go together."""
        if quality is not None:
            quality = check_integer(quality, "quality", 1, 100, self.name)
        encoding = check_choice(encoding, "encoding", STREAM_ENCODINGS, self.name)
        if encoding not in encodings:
            raise wrong_argument(
                "encoding", "no video: its frames depend on each other", encoding, self.name
            )
        return FrameRequest(encoding, quality)

    def _check_limits(
        self, bitrate: float | None, latency: float | None
    ) -> tuple[float | None, float | None]:
        """Check the limits of a stream's bit rate and latency."""
        if bitrate is not None:
            bitrate = check_number(bitrate, "bitrate", 1e3, 1e11, self.name)
        if latency is not None:
            latency = check_number(latency, "latency", 1e-3, 60.0, self.name)
        return bitrate, latency

    def _make_listeners(self) -> Listeners:
        return Listeners(self.settings.name, self._observers)

    @property
    def _camera_address(self) -> Address:
        """Address of the camera itself, as far as it is known."""
        return self.settings.address

    def _set_interpreter(self, spec: object) -> None:
        """Interpret results by ``spec`` from now on; None: by the settings.

        This holds for every user of this object.

        Raises:
            ConfigurationError: ``spec`` is not valid, or does not fit the calibration.
        """
        spec = self.settings.interpret_as if spec is None else spec
        self._default = self._interpretation(spec)
        self._default_spec = spec

    def _interpretation(self, spec: object, *, of_camera: bool = False) -> Interpretation:
        """Return the interpretation of results by ``spec``.

        Args:
            spec: as ``interpret_as``.
            of_camera: True if ``spec`` is the camera's setting, which its calibration has to fit.

        Raises:
            ConfigurationError: ``spec`` is not valid, or does not fit the calibration.
        """
        if isinstance(spec, Interpretation):
            return spec
        cached = self._interpretations.get(spec) if isinstance(spec, str) else None
        if cached is not None:
            return cached
        lenient, y_down = self.settings.lenient, self.settings.y_down
        calibration = self.settings.calibration
        interpretation = Interpretation(
            spec,
            lenient=lenient,
            y_down=y_down,
            calibration=calibration,
            strict_calibration=of_camera,
        )
        if isinstance(spec, str) and len(self._interpretations) < MAX_INTERPRETATIONS:
            self._interpretations[spec] = interpretation
        return interpretation

    async def _await_next(
        self, future: asyncio.Future[Result], deadline: float, timeout: float
    ) -> Result:
        try:
            async with asyncio.timeout_at(deadline):
                return await future
        except TimeoutError as exc:
            if future.done() and not future.cancelled():
                return future.result()
            raise TriggerTimeoutError(
                f"{self.name}: no result came within {timeout:g} s; status: {self.status}",
                waited=timeout,
            ) from exc

    def _subscribed(self, subscribers: Subscribers[Any], queue: QueueT) -> QueueT:
        """Add a queue to the subscribers; end it at once if no more items will come."""
        end = self._end_of_streams()
        if end is not None:
            queue.end(end[0])
        queue.hold_source(self)
        subscribers.add(queue)
        self._on_listener_added(subscribers)
        return queue


def _size_of(result: Result) -> int:
    return len(result.raw)
