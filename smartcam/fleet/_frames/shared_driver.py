"""Read the frames of a fleet's camera as a source of frames, by one request after the other."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from smartcam._extras import load
from smartcam.exceptions import (
    ConfigurationError,
    FrameSourceError,
    ResponseTimeoutError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.fleet._frames.caller import StreamCounts, as_source_error
from smartcam.fleet._frames.stream import HOLD_TIMEOUT
from smartcam.fleet._frames.wire import VIDEO, FrameForm
from smartcam.frames import FrameDriver

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.fleet._frames.caller import FrameClient
    from smartcam.fleet._frames.stream_form import FleetStreamRequest
    from smartcam.fleet._frames.units import VideoReceiver
    from smartcam.fleet._frames.wire import FleetFrame
    from smartcam.frames import (
        AwaitedTrigger,
        DeviceFeatures,
        Frame,
        FrameAddress,
        FrameSink,
        StreamFormat,
    )

logger: logging.Logger = logging.getLogger("smartcam.fleet")

ANSWER_TIMEOUT = 4.0
"""Seconds that a request may take for encoding and transfer, in addition to waiting for a frame."""

MAX_UNANSWERED_REQUESTS = 3
"""Number of consecutive requests without an answer after which a stream has ended."""

MAX_BROKEN_FRAMES = 10
"""Number of consecutive incomplete frames after which a stream has ended."""


class SharedFrameDriver(FrameDriver):
    """Frames of an open camera of a fleet.

    Args:
        address: address of the camera.
        frame_client: object that asks the agent for frames.
        request: form and rate of the frames.
    """

    sets_captured = True

    def __init__(
        self, address: FrameAddress, frame_client: FrameClient, request: FleetStreamRequest
    ) -> None:
        super().__init__(address)
        self._frame_client, self._request = frame_client, request
        self._task: asyncio.Task[None] | None = None
        self._video: VideoReceiver | None = None

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._frame_client.name

    async def open(self) -> StreamFormat:
        """Make the agent open the device.

        Raises:
            FrameSourceError: the agent cannot open the device, or there is no agent.
            UnsupportedError: the camera has no frames.
            MissingExtraError: the package that decodes H.264 is not installed here.
        """
        if self._request.form.name == VIDEO and self._request.decode:
            load("av")
        try:
            return await self._frame_client.read_format(self._request)
        except (FrameSourceError, UnsupportedError, ConfigurationError):
            raise
        except SmartCamError as exc:
            raise as_source_error(self.name, exc) from exc

    @property
    def features(self) -> DeviceFeatures:
        """The features of the device, through the camera's agent."""
        return self._frame_client.features

    async def trigger_by_owner(self, timeout: float, *, refuse: bool) -> Frame:
        """Trigger the device through the camera's agent, and return the picture.

        Raises:
            SmartCamError: the agent's error.
        """
        form = self._request.form
        picture = FrameForm("raw", None) if form.name == VIDEO else form
        return await self._frame_client.trigger(picture, timeout, wait=not refuse)

    async def trigger(
        self, pending: AwaitedTrigger, fire: Callable[[], Awaitable[object]] | None
    ) -> None:
        """Refuse a trigger line: the agent cannot call a function of this program.

        Raises:
            UnsupportedError: always.
        """
        del pending, fire
        raise UnsupportedError(
            f"{self.name}: its agent triggers it by software; `fire` cannot be called there"
        )

    async def start(self, sink: FrameSink) -> None:
        """Start to request one frame after the other."""
        if self._request.form.name == VIDEO:
            from smartcam.fleet._frames.units import VideoReceiver

            self._video = VideoReceiver(decode=self._request.decode)
        stream = self._frame_client.next_stream()
        self._task = asyncio.get_running_loop().create_task(
            self._run(sink, stream), name=f"frames of {self.name}"
        )
        self._task.add_done_callback(lambda _: self._frame_client.end_stream(stream))

    async def stop(self) -> None:
        """Stop requesting frames."""
        task, self._task = self._task, None
        video, self._video = self._video, None
        try:
            if task is not None:
                task.cancel()
                await asyncio.wait([task])
        finally:
            if video is not None:
                await video.close()

    async def close(self) -> None:
        """Stop requesting frames."""
        await self.stop()

    async def _run(self, sink: FrameSink, stream: int) -> None:
        try:
            end = await self._receive_until_end(sink, stream)
        except Exception as exc:
            logger.exception("%s ! its stream of frames failed", self.name)
            end = FrameSourceError(f"{self.name}: {exc!r}", source=self.name)
        sink.ended(end)

    async def _receive_until_end(self, sink: FrameSink, stream: int) -> FrameSourceError | None:
        """Receive frames until the stream ends; return the error that ended it."""
        loop = asyncio.get_running_loop()
        counts, unanswered_count, broken_count = StreamCounts(), 0, 0
        while True:
            try:
                deadline = loop.time() + HOLD_TIMEOUT + ANSWER_TIMEOUT
                answer, frames = await self._frame_client.request_frames(
                    "next_frame", deadline, self._arguments(stream), counts
                )
            except FrameSourceError as exc:
                return exc
            except ResponseTimeoutError as exc:
                unanswered_count += 1
                if unanswered_count >= MAX_UNANSWERED_REQUESTS:
                    return as_source_error(self.name, exc)
                continue
            except SmartCamError as exc:
                return as_source_error(self.name, exc)
            unanswered_count = 0
            if frames:
                broken_count = 0
                if answer["skipped"]:
                    sink.skipped(answer["skipped"])
                await self._pass_frames(sink, answer, frames)
            elif answer.get("ended"):
                return None
            elif "frame" in answer:
                broken_count += 1
                if broken_count >= MAX_BROKEN_FRAMES:
                    return FrameSourceError(
                        f"{self.name}: {broken_count} frames in a row did not come here whole",
                        source=self.name,
                    )

    def _arguments(self, stream: int) -> dict[str, Any]:
        """Return the arguments of the call for the next frame."""
        arguments = {**self._request.form.fields(), "stream": stream}
        control = self._request.rate_control
        if control is not None:
            arguments |= {"quality": control.quality, "min_interval": control.pause}
        if self._video is not None:
            arguments["last_number"] = self._video.last_number
        return arguments

    async def _pass_frames(
        self, sink: FrameSink, answer: dict[str, Any], frames: list[FleetFrame]
    ) -> None:
        """Pass received frames to the readers."""
        if self._video is not None:
            await self._video.give_frames(sink, answer, frames)
            return
        frame, control = frames[-1], self._request.rate_control
        if control is not None:
            age_here, age = frame.age, float(answer["frame"]["age"])
            control.record_arrival(len(frame.data), frame.captured + age, age_here - age, age=age)
            frame = replace(frame, rate=control.statistics())
        sink.frame(frame)
