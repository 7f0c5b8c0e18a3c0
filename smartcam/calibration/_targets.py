"""Printed targets: what is on a sheet, and where each of its points lies.

A target's frame lies on the sheet as one reads it: origin at a corner of its points, x to the right
along the ray A, y up along the ray B, z out of the sheet towards the reader. Points are numbered
from the origin along x, then row by row along y.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, TypeVar

import numpy as np

from smartcam.calibration._codes import Code
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.calibration._geometry.rotations import Array

MAX_POINTS = 10_000
"""Of one target."""

AREA_DISTANCE = 0.3
"""Sides of a square from an outer corner of a checkerboard, along x and along y, to the middle of
the round area outside of it."""

AREA_DIAMETER = 0.3
"""Of this area, sides of a square."""


@dataclass(frozen=True, kw_only=True)
class Checkerboard:
    """A checkerboard; its points are the corners where four squares meet.

    The outermost square at the origin is black, and the squares reach from (-1, -1) to
    (columns, rows) sides of one.

    Attributes:
        columns: corners along x, at least 3.
        rows: corners along y, at least 3.
        square: side of a square, metres.
        origin_mark: the area outside of the outer corner next to the origin is a black dot, and
            those outside of the three other ones are white (thesis 3.2.3.2).
    """

    kind: ClassVar[str] = "checkerboard"

    columns: int
    rows: int
    square: float
    origin_mark: bool = False

    def __post_init__(self) -> None:
        _check_counts(self.kind, self.columns, self.rows)
        _check_lengths(self.kind, square=self.square)
        _check_flags(self.kind, origin_mark=self.origin_mark)

    @property
    def points(self) -> Array:
        """(N, 3), metres, in the target's frame."""
        return _grid(self.columns, self.rows, self.square)

    @property
    def corner_areas(self) -> Array:
        """(4, 2), metres: middles of the round areas outside of the outer corners.

        The first is the origin's, the others follow counter-clockwise as one reads the sheet: at
        the end of the ray A, opposite, at the end of the ray B.
        """
        low = -self.square * (1 + AREA_DISTANCE)
        right = self.square * (self.columns + AREA_DISTANCE)
        top = self.square * (self.rows + AREA_DISTANCE)
        return np.array([[low, low], [right, low], [right, top], [low, top]])

    @property
    def corner_area_diameter(self) -> float:
        """Of each of the ``corner_areas``, and of the origin's dot, metres."""
        return AREA_DIAMETER * self.square

    @property
    def turned_alike(self) -> bool:
        """Whether the sheet looks the same when it is turned by half."""
        return not self.origin_mark and (self.columns + self.rows) % 2 == 0


@dataclass(frozen=True, kw_only=True)
class Charuco:
    """A checkerboard with a marker in each white square; corners have ids, some may be hidden.

    Attributes:
        columns: squares along x, at least 3.
        rows: squares along y, at least 3.
        square: side of a square, metres.
        marker: side of a marker, metres, less than ``square``.
        dictionary: name of one of OpenCV's, such as ``DICT_5X5_250``.
        legacy_pattern: as OpenCV before 4.6 prints an even number of rows: a white square at the
            upper left, where a black one is.
    """

    kind: ClassVar[str] = "charuco"

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str = "DICT_5X5_250"
    legacy_pattern: bool = False

    turned_alike: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check_counts(self.kind, self.columns, self.rows)
        _check_lengths(self.kind, square=self.square, marker=self.marker)
        _check_flags(self.kind, legacy_pattern=self.legacy_pattern)
        if not isinstance(self.dictionary, str):
            raise CalibrationError(
                f"charuco: expected the name of a dictionary, got {self.dictionary!r}",
                code=Code.SHAPE,
                expected="DICT_5X5_250",
                got=self.dictionary,
            )
        if self.marker >= self.square:
            raise CalibrationError(
                f"charuco: expected a marker smaller than its square ({self.square:g} m), "
                f"got {self.marker:g} m",
                code=Code.SHAPE,
                expected=self.square,
                got=self.marker,
            )

    @property
    def points(self) -> Array:
        """(N, 3), metres, in the target's frame: its origin is the lower left inner corner."""
        return _grid(self.columns - 1, self.rows - 1, self.square)


@dataclass(frozen=True, kw_only=True)
class CircleGrid:
    """Dots in rows and columns; its points are their centres.

    Attributes:
        columns: dots of a row, at least 3.
        rows: at least 3.
        spacing: between the centres of two neighbours of a row, metres.
        diameter: of a dot, metres, less than ``spacing``.
        asymmetric: every other row is shifted by half of ``spacing``, and rows are half of it
            apart.
        origin_diameter: of the dot at the origin where it is larger, metres; None for a grid that
            looks the same when it is turned.
    """

    kind: ClassVar[str] = "circles"

    columns: int
    rows: int
    spacing: float
    diameter: float
    asymmetric: bool = False
    origin_diameter: float | None = None

    def __post_init__(self) -> None:
        _check_counts(self.kind, self.columns, self.rows)
        _check_lengths(self.kind, spacing=self.spacing, diameter=self.diameter)
        _check_flags(self.kind, asymmetric=self.asymmetric)
        if self.origin_diameter is not None:
            _check_lengths(self.kind, origin_diameter=self.origin_diameter)
        between = (self.diameter + (self.origin_diameter or self.diameter)) / 2
        apart = self.spacing * (math.sqrt(0.5) if self.asymmetric else 1.0)
        if between >= apart:
            raise CalibrationError(
                f"circles: expected dots that do not touch each other at a distance of {apart:g} "
                f"m, got a mean diameter of two neighbours of {between:g} m",
                code=Code.SHAPE,
                expected=apart,
                got=between,
            )
        if self.origin_diameter is not None and self.origin_diameter <= self.diameter:
            raise CalibrationError(
                f"circles: expected origin_diameter larger than the other dots' "
                f"({self.diameter:g} m), got {self.origin_diameter:g} m",
                code=Code.SHAPE,
                expected=self.diameter,
                got=self.origin_diameter,
            )

    @property
    def points(self) -> Array:
        """(N, 3), metres, in the target's frame."""
        if not self.asymmetric:
            return _grid(self.columns, self.rows, self.spacing)
        points = _grid(self.columns, self.rows, self.spacing)
        points[:, 1] /= 2
        odd = np.repeat(np.arange(self.rows) % 2 == 1, self.columns)
        points[odd, 0] += self.spacing / 2
        return points

    @property
    def turned_alike(self) -> bool:
        """Whether the sheet looks the same when it is turned by half."""
        return self.origin_diameter is None and not (self.asymmetric and self.rows % 2 == 1)


Target: TypeAlias = Checkerboard | Charuco | CircleGrid
"""What :func:`~smartcam.calibration.find_target` looks for."""

T = TypeVar("T", bound=Target)

_KINDS: Mapping[str, type[Target]] = {
    kind.kind: kind for kind in (Checkerboard, Charuco, CircleGrid)
}


def target_to_data(target: Target) -> dict[str, Any]:
    """Return a target as JSON takes it; :func:`target_from_data` gives it back."""
    return {"kind": target.kind, **dataclasses.asdict(target)}


def target_from_data(data: Mapping[str, Any]) -> Target:
    """Return the target that :func:`target_to_data` describes.

    Raises:
        CalibrationError: SHAPE: not a description of a target.
    """
    given = dict(data) if hasattr(data, "items") else {}
    named = given.pop("kind", None)
    kind = _KINDS.get(named) if isinstance(named, str) else None
    if kind is None:
        raise CalibrationError(
            f"target: expected a kind of {sorted(_KINDS)}, got {named!r}",
            code=Code.SHAPE,
            expected=sorted(_KINDS),
            got=named,
        )
    try:
        return kind(**given)
    except TypeError as exc:
        raise CalibrationError(f"target: {exc}", code=Code.SHAPE, got=sorted(given)) from exc


def resized(target: T, factor: float) -> T:
    """Return a target with all of its lengths multiplied by a factor.

    Raises:
        CalibrationError: SHAPE: a factor that is not positive.
    """
    lengths = {
        one.name: factor * value
        for one in dataclasses.fields(target)
        if one.name not in {"columns", "rows"}
        and not isinstance(value := getattr(target, one.name), bool | str | None)
    }
    return dataclasses.replace(target, **lengths)


def _grid(columns: int, rows: int, spacing: float) -> Array:
    points = np.zeros((columns * rows, 3))
    points[:, 0] = np.tile(np.arange(columns) * spacing, rows)
    points[:, 1] = np.repeat(np.arange(rows) * spacing, columns)
    return points


def _check_counts(kind: str, columns: Any, rows: Any) -> None:
    for name, count in (("columns", columns), ("rows", rows)):
        if not isinstance(count, int) or isinstance(count, bool) or count < 3:
            raise CalibrationError(
                f"{kind}: expected {name} to be a whole number of at least 3, got {count!r}",
                code=Code.SHAPE,
                expected=3,
                got=count,
            )
    if columns * rows > MAX_POINTS:
        raise CalibrationError(
            f"{kind}: expected at most {MAX_POINTS} points, got {columns} x {rows}",
            code=Code.SHAPE,
            expected=MAX_POINTS,
            got=columns * rows,
        )


def _check_flags(kind: str, **flags: Any) -> None:
    for name, flag in flags.items():
        if not isinstance(flag, bool):
            raise CalibrationError(
                f"{kind}: expected {name} to be True or False, got {flag!r}",
                code=Code.SHAPE,
                expected="True or False",
                got=flag,
            )


def _check_lengths(kind: str, **lengths: Any) -> None:
    for name, length in lengths.items():
        number = isinstance(length, int | float) and not isinstance(length, bool)
        if not (number and math.isfinite(length) and length > 0):
            raise CalibrationError(
                f"{kind}: expected {name} to be a length in metres, got {length!r}",
                code=Code.SHAPE,
                expected="metres",
                got=length,
            )
