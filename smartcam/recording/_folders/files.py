"""Begin, fill, end and delete the files of a folder of recordings, in one thread."""

from __future__ import annotations

import contextlib
import logging
import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import FrameFormatError
from smartcam.recording._exclusive_files import open_exclusively
from smartcam.recording._folders.camera_recording import Gap
from smartcam.recording._recorder import Description, RecordingFile
from smartcam.recording._state import STATE_METADATA

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from smartcam.recording._folder import RecordingFolder
    from smartcam.recording._folders.camera_recording import CameraRecording

logger: logging.Logger = logging.getLogger("smartcam.recording")

LISTING_INTERVAL = 10.0
"""Seconds after which the folder is listed again when a file is begun."""

ITEMS_PER_CHECK = 64
"""Number of items after which a file's size is checked."""


class Limits(NamedTuple):
    """The limits of a file, and of all files.

    Attributes:
        size: bytes of a file at which it ends.
        age: age of a file, seconds, at which it ends.
        keep: largest number of bytes of all files.
    """

    size: float
    age: float
    keep: float


class FolderFiles:
    """Writes the records of each camera to its files.

    Args:
        folder: folder that holds the files.
        limits: bounds on the files.
        compress: function that compresses a chunk.
        clock: function that returns the time in seconds, for the files' age.
    """

    def __init__(
        self,
        folder: RecordingFolder,
        limits: Limits,
        compress: Callable[[bytes], bytes],
        clock: Callable[[], float],
    ) -> None:
        self._folder, self._limits, self._compress, self._clock = folder, limits, compress, clock
        self._listed_at = -math.inf  # time of the last listing of the folder
        self._undeletable: set[str] = set()  # files that could not be deleted

    def enter(self) -> None:
        """Enter the folder; raises as :meth:`RecordingFolder.enter`."""
        self._folder.enter()
        self._listed_at = self._clock()

    def write(self, recording: CameraRecording, entries: list[Any]) -> None:
        """Write records of a camera, and remove those on the disk from ``entries``.

        Raises:
            OSError: the remaining records could not be written.
        """
        done_count = written = 0
        try:
            for index, entry in enumerate(entries):
                must_end = not index % ITEMS_PER_CHECK and self._must_end(recording)
                if recording.file is None or must_end:
                    self._flush(recording, written)
                    done_count, written = index, 0
                    self._begin_file(recording, entry)
                written += self._add(recording, entry)
            self._flush(recording, written)
            done_count = len(entries)
        except BaseException:
            self._cut_file(recording)
            raise
        finally:
            del entries[:done_count]

    def _must_end(self, recording: CameraRecording) -> bool:
        aged = self._clock() - recording.begun_at >= self._limits.age
        return recording.file is not None and (aged or recording.file.size >= self._limits.size)

    def _add(self, recording: CameraRecording, entry: Any) -> int:
        """Add an entry's records to the file; return their number."""
        file = recording.file
        if file is None:  # cannot happen: the file was begun
            return 0
        if recording.gap is not None and not recording.gap_written:
            self._add_gap(recording, file, recording.gap)
            recording.gap_written = True
        if isinstance(entry, Gap):
            recording.update_state_from_gap(entry)
            self._add_gap(recording, file, entry)
            return 0
        if isinstance(entry, Description):
            recording.metadata |= entry.metadata
            file.add(Description(recording.metadata))
            return 0
        recording.update_state(entry)
        written = 0
        try:
            items = [*recording.make_items(entry)]
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:  # noqa: BLE001 - an interpreter may raise anything
            recording.count_one_lost(f"unexpected {exc!r}")
            return 0
        recording.extra_records += len(items) - 1  # a bad result makes an error, too
        for item in items:
            try:
                file.add(item)
            except FrameFormatError as exc:  # an OSError, but not from the disk
                recording.count_one_lost(str(exc))
            except OSError:
                raise
            except Exception as exc:  # noqa: BLE001 - the record cannot be encoded
                recording.count_one_lost(str(exc))
            else:
                written += 1
        return written

    @staticmethod
    def _add_gap(recording: CameraRecording, file: RecordingFile, gap: Gap) -> None:
        file.add(gap.error(recording.camera))
        file.add_metadata(STATE_METADATA, recording.state.to_metadata(recording.endian, gap.until))

    def _begin_file(self, recording: CameraRecording, first: Any) -> None:
        """End a camera's file, if any, and begin the next one, whose first record is ``first``.

        Raises:
            OSError: the file cannot be created.
        """
        now = self._clock()
        if now - self._listed_at > LISTING_INTERVAL:
            self._folder.list_files()
            self._listed_at = now
        at = _time_of(first)
        path = self._folder.next_path(recording.camera, at)
        file = RecordingFile(open_exclusively(path, overwrite=False), self._compress, path)
        try:
            file.start()
            file.add(Description(recording.metadata))
            file.add_metadata(STATE_METADATA, recording.state.to_metadata(recording.endian, at))
            file.flush()
        except BaseException:
            file.close()
            with contextlib.suppress(OSError):
                path.unlink()
            raise
        self._folder.add(path)
        self.finish(recording)
        recording.file, recording.begun_at, recording.synced_bytes = file, now, file.size

    def _flush(self, recording: CameraRecording, written: int) -> None:
        """Sync the added records to the disk, and count them."""
        file = recording.file
        if file is None:
            return
        file.flush()
        file.check_path()
        recording.synced_bytes = file.size
        recording.written += written
        if recording.gap_written:
            recording.gap, recording.gap_written = None, False
        self._folder.set_size(file.path, file.size)

    def _cut_file(self, recording: CameraRecording) -> None:
        """Close a file, cut to the last whole chunk."""
        file, recording.file = recording.file, None
        recording.gap_written = False
        if file is not None:
            file.cut_to(recording.synced_bytes)
            self._folder.set_size(file.path, recording.synced_bytes)

    def finish(self, recording: CameraRecording) -> None:
        """End a camera's file, if any; without an index if that cannot be written."""
        file, recording.file = recording.file, None
        if file is None:
            return
        try:
            file.finish()
        except (OSError, ValueError) as exc:
            file.cut_to(recording.synced_bytes)
            logger.warning("%s: its index could not be written: %s", file.path, exc)
        file.close()
        self._folder.set_size(file.path, file.size)

    def end_old(self, recordings: Iterable[CameraRecording]) -> None:
        """End files that are old enough, also of silent cameras."""
        for recording in recordings:
            if self._must_end(recording) and self._clock() - recording.begun_at >= self._limits.age:
                self.finish(recording)

    # ------------------------------------------------------------------ the bound on the disk

    def delete_old(self, recordings: Sequence[CameraRecording]) -> None:
        """Delete the oldest files until all files together are within ``keep``."""
        folder = self._folder
        while folder.total_bytes > self._limits.keep:
            old_files = [
                file for file in folder.files.values() if file.name not in self._undeletable
            ]
            if not old_files:
                return
            oldest = min(old_files)
            for recording in recordings:
                if recording.file is not None and recording.file.path.name == oldest.name:
                    self.finish(recording)  # the camera's next record begins a new file
            try:
                folder.delete(oldest.name)
            except OSError as exc:
                self._undeletable.add(oldest.name)
                logger.warning("%s cannot be deleted: %s", folder.path / oldest.name, exc)


def _time_of(entry: Any) -> datetime:
    """Return the time of an entry; the present time if it has none."""
    item = getattr(entry, "result", entry)
    at = getattr(item, "received_at", None) or getattr(item, "at", None)
    return at if isinstance(at, datetime) else datetime.now(UTC)
