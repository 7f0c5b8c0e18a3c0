"""Answer the requests of one robot at a gateway, and keep the parts that it may still get."""

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
    from smartcam.gateway._account import GatewayAccount
    from smartcam.gateway._lines import RobotRequest
    from smartcam.gateway._parts import Parts, Row
    from smartcam.gateway._settings import GatewaySettings
    from smartcam.models import Result

CANCEL_GRACE: Final = 0.2
"""Seconds after the deadline after which a call that has not ended by itself is cancelled."""

ASKING_FOR_PARTS = ("TRIGGER", "NEXT", "WAIT")
"""Words of requests for a part."""

WORDS = (*ASKING_FOR_PARTS, "STATUS", "WHY")
"""The words that a request may begin with."""

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
"""The code of an error; the first class that matches counts."""


class GatewayCamera:
    """The camera of a gateway, with the settings and counts that all robots share.

    Args:
        camera: the camera.
        settings: deadlines and ages.
        account: account that counts the parts.

    Attributes:
        camera: the camera; another object may replace it.
        turn: lock of the robot that triggers.
    """

    def __init__(
        self, camera: Camera, settings: GatewaySettings, parts: Parts, account: GatewayAccount
    ) -> None:
        self.camera: Camera = camera
        self.settings: GatewaySettings = settings
        self.parts: Parts = parts
        self.account: GatewayAccount = account
        self.turn = asyncio.Lock()


class RobotRequests:
    """The requests of one robot, one after the other.

    Args:
        shared: the camera that the robot shares with other robots.
    """

    def __init__(self, shared: GatewayCamera) -> None:
        self._shared = shared
        self._rows: list[Row] | None = None  # rows of the last result; None without one
        self._until = 0.0  # loop time until which the rows may be asked for
        self._last = RobotAnswer(AnswerCode.NONE, words="no request has failed")
        self._gives_row = False  # the answer being written has the first row

    # ------------------------------------------------------------------ a request

    async def answer(self, request: RobotRequest, deadline: float) -> RobotAnswer:
        """Return the answer to a request, no later than :data:`CANCEL_GRACE` after the deadline."""
        try:
            async with asyncio.timeout_at(deadline + CANCEL_GRACE):
                answer = await self._answer(request, deadline)
        except (SmartCamError, TimeoutError) as exc:
            code = next((code for kind, code in CODES if isinstance(exc, kind)), AnswerCode.FAULT)
            answer = RobotAnswer(code, words=str(exc) or "no answer of the camera in time")
        except Exception as exc:  # noqa: BLE001 - a robot waits, and is told whatever it was
            _log.exception("a request failed")
            answer = RobotAnswer(AnswerCode.FAULT, words=f"unexpected {exc!r:.100}")
        if answer.code.is_error:
            self._last = answer
        return answer

    async def _answer(self, request: RobotRequest, deadline: float) -> RobotAnswer:
        if request.word not in WORDS or (request.application is not None) > (
            request.word == "TRIGGER"
        ):
            words = f"expected {', '.join(WORDS)} (TRIGGER n: with application n)"
            return RobotAnswer(AnswerCode.BAD_REQUEST, words=f"{words}, got {request.given!r}")
        if request.word == "STATUS":
            return self._status()
        if request.word == "WHY":
            return RobotAnswer(AnswerCode.PART, words=f"{self._last.code.name} {self._last.words}")
        if request.word != "NEXT":
            self.forget()
            self._keep(await self._result(request, deadline))
        return self._next()

    async def _result(self, request: RobotRequest, deadline: float) -> Result:
        camera = self._shared.camera
        if request.word == "WAIT":
            return await camera.next_result(timeout=_left(deadline))
        # half of the time is left for the camera
        async with _turn(self._shared.turn, deadline - 0.5 * self._shared.settings.timeout):
            return await camera.trigger(request.application, timeout=_left(deadline))

    def _status(self) -> RobotAnswer:
        camera = self._shared.camera
        running = camera.connected and Status.RUNNING in camera.status
        values = [int(camera.connected), int(running), camera.active_application or 0]
        return RobotAnswer(AnswerCode.PART, values=values)

    # ------------------------------------------------------------------ parts

    def _keep(self, result: Result) -> None:
        rows = self._shared.parts.rows(result.value, result.application)
        self._rows = rows
        self._until = asyncio.get_running_loop().time() + self._shared.settings.max_age
        self._shared.account.parts += len(rows)
        self._shared.account.waiting += len(rows)

    def _next(self) -> RobotAnswer:
        if self._rows is None:
            return RobotAnswer(
                AnswerCode.NO_RESULT, words="there is no result: TRIGGER or WAIT comes first"
            )
        if self._rows and asyncio.get_running_loop().time() > self._until:
            self.forget()
            age = self._shared.settings.max_age
            return RobotAnswer(AnswerCode.NO_RESULT, words=f"the result is older than {age:g} s")
        if not self._rows:
            return RobotAnswer(AnswerCode.NONE)
        self._gives_row = True
        return RobotAnswer(AnswerCode.PART, len(self._rows) - 1, self._rows[0])

    def sent(self) -> None:
        """Count the part of the last answer as delivered; called when it was written."""
        if self._gives_row and self._rows:
            del self._rows[0]
            self._shared.account.waiting -= 1
            self._shared.account.delivered += 1
        self._gives_row = False

    def failed(self, words: str) -> RobotAnswer:
        """Return the answer instead of one that cannot be written; the result is forgotten."""
        self.forget()
        self._last = RobotAnswer(AnswerCode.UNREADABLE, words=words)
        return self._last

    def forget(self) -> None:
        """Forget the last result: a newer one is asked for, or the robot has disconnected."""
        rows, self._rows, self._gives_row = self._rows or [], None, False
        self._shared.account.waiting -= len(rows)
        self._shared.account.forgotten += len(rows)


def _left(deadline: float) -> float:
    """Return the seconds until a deadline, at least a millisecond."""
    return max(0.001, deadline - asyncio.get_running_loop().time())


@contextlib.asynccontextmanager
async def _turn(lock: asyncio.Lock, deadline: float) -> AsyncIterator[None]:
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
