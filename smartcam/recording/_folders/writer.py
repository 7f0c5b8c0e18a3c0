"""The thread that writes a folder of recordings, with consecutive files for each camera.

Records are put into one bounded list; the thread takes the list twice a second and writes each
camera's records to the disk. Records that cannot be written are counted for each camera, and
reported in the camera's files as soon as the disk works again.
"""

from __future__ import annotations

import errno
import logging
import os
import shutil
import threading
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from smartcam._forks import notify_of_forks
from smartcam.exceptions import ConfigurationError, RecordingError
from smartcam.models import CameraEvent
from smartcam.recording._folders.camera_recording import CameraRecording, Gap
from smartcam.recording._folders.files import FolderFiles, Limits
from smartcam.recording._recorder import (
    CHUNK,
    CLOSE_TIMEOUT,
    INTERVAL,
    ITEM_OVERHEAD_BYTES,
    MAX_WAITING_BYTES,
    Description,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.recording._folder import RecordingFolder
    from smartcam.recording._folders.camera_recording import RecordingCounts
    from smartcam.recording._mcap.form import Item

logger: logging.Logger = logging.getLogger("smartcam.recording")

MIN_FREE_BYTES = 4 * CHUNK
"""Least number of bytes that must be free on a disk that was full before it is tried again."""

RETRY_DELAYS = (1.0, 2.0, 4.0, 8.0, 15.0, 30.0)
"""Seconds until a disk that failed is tried again; the last delay is repeated."""

EVENT_ROOM_FACTOR = 2
"""Events may wait until this multiple of the limit for other records, since they have the state."""


@dataclass(eq=False)
class _Trouble:
    """The reason why nothing is written now."""

    error: RecordingError
    reason: str  # text without the folder
    disk_was_full: bool
    retry_at: float  # time of the next try, on the monotonic clock
    failed_retries: int = 0


@dataclass(eq=False)
class _DiskQueue:
    """The records that wait for the thread."""

    entries: list[tuple[CameraRecording, Any]] = field(default_factory=list)
    bytes: int = 0


class FolderWriter:
    """Writes records in a thread.

    Args:
        folder: folder that holds the files.
        limits: bounds on the files.
        compress: function that compresses a chunk.
        report: function that is called in the thread with the error when nothing can be written,
            and with None when it can again.
        clock: function that returns the time in seconds, for the files' age and delays.

    Attributes:
        trouble: error because of which nothing is written now; None without one.
    """

    def __init__(
        self,
        folder: RecordingFolder,
        limits: Limits,
        compress: Callable[[bytes], bytes],
        report: Callable[[RecordingError | None], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder, self._report, self._clock = folder, report, clock
        self._files = FolderFiles(folder, limits, compress, clock)
        self._condition = threading.Condition()
        self._waiting = _DiskQueue()
        self._is_closing = False
        self._recordings: dict[str, CameraRecording] = {}
        self._trouble: _Trouble | None = None
        self._thread: threading.Thread | None = None
        notify_of_forks(self)

    def on_fork(self) -> None:
        """Write nothing in a fork of the process that has the folder; leave out all records."""
        self._condition, self._waiting = threading.Condition(), _DiskQueue()
        self._thread, self._is_closing = None, True

    # ------------------------------------------------------------------ from any thread

    @property
    def trouble(self) -> RecordingError | None:
        trouble = self._trouble
        return None if trouble is None else trouble.error

    @property
    def counts(self) -> dict[str, RecordingCounts]:
        """Counts of each camera's records, by the camera's name."""
        with self._condition:
            return {name: recording.counts for name, recording in self._recordings.items()}

    def new_recording(
        self, camera: str, make_items: Callable[[Any], Iterator[Item]]
    ) -> CameraRecording:
        """Return a new recording of a camera."""
        with self._condition:
            recording = self._recordings[camera] = CameraRecording(camera, make_items)
        return recording

    def describe(self, recording: CameraRecording, metadata: dict[str, str]) -> None:
        """Write metadata of a camera to each of its files."""
        with self._condition:
            description = Description({"camera": recording.camera, **metadata})
            self._waiting.entries.append((recording, description))

    @property
    def waiting_bytes(self) -> int:
        """Bytes that wait for the disk."""
        return self._waiting.bytes

    def put(
        self, recording: CameraRecording, entry: Any, size: int, *, event: bool = False
    ) -> bool:
        """Put an entry into the list, or leave it out and count it if too much waits. Never wait.

        Return whether the entry is in the list.

        Args:
            recording: recording of the camera that the entry is about.
            entry: object that ``make_items`` of the recording makes items of.
            size: bytes for which the entry counts while it waits; below 0: the entry is too large.
            event: whether the entry is an event; events have more room to wait.
        """
        with self._condition:
            waiting = self._waiting
            recording.offered += 1
            room = MAX_WAITING_BYTES * EVENT_ROOM_FACTOR if event else MAX_WAITING_BYTES
            if self._is_closing or waiting.bytes > room or size < 0:
                self._leave_out(recording, entry)
                return False
            before = waiting.bytes
            waiting.entries.append((recording, entry))
            waiting.bytes += size + ITEM_OVERHEAD_BYTES
            if not before or before < CHUNK <= waiting.bytes:
                self._condition.notify()
            return True

    def _leave_out(self, recording: CameraRecording, entry: Any) -> None:
        at = datetime.now(UTC)
        recording.left_out += 1
        if recording.overflow is None:
            recording.overflow = Gap(at, at, 0, "the disk is too slow")
            self._waiting.entries.append((recording, recording.overflow))
        gap = recording.overflow
        gap.until, gap.count = at, gap.count + 1
        if isinstance(entry, CameraEvent):
            gap.events.pop(type(entry), None)
            gap.events[type(entry)] = entry

    def start(self) -> None:
        """Enter the folder and start the thread; blocks while the disk does.

        Raises:
            ConfigurationError: another recorder writes in the folder.
        """
        try:
            self._files.enter()
        except OSError as exc:
            self._fail(exc)
        self._thread = threading.Thread(
            target=self._write_until_closed,
            name=f"smartcam.recordings[{self._folder.path.name}]",
            daemon=True,
        )
        self._thread.start()

    def stop(self) -> None:
        """Write waiting records and end the files; blocks for at most 30 s. Idempotent."""
        with self._condition:
            self._is_closing = True
            self._condition.notify()
        thread = self._thread
        if thread is not None:
            thread.join(CLOSE_TIMEOUT)
            if thread.is_alive():
                logger.error(
                    "recordings %s: the disk did not take the rest within %g s",
                    self._folder.path,
                    CLOSE_TIMEOUT,
                )

    # ------------------------------------------------------------------ the thread

    def _write_until_closed(self) -> None:
        try:
            is_last = False
            while not is_last:
                batches, is_last = self._take_batches()
                self._write(batches)
        finally:
            for recording in self._all_recordings():
                self._files.finish(recording)
            self._folder.leave()

    def _take_batches(self) -> tuple[dict[CameraRecording, list[Any]], bool]:
        """Wait for records; return them by camera, and whether they were the last."""
        with self._condition:
            self._condition.wait_for(lambda: self._waiting.entries or self._is_closing, INTERVAL)
            if self._waiting.entries:
                self._condition.wait_for(
                    lambda: self._is_closing or self._waiting.bytes > CHUNK, INTERVAL
                )
            taken, self._waiting = self._waiting, _DiskQueue()
            for recording in self._recordings.values():
                recording.overflow = None
            is_last = self._is_closing
        batches: dict[CameraRecording, list[Any]] = {}
        for recording, entry in taken.entries:
            batches.setdefault(recording, []).append(entry)
        return batches, is_last

    def _write(self, batches: dict[CameraRecording, list[Any]]) -> None:
        """Write records, or count them as lost; never raises."""
        try:
            if self._should_try(batches):
                for recording, entries in batches.items():
                    self._files.write(recording, entries)
                recordings = self._all_recordings()
                self._files.end_old(recordings)
                self._files.delete_old(recordings)
                if batches:
                    self._report_recovery()
        except (OSError, ConfigurationError) as exc:
            self._fail(exc)
        except Exception as exc:
            logger.exception("recordings %s: unexpected", self._folder.path)
            self._fail(exc)
        trouble = self._trouble
        if trouble is not None:
            for recording, entries in batches.items():
                recording.count_lost(entries, trouble.reason)

    def _should_try(self, batches: dict[CameraRecording, list[Any]]) -> bool:
        """Return True if the disk should be tried now; check its free space after it was full.

        Raises:
            ConfigurationError: another recorder writes in the folder now.
            OSError: the folder does not exist, or there is no room.
        """
        trouble, now = self._trouble, self._clock()
        if trouble is None:
            return True
        if now < trouble.retry_at or not batches:
            return False
        self._files.enter()
        if trouble.disk_was_full and shutil.disk_usage(self._folder.path).free < MIN_FREE_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return True

    def _all_recordings(self) -> list[CameraRecording]:
        with self._condition:
            return [*self._recordings.values()]

    # ------------------------------------------------------------------ trouble

    def _fail(self, error: Exception) -> None:
        before = self._trouble
        failed_retries = 0 if before is None else before.failed_retries + 1
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        prefix = f"recordings {self._folder.path}: "
        failure = RecordingError(prefix + reason.removeprefix(prefix))
        failure.__cause__ = error
        disk_was_full = isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT}
        retry_at = self._clock() + RETRY_DELAYS[min(failed_retries, len(RETRY_DELAYS) - 1)]
        self._trouble = _Trouble(failure, reason, disk_was_full, retry_at, failed_retries)
        if before is None:
            logger.warning("%s; nothing is recorded until the disk works again", failure)
            self._report(failure)

    def _report_recovery(self) -> None:
        """Report that the disk works again, if it had failed."""
        if self._trouble is not None:
            self._trouble = None
            logger.warning("recordings %s: records are written again", self._folder.path)
            self._report(None)
