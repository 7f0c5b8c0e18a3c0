"""Read files of other programs within a bound, and write them whole or not at all."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

import numpy as np

from smartcam.calibration._files.store import replace_file
from smartcam.calibration._units import check_length, metres_of, no_unit_error
from smartcam.calibration.formats._plain import malformed_error
from smartcam.exceptions import CalibrationError
from smartcam.geometry import Transform
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

MAX_TEXT_BYTES = 1 << 16
"""A file with one pose has at most this many bytes; usual ones have some hundred."""

MAX_YAML_BYTES = 1 << 18
"""A YAML file with samples has at most this many bytes, which hold some 400 samples. PyYAML may
take seconds for it."""

MAX_FILE_BYTES = 1 << 24
"""A JSON or CSV file has at most this many bytes: a ground truth of EuRoC has 6 MB."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Measured(Generic[T]):
    """A value read from a file whose format does not fix the unit of lengths."""

    value: T
    unit: str | None = None  # unit that the file names, or None


@dataclass(frozen=True, slots=True)
class Format(Generic[T]):
    """One format of files."""

    title: str  # description for people
    suffix: str  # suffix of the files' names
    # function that parses a text to a value; further arguments: the size for cameras, else the
    # names of target and source if the format has none. It returns Measured if lengths may be in
    # any unit, else metres; errors are those of
    # :func:`~smartcam.calibration.formats.read_transform`
    parse: Callable[..., T | Measured[T]]
    # function that returns a value as text without ``head``; None for a format that is only read.
    # Errors are those of :func:`~smartcam.calibration.formats.write_transform`, and ``WRONG_FRAME``
    compose: Callable[[T], str] | None = None  # None: it is only read
    head: str = ""  # text at the beginning of each file
    most: int = MAX_TEXT_BYTES  # largest number of bytes of a file

    def read(
        self,
        path: str | os.PathLike[str],
        *given: Any,
        unit: str | None = None,
    ) -> T:
        """Read a file; errors are those of ``parse``, and UNIT_UNKNOWN.

        ``unit``: unit of its lengths; None for the unit that the file or its format names.
        """
        with Path(path).open("rb") as stream:
            body = stream.read(self.most + 1)
        try:
            if len(body) > self.most:
                raise malformed_error("file", f"{self.most} bytes at most")
            try:
                text = body.decode("utf-8-sig")
            except UnicodeDecodeError as exc:
                raise malformed_error("file", f"UTF-8 ({exc.reason} at byte {exc.start})") from exc
            return self._in_metres(self.parse(text, *given), unit)
        except CalibrationError as exc:
            raise CalibrationError(
                f"{path}: {self.title}: {exc}", code=exc.code, expected=exc.expected, got=exc.got
            ) from exc

    def _in_metres(self, parsed: T | Measured[T], unit: str | None) -> T:
        by_file = isinstance(parsed, Measured)
        stated = cast("Measured[T]", parsed).unit if by_file else "m"
        value = cast("Measured[T]", parsed).value if by_file else cast("T", parsed)
        motions = _motions(value)
        if not motions:
            return value
        if unit is None and stated is None:
            raise no_unit_error("lengths")
        factor = metres_of(unit or stated or "m", "lengths")
        if unit is None and not by_file:
            for motion in motions:
                distance = factor * float(np.linalg.norm(motion.translation))
                check_length(distance, f"distance of {motion.source} from {motion.target}")
        return value if factor == 1.0 else cast("T", _scaled(value, factor))

    def write(self, path: str | os.PathLike[str], value: T) -> None:
        """Write a file, whole or not at all; errors are those of ``compose``, and NOT_WRITTEN."""
        replace_file(Path(path), (self.head + self.text(value)).encode())

    def text(self, value: T) -> str:
        """Return a value as text, without ``head``; raise UNKNOWN_FORMAT if it can only be read."""
        if self.compose is None:
            raise Code.UNKNOWN_FORMAT.refusal(
                f"{self.title}: expected a format that can be written, got one that is only read",
                got=self.title,
            )
        return self.compose(value)


def _motions(value: Any) -> list[Transform]:
    """Return all motions in a file's value: a motion, nested lists of motions, or a chain."""
    if isinstance(value, Transform):
        return [value]
    if isinstance(value, (list, tuple)):
        return [motion for item in value for motion in _motions(item)]
    return _motions(getattr(value, "transforms", ()))


def _scaled(value: Any, factor: float) -> Any:
    """Return a file's value with all translations multiplied by a factor."""
    if isinstance(value, Transform):
        return dataclasses.replace(value, translation=factor * value.translation)
    if isinstance(value, tuple) and hasattr(value, "_replace"):
        return type(value)(*(_scaled(item, factor) for item in value))
    if isinstance(value, (list, tuple)):
        return type(value)(_scaled(item, factor) for item in value)
    return dataclasses.replace(value, transforms=_scaled(value.transforms, factor))


def named(parse: Callable[[str], T | Measured[T]]) -> Callable[..., T | Measured[T]]:
    """Return a parser for a format that names its frames itself, or has none."""
    return lambda text, *_names: parse(text)
