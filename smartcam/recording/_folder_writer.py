"""The thread that writes a folder of recordings: of each camera files that follow each other.

What comes is put into one list, in bounds; the thread takes the list twice a second and has each
camera's part of it put on the disk. What a disk does not take is counted, camera by camera, and
told in the files as soon as there is one that takes it.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import shutil
import threading
import time
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import ConfigurationError, RecordingError
from smartcam.models import CameraEvent
from smartcam.recording._form import GAP, STATE_METADATA, RecordedError, RecordedState
from smartcam.recording._recorder import (
    CHUNK,
    CLOSE_TIMEOUT,
    INTERVAL,
    MAX_WAITING,
    OVERHEAD,
    Description,
    RecordingFile,
    opened,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.recording._folder import RecordingFolder
    from smartcam.recording._form import Item

logger: logging.Logger = logging.getLogger("smartcam.recording")

ROOM = 4 * CHUNK
"""Bytes that must be free on a disk that was full before it is tried again."""

RETRIES = (1.0, 2.0, 4.0, 8.0, 15.0, 30.0)
"""Seconds until a disk that did not take something is tried again; the last for ever."""

LOOK = 10.0
"""Seconds after which it is looked again what is in the folder, where files are begun."""

STEP = 64
"""Items after which a file's size is looked at."""

EVENT_ROOM = 2
"""How much more may wait before events are left out, too: they say what the camera is."""


class RecordingAccount(NamedTuple):
    """What became of a camera's records: frames, results, events and errors, all counted alike.

    Attributes:
        written: on the disk.
        waiting: for the disk.
        lost: not written: the disk was full, gone or too slow, or it could not be read back.
    """

    written: int = 0
    waiting: int = 0
    lost: int = 0


class Limits(NamedTuple):
    """When a file is over, and what is kept.

    Attributes:
        size: bytes of a file.
        age: seconds that a file is written.
        keep: bytes of all files.
    """

    size: float
    age: float
    keep: float


class Clocks(NamedTuple):
    """Where the time comes from.

    Attributes:
        wall: seconds since 1970, for names.
        steady: seconds, for ages and delays.
    """

    wall: Callable[[], float] = time.time
    steady: Callable[[], float] = time.monotonic


@dataclass(eq=False)
class Gap:
    """Records that were not written.

    Attributes:
        since: when the first of them came.
        until: when the last of them came.
        count: how many.
        reason: why.
    """

    since: datetime
    until: datetime
    count: int
    reason: str

    def error(self, camera: str) -> RecordedError:
        """Return what stands in the file."""
        text = (
            f"{self.count} records from {self.since.isoformat()} to {self.until.isoformat()} were "
            f"not written: {self.reason}"
        )
        return RecordedError(camera, self.until, GAP, text, None, self.since, self.count)


class Track:
    """What is recorded of one camera.

    Args:
        camera: its name.
        read: makes items of what was put in, in the thread.

    Attributes:
        endian: that its last status told.
        offered: records that came.
        written: records on the disk.
        lost: records that are not, and will not be.
        overflow: the gap that grows where too much waits; None where nothing is left out.
    """

    def __init__(self, camera: str, read: Callable[[Any], Iterator[Item]]) -> None:
        self.camera = camera
        self.read = read
        self.offered = self.written = self.lost = 0
        self.overflow: Gap | None = None
        self.state = RecordedState(camera)
        self.endian = 0
        self.facts: dict[str, str] = {"camera": camera}
        self.gap: Gap | None = None  # not told in a file that is on the disk
        self.gap_told = False  # it is in the file's next chunk
        self.file: RecordingFile | None = None
        self.begun = 0.0  # when the file was, on the steady clock
        self.good = 0  # bytes of the file that are on the disk

    @property
    def account(self) -> RecordingAccount:
        """What became of its records."""
        offered, written, lost = self.offered, self.written, self.lost
        return RecordingAccount(written, max(0, offered - written - lost), lost)

    def lose(self, given: list[Any], reason: str) -> None:
        """Count what was put in and is not written; what it says of the camera is kept."""
        for one in given:
            if isinstance(one, Description):
                self.facts |= one.facts
            elif isinstance(one, Gap):
                self._widen(one)  # it is counted
            else:
                self.follow(one)
                self.lose_one(reason)

    def lose_one(self, reason: str) -> None:
        """Count a record that is not written."""
        at = datetime.now(UTC)
        self.lost += 1
        self._widen(Gap(at, at, 1, reason))

    def follow(self, item: object) -> None:
        """Keep what an item says of the camera."""
        if isinstance(item, CameraEvent):
            self.state = self.state.after(item)

    def _widen(self, more: Gap) -> None:
        if self.gap is None:
            self.gap = replace(more)
        else:
            self.gap.until, self.gap.count = more.until, self.gap.count + more.count


@dataclass(eq=False)
class _Trouble:
    """Why nothing is written at the time."""

    error: RecordingError
    reason: str  # without the folder
    full: bool  # there was no room
    again: float  # when it is tried again, on the steady clock
    tries: int = 0


@dataclass(eq=False)
class _Waiting:
    """What waits for the thread."""

    items: list[tuple[Track, Any]] = field(default_factory=list[tuple[Track, Any]])
    bytes: int = 0


class FolderWriter:
    """Writes what is put in.

    Args:
        folder: that the files are in.
        limits: of files.
        mcap: the library's module ``mcap.writer``.
        tell: called in the thread with why nothing is written, and with None when it is again.
        clocks: where the time comes from.

    Attributes:
        trouble: why nothing is written at the time; None where all is well.
    """

    def __init__(
        self,
        folder: RecordingFolder,
        limits: Limits,
        mcap: Any,
        tell: Callable[[RecordingError | None], None],
        clocks: Clocks | None = None,
    ) -> None:
        self._folder, self._limits, self._mcap, self._tell = folder, limits, mcap, tell
        self._clocks = clocks or Clocks()
        self._more = threading.Condition()
        self._waiting = _Waiting()
        self._closing = False
        self._tracks: dict[str, Track] = {}
        self._trouble: _Trouble | None = None
        self._thread: threading.Thread | None = None
        self._looked = 0.0
        self._stuck: set[str] = set()  # files that could not be deleted

    # ------------------------------------------------------------------ from any thread

    @property
    def trouble(self) -> RecordingError | None:
        trouble = self._trouble
        return None if trouble is None else trouble.error

    @property
    def accounts(self) -> dict[str, RecordingAccount]:
        """What became of each camera's records."""
        with self._more:
            return {name: track.account for name, track in self._tracks.items()}

    def track(self, camera: str, read: Callable[[Any], Iterator[Item]]) -> Track:
        """Return a new track."""
        with self._more:
            track = self._tracks[camera] = Track(camera, read)
        return track

    def describe(self, track: Track, facts: dict[str, str]) -> None:
        """Keep facts about a camera in each of its files."""
        with self._more:
            self._waiting.items.append((track, Description({"camera": track.camera, **facts})))

    def put(self, track: Track, given: Any, size: int, *, event: bool = False) -> None:
        """Have something written; where too much waits it is left out and counted. Never waits.

        Args:
            track: whose it is.
            given: what ``read`` of the track makes items of.
            size: its bytes.
            event: it says what the camera is.
        """
        waiting = self._waiting
        with self._more:
            track.offered += 1
            room = MAX_WAITING * EVENT_ROOM if event else MAX_WAITING
            if self._closing or waiting.bytes > room:
                self._leave_out(track)
                return
            before = waiting.bytes
            waiting.items.append((track, given))
            waiting.bytes += size + OVERHEAD
            if not before or before < CHUNK <= waiting.bytes:
                self._more.notify()

    def _leave_out(self, track: Track) -> None:
        at = datetime.now(UTC)
        track.lost += 1
        if track.overflow is None:
            track.overflow = Gap(at, at, 0, "the disk is too slow")
            self._waiting.items.append((track, track.overflow))
        track.overflow.until, track.overflow.count = at, track.overflow.count + 1

    def start(self) -> None:
        """Enter the folder and start the thread. It blocks for as long as the disk wants.

        Raises:
            ConfigurationError: another recorder writes in the folder.
        """
        try:
            self._folder.enter()
        except OSError as exc:
            self._fail(exc)
        self._thread = threading.Thread(
            target=self._run, name=f"smartcam.recordings[{self._folder.path.name}]", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Write what waits and end the files; bounded. It blocks. Idempotent."""
        with self._more:
            self._closing = True
            self._more.notify()
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

    def _run(self) -> None:
        try:
            over = False
            while not over:
                items, over = self._take()
                self._write(items)
        finally:
            for track in self._tracks.values():
                self._finish(track)
            self._folder.leave()

    def _take(self) -> tuple[dict[Track, list[Any]], bool]:
        """Wait for something; return it by its camera, and whether that was the last."""
        with self._more:
            self._more.wait_for(lambda: self._waiting.items or self._closing, INTERVAL)
            if self._waiting.items:
                self._more.wait_for(lambda: self._closing or self._waiting.bytes > CHUNK, INTERVAL)
            taken, self._waiting = self._waiting, _Waiting()
            for track in self._tracks.values():
                track.overflow = None
            over = self._closing
        found: dict[Track, list[Any]] = {}
        for track, item in taken.items:
            found.setdefault(track, []).append(item)
        return found, over

    def _write(self, found: dict[Track, list[Any]]) -> None:
        """Write what came, or count it; never raises."""
        try:
            if self._ready(found):
                for track, given in found.items():
                    self._write_track(track, given)
                self._end_old()
                self._delete_old()
                if found:
                    self._heal()
        except (OSError, ConfigurationError) as exc:
            self._fail(exc)
        except Exception as exc:
            logger.exception("recordings %s: unexpected", self._folder.path)
            self._fail(exc)
        trouble = self._trouble
        if trouble is not None:
            for track, given in found.items():
                track.lose(given, trouble.reason)

    def _ready(self, found: dict[Track, list[Any]]) -> bool:
        """Return whether the disk is to be tried; where it had failed, look whether there is room.

        Raises:
            ConfigurationError: another recorder has the folder now.
            OSError: the folder is not there, or there is no room.
        """
        trouble, now = self._trouble, self._clocks.steady()
        if trouble is None:
            return True
        if now < trouble.again or not found:
            return False
        self._folder.enter()
        self._looked = now
        if trouble.full and shutil.disk_usage(self._folder.path).free < ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return True

    def _write_track(self, track: Track, given: list[Any]) -> None:
        """Write what came of a camera; what is on the disk is taken out of ``given``.

        Raises:
            OSError: the disk did not take the rest.
        """
        done = written = 0
        try:
            for place, one in enumerate(given):
                if track.file is None or (not place % STEP and self._is_over(track)):
                    self._flush(track, written)
                    done, written = place, 0
                    self._begin(track)
                written += self._add(track, one)
            self._flush(track, written)
            done = len(given)
        except BaseException:
            self._cut(track)
            raise
        finally:
            del given[:done]

    def _is_over(self, track: Track) -> bool:
        aged = self._clocks.steady() - track.begun >= self._limits.age
        return track.file is not None and (aged or track.file.size >= self._limits.size)

    def _add(self, track: Track, one: Any) -> int:
        """Add what was put in to the file; return how many records that were."""
        file = track.file
        if file is None:  # not so: it was begun
            return 0
        if track.gap is not None and not track.gap_told:
            self._add_gap(track, file, track.gap)
            track.gap_told = True
        if isinstance(one, Gap):
            self._add_gap(track, file, one)
            return 0
        if isinstance(one, Description):
            track.facts |= one.facts
            file.add(Description(track.facts))
            return 0
        written = records = 0
        for item in track.read(one):
            records += 1
            try:
                file.add(item)
            except (ValueError, TypeError, RecursionError) as exc:  # nobody could read it back
                track.lose_one(str(exc))
            else:
                written += 1
            track.follow(item)
        track.offered += records - 1  # a result that cannot be read is an error, too
        return written

    @staticmethod
    def _add_gap(track: Track, file: RecordingFile, gap: Gap) -> None:
        file.add(gap.error(track.camera))
        file.note(STATE_METADATA, track.state.facts(track.endian))

    def _begin(self, track: Track) -> None:
        """Begin a camera's next file, and end the one before, if any.

        Raises:
            OSError: it cannot be made.
        """
        now = self._clocks.steady()
        if now - self._looked > LOOK:
            self._folder.look()
            self._looked = now
        path = self._folder.next_path(track.camera, self._clocks.wall())
        file = RecordingFile(opened(path, overwrite=False), self._mcap, path)
        try:
            file.start()
            file.add(Description(track.facts))
            file.note(STATE_METADATA, track.state.facts(track.endian))
            file.flush()
        except BaseException:
            file.close()
            with contextlib.suppress(OSError):
                path.unlink()
            raise
        self._folder.add(path)
        before, track.file = track.file, file
        track.begun, track.good = now, file.size
        if before is not None:
            self._end(before)

    def _flush(self, track: Track, written: int) -> None:
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

    def _cut(self, track: Track) -> None:
        """Leave a file with what is on the disk: its last chunk may be half of one."""
        file, track.file = track.file, None
        track.gap_told = False
        if file is not None:
            file.cut(track.good)
            self._folder.grown(file.path, track.good)

    def _end(self, file: RecordingFile) -> None:
        """End a file; what of its index the disk does not take is left out."""
        try:
            file.finish()
        finally:
            file.close()
            self._folder.grown(file.path, file.size)

    def _finish(self, track: Track) -> None:
        file, track.file = track.file, None
        if file is not None:
            try:
                self._end(file)
            except (OSError, ValueError) as exc:
                file.cut(track.good)
                logger.warning("%s has no end: %s", file.path, exc)

    def _end_old(self) -> None:
        """End files that are old enough, of cameras that say nothing."""
        for track in self._tracks_now():
            if self._is_over(track) and self._clocks.steady() - track.begun >= self._limits.age:
                self._finish(track)

    def _tracks_now(self) -> list[Track]:
        with self._more:
            return [*self._tracks.values()]

    # ------------------------------------------------------------------ the bound on the disk

    def _delete_old(self) -> None:
        """Delete the oldest files until what is left is within the bound."""
        folder = self._folder
        while folder.bytes > self._limits.keep:
            found = [one for one in folder.files.values() if one.name not in self._stuck]
            if not found:
                return
            oldest = min(found)
            for track in self._tracks_now():
                if track.file is not None and track.file.path.name == oldest.name:
                    self._finish(track)  # it goes on in a new one
            try:
                folder.delete(oldest.name)
            except OSError as exc:
                self._stuck.add(oldest.name)
                logger.warning("%s cannot be deleted: %s", folder.path / oldest.name, exc)

    # ------------------------------------------------------------------ trouble

    def _fail(self, error: Exception) -> None:
        before = self._trouble
        tries = 0 if before is None else before.tries + 1
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        prefix = f"recordings {self._folder.path}: "
        told = RecordingError(prefix + reason.removeprefix(prefix))
        told.__cause__ = error
        full = isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT}
        again = self._clocks.steady() + RETRIES[min(tries, len(RETRIES) - 1)]
        self._trouble = _Trouble(told, reason, full, again, tries)
        if before is None:
            logger.warning("%s; nothing is recorded until it is better", told)
            self._tell(told)

    def _heal(self) -> None:
        """The disk took something."""
        if self._trouble is not None:
            self._trouble = None
            logger.warning("recordings %s: recorded again", self._folder.path)
            self._tell(None)
