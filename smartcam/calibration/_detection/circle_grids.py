"""Find grids of dots in images, number them from their origin and fit their centres.

A grid that is seen in part could be numbered in more than one way. It is refused: all its dots
must be visible, and there must be no further dots where its rows and columns would continue.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._detection.blobs import find_dark_pieces
from smartcam.calibration._detection.dots import GridMap, refine_dots
from smartcam.calibration._detection.grid_growing import area_test, grow_grids
from smartcam.calibration._detection.image import (
    USUAL_SIDE_PX,
    GreyImage,
    resize_image,
    shrink_image,
)
from smartcam.calibration._detection.ordering import (
    choose_marked,
    choose_rightward,
    find_arrangements,
)
from smartcam.calibration._detection.sampling import mean_level
from smartcam.calibration._homography import local_steps
from smartcam.calibration._views import TargetView
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration._detection.blobs import Pieces, Spots
    from smartcam.calibration._detection.dots import Dots
    from smartcam.calibration._detection.ordering import Arrangement
    from smartcam.calibration._targets import CircleGrid
    from smartcam.exceptions import CalibrationError
    from smartcam.geometry._inside import Array

WIDE_WINDOW_RATIO, NARROW_WINDOW_RATIO = 1.0, 0.3
"""Sides of the wide and of the narrow square around a pixel, with whose mean the pixel is compared;
in distances between the dots of a grid that fills the image."""

SMALL_SIDE_PX = 800
"""A grid is searched first in an image whose longest side has at most this many pixels."""

MIN_DOT_SHARE = 0.4
"""The image is searched at twice its size only if at least this fraction of the target's dots is
found in rows and columns among the specks. (Doubling the size separates dots that touch each other
at the given size.)"""

NEIGHBOURS = 8
"""In a grid whose dots have only a few pixels, the next dots are searched among this many
neighbours."""

EXTRA_SPOTS = 1000
"""Number of spots that are examined in addition to twice the number of the target's dots. If an
image has more spots, only the largest are examined."""

MIN_DOTS_REPORTED = 9
"""An error mentions dots in rows and columns if at least this many were found."""

MAX_OFFSET_RATIO = 0.15
"""A dot may be this far from the place that the other dots predict, as a fraction of the distance
between dots."""

RING_DIRECTIONS = np.column_stack(
    [np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8)]
)
"""(16, 2), points of the unit circle."""


def find_circles(image: GreyImage, target: CircleGrid, name: str = "") -> TargetView:
    """Find the centres of a grid's dots, dark on light or light on dark.

    Raises TARGET_NOT_FOUND, AMBIGUOUS_ORIGIN, MIRRORED.
    """
    counts = _SearchCounts()
    for dark_image, points, arrangements in _find_grids(image, target, counts):
        if _is_complete(dark_image, target, points[arrangements[0].order.ravel()]):
            return _make_view(dark_image, target, points, arrangements, name)
        counts.max_grid_count = len(points) + 1
    raise _not_found_error(target, counts)


@dataclass
class _SearchCounts:
    """The numbers of spots and dots that a search has found, for the error if the search fails."""

    spot_count: int | None = None  # count of dark spots, in the first search
    # largest number of dots in rows and columns; growing stops above the target's number
    max_grid_count: int = 0


def _find_grids(
    image: GreyImage, target: CircleGrid, counts: _SearchCounts
) -> Iterator[tuple[GreyImage, Array, list[Arrangement]]]:
    """Yield an image, dots (N, 2) arranged as the target's, pixels, and the ways to number them.

    The image is the one in which the dots are dark: the given one or its negative.
    """
    for is_negative, scale, spots in _search_image(image.uint8_levels, target):
        for points, grid_positions in _find_full_grids(spots, target, counts):
            centres = (points + 0.5) / scale - 0.5
            arrangements = find_arrangements(centres, grid_positions, target)
            if arrangements and _fits_flat_grid(target, centres[arrangements[0].order.ravel()]):
                dark_image = (
                    GreyImage(255 - image.levels, 255 - image.uint8_levels)
                    if is_negative
                    else image
                )
                yield dark_image, centres, arrangements


def _search_image(
    image: NDArray[np.uint8], target: CircleGrid
) -> Iterator[tuple[bool, float, Spots]]:
    """Search an image in several ways; yield whether it is the negative, its scale, and its spots.

    A large image is searched at a small size first. Any image is searched at twice its size if it
    may have dots of a few pixels.
    """
    longest_side = max(image.shape)
    factor, usual_scale = (
        math.ceil(longest_side / SMALL_SIDE_PX),
        min(1.0, USUAL_SIDE_PX / longest_side),
    )
    max_spots = EXTRA_SPOTS + 2 * len(target.points)
    if factor > 1:
        reduced = shrink_image(image, factor)
        for is_negative in (False, True):
            yield (
                is_negative,
                1 / factor,
                _find_pieces(reduced, is_negative, WIDE_WINDOW_RATIO, target).find_spots(max_spots),
            )
    resized = resize_image(image, usual_scale)
    negatives_with_specks = []
    for window_ratio, is_negative in itertools.product(
        (WIDE_WINDOW_RATIO, NARROW_WINDOW_RATIO), (False, True)
    ):
        pieces = _find_pieces(resized, is_negative, window_ratio, target)
        yield is_negative, usual_scale, pieces.find_spots(max_spots)
        if window_ratio == NARROW_WINDOW_RATIO and _contain_grid(pieces.find_specks(), target):
            negatives_with_specks.append(is_negative)
    for is_negative in negatives_with_specks:
        pieces = _find_pieces(
            resize_image(image, 2 * usual_scale), is_negative, NARROW_WINDOW_RATIO, target
        )
        yield is_negative, 2 * usual_scale, pieces.find_spots(max_spots)


def _find_pieces(
    image: NDArray[np.uint8], is_negative: bool, window_ratio: float, target: CircleGrid
) -> Pieces:
    # length of the grid's longer side, in distances between its dots
    longer_side = max(target.columns, target.rows / 2 if target.asymmetric else target.rows)
    window = round(window_ratio * max(image.shape) / longer_side)
    return find_dark_pieces(255 - image if is_negative else image, window)


def _contain_grid(specks: Spots, target: CircleGrid) -> bool:
    """Return True if many dots of the grid are found among the dots of a few pixels."""
    min_count = max(4, round(MIN_DOT_SHARE * len(target.points)))
    may_be_neighbours = area_test(specks.areas)
    return any(
        grow_grids(
            specks.points,
            may_be_neighbours,
            min_count=min_count,
            max_count=min_count,
            neighbours=NEIGHBOURS,
        )
    )


def _find_full_grids(
    spots: Spots, target: CircleGrid, counts: _SearchCounts
) -> Iterator[tuple[Array, NDArray[np.intp]]]:
    """Yield grids with as many dots as the target: dots (N, 2) and their grid positions (N, 2)."""
    count = target.columns * target.rows
    if counts.spot_count is None:
        counts.spot_count = len(spots.areas)
    elif len(spots.areas) < count:
        return
    origin_area_ratio = ((target.origin_diameter or target.diameter) / target.diameter) ** 2
    same_size, origin_size = area_test(spots.areas), area_test(spots.areas, origin_area_ratio)

    def may_follow(first: NDArray[np.intp], second: NDArray[np.intp]) -> NDArray[np.bool_]:
        return same_size(first, second) | origin_size(first, second)

    for grid in grow_grids(
        spots.points, same_size, may_follow=may_follow, min_count=MIN_DOTS_REPORTED, max_count=count
    ):
        counts.max_grid_count = max(counts.max_grid_count, len(grid))
        if len(grid) == count:
            yield spots.points[list(grid.values())], np.array(list(grid), dtype=np.intp)


def _fits_flat_grid(target: CircleGrid, points: Array) -> bool:
    """Return True if the dots lie where a flat grid would show them."""
    flat_points = target.points[:, :2]
    grid_map = GridMap(flat_points, points)
    steps = np.linalg.norm(local_steps(grid_map, flat_points, target.spacing), axis=2).min(axis=1)
    distances = np.linalg.norm(grid_map(flat_points) - points, axis=1)
    return bool((distances < MAX_OFFSET_RATIO * steps).all())


def _is_complete(image: GreyImage, target: CircleGrid, points: Array) -> bool:
    """Return True if there are no further dots where the grid's rows and columns would continue.

    A further dot would be dark with light paper all around. Places outside of the image are not
    counted.
    """
    flat_points = target.points[:, :2]
    grid_map = GridMap(flat_points, points)
    positions = _positions_beyond(target)
    threshold = sum(_dot_and_gap_levels(image, target, grid_map)) / 2
    inner_levels = _ring_levels(image, grid_map, positions, target.diameter / 4)
    outer_levels = _ring_levels(
        image, grid_map, positions, (_min_distance(target) + target.diameter) / 4
    )
    is_in_image = np.isfinite(inner_levels).any(axis=1)
    darkest = np.where(np.isfinite(inner_levels), inner_levels, -np.inf).max(axis=1)
    lightest = np.where(np.isfinite(outer_levels), outer_levels, np.inf).min(axis=1)
    is_dot: NDArray[np.bool_] = is_in_image & (darkest < threshold) & (lightest > threshold)
    return not is_dot.any()


def _min_distance(target: CircleGrid) -> float:
    """Return the least distance between two dots, metres."""
    return target.spacing * (math.sqrt(0.5) if target.asymmetric else 1.0)


def _dot_and_gap_levels(
    image: GreyImage, target: CircleGrid, grid_map: GridMap
) -> tuple[float, float]:
    """Return the mean grey level in the dots, and the mean grey level in the gaps around them."""
    flat_points = target.points[:, None, :2]
    gap = (_min_distance(target) + target.diameter) / 4
    inner_level, outer_level = (
        mean_level(image, grid_map((flat_points + radius * RING_DIRECTIONS).reshape(-1, 2)))
        for radius in (target.diameter / 4, gap)
    )
    return inner_level, outer_level


def _positions_beyond(target: CircleGrid) -> Array:
    """Return the positions (N, 2) where the grid's rows and columns would continue, metres."""
    half_spacing = target.spacing / 2
    half_steps = np.rint(target.points[:, :2] / half_spacing).astype(np.intp)
    steps = [(1, 1), (1, -1)] if target.asymmetric else [(2, 0), (0, 2)]
    all_steps = np.array(steps + [(-x, -y) for x, y in steps])
    neighbours = {(x, y) for x, y in (half_steps[:, None] + all_steps).reshape(-1, 2).tolist()}
    return half_spacing * np.array(sorted(neighbours - {(x, y) for x, y in half_steps.tolist()}))


def _ring_levels(image: GreyImage, grid_map: GridMap, positions: Array, radius: float) -> Array:
    """Return grey levels (N, 16) on circles around N positions; NaN outside of the image."""
    u, v = grid_map((positions[:, None] + radius * RING_DIRECTIONS).reshape(-1, 2)).T
    width, height = image.size
    is_inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    column, row = (
        np.rint(np.where(is_inside, coordinates, 0)).astype(np.intp) for coordinates in (u, v)
    )
    levels = np.where(is_inside, image.levels[row, column], np.nan)
    return levels.reshape(len(positions), len(RING_DIRECTIONS))


def _make_view(
    image: GreyImage, target: CircleGrid, points: Array, arrangements: list[Arrangement], name: str
) -> TargetView:
    arrangement, margin = _number_dots(image, target, points, arrangements)
    flat_points, order = target.points[:, :2], arrangement.order.ravel()
    diameters = np.full(len(flat_points), target.diameter)
    diameters[0] = target.origin_diameter or target.diameter
    grid_map = GridMap(flat_points, points[order])
    dots = _refine_grid(image, target, grid_map, points[order], diameters)
    shifts = GridMap(flat_points, dots.points - grid_map.shifts(flat_points, diameters)).shifts(
        flat_points, diameters
    )
    return TargetView(
        target=target,
        size=image.size,
        ids=np.arange(len(flat_points), dtype=np.intp),
        points=dots.points - shifts,
        covariance=dots.covariance,
        margin=margin,
        name=name,
    )


def _refine_grid(
    image: GreyImage, target: CircleGrid, grid_map: GridMap, points: Array, diameters: Array
) -> Dots:
    """Return the fitted dots; each fit uses the pixels up to half the gap around the dot."""
    flat_points, radii = target.points[:, :2], diameters / 2
    gaps = _min_distance(target) - 2 * radii
    gaps[1:] = np.minimum(gaps[1:], np.linalg.norm(flat_points[1:], axis=1) - radii[0] - radii[1:])
    gaps[0] = gaps[1:].min()
    directions = local_steps(grid_map, flat_points, target.diameter / 2) / (target.diameter / 2)
    reaches = radii + gaps / 2
    return refine_dots(
        image,
        points,
        directions * radii[:, None, None],
        directions * reaches[:, None, None],
    )


def _number_dots(
    image: GreyImage, target: CircleGrid, points: Array, arrangements: list[Arrangement]
) -> tuple[Arrangement, float | None]:
    name = f"{target.columns} x {target.rows} dots"
    if target.origin_diameter is None:
        return choose_rightward(arrangements, name), None
    flat_points = target.points[:, :2]
    rim = RING_DIRECTIONS * (target.diameter + target.origin_diameter) / 4
    gap_ring = target.spacing * (RING_DIRECTIONS / 16 + (0.5, 0.0 if target.asymmetric else 0.5))
    levels_by_origin = {}
    for arrangement in arrangements:
        grid_map = GridMap(flat_points, points[arrangement.order.ravel()])
        levels_by_origin[int(arrangement.order[0, 0])] = [
            mean_level(image, grid_map(ring)) for ring in (rim, gap_ring)
        ]
    mean_paper = sum(paper_level for _, paper_level in levels_by_origin.values()) / len(
        levels_by_origin
    )

    def level(order: NDArray[np.intp]) -> float:
        """Return the grey level at the larger dot's rim, corrected for uneven light."""
        rim_level, paper_level = levels_by_origin[int(order[0, 0])]
        return rim_level * mean_paper / max(paper_level, 1.0)

    return choose_marked(arrangements, level, f"{name}, of which the larger one is the origin")


def _not_found_error(target: CircleGrid, counts: _SearchCounts) -> CalibrationError:
    """Return the error that reports the dots that were found instead."""
    count = target.columns * target.rows
    if counts.max_grid_count > count:
        text = "saw more than these in rows and columns, as of a larger grid"
    else:
        text = f"saw {counts.spot_count} dark spots and no such grid among them"
        if counts.max_grid_count:
            text += f", at most {counts.max_grid_count} in rows and columns"
    return Code.TARGET_NOT_FOUND.error(
        f"circles: expected {target.columns} x {target.rows} dots, {text}",
        count,
        counts.max_grid_count or counts.spot_count,
    )
