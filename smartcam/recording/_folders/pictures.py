"""Record the pictures of an agent's cameras with their results."""

from __future__ import annotations

import asyncio
import logging
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final

from smartcam.backoff import Backoff
from smartcam.exceptions import SmartCamError
from smartcam.frames._inside import FrameTap
from smartcam.recording._mcap.form import (
    MAX_PICTURE_SIZE_BYTES,
    RecordedError,
    RecordedPicture,
    captured_at,
)
from smartcam.recording._picture_matching import PictureMatcher
from smartcam.recording._pictures.result_pictures import MAX_MATCHED_BYTES
from smartcam.recording._recorder import MAX_WAITING_BYTES

if TYPE_CHECKING:
    from typing import Any

    from smartcam.fleet import FleetServer
    from smartcam.frames import Frame, FrameSource
    from smartcam.models import Result
    from smartcam.recording._folders.camera_recording import CameraRecording
    from smartcam.recording._folders.writer import FolderWriter

logger: logging.Logger = logging.getLogger("smartcam.recording")

MAX_BYTES_WITH_PICTURES: Final = 3 * MAX_WAITING_BYTES // 4
"""A picture is added only if, with it, at most this many bytes wait for the disk; the rest of the
room is for results."""

RETRY: Final = Backoff(initial=1.0, maximum=30.0)
"""Delays before a lost source of pictures is opened again."""


class FleetPictures:
    """Adds the pictures of cameras to their recordings, as long as the agent has the cameras.

    Args:
        server: agent of the cameras.
        writer: writer of the recordings.
        records_all: whether every picture is recorded, or only pictures of results.
    """

    def __init__(self, server: FleetServer, writer: FolderWriter, *, records_all: bool) -> None:
        self._server, self._writer, self._records_all = server, writer, records_all
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._matchers: dict[str, PictureMatcher] = {}

    def start_recording(self, recording: CameraRecording) -> None:
        """Record the pictures of a camera from now on; do nothing if they already are recorded."""
        task = self._tasks.get(recording.camera)
        if task is None or task.done():
            name = f"smartcam.recordings.pictures[{recording.camera}]"
            loop = asyncio.get_running_loop()
            self._tasks[recording.camera] = loop.create_task(self._record(recording), name=name)

    def add_result(self, recording: CameraRecording, result: Result[Any]) -> None:
        """Record the picture of a result, found by its time."""
        matcher = self._matchers.get(recording.camera)
        if matcher is not None:
            matcher.results.append(result)
            self._put_matched(recording, matcher)

    def add_reported(self, recording: CameraRecording, result: Result[Any], frame: Frame) -> None:
        """Record a picture that the camera itself sent as the result's picture."""
        number, received_at = result.number, result.received_at
        camera, at = recording.camera, captured_at(frame)
        self._put(recording, RecordedPicture(camera, at, frame, 0, number, received_at))

    async def stop(self) -> None:
        """Record no more pictures.

        Cancellation: takes effect when the tasks have ended, which happens at once.
        """
        tasks = [*self._tasks.values()]
        self._tasks.clear()
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    async def _record(self, recording: CameraRecording) -> None:
        """Record as long as the agent has the camera and the camera has pictures."""
        delays, logged = RETRY.delays(), ""
        while True:
            camera = self._server.shared_cameras.get(recording.camera)
            if camera is None or camera.frames.closed or camera.frames.make is None:
                return
            if camera.frames.reports_pictures:
                return
            reason = "they ended"
            try:
                if await self._receive(recording, await camera.frames.source()):
                    delays, logged = RETRY.delays(), ""
            except (SmartCamError, OSError) as exc:
                reason = str(exc)
            except Exception as exc:  # a driver may be a plug-in's
                logger.exception("%s ! its pictures are not recorded", recording.camera)
                reason = repr(exc)
            if reason != logged and not camera.frames.closed:
                logged = reason
                self._report(recording, reason)
            await asyncio.sleep(next(delays))

    async def _receive(self, recording: CameraRecording, source: FrameSource) -> bool:
        """Receive pictures until the source ends; return whether any came."""
        has_received = False
        matcher = PictureMatcher(MAX_MATCHED_BYTES)

        def on_frame(frame: Frame) -> bool:
            nonlocal has_received
            has_received = True
            picture = RecordedPicture(recording.camera, captured_at(frame), frame)
            if self._records_all:
                return self._put(recording, picture)
            matcher.add_picture(picture)
            self._put_matched(recording, matcher)
            return True

        tap = FrameTap(
            source, on_frame, lambda: self._writer.waiting_bytes > MAX_BYTES_WITH_PICTURES // 2
        )
        if not self._records_all:
            self._matchers[recording.camera] = matcher
        try:
            await tap.pass_until_end()
        finally:
            self._matchers.pop(recording.camera, None)
            tap.close()
        return has_received

    def _put_matched(self, recording: CameraRecording, matcher: PictureMatcher) -> None:
        for _, picture, _ in matcher.take_matched_by_time():
            if picture is not None:
                at = captured_at(picture)
                self._put(recording, RecordedPicture(recording.camera, at, picture))

    def _put(self, recording: CameraRecording, picture: RecordedPicture) -> bool:
        """Write a picture, or leave it out and count it if results need the room."""
        size = memoryview(picture.frame.data).nbytes
        fits = self._writer.waiting_bytes + size <= MAX_BYTES_WITH_PICTURES
        return self._writer.put(
            recording, picture, size if fits and size <= MAX_PICTURE_SIZE_BYTES else -1
        )

    def _report(self, recording: CameraRecording, reason: str) -> None:
        """Report in the log and in the recording why a camera's pictures are not recorded."""
        logger.warning("%s ! its pictures are not recorded: %s", recording.camera, reason)
        text = f"its pictures are not recorded: {reason}"
        error = RecordedError(recording.camera, datetime.now(UTC), "FrameSourceError", text, None)
        self._writer.put(recording, error, len(text))
