"""Patterns of places in rows, columns and layers, such as the places of parts on a pallet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, overload

import numpy as np

from smartcam._arguments import (
    as_plain_value,
    check_integer,
    check_number,
    check_text,
    wrong_argument,
)
from smartcam.geometry._codes import Code
from smartcam.geometry._rotations import as_vector
from smartcam.geometry._transforms import Transform, as_motion

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from smartcam.geometry._rotations import Array

MAX_PLACES_PER_DIRECTION: Final = 1000
"""Largest number of rows, columns or layers of a pattern."""

MIN_SINE: Final = 0.5
"""Least sine of the angle between the touched row and column: 30 degrees."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacePattern(Sequence[Transform]):
    """Places in rows, columns and layers: a sequence of their poses, the lowest layer first.

    ::

        pattern = PlacePattern.from_touches(first, row_end, column_end, rows=2, columns=3, layers=2)
        for place in pattern:                          # T_robot_place
            place.translation, place.quaternion

    A place's x axis goes along the row, its y axis to the next row, its z axis to the next layer.

    Attributes:
        frame: pose of the first place.
        rows: number of rows.
        columns: number of places in a row.
        layers: number of layers.
        pitch: distances to the next column, row and layer, metres.

    Raises:
        ConfigurationError: a number of places or a distance that is not possible.
        CalibrationError: ``SHAPE``: the frame is no transform.
    """

    frame: Transform
    rows: int = 1
    columns: int = 1
    layers: int = 1
    pitch: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the counts, and the pitch along each direction with more than one place."""
        caller = "PlacePattern"
        as_motion(self.frame, f"{caller}: frame", "robot", "place")
        for name in ("rows", "columns", "layers"):
            count = check_integer(getattr(self, name), name, 1, MAX_PLACES_PER_DIRECTION, caller)
            object.__setattr__(self, name, count)
        if not isinstance(self.pitch, tuple | list) or len(self.pitch) != 3:
            raise wrong_argument(
                "pitch", "distances of columns, rows and layers", self.pitch, caller
            )
        counts = (self.columns, self.rows, self.layers)
        pitch = [
            check_number(as_plain_value(step), "pitch", 0, 1e3, caller, exclusive=count > 1)
            for step, count in zip(self.pitch, counts, strict=True)
        ]
        object.__setattr__(self, "pitch", tuple(pitch))

    @classmethod
    def from_touches(
        cls,
        first: ArrayLike,
        row_end: ArrayLike,
        column_end: ArrayLike,
        *,
        rows: int,
        columns: int,
        layers: int = 1,
        height: float = 0.0,
        robot_frame: str = "robot",
    ) -> PlacePattern:
        """Return the pattern whose lowest layer has three corners that a robot touched.

        The layers' direction is the cross product of the row's and the column's direction.

        Args:
            first: (3,), the first place, metres.
            row_end: (3,), the last place of the first row.
            column_end: (3,), the first place of the last row.
            rows: number of rows, 2 or more.
            columns: number of places in a row, 2 or more.
            layers: number of layers.
            height: distance to the next layer, metres.
            robot_frame: name of the frame that the touches are given in.

        Raises:
            ConfigurationError: a number of places or a distance that is not possible.
            CalibrationError: ``SHAPE``, ``NOT_FINITE``; ``NOT_RIGID``: row and column are at less
                than 30 degrees to each other.
        """
        caller = "PlacePattern.from_touches"
        rows = check_integer(rows, "rows", 2, MAX_PLACES_PER_DIRECTION, caller)
        columns = check_integer(columns, "columns", 2, MAX_PLACES_PER_DIRECTION, caller)
        frame_name = check_text(robot_frame, "robot_frame", caller)
        corner = as_vector(first, 3, "first")
        row_vector = as_vector(row_end, 3, "row_end") - corner
        column_vector = as_vector(column_end, 3, "column_end") - corner
        normal = np.cross(row_vector, column_vector)
        lengths = float(np.linalg.norm(row_vector)), float(np.linalg.norm(column_vector))
        sine = float(np.linalg.norm(normal)) / max(lengths[0] * lengths[1], 1e-300)
        if not sine >= MIN_SINE:
            raise Code.NOT_RIGID.error(
                f"{caller}: expected a row and a column at 30 degrees or more to each other, got "
                f"{math.degrees(math.asin(min(sine, 1.0))):.3g} degrees",
                MIN_SINE,
                sine,
            )
        x, z = row_vector / lengths[0], normal / np.linalg.norm(normal)
        rotation = np.column_stack([x, np.cross(z, x), z])
        return cls(
            frame=Transform(frame_name, "place", rotation, corner),
            rows=rows,
            columns=columns,
            layers=layers,
            pitch=(lengths[0] / (columns - 1), lengths[1] / (rows - 1), height),
        )

    def __len__(self) -> int:
        """Return the number of places."""
        return self.rows * self.columns * self.layers

    @overload
    def __getitem__(self, index: int) -> Transform: ...
    @overload
    def __getitem__(self, index: slice) -> list[Transform]: ...
    def __getitem__(self, index: int | slice) -> Transform | list[Transform]:
        """Return the pose of the place with an index, or the poses of a slice of places."""
        if isinstance(index, slice):
            return [self._pose_of(number) for number in range(len(self))[index]]
        return self._pose_of(range(len(self))[index])

    def row_column_layer(self, number: int) -> tuple[int, int, int]:
        """Return row, column and layer of a place, each from 0.

        Args:
            number: number of the place, from 0.

        Raises:
            ConfigurationError: there is no such place.
        """
        number = check_integer(number, "number", 0, len(self) - 1, "PlacePattern.row_column_layer")
        layer, rest = divmod(number, self.rows * self.columns)
        row, column = divmod(rest, self.columns)
        return row, column, layer

    def _pose_of(self, number: int) -> Transform:
        row, column, layer = self.row_column_layer(number)
        steps: Array = np.array([column, row, layer]) * self.pitch
        return Transform(
            self.frame.target,
            self.frame.source,
            self.frame.rotation,
            self.frame.apply(steps),
            self.frame.at,
        )
