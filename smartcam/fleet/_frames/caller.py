"""Request frames of a fleet's camera from its agent: single frames and streams."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import (
    CalibrationError,
    FrameLostError,
    FrameSourceError,
    FrameTimeoutError,
    RemoteProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.fleet._frames.features import FleetFeatures
from smartcam.fleet._frames.wire import from_fields
from smartcam.frames import StreamFormat, find_format
from smartcam.geometry import CameraModel

if TYPE_CHECKING:
    from smartcam.fleet._bus.bus import Data
    from smartcam.fleet._frames.stream_form import FleetStreamRequest
    from smartcam.fleet._frames.wire import FleetFrame, FrameForm
    from smartcam.fleet._program.caller import Caller

logger: logging.Logger = logging.getLogger("smartcam.fleet")

OPEN_TIMEOUT = 15.0
"""Seconds that an agent has to open its device."""

ANSWER_TIMEOUT = 2.0
"""Seconds after a trigger's timeout until which the agent's reply may still arrive."""

MAX_LENSES = 16


class StreamCounts:
    """The counts of frames in the agent's last reply about a stream."""

    def __init__(self) -> None:
        self._last: tuple[int, int, int, int] | None = None

    def count_new(self, reply: dict[str, Any], received_count: int = 1) -> tuple[int, int]:
        """Return the numbers of frames skipped and lost since the last reply."""
        now = int(reply["stream"]), int(reply["sent"]), int(reply["skipped"]), int(reply["lost"])
        last, self._last = self._last, now
        if last is None or last[0] != now[0]:  # the agent has begun a new stream
            last = now[0], 0, 0, 0
        sent, skipped, lost = (
            max(0, new - old) for new, old in zip(now[1:], last[1:], strict=True)
        )
        return skipped, lost + max(
            0, sent - received_count
        )  # number of frames that were sent, but did not arrive


class FrameClient:
    """Asks a camera's agent for frames.

    Args:
        name: name of the camera, for frames and texts.
        caller: object that calls the camera's agent.
    """

    def __init__(self, name: str, caller: Caller) -> None:
        self.name, self._caller = name, caller
        self._lenses: dict[tuple[int, int], CameraModel | None] = {}

    async def read_format(self, request: FleetStreamRequest) -> StreamFormat:
        """Return the format of the requested frames; the agent opens its device for this.

        Raises:
            SmartCamError: the agent's error.
        """
        loop = asyncio.get_running_loop()
        reply = await self._caller.call("about_frames", loop.time() + OPEN_TIMEOUT)
        answer = reply.fields["answer"]
        try:
            rates = tuple(float(rate) for rate in answer["rates"])
            size = int(answer["width"]), int(answer["height"])
            return StreamFormat(
                find_format(request.pixel_format(str(answer["format"]))), *size, rates
            )
        except (KeyError, TypeError, ValueError) as exc:
            raise RemoteProtocolError(f"{self.name}: invalid format of frames: {exc!r}") from exc

    async def get_frame(
        self,
        encoding: FrameForm,
        timeout: float,
        *,
        max_age: float | None = None,
        moment: float | None = None,
        fresh: bool = False,
    ) -> FleetFrame:
        """Return one frame.

        Args:
            encoding: form of the frame.
            timeout: seconds to wait for the frame.
            max_age: largest age of the frame, seconds since its capture; None for any.
            moment: time of ``time.monotonic()`` after which the frame must be exposed.
            fresh: whether the frame must be exposed after this call.

        Raises:
            FrameTimeoutError: no frame came in time.
            SmartCamError: the agent's error.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout
        arguments = {**encoding.fields(), "max_age": max_age, "fresh": fresh}
        if moment is not None:
            # the latest time that this moment can have on the agent's clock
            arguments["after"] = self._caller.latest_agent_time(moment + self._clock_lead)
        try:
            while True:  # repeated if a part was dropped; this is safe, as nothing is triggered
                _, frame = await self.request_frame("frame", deadline, arguments, StreamCounts())
                if frame is not None:
                    return frame
                if loop.time() >= deadline:
                    raise FrameTimeoutError(
                        f"{self.name}: a frame was sent, but did not come here whole within "
                        f"{timeout:g} s",
                        source=self.name,
                    )
        except ResponseTimeoutError as exc:
            raise FrameTimeoutError(str(exc), source=self.name) from exc

    @property
    def features(self) -> FleetFeatures:
        """The features of the camera's device."""
        return FleetFeatures(self.name, self._caller)

    async def trigger(self, encoding: FrameForm, timeout: float, *, wait: bool) -> FleetFrame:
        """Trigger the device, and return the trigger's picture.

        Raises:
            FrameLostError: the picture was taken, but did not arrive completely.
            TriggerTimeoutError: the agent did not reply; whether it was triggered is unknown.
            SmartCamError: the agent's error.
        """
        deadline = asyncio.get_running_loop().time() + timeout + ANSWER_TIMEOUT
        arguments = {**encoding.fields(), "wait": wait}
        try:
            _, frame = await self.request_frame(
                "trigger_frame", deadline, arguments, StreamCounts(), timeout=timeout
            )
        except ResponseTimeoutError as exc:
            raise TriggerTimeoutError(str(exc), waited=exc.waited) from exc
        if frame is None:
            raise FrameLostError(
                f"{self.name}: the picture of the trigger was taken, and did not come here whole"
            )
        return frame

    async def request_frame(
        self,
        do: str,
        deadline: float,
        arguments: dict[str, Any],
        counts: StreamCounts,
        timeout: float | None = None,
    ) -> tuple[dict[str, Any], FleetFrame | None]:
        """Send one request; return the reply, and the frame if it arrived completely.

        Args:
            do: ``frame``, ``trigger_frame``, or ``next_frame`` of a stream.
            deadline: loop time at which the agent's work must end.
            arguments: arguments of the call.
            counts: counts of the stream.
            timeout: the user's timeout, seconds; by default the time until ``deadline``.
        """
        answer, frames = await self.request_frames(do, deadline, arguments, counts, timeout)
        return answer, frames[-1] if frames else None

    async def request_frames(
        self,
        do: str,
        deadline: float,
        arguments: dict[str, Any],
        counts: StreamCounts,
        timeout: float | None = None,
    ) -> tuple[dict[str, Any], list[FleetFrame]]:
        """Send one request like :meth:`request_frame`; H.264 can have several frames in a reply."""
        caller = self._caller
        caller.require()
        number = caller.program.next_call()
        incoming = caller.program.frames.expect_frame(caller, number)
        sent_at = asyncio.get_running_loop().time()
        try:
            reply = await caller.call(do, deadline, arguments, number=number, timeout=timeout)
            answer = reply.fields["answer"]
            fields = answer.get("frame")
            if fields is None:
                return answer, []
            data = await incoming.complete_data(int(fields["size"]))
            if data is None:
                return answer, []
            caller.narrow_clock_lead(float(answer["asked_at"]), sent_at)
            units = answer.get("units", [fields])
            stream = "stream" in answer
            skipped, lost = (
                counts.count_new(answer, len(units)) if stream else (0, int(fields["lost"]))
            )
            epoch, position = int(reply.fields["epoch"]), 0
            frames: list[FleetFrame] = []
            for unit in units:
                end = position + int(unit["size"])
                part = data if len(units) == 1 else memoryview(data)[position:end]
                frames.append(await self._read_frame(unit, part, lost, epoch, deadline))
                position, lost = end, 0
            if position != len(data):
                raise ValueError(f"{len(data)} bytes came, {position} were expected")
        except (KeyError, TypeError, ValueError) as exc:
            if isinstance(exc, SmartCamError):
                raise
            raise RemoteProtocolError(f"{self.name}: invalid reply of the agent: {exc!r}") from exc
        finally:
            incoming.forget()
        return {**answer, "skipped": skipped}, frames

    async def _read_frame(
        self, fields: dict[str, Any], data: Data, lost: int, epoch: int, deadline: float
    ) -> FleetFrame:
        """Return the frame for an agent's fields and bytes."""
        earliest, latest = self._caller.local_times(float(fields["captured"]))
        return from_fields(
            fields,
            data,
            captured=(earliest + latest) / 2 - self._clock_lead,
            uncertainty=(latest - earliest) / 2,
            lost=lost,
            source=self.name,
            camera_info=await self._lens(epoch, int(fields["lens"]), deadline),
        )

    @property
    def _clock_lead(self) -> float:
        """Seconds by which the loop's clock is ahead of frames' clock, ``time.monotonic()``."""
        if self._caller.program.bus.local:
            return 0.0  # the times of frames need no conversion
        return asyncio.get_running_loop().time() - time.monotonic()

    async def _lens(self, epoch: int, number: int, deadline: float) -> CameraModel | None:
        """Return the lens that a frame names by its number; None without one."""
        if not number:
            return None
        key = epoch, number
        if key not in self._lenses:
            reply = await self._caller.call("lens", deadline, {"lens": number})
            data = reply.fields["answer"]["lens"]
            try:
                lens = None if data is None else CameraModel.from_data(data)
            except CalibrationError as exc:
                raise RemoteProtocolError(f"{self.name}: invalid lens of the agent: {exc}") from exc
            self._lenses[key] = lens
            if len(self._lenses) > MAX_LENSES:
                del self._lenses[next(iter(self._lenses))]
        return self._lenses[key]

    def end_stream(self, stream: int) -> None:
        """Tell the agent that a stream has ended."""
        self._caller.notify("end_stream", {"stream": stream})

    def next_stream(self) -> int:
        """Return the number of a new stream."""
        return self._caller.program.next_call()


def as_source_error(name: str, error: SmartCamError) -> FrameSourceError:
    """Return an error as a :exc:`FrameSourceError`, which readers of frames expect."""
    source_error = FrameSourceError(str(error), source=name)
    source_error.__cause__ = error
    return source_error
