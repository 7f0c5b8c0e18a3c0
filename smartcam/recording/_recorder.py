"""Record into a file: an observer collects items, and a thread writes them.

The observer's methods put their arguments into a list and return. A thread takes the list twice a
second, writes it as one chunk of the file and syncs the chunk to the disk. So a crash, even of the
machine, loses about half a second. No item except pictures is left out: if the disk is full or too
slow, the recording ends with an error, and never has a gap.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import errno
import json
import os
import stat
import threading
from datetime import UTC, datetime
from typing import IO, TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

import smartcam
from smartcam._arguments import check_flag, check_kind, check_path, check_text
from smartcam._extras import from_part, load
from smartcam._forks import notify_of_forks
from smartcam.exceptions import ConfigurationError, RecordingError, SmartCamError
from smartcam.models import CameraEvent, Connected, Reconnected, Result
from smartcam.observers import Observer, RawFrame, TraceEntry
from smartcam.recording._exclusive_files import open_exclusively
from smartcam.recording._mcap.bodies import LastBodies
from smartcam.recording._mcap.form import (
    ANNOTATIONS,
    ANNOTATIONS_SCHEMA,
    CAMERA_METADATA,
    FILE_METADATA,
    FORMAT,
    KINDS,
    MAX_NAME_CHARACTERS,
    MAX_PICTURE_SIZE_BYTES,
    PICTURES,
    PROFILE,
    RecordedError,
    RecordedPicture,
    captured_at,
    checked_bytes,
    load_compress,
    message_of,
    nanoseconds,
    topic_of,
)
from smartcam.recording._mcap.json import FrameTexts, data_of
from smartcam.recording._mcap.writer import McapWriter
from smartcam.settings import is_fleet, parse_address

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path
    from types import TracebackType
    from typing import Self

    from smartcam.frames import Frame, FrameSource
    from smartcam.frames._inside import ReaderStatistics
    from smartcam.recording._mcap.form import Item

INTERVAL = 0.5
"""Seconds between two chunks: a crash loses at most a second, writing included. The index of the
chunks is kept in memory until the end: about 25 MB for a day without a pause."""

CHUNK = 1 << 20
"""Number of waiting bytes at which a chunk is written before the interval ends; also the size at
which a chunk ends."""

MAX_WAITING_BYTES = 1 << 26
"""Largest number of bytes that wait for the disk before the recording gives up: a minute of a fast
camera."""

MAX_WAITING_PICTURE_BYTES = 1 << 26
"""Largest number of bytes of pictures that wait for the disk before further ones are left out; a
single picture may be larger."""

VIDEO_SUFFIX = ".mkv"
"""Suffix of a file that becomes a video."""

CLOSE_TIMEOUT = 30.0
"""Seconds that :meth:`Recorder.close` waits for the disk."""

ITEM_OVERHEAD_BYTES = 512
"""Number of bytes for which an item counts in addition to its data."""


class Counts(NamedTuple):
    """The counts of recorded items so far, written or waiting.

    Attributes:
        frames: frames and bytes that make no frame.
        results: interpreted results.
        events: events of cameras.
        errors: errors.
        pictures: pictures.
        left_out: pictures that were not written, since too much waited for the disk.
    """

    frames: int = 0
    results: int = 0
    events: int = 0
    errors: int = 0
    pictures: int = 0
    left_out: int = 0


class Description(NamedTuple):
    """Texts about a camera, for the file's metadata."""

    metadata: dict[str, str]


RecorderInput: TypeAlias = "Item | RawFrame | Description"
"""Objects that the thread writes."""


class _RecordingOutput(Protocol):
    """The file or folder that the thread writes to."""

    def start(self) -> None: ...

    def add(self, item: RecorderInput, /) -> None: ...

    def flush(self) -> None: ...

    def finish(self) -> None: ...

    def close(self) -> None: ...


class Recorder(Observer):
    """Writes all frames, results, events and errors of clients to an MCAP file.

    ::

        with Recorder("run.mcap") as recorder:
            async with smartcam.connect(url, observers=[recorder]) as camera:
                ...

    One recorder may serve several cameras, of several event loops: topics have the camera's name.
    Before it is opened and after it is closed it ignores all calls. A result's value is converted
    to JSON a moment later in the recorder's thread: do not change it in place.

    A file that ends in ``.mkv`` becomes a video of one camera's pictures, without loss: JPEGs as
    they came, pixels compressed by FFV1. The times are those of the captures, in whole
    milliseconds, from the first picture on, whose time is the file's ``creation_time``. If size or
    format changes, a further file begins: ``run-2.mkv``. A video has no results and events.

    Args:
        path: the file; the usual suffix is ``.mcap``.
        overwrite: replace an existing file.
        pictures: write the pictures of results, if the camera has them, as software cameras
            do.

    Attributes:
        path: path that was given.
    """

    def __init__(self, path: str | Path, *, overwrite: bool = False, pictures: bool = True) -> None:
        self.path: Path = check_path(path, "path", "recording")
        self._pictures = check_flag(pictures, "pictures", "recording")
        self._overwrite = check_flag(overwrite, "overwrite", "recording")
        self._condition = threading.Condition()
        self._items: list[RecorderInput] = []
        self._waiting_bytes = 0  # without pictures
        self._waiting_picture_bytes = 0
        self._left_out: dict[str, int] = {}  # pictures left out since the last one, by camera
        self._counts = dict.fromkeys(Counts._fields, 0)
        self._accepts_items = False
        self._is_closing = False
        self._file: _RecordingOutput | None = None
        self._thread: threading.Thread | None = None
        self._failure: concurrent.futures.Future[RecordingError] = concurrent.futures.Future()
        notify_of_forks(self)

    # ------------------------------------------------------------------ life

    def open(self) -> Self:
        """Create the file and start the thread that writes it.

        Raises:
            ConfigurationError: the file exists already, another recorder writes it, or it cannot be
                created.
            MissingExtraError: the mcap library is not installed.
        """
        if self._thread is not None:
            raise ConfigurationError(f"recording {self.path}: opened before; make a new recorder")
        self._file = self._make_file()
        self._accepts_items = True
        self._thread = threading.Thread(
            target=self._write_all, name=f"smartcam.recorder[{self.path.name}]", daemon=True
        )
        self._thread.start()
        return self

    def _make_file(self) -> _RecordingOutput:
        """Create the file; raises as :meth:`open`."""
        if self.path.suffix.lower() == VIDEO_SUFFIX:
            with from_part("frames", "videos need"):
                from smartcam.recording._pictures.video import VideoFile

            load("av", "videos need")
            return VideoFile(self._open_stream(), self.path, overwrite=self._overwrite)
        compress = load_compress()
        return RecordingFile(self._open_stream(), compress, self.path)

    def _open_stream(self) -> IO[bytes]:
        """Create the empty file; raises as :meth:`open`."""
        try:
            return open_exclusively(self.path, overwrite=self._overwrite)
        except FileExistsError as exc:
            raise ConfigurationError(
                f"recording {self.path}: the file exists already; overwrite (--force) replaces it"
            ) from exc
        except ConfigurationError:
            raise
        except (OSError, ValueError) as exc:
            reason = exc.strerror if isinstance(exc, OSError) else exc
            raise ConfigurationError(f"recording {self.path}: {reason}") from exc

    def close(self) -> None:
        """Write waiting items and end the file; idempotent.

        The call waits for the disk, usually some milliseconds, at most 30 s. If an event loop must
        not wait, call it in a thread.

        Raises:
            RecordingError: the recording has failed, earlier or now.
        """
        with self._condition:
            self._accepts_items, self._is_closing = False, True
            self._condition.notify()
        if self._thread is not None:
            self._thread.join(CLOSE_TIMEOUT)
            if self._thread.is_alive():
                self._fail(f"the disk did not take the rest within {CLOSE_TIMEOUT:g} s")
        if self.error is not None:
            raise self.error

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, tb: TracebackType | None
    ) -> None:
        if exc is None:
            self.close()
            return
        with contextlib.suppress(RecordingError):  # the first error is raised
            self.close()

    def on_fork(self) -> None:
        """Record nothing in a fork of the process that writes the file."""
        self._condition, self._failure = threading.Condition(), concurrent.futures.Future()
        self._thread, self._items, self._waiting_bytes = None, [], 0
        self._waiting_picture_bytes = 0
        if self._file is not None:
            self._fail("this process is a fork; the recording goes on in the original process")

    @property
    def counts(self) -> Counts:
        """Counts of recorded items so far."""
        return Counts(**self._counts)

    @property
    def error(self) -> RecordingError | None:
        """Error that ended the recording before it was closed; None if there was none."""
        return self._failure.result() if self._failure.done() else None

    async def wait_failed(self) -> RecordingError:
        """Wait, without a time limit, until the recording fails; return the error.

        Cancellation: safe.
        """
        return await asyncio.shield(asyncio.wrap_future(self._failure))

    def describe(self, camera: str, **metadata: object) -> None:
        """Write metadata of a camera to the file, such as ``interpret_as``; None is left out.

        The address and the dialect are written without this call, at the start of every session.
        """
        texts = {name: str(value) for name, value in metadata.items() if value is not None}
        self._put(Description({"camera": camera, **texts}), 0)

    # ------------------------------------------------------------------ the observer

    def on_frame(self, entry: TraceEntry) -> None:
        """Keep a frame."""
        self._put(entry, len(entry.hex), "frames")

    def on_raw_frames(self, frames: Sequence[RawFrame]) -> None:
        """Keep frames; the thread decodes them."""
        self._put_all(frames, 2 * sum([frame.size for frame in frames]), "frames")

    def on_state(self, event: CameraEvent) -> None:
        """Keep an event."""
        self._put(event, 0, "events")

    def on_result(self, result: Result) -> None:
        """Keep a result."""
        self._put(result, 4 * len(result.raw), "results")

    def on_results(self, results: Sequence[Result]) -> None:
        """Keep results that came together."""
        self._put_all(results, 4 * sum([len(result.raw) for result in results]), "results")

    def on_picture(self, result: Result, frame: Frame) -> None:
        """Keep the picture of a result, unless ``pictures`` is False."""
        if self._pictures:
            self.add_picture(frame, camera=result.camera, result=result)

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        """Keep an error."""
        now = datetime.now(UTC)
        text = str(error)
        self._put(
            RecordedError(camera, now, type(error).__name__, text, triggered_at),
            len(text),
            "errors",
        )

    def add_picture(
        self, frame: Frame, *, camera: str = "", result: Result[Any] | None = None
    ) -> bool:
        """Add a picture to its camera's recording; never wait.

        If more than 64 MiB of pictures wait for the disk, the picture is left out; the next picture
        has the number of pictures left out before it. Results are never left out for pictures.

        Args:
            frame: picture of a source of frames; its bytes are kept until they are written.
            camera: name of the camera in the file; default the frame's source.
            result: result of the picture.

        Returns:
            True if the picture was added.

        Raises:
            ConfigurationError: an argument has a wrong type; or the file is a video of another
                camera.
            FrameFormatError: the file is a video, which cannot hold the picture without loss; or
                the picture exceeds the bounds for reading, such as a side of more than 1,048,576
                pixels. The recording goes on without it.
            MissingExtraError: the distribution of frames is not installed.
        """
        with from_part("frames", "pictures need"):
            from smartcam.frames import Frame
            from smartcam.recording._pictures.messages import check_readable

        check_kind(frame, Frame, "frame", "a Frame", "recording")
        if result is not None:
            check_kind(result, Result, "result", "a Result, or None", "recording")
        camera = check_text(camera, "camera", "recording", least=0, most=MAX_NAME_CHARACTERS)
        name = camera or frame.source
        result_key = (None, None) if result is None else (result.number, result.received_at)
        check_readable(frame)
        if (check := getattr(self._file, "check_picture", None)) is not None:
            check(frame, name)
        size = memoryview(frame.data).nbytes
        with self._condition:
            if not self._accepts_items:
                return False
            waiting = self._waiting_picture_bytes
            free_bytes = MAX_WAITING_PICTURE_BYTES - waiting if waiting else size
            if size > min(free_bytes, MAX_PICTURE_SIZE_BYTES):
                self._counts["left_out"] += 1
                self._left_out[name] = self._left_out.get(name, 0) + 1
                return False
            left_out = self._left_out.pop(name, 0)
            self._counts["pictures"] += 1
            self._items.append(
                RecordedPicture(name, captured_at(frame), frame, left_out, *result_key)
            )
            self._waiting_picture_bytes += size + ITEM_OVERHEAD_BYTES
            if not waiting or waiting < CHUNK <= self._waiting_picture_bytes:
                self._condition.notify()
        return True

    def add_image(self, camera: str, image: bytes, *, result: Result[Any] | None = None) -> bool:
        """Add a picture from ``read_image()``.

        ::

            result = await camera.trigger()
            recorder.add_image(camera.name, await camera.read_image(), result=result)

        Args:
            camera: name of the camera in the file.
            image: bytes of a bitmap file.
            result: result of the picture.

        Returns:
            True if the picture was added, as for :meth:`add_picture`.

        Raises:
            ConfigurationError: an argument has a wrong type.
            FrameFormatError: the file is no bitmap.
            MissingExtraError: the distribution of frames is not installed.
        """
        camera = check_text(camera, "camera", "recording", least=1, most=MAX_NAME_CHARACTERS)
        check_kind(image, bytes, "image", "bytes", "recording")
        if result is not None:
            check_kind(result, Result, "result", "a Result, or None", "recording")
        with from_part("frames", "pictures need"):
            from smartcam.recording._pictures.images import frame_of_image

        return self.add_picture(frame_of_image(camera, image, result), camera=camera, result=result)

    async def record(
        self,
        source: FrameSource,
        *,
        camera: str = "",
        count: int | None = None,
        on_start: Callable[[], None] = lambda: None,
    ) -> ReaderStatistics:
        """Record every picture of a source until it ends, or until ``count`` pictures.

        The source streams for the recording and for its other readers. A source that can wait, such
        as a file with ``pace=none``, waits for the disk; pictures of other sources are left
        out and counted if the disk is too slow.

        Args:
            source: open source.
            camera: name of the camera in the recording; default the source's.
            count: number of pictures after which the recording ends; None: at the source's end.
            on_start: function that is called when the first picture was added.

        Returns:
            Counts of delivered and lost pictures; ``skipped`` counts pictures that were left out.

        Raises:
            ConfigurationError: an argument is wrong.
            LocalProtocolError: the source is not open.
            FrameFormatError: the file is a video, which cannot hold the pictures without loss; or
                one of them cannot be recorded, as for :meth:`add_picture`.
            FrameSourceError: the source is lost, or hangs; earlier pictures are recorded.
            RecordingError: the recording failed, such as on a full disk.
            MissingExtraError: the distribution of frames is not installed.

        Cancellation: safe; earlier pictures are recorded.
        """
        with from_part("frames", "pictures need"):
            from smartcam.recording._pictures.recorder import record_frames

        return await record_frames(source, self, camera, count, on_start)

    @property
    def files(self) -> tuple[Path, ...]:
        """Paths of the files so far; a video may have several."""
        return tuple(getattr(self._file, "paths", (self.path,)))

    @property
    def has_room(self) -> bool:
        """True if less than half of the room for waiting pictures is used."""
        return self._waiting_picture_bytes < MAX_WAITING_PICTURE_BYTES // 2

    def _put(self, item: RecorderInput, size: int, kind: str | None = None) -> None:
        self._put_all((item,), size, kind)

    def _put_all(self, items: Sequence[RecorderInput], size: int, kind: str | None) -> None:
        """Put items of one kind into the list, with ``size`` bytes together."""
        with self._condition:
            if not self._accepts_items:
                return
            if kind is not None:
                self._counts[kind] += len(items)
            waiting_before = self._waiting_bytes
            self._items += items
            waiting = waiting_before + size + ITEM_OVERHEAD_BYTES * len(items)
            self._waiting_bytes = waiting
            if not waiting_before or waiting_before < CHUNK <= waiting:
                self._condition.notify()
        if waiting > MAX_WAITING_BYTES:
            self._fail(f"the disk is too slow: {waiting >> 20} MiB wait to be written")

    # ------------------------------------------------------------------ the thread

    def _fail(self, reason: str, cause: BaseException | None = None) -> None:
        """End the recording; keep the first reason."""
        error = RecordingError(f"recording {self.path}: {reason}")
        error.__cause__ = cause
        with self._condition:
            self._accepts_items = False
            self._items.clear()
            self._waiting_bytes = self._waiting_picture_bytes = 0
            is_first = not self._failure.done()
        if is_first:
            with contextlib.suppress(concurrent.futures.InvalidStateError):
                self._failure.set_result(error)

    def _write_all(self) -> None:
        if self._file is None:
            return
        try:
            with contextlib.closing(self._file) as file:
                file.start()
                while not self._write_batch(file):
                    pass
                file.finish()
        except OSError as exc:
            self._fail(exc.strerror or str(exc), exc)
        except ValueError as exc:  # a message that exceeds the bounds for reading
            self._fail(str(exc), exc)
        except Exception as exc:  # noqa: BLE001 - the thread must not end silently
            self._fail(f"unexpected {exc!r}", exc)

    def _write_batch(self, file: _RecordingOutput) -> bool:
        """Wait for items and write them; return True if they were the last."""
        with self._condition:
            self._condition.wait_for(lambda: self._items or self._is_closing)
            self._condition.wait_for(
                lambda: (
                    self._is_closing or self._waiting_bytes + self._waiting_picture_bytes > CHUNK
                ),
                INTERVAL,
            )
            items, self._items = self._items, []
            self._waiting_bytes, is_last = 0, self._is_closing
            self._waiting_picture_bytes = 0
        for item in items:
            file.add(item)
        file.flush()
        return is_last


class RecordingFile:
    """An MCAP file that is being written.

    Args:
        stream: the open file, closed at the end.
        compress: function that compresses a chunk, from :func:`load_compress`.
        path: path of the file.
    """

    def __init__(self, stream: IO[bytes], compress: Callable[[bytes], bytes], path: Path) -> None:
        self.path = path
        self._stream = stream  # closed at the end
        self._writer = McapWriter(stream, compress, CHUNK)
        self._on_disk = stat.S_ISREG(os.fstat(stream.fileno()).st_mode)
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._sequences: dict[int, int] = {}
        self._metadata: dict[str, dict[str, str]] = {}
        self._frame_texts = FrameTexts()
        self._bodies: LastBodies[tuple[str, str], int] = LastBodies()  # frame numbers by data
        self._size = 0  # size when the file was closed
        # time of the last message, also in nanoseconds; frames that came together share it
        self._last_time: tuple[datetime | None, int] = None, 0

    def start(self) -> None:
        """Write the beginning of the file."""
        self._writer.start(PROFILE, f"smartcam {smartcam.__version__}")
        began = datetime.now(UTC).isoformat()
        metadata = {"format": FORMAT, "version": smartcam.__version__, "began": began}
        self._writer.add_metadata(FILE_METADATA, metadata)
        self.flush()

    def add(self, item: RecorderInput) -> None:
        """Write one item; it is on the disk after the next :meth:`flush`."""
        if isinstance(item, RawFrame):  # raw frames and results are most of a recording
            text, data = self._frame_texts.text(item)
            self._write_frame(item.camera, item.at, checked_bytes(text), data)
            return
        if isinstance(item, Result):
            frame = self._bodies.get((item.camera, item.raw.hex()))
            self._write_message("results", item.camera, item.received_at, item, frame)
            return
        match item:
            case TraceEntry():
                self._write_frame(item.camera, item.at, message_of("frames", item), data_of(item))
            case Description(metadata):
                self._write_camera_metadata(metadata)
            case RecordedError():
                self._write_message("errors", item.camera, item.at, item)
            case RecordedPicture():
                self._write_picture(item)
            case _:
                if isinstance(item, (Connected, Reconnected)):
                    texts = {"camera": item.camera, **address_metadata(item.url)}
                    self._write_camera_metadata(texts)
                self._write_message("events", item.camera, item.at, item)

    @property
    def size(self) -> int:
        """Number of bytes so far, without the chunk that is being filled."""
        return self._size if self._stream.closed else self._stream.tell()

    def add_metadata(self, name: str, texts: dict[str, str]) -> None:
        """Write texts under a name, after the items so far."""
        self._writer.flush()  # write the chunk, which would otherwise follow the texts
        self._writer.add_metadata(name, texts)

    def check_path(self) -> None:
        """Check that the file is still at its path.

        Raises:
            OSError: the file was deleted, or moved away with its folder.
        """
        status = os.fstat(self._stream.fileno())
        if not os.path.samestat(status, self.path.stat()):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self.path))

    def cut_to(self, size: int) -> None:
        """Cut the file to its first ``size`` bytes, if the disk allows it, and close it."""
        self.close()
        with contextlib.suppress(OSError):
            os.truncate(self.path, size)
        self._size = size

    def flush(self) -> None:
        """End the chunk and sync it to the disk."""
        self._writer.flush()
        if self._on_disk:
            os.fsync(self._stream.fileno())

    def finish(self) -> None:
        """Write the index and the end of the file."""
        self._writer.finish()
        self._stream.flush()

    def close(self) -> None:
        """Close the file, and drop bytes that cannot be written."""
        if self._stream.closed:
            return
        with contextlib.suppress(OSError):
            self._size = self._stream.tell()
        with contextlib.suppress(OSError):
            self._stream.close()

    def _write_message(
        self, kind: str, camera: str, at: datetime, item: Item, raw_frame: int | None = None
    ) -> int:
        """Write a message; return its number, which is counted for each topic."""
        return self._write(kind, camera, at, message_of(kind, item, raw_frame))

    def _write_frame(self, camera: str, at: datetime, text: bytes, data: str) -> None:
        """Write a frame; keep its data, as hex, for its result."""
        number = self._write("frames", camera, at, text)
        if data:
            self._bodies.add((camera, data), number, len(data))

    def _write(self, kind: str, camera: str, at: datetime, text: bytes) -> int:
        channel = self._channels.get((camera, kind)) or self._channel_of(camera, kind)
        self._sequences[channel] = number = self._sequences[channel] + 1 & 0xFFFFFFFF
        if at is not self._last_time[0]:
            self._last_time = at, nanoseconds(at)
        self._writer.add_message(channel, self._last_time[1], text, number)
        return number

    def _write_picture(self, picture: RecordedPicture) -> None:
        """Write a picture, without compressing its chunk."""
        with from_part("frames", "pictures need"):
            from smartcam.recording._pictures import messages

        annotations_number = self._write_annotations(picture) if picture.frame.drawings else None
        schema = messages.schema_of(picture)
        data = messages.picture_message(picture, annotations_number)
        self._write_foxglove(picture, PICTURES, schema, messages.schema_data, data)

    def _write_annotations(self, picture: RecordedPicture) -> int:
        """Write the marks of a picture that is written next; return the number of the message."""
        with from_part("frames", "pictures need"):
            from smartcam.recording._pictures import annotations

        data = annotations.annotations_message(picture.frame)
        schema_data = annotations.schema_data
        return self._write_foxglove(picture, ANNOTATIONS, ANNOTATIONS_SCHEMA, schema_data, data)

    def _write_foxglove(
        self,
        picture: RecordedPicture,
        topic: str,
        schema: str,
        schema_data: Callable[[str], bytes],
        data: bytes,
    ) -> int:
        """Write a message of Foxglove with a picture's time; return the message's number."""
        key = picture.camera, schema
        if key not in self._channels:
            if schema not in self._schemas:
                schema_bytes = schema_data(schema)
                self._schemas[schema] = self._writer.register_schema(
                    schema, "protobuf", schema_bytes
                )
            self._channels[key] = channel = self._writer.register_channel(
                f"/{picture.camera}/{topic}",
                "protobuf",
                self._schemas[schema],
                {"camera": picture.camera},
            )
            self._sequences[channel] = 0
        channel = self._channels[key]
        self._sequences[channel] = number = self._sequences[channel] + 1 & 0xFFFFFFFF
        self._writer.add_message(channel, nanoseconds(picture.at), data, number, compressed=False)
        return number

    def _channel_of(self, camera: str, kind: str) -> int:
        known = self._channels.get((camera, kind))
        if known is not None:
            return known
        if kind not in self._schemas:
            schema = json.dumps(KINDS[kind].json_schema).encode()
            self._schemas[kind] = self._writer.register_schema(
                KINDS[kind].schema, "jsonschema", schema
            )
        channel = self._writer.register_channel(
            topic_of(camera, kind), "json", self._schemas[kind], {"camera": camera}
        )
        self._channels[camera, kind] = channel
        self._sequences[channel] = 0
        return channel

    def _write_camera_metadata(self, metadata: dict[str, str]) -> None:
        """Write a camera's metadata if they are new."""
        old_metadata = self._metadata.get(metadata["camera"], {})
        new_metadata = {**old_metadata, **metadata}
        if new_metadata != old_metadata:
            self._metadata[metadata["camera"]] = new_metadata
            self._writer.add_metadata(CAMERA_METADATA, new_metadata)


def address_metadata(url: str) -> dict[str, str]:
    """Return the metadata of a camera that follow from its address."""
    if is_fleet(url):  # only the agent has the dialect
        return {"url": url, "protocol": "fleet"}
    try:
        address = parse_address(url)
    except ConfigurationError:  # a plug-in that is no longer installed
        return {"url": url}
    quirks = ",".join(address.quirks)
    metadata = {"protocol": address.protocol, "dialect": address.dialect, "quirks": quirks}
    return {"url": address.url, **{name: text for name, text in metadata.items() if text}}
