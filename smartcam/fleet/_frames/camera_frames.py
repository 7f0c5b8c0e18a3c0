"""Share a camera's frames at its agent: one source for all programs.

A program with a stream requests one frame after the other. Usually a request arrives before the
next frame, so that the frame is not delayed; a program that stops requesting gets no frames.
Between two requests the agent keeps a reader for the program, which skips and counts frames like
any reader. The agent closes the reader when the program leaves, or after some time without a
request. When the last reader is closed, the device stops streaming.
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
    from smartcam.fleet._frames.stream import FrameCall, TakenFrame
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
"""Largest number of unanswered calls for frames of one camera that one program may have, since each
call may hold a frame in memory."""

MAX_ENCODINGS = 16
"""Number of encodings whose last frame is kept for other programs with the same encoding."""

MAX_VIDEO_SETTINGS = 4
"""Largest number of different H.264 settings that are encoded at the same time."""

MAX_LENSES = 16


class FrameSupply(NamedTuple):
    """The origin of a camera's frames and pictures.

    Attributes:
        make: function that returns the source of frames; None: there is none.
        url: address of the source, without a password; for people.
        reporter: observer of the camera's sessions that reports the picture of each result;
            None: no reports.
    """

    make: Callable[[], FrameSource] | None
    url: str | None
    reporter: Observer | None = None


NO_FRAME_SUPPLY = FrameSupply(None, None)


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
        encoder: encoder that compresses frames before they are sent.
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
    _opening_task: asyncio.Task[FrameSource] | None = None
    _streams: dict[tuple[str, int], FrameStream] = field(
        default_factory=dict[tuple[str, int], FrameStream]
    )
    _pending_calls: dict[str, int] = field(default_factory=dict[str, int])
    _videos: dict[FrameForm, SharedVideo] = field(default_factory=dict[FrameForm, "SharedVideo"])
    _encoded: dict[FrameForm, _Encoded] = field(default_factory=dict[FrameForm, _Encoded])
    _lenses: dict[int, CameraModel] = field(default_factory=dict[int, "CameraModel"])
    _numbers: itertools.count[int] = field(default_factory=lambda: itertools.count(1))
    _tasks: set[asyncio.Task[Any]] = field(default_factory=set["asyncio.Task[Any]"])
    _closed: bool = False

    # ------------------------------------------------------------------ open and close

    async def close(self) -> None:
        """End all streams, and release the device. Idempotent."""
        self._closed = True
        for stream in self._streams.values():
            stream.close()
        self._streams.clear()
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
    def stream_count(self) -> int:
        """Number of streams."""
        return len(self._streams)

    @property
    def statistics(self) -> SourceStatistics | None:
        """Statistics of the source; None if it is not open."""
        return None if self._source is None else self._source.statistics()

    def forget_program(self, program: str) -> None:
        """Close the streams of a program that has left the bus."""
        for key in [key for key in self._streams if key[0] == program]:
            self._streams.pop(key).close()

    async def source(self) -> FrameSource:
        """Return the source; open it first if it is not open.

        Raises:
            UnsupportedError: the camera has no source of frames.
            FrameSourceError: the source cannot be opened; the next call tries again.

        Cancellation: the source is opened nevertheless, for the next call.
        """
        if self._source is not None:
            return self._source
        if self.make is None:
            raise UnsupportedError(
                f"{self.name} has no frames: add `frames: URL` to its entry in the fleet file, "
                "such as v4l2:///dev/video0"
            )
        if self._closed:
            raise LocalProtocolError(f"{self.name}: the agent ends")
        if self._opening_task is None or self._opening_task.done():
            self._opening_task = self._start_task(self._open(self.make()), "frames")
        return await asyncio.shield(self._opening_task)

    async def _open(self, source: FrameSource) -> FrameSource:
        await source.__aenter__()
        self._source = source
        return source

    # ------------------------------------------------------------------ calls

    async def format_fields(self, timeout: float) -> dict[str, Any]:
        """Return the format of the camera's frames, as the device reports it."""
        with self._naming_timeout(timeout, "the device"):
            async with asyncio.timeout(timeout):
                source_format = (await self.source()).format
        return {
            "format": source_format.format.name,
            "width": source_format.width,
            "height": source_format.height,
            "rates": list(source_format.rates),
        }

    async def send_frame(
        self, call: FrameCall, *, max_age: float | None, after: float | None, fresh: bool
    ) -> dict[str, Any]:
        """Send the frame that :meth:`get_frame` returns; return the fields of the reply."""
        asked_at = asyncio.get_running_loop().time()
        frame, encoding_time = await self.get_frame(call, max_age=max_age, after=after, fresh=fresh)
        self._send_bytes([frame], call)
        return {"asked_at": asked_at, "frame": self._frame_fields(frame, encoding_time)}

    async def get_frame(
        self, call: FrameCall, *, max_age: float | None, after: float | None, fresh: bool
    ) -> tuple[Frame, float]:
        """Return one frame, and the seconds that its encoding took.

        Args:
            call: the asking program, and the form of the frame.
            max_age: largest age of the frame, seconds since it was captured; None for any.
            after: time of the agent's clock after which the frame must be exposed.
            fresh: whether the frame must be exposed after this request.
        """
        now = time.monotonic() + self.sender.clock_lead
        with self._counting_call(call), self._naming_timeout(call.timeout, "a frame"):
            async with asyncio.timeout(call.timeout):
                source = await self.source()
                if fresh or after is not None:
                    moment = now if after is None else after
                    frame = await source.after(moment - self.sender.clock_lead, timeout=None)
                else:
                    age = math.inf if max_age is None else max_age
                    frame = await source.newest(max_age=age, timeout=None)
                return await self._encode(frame, call.encoding)

    async def send_triggered_frame(self, call: FrameCall, *, wait: bool) -> dict[str, Any]:
        """Trigger the device, and send this trigger's picture; return the fields of the reply."""
        asked_at = asyncio.get_running_loop().time()
        frame, encoding_time = await self.trigger_frame(call, wait=wait)
        self._send_bytes([frame], call)
        return {"asked_at": asked_at, "frame": self._frame_fields(frame, encoding_time)}

    async def trigger_frame(self, call: FrameCall, *, wait: bool) -> tuple[Frame, float]:
        """Trigger the device; return its picture, and the seconds that its encoding took."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + call.timeout
        with self._counting_call(call):
            with self._naming_timeout(call.timeout, "the device"):
                async with asyncio.timeout(call.timeout):
                    source = await self.source()
            frame = await source.trigger(
                timeout=max(1e-3, deadline - loop.time()), when_busy="wait" if wait else "refuse"
            )
            return await self._encode(frame, call.encoding)

    async def features(
        self, name: str | None, timeout: float, *, names_only: bool, value_only: bool
    ) -> dict[str, Any]:
        """Return the features of the device, or the feature with this name, for JSON."""
        features = (await self._open_source_within(timeout)).features
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
        source = await self._open_source_within(timeout)
        return {"value": await source.features[name].set(value, timeout=timeout)}

    async def execute_feature(self, name: str, timeout: float) -> None:
        """Execute a command of the device, and wait until it is done."""
        await (await self._open_source_within(timeout)).features[name].execute(timeout=timeout)

    async def _open_source_within(self, timeout: float) -> FrameSource:
        """Return the source; open it first if it is not open, within a timeout."""
        with self._naming_timeout(timeout, "the device"):
            async with asyncio.timeout(timeout):
                return await self.source()

    async def send_next_frames(self, call: FrameCall, stream_number: int) -> dict[str, Any]:
        """Send the next frames of a stream, and return the fields of the reply.

        If no frame comes in time, the reply is without frames.
        """
        asked_at = asyncio.get_running_loop().time()
        key = call.program, stream_number
        with self._counting_call(call):
            stream = self._streams.get(key)
            if stream is None:
                stream = await self._begin_stream(key, call)
            if stream.busy:
                raise LocalProtocolError(f"{self.name}: two requests for the frames of one stream")
            if isinstance(stream, VideoStream) != (call.encoding.name == VIDEO):
                raise LocalProtocolError(f"{self.name}: a stream cannot change from or to {VIDEO}")
            stream.mark_busy()
            try:
                taken = await stream.take_frames(call)
            except FrameTimeoutError:
                raise
            except TimeoutError:
                return {"asked_at": asked_at}
            except StopAsyncIteration:
                self._end_stream(key, stream)
                return {"asked_at": asked_at, "ended": True}
            except Exception:
                self._end_stream(key, stream)
                raise
            finally:
                if self._streams.get(key) is stream:
                    stream.mark_idle(lambda: self._end_stream(key, stream))
        self._send_bytes([each.frame for each in taken], call)
        return {
            "asked_at": asked_at,
            "stream": stream.number,
            **stream.counts(),
            **self._all_fields(taken),
        }

    async def _begin_stream(self, key: tuple[str, int], call: FrameCall) -> FrameStream:
        """Return a new stream with this key, or the one that another call has begun meanwhile."""
        with self._naming_timeout(call.timeout, "the device"):
            async with asyncio.timeout(call.timeout):
                source = await self.source()
        if key in self._streams:
            return self._streams[key]
        program_count = sum(program == key[0] for program, _ in self._streams)
        role = role_of(key[0])
        role_count = sum(role_of(program) == role for program, _ in self._streams)
        if role_count >= MAX_STREAMS_PER_ROLE or program_count >= MAX_STREAMS_PER_PROGRAM:
            raise LocalProtocolError(
                f"{self.name}: {role_count} streams of frames of role {role}, {program_count} of "
                "them this program's; no more are possible"
            )
        number = next(self._numbers)
        stream: FrameStream
        if call.encoding.name == VIDEO:
            video = self._get_video(source, call.encoding)
            stream = VideoStream(number, video, self._release_video)
        else:
            stream = PictureStream(number, source.reader(timeout=None), self._encode)
        self._streams[key] = stream
        return stream

    def _get_video(self, source: FrameSource, form: FrameForm) -> SharedVideo:
        """Return the shared H.264 of one setting, and count one more stream that uses it."""
        from smartcam.fleet._frames.video import SharedVideo

        video = self._videos.get(form)
        if video is None or video.has_ended:
            if len(self._videos) >= MAX_VIDEO_SETTINGS:
                raise LocalProtocolError(
                    f"{self.name}: {len(self._videos)} settings of H.264 are encoded; no more are "
                    "possible"
                )
            rates = source.format.rates
            encoder = self.encoder.h264(min(rates) if rates else None, form.bitrate)
            video = self._videos[form] = SharedVideo(source, encoder, self.name)
        video.viewer_count += 1
        return video

    def _release_video(self, video: SharedVideo) -> None:
        """Count one stream less that uses the shared H.264; close it after the last one."""
        video.viewer_count -= 1
        if video.viewer_count:
            return
        for form in [form for form, known in self._videos.items() if known is video]:
            del self._videos[form]
        closing = video.start_closing()
        self._tasks.add(closing)
        closing.add_done_callback(self._on_task_done)

    def end_stream(self, program: str, stream_number: int) -> None:
        """End a stream; does nothing if there is none with this number."""
        stream = self._streams.get((program, stream_number))
        if stream is not None:
            self._end_stream((program, stream_number), stream)

    def _end_stream(self, key: tuple[str, int], stream: FrameStream) -> None:
        if self._streams.get(key) is stream:
            del self._streams[key]
        stream.close()
        if not self._streams:
            self._encoded.clear()

    def lens_fields(self, number: int) -> dict[str, Any]:
        """Return the lens that a frame names by this number; None in the field if it is unknown."""
        lens = self._lenses.get(number)
        return {"lens": None if lens is None else lens.to_data()}

    # ------------------------------------------------------------------ send and encode

    def _send_bytes(self, frames: list[Frame], call: FrameCall) -> None:
        """Send the bytes of frames.

        Raises:
            FrameFormatError: the frames are larger than :data:`MAX_FRAME_BYTES`.
        """
        size = sum(len(frame.data) for frame in frames)
        if size > MAX_FRAME_BYTES:
            raise FrameFormatError(
                f"{self.name}: a frame of {size} bytes, expected {MAX_FRAME_BYTES} at most",
                source=self.name,
            )
        data = frames[0].data if len(frames) == 1 else b"".join(frame.data for frame in frames)
        self.sender.send(call.program, call.call, data)

    def _frame_fields(self, frame: Frame, encoding_time: float) -> dict[str, Any]:
        """Return the fields that describe a frame."""
        return to_fields(
            frame, self.sender.clock_lead, encoding_time, self._lens_number(frame.camera_info)
        )

    def _all_fields(self, taken: list[TakenFrame]) -> dict[str, Any]:
        """Return the fields that describe the frames of one reply."""
        if not taken[-1].number:
            return {"frame": self._frame_fields(taken[-1].frame, taken[-1].encoding_time)}
        access_units = [
            {**self._frame_fields(each.frame, each.encoding_time), "number": each.number}
            for each in taken
        ]
        size = sum(unit["size"] for unit in access_units)
        return {"frame": {"size": size}, "units": access_units}

    async def _encode(self, frame: Frame, encoding: FrameForm) -> tuple[Frame, float]:
        """Return a frame encoded, and the seconds that this took; equal requests share the work."""
        if encoding.name == "raw":
            return frame, 0.0
        last = self._encoded.pop(encoding, None)
        if last is None or last.frame is not frame:
            last = _Encoded(
                frame, self._start_task(self.encoder.encode(frame, encoding), encoding.name)
            )
        self._encoded[encoding] = last
        if len(self._encoded) > MAX_ENCODINGS:
            del self._encoded[next(iter(self._encoded))]
        started_at = time.perf_counter()
        encoded = await asyncio.shield(last.task)
        return encoded, 0.0 if encoded is frame else time.perf_counter() - started_at

    def _start_task(self, work: Coroutine[Any, Any, T], name: str) -> asyncio.Task[T]:
        """Start a task that other tasks await; :meth:`close` cancels it."""
        task = asyncio.get_running_loop().create_task(
            work, name=f"smartcam.fleet.{self.name}.{name}"
        )
        self._tasks.add(task)
        task.add_done_callback(self._on_task_done)
        return task

    def _on_task_done(self, task: asyncio.Task[Any]) -> None:
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
    def _counting_call(self, call: FrameCall) -> Iterator[None]:
        """Count the block as a pending call of its program; refuse too many."""
        pending_count = self._pending_calls.get(call.program, 0)
        if pending_count >= MAX_FRAME_CALLS_PER_PROGRAM:
            raise LocalProtocolError(
                f"{self.name}: {pending_count} calls of this program for frames are under way"
            )
        self._pending_calls[call.program] = pending_count + 1
        try:
            yield
        finally:
            pending_count = self._pending_calls[call.program] - 1
            if pending_count:
                self._pending_calls[call.program] = pending_count
            else:
                del self._pending_calls[call.program]

    @contextlib.contextmanager
    def _naming_timeout(self, seconds: float, operation: str) -> Iterator[None]:
        """Turn a ``TimeoutError`` of the block into an error that names the operation."""
        try:
            yield
        except TimeoutError as exc:
            if isinstance(exc, FrameTimeoutError):
                raise
            raise FrameTimeoutError(
                f"{self.name}: waited {seconds:.3g} s for {operation}, in vain", source=self.name
            ) from None
