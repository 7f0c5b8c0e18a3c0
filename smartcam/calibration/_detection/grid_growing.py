"""Dots that stand in rows and columns, among others that do not.

A dot whose neighbours stand opposite each other in two directions may be a grid's. From there each
dot is looked for where the ones before it say that it is, until no more are found. A tilted sheet's
steps change from dot to dot, which is why the last two of a row predict the third.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam.calibration._geometry.homography import apply_homography, fit_homography, local_steps
from smartcam.calibration._optional_imports import load

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.calibration._geometry.rotations import Array

NEIGHBOURS = 12
"""Dots around one among which those opposite each other are looked for: a grid's eight next ones
and what may be printed between."""

OPPOSITE = 0.3
"""Of a step, by which the steps to two dots opposite each other differ at most."""

LEAST_SINE = 0.5
"""Of the angle between the steps to a grid's next column and its next row: 30 degrees; the two
shortest steps of a lattice have 60 or more."""

NEAR = 0.3
"""Of a step, from where it leads to the dot that is found there at most."""

ALIKE = 1.8
"""Times the area of its neighbour that a dot has at most."""

REGULAR = 0.08
"""Of a step, from where a flat grid has its dots to where they are, in the median at most: lenses
bend less."""

MOST_TRIES = 50
"""Dots from which a grid is grown."""

Place = tuple[int, int]

_AROUND: Final[list[Place]] = [(1, 0), (0, 1), (-1, 0), (0, -1)]

Lattice = dict[Place, int]
"""The dot at a column and a row, counted from anywhere in any direction."""


def lattices(
    points: Array, areas: Array, *, least: int, most: int, larger: float = 1.0
) -> Iterator[Lattice]:
    """Yield grids, each of dots that hang together.

    ``points`` (N, 2), pixels, have ``areas`` (N,), pixels^2; a dot's area may be that of its
    neighbours, or ``larger`` times as much. A grid has at least ``least`` dots, four or more; of
    one with more than ``most``, a few more than these are returned.
    """
    if len(points) < 5:
        return
    grown = _Grown(points, areas, larger)
    seen = np.zeros(len(points), dtype=np.bool_)
    tries = MOST_TRIES
    for start, steps in grown.starts():
        if seen[start]:
            continue
        found = grown.grow(start, steps, most)
        seen[list(found.values())] = True
        if len(found) >= least and _is_regular(points, found):
            yield found
        tries -= 1
        if tries == 0:
            return


@dataclass(eq=False)
class _Grown:
    """Dots by their places, and grids that are grown from one of them."""

    _points: Array
    _areas: Array
    _larger: float

    def __post_init__(self) -> None:
        self._tree = load("scipy.spatial").cKDTree(self._points)

    def starts(self) -> Iterator[tuple[int, Array]]:
        """Yield dots with neighbours on four sides, and the steps (2, 2) to two of them.

        Those that have two exactly opposite each other come first.
        """
        points = self._points
        _, near = self._tree.query(points, min(NEIGHBOURS + 1, len(points)))
        near = near[:, 1:]
        part = self._areas[near] / self._areas[:, None]
        alike = (part < ALIKE) & (part > 1 / ALIKE)
        ways = points[near] - points[:, None]
        lengths = np.maximum(np.linalg.norm(ways, axis=2), 1e-9)
        apart = np.linalg.norm(ways[:, :, None] + ways[:, None], axis=3)
        apart /= np.minimum(lengths[:, :, None], lengths[:, None])
        apart[~(alike[:, :, None] & alike[:, None])] = np.inf
        best = apart.min(axis=(1, 2))
        for index in np.argsort(best)[: int((best < OPPOSITE).sum())].tolist():
            ahead, behind = np.nonzero(np.triu(apart[index] < OPPOSITE))
            steps = (ways[index, ahead] - ways[index, behind]) / 2
            steps = steps[np.argsort(np.linalg.norm(steps, axis=1))]
            across, *others = steps
            for other in others:
                area = abs(float(across[0] * other[1] - across[1] * other[0]))
                if area > LEAST_SINE * float(np.hypot(*across) * np.hypot(*other)):
                    yield index, np.stack([across, other])
                    break

    def grow(self, start: int, steps: Array, most: int) -> Lattice:
        """Return all dots that are reached from one step by step, or a few more than ``most``."""
        places: Lattice = {(0, 0): start}
        taken = {start}
        reached = deque([((0, 0), steps, float(self._areas[start]))])
        while reached and len(places) <= most:
            here, steps, area = reached.popleft()
            ways = np.concatenate([steps, -steps])
            ahead = self._points[places[here]] + ways
            off, near = self._tree.query(ahead, min(3, len(self._points)))
            longest = NEAR * np.linalg.norm(ways, axis=1)
            for side, (column, row) in enumerate(_AROUND):
                there = (here[0] + column, here[1] + row)
                dots = near[side, off[side] < longest[side]].tolist()
                fits = [dot for dot in dots if dot not in taken and self._follows(dot, area)]
                if there in places or not fits:
                    continue
                dot = places[there] = fits[0]
                taken.add(dot)
                step = steps.copy()
                step[side % 2] = (column + row) * (self._points[dot] - self._points[places[here]])
                own = float(self._areas[dot])
                reached.append((there, step, own if _alike(own, area) else area))
        return places

    def _follows(self, dot: int, area: float) -> bool:
        mine = float(self._areas[dot])
        return _alike(mine, area) or _alike(mine, self._larger * area)


def _is_regular(points: Array, grid: Lattice) -> bool:
    """Return whether a flat sheet's grid may be seen so: among many dots, chance finds others."""
    places = np.array(list(grid), dtype=np.float64)
    found = points[list(grid.values())]
    matrix = fit_homography(places, found)
    if matrix is None:
        return False
    seen = partial(apply_homography, matrix)
    off = np.linalg.norm(seen(places) - found, axis=1)
    steps = np.linalg.norm(local_steps(seen, places, 1.0), axis=2).min(axis=1)
    return bool(np.median(off / steps) < REGULAR)


def _alike(area: float, other: float) -> bool:
    return other / ALIKE < area < other * ALIKE
