"""Frames of a fleet's camera at a program: one on request, and a stream that readers read."""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any

from smartcam.calibration import CameraModel
from smartcam.exceptions import (
    CalibrationError,
    ConfigurationError,
    FrameSourceError,
    FrameTimeoutError,
    RemoteProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.fleet._frame_encoding import FORMATS
from smartcam.fleet._frame_wire import FrameForm, from_fields
from smartcam.fleet._frames import HOLD
from smartcam.frames import FrameDriver, StreamFormat, find_format

if TYPE_CHECKING:
    from smartcam.fleet._caller import Caller
    from smartcam.fleet._frame_wire import FleetFrame
    from smartcam.frames import FrameAddress, FrameSink

logger: logging.Logger = logging.getLogger("smartcam.fleet")

ANSWER = 4.0
"""Seconds for the answer to a request of a stream, beyond those that it waits for a frame: to
encode it, and for the way."""

MOST_SILENT = 3
"""Requests in a row without an answer after which a stream has ended."""

MOST_TORN = 10
"""Frames in a row that did not come whole after which it has ended, too."""

OPEN_TIMEOUT = 15.0
"""Seconds for an agent to open its device."""

MOST_LENSES = 16


class _StreamCounts:
    """What a stream's last frame said of those before it."""

    def __init__(self) -> None:
        self._last: tuple[int, int, int, int] | None = None

    def since(self, said: dict[str, Any]) -> tuple[int, int]:
        """Return how many were skipped, and lost, since the frame before."""
        now = int(said["stream"]), int(said["sent"]), int(said["skipped"]), int(said["lost"])
        last, self._last = self._last, now
        if last is None or last[0] != now[0]:  # the first one, or the agent took it for over
            last = now[0], 0, 0, 0
        sent, skipped, lost = (
            max(0, new - old) for new, old in zip(now[1:], last[1:], strict=True)
        )
        return skipped, lost + max(0, sent - 1)  # those that were sent and did not come


class FrameCaller:
    """Asks a camera's agent for frames.

    Args:
        name: of the camera, for frames and texts.
        caller: calls the agent.
    """

    def __init__(self, name: str, caller: Caller) -> None:
        self.name, self._caller = name, caller
        self._lenses: dict[tuple[int, int], CameraModel | None] = {}

    async def about(self, encoding: FrameForm) -> StreamFormat:
        """Return what frames come, as the device says; it is opened for that.

        Raises:
            SmartCamError: as the agent says.
        """
        loop = asyncio.get_running_loop()
        reply = await self._caller.call("about_frames", loop.time() + OPEN_TIMEOUT)
        said = reply.fields["answer"]
        try:
            rates = tuple(float(rate) for rate in said["rates"])
            size = int(said["width"]), int(said["height"])
            pixels = FORMATS.get(encoding.name, str(said["format"]))
            return StreamFormat(find_format(pixels), *size, rates)
        except (KeyError, TypeError, ValueError) as exc:
            raise RemoteProtocolError(f"{self.name}: what the agent says of it: {exc!r}") from exc

    async def one(
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
            encoding: how it is to come.
            timeout: seconds.
            max_age: seconds since it was captured at most; None: any.
            moment: it was exposed after this one, of ``time.monotonic()``.
            fresh: it was exposed after this call.

        Raises:
            FrameTimeoutError: none came in time.
            SmartCamError: as the agent says.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout
        arguments = {**encoding.fields(), "max_age": max_age, "fresh": fresh}
        if moment is not None:
            # what the agent's clock says then, or later: none that is older passes for it
            arguments["after"] = self._caller.clock_at_most(moment + self._ahead)
        try:
            while True:  # nothing is done by it, so it may be asked again where a part was dropped
                _, frame = await self.ask("frame", deadline, arguments, _StreamCounts())
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

    async def ask(
        self, do: str, deadline: float, arguments: dict[str, Any], counts: _StreamCounts
    ) -> tuple[dict[str, Any], FleetFrame | None]:
        """Ask once; return what the agent says, and the frame if there is one that came whole.

        Args:
            do: ``frame``, or ``next_frame`` of a stream.
            deadline: loop time until which the agent has to have it.
            arguments: of the call.
            counts: of the stream.
        """
        caller = self._caller
        caller.require()
        number = caller.program.next_call()
        incoming = caller.program.frames.expect(caller, number)
        said_at = asyncio.get_running_loop().time()
        try:
            reply = await caller.call(do, deadline, arguments, number=number)
            answer = reply.fields["answer"]
            said = answer.get("frame")
            if said is None:
                return answer, None
            data = await incoming.whole(int(said["size"]))
            if data is None:
                return answer, None
            caller.bound(float(answer["came"]), said_at)
            earliest, latest = caller.here(float(said["captured"]))
            skipped, lost = counts.since(answer) if "stream" in answer else (0, int(said["lost"]))
            lens = await self._lens(int(reply.fields["epoch"]), int(said["lens"]), deadline)
        except (KeyError, TypeError, ValueError) as exc:
            if isinstance(exc, SmartCamError):
                raise
            raise RemoteProtocolError(f"{self.name}: what the agent says: {exc!r}") from exc
        finally:
            incoming.forget()
        frame = from_fields(
            said,
            data,
            captured=(earliest + latest) / 2 - self._ahead,
            doubt=(latest - earliest) / 2,
            lost=lost,
            source=self.name,
            camera_info=lens,
        )
        return {**answer, "skipped": skipped}, frame

    @property
    def _ahead(self) -> float:
        """How far the loop's clock is ahead of the one that frames are timed by, seconds."""
        if self._caller.program.bus.local:
            return 0.0  # they keep the time that they have
        return asyncio.get_running_loop().time() - time.monotonic()

    async def _lens(self, epoch: int, number: int, deadline: float) -> CameraModel | None:
        """Return the lens that a frame names."""
        if not number:
            return None
        key = epoch, number
        if key not in self._lenses:
            reply = await self._caller.call("lens", deadline, {"lens": number})
            said = reply.fields["answer"]["lens"]
            try:
                found = None if said is None else CameraModel.from_data(said)
            except CalibrationError as exc:
                raise RemoteProtocolError(f"{self.name}: the agent's lens: {exc}") from exc
            self._lenses[key] = found
            if len(self._lenses) > MOST_LENSES:
                del self._lenses[next(iter(self._lenses))]
        return self._lenses[key]

    def leave(self, stream: int) -> None:
        """End a stream."""
        self._caller.tell("leave_frames", {"stream": stream})

    def next_stream(self) -> int:
        """Return the number of another stream."""
        return self._caller.program.next_call()


class SharedFrameDriver(FrameDriver):
    """Frames of a fleet's camera that is open.

    Args:
        address: the camera's.
        frames: asks for them.
        encoding: how they are to come.
    """

    times_frames = True

    def __init__(self, address: FrameAddress, frames: FrameCaller, encoding: FrameForm) -> None:
        super().__init__(address)
        self._frames, self._encoding = frames, encoding
        self._task: asyncio.Task[None] | None = None

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._frames.name

    async def open(self) -> StreamFormat:
        """Have the agent open the device.

        Raises:
            FrameSourceError: it cannot, or there is no agent.
            UnsupportedError: the camera has no frames.
        """
        try:
            return await self._frames.about(self._encoding)
        except (FrameSourceError, UnsupportedError, ConfigurationError):
            raise
        except SmartCamError as exc:
            raise as_source_error(self.name, exc) from exc

    async def start(self, sink: FrameSink) -> None:
        """Ask for one frame after the other."""
        self._task = asyncio.get_running_loop().create_task(
            self._ask(sink, self._frames.next_stream()), name=f"frames of {self.name}"
        )

    async def stop(self) -> None:
        """Ask no more."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.wait([task])

    async def close(self) -> None:
        """Ask no more."""
        await self.stop()

    async def _ask(self, sink: FrameSink, stream: int) -> None:
        try:
            end = await self._until_end(sink, stream)
        except Exception as exc:
            logger.exception("%s ! its frames end", self.name)
            end = FrameSourceError(f"{self.name}: {exc!r}", source=self.name)
        finally:
            self._frames.leave(stream)
        sink.ended(end)

    async def _until_end(self, sink: FrameSink, stream: int) -> FrameSourceError | None:
        """Take frames until there will be none, and return why."""
        loop = asyncio.get_running_loop()
        arguments = {**self._encoding.fields(), "stream": stream}
        counts, silent, torn = _StreamCounts(), 0, 0
        while True:
            try:
                deadline = loop.time() + HOLD + ANSWER
                answer, frame = await self._frames.ask("next_frame", deadline, arguments, counts)
            except FrameSourceError as exc:
                return exc
            except ResponseTimeoutError as exc:
                silent += 1
                if silent >= MOST_SILENT:
                    return as_source_error(self.name, exc)
                continue
            except SmartCamError as exc:
                return as_source_error(self.name, exc)
            silent = 0
            if frame is not None:
                torn = 0
                if answer["skipped"]:
                    sink.skipped(answer["skipped"])
                sink.frame(frame)
            elif answer.get("ended"):
                return None
            elif "frame" in answer:
                torn += 1
                if torn >= MOST_TORN:
                    return FrameSourceError(
                        f"{self.name}: {torn} frames in a row did not come here whole",
                        source=self.name,
                    )


def as_source_error(name: str, error: SmartCamError) -> FrameSourceError:
    """Return an error as readers of frames expect it."""
    made = FrameSourceError(str(error), source=name)
    made.__cause__ = error
    return made
