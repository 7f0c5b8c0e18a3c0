"""What a fleet file says of recording beside the agent."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

from pydantic import Field, PlainValidator, WithJsonSchema

from smartcam.fleet._ros_file import Fields

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

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

LEAST_SIZE = 10**5
MOST_BYTES = 1 << 50
LEAST_AGE = 1.0
MOST_AGE = 366 * 86400.0
MOST_PATTERNS = 1000

_NUMBER = r"(\d{1,12}(?:\.\d{1,6})?)"
_PATTERN = re.compile(r"(?:\*\*|\*|[a-z0-9_*-]+)(?:/(?:\*\*|\*|[a-z0-9_*-]+))*", re.ASCII)


def _amount(units: Mapping[str, int], least: float, most: float, example: str) -> Any:
    """Return what reads a number with its unit, in any case of its letters, or the number alone."""
    known = {unit.lower(): factor for unit, factor in units.items()}
    text = re.compile(rf"{_NUMBER} ?([a-z]+)", re.ASCII)

    def read(given: object) -> float:
        found: float | None = None
        if isinstance(given, str):
            parts = text.fullmatch(given.strip().lower())
            if parts is not None and parts[2] in known:
                found = float(parts[1]) * known[parts[2]]
        elif isinstance(given, (int, float)) and not isinstance(given, bool):
            found = float(given)
        if found is None:
            raise ValueError(
                f"expected a number with a unit, such as {example!r}; units are "
                f"{', '.join(units)}; got {given!r:.60}"
            )
        if not least <= found <= most:
            raise ValueError(f"expected {least:g} to {most:g} {next(iter(units))}, got {found:g}")
        return found

    return PlainValidator(read)


def _schema(units: Mapping[str, int]) -> WithJsonSchema:
    pattern = f"^{_NUMBER} ?({'|'.join(units)})$"
    return WithJsonSchema({"anyOf": [{"type": "number"}, {"type": "string", "pattern": pattern}]})


Size = Annotated[float, _amount(BYTES, LEAST_SIZE, MOST_BYTES, "100 MB"), _schema(BYTES)]
Age = Annotated[float, _amount(SECONDS, LEAST_AGE, MOST_AGE, "1 h"), _schema(SECONDS)]


def _patterns(given: object) -> tuple[str, ...]:
    found: list[str] = []
    for one in cast("list[object]", given) if isinstance(given, (list, tuple)) else [given]:
        if not isinstance(one, str) or _PATTERN.fullmatch(one) is None:
            raise ValueError(
                f"expected a camera's name, or a pattern such as line1/**; got {one!r:.80}"
            )
        found.append(one)
    if not 1 <= len(found) <= MOST_PATTERNS:
        raise ValueError(f"{len(found)} patterns, expected 1 to {MOST_PATTERNS}")
    return tuple(found)


_ONE = {"type": "string", "pattern": f"^{_PATTERN.pattern}$"}
Patterns = Annotated[
    tuple[str, ...],
    PlainValidator(_patterns),
    WithJsonSchema({"anyOf": [_ONE, {"type": "array", "items": _ONE, "minItems": 1}]}),
]


class RecordSection(Fields):
    """Recording beside the agent: of each camera files that follow each other, in one folder."""

    folder: str = Field(
        "recordings", min_length=1, description="where the files are, beside this file; made if new"
    )
    size: Size = Field(1e8, description="a camera's next file begins behind so much: 100 MB")
    age: Age = Field(3600.0, description="or behind so long: 1 h, 30 min, 1 d")
    keep: Size = Field(
        1e10, description="of all files together; beyond it the oldest are deleted: 10 GB"
    )
    cameras: Patterns = Field(
        ("**",), description="which ones: names, * for one part of them, ** for any number"
    )
    frames: bool = Field(
        True,
        description="record what went over the wire, too; without it a replay has results and "
        "statuses only",
    )

    def chooses(self, camera: str) -> bool:
        """Return whether a camera of this name is recorded."""
        return any(
            _matches(one.split("/"), camera.split("/"), "**", _part_fits) for one in self.cameras
        )

    def path(self, folder: Path) -> Path:
        """Return the folder of the files.

        Args:
            folder: that the fleet file is in.
        """
        return folder / Path(self.folder).expanduser()


def mistakes_of(section: RecordSection, folder: Path) -> Iterator[tuple[tuple[str, ...], str]]:
    """Give what cannot work of it, and where."""
    if section.keep < 2 * section.size:
        yield (
            ("record", "keep"),
            f"expected twice the size of a file, {2 * section.size:g} bytes, or more; "
            f"got {section.keep:g}",
        )
    path = section.path(folder)
    if path.exists() and not path.is_dir():
        yield ("record", "folder"), f"{path} is there, and is no folder"


def _matches(pattern: Sequence[str], items: Sequence[str], many: str, fits: Fits) -> bool:
    """Return whether items fit a pattern; ``many`` in it stands for any number of them."""
    places = _passed({0}, pattern, many)
    for item in items:
        stayed = {place for place in places if place < len(pattern) and pattern[place] == many}
        gone = {
            place + 1
            for place in places - stayed
            if place < len(pattern) and fits(pattern[place], item)
        }
        places = _passed(stayed | gone, pattern, many)
    return len(pattern) in places


def _passed(places: set[int], pattern: Sequence[str], many: str) -> set[int]:
    """Return places in a pattern with those behind what may stand for nothing."""
    for place, one in enumerate(pattern):
        if place in places and one == many:
            places = places | {place + 1}
    return places


def _part_fits(pattern: str, part: str) -> bool:
    return _matches(pattern, part, "*", str.__eq__)
