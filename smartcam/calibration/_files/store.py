"""Files of calibrations: written whole or not at all, and never misread.

A file is JSON: ``schema``, ``schema_version``, ``kind``, ``written_at``, ``units``, ``software``,
``context``, ``data`` and ``sha256``, the hash of all the rest. Floats are written with as many
digits as it takes to read the same bits again; NaN and infinity, which JSON lacks, are refused.

Writing: a temporary file in the same folder is written and synced, the present file is kept under
``NAME.1`` (the one before as ``NAME.2``, ...), the new one takes its place in one step, the folder
is synced. Whenever that is cut off, the name leads to the old file or the new one, whole; the next
writer clears away what was left. One writes in a folder at a time, as long as it has its lock.
"""

from __future__ import annotations

import contextlib
import filecmp
import hashlib
import itertools
import json
import os
import platform
import re
import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from smartcam._locks import try_lock
from smartcam.calibration._codes import Code
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

SCHEMA = "smartcam.calibration"
"""What ``schema`` is in every file."""

SCHEMA_VERSION = (1, 0)
"""Major and minor; a file of a newer major is refused, one of a newer minor is read."""

UNITS: Mapping[str, str] = {"length": "m", "angle": "rad", "time": "s"}
"""Units of all that a file holds, unless a name in it says otherwise."""

BACKUPS = 3
"""Earlier versions of a file that are kept."""

MAX_FILE = 1 << 24
"""Bytes of a file at most: a calibration of 10,000 touches has a quarter of it."""

LOCK_TIMEOUT = 30.0
"""Seconds that a writer waits for others in the same folder, each of which takes milliseconds."""

_LOOK_AGAIN = 0.002
_ATTEMPTS = 5

MIGRATIONS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {}
"""By major version: what makes the content of the next major version of a file's content."""

_PACKAGES = ("smartcam", "numpy", "scipy", "opencv-python-headless")

StrPath = str | os.PathLike[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """What a file holds.

    Attributes:
        kind: what the data are: ``plane``, ...
        data: the data.
        context: what was said about them: frames, tool, raw samples, ...
        written_at: when, UTC, ISO 8601.
        software: versions of what wrote it, by name.
        version: the file's schema version, major and minor.
    """

    kind: str
    data: dict[str, Any]
    context: dict[str, Any]
    written_at: str
    software: dict[str, str]
    version: tuple[int, int]


def write(
    path: StrPath,
    kind: str,
    data: Mapping[str, Any],
    *,
    context: Mapping[str, Any] | None = None,
    backups: int = BACKUPS,
) -> None:
    """Write a file; what was there is kept as a backup.

    The folder of ``path`` must be there. ``data`` are JSON-able, SI units, finite numbers;
    ``context`` is what else is to be kept with them: frames, tool, raw samples. Raises
    ``NOT_STORABLE``: the data are no JSON or too large; ``NOT_WRITTEN`` or ``IN_USE``: what was
    there is there.
    """
    content = {
        "schema": SCHEMA,
        "schema_version": "{}.{}".format(*SCHEMA_VERSION),
        "kind": kind,
        "written_at": datetime.now(UTC).isoformat(),
        "units": dict(UNITS),
        "software": _software(),
        "context": dict(context or {}),
        "data": dict(data),
    }
    try:
        content["sha256"] = _digest(content)
        text = json.dumps(content, allow_nan=False, indent=1) + "\n"
        body = text.encode()
    except (TypeError, ValueError, RecursionError) as exc:
        raise CalibrationError(
            f"{path}: cannot be stored: {exc}; expected finite numbers, texts, lists and mappings",
            code=Code.NOT_STORABLE,
        ) from exc
    if len(body) > MAX_FILE:
        raise CalibrationError(
            f"{path}: {len(body)} bytes, expected {MAX_FILE} at most",
            code=Code.NOT_STORABLE,
            got=len(body),
            expected=MAX_FILE,
        )
    replace_file(Path(path), body, backups=backups)


def read(path: StrPath, kind: str) -> dict[str, Any]:
    """Return the data of a file, which must be of a kind.

    Raises ``BROKEN_FILE``, ``NEWER_VERSION``, ``WRONG_KIND``; OSError: it cannot be read.
    """
    document = read_document(path)
    if document.kind != kind:
        raise CalibrationError(
            f"{path}: holds {document.kind!r}, expected {kind!r}",
            code=Code.WRONG_KIND,
            got=document.kind,
            expected=kind,
        )
    return document.data


def read_document(path: StrPath) -> Document:
    """Return all that a file holds.

    Raises ``BROKEN_FILE``, ``NEWER_VERSION``; OSError: it cannot be read.
    """
    with Path(path).open("rb") as stream:
        body = stream.read(MAX_FILE + 1)
    if len(body) > MAX_FILE:
        raise _broken(path, f"more than {MAX_FILE} bytes")
    try:
        parsed: Any = json.loads(body)
    except (ValueError, RecursionError) as exc:
        raise _broken(path, f"no JSON: {exc}") from exc
    if not isinstance(parsed, dict):
        raise _broken(path, "no JSON object")
    content = cast("dict[str, Any]", parsed)
    if content.get("schema") != SCHEMA:
        raise _broken(path, f"schema {content.get('schema')!r}, expected {SCHEMA!r}")
    version = _version(path, content.get("schema_version"))
    said = content.pop("sha256", None)
    if said != _digest(content):
        raise _broken(path, "its hash is another: it was damaged, or changed by hand")
    for major in range(version[0], SCHEMA_VERSION[0]):
        content = MIGRATIONS[major](content)
    try:
        return Document(
            kind=str(content["kind"]),
            data=dict(content["data"]),
            context=dict(content["context"]),
            written_at=str(content["written_at"]),
            software=dict(content["software"]),
            version=version,
        )
    except (KeyError, TypeError, ValueError) as exc:
        raise _broken(path, f"{exc!r}") from exc


def _broken(path: StrPath, why: str) -> CalibrationError:
    return CalibrationError(
        f"{path}: {why}; expected a calibration as smartcam writes it", code=Code.BROKEN_FILE
    )


def _version(path: StrPath, text: object) -> tuple[int, int]:
    major, dot, minor = str(text).partition(".")
    if not (dot and major.isdecimal() and minor.isdecimal() and len(str(text)) < 20):
        raise _broken(path, f"schema_version {text!r}")
    version = int(major), int(minor)
    if version[0] > SCHEMA_VERSION[0]:
        raise CalibrationError(
            f"{path}: schema version {text}, expected {SCHEMA_VERSION[0]} at most: "
            "a newer smartcam wrote it",
            code=Code.NEWER_VERSION,
            got=text,
            expected="{}.{}".format(*SCHEMA_VERSION),
        )
    if any(major not in MIGRATIONS for major in range(version[0], SCHEMA_VERSION[0])):
        raise _broken(path, f"schema_version {text!r}, which there never was")
    return version


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _software() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return found


# ---------------------------------------------------------------------- files


def replace_file(path: Path, body: bytes, *, backups: int = 0) -> None:
    """Put a file in the place of another, whole or not at all; a symbolic link is replaced.

    Any number of processes and threads may do so at once; the last one's file stays. What a crash
    left behind is cleared away. Raises ``NOT_WRITTEN``: it cannot be written, or ``IN_USE``:
    another one writes in the folder and does not end; what was there is there.
    """
    with _writing(path) as alone:
        if alone:
            _clear(path)
        for _ in range(_ATTEMPTS - 1):
            with contextlib.suppress(FileNotFoundError, FileExistsError):
                return _replace(path, body, backups)
        return _replace(path, body, backups)


def keep_backup(path: Path, count: int) -> None:
    """Keep a file as ``NAME.1``, the one before as ``NAME.2``, up to ``count``; it stays there.

    Nothing is done where it is not there. Raises as :func:`replace_file`.
    """
    with _writing(path):
        _rotate(path, count)


def sync_folder(folder: Path) -> None:
    """Have the system write a folder's names to the disk, where it can."""
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
    """Be the only one that writes in a file's folder; what the disk refuses is told as ours.

    Yields whether it is so: there are file systems without locks.
    """
    try:
        handle = _open_lock(path.parent)
        try:
            deadline = time.monotonic() + LOCK_TIMEOUT
            while (alone := try_lock(handle)) is False:
                if time.monotonic() > deadline:
                    raise CalibrationError(
                        f"{path}: another process has written in its folder for "
                        f"{LOCK_TIMEOUT:g} s; expected it to end",
                        code=Code.IN_USE,
                    )
                time.sleep(_LOOK_AGAIN)
            yield alone is True
        finally:
            os.close(handle)  # and with it the lock
    except OSError as exc:
        raise CalibrationError(
            f"{path}: cannot be written: {exc.strerror or exc}",
            code=Code.NOT_WRITTEN,
            got=exc.errno,
        ) from exc


def _open_lock(folder: Path) -> int:
    """Return the path to lock: the folder itself; on Windows, where it cannot be, a file in it."""
    flags = getattr(os, "O_DIRECTORY", None)
    if flags is None:
        return os.open(folder / ".smartcam.lock", os.O_RDWR | os.O_CREAT)
    return os.open(folder, os.O_RDONLY | flags)


def _replace(path: Path, body: bytes, backups: int) -> None:
    """Replace a file; where there are no locks, another one may be at the backups, too."""
    temporary = _temporary(path, body)
    try:
        if backups > 0:
            _rotate(path, backups)
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    sync_folder(path.parent)


def _clear(path: Path) -> None:
    """Take away what was to become this file when its writer was killed."""
    stale = re.compile(re.escape(f".{path.name}.") + r"[a-z0-9_]{8}\.tmp")
    with os.scandir(path.parent) as found:
        names = [one.name for one in found if stale.fullmatch(one.name)]
    for name in names:
        path.with_name(name).unlink(missing_ok=True)


def _temporary(path: Path, body: bytes) -> Path:
    """Write a file beside another one, to take its place."""
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
    rows = [path.with_name(f"{path.name}.{number}") for number in range(1, count + 1)]
    if rows[0].is_file() and filecmp.cmp(path, rows[0], shallow=False):
        return  # a crash came between backup and new file
    filled = list(itertools.takewhile(Path.exists, rows[:-1]))  # a gap takes what comes before it
    for newer, older in reversed(list(zip(filled, rows[1:], strict=False))):
        if older.exists() and newer.samefile(older):
            newer.unlink()  # to rename one name of a file to another does nothing
        else:
            newer.replace(older)
    try:
        os.link(path, rows[0])  # a second name: no moment without the file
    except (OSError, NotImplementedError):
        _temporary(path, path.read_bytes()).replace(rows[0])
