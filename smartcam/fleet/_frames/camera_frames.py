"""Share a camera's frames at its agent: one source for all programs.

A program with a stream requests one frame after the other. The request arrives before the next
frame, so it costs no time; a program that stops requesting gets no frames. Between two requests the
agent keeps a reader for the program, which skips and counts frames like any reader. The reader is
closed with its program, or after a time without a request; the device stops with the last reader.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from smartcam.exceptions import (
    FrameFormatError,
    FrameTimeoutError,
    LocalProtocolError,
    UnsupportedError,
)
from smartcam.fleet._frames.features import feature_fields
from smartcam.fleet._frames.stream import FrameStream, PictureStream, VideoStream
from smartcam.fleet._frames.wire import MAX_FRAME_BYTES, VIDEO, FrameForm, to_fields
from smartcam.fleet._program.program_name import role_of

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterator

    from smartcam.fleet._frames.encoding import FrameEncoder
    from smartcam.fleet._frames.sender import FrameSender
    from smartcam.fleet._frames.stream import FrameOrder, TakenFrame
    from smartcam.fleet._frames.video import SharedVideo
    from smartcam.frames import Frame, FrameSource
    from smartcam.frames._inside import SourceStatistics
    from smartcam.geometry import CameraModel
    from smartcam.observers import Observer

T = TypeVar("T")

MAX_STREAMS_PER_ROLE = 256
"""Largest number of streams of one camera that the programs of one role may have."""

MAX_STREAMS_PER_PROGRAM = 16
"""Largest number of streams of one camera that one program may have."""

MAX_FRAME_CALLS_PER_PROGRAM = 16
"""Largest number of calls for frames of one camera that one program may have pending: each may hold
a frame."""

MAX_ENCODINGS = 16
"""Number of encodings whose last frame is kept for other viewers with the same encoding."""

MAX_VIDEO_SETTINGS = 4
"""Largest number of settings of H.264 that are encoded at one time."""

MAX_LENSES = 16


class FramesOf(NamedTuple):
    """The source of a camera's frames.

    Attributes:
        make: function that returns the source; None: there is none.
        url: address of the source, without a password; for people.
        reporter: observer of the camera's sessions that reports the picture of each result;
            None: there is none.
    """

    make: Callable[[], FrameSource] | None
    url: str | None
    reporter: Observer | None = None


NO_FRAMES = FramesOf(None, None)


class _Encoded(NamedTuple):
    """The last frame in one encoding."""

    frame: Frame
    task: asyncio.Task[Frame]


@dataclass(eq=False)
class SharedFrames:
    """The frames of one camera, for programs.

    Args:
        name: name of the camera.
        make: function that returns the camera's source; None: the camera has none.
        sender: sender of the frames' bytes.
        encoder: encoder that makes frames small before they are sent.
        url: address of the source, without a password; for people.
        reports_pictures: whether observers of the camera get the picture of each result.
    """

    name: str
    make: Callable[[], FrameSource] | None
    sender: FrameSender
    encoder: FrameEncoder
    url: str | None = None
    reports_pictures: bool = False
    _source: FrameSource | None = None
    _opening: asyncio.Task[FrameSource] | None = None
    _viewers: dict[tuple[str, int], FrameStream] = field(
        default_factory=dict[tuple[str, int], FrameStream]
    )
    _asking: dict[str, int] = field(default_factory=dict[str, int])
    _videos: dict[FrameForm, SharedVideo] = field(default_factory=dict[FrameForm, "SharedVideo"])
    _encoded: dict[FrameForm, _Encoded] = field(default_factory=dict[FrameForm, _Encoded])
    _lenses: dict[int, CameraModel] = field(default_factory=dict[int, "CameraModel"])
    _numbers: itertools.count[int] = field(default_factory=lambda: itertools.count(1))
    _tasks: set[asyncio.Task[Any]] = field(default_factory=set["asyncio.Task[Any]"])
    _closed: bool = False

    # ------------------------------------------------------------------ life

    async def close(self) -> None:
        """End all streams, and release the device. Idempotent."""
        self._closed = True
        for viewer in self._viewers.values():
            viewer.close()
        self._viewers.clear()
        for video in [*self._videos.values()]:
            await video.close()
        self._videos.clear()
        tasks = [*self._tasks]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._encoded.clear()
        source, self._source = self._source, None
        if source is not None:
            await source.close()

    @property
    def closed(self) -> bool:
        """True once the device is released for good."""
        return self._closed

    @property
    def viewers(self) -> int:
        """Number of streams."""
        return len(self._viewers)

    @property
    def statistics(self) -> SourceStatistics | None:
        """Statistics of the source; None if it is not open."""
        return None if self._source is None else self._source.statistics()

    def forget(self, program: str) -> None:
        """Drop the streams of a program that has left the bus."""
        for key in [key for key in self._viewers if key[0] == program]:
            self._viewers.pop(key).close()

    async def source(self) -> FrameSource:
        """Return the source, opened if it is not open.

        Raises:
            UnsupportedError: the camera has none.
            FrameSourceError: the source cannot be opened; the next one tries again.

        Cancellation: the source is opened nevertheless, for the next viewer.
        """
        if self._source is not None:
            return self._source
        if self.make is None:
            raise UnsupportedError(
                f"{self.name} has no frames: its entry in the fleet file wants frames: URL, such "
                "as v4l2:///dev/video0"
            )
        if self._closed:
            raise LocalProtocolError(f"{self.name}: the agent ends")
        if self._opening is None or self._opening.done():
            self._opening = self._begin(self._open(self.make()), "frames")
        return await asyncio.shield(self._opening)

    async def _open(self, source: FrameSource) -> FrameSource:
        await source.__aenter__()
        self._source = source
        return source

    # ------------------------------------------------------------------ calls

    async def about(self, timeout: float) -> dict[str, Any]:
        """Return the format of the camera's frames, as the device reports it."""
        with self._within(timeout, "the device"):
            async with asyncio.timeout(timeout):
                made = (await self.source()).format
        return {
            "format": made.format.name,
            "width": made.width,
            "height": made.height,
            "rates": list(made.rates),
        }

    async def frame(
        self, order: FrameOrder, *, max_age: float | None, after: float | None, fresh: bool
    ) -> dict[str, Any]:
        """Send the frame that :meth:`get` returns."""
        asked_at = asyncio.get_running_loop().time()
        frame, took = await self.get(order, max_age=max_age, after=after, fresh=fresh)
        self._send([frame], order)
        return {"came": asked_at, "frame": self._frame_fields(frame, took)}

    async def get(
        self, order: FrameOrder, *, max_age: float | None, after: float | None, fresh: bool
    ) -> tuple[Frame, float]:
        """Return one frame, and the seconds of its encoding.

        Args:
            order: the asking program, and the form of the frame.
            max_age: largest age of the frame, seconds since it was captured; None for any.
            after: time of the agent's clock after which the frame must be exposed.
            fresh: whether the frame must be exposed after this request.
        """
        now = time.monotonic() + self.sender.ahead
        with self._counted(order), self._within(order.timeout, "a frame"):
            async with asyncio.timeout(order.timeout):
                source = await self.source()
                if fresh or after is not None:
                    moment = now if after is None else after
                    frame = await source.after(moment - self.sender.ahead, timeout=None)
                else:
                    age = math.inf if max_age is None else max_age
                    frame = await source.newest(max_age=age, timeout=None)
                return await self._encode(frame, order.encoding)

    async def trigger(self, order: FrameOrder, *, wait: bool) -> dict[str, Any]:
        """Trigger the device, and send the picture that this trigger caused."""
        asked_at = asyncio.get_running_loop().time()
        frame, took = await self.triggered(order, wait=wait)
        self._send([frame], order)
        return {"came": asked_at, "frame": self._frame_fields(frame, took)}

    async def triggered(self, order: FrameOrder, *, wait: bool) -> tuple[Frame, float]:
        """Trigger the device; return its picture, and the seconds of its encoding."""
        loop = asyncio.get_running_loop()
        end = loop.time() + order.timeout
        with self._counted(order):
            with self._within(order.timeout, "the device"):
                async with asyncio.timeout(order.timeout):
                    source = await self.source()
            frame = await source.trigger(
                timeout=max(1e-3, end - loop.time()), when_busy="wait" if wait else "refuse"
            )
            return await self._encode(frame, order.encoding)

    async def features(
        self, name: str | None, timeout: float, *, names_only: bool, value_only: bool
    ) -> dict[str, Any]:
        """Return the features of the device, or one of them, as JSON."""
        features = (await self._soon(timeout)).features
        if names_only:
            return {"names": await features.names(timeout=timeout)}
        if name is None:
            descriptions = [*(await features.describe(timeout=timeout)).values()]
        elif value_only:
            return {"value": await features[name].get(timeout=timeout)}
        else:
            descriptions = [await features[name].describe(timeout=timeout)]
        return {"features": [feature_fields(feature) for feature in descriptions]}

    async def set_feature(self, name: str, value: Any, timeout: float) -> dict[str, Any]:
        """Set a feature; return the value that the device accepted."""
        source = await self._soon(timeout)
        return {"value": await source.features[name].set(value, timeout=timeout)}

    async def execute_feature(self, name: str, timeout: float) -> None:
        """Execute a command of the device, to its end."""
        await (await self._soon(timeout)).features[name].execute(timeout=timeout)

    async def _soon(self, timeout: float) -> FrameSource:
        """Return the source, opened if it is not open."""
        with self._within(timeout, "the device"):
            async with asyncio.timeout(timeout):
                return await self.source()

    async def next(self, order: FrameOrder, stream: int) -> dict[str, Any]:
        """Send the new frames of a stream; an empty list after a time without a frame."""
        asked_at = asyncio.get_running_loop().time()
        key = order.program, stream
        with self._counted(order):
            viewer = self._viewers.get(key)
            if viewer is None:
                viewer = await self._view(key, order)
            if viewer.busy:
                raise LocalProtocolError(f"{self.name}: two requests for the frames of one stream")
            if isinstance(viewer, VideoStream) != (order.encoding.name == VIDEO):
                raise LocalProtocolError(f"{self.name}: a stream does not become {VIDEO}, nor back")
            viewer.wake()
            try:
                taken = await viewer.take(order)
            except FrameTimeoutError:
                raise
            except TimeoutError:
                return {"came": asked_at}
            except StopAsyncIteration:
                self._leave(key, viewer)
                return {"came": asked_at, "ended": True}
            except Exception:
                self._leave(key, viewer)
                raise
            finally:
                if self._viewers.get(key) is viewer:
                    viewer.mark_idle(lambda: self._leave(key, viewer))
        self._send([each.frame for each in taken], order)
        return {
            "came": asked_at,
            "stream": viewer.number,
            **viewer.counts(),
            **self._all_fields(taken),
        }

    async def _view(self, key: tuple[str, int], order: FrameOrder) -> FrameStream:
        """Begin a stream."""
        with self._within(order.timeout, "the device"):
            async with asyncio.timeout(order.timeout):
                source = await self.source()
        if key in self._viewers:
            return self._viewers[key]
        of_program = sum(program == key[0] for program, _ in self._viewers)
        role = role_of(key[0])
        like = sum(role_of(program) == role for program, _ in self._viewers)
        if like >= MAX_STREAMS_PER_ROLE or of_program >= MAX_STREAMS_PER_PROGRAM:
            raise LocalProtocolError(
                f"{self.name}: {like} streams of frames of role {role}, {of_program} of them this "
                "program's; no more are possible"
            )
        number = next(self._numbers)
        viewer: FrameStream
        if order.encoding.name == VIDEO:
            viewer = VideoStream(number, self._video(source, order.encoding), self._leave_video)
        else:
            viewer = PictureStream(number, source.reader(timeout=None), self._encode)
        self._viewers[key] = viewer
        return viewer

    def _video(self, source: FrameSource, form: FrameForm) -> SharedVideo:
        """Return the H.264 stream of one setting, for one more viewer."""
        from smartcam.fleet._frames.video import SharedVideo

        video = self._videos.get(form)
        if video is None or video.over:
            if len(self._videos) >= MAX_VIDEO_SETTINGS:
                raise LocalProtocolError(
                    f"{self.name}: {len(self._videos)} settings of H.264 are encoded; no more are "
                    "possible"
                )
            rates = source.format.rates
            encoder = self.encoder.h264(min(rates) if rates else None, form.bitrate)
            video = self._videos[form] = SharedVideo(source, encoder, self.name)
        video.viewers += 1
        return video

    def _leave_video(self, video: SharedVideo) -> None:
        """Remove a viewer of an H.264 stream; end the stream with its last viewer."""
        video.viewers -= 1
        if video.viewers:
            return
        for form in [form for form, known in self._videos.items() if known is video]:
            del self._videos[form]
        ending = video.end()
        self._tasks.add(ending)
        ending.add_done_callback(self._done)

    def leave(self, program: str, stream: int) -> None:
        """End a stream; does nothing if it is not known."""
        viewer = self._viewers.get((program, stream))
        if viewer is not None:
            self._leave((program, stream), viewer)

    def _leave(self, key: tuple[str, int], viewer: FrameStream) -> None:
        if self._viewers.get(key) is viewer:
            del self._viewers[key]
        viewer.close()
        if not self._viewers:
            self._encoded.clear()

    def lens(self, number: int) -> dict[str, Any]:
        """Return the lens with a number from a frame; None if it is not known."""
        lens = self._lenses.get(number)
        return {"lens": None if lens is None else lens.to_data()}

    # ------------------------------------------------------------------ a frame

    def _send(self, frames: list[Frame], order: FrameOrder) -> None:
        """Send the bytes of frames.

        Raises:
            FrameFormatError: the frame is larger than a frame may be.
        """
        size = sum(len(frame.data) for frame in frames)
        if size > MAX_FRAME_BYTES:
            raise FrameFormatError(
                f"{self.name}: a frame of {size} bytes, expected {MAX_FRAME_BYTES} at most",
                source=self.name,
            )
        data = frames[0].data if len(frames) == 1 else b"".join(frame.data for frame in frames)
        self.sender.send(order.program, order.call, data)

    def _frame_fields(self, frame: Frame, took: float) -> dict[str, Any]:
        """Return the fields that describe a frame."""
        return to_fields(frame, self.sender.ahead, took, self._lens_number(frame.camera_info))

    def _all_fields(self, taken: list[TakenFrame]) -> dict[str, Any]:
        """Return the fields that describe the frames of one reply."""
        if not taken[-1].number:
            return {"frame": self._frame_fields(taken[-1].frame, taken[-1].took)}
        units = [
            {**self._frame_fields(each.frame, each.took), "number": each.number} for each in taken
        ]
        return {"frame": {"size": sum(unit["size"] for unit in units)}, "units": units}

    async def _encode(self, frame: Frame, encoding: FrameForm) -> tuple[Frame, float]:
        """Return a frame encoded, once for all equal requests, and the seconds that it took."""
        if encoding.name == "raw":
            return frame, 0.0
        last = self._encoded.pop(encoding, None)
        if last is None or last.frame is not frame:
            last = _Encoded(
                frame, self._begin(self.encoder.encoded(frame, encoding), encoding.name)
            )
        self._encoded[encoding] = last
        if len(self._encoded) > MAX_ENCODINGS:
            del self._encoded[next(iter(self._encoded))]
        began = time.perf_counter()
        made = await asyncio.shield(last.task)
        return made, 0.0 if made is frame else time.perf_counter() - began

    def _begin(self, work: Coroutine[Any, Any, T], name: str) -> asyncio.Task[T]:
        """Start a task that other tasks await; it ends with the agent at the latest."""
        task = asyncio.get_running_loop().create_task(
            work, name=f"smartcam.fleet.{self.name}.{name}"
        )
        self._tasks.add(task)
        task.add_done_callback(self._done)
        return task

    def _done(self, task: asyncio.Task[Any]) -> None:
        self._tasks.discard(task)
        if not task.cancelled():
            task.exception()  # the waiting tasks got the error

    def _lens_number(self, lens: CameraModel | None) -> int:
        if lens is None:
            return 0
        for number, known in self._lenses.items():
            if known is lens:
                return number
        number = next(self._numbers)
        self._lenses[number] = lens
        if len(self._lenses) > MAX_LENSES:
            del self._lenses[next(iter(self._lenses))]
        return number

    @contextlib.contextmanager
    def _counted(self, order: FrameOrder) -> Iterator[None]:
        """Count the pending calls of a program."""
        under_way = self._asking.get(order.program, 0)
        if under_way >= MAX_FRAME_CALLS_PER_PROGRAM:
            raise LocalProtocolError(
                f"{self.name}: {under_way} calls of this program for frames are under way"
            )
        self._asking[order.program] = under_way + 1
        try:
            yield
        finally:
            left = self._asking[order.program] - 1
            if left:
                self._asking[order.program] = left
            else:
                del self._asking[order.program]

    @contextlib.contextmanager
    def _within(self, seconds: float, operation: str) -> Iterator[None]:
        """Raise a timeout in the block as an error that names the operation."""
        try:
            yield
        except TimeoutError as exc:
            if isinstance(exc, FrameTimeoutError):
                raise
            raise FrameTimeoutError(
                f"{self.name}: waited {seconds:.3g} s for {operation}, in vain", source=self.name
            ) from None
