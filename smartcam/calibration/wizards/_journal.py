"""Keep a journal of a wizard's run (a sequence), so that the run can be resumed after a crash.

The first line names the wizard, each other line is an entry: a step with its answers. A line is
written and synced to the disk before the next step is shown. A killed process leaves at most a part
of a line, which the next process removes: the answer in this line was not confirmed yet.
"""

from __future__ import annotations

import contextlib
import json
import os
from typing import TYPE_CHECKING, Any

from smartcam._locks import try_lock
from smartcam._whole_files import sync_folder
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Self

    from smartcam.exceptions import CalibrationError

MAX_ENTRIES = 10_000
"""Largest number of entries of a journal; a calibration by hand has some dozens."""

MAX_LINE_BYTES = 1 << 20
"""Largest number of bytes of an entry; a result of 900 localizations has a quarter of it."""

_MAX_FILE = 1 << 28


class Journal:
    """A journal in a file; only one sequence at a time can use it.

    The file is locked while it is open, so that no other process writes into it.

    Args:
        path: the file, which is created if it does not exist. A symbolic link is refused.

    Attributes:
        path: the file.
        header: contents of the first line; None for a new file.
        entries: the entries.

    Raises:
        CalibrationError: ``IN_USE`` or ``BROKEN_FILE``.
        OSError: the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path: Path = path
        self.header: dict[str, Any] | None = None
        self.entries: list[dict[str, Any]] = []
        self._size = 0
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
        self._stream = os.fdopen(os.open(path, flags, 0o644), "r+b", buffering=0)
        try:
            self._lock()
            self._read_entries()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def start(self, header: dict[str, Any]) -> None:
        """Write the first line of a new file.

        Raises ``NOT_STORABLE``, and OSError if the file cannot be written.
        """
        self.header = self._write(header)
        sync_folder(self.path.parent)

    def append(self, entry: dict[str, Any]) -> dict[str, Any]:
        """Write an entry to the disk, and return the entry as reading the journal will give it.

        Raises ``NOT_STORABLE`` if the entry is not possible as JSON, or too long, or if the journal
        is full; OSError if the entry cannot be written, which leaves the file as it was.
        """
        if len(self.entries) >= MAX_ENTRIES:
            raise Code.NOT_STORABLE.error(
                f"{self.path}: entry {MAX_ENTRIES + 1}, expected {MAX_ENTRIES} at most"
            )
        stored = self._write(entry)
        self.entries.append(stored)
        return stored

    def close(self) -> None:
        """Close the file, which frees its lock. Idempotent."""
        self._stream.close()

    def _lock(self) -> None:
        if try_lock(self._stream.fileno()) is False:
            raise Code.IN_USE.error(
                f"{self.path}: another sequence writes it; expected one at a time"
            )

    def _read_entries(self) -> None:
        if os.fstat(self._stream.fileno()).st_size > _MAX_FILE:
            raise self._broken_journal_error(f"more than {_MAX_FILE} bytes")
        data = self._stream.read() or b""
        complete = data.rfind(b"\n") + 1
        for number, line in enumerate(data[:complete].splitlines(), 1):
            try:
                value = json.loads(line)
            except ValueError as exc:
                raise self._broken_journal_error(f"line {number} is no JSON: {exc}") from exc
            if not isinstance(value, dict):
                raise self._broken_journal_error(f"line {number} is no object")
            if number == 1:
                self.header = value
            else:
                self.entries.append(value)
        self._size = complete
        self._truncate()

    def _write(self, value: dict[str, Any]) -> dict[str, Any]:
        try:
            line = json.dumps(value, allow_nan=False, separators=(",", ":")).encode() + b"\n"
        except (TypeError, ValueError, RecursionError) as exc:
            raise Code.NOT_STORABLE.error(f"{self.path}: cannot be stored: {exc}") from exc
        if len(line) > MAX_LINE_BYTES:
            raise Code.NOT_STORABLE.error(
                f"{self.path}: an entry of {len(line)} bytes, expected {MAX_LINE_BYTES} at most"
            )
        try:
            self._write_bytes(line)
        except BaseException:
            with contextlib.suppress(OSError):
                self._truncate()
            raise
        self._size += len(line)
        stored: dict[str, Any] = json.loads(line)
        return stored

    def _write_bytes(self, line: bytes) -> None:
        unwritten = memoryview(line)
        while unwritten:
            unwritten = unwritten[self._stream.write(unwritten) :]
        os.fsync(self._stream.fileno())

    def _truncate(self) -> None:
        self._stream.truncate(self._size)
        self._stream.seek(self._size)

    def _broken_journal_error(self, reason: str) -> CalibrationError:
        return Code.BROKEN_FILE.error(f"{self.path}: {reason}; expected the journal of a sequence")
