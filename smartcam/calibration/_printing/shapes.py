"""Draw the black shapes of a target, in millimetres from its origin, x right and y up."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.charucos import charuco_board
from smartcam.calibration._detection.marker_grids import marker_patterns
from smartcam.calibration._printing.page import Disc, Polygon, rectangle
from smartcam.calibration._targets import Charuco, Checkerboard, CircleGrid, MarkerGrid

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration._printing.page import Point
    from smartcam.calibration._targets import Target

MM_PER_METRE = 1e3
"""Millimetres per metre."""


class Box(NamedTuple):
    """Bounds of a target's pattern without its origin mark, mm from its origin."""

    left: float
    low: float
    right: float
    high: float


def pattern_shapes(target: Target) -> tuple[tuple[Polygon | Disc, ...], Box]:
    """Return the black shapes of a target, those of an origin mark last, and their bounds.

    Raises SHAPE if OpenCV has no such dictionary or it has too few markers; MissingExtraError: a
    marker's pattern needs OpenCV.
    """
    match target:
        case Checkerboard():
            return tuple(_checkerboard(target)), _board(target.columns, target.rows, target.square)
        case Charuco():
            box = _board(target.columns - 1, target.rows - 1, target.square)
            return tuple(_charuco(target, box)), box
        case CircleGrid():
            return _dots(target)
        case MarkerGrid():
            return tuple(_markers(target)), _marker_box(target)


def _board(columns: int, rows: int, square: float) -> Box:
    side = MM_PER_METRE * square
    return Box(-side, -side, columns * side, rows * side)


def _checkerboard(target: Checkerboard) -> Iterator[Polygon | Disc]:
    side = MM_PER_METRE * target.square
    for row in range(target.rows + 1):
        for column in range(row % 2, target.columns + 1, 2):
            yield rectangle((column - 1) * side, (row - 1) * side, side, side)
    if target.origin_mark:
        x, y = (MM_PER_METRE * target.corner_areas[0]).tolist()
        yield Disc((x, y), MM_PER_METRE * target.corner_area_diameter / 2)


def _charuco(target: Charuco, box: Box) -> Iterator[Polygon]:
    """Yield squares and markers, in OpenCV's order: from the upper left."""
    side, marker = MM_PER_METRE * target.square, MM_PER_METRE * target.marker
    first_black = 1 if target.legacy_pattern and target.rows % 2 == 0 else 0
    cells = [
        (column, row, box.left + column * side, box.high - (row + 1) * side)
        for row in range(target.rows)
        for column in range(target.columns)
    ]
    inset = (side - marker) / 2
    patterns = _marker_modules(target)
    for column, row, left, low in cells:
        if (column + row) % 2 == first_black:
            yield rectangle(left, low, side, side)
            continue
        pattern = next(patterns)
        module = marker / len(pattern)
        for loop in outlines(pattern):
            yield Polygon(
                tuple((left + inset + x * module, low + inset + y * module) for x, y in loop)
            )


def _marker_box(target: MarkerGrid) -> Box:
    border = MM_PER_METRE * target.gap if target.kalibr else 0.0
    right, high = (MM_PER_METRE * target.points[-1, :2]).tolist()
    return Box(-border, -border, right + border, high + border)


def _markers(target: MarkerGrid) -> Iterator[Polygon]:
    """Yield markers, and for Kalibr's grids the squares between their corners."""
    side, gap = MM_PER_METRE * target.marker, MM_PER_METRE * target.gap
    patterns = marker_patterns(target)
    module = side / len(patterns[0])
    for numbers, pattern in zip(target.corners, patterns, strict=True):
        left, low = (MM_PER_METRE * target.points[numbers, :2].min(axis=0)).tolist()
        for loop in outlines(pattern):
            yield Polygon(tuple((left + x * module, low + y * module) for x, y in loop))
    if target.kalibr:
        for row in range(-1, target.rows):
            for column in range(-1, target.columns):
                left, low = (count * (side + gap) + side for count in (column, row))
                yield rectangle(left, low, gap, gap)


def _marker_modules(target: Charuco) -> Iterator[NDArray[np.bool_]]:
    """Yield the black modules of each marker, including its border, in the order of ids."""
    cv2 = load("cv2")
    dictionary: Any = charuco_board(target).getDictionary()
    modules = dictionary.markerSize + 2
    for identity in range(target.columns * target.rows // 2):
        yield np.asarray(cv2.aruco.generateImageMarker(dictionary, identity, modules)) == 0


def outlines(cells: NDArray[np.bool_]) -> list[list[tuple[int, int]]]:
    """Return the outlines of the black areas among cells (rows, columns), the upper row first.

    Corners are (x, y), x right and y up, in cells from the lower left corner. Outer outlines run
    counter-clockwise, those of holes clockwise.
    """
    black = {(int(x), int(y)) for y, x in np.argwhere(cells[::-1])}
    next_corners: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for x, y in sorted(black):
        cell_corners = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)]
        neighbours = [(x, y - 1), (x + 1, y), (x, y + 1), (x - 1, y)]
        for side, neighbour in enumerate(neighbours):
            if neighbour not in black:
                next_corners.setdefault(cell_corners[side], []).append(cell_corners[(side + 1) % 4])
    loops = []
    while next_corners:
        start = corner = next(iter(next_corners))
        loop = []
        while True:
            candidates = next_corners[corner]
            next_corner = candidates.pop()
            if not candidates:
                del next_corners[corner]
            loop.append(corner)
            corner = next_corner
            if corner == start:
                break
        loops.append(_turning_points(loop))
    return loops


def _turning_points(loop: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Return the points at which a loop changes its direction."""
    triples = zip([loop[-1], *loop[:-1]], loop, [*loop[1:], loop[0]], strict=True)
    return [
        point
        for previous, point, following in triples
        if following[0] != previous[0] and following[1] != previous[1]
    ]


def _dots(target: CircleGrid) -> tuple[tuple[Disc, ...], Box]:
    centres = MM_PER_METRE * target.points[:, :2]
    radii = np.full(len(centres), MM_PER_METRE * target.diameter / 2)
    if target.origin_diameter is not None:
        radii[0] = MM_PER_METRE * target.origin_diameter / 2
    dots = tuple(
        Disc((x, y), radius)
        for (x, y), radius in zip(centres.tolist(), radii.tolist(), strict=True)
    )
    low, high = (centres - radii[:, None]).min(axis=0), (centres + radii[:, None]).max(axis=0)
    return dots, Box(*low.tolist(), *high.tolist())


def origin_mark_shapes(radius: float) -> tuple[tuple[Polygon | Disc, ...], Box]:
    """Return an origin mark: a disc with two black quarters, the first with a white dot.

    The robot touches the point where the quarters meet; the dot shows how the sheet is turned.
    """
    dot_radius = 0.18 * radius
    dot_offset = 0.6 * radius * math.sqrt(0.5)
    shapes = (
        _quarter_disc(radius, 0),
        _quarter_disc(radius, 180),
        _circle((dot_offset, dot_offset), dot_radius, clockwise=True),
    )
    return shapes, Box(-radius, -radius, radius, radius)


def _quarter_disc(radius: float, start: int) -> Polygon:
    angles = [math.radians(start + degrees) for degrees in range(91)]
    return Polygon(
        ((0.0, 0.0), *((radius * math.cos(angle), radius * math.sin(angle)) for angle in angles))
    )


def _circle(centre: Point, radius: float, *, clockwise: bool) -> Polygon:
    angles = [math.radians(-degrees if clockwise else degrees) for degrees in range(0, 360, 3)]
    x, y = centre
    return Polygon(
        tuple((x + radius * math.cos(angle), y + radius * math.sin(angle)) for angle in angles)
    )
