"""Name, list, count and delete the files in a folder of consecutive recordings.

A file's name consists of the camera's name, with ``.`` for ``/``, and the time of the first record,
UTC: ``line1.cam3_20260102T030405.678Z.mcap``. Sorted by name, a camera's files are in order.
"""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from smartcam._locks import try_lock
from smartcam.exceptions import ConfigurationError
from smartcam.recording._mcap.form import EPOCH, PROFILE
from smartcam.recording._mcap.records import MAGIC

if TYPE_CHECKING:
    from collections.abc import Iterator

SUFFIX = ".mcap"

_NAME = re.compile(
    r"(?P<camera>[a-z0-9_-]+(?:\.[a-z0-9_-]+){0,3})_(?P<at>\d{8}T\d{6}\.\d{3})Z\.mcap", re.ASCII
)
_TIME_FORMAT = "%Y%m%dT%H%M%S.%f"

_HEAD = MAGIC + b"\x01"
_PROFILE_OFFSET = len(_HEAD) + 8
"""Offset in the file, in bytes, of the length of the header's profile."""

LOCK = ".smartcam.lock"
"""The file that is locked if a folder cannot be locked, as on Windows."""


class FileName(NamedTuple):
    """The parts of a file's name.

    Attributes:
        camera: name of the camera.
        at: time of the first record, UTC, in whole milliseconds; never before the previous file's.
    """

    camera: str
    at: datetime

    @classmethod
    def parse(cls, name: str) -> FileName | None:
        """Return the parts of a name; None if the name is not one that a recorder gives."""
        match = _NAME.fullmatch(name)
        if match is None:
            return None
        try:
            at = datetime.strptime(match["at"], _TIME_FORMAT).replace(tzinfo=UTC)
        except ValueError:
            return None
        return cls(match["camera"].replace(".", "/"), at)

    def __str__(self) -> str:
        at = self.at.strftime("%Y%m%dT%H%M%S.") + f"{self.at.microsecond // 1000:03d}"
        return f"{self.camera.replace('/', '.')}_{at}Z{SUFFIX}"


@dataclass(order=True)
class KnownFile:
    """A file of the folder; files sort by age, the oldest first.

    Attributes:
        at: time of the file's beginning.
        name: name of the file.
        size: size of the file, bytes.
    """

    at: datetime
    name: str
    size: int = field(compare=False)


def is_smartcam_recording(path: Path) -> bool:
    """Return True if a file begins like a recording of smartcam; False for an empty file."""
    try:
        with path.open("rb") as stream:
            head = stream.read(_PROFILE_OFFSET + 4 + len(PROFILE))
    except OSError:
        return False
    length = int.from_bytes(head[_PROFILE_OFFSET : _PROFILE_OFFSET + 4], "little")
    return (
        head.startswith(_HEAD)
        and length == len(PROFILE)
        and head[_PROFILE_OFFSET + 4 :] == PROFILE.encode()
    )


def files_of(folder: Path) -> Iterator[tuple[FileName, os.DirEntry[str]]]:
    """Yield the files with a recorder's names, in no order, without reading them.

    Raises:
        OSError: the folder cannot be read.
    """
    with os.scandir(folder) as entries:
        for entry in entries:
            name = FileName.parse(entry.name)
            if name is not None and entry.is_file(follow_symlinks=False):
                yield name, entry


class RecordingFolder:
    """A folder in which one recorder writes; not thread-safe.

    Args:
        path: the folder.

    Attributes:
        path: path that was given.
        files: the known files of the recorder, by name.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files: dict[str, KnownFile] = {}
        # for each examined file, by name: whether it is a recording of smartcam
        self._is_own: dict[str, bool] = {}
        self._lock: int | None = None
        self._existed = False  # whether the folder existed earlier; then it is not created again
        self._last: dict[str, datetime] = {}  # start of the last file of each camera

    def enter(self) -> None:
        """Create the folder if it never existed, lock it and list its files.

        A folder that existed earlier and is missing now is not created again: it may have been a
        mounted disk, and the disk below its mount point may be small.

        Raises:
            ConfigurationError: another recorder writes in it.
            OSError: the folder cannot be created, or read.
        """
        self.leave()
        if not self._existed:
            self.path.mkdir(exist_ok=True)
        flags = getattr(os, "O_DIRECTORY", None)
        if flags is None:
            lock = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT)
        else:
            lock = os.open(self.path, os.O_RDONLY | flags)
        if try_lock(lock) is False:
            os.close(lock)
            raise ConfigurationError(f"recordings {self.path}: another recorder writes in it")
        self._lock, self._existed = lock, True
        self.list_files()

    def leave(self) -> None:
        """Unlock the folder. Idempotent."""
        lock, self._lock = self._lock, None
        if lock is not None:
            os.close(lock)

    def list_files(self) -> None:
        """List the files again.

        Raises:
            OSError: the folder cannot be read.
        """
        known_files: dict[str, KnownFile] = {}
        is_own: dict[str, bool] = {}
        for name, entry in files_of(self.path):
            known = self._is_own.get(entry.name)
            is_own[entry.name] = known = (
                is_smartcam_recording(Path(entry.path)) if known is None else known
            )
            if known:
                with contextlib.suppress(FileNotFoundError):
                    size = entry.stat(follow_symlinks=False).st_size
                    known_files[entry.name] = KnownFile(name.at, entry.name, size)
            self._update_last(name)
        self.files, self._is_own = known_files, is_own

    def _update_last(self, name: FileName) -> None:
        self._last[name.camera] = max(name.at, self._last.get(name.camera, EPOCH))

    def next_path(self, camera: str, at: datetime) -> Path:
        """Return the path of a camera's next file, which sorts after all earlier ones.

        Args:
            camera: name of the camera.
            at: time of the first record of the file.
        """
        rounded = max(EPOCH, at - timedelta(microseconds=at.microsecond % 1000))
        last = self._last.get(camera)
        if last is not None:
            rounded = max(rounded, last + timedelta(milliseconds=1))
        name = FileName(camera, rounded)
        self._update_last(name)
        return self.path / str(name)

    def add(self, path: Path) -> None:
        """Count a file that was just made."""
        name = FileName.parse(path.name)
        if name is not None:
            self._is_own[path.name] = True
            self.files[path.name] = KnownFile(name.at, path.name, 0)

    def set_size(self, path: Path, size: int) -> None:
        """Record the present size of a file, bytes."""
        if path.name in self.files:
            self.files[path.name].size = size

    @property
    def total_bytes(self) -> int:
        """Number of bytes of all files of the recorder."""
        return sum(file.size for file in self.files.values())

    def delete(self, name: str) -> None:
        """Delete a file of the recorder; keep the file if another program has replaced it.

        Raises:
            OSError: the file cannot be deleted.
        """
        path = self.path / name
        if is_smartcam_recording(path):
            path.unlink(missing_ok=True)
        self.files.pop(name, None)
        self._is_own.pop(name, None)
