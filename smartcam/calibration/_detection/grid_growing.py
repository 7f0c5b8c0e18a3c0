"""Find the dots of a grid among other dots.

A dot whose neighbours lie opposite each other in two directions may belong to a grid. From there
each next dot is looked for at the place that the ones before it predict, until no more are found.
The steps of a tilted sheet change from dot to dot, which is why the last two dots of a row predict
the third.
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
"""Opposite neighbours of a dot are looked for among this many nearest dots: the eight of a grid,
and others that may be printed between."""

MAX_OPPOSITE_DIFFERENCE = 0.2
"""The steps to two opposite dots differ by less than this part of the shorter step."""

MIN_SINE = 0.5
"""The steps to a grid's next column and next row must enclose an angle whose sine is larger than
this: 30 degrees. The two shortest steps of a lattice enclose 60 degrees or more."""

MAX_STEP_OFFSET, MAX_FIRST_STEP_OFFSET = 0.3, 0.2
"""A dot is the grid's next one if it lies within the first part of a step from the place that the
step leads to; within two steps of the first dot, where steps change less, within the second
part."""

MAX_AREA_RATIO = 1.8
"""A dot has at most this many times the area of its neighbour."""

MAX_MEDIAN_OFFSET = 0.08
"""The dots of a flat grid lie off their places by a median of less than this part of a step: lenses
bend a grid of fewer than 20 dots by less."""

MAX_SEEDS_RANKED = 128
"""At most this many dots, those with the best pair of opposite neighbours, are searched for a
second pair."""

MAX_SEEDS_TRIED = 4
"""A grid is grown from at most this many dots. A grid's dots stand opposite each other more exactly
than dots that do so by chance, so the first dot that is tried is the grid's as a rule."""

MIN_DOTS_REACHED = 8
"""At least this many dots of a grid lie within two steps of its first dot, that dot included."""

Place = tuple[int, int]

_AROUND: Final[list[Place]] = [(1, 0), (0, 1), (-1, 0), (0, -1)]

Lattice = dict[Place, int]
"""The dot at each column and row; the origin and directions of these are arbitrary."""

Alike: TypeAlias = "Callable[[NDArray[np.intp], NDArray[np.intp]], NDArray[np.bool_]]"
"""Function that returns, from the indices of pairs of dots, whether the two may be neighbours."""


def lattices(
    points: Array,
    alike: Alike,
    *,
    least: int,
    most: int,
    follows: Alike | None = None,
    neighbours: int = NEIGHBOURS,
) -> Iterator[Lattice]:
    """Yield grids of connected dots.

    ``alike`` says which of the ``points`` (N, 2), pixels, may be neighbours, ``follows`` which
    others may come after a dot. A grid has at least ``least`` dots, four or more. Growing stops
    soon after ``most`` dots. A grid is grown from a dot that has two pairs of opposite dots among
    its nearest ``neighbours``; at most MAX_SEEDS_TRIED of these are tried.
    """
    if len(points) < 5:
        return
    tries = MAX_SEEDS_TRIED
    grown = _Grown(points, alike, follows or alike)
    seen = np.zeros(len(points), dtype=np.bool_)
    for start, steps in grown.starts(neighbours):
        if seen[start]:
            continue
        grid = grown.grow(start, steps, most)
        seen[list(grid.values())] = True
        if len(grid) >= least and _is_regular(points, grid):
            grown.complete(grid, most)
            yield grid
        tries -= 1
        if tries == 0:
            return


def alike_areas(areas: Array, larger: float = 1.0) -> Alike:
    """Return a test whether two ``areas`` (N,) are alike, or one ``larger`` times the other."""

    def alike(one: NDArray[np.intp], other: NDArray[np.intp]) -> NDArray[np.bool_]:
        part = areas[one] / (larger * areas[other])
        return np.asarray((part < MAX_AREA_RATIO) & (part > 1 / MAX_AREA_RATIO))

    return alike


@dataclass(eq=False)
class _Grown:
    """Dots by their places, and the grids that are grown from one of them."""

    _points: Array
    _alike: Alike
    _follows: Alike

    def __post_init__(self) -> None:
        self._tree = load("scipy.spatial").cKDTree(self._points)

    def starts(self, neighbours: int) -> Iterator[tuple[int, Array]]:
        """Yield dots with neighbours on four sides, and the steps (2, 2) to two of them.

        Dots whose neighbours lie most exactly opposite each other come first.
        """
        points = self._points
        _, neighbours_of = self._tree.query(points, min(neighbours + 1, len(points)))
        neighbours_of = neighbours_of[:, 1:]
        alike = self._alike(neighbours_of, np.arange(len(points))[:, None])
        ways = points[neighbours_of] - points[:, None]
        # |a + b|^2 = |a|^2 + |b|^2 + 2 a b, all pairs by one product
        products = ways @ ways.transpose(0, 2, 1)
        squares = np.maximum(np.einsum("nii->ni", products), 1e-18)
        apart = squares[:, :, None] + squares[:, None] + 2 * products
        apart = np.sqrt(np.maximum(apart, 0) / np.minimum(squares[:, :, None], squares[:, None]))
        apart[~(alike[:, :, None] & alike[:, None])] = np.inf
        best = apart.min(axis=(1, 2))
        ranked = np.argsort(best)[
            : min(MAX_SEEDS_RANKED, int((best < MAX_OPPOSITE_DIFFERENCE).sum()))
        ]
        worse = _across(ways[ranked], apart[ranked])
        for index in ranked[np.argsort(worse)][
            : int((worse < MAX_OPPOSITE_DIFFERENCE).sum())
        ].tolist():
            ahead, opposite = np.nonzero(np.triu(apart[index] < MAX_OPPOSITE_DIFFERENCE))
            steps = (ways[index, ahead] - ways[index, opposite]) / 2
            steps = steps[np.argsort(np.linalg.norm(steps, axis=1))]
            across, *others = steps
            for other in others:
                area = abs(float(across[0] * other[1] - across[1] * other[0]))
                if area > MIN_SINE * float(np.hypot(*across) * np.hypot(*other)):
                    yield index, np.stack([across, other])
                    break

    def grow(self, start: int, steps: Array, most: int) -> Lattice:
        """Return the dots reached step by step from a dot; stop soon after ``most``."""
        places: Lattice = {(0, 0): start}
        taken = {start}
        # each dot with the steps from it, and with the dot whose area the next ones must be like
        reached = [((0, 0), start, steps, start)]
        waves = 0
        while reached and len(places) <= most:
            if waves == 2 and len(places) < MIN_DOTS_REACHED:
                break
            waves += 1
            around = self._around(reached, MAX_FIRST_STEP_OFFSET if waves < 2 else MAX_STEP_OFFSET)
            wave, reached = reached, []
            for (place, dot, steps, like), sides in zip(wave, around, strict=True):
                for side, fits in enumerate(sides):
                    column, row = _AROUND[side]
                    neighbour = (place[0] + column, place[1] + row)
                    free = next((near for near in fits if near not in taken), None)
                    if free is None or neighbour in places:
                        continue
                    places[neighbour] = free
                    taken.add(free)
                    step = steps.copy()
                    step[side % 2] = (column + row) * (self._points[free] - self._points[dot])
                    is_alike = bool(self._alike(np.array(free), np.array(like)))
                    reached.append((neighbour, free, step, free if is_alike else like))
        return places

    def complete(self, places: Lattice, most: int) -> None:
        """Add the dots beside a grid that lie where all of its dots together predict them.

        Far from the start and near the horizon, the last step alone predicts them less well.
        """
        added = True
        while added and len(places) <= most:
            added = False
            mapped = GridMap(np.array(list(places), float), self._points[list(places.values())])
            taken = set(places.values())
            next_to = {
                (x + column, y + row): dot
                for (x, y), dot in places.items()
                for column, row in _AROUND
                if (x + column, y + row) not in places
            }
            at = np.array(list(next_to), dtype=np.float64)
            longest = MAX_STEP_OFFSET * np.linalg.norm(local_steps(mapped, at, 1.0), axis=2).min(
                axis=1
            )
            distances, nearest = self._tree.query(mapped(at))
            fits = (distances < longest) & self._follows(nearest, np.array(list(next_to.values())))
            for place, dot, fit in zip(next_to, nearest.tolist(), fits.tolist(), strict=True):
                if fit and dot not in taken:
                    places[place] = dot
                    taken.add(dot)
                    added = True

    def _around(
        self, reached: list[tuple[Place, int, Array, int]], limit: float
    ) -> list[list[list[int]]]:
        """Return, for each dot and each of its four sides, the dots that may come next.

        ``limit``: largest distance of such a dot from the end of the step, as a part of the step.
        """
        dots = np.array([dot for _, dot, _, _ in reached])
        like = np.array([like for _, _, _, like in reached])
        steps = np.stack([steps for _, _, steps, _ in reached])
        ways = np.concatenate([steps, -steps], axis=1)
        ahead = self._points[dots][:, None] + ways
        distances, nearest = self._tree.query(ahead, min(3, len(self._points)))
        fits = distances < limit * np.linalg.norm(ways, axis=2)[:, :, None]
        fits &= self._follows(nearest, like[:, None, None])
        return [
            [
                [dot for dot, fit in zip(*side, strict=True) if fit]
                for side in zip(*dots_and_fits, strict=True)
            ]
            for dots_and_fits in zip(nearest.tolist(), fits.tolist(), strict=True)
        ]


def _across(ways: Array, apart: Array) -> Array:
    """Return the deviation from opposite (N,) of the best pair across the best one.

    ``ways`` (N, K, 2) lead to the neighbours; ``apart`` (N, K, K) is the deviation of each two from
    being opposite.
    """
    count, around, _ = apart.shape
    between = (ways[:, :, None] - ways[:, None]).reshape(count, around * around, 2)
    between /= np.maximum(np.linalg.norm(between, axis=2, keepdims=True), 1e-9)
    flat = apart.reshape(count, around * around)
    first = between[np.arange(count), flat.argmin(axis=1)][:, None]
    sine = np.abs(between[:, :, 0] * first[:, :, 1] - between[:, :, 1] * first[:, :, 0])
    return np.asarray(np.where(sine > MIN_SINE, flat, np.inf).min(axis=1))


def _is_regular(points: Array, grid: Lattice) -> bool:
    """Return True if a flat sheet could look like the grid, which chance may have made."""
    places = np.array(list(grid), dtype=np.float64)
    pixels = points[list(grid.values())]
    seen = GridMap(places, pixels)
    distances = np.linalg.norm(seen(places) - pixels, axis=1)
    steps = np.linalg.norm(local_steps(seen, places, 1.0), axis=2).min(axis=1)
    return bool(np.median(distances / steps) < MAX_MEDIAN_OFFSET)
