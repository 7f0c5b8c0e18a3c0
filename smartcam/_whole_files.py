"""Write files whole or not at all.

A temporary file in the same folder is written and synced. If backups are wanted, the old file is
kept as ``NAME.1``, and its backups become ``NAME.2``, ... Then the temporary file replaces the old
file in one step, and the folder is synced. If the process is killed at any time, the name leads to
the whole old file or the whole new file, and the next writer removes the temporary files. A folder
has a lock, so that only one process at a time writes in it.
"""

from __future__ import annotations

import contextlib
import filecmp
import itertools
import os
import re
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

from smartcam._locks import try_lock

if TYPE_CHECKING:
    from collections.abc import Iterator

LOCK_TIMEOUT = 30.0
"""Seconds that a writer waits for other writers in the folder, each of which takes milliseconds."""

_LOCK_RETRY_TIME = 0.002
_MAX_ATTEMPTS = 5


class FolderInUseError(OSError):
    """Another process writes in a file's folder, and does not finish."""


def replace_file(path: Path, body: bytes, *, backups: int = 0) -> None:
    """Write a file, whole or not at all, in place of the old one; a symbolic link is replaced.

    Any number of processes and threads may write at once; the file of the last writer stays.
    Temporary files that a crash has left are removed.

    Raises:
        FolderInUseError: another process writes in the folder and does not finish.
        OSError: the file cannot be written. The old file is still there.
    """
    with _writing(path) as has_lock:
        if has_lock:
            _remove_leftovers(path)
        for _ in range(_MAX_ATTEMPTS - 1):
            with contextlib.suppress(FileNotFoundError, FileExistsError):
                return _replace(path, body, backups)
        return _replace(path, body, backups)


def keep_backup(path: Path, count: int) -> None:
    """Keep a file also as ``NAME.1``, and older backups up to ``count`` files.

    Do nothing if the file does not exist.

    Raises:
        FolderInUseError, OSError: as :func:`replace_file`.
    """
    with _writing(path):
        _rotate(path, count)


def sync_folder(folder: Path) -> None:
    """Write a folder's list of names to the disk, if the system can."""
    flags = getattr(os, "O_DIRECTORY", None)
    if flags is None:  # Windows: folders cannot be opened
        return
    handle = os.open(folder, os.O_RDONLY | flags)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[bool]:
    """Lock a file's folder for writing.

    Yields False if the file system has no locks.
    """
    handle = _open_lock(path.parent)
    try:
        deadline = time.monotonic() + LOCK_TIMEOUT
        while (has_lock := try_lock(handle)) is False:
            if time.monotonic() > deadline:
                raise FolderInUseError(
                    f"another process has written in its folder for {LOCK_TIMEOUT:g} s; expected "
                    "it to end"
                )
            time.sleep(_LOCK_RETRY_TIME)
        yield has_lock is True
    finally:
        os.close(handle)  # and with it the lock


def _open_lock(folder: Path) -> int:
    """Open the path to lock: the folder itself; on Windows, which cannot open it, a file in it."""
    flags = getattr(os, "O_DIRECTORY", None)
    if flags is None:
        return os.open(folder / ".smartcam.lock", os.O_RDWR | os.O_CREAT)
    return os.open(folder, os.O_RDONLY | flags)


def _replace(path: Path, body: bytes, backups: int) -> None:
    """Replace a file; without locks, another process may change the backups, too."""
    temporary = _write_temporary(path, body)
    try:
        if backups > 0:
            _rotate(path, backups)
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    sync_folder(path.parent)


def _remove_leftovers(path: Path) -> None:
    """Remove temporary files for this path whose writer was killed."""
    stale = re.compile(re.escape(f".{path.name}.") + r"[a-z0-9_]{8}\.tmp")
    with os.scandir(path.parent) as entries:
        names = [entry.name for entry in entries if stale.fullmatch(entry.name)]
    for name in names:
        path.with_name(name).unlink(missing_ok=True)


def _write_temporary(path: Path, body: bytes) -> Path:
    """Write a new file in the path's folder, under a temporary name, and return its path."""
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(body)
            stream.flush()
            os.fsync(stream.fileno())
    except BaseException:
        with contextlib.suppress(OSError):
            Path(name).unlink()
        raise
    return Path(name)


def _rotate(path: Path, count: int) -> None:
    if not path.is_file() or path.is_symlink():
        return
    backup_paths = [path.with_name(f"{path.name}.{number}") for number in range(1, count + 1)]
    if backup_paths[0].is_file() and filecmp.cmp(path, backup_paths[0], shallow=False):
        return  # a crash came between backup and new file
    present = list(itertools.takewhile(Path.exists, backup_paths[:-1]))  # up to the first gap
    for newer, older in reversed(list(zip(present, backup_paths[1:], strict=False))):
        if older.exists() and newer.samefile(older):
            newer.unlink()  # renaming one name of a file to another does nothing
        else:
            newer.replace(older)
    try:
        os.link(path, backup_paths[0])  # a second name, so that the file is always there
    except (OSError, NotImplementedError):
        _write_temporary(path, path.read_bytes()).replace(backup_paths[0])
