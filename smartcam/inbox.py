"""What comes from the camera, and who waits for it.

The receive task hands every chunk to :meth:`Inbox.dispatch`, which never waits: an answer completes
its request, a status is shown to every predicate in order, a result gets exactly one fate and goes
to its trigger and to the streams. What the camera is known to be stands here too.
"""

from __future__ import annotations

import asyncio
import collections
import logging
import weakref
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

from smartcam.exceptions import (
    CameraFaultError,
    ConnectionClosedError,
    InputContainerError,
    InterpretationError,
    OvertriggeredError,
    SmartCamError,
    WrongApplicationError,
)
from smartcam.models import (
    ApplicationChanged,
    CameraEvent,
    Result,
    Status,
    StatusChanged,
)
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.connection import Chunk
    from smartcam.interpretation import Interpretation
    from smartcam.streams import Subscription

__all__ = ["Inbox", "PendingTrigger"]

logger: logging.Logger = logging.getLogger("smartcam.client")

Answer = m.Message | SmartCamError


@dataclass(slots=True)
class PendingTrigger:
    """The trigger under way.

    Attributes:
        outcome: gets the result or the error.
        interpretation: how to read its result.
        has_input: input data was sent with it.
        sent_at: loop time.
        triggered_at: wall clock, UTC.
        came: its result came when nobody waited any more.
    """

    outcome: asyncio.Future[Result]
    interpretation: Interpretation
    has_input: bool
    sent_at: float
    triggered_at: datetime
    came: bool = False


@dataclass(slots=True)
class _StatusWaiter:
    predicate: Callable[[Status], bool]
    outcome: asyncio.Future[Status]


class Inbox:
    """The receiving half of a client.

    Args:
        name: the camera's name.
        interpretation: how to read results that no trigger reads otherwise.
    """

    def __init__(self, name: str, interpretation: Interpretation) -> None:
        self.name = name
        self.interpretation = interpretation
        self.end: SmartCamError | None = None
        # what the camera is known to be
        self.status: Status | None = None
        self.endian: int = 0
        self.active: int | None = None
        self.expected: int | None = None  # the application that was named, if any
        # who waits for what
        self.pending: PendingTrigger | None = None
        self.debt: Literal["late", "streamed"] | None = None  # fate of the result still to come
        # the input data of a trigger without a result may still be queued in the camera
        self.input_in_doubt: bool = False
        # by the answer's type; by id for a message that the dialect does not know
        self.answers: dict[type[m.Message] | int, asyncio.Future[Answer]] = {}
        # weak: a waiter that was made and never awaited must not count as a listener
        self.next_results: weakref.WeakSet[asyncio.Future[Result]] = weakref.WeakSet()
        self._status_waiters: list[_StatusWaiter] = []
        self.result_streams: weakref.WeakSet[Subscription[Result]] = weakref.WeakSet()
        self.status_streams: weakref.WeakSet[Subscription[Status]] = weakref.WeakSet()
        self.event_streams: weakref.WeakSet[Subscription[CameraEvent]] = weakref.WeakSet()
        # the account
        self.fates: collections.Counter[str] = collections.Counter()
        self.received: int = 0
        self.empty_slots: int = 0
        self.overtriggers: int = 0

    # ------------------------------------------------------------------ from the receive task

    def dispatch(self, chunk: Chunk) -> None:
        """Hand on every event of a chunk, in order; never waits, never raises."""
        at = datetime.now(UTC)
        for event in chunk.events:
            match event:
                case m.ResultContainer():
                    self._on_result(event, chunk.received_at, at)
                    self._on_answer(m.ResultContainer, event)
                case m.StatusReport():
                    self._on_status(event, chunk.received_at, at)
                    self._on_answer(m.StatusReport, event)
                case m.UnknownMessage():
                    self._on_answer(event.message_id, event)
                case m.QueryAnswer():
                    self.set_active(event.application, at)
                    self._on_answer(type(event), event)
                case m.SwitchAnswer():
                    if event.code == 0:
                        self.expected = event.application
                        self.input_in_doubt = False
                    self.set_active(event.application, at)
                    self._on_answer(type(event), event)
                case m.Message():
                    self._on_answer(type(event), event)
                case _:
                    pass  # LinkFailed and LinkEnded: the link tells its reader when it is drained

    def fail(self, error: SmartCamError) -> None:
        """The session is over: tell everybody who waits, and everybody who comes later.

        The first reason stays. Streams go on until :meth:`finish`.
        """
        if self.end is not None:
            return
        self.end = error
        for answer in self.answers.values():
            answer.set_result(error)
        self.answers.clear()
        waiting: list[asyncio.Future[Result] | asyncio.Future[Status]] = [*self.next_results]
        waiting += [waiter.outcome for waiter in self._status_waiters]
        if self.pending is not None:
            waiting.append(self.pending.outcome)
        for future in waiting:
            if not future.done():
                future.set_exception(error)
        self.next_results.clear()
        self._status_waiters.clear()

    def finish(self) -> None:
        """Nothing more will come: end the streams, quietly if it was us who closed."""
        for stream in self.streams():
            stream.end(None if isinstance(self.end, ConnectionClosedError) else self.end)

    # ------------------------------------------------------------------ for the client

    def streams(self) -> list[Subscription[Any]]:
        """Every subscription that is still referred to."""
        return [*self.result_streams, *self.status_streams, *self.event_streams]

    def next_answer(self, key: type[m.Message] | int) -> asyncio.Future[Answer]:
        """Register for the next answer of this kind; errors come as a result, never raised."""
        future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
        self.answers[key] = future
        return future

    async def wait_status(self, predicate: Callable[[Status], bool], deadline: float) -> Status:
        """Return the first status, the present one included, that ``predicate`` accepts.

        It is shown every status in order. What it raises comes out here.

        Raises:
            TimeoutError: at ``deadline`` (loop time).
            LinkError: the session ended.
        """
        if self.end is not None:
            raise self.end.with_traceback(None)  # raised many times, it would grow each time
        if self.status is not None and predicate(self.status):
            return self.status
        waiter = _StatusWaiter(predicate, asyncio.get_running_loop().create_future())
        self._status_waiters.append(waiter)
        try:
            async with asyncio.timeout_at(deadline):
                return await waiter.outcome
        finally:
            if waiter in self._status_waiters:
                self._status_waiters.remove(waiter)

    def give_up(self, pending: PendingTrigger) -> None:
        """Its caller waits no more; a result that still comes is late."""
        if not pending.came:
            self.debt = "late"

    def set_active(self, application: int, at: datetime) -> None:
        """Note which application is active."""
        previous, self.active = self.active, application
        if previous != application:
            self.publish(
                ApplicationChanged(
                    camera=self.name, at=at, application=application, previous=previous
                )
            )

    def publish(self, event: CameraEvent) -> None:
        """Hand an event to its subscribers."""
        logger.debug("%s = %s", self.name, event)
        for stream in tuple(self.event_streams):
            stream.offer(event, 0.0)

    # ------------------------------------------------------------------ inside

    def _on_answer(self, key: type[m.Message] | int, message: m.Message) -> None:
        future = self.answers.pop(key, None)
        if future is not None:
            future.set_result(message)

    def _on_status(self, report: m.StatusReport, now: float, at: datetime) -> None:
        previous, status = self.status, report.status
        self.status, self.endian = status, report.endian
        risen = Status(status.value & ~(previous.value if previous is not None else 0))
        if Status.OVERTRIGGERED in risen:
            self.overtriggers += 1
        self._fail_trigger(risen)
        if status != previous:
            self.publish(StatusChanged(camera=self.name, at=at, status=status, previous=previous))
        for stream in tuple(self.status_streams):
            stream.offer(status, now)
        for waiter in tuple(self._status_waiters):
            if waiter.outcome.done():
                continue
            try:
                if waiter.predicate(status):
                    waiter.outcome.set_result(status)
            except Exception as exc:  # noqa: BLE001 - the user's predicate: its caller gets it
                waiter.outcome.set_exception(exc)

    def _fail_trigger(self, risen: Status) -> None:
        """End the trigger under way where a status bit says that its result cannot be trusted."""
        pending = self.pending
        if pending is None or pending.outcome.done():
            return
        error: SmartCamError | None = None
        if Status.SYSTEM_ERROR in risen:
            error = CameraFaultError(f"{self.name}: the camera reports System Error")
        elif Status.OVERTRIGGERED in risen:
            error = OvertriggeredError(
                f"{self.name}: the camera dropped a trigger while ours was under way; "
                "it cannot be told whose"
            )
        elif Status.INPUT_CONTAINER in risen and pending.has_input:
            error = InputContainerError(
                f"{self.name}: input data and inspections are out of step: "
                "the result would not belong to this input"
            )
        if error is not None:
            self.debt = "streamed"  # a result may still come, and it is nobody's
            pending.outcome.set_exception(error)

    def _on_result(self, container: m.ResultContainer, now: float, at: datetime) -> None:
        self.received += 1
        pending = self.pending if self.pending and not self.pending.outcome.done() else None
        if self.expected is not None and container.application != self.expected:
            self.fates["wrong_application"] += 1
            if pending is not None:
                self.debt = "late"  # ours may still come
                pending.outcome.set_exception(self._wrong_application(container))
            return
        if self.expected is None:
            self.set_active(container.application, at)
        fate = "triggered"
        if pending is None:
            if self.pending is not None and self.pending.outcome.cancelled():
                self.debt, self.pending.came = "late", True  # its caller was not woken yet
            listening = self._listening()
            fate = self.debt or ("streamed" if listening else "unclaimed")
            self.debt = None
            if not listening:
                self.fates[fate] += 1
                return
        try:
            result = self._interpret(container, pending, now, at)
        except InterpretationError as error:
            self.fates["late" if fate == "late" else "uninterpretable"] += 1
            self._deliver(error, pending, now)
        else:
            self.fates[fate] += 1
            self._deliver(result, pending, now)

    def _listening(self) -> bool:
        return any(not stream.ended for stream in self.result_streams) or any(
            not future.done() for future in self.next_results
        )

    def _interpret(
        self, container: m.ResultContainer, pending: PendingTrigger | None, now: float, at: datetime
    ) -> Result:
        interpretation = pending.interpretation if pending is not None else self.interpretation
        done = interpretation(container, self.endian, camera=self.name, number=self.received, at=at)
        self.empty_slots += done.empty_slots
        return Result(
            camera=self.name,
            application=container.application,
            sequence=done.sequence,
            number=self.received,
            triggered_at=pending.triggered_at if pending is not None else None,
            received_at=at,
            latency=now - pending.sent_at if pending is not None else None,
            raw=container.data,
            value=done.value,
        )

    def _deliver(
        self, result: Result | InterpretationError, pending: PendingTrigger | None, now: float
    ) -> None:
        if pending is not None and pending.has_input:
            self.input_in_doubt = False
        for stream in tuple(self.result_streams):
            stream.offer(result, now)
        waiting = tuple(self.next_results)
        self.next_results.clear()
        for future in (*waiting, pending.outcome) if pending is not None else waiting:
            if future.done():
                continue
            if isinstance(result, InterpretationError):
                future.set_exception(result)
            else:
                future.set_result(result)

    def _wrong_application(self, container: m.ResultContainer) -> WrongApplicationError:
        return WrongApplicationError(
            f"{self.name}: a result of application {container.application} came, "
            f"application {self.expected} was expected",
            expected=self.expected,
            got=container.application,
        )
