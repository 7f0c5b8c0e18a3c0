"""Map the names of calibrations, which clients choose, to files in one folder.

A name never leads out of the folder: names with characters beyond :data:`NAME`, and symbolic links
inside of the folder, are refused before anything is opened.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from smartcam._arguments import check_path
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    import os
    from pathlib import Path

    from smartcam.exceptions import CalibrationError

NAME = r"[A-Za-z0-9](?:[A-Za-z0-9_-]*[A-Za-z0-9])?"
"""Pattern of a name, which has no dot, slash or other character with a meaning to file systems."""

MAX_NAME_LENGTH = 64
"""A name has at most this many characters."""

EXPORTS = "exports"
"""Name of the subfolder for exported files."""

_SUFFIXES = (".json", ".yaml", ".txt", ".calib")
_RESERVED = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])", re.IGNORECASE)
"""Names that Windows keeps for devices."""


class Folder:
    """A folder of calibrations, which is created if it does not exist.

    Args:
        path: the folder; it may be a symbolic link, since the user chooses it.

    Attributes:
        path: the folder, absolute.

    Raises:
        ConfigurationError: ``path`` is no path.
        OSError: the folder cannot be created.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path: Path = check_path(path, "path", "Folder").resolve()
        self.path.mkdir(parents=True, exist_ok=True)

    def names(self) -> list[str]:
        """Return the sorted names of the calibrations in the folder."""
        files = (
            path for path in self.path.glob("*.json") if path.is_file() and not path.is_symlink()
        )
        return sorted(file.stem for file in files if _is_name(file.stem))

    def calibration(self, name: str) -> Path:
        """Return the path of a calibration's file.

        Raises:
            CalibrationError: ``BAD_NAME``.
        """
        return self._safe_path(f"{_check_name(name)}.json")

    def journal(self, name: str, wizard: str = "") -> Path:
        """Return the path of a wizard's journal.

        Args:
            name: name of the calibration.
            wizard: name of the wizard; empty for the one that makes the calibration.

        Raises:
            CalibrationError: ``BAD_NAME``.
        """
        stem = f"{_check_name(name)}.{_check_name(wizard)}" if wizard else _check_name(name)
        return self._safe_path(f"{stem}.journal")

    def checks(self, name: str) -> Path:
        """Return the path of the file of a calibration's checks.

        Raises:
            CalibrationError: ``BAD_NAME``.
        """
        return self._safe_path(f"{_check_name(name)}.checks.jsonl")

    def export(self, target: str) -> Path:
        """Return the path that an export is written to; create its folder.

        Args:
            target: name of the file, with one of the suffixes in _SUFFIXES.

        Raises:
            CalibrationError: ``BAD_NAME``.
            OSError: the folder cannot be created.
        """
        target = target.removeprefix(f"{EXPORTS}/")
        stem, dot, suffix = target.rpartition(".")
        if f"{dot}{suffix}" not in _SUFFIXES:
            raise _bad_name_error(target, f"a name that ends in one of {', '.join(_SUFFIXES)}")
        path = self._safe_path(EXPORTS, f"{_check_name(stem)}.{suffix}")
        path.parent.mkdir(exist_ok=True)
        return path

    def find(self, name_or_path: str) -> Path:
        """Return the path of a calibration, by its name, or of an exported file.

        Args:
            name_or_path: ``NAME``, or ``exports/NAME.json``.

        Raises:
            CalibrationError: ``BAD_NAME``, ``NOT_FOUND``.
        """
        if "/" not in name_or_path:
            path = self.calibration(name_or_path)
        elif name_or_path.startswith(f"{EXPORTS}/"):
            path = self.export(name_or_path)
        else:
            raise _bad_name_error(name_or_path, f"a name, or {EXPORTS}/NAME.json")
        if not path.is_file():
            known = ", ".join(self.names()[:20]) or "none: the folder is empty"
            raise Code.NOT_FOUND.error(
                f"no calibration {name_or_path!r}; there are {known}", got=name_or_path
            )
        return path

    def _safe_path(self, *parts: str) -> Path:
        """Return a path inside the folder; raise BAD_NAME if it leads through a symbolic link."""
        path = self.path
        for part in parts:
            path /= part
            if path.is_symlink():
                raise _bad_name_error(part, "no symbolic link")
        return path


def _is_name(text: str) -> bool:
    return bool(
        len(text) <= MAX_NAME_LENGTH and re.fullmatch(NAME, text) and not _RESERVED.fullmatch(text)
    )


def _check_name(name: str) -> str:
    """Return the name; raise BAD_NAME for one that is not allowed."""
    if not _is_name(name):
        raise _bad_name_error(name, f"1 to {MAX_NAME_LENGTH} letters, digits, '-' and '_'")
    return name


def _bad_name_error(name: str, expected: str) -> CalibrationError:
    shown = repr(name) if len(name) <= MAX_NAME_LENGTH else f"{name[:MAX_NAME_LENGTH]!r}..."
    return Code.BAD_NAME.error(
        f"the name {shown} cannot be used: expected {expected}", expected, name
    )
