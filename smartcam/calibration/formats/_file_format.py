"""Files of a format of another program: read within a bound, written whole or not at all."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from smartcam.calibration._files.store import replace_file
from smartcam.calibration.formats._plain import malformed
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

MAX_TEXT = 1 << 16
"""Bytes at most of a file with one pose, which has some hundred."""

MAX_YAML = 1 << 18
"""Bytes at most of a YAML file with samples: some 400 of them. PyYAML may take seconds for it."""

MAX_FILE = 1 << 24
"""Bytes at most of a JSON or CSV file: a ground truth of EuRoC has 6 MB."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Format(Generic[T]):
    """One format."""

    title: str  # what it is
    suffix: str  # what its files' names end in
    # makes a value of a text and the names of target and source, which formats without names of
    # frames use; errors are those of :func:`~smartcam.calibration.formats.read_transform`
    parse: Callable[[str, str, str], T]
    # makes a text of a value, without ``head``; errors are those of
    # :func:`~smartcam.calibration.formats.write_transform`, and ``WRONG_FRAME``
    compose: Callable[[T], str]
    head: str = ""  # what the file begins with
    most: int = MAX_TEXT  # bytes of a file at most

    def read(self, path: str | os.PathLike[str], target: str = "", source: str = "") -> T:
        """Read a file; errors are those of ``parse``."""
        with Path(path).open("rb") as stream:
            body = stream.read(self.most + 1)
        try:
            if len(body) > self.most:
                raise malformed("file", f"{self.most} bytes at most")
            try:
                text = body.decode("utf-8-sig")
            except UnicodeDecodeError as exc:
                raise malformed("file", f"UTF-8 ({exc.reason} at byte {exc.start})") from exc
            return self.parse(text, target, source)
        except CalibrationError as exc:
            raise CalibrationError(
                f"{path}: {self.title}: {exc}", code=exc.code, expected=exc.expected, got=exc.got
            ) from exc

    def write(self, path: str | os.PathLike[str], value: T) -> None:
        """Write a file, whole or not at all; errors are those of ``compose``, and NOT_WRITTEN."""
        replace_file(Path(path), (self.head + self.compose(value)).encode())


def named(parse: Callable[[str], T]) -> Callable[[str, str, str], T]:
    """Return a parser for a format that names its frames, or has none to name."""
    return lambda text, _target, _source: parse(text)
