"""Write files of calibrations whole or not at all, and never misread one.

A file is JSON: ``schema``, ``schema_version``, ``kind``, ``written_at``, ``units``, ``software``,
``context``, ``data`` and ``sha256``, the hash of all other entries. Floats are written with so many
digits that reading gives the same bits; NaN and infinity, which JSON lacks, are refused. Files are
replaced, and earlier versions kept, by :mod:`smartcam._whole_files`.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from smartcam import _whole_files
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from smartcam.exceptions import CalibrationError

SCHEMA = "smartcam.calibration"
"""Value of ``schema`` in every file."""

SCHEMA_VERSION = (1, 0)
"""Major and minor version: files of a newer major version are refused, files of a newer minor
version are read."""

UNITS: Mapping[str, str] = {"length": "m", "angle": "rad", "time": "s"}
"""Units of the numbers in a file; a field in another unit has a name that ends in the unit."""

BACKUPS = 3
"""Number of earlier versions of a file that are kept."""

MAX_FILE_BYTES = 1 << 24
"""A file has at most this many bytes: a calibration of 10,000 touches needs a quarter of them."""

MIGRATIONS: dict[int, Callable[[dict[str, Any]], dict[str, Any]]] = {}
"""For each earlier major version, the function that converts a file's content to the next one."""

_PACKAGES = ("smartcam", "numpy", "scipy", "opencv-python-headless")

StrPath = str | os.PathLike[str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Document:
    """The contents of a calibration's file.

    Attributes:
        kind: kind of the data: ``plane``, ...
        data: the data.
        context: facts about the data: frames, tool, raw samples, ...
        written_at: time of writing, UTC, ISO 8601.
        software: versions of the programs that wrote it, by name.
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
    """Write a file, and keep the previous one as a backup.

    The folder of ``path`` must exist. ``data`` must be JSON data with finite numbers in SI units;
    ``context`` is stored with them: frames, tool, raw samples. Raises ``NOT_STORABLE`` if the data
    are no JSON data, or too large; ``NOT_WRITTEN`` or ``IN_USE``, which leave the previous file in
    place.
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
        raise Code.NOT_STORABLE.error(
            f"{path}: cannot be stored: {exc}; expected finite numbers, texts, lists and mappings"
        ) from exc
    if len(body) > MAX_FILE_BYTES:
        raise Code.NOT_STORABLE.error(
            f"{path}: {len(body)} bytes, expected {MAX_FILE_BYTES} at most",
            MAX_FILE_BYTES,
            len(body),
        )
    replace_file(Path(path), body, backups=backups)


def read(path: StrPath, kind: str) -> dict[str, Any]:
    """Return the data of a file of the given kind.

    Raises ``BROKEN_FILE``, ``NEWER_VERSION``, ``WRONG_KIND``; and OSError if the file cannot be
    read.
    """
    document = read_document(path)
    if document.kind != kind:
        raise Code.WRONG_KIND.error(
            f"{path}: holds {document.kind!r}, expected {kind!r}", kind, document.kind
        )
    return document.data


def read_document(path: StrPath) -> Document:
    """Return the contents of a file.

    Raises ``BROKEN_FILE``, ``NEWER_VERSION``; and OSError if the file cannot be read.
    """
    with Path(path).open("rb") as stream:
        body = stream.read(MAX_FILE_BYTES + 1)
    if len(body) > MAX_FILE_BYTES:
        raise _broken_file_error(path, f"more than {MAX_FILE_BYTES} bytes")
    try:
        parsed: Any = json.loads(body)
    except (ValueError, RecursionError) as exc:
        raise _broken_file_error(path, f"no JSON: {exc}") from exc
    if not isinstance(parsed, dict):
        raise _broken_file_error(path, "no JSON object")
    content = cast("dict[str, Any]", parsed)
    if content.get("schema") != SCHEMA:
        raise _broken_file_error(path, f"schema {content.get('schema')!r}, expected {SCHEMA!r}")
    version = _version(path, content.get("schema_version"))
    stored_hash = content.pop("sha256", None)
    if stored_hash != _digest(content):
        raise _broken_file_error(
            path, "its hash does not match: it was damaged, or changed by hand"
        )
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
        raise _broken_file_error(path, f"{exc!r}") from exc


def _broken_file_error(path: StrPath, reason: str) -> CalibrationError:
    return Code.BROKEN_FILE.error(f"{path}: {reason}; expected a calibration as smartcam writes it")


def _version(path: StrPath, text: object) -> tuple[int, int]:
    major, dot, minor = str(text).partition(".")
    if not (dot and major.isdecimal() and minor.isdecimal() and len(str(text)) < 20):
        raise _broken_file_error(path, f"schema_version {text!r}")
    version = int(major), int(minor)
    if version[0] > SCHEMA_VERSION[0]:
        raise Code.NEWER_VERSION.error(
            f"{path}: schema version {text}, expected {SCHEMA_VERSION[0]} at most: "
            "a newer smartcam wrote it",
            "{}.{}".format(*SCHEMA_VERSION),
            text,
        )
    if any(major not in MIGRATIONS for major in range(version[0], SCHEMA_VERSION[0])):
        raise _broken_file_error(path, f"schema_version {text!r}, which does not exist")
    return version


def _digest(content: Mapping[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _software() -> dict[str, str]:
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


# ---------------------------------------------------------------------- files


def replace_file(path: Path, body: bytes, *, backups: int = 0) -> None:
    """Write a file whole or not at all; replace an earlier file or symbolic link of that name.

    Raises ``NOT_WRITTEN``: the file cannot be written; ``IN_USE``: another process keeps writing in
    the folder. Both leave the previous file in place.
    """
    with _calibration_errors(path):
        _whole_files.replace_file(path, body, backups=backups)


def keep_backup(path: Path, count: int) -> None:
    """Copy a file to ``NAME.1``; move earlier copies to ``NAME.2`` and so on, up to ``count``.

    Does nothing if the file does not exist. Raises the errors of :func:`replace_file`.
    """
    with _calibration_errors(path):
        _whole_files.keep_backup(path, count)


@contextlib.contextmanager
def _calibration_errors(path: Path) -> Iterator[None]:
    """Raise an error of the file system as a CalibrationError."""
    try:
        yield
    except _whole_files.FolderInUseError as exc:
        raise Code.IN_USE.error(f"{path}: {exc}") from exc
    except OSError as exc:
        raise Code.NOT_WRITTEN.error(
            f"{path}: cannot be written: {exc.strerror or exc}", got=exc.errno
        ) from exc
