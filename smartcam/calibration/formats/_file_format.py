"""Read files of other programs, refusing large ones, and write files whole or not at all."""

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
"""Largest number of bytes of a file with one pose; usual files have some hundred bytes."""

MAX_YAML_BYTES = 1 << 18
"""Largest number of bytes of a YAML file with samples: some 400 samples. PyYAML may take seconds
for such a file."""

MAX_FILE_BYTES = 1 << 24
"""Largest number of bytes of a JSON or CSV file; a ground truth of EuRoC has 6 MB."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class UnscaledValue(Generic[T]):
    """A value with lengths in the file's unit: the format of the file allows several units."""

    value: T
    unit: str | None = None  # unit that the file names, or None


@dataclass(frozen=True, slots=True)
class Format(Generic[T]):
    """One format of files."""

    title: str  # description for people
    suffix: str  # suffix of the files' names
    # function that parses a text to a value. Further arguments: for cameras the image size, else
    # the names of target and source if the format does not name them. It returns an UnscaledValue
    # if lengths may be in any unit, else metres; errors are those of
    # :func:`~smartcam.calibration.formats.read_transform`
    parse: Callable[..., T | UnscaledValue[T]]
    # function that returns a value as text without ``head``; None: the format is only read.
    # Errors are those of :func:`~smartcam.calibration.formats.write_transform`, and ``WRONG_FRAME``
    compose: Callable[[T], str] | None = None
    head: str = ""  # text at the beginning of each file
    max_bytes: int = MAX_TEXT_BYTES  # largest size of a file

    def read(
        self,
        path: str | os.PathLike[str],
        *parse_arguments: Any,
        unit: str | None = None,
    ) -> T:
        """Read a file; errors are those of ``parse``, and UNIT_UNKNOWN.

        ``unit``: unit of the file's lengths; None for the unit that the file or its format names.
        """
        with Path(path).open("rb") as stream:
            body = stream.read(self.max_bytes + 1)
        try:
            if len(body) > self.max_bytes:
                raise malformed_error("file", f"{self.max_bytes} bytes at most")
            try:
                text = body.decode("utf-8-sig")
            except UnicodeDecodeError as exc:
                raise malformed_error("file", f"UTF-8 ({exc.reason} at byte {exc.start})") from exc
            return self._to_metres(self.parse(text, *parse_arguments), unit)
        except CalibrationError as exc:
            raise CalibrationError(
                f"{path}: {self.title}: {exc}", code=exc.code, expected=exc.expected, got=exc.got
            ) from exc

    def _to_metres(self, parsed: T | UnscaledValue[T], unit: str | None) -> T:
        has_any_unit = isinstance(parsed, UnscaledValue)
        stated_unit = cast("UnscaledValue[T]", parsed).unit if has_any_unit else "m"
        value = cast("UnscaledValue[T]", parsed).value if has_any_unit else cast("T", parsed)
        motions = _find_transforms(value)
        if not motions:
            return value
        if unit is None and stated_unit is None:
            raise no_unit_error("lengths")
        factor = metres_of(unit or stated_unit or "m", "lengths")
        if unit is None and not has_any_unit:
            for motion in motions:
                distance = factor * float(np.linalg.norm(motion.translation))
                check_length(distance, f"distance of {motion.source} from {motion.target}")
        return value if factor == 1.0 else cast("T", _scale_translations(value, factor))

    def write(self, path: str | os.PathLike[str], value: T) -> None:
        """Write a file, whole or not at all; errors are those of ``compose``, and NOT_WRITTEN."""
        replace_file(Path(path), (self.head + self.to_text(value)).encode())

    def to_text(self, value: T) -> str:
        """Return a value as text, without ``head``; raise UNKNOWN_FORMAT if it can only be read."""
        if self.compose is None:
            raise Code.UNKNOWN_FORMAT.error(
                f"{self.title}: expected a format that can be written, got one that is only read",
                got=self.title,
            )
        return self.compose(value)


def _find_transforms(value: Any) -> list[Transform]:
    """Return all transforms in a file's value: a transform, nested lists of them, or a chain."""
    if isinstance(value, Transform):
        return [value]
    if isinstance(value, (list, tuple)):
        return [transform for item in value for transform in _find_transforms(item)]
    return _find_transforms(getattr(value, "transforms", ()))


def _scale_translations(value: Any, factor: float) -> Any:
    """Return a file's value with all translations multiplied by a factor."""
    if isinstance(value, Transform):
        return dataclasses.replace(value, translation=factor * value.translation)
    if isinstance(value, tuple) and hasattr(value, "_replace"):
        return type(value)(*(_scale_translations(item, factor) for item in value))
    if isinstance(value, (list, tuple)):
        return type(value)(_scale_translations(item, factor) for item in value)
    return dataclasses.replace(value, transforms=_scale_translations(value.transforms, factor))


def ignore_names(
    parse: Callable[[str], T | UnscaledValue[T]],
) -> Callable[..., T | UnscaledValue[T]]:
    """Return a parser that ignores the caller's names of frames: the format defines them itself."""
    return lambda text, *_names: parse(text)
