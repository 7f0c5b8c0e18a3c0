"""Record pictures into consecutive files in a folder, and delete the oldest files."""

from __future__ import annotations

import asyncio
import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final

from smartcam._arguments import check_callable, check_kind, check_number, check_path, check_text
from smartcam.exceptions import ConfigurationError
from smartcam.frames import Frame
from smartcam.recording._folder import FileName, RecordingFolder
from smartcam.recording._folders.files import Limits
from smartcam.recording._folders.writer import FolderWriter
from smartcam.recording._mcap.form import (
    MAX_NAME_CHARACTERS,
    MAX_PICTURE_SIZE_BYTES,
    RecordedPicture,
    captured_at,
    load_compress,
)
from smartcam.recording._pictures.recorder import record_frames
from smartcam.recording._recorder import MAX_WAITING_PICTURE_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path
    from typing import Self

    from smartcam.exceptions import RecordingError
    from smartcam.frames import FrameSource
    from smartcam.frames._inside import ReaderStatistics
    from smartcam.recording._folders.camera_recording import RecordingCounts

MIN_FILE_BYTES: Final = 1e5
MAX_FILE_BYTES: Final = 1e15
MAX_AGE: Final = 86_400.0 * 366
"""Largest age of a file, seconds."""


class RotatingRecorder:
    """Records pictures into a folder, like an agent that records its cameras.

    ::

        with RotatingRecorder("pictures", size=1e9, keep=50e9) as folder:
            async with smartcam.frames.open(url) as source:
                await folder.record(source)

    Each camera has separate files, such as ``left_20260102T030405.678Z.mcap``. If the disk is
    full, slow or missing, pictures are lost, and counted in the files; when it works again, the
    recording goes on.

    Args:
        path: the folder; created if it does not exist.
        size: number of bytes after which a file ends and the next one begins.
        age: number of seconds after which a file ends and the next one begins.
        keep: bytes of all files together, beyond which the oldest recordings are deleted.
        on_trouble: function that is called in the writer's thread with the error when nothing can
            be written, and with None when it can again.

    Attributes:
        path: path that was given.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        size: float = 1e9,
        age: float = 3600.0,
        keep: float = 10e9,
        on_trouble: Callable[[RecordingError | None], None] = lambda _: None,
    ) -> None:
        self.path: Path = check_path(path, "path", "recordings")
        size = check_number(size, "size", MIN_FILE_BYTES, MAX_FILE_BYTES, unit="bytes")
        age = check_number(age, "age", 1.0, MAX_AGE, unit="seconds")
        keep = check_number(keep, "keep", 2 * size, MAX_FILE_BYTES, unit="bytes")
        check_callable(on_trouble, "on_trouble", "recordings")
        self._limits = Limits(size, age, keep)
        self._on_trouble = on_trouble
        self._writer: FolderWriter | None = None
        self._recordings: dict[str, Any] = {}

    def open(self) -> Self:
        """Take the folder over and start the thread that writes it.

        Raises:
            ConfigurationError: another recorder writes in the folder.
            MissingExtraError: the library that compresses the chunks is not installed.
        """
        if self._writer is not None:
            raise ConfigurationError(f"recordings {self.path}: opened before; make a new recorder")
        folder = RecordingFolder(self.path)
        writer = FolderWriter(folder, self._limits, load_compress(), self._on_trouble)
        writer.start()
        self._writer = writer
        return self

    def close(self) -> None:
        """Write waiting pictures and end the files; wait for the disk, 30 s at most. Idempotent."""
        if self._writer is not None:
            self._writer.stop()

    def __enter__(self) -> Self:
        return self.open()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def counts(self) -> dict[str, RecordingCounts]:
        """Counts of each camera's pictures: written, waiting and lost."""
        return {} if self._writer is None else self._writer.counts

    @property
    def trouble(self) -> RecordingError | None:
        """Error because of which nothing is written now; None without one."""
        return None if self._writer is None else self._writer.trouble

    @property
    def has_room(self) -> bool:
        """True if less than half of the room for waiting pictures is used."""
        return self._writer is None or self._writer.waiting_bytes < MAX_WAITING_PICTURE_BYTES // 2

    def add_picture(self, frame: Frame, *, camera: str = "") -> bool:
        """Add a picture, or leave it out and count it if too much waits. Never waits.

        Args:
            frame: picture of a source of frames; its bytes are kept until they are written.
            camera: name of the camera; default: :func:`name_in_recording` of the frame's source.

        Returns:
            True if the picture was added.

        Raises:
            ConfigurationError: an argument is wrong.
        """
        check_kind(frame, Frame, "frame", "a Frame", "recordings")
        camera = check_text(camera, "camera", "recordings", most=MAX_NAME_CHARACTERS)
        if self._writer is None:
            return False
        name = camera or name_in_recording(frame.source)
        recording = self._recordings.get(name)
        if recording is None:
            example = FileName(name, datetime.now(UTC))
            if FileName.parse(str(example)) is None:
                raise ConfigurationError(
                    f"recordings {self.path}: camera {name!r:.60}: expected a name of small "
                    "letters, digits, _ and -, since the files' names contain it"
                )
            recording = self._recordings[name] = self._writer.new_recording(name, _single_item)
        size = memoryview(frame.data).nbytes
        return self._writer.put(
            recording,
            RecordedPicture(name, captured_at(frame), frame),
            size if size <= MAX_PICTURE_SIZE_BYTES else -1,
        )

    async def record(
        self,
        source: FrameSource,
        *,
        camera: str = "",
        count: int | None = None,
        on_start: Callable[[], None] = lambda: None,
    ) -> ReaderStatistics:
        """Record every picture of a source, like :meth:`Recorder.record`."""
        return await record_frames(source, self, camera, count, on_start)

    async def wait_failed(self) -> RecordingError:
        """Wait forever, since errors of the disk do not end a recording into a folder.

        Cancellation: safe.
        """
        never: asyncio.Future[RecordingError] = asyncio.get_running_loop().create_future()
        return await never


def name_in_recording(name: str) -> str:
    """Return the name of a source in a recording: lower case letters, digits, _ and hyphens."""
    return re.sub(r"[^a-z0-9_]+", "-", name.lower()).strip("-")[:100] or "camera"


def _single_item(picture: RecordedPicture) -> Iterator[RecordedPicture]:
    yield picture
