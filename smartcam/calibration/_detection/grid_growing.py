"""Find the dots of a grid among other dots.

A dot whose neighbours lie opposite each other in two directions may belong to a grid. From such a
dot, each next dot is searched at the place that the dots before it predict, until no more are
found. The steps of a tilted sheet change from dot to dot, so the last two dots of a row predict the
third.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.dots import GridMap
from smartcam.calibration._homography import local_steps

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

NEIGHBOURS = 12
"""Opposite neighbours of a dot are searched among this many nearest dots: the eight of a grid, and
others that may be printed between them."""

MAX_OPPOSITE_DIFFERENCE = 0.2
"""The steps to two opposite dots differ by less than this fraction of the shorter step."""

MIN_SINE = 0.5
"""The steps to a grid's next column and next row must enclose an angle whose sine is larger than
this: 30 degrees. The two shortest steps of a lattice enclose 60 degrees or more."""

MAX_STEP_OFFSET, MAX_FIRST_STEP_OFFSET = 0.3, 0.2
"""A dot is the grid's next dot if its distance from the end of the step is less than this fraction
of the step. The second value is for the steps from the grid's first dot, near which steps change
less."""

MAX_AREA_RATIO = 1.8
"""A dot has at most this many times the area of its neighbour."""

MAX_MEDIAN_OFFSET = 0.08
"""The median distance of a flat grid's dots from their predicted places is less than this fraction
of a step: a lens distorts a grid of fewer than 20 dots by less than that."""

MAX_SEEDS_RANKED = 128
"""A second pair of opposite neighbours is searched only at this many dots: the dots whose first
pair is most exactly opposite."""

MAX_SEEDS_TRIED = 4
"""A grid is grown from at most this many dots. The neighbours of a grid's dot are more exactly
opposite than those of other dots, so the first dot that is tried is usually one of the grid."""

MIN_DOTS_REACHED = 8
"""Within two steps of a grid's first dot there are at least this many of its dots, including the
first dot."""

Place = tuple[int, int]

_SIDES: Final[list[Place]] = [(1, 0), (0, 1), (-1, 0), (0, -1)]

Lattice = dict[Place, int]
"""The dot at each column and row; the origin and directions of these are arbitrary."""

PairTest: TypeAlias = "Callable[[NDArray[np.intp], NDArray[np.intp]], NDArray[np.bool_]]"
"""Function of the indices of the first and second dots of pairs; it returns a mask of the pairs
that fit together."""


def grow_grids(
    points: Array,
    may_be_neighbours: PairTest,
    *,
    min_count: int,
    max_count: int,
    may_follow: PairTest | None = None,
    neighbours: int = NEIGHBOURS,
) -> Iterator[Lattice]:
    """Yield grids of connected dots.

    ``may_be_neighbours`` tells which of the ``points`` (N, 2), pixels, may be neighbours,
    ``may_follow`` which dot may come after another one (None: as ``may_be_neighbours``). A grid has
    at least ``min_count`` dots, four or more. Growing stops soon after ``max_count`` dots. A grid
    is grown from a dot that has two pairs of opposite dots among its nearest ``neighbours``; at
    most MAX_SEEDS_TRIED of these are tried.
    """
    if len(points) < 5:
        return
    tries_left = MAX_SEEDS_TRIED
    grower = _GridGrower(points, may_be_neighbours, may_follow or may_be_neighbours)
    is_in_a_grid = np.zeros(len(points), dtype=np.bool_)
    for start, steps in grower.find_starts(neighbours):
        if is_in_a_grid[start]:
            continue
        grid = grower.grow(start, steps, max_count)
        is_in_a_grid[list(grid.values())] = True
        if len(grid) >= min_count and _is_regular(points, grid):
            grower.complete(grid, max_count)
            yield grid
        tries_left -= 1
        if tries_left == 0:
            return


def area_test(areas: Array, ratio: float = 1.0) -> PairTest:
    """Return a test for pairs whose first dot has about ``ratio`` times the second dot's area."""

    def has_ratio(first: NDArray[np.intp], second: NDArray[np.intp]) -> NDArray[np.bool_]:
        quotient = areas[first] / (ratio * areas[second])
        return np.asarray((quotient < MAX_AREA_RATIO) & (quotient > 1 / MAX_AREA_RATIO))

    return has_ratio


@dataclass(eq=False)
class _GridGrower:
    """Finds a grid among dots, beginning at one of its dots."""

    _points: Array
    _may_be_neighbours: PairTest
    _may_follow: PairTest

    def __post_init__(self) -> None:
        self._tree = load("scipy.spatial").cKDTree(self._points)

    def find_starts(self, neighbours: int) -> Iterator[tuple[int, Array]]:
        """Yield dots with neighbours on four sides, and the steps (2, 2) to two of the neighbours.

        Dots whose neighbours lie most exactly opposite each other come first.
        """
        points = self._points
        _, neighbour_indices = self._tree.query(points, min(neighbours + 1, len(points)))
        neighbour_indices = neighbour_indices[:, 1:]
        is_neighbour = self._may_be_neighbours(neighbour_indices, np.arange(len(points))[:, None])
        vectors = points[neighbour_indices] - points[:, None]
        # |a + b|^2 = |a|^2 + |b|^2 + 2 a b, all pairs by one product
        products = vectors @ vectors.transpose(0, 2, 1)
        squares = np.maximum(np.einsum("nii->ni", products), 1e-18)
        deviations = squares[:, :, None] + squares[:, None] + 2 * products
        deviations = np.sqrt(
            np.maximum(deviations, 0) / np.minimum(squares[:, :, None], squares[:, None])
        )
        deviations[~(is_neighbour[:, :, None] & is_neighbour[:, None])] = np.inf
        least_deviations = deviations.min(axis=(1, 2))
        ranked = np.argsort(least_deviations)[
            : min(MAX_SEEDS_RANKED, int((least_deviations < MAX_OPPOSITE_DIFFERENCE).sum()))
        ]
        second_deviations = _second_deviation(vectors[ranked], deviations[ranked])
        for index in ranked[np.argsort(second_deviations)][
            : int((second_deviations < MAX_OPPOSITE_DIFFERENCE).sum())
        ].tolist():
            first, second = np.nonzero(np.triu(deviations[index] < MAX_OPPOSITE_DIFFERENCE))
            steps = (vectors[index, first] - vectors[index, second]) / 2
            steps = steps[np.argsort(np.linalg.norm(steps, axis=1))]
            shortest, *longer_steps = steps
            for longer in longer_steps:
                area = abs(float(shortest[0] * longer[1] - shortest[1] * longer[0]))
                if area > MIN_SINE * float(np.hypot(*shortest) * np.hypot(*longer)):
                    yield index, np.stack([shortest, longer])
                    break

    def grow(self, start: int, steps: Array, max_count: int) -> Lattice:
        """Return the dots that are reached from a dot, hardly more than ``max_count``."""
        grid: Lattice = {(0, 0): start}
        used = {start}
        # column and row, index of the dot, steps to its neighbours, and index of the dot with whose
        # area the neighbours' areas are compared
        front = [((0, 0), start, steps, start)]
        wave_count = 0
        while front and len(grid) <= max_count:
            if wave_count == 2 and len(grid) < MIN_DOTS_REACHED:
                break
            wave_count += 1
            candidates = self._next_candidates(
                front, MAX_FIRST_STEP_OFFSET if wave_count < 2 else MAX_STEP_OFFSET
            )
            last_front, front = front, []
            for (position, dot, steps, size_reference), candidates_by_side in zip(
                last_front, candidates, strict=True
            ):
                for side, side_candidates in enumerate(candidates_by_side):
                    column, row = _SIDES[side]
                    next_place = (position[0] + column, position[1] + row)
                    free_dot = next(
                        (candidate for candidate in side_candidates if candidate not in used), None
                    )
                    if free_dot is None or next_place in grid:
                        continue
                    grid[next_place] = free_dot
                    used.add(free_dot)
                    step = steps.copy()
                    step[side % 2] = (column + row) * (self._points[free_dot] - self._points[dot])
                    is_alike = bool(
                        self._may_be_neighbours(np.array(free_dot), np.array(size_reference))
                    )
                    front.append(
                        (next_place, free_dot, step, free_dot if is_alike else size_reference)
                    )
        return grid

    def complete(self, grid: Lattice, max_count: int) -> None:
        """Add the dots next to a grid that lie where all of its dots together predict them.

        Far from the start and near the horizon, the last step alone predicts a dot less well.
        """
        has_added = True
        while has_added and len(grid) <= max_count:
            has_added = False
            grid_map = GridMap(np.array(list(grid), float), self._points[list(grid.values())])
            used = set(grid.values())
            known_dot_beside = {
                (x + column, y + row): dot
                for (x, y), dot in grid.items()
                for column, row in _SIDES
                if (x + column, y + row) not in grid
            }
            empty_places = np.array(list(known_dot_beside), dtype=np.float64)
            max_distances = MAX_STEP_OFFSET * np.linalg.norm(
                local_steps(grid_map, empty_places, 1.0), axis=2
            ).min(axis=1)
            distances, nearest = self._tree.query(grid_map(empty_places))
            fit_mask = (distances < max_distances) & self._may_follow(
                nearest, np.array(list(known_dot_beside.values()))
            )
            for position, dot, is_fit in zip(
                known_dot_beside, nearest.tolist(), fit_mask.tolist(), strict=True
            ):
                if is_fit and dot not in used:
                    grid[position] = dot
                    used.add(dot)
                    has_added = True

    def _next_candidates(
        self, front: list[tuple[Place, int, Array, int]], limit: float
    ) -> list[list[list[int]]]:
        """Return, for each dot and each of its four sides, the dots that may come next.

        ``limit``: largest distance of such a dot from the end of the step, as a share of the step.
        """
        dots = np.array([dot for _, dot, _, _ in front])
        size_references = np.array([size_references for _, _, _, size_references in front])
        steps = np.stack([steps for _, _, steps, _ in front])
        vectors = np.concatenate([steps, -steps], axis=1)
        ends = self._points[dots][:, None] + vectors
        distances, nearest = self._tree.query(ends, min(3, len(self._points)))
        fit_mask = distances < limit * np.linalg.norm(vectors, axis=2)[:, :, None]
        fit_mask &= self._may_follow(nearest, size_references[:, None, None])
        return [
            [
                [dot for dot, is_fit in zip(*side, strict=True) if is_fit]
                for side in zip(*dots_and_fits, strict=True)
            ]
            for dots_and_fits in zip(nearest.tolist(), fit_mask.tolist(), strict=True)
        ]


def _second_deviation(vectors: Array, deviations: Array) -> Array:
    """Return the least deviation (N,) of a pair whose direction differs from the best pair's.

    ``vectors`` (N, K, 2): to the K neighbours. ``deviations`` (N, K, K): how far each two
    neighbours are from being opposite.
    """
    count, neighbour_count, _ = deviations.shape
    directions = (vectors[:, :, None] - vectors[:, None]).reshape(
        count, neighbour_count * neighbour_count, 2
    )
    directions /= np.maximum(np.linalg.norm(directions, axis=2, keepdims=True), 1e-9)
    pair_deviations = deviations.reshape(count, neighbour_count * neighbour_count)
    best_directions = directions[np.arange(count), pair_deviations.argmin(axis=1)][:, None]
    sine = np.abs(
        directions[:, :, 0] * best_directions[:, :, 1]
        - directions[:, :, 1] * best_directions[:, :, 0]
    )
    return np.asarray(np.where(sine > MIN_SINE, pair_deviations, np.inf).min(axis=1))


def _is_regular(points: Array, grid: Lattice) -> bool:
    """Return True if the grid could be that of a flat sheet, and not a chance arrangement."""
    grid_positions = np.array(list(grid), dtype=np.float64)
    pixels = points[list(grid.values())]
    grid_map = GridMap(grid_positions, pixels)
    distances = np.linalg.norm(grid_map(grid_positions) - pixels, axis=1)
    steps = np.linalg.norm(local_steps(grid_map, grid_positions, 1.0), axis=2).min(axis=1)
    return bool(np.median(distances / steps) < MAX_MEDIAN_OFFSET)
