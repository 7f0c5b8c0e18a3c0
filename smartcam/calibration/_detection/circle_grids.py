"""Find grids of dots in images, number them from their origin and fit their centres.

A grid that is seen in part could be numbered in more than one way. It is refused: all its dots must
be visible, and no further ones beside them.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from smartcam.calibration._detection.blobs import dark_pieces
from smartcam.calibration._detection.dots import GridMap, refine_dots
from smartcam.calibration._detection.grid_growing import alike_areas, lattices
from smartcam.calibration._detection.image import USUAL_SIDE_PX, GreyImage, reduced, scaled
from smartcam.calibration._detection.ordering import arrangements, marked, most_rightward
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
"""Side of the square whose mean a pixel is compared with, in distances between dots of a grid that
fills the image: a wide and a narrow square."""

SMALL_SIDE_PX = 800
"""A grid is looked for first in an image whose longest side has this many pixels."""

MIN_DOT_SHARE = 0.4
"""At least this part of a grid's dots must be found in rows and columns among dots of a few pixels,
before the image is searched at twice its size. If all dots are visible at twice the size, this many
can be separated in the given one."""

NEIGHBOURS = 8
"""Dots of a few pixels: the next dots of a grid are looked for among this many neighbours."""

EXTRA_SPOTS = 1000
"""Spots examined beyond twice the number of the target's dots; in an image with more, the
largest."""

MIN_DOTS_REPORTED = 9
"""An error reports dots in rows and columns only if there are at least this many."""

MAX_OFFSET_RATIO = 0.15
"""A dot may lie this part of the distance between dots off the place that the others predict."""

RING_DIRECTIONS = np.column_stack(
    [np.cos(np.arange(16) * np.pi / 8), np.sin(np.arange(16) * np.pi / 8)]
)
"""(16, 2), points of the unit circle."""


def find_circles(image: GreyImage, target: CircleGrid, name: str = "") -> TargetView:
    """Find the centres of a grid's dots, dark on light or light on dark.

    Raises TARGET_NOT_FOUND, AMBIGUOUS_ORIGIN, MIRRORED.
    """
    seen = _Counted()
    for inked, points, ways in _grids(image, target, seen):
        if _is_whole(inked, target, points[ways[0].order.ravel()]):
            return _view(inked, target, points, ways, name)
        seen.largest = len(points) + 1
    raise _not_found_error(target, seen)


@dataclass
class _Counted:
    """The counts of a search, kept for the text of its error."""

    spots: int | None = None  # count of dark spots, in the first search
    # the most dots found in rows and columns; a count above the target's is not completed
    largest: int = 0


def _grids(
    image: GreyImage, target: CircleGrid, seen: _Counted
) -> Iterator[tuple[GreyImage, Array, list[Arrangement]]]:
    """Yield dots (N, 2), pixels, that are arranged as the target's, and the ways to number them.

    With them comes the image in which they are dark: the given one or its negative.
    """
    for light, scale, spots in _looks(image.bytes, target):
        for points, places in _laid_out(spots, target, seen):
            centres = (points + 0.5) / scale - 0.5
            ways = arrangements(centres, places, target)
            if ways and _is_flat(target, centres[ways[0].order.ravel()]):
                dark = GreyImage(255 - image.levels, 255 - image.bytes) if light else image
                yield dark, centres, ways


def _looks(image: NDArray[np.uint8], target: CircleGrid) -> Iterator[tuple[bool, float, Spots]]:
    """Yield each search of an image: whether of its negative, at which scale, and the spots found.

    A large image is searched at a small size first. Any image is searched at twice its size if it
    may have dots of a few pixels.
    """
    longest = max(image.shape)
    times, usual = math.ceil(longest / SMALL_SIDE_PX), min(1.0, USUAL_SIDE_PX / longest)
    most = EXTRA_SPOTS + 2 * len(target.points)
    if times > 1:
        small = reduced(image, times)
        for light in (False, True):
            yield light, 1 / times, _pieces(small, light, WIDE_WINDOW_RATIO, target).spots(most)
    looked_at = scaled(image, usual)
    fine = []
    for part, light in itertools.product((WIDE_WINDOW_RATIO, NARROW_WINDOW_RATIO), (False, True)):
        pieces = _pieces(looked_at, light, part, target)
        yield light, usual, pieces.spots(most)
        if part == NARROW_WINDOW_RATIO and _may_be_dots(pieces.specks(), target):
            fine.append(light)
    for light in fine:
        pieces = _pieces(scaled(image, 2 * usual), light, NARROW_WINDOW_RATIO, target)
        yield light, 2 * usual, pieces.spots(most)


def _pieces(image: NDArray[np.uint8], light: bool, part: float, target: CircleGrid) -> Pieces:
    # length of the grid's longer side, in distances between its dots
    longest = max(target.columns, target.rows / 2 if target.asymmetric else target.rows)
    around = round(part * max(image.shape) / longest)
    return dark_pieces(255 - image if light else image, around)


def _may_be_dots(specks: Spots, target: CircleGrid) -> bool:
    """Return True if dots of a few pixels may be a good part of the grid."""
    least = max(4, round(MIN_DOT_SHARE * len(target.points)))
    alike = alike_areas(specks.areas)
    return any(lattices(specks.points, alike, least=least, most=least, neighbours=NEIGHBOURS))


def _laid_out(
    spots: Spots, target: CircleGrid, seen: _Counted
) -> Iterator[tuple[Array, NDArray[np.intp]]]:
    """Yield the target's number of dots (N, 2) in rows and columns, and their places (N, 2)."""
    count = target.columns * target.rows
    if seen.spots is None:
        seen.spots = len(spots.areas)
    elif len(spots.areas) < count:
        return
    larger = ((target.origin_diameter or target.diameter) / target.diameter) ** 2
    like, larger_like = alike_areas(spots.areas), alike_areas(spots.areas, larger)

    def follows(one: NDArray[np.intp], other: NDArray[np.intp]) -> NDArray[np.bool_]:
        return like(one, other) | larger_like(one, other)

    for grid in lattices(spots.points, like, follows=follows, least=MIN_DOTS_REPORTED, most=count):
        seen.largest = max(seen.largest, len(grid))
        if len(grid) == count:
            yield spots.points[list(grid.values())], np.array(list(grid), dtype=np.intp)


def _is_flat(target: CircleGrid, points: Array) -> bool:
    """Return True if the dots lie where a flat grid would show them."""
    flat = target.points[:, :2]
    mapped = GridMap(flat, points)
    steps = np.linalg.norm(local_steps(mapped, flat, target.spacing), axis=2).min(axis=1)
    distances = np.linalg.norm(mapped(flat) - points, axis=1)
    return bool((distances < MAX_OFFSET_RATIO * steps).all())


def _is_whole(image: GreyImage, target: CircleGrid, points: Array) -> bool:
    """Return True if no dots stand where the grid's rows and columns would go on.

    A further dot would be dark with light paper all around; a place outside of the image is
    neither.
    """
    flat = target.points[:, :2]
    mapped = GridMap(flat, points)
    next_to = _next_to(target)
    half = sum(_contrast(image, target, mapped)) / 2
    inside = _levels(image, mapped, next_to, target.diameter / 4)
    outside = _levels(image, mapped, next_to, (_apart(target) + target.diameter) / 4)
    known = np.isfinite(inside).any(axis=1)
    darkest = np.where(np.isfinite(inside), inside, -np.inf).max(axis=1)
    lightest = np.where(np.isfinite(outside), outside, np.inf).min(axis=1)
    beyond: NDArray[np.bool_] = known & (darkest < half) & (lightest > half)
    return not beyond.any()


def _apart(target: CircleGrid) -> float:
    """Return the least distance between two dots, metres."""
    return target.spacing * (math.sqrt(0.5) if target.asymmetric else 1.0)


def _contrast(image: GreyImage, target: CircleGrid, mapped: GridMap) -> tuple[float, float]:
    """Return the mean grey level within the dots, and the mean level of the gaps around them."""
    flat = target.points[:, None, :2]
    gap = (_apart(target) + target.diameter) / 4
    inside, outside = (
        mean_level(image, mapped((flat + radius * RING_DIRECTIONS).reshape(-1, 2)))
        for radius in (target.diameter / 4, gap)
    )
    return inside, outside


def _next_to(target: CircleGrid) -> Array:
    """Return the places around the grid where rows and columns would go on, (N, 2), metres."""
    half = target.spacing / 2
    half_steps = np.rint(target.points[:, :2] / half).astype(np.intp)
    steps = [(1, 1), (1, -1)] if target.asymmetric else [(2, 0), (0, 2)]
    ways = np.array(steps + [(-x, -y) for x, y in steps])
    around = {(x, y) for x, y in (half_steps[:, None] + ways).reshape(-1, 2).tolist()}
    return half * np.array(sorted(around - {(x, y) for x, y in half_steps.tolist()}))


def _levels(image: GreyImage, mapped: GridMap, flat: Array, radius: float) -> Array:
    """Return grey levels (N, 16) on circles around places; NaN outside of the image."""
    u, v = mapped((flat[:, None] + radius * RING_DIRECTIONS).reshape(-1, 2)).T
    width, height = image.size
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    column, row = (
        np.rint(np.where(inside, coordinates, 0)).astype(np.intp) for coordinates in (u, v)
    )
    levels = np.where(inside, image.levels[row, column], np.nan)
    return levels.reshape(len(flat), len(RING_DIRECTIONS))


def _view(
    image: GreyImage, target: CircleGrid, points: Array, ways: list[Arrangement], name: str
) -> TargetView:
    arrangement, margin = _number(image, target, points, ways)
    flat, order = target.points[:, :2], arrangement.order.ravel()
    diameters = np.full(len(flat), target.diameter)
    diameters[0] = target.origin_diameter or target.diameter
    seen = GridMap(flat, points[order])
    dots = _refine(image, target, seen, points[order], diameters)
    shifts = GridMap(flat, dots.points - seen.shifts(flat, diameters)).shifts(flat, diameters)
    return TargetView(
        target=target,
        size=image.size,
        ids=np.arange(len(flat), dtype=np.intp),
        points=dots.points - shifts,
        covariance=dots.covariance,
        margin=margin,
        name=name,
    )


def _refine(
    image: GreyImage, target: CircleGrid, seen: GridMap, points: Array, diameters: Array
) -> Dots:
    """Return the fitted dots, each from the pixels up to half way to the next dot."""
    flat, radii = target.points[:, :2], diameters / 2
    gaps = _apart(target) - 2 * radii
    gaps[1:] = np.minimum(gaps[1:], np.linalg.norm(flat[1:], axis=1) - radii[0] - radii[1:])
    gaps[0] = gaps[1:].min()
    directions = local_steps(seen, flat, target.diameter / 2) / (target.diameter / 2)
    reaches = radii + gaps / 2
    return refine_dots(
        image,
        points,
        directions * radii[:, None, None],
        directions * reaches[:, None, None],
    )


def _number(
    image: GreyImage, target: CircleGrid, points: Array, ways: list[Arrangement]
) -> tuple[Arrangement, float | None]:
    name = f"{target.columns} x {target.rows} dots"
    if target.origin_diameter is None:
        return most_rightward(ways, name), None
    flat = target.points[:, :2]
    rim = RING_DIRECTIONS * (target.diameter + target.origin_diameter) / 4
    between = target.spacing * (RING_DIRECTIONS / 16 + (0.5, 0.0 if target.asymmetric else 0.5))
    seen = {}
    for arrangement in ways:
        mapped = GridMap(flat, points[arrangement.order.ravel()])
        seen[int(arrangement.order[0, 0])] = [
            mean_level(image, mapped(at)) for at in (rim, between)
        ]
    light = sum(paper for _, paper in seen.values()) / len(seen)

    def level(order: NDArray[np.intp]) -> float:
        """Return the level of the rim, as if the paper there had the mean brightness."""
        dark, paper = seen[int(order[0, 0])]
        return dark * light / max(paper, 1.0)

    return marked(ways, level, f"{name}, of which the larger one is the origin")


def _not_found_error(target: CircleGrid, seen: _Counted) -> CalibrationError:
    """Return an error that reports the dots seen instead."""
    count = target.columns * target.rows
    if seen.largest > count:
        text = "saw more than these in rows and columns, as of a larger grid"
    else:
        text = f"saw {seen.spots} dark spots and no such grid among them"
        if seen.largest:
            text += f", at most {seen.largest} in rows and columns"
    return Code.TARGET_NOT_FOUND.refusal(
        f"circles: expected {target.columns} x {target.rows} dots, {text}",
        count,
        seen.largest or seen.spots,
    )
