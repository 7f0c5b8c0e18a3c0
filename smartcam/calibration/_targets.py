"""Describe printed targets: the pattern on a sheet, and the place of each of its points.

The frame of a target, for a sheet held the right way up: origin at the lower left point, x to the
right (along the printed ray A), y up (ray B), z out of the sheet towards the reader. Points are
numbered from the origin along x, then row by row along y.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias, TypeVar

import numpy as np

from smartcam._argument_checks import a_target, check_arguments
from smartcam._arguments import excerpt
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Mapping

    from _typeshed import DataclassInstance
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

MAX_POINTS = 10_000
"""A target has at most this many points."""

MAX_LENGTH_M = 1.0
"""Largest side of a square or marker, and largest distance of dots, metres. Printed squares,
markers and distances are below a few hundred millimetres, so a larger number is probably in
millimetres."""

AREA_DISTANCE_SQUARES = 0.3
"""Distance along x and along y from an outer corner of a checkerboard to the centre of the round
area outside of it, in sides of a square."""

AREA_DIAMETER_SQUARES = 0.3
"""Diameter of the round area outside of an outer corner of a checkerboard, in sides of a square."""


@dataclass(frozen=True, kw_only=True)
class Checkerboard:
    """A checkerboard; its points are the corners where four squares meet.

    The outermost square at the origin is black, and the squares reach from (-1, -1) to (columns,
    rows), in sides of a square.

    Attributes:
        columns: corners along x, at least 3.
        rows: corners along y, at least 3.
        square: side of a square, metres.
        origin_mark: whether the area outside of the outer corner next to the origin is a black dot,
            and the areas outside of the three other corners are white (thesis 3.2.3.2).
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
        """Centres of the round areas outside of the outer corners, (4, 2), metres.

        The first is at the origin, the others follow counter-clockwise on the sheet: at the end of
        the ray A, opposite, at the end of the ray B.
        """
        low = -self.square * (1 + AREA_DISTANCE_SQUARES)
        right = self.square * (self.columns + AREA_DISTANCE_SQUARES)
        top = self.square * (self.rows + AREA_DISTANCE_SQUARES)
        return np.array([[low, low], [right, low], [right, top], [low, top]])

    @property
    def corner_area_diameter(self) -> float:
        """Diameter of each of the ``corner_areas``, and of the origin's dot, metres."""
        return AREA_DIAMETER_SQUARES * self.square

    @property
    def half_turn_symmetric(self) -> bool:
        """True if the sheet looks the same after half a turn."""
        return not self.origin_mark and (self.columns + self.rows) % 2 == 0


@dataclass(frozen=True, kw_only=True)
class Charuco:
    """A checkerboard with a marker in each white square; corners have ids, so some may be hidden.

    Attributes:
        columns: squares along x, at least 3.
        rows: squares along y, at least 3.
        square: side of a square, metres.
        marker: side of a marker, metres, less than ``square``.
        dictionary: name of one of OpenCV's dictionaries, such as ``DICT_5X5_250``.
        legacy_pattern: True for the pattern that OpenCV before 4.6 prints with an even number of
            rows: the square at the upper left is white instead of black.
    """

    kind: ClassVar[str] = "charuco"

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str = "DICT_5X5_250"
    legacy_pattern: bool = False

    half_turn_symmetric: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check_counts(self.kind, self.columns, self.rows)
        _check_lengths(self.kind, square=self.square, marker=self.marker)
        _check_flags(self.kind, legacy_pattern=self.legacy_pattern)
        if not isinstance(self.dictionary, str):
            raise Code.SHAPE.error(
                f"charuco: expected the name of a dictionary, got {excerpt(self.dictionary)}",
                "DICT_5X5_250",
                self.dictionary,
            )
        if self.marker >= self.square:
            raise Code.SHAPE.error(
                f"charuco: expected a marker smaller than its square ({self.square:g} m), "
                f"got {self.marker:g} m",
                self.square,
                self.marker,
            )

    @property
    def points(self) -> Array:
        """(N, 3), metres, in the target's frame: its origin is the lower left inner corner."""
        return _grid(self.columns - 1, self.rows - 1, self.square)


@dataclass(frozen=True, kw_only=True)
class CircleGrid:
    """Dots in rows and columns; its points are their centres.

    Attributes:
        columns: number of dots in a row, at least 3.
        rows: number of dots in a column, at least 3.
        spacing: distance between the centres of two neighbours in a row, metres.
        diameter: diameter of a dot, metres, less than ``spacing``.
        asymmetric: True if rows are half of ``spacing`` apart and every other one is shifted by as
            much.
        origin_diameter: diameter of the larger dot at the origin, metres; None for a grid without
            one, which looks the same when it is turned.
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
        mean_diameter = (self.diameter + (self.origin_diameter or self.diameter)) / 2
        min_distance = self.spacing * (math.sqrt(0.5) if self.asymmetric else 1.0)
        if mean_diameter >= min_distance:
            raise Code.SHAPE.error(
                f"circles: expected dots that do not touch each other at a distance of "
                f"{min_distance:g} m, got a mean diameter of two neighbours of {mean_diameter:g} m",
                min_distance,
                mean_diameter,
            )
        if self.origin_diameter is not None and self.origin_diameter <= self.diameter:
            raise Code.SHAPE.error(
                f"circles: expected origin_diameter larger than the other dots' "
                f"({self.diameter:g} m), got {self.origin_diameter:g} m",
                self.diameter,
                self.origin_diameter,
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
    def half_turn_symmetric(self) -> bool:
        """True if the sheet looks the same after half a turn."""
        return self.origin_diameter is None and not (self.asymmetric and self.rows % 2 == 1)


@dataclass(frozen=True, kw_only=True)
class MarkerGrid:
    """Markers in rows and columns; the points are the markers' corners, and some may be hidden.

    It is OpenCV's ``GridBoard``, whose numbers count from the upper left marker row by row, or
    Kalibr's AprilGrid (:meth:`april_grid`), whose numbers count from the lower left one upwards.
    Points are numbered along x through the lower corners of the lowest row, then through their
    upper ones, and so on.

    Attributes:
        columns: markers along x, at least 1.
        rows: markers along y, at least 1; two markers or more in all.
        marker: side of a marker with its black border, metres.
        gap: distance between two neighbouring markers, metres.
        dictionary: name of one of OpenCV's dictionaries, such as ``DICT_4X4_50``.
        border: width of a marker's black border in modules, 1 or 2.
        first_id: number of the first marker.
        kalibr: whether the markers are numbered and turned as Kalibr prints them, with black
            squares between their corners.
    """

    kind: ClassVar[str] = "marker_grid"

    columns: int
    rows: int
    marker: float
    gap: float
    dictionary: str = "DICT_4X4_50"
    border: int = 1
    first_id: int = 0
    kalibr: bool = False

    half_turn_symmetric: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check_counts(self.kind, self.columns, self.rows, minimum=1)
        _check_counts(self.kind, 2 * self.columns, 2 * self.rows, minimum=1)
        _check_lengths(self.kind, marker=self.marker, gap=self.gap)
        _check_flags(self.kind, kalibr=self.kalibr)
        _check_whole(self.kind, 1, border=self.border)
        _check_whole(self.kind, 0, first_id=self.first_id)
        if not isinstance(self.dictionary, str) or self.columns * self.rows < 2:
            raise Code.SHAPE.error(
                f"{self.kind}: expected the name of a dictionary and two markers or more, got "
                f"{excerpt(self.dictionary)} and {self.columns} x {self.rows}",
                got=(self.dictionary, self.columns, self.rows),
            )

    @classmethod
    def april_grid(
        cls, *, columns: int, rows: int, tag: float, spacing: float, border: int = 2
    ) -> MarkerGrid:
        """Return Kalibr's AprilGrid of tags 36h11.

        Args:
            columns: tags along x, Kalibr's ``tagCols``.
            rows: tags along y, ``tagRows``.
            tag: side of a tag from edge to edge of its black border, metres, ``tagSize``.
            spacing: distance between two tags as a fraction of ``tag``, ``tagSpacing``.
            border: width of a tag's black border in modules; Kalibr prints 2.
        """
        return cls(
            columns=columns,
            rows=rows,
            marker=tag,
            gap=spacing * tag,
            dictionary="DICT_APRILTAG_36h11",
            border=border,
            kalibr=True,
        )

    @property
    def points(self) -> Array:
        """(N, 3), metres, in the target's frame: its origin is the lower left corner."""
        points = _grid(2 * self.columns, 2 * self.rows, 1.0)
        cells, sides = np.divmod(points, 2)
        return np.asarray(cells * (self.marker + self.gap) + sides * self.marker)

    @property
    def corners(self) -> NDArray[np.intp]:
        """Numbers of the points at each marker's corners, in OpenCV's order, (M, 4).

        Corners go clockwise from the upper left one of a marker as OpenCV prints it; it prints
        tags of AprilTag, and so those of Kalibr, upside down.
        """
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        row = row if self.kalibr else self.rows - 1 - row
        lower_left = 4 * self.columns * row + 2 * column
        up = 2 * self.columns
        clockwise = np.array([up, up + 1, 1, 0])
        corner_indices: NDArray[np.intp] = lower_left[:, None] + np.roll(clockwise, 2 * self.kalibr)
        return corner_indices


Target: TypeAlias = Checkerboard | Charuco | CircleGrid | MarkerGrid
"""Targets that :func:`~smartcam.calibration.find_target` looks for."""

T = TypeVar("T", bound="DataclassInstance")

_KINDS: Mapping[str, type[Target]] = {
    kind.kind: kind for kind in (Checkerboard, Charuco, CircleGrid, MarkerGrid)
}


@check_arguments(target=a_target)
def target_to_data(target: Target) -> dict[str, Any]:
    """Return a target as JSON data, which :func:`target_from_data` reads."""
    return {"kind": target.kind, **dataclasses.asdict(target)}


def target_from_data(data: Mapping[str, Any]) -> Target:
    """Return the target that :func:`target_to_data` describes.

    Raises:
        CalibrationError: SHAPE: the data do not describe a target.
    """
    fields = dict(data) if hasattr(data, "items") else {}
    kind_name = fields.pop("kind", None)
    target_class = _KINDS.get(kind_name) if isinstance(kind_name, str) else None
    if target_class is None:
        raise Code.SHAPE.error(
            f"target: expected a kind of {sorted(_KINDS)}, got {excerpt(kind_name)}",
            sorted(_KINDS),
            kind_name,
        )
    try:
        return target_class(**fields)
    except TypeError as exc:
        raise Code.SHAPE.error(f"target: {exc}", got=sorted(fields)) from exc


def resized(target: T, factor: float, digits: int | None = None) -> T:
    """Return a target with all of its lengths multiplied by a factor, and rounded to some digits.

    Raises:
        CalibrationError: SHAPE: the factor is not positive.
    """
    lengths = {
        field.name: factor * value if digits is None else round(factor * value, digits)
        for field in dataclasses.fields(target)
        if str(field.type).startswith("float")
        and (value := getattr(target, field.name)) is not None
    }
    return dataclasses.replace(target, **lengths)


def _grid(columns: int, rows: int, spacing: float) -> Array:
    points = np.zeros((columns * rows, 3))
    points[:, 0] = np.tile(np.arange(columns) * spacing, rows)
    points[:, 1] = np.repeat(np.arange(rows) * spacing, columns)
    return points


def _check_counts(kind: str, columns: Any, rows: Any, minimum: int = 3) -> None:
    _check_whole(kind, minimum, columns=columns, rows=rows)
    if columns * rows > MAX_POINTS:
        raise Code.SHAPE.error(
            f"{kind}: expected at most {MAX_POINTS} points, "
            f"got {excerpt(columns)} x {excerpt(rows)}",
            MAX_POINTS,
            columns * rows,
        )


def _check_whole(kind: str, minimum: int, **numbers: Any) -> None:
    for name, number in numbers.items():
        if not isinstance(number, int) or isinstance(number, bool) or number < minimum:
            raise Code.SHAPE.error(
                f"{kind}: expected {name} to be a whole number of at least {minimum}, "
                f"got {excerpt(number)}",
                minimum,
                number,
            )


def _check_flags(kind: str, **flags: Any) -> None:
    for name, flag in flags.items():
        if not isinstance(flag, bool):
            raise Code.SHAPE.error(
                f"{kind}: expected {name} to be True or False, got {excerpt(flag)}",
                "True or False",
                flag,
            )


def _check_lengths(kind: str, **lengths: Any) -> None:
    for name, length in lengths.items():
        is_number = isinstance(length, int | float) and not isinstance(length, bool)
        if is_number and MAX_LENGTH_M < length < math.inf:
            raise Code.UNIT_UNKNOWN.error(
                f"{kind}: expected {name} to be a length of {MAX_LENGTH_M:g} m at most, got "
                f"{excerpt(length)} m; is it in millimetres?",
                MAX_LENGTH_M,
                length,
            )
        if not (is_number and math.isfinite(length) and length > 0):
            raise Code.SHAPE.error(
                f"{kind}: expected {name} to be a length in metres, got {excerpt(length)}",
                "metres",
                length,
            )
