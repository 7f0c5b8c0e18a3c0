"""Types of values in settings files: sizes, times, and patterns of cameras' names."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any, cast

from pydantic import PlainValidator, WithJsonSchema

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    Fits = Callable[[str, str], bool]

BYTES: Mapping[str, int] = {
    "B": 1,
    "kB": 10**3,
    "MB": 10**6,
    "GB": 10**9,
    "TB": 10**12,
    "KiB": 1 << 10,
    "MiB": 1 << 20,
    "GiB": 1 << 30,
    "TiB": 1 << 40,
}
SECONDS: Mapping[str, int] = {"s": 1, "min": 60, "h": 3600, "d": 86400}

MIN_FILE_BYTES = 10**5
MAX_FOLDER_BYTES = 1 << 50
MIN_AGE_SECONDS = 1.0
MAX_AGE_SECONDS = 366 * 86400.0
MAX_PATTERNS = 1000

_NUMBER = r"(\d{1,12}(?:\.\d{1,6})?)"
_PATTERN = re.compile(r"[a-z0-9_*-]+(?:/[a-z0-9_*-]+)*", re.ASCII)


def _amount(units: Mapping[str, int], minimum: float, maximum: float, example: str) -> Any:
    """Return a validator of numbers; their unit may be missing, and in upper or lower case."""
    factors = {unit.lower(): factor for unit, factor in units.items()}
    text = re.compile(rf"{_NUMBER} ?([a-z]+)", re.ASCII)

    def read(given: object) -> float:
        value: float | None = None
        if isinstance(given, str):
            parts = text.fullmatch(given.strip().lower())
            if parts is not None and parts[2] in factors:
                value = float(parts[1]) * factors[parts[2]]
        elif isinstance(given, (int, float)) and not isinstance(given, bool):
            value = float(given)
        if value is None:
            raise ValueError(
                f"expected a number with a unit, such as {example!r}; units are "
                f"{', '.join(units)}; got {given!r:.60}"
            )
        if not minimum <= value <= maximum:
            raise ValueError(
                f"expected {minimum:g} to {maximum:g} {next(iter(units))}, got {value:g}"
            )
        return value

    return PlainValidator(read)


def _schema(units: Mapping[str, int]) -> WithJsonSchema:
    pattern = f"^{_NUMBER} ?({'|'.join(units)})$"
    return WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "string", "pattern": pattern}]})


Size = Annotated[float, _amount(BYTES, MIN_FILE_BYTES, MAX_FOLDER_BYTES, "100 MB"), _schema(BYTES)]
Age = Annotated[float, _amount(SECONDS, MIN_AGE_SECONDS, MAX_AGE_SECONDS, "1 h"), _schema(SECONDS)]


def _patterns(given: object) -> tuple[str, ...]:
    patterns: list[str] = []
    for pattern in cast("list[object]", given) if isinstance(given, (list, tuple)) else [given]:
        if not isinstance(pattern, str) or _PATTERN.fullmatch(pattern) is None:
            raise ValueError(
                f"expected a camera's name, or a pattern such as line1/**; got {pattern!r:.80}"
            )
        patterns.append(pattern)
    if not 1 <= len(patterns) <= MAX_PATTERNS:
        raise ValueError(f"{len(patterns)} patterns, expected 1 to {MAX_PATTERNS}")
    return tuple(patterns)


_PATTERN_SCHEMA = {"type": "string", "pattern": f"^{_PATTERN.pattern}$"}
Patterns = Annotated[
    tuple[str, ...],
    PlainValidator(_patterns),
    WithJsonSchema(
        {"anyOf": [_PATTERN_SCHEMA, {"type": "array", "items": _PATTERN_SCHEMA, "minItems": 1}]}
    ),
]


def matches_any(patterns: Sequence[str], camera: str) -> bool:
    """Return True if one of the patterns matches the camera's name."""
    return any(
        _matches(pattern.split("/"), camera.split("/"), "**", _part_fits) for pattern in patterns
    )


def _matches(pattern: Sequence[str], items: Sequence[str], many: str, fits: Fits) -> bool:
    """Return True if items match a pattern whose part ``many`` matches any number of items."""
    # indices of the parts of the pattern that may match the next item
    indices = _skip_many({0}, pattern, many)
    for item in items:
        repeated = {i for i in indices if i < len(pattern) and pattern[i] == many}
        advanced = {
            i + 1 for i in indices - repeated if i < len(pattern) and fits(pattern[i], item)
        }
        indices = _skip_many(repeated | advanced, pattern, many)
    return len(pattern) in indices


def _skip_many(indices: set[int], pattern: Sequence[str], many: str) -> set[int]:
    """Add the indices after each part that equals ``many``, since it may match no item."""
    for index, part in enumerate(pattern):
        if index in indices and part == many:
            indices = indices | {index + 1}
    return indices


def _part_fits(pattern: str, part: str) -> bool:
    return _matches(pattern, part, "*", str.__eq__)
