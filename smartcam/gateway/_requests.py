"""Answer the requests of one robot, and keep the parts that the robot may still request."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import (
    CalibrationError,
    CameraBusyError,
    CommandRejectedError,
    ConfigurationError,
    InterpretationError,
    LinkError,
    NotAllowedError,
    NotRunningError,
    ProtocolError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.gateway._lines import AnswerCode, RobotAnswer
from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.camera import Camera
    from smartcam.gateway._counts import GatewayCounts
    from smartcam.gateway._lines import RobotRequest
    from smartcam.gateway._parts import Converter, PartValues
    from smartcam.gateway._settings import GatewaySettings
    from smartcam.models import Result

CANCEL_GRACE: Final = 0.2
"""Seconds after a request's deadline when a call to the camera that still runs is cancelled."""

PART_WORDS = ("TRIGGER", "NEXT", "WAIT")
"""The words with which a robot requests a part."""

WORDS = (*PART_WORDS, "STATUS", "WHY")
"""All words with which a request may begin."""

_log = logging.getLogger("smartcam.gateway")

CODES: tuple[tuple[type[BaseException], AnswerCode], ...] = (
    (CameraBusyError, AnswerCode.BUSY),
    (TimeoutError, AnswerCode.TIMEOUT),
    (LinkError, AnswerCode.NOT_CONNECTED),
    (ProtocolError, AnswerCode.NOT_CONNECTED),
    (NotRunningError, AnswerCode.NOT_RUNNING),
    (CommandRejectedError, AnswerCode.REFUSED),
    (UnsupportedError, AnswerCode.REFUSED),
    (NotAllowedError, AnswerCode.REFUSED),
    (InterpretationError, AnswerCode.UNREADABLE),
    (CalibrationError, AnswerCode.UNREADABLE),
    (ConfigurationError, AnswerCode.REFUSED),
    (SmartCamError, AnswerCode.FAULT),
)
"""The code that answers each class of errors; the first class that matches decides."""


class GatewayCamera:
    """The camera, the settings and the counts, which all robots of a gateway share.

    Args:
        camera: the camera.
        settings: timeouts of requests, and the age up to which parts are given to robots.
        counts: counts of requests and parts.

    Attributes:
        camera: the camera; the gateway may set another object.
        trigger_lock: lock that a robot's request holds while it triggers the camera.
    """

    def __init__(
        self, camera: Camera, settings: GatewaySettings, converter: Converter, counts: GatewayCounts
    ) -> None:
        self.camera: Camera = camera
        self.settings: GatewaySettings = settings
        self.converter: Converter = converter
        self.counts: GatewayCounts = counts
        self.trigger_lock = asyncio.Lock()


class RobotRequests:
    """Answers the requests of one robot, one after the other.

    Args:
        shared: the camera that the robot shares with other robots.
    """

    def __init__(self, shared: GatewayCamera) -> None:
        self._shared = shared
        self._parts: list[PartValues] | None = None  # values of the parts of the last result
        self._parts_expire_at = 0.0  # loop time after which the robot gets no more of the parts
        self._last_error = RobotAnswer(AnswerCode.NO_PART, text="no request has failed")
        self._answer_has_part = False  # True while an answer with the first part is being written

    # ------------------------------------------------------------------ a request

    async def answer(self, request: RobotRequest, deadline: float) -> RobotAnswer:
        """Return the answer to a request, no later than :data:`CANCEL_GRACE` after the deadline."""
        try:
            async with asyncio.timeout_at(deadline + CANCEL_GRACE):
                answer = await self._answer(request, deadline)
        except (SmartCamError, TimeoutError) as exc:
            code = next((code for kind, code in CODES if isinstance(exc, kind)), AnswerCode.FAULT)
            answer = RobotAnswer(code, text=str(exc) or "no answer of the camera in time")
        except Exception as exc:  # noqa: BLE001 - a robot waits for an answer in any case
            _log.exception("a request failed")
            answer = RobotAnswer(AnswerCode.FAULT, text=f"unexpected {exc!r:.100}")
        if answer.code.is_error:
            self._last_error = answer
        return answer

    async def _answer(self, request: RobotRequest, deadline: float) -> RobotAnswer:
        if request.word not in WORDS or (request.application is not None) > (
            request.word == "TRIGGER"
        ):
            words = f"expected {', '.join(WORDS)} (TRIGGER n: with application n)"
            return RobotAnswer(AnswerCode.BAD_REQUEST, text=f"{words}, got {request.text!r}")
        if request.word == "STATUS":
            return self._status()
        if request.word == "WHY":
            return RobotAnswer(
                AnswerCode.OK, text=f"{self._last_error.code.name} {self._last_error.text}"
            )
        if request.word != "NEXT":
            self.forget_result()
            self._keep_parts(await self._get_result(request, deadline))
        return self._next_part()

    async def _get_result(self, request: RobotRequest, deadline: float) -> Result:
        camera = self._shared.camera
        if request.word == "WAIT":
            return await camera.next_result(timeout=_time_left(deadline))
        # wait for the lock at most half of the time, so that the camera gets the other half
        async with _hold_lock(
            self._shared.trigger_lock, deadline - 0.5 * self._shared.settings.timeout
        ):
            return await camera.trigger(request.application, timeout=_time_left(deadline))

    def _status(self) -> RobotAnswer:
        camera = self._shared.camera
        running = camera.connected and Status.RUNNING in camera.status
        values = [int(camera.connected), int(running), camera.active_application or 0]
        return RobotAnswer(AnswerCode.OK, values=values)

    # ------------------------------------------------------------------ parts

    def _keep_parts(self, result: Result) -> None:
        parts = self._shared.converter.convert(result.value, result.application)
        self._parts = parts
        self._parts_expire_at = asyncio.get_running_loop().time() + self._shared.settings.max_age
        self._shared.counts.parts += len(parts)
        self._shared.counts.waiting += len(parts)

    def _next_part(self) -> RobotAnswer:
        if self._parts is None:
            return RobotAnswer(
                AnswerCode.NO_RESULT, text="there is no result: TRIGGER or WAIT comes first"
            )
        if self._parts and asyncio.get_running_loop().time() > self._parts_expire_at:
            self.forget_result()
            age = self._shared.settings.max_age
            return RobotAnswer(AnswerCode.NO_RESULT, text=f"the result is older than {age:g} s")
        if not self._parts:
            return RobotAnswer(AnswerCode.NO_PART)
        self._answer_has_part = True
        return RobotAnswer(AnswerCode.OK, len(self._parts) - 1, self._parts[0])

    def on_sent(self) -> None:
        """Count the part in the last answer as delivered; called after the answer was written."""
        if self._answer_has_part and self._parts:
            del self._parts[0]
            self._shared.counts.waiting -= 1
            self._shared.counts.delivered += 1
        self._answer_has_part = False

    def replace_answer(self, words: str) -> RobotAnswer:
        """Forget the result, and return an error instead of an answer that cannot be written."""
        self.forget_result()
        self._last_error = RobotAnswer(AnswerCode.UNREADABLE, text=words)
        return self._last_error

    def forget_result(self) -> None:
        """Forget the last result: the robot requests a newer one, or has disconnected."""
        parts, self._parts, self._answer_has_part = self._parts or [], None, False
        self._shared.counts.waiting -= len(parts)
        self._shared.counts.forgotten += len(parts)


def _time_left(deadline: float) -> float:
    """Return the seconds until a deadline, at least a millisecond."""
    return max(0.001, deadline - asyncio.get_running_loop().time())


@contextlib.asynccontextmanager
async def _hold_lock(lock: asyncio.Lock, deadline: float) -> AsyncIterator[None]:
    """Hold the lock while the block runs; raise CameraBusyError if it is not free in time."""
    try:
        async with asyncio.timeout_at(deadline):
            await lock.acquire()
    except TimeoutError as exc:
        raise CameraBusyError("another robot's request is under way at the camera") from exc
    try:
        yield
    finally:
        lock.release()
