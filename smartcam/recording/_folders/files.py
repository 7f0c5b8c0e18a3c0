"""The files of a folder of recordings: begun, filled, ended, deleted; in one thread."""

from __future__ import annotations

import contextlib
import logging
import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import FrameFormatError
from smartcam.recording._exclusive_files import opened
from smartcam.recording._folders.track import Gap
from smartcam.recording._recorder import Description, RecordingFile
from smartcam.recording._state import STATE_METADATA

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from smartcam.recording._folder import RecordingFolder
    from smartcam.recording._folders.track import CameraTrack

logger: logging.Logger = logging.getLogger("smartcam.recording")

LOOK_INTERVAL = 10.0
"""Seconds after which it is looked again what is in the folder, where files are begun."""

ITEMS_PER_LOOK = 64
"""Items after which a file's size is looked at."""


class Limits(NamedTuple):
    """The limits at which a file is ended, and of how much is kept.

    Attributes:
        size: bytes of a file.
        age: seconds that a file is written.
        keep: bytes of all files.
    """

    size: float
    age: float
    keep: float


class FolderFiles:
    """Writes what came of each camera to its files.

    Args:
        folder: folder that holds the files.
        limits: bounds on the files.
        compress: function that packs a chunk.
        clock: function that returns seconds, for the files' age.
    """

    def __init__(
        self,
        folder: RecordingFolder,
        limits: Limits,
        compress: Callable[[bytes], bytes],
        clock: Callable[[], float],
    ) -> None:
        self._folder, self._limits, self._compress, self._clock = folder, limits, compress, clock
        self._looked = -math.inf  # when it was looked what is in the folder
        self._stuck: set[str] = set()  # files that could not be deleted

    def enter(self) -> None:
        """Enter the folder; raises as :meth:`RecordingFolder.enter`."""
        self._folder.enter()
        self._looked = self._clock()

    def write(self, track: CameraTrack, given: list[Any]) -> None:
        """Write what came of a camera; what is on the disk is taken out of ``given``.

        Raises:
            OSError: the disk did not take the rest.
        """
        done = written = 0
        try:
            for place, one in enumerate(given):
                if track.file is None or (not place % ITEMS_PER_LOOK and self._is_over(track)):
                    self._flush(track, written)
                    done, written = place, 0
                    self._begin(track, one)
                written += self._add(track, one)
            self._flush(track, written)
            done = len(given)
        except BaseException:
            self._cut(track)
            raise
        finally:
            del given[:done]

    def _is_over(self, track: CameraTrack) -> bool:
        aged = self._clock() - track.begun >= self._limits.age
        return track.file is not None and (aged or track.file.size >= self._limits.size)

    def _add(self, track: CameraTrack, one: Any) -> int:
        """Add what was put in to the file; return how many records that were."""
        file = track.file
        if file is None:  # not so: it was begun
            return 0
        if track.gap is not None and not track.gap_told:
            self._add_gap(track, file, track.gap)
            track.gap_told = True
        if isinstance(one, Gap):
            track.follow_all(one)
            self._add_gap(track, file, one)
            return 0
        if isinstance(one, Description):
            track.facts |= one.facts
            file.add(Description(track.facts))
            return 0
        track.follow(one)
        written = 0
        try:
            items = [*track.read(one)]
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:  # noqa: BLE001 - an interpreter's, of whatever kind
            track.lose_one(f"unexpected {exc!r}")
            return 0
        track.more += len(items) - 1  # a result that cannot be read is an error, too
        for item in items:
            try:
                file.add(item)
            except FrameFormatError as exc:  # which is an OSError, and not the disk's
                track.lose_one(str(exc))
            except OSError:
                raise
            except Exception as exc:  # noqa: BLE001 - nobody could read it back
                track.lose_one(str(exc))
            else:
                written += 1
        return written

    @staticmethod
    def _add_gap(track: CameraTrack, file: RecordingFile, gap: Gap) -> None:
        file.add(gap.error(track.camera))
        file.note(STATE_METADATA, track.state.facts(track.endian, gap.until))

    def _begin(self, track: CameraTrack, first: Any) -> None:
        """Begin a camera's next file, and end the one before, if any; ``first``: what it is for.

        Raises:
            OSError: the file cannot be created.
        """
        now = self._clock()
        if now - self._looked > LOOK_INTERVAL:
            self._folder.look()
            self._looked = now
        at = _time_of(first)
        path = self._folder.next_path(track.camera, at)
        file = RecordingFile(opened(path, overwrite=False), self._compress, path)
        try:
            file.start()
            file.add(Description(track.facts))
            file.note(STATE_METADATA, track.state.facts(track.endian, at))
            file.flush()
        except BaseException:
            file.close()
            with contextlib.suppress(OSError):
                path.unlink()
            raise
        self._folder.add(path)
        self.finish(track)
        track.file, track.begun, track.good = file, now, file.size

    def _flush(self, track: CameraTrack, written: int) -> None:
        """Have what was added put on the disk, and count it."""
        file = track.file
        if file is None:
            return
        file.flush()
        file.check()
        track.good = file.size
        track.written += written
        if track.gap_told:
            track.gap, track.gap_told = None, False
        self._folder.grown(file.path, file.size)

    def _cut(self, track: CameraTrack) -> None:
        """Leave a file with what is on the disk: its last chunk may be half of one."""
        file, track.file = track.file, None
        track.gap_told = False
        if file is not None:
            file.cut(track.good)
            self._folder.grown(file.path, track.good)

    def finish(self, track: CameraTrack) -> None:
        """End a camera's file, if any; where the disk does not take its index it has none."""
        file, track.file = track.file, None
        if file is None:
            return
        try:
            file.finish()
        except (OSError, ValueError) as exc:
            file.cut(track.good)
            logger.warning("%s has no end: %s", file.path, exc)
        file.close()
        self._folder.grown(file.path, file.size)

    def end_old(self, tracks: Iterable[CameraTrack]) -> None:
        """End files that are old enough, of cameras that say nothing."""
        for track in tracks:
            if self._is_over(track) and self._clock() - track.begun >= self._limits.age:
                self.finish(track)

    # ------------------------------------------------------------------ the bound on the disk

    def delete_old(self, tracks: Sequence[CameraTrack]) -> None:
        """Delete the oldest files until what is left is within the bound."""
        folder = self._folder
        while folder.bytes > self._limits.keep:
            found = [one for one in folder.files.values() if one.name not in self._stuck]
            if not found:
                return
            oldest = min(found)
            for track in tracks:
                if track.file is not None and track.file.path.name == oldest.name:
                    self.finish(track)  # it goes on in a new one
            try:
                folder.delete(oldest.name)
            except OSError as exc:
                self._stuck.add(oldest.name)
                logger.warning("%s cannot be deleted: %s", folder.path / oldest.name, exc)


def _time_of(given: Any) -> datetime:
    """Return when what was put in came; now where it does not say."""
    item = getattr(given, "result", given)
    at = getattr(item, "received_at", None) or getattr(item, "at", None)
    return at if isinstance(at, datetime) else datetime.now(UTC)
