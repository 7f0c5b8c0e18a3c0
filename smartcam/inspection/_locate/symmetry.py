"""Find the rotations after which a part looks like itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from smartcam.geometry._inside import Array
    from smartcam.inspection._locate.segments import Segments

MIN_SAME_SHARE: Final = 0.97
"""Least share of the outline that a turn (rotation) of a symmetry must bring onto the outline."""

MIN_ALIKE_SHARE: Final = 0.75
"""Least share of the outline for a turn by which a part may be mistaken for the unturned part."""

MAX_FOLD: Final = 24
"""Largest fold (number of turns in the full circle) that is distinguished from a round part."""

OUTLINE_DISTANCE_PX: Final = 1.5
"""Largest distance of a turned point from the outline, pixels."""

MAX_EDGE_ANGLE: Final = math.radians(20.0)
"""Largest angle between the direction of a turned edge and the direction of the edge at its
place."""

CENTRE_STEPS: Final = 6
"""Number of iterations that find the centre of a part's turns."""

PAIRING_DISTANCE_PX: Final = 8.0
"""Largest distance, pixels, between a turned segment and its partner, in the first iteration."""

MIN_PAIRED_SEGMENTS: Final = 8
"""Least number of turned segments with a partner."""

COMMON_FOLDS: Final = (2, 3, 4, 5, 6, 8)
"""Folds whose centre is always searched; for other folds, only if enough of the outline matches
about the reference. A notch in the part may have moved the reference away from the centre."""

MAX_POINTS: Final = 1000
"""Approximate number of edge pixels that are turned."""

ANGLE_COUNT: Final = 720
"""Turns of the full circle that are tried."""


@dataclass(frozen=True, slots=True)
class Symmetry:
    """The rotations (turns) after which a part looks like itself.

    Attributes:
        fold: number of turns in the full circle after which the part is the same: 1 for most parts,
            4 for a square, 0 for a round part, which has no angle.
        alike: other turns after which the part may be mistaken for the unturned part: radians, and
            the share of the outline that is the same; the largest share first.
        centre: centre of these turns, pixels from the part's reference.
    """

    fold: int = 1
    alike: tuple[tuple[float, float], ...] = ()
    centre: tuple[float, float] = (0.0, 0.0)

    @property
    def period(self) -> float:
        """Angle after which the part is the same, radians; an angle is known modulo this."""
        return 2 * math.pi / max(self.fold, 1)

    def text(self) -> str:
        """Return a sentence about the symmetry, for people."""
        if self.fold == 0:
            return "round: it has no angle"
        sentence = "has one angle"
        if self.fold > 1:
            sentence = f"the same every {360 / self.fold:g} degrees: its angle is known modulo that"
        if self.alike:
            angle, share = self.alike[0]
            sentence += (
                f"; turned by {math.degrees(angle):.0f} degrees, {100 * share:.0f} % of it are "
                "the same: the rest, which tells the angles apart, must be visible"
            )
        return sentence


def find_symmetry(segments: Segments, points: Array, normals: Array) -> tuple[Symmetry, Array]:
    """Return the turns that bring a part's edges onto themselves, and the centre (2,) of the turns.

    ``points`` (M, 2) and ``normals`` (M, 2) are all edges of the part; ``segments`` are the edges
    whose place is measured to a fraction of a pixel. For a part without symmetry, the centre is the
    reference, (0, 0).
    """
    shares = _matching_shares(points, normals)
    best, best_share = Symmetry(1, _find_alike_turns(shares, 1)), MIN_ALIKE_SHARE
    for count in (0, *range(MAX_FOLD, 1, -1)):
        if count not in COMMON_FOLDS and _min_share(shares, count) < MIN_ALIKE_SHARE:
            continue
        centre = _find_centre(segments, count or MAX_FOLD)
        centred_shares = _matching_shares(points - centre, normals)
        min_share = _min_share(centred_shares, count)
        if min_share >= MIN_SAME_SHARE:
            return Symmetry(
                count, _find_alike_turns(centred_shares, count) if count else ()
            ), centre
        if min_share > best_share and count:
            x, y = centre.tolist()
            best, best_share = Symmetry(1, _find_alike_turns(centred_shares, 1), (x, y)), min_share
    return best, np.zeros(2)


def _min_share(shares: Array, count: int) -> float:
    """Return the least share that matches after a turn of the fold ``count``; 0: any turn."""
    if count == 0:
        return float(shares.min())
    turns = np.rint(ANGLE_COUNT * np.arange(1, count) / count).astype(np.intp)
    around = np.mod(turns[:, None] + np.arange(-1, 2, dtype=np.intp), ANGLE_COUNT)
    return float(shares[around].max(axis=1).min())


def _find_centre(segments: Segments, count: int) -> Array:
    """Return the centre (2,) about which turns bring segments nearest to other segments."""
    centre = np.zeros(2)
    tree = load("scipy.spatial", "locate needs").cKDTree(segments.middles)
    for step in range(CENTRE_STEPS):
        reach = max(PAIRING_DISTANCE_PX * (1 - step / 4), OUTLINE_DISTANCE_PX)
        rows, values = [], []
        for number in range(1, count):
            angle = 2 * math.pi * number / count
            cos, sin = math.cos(angle), math.sin(angle)
            turn = np.array([[cos, -sin], [sin, cos]])
            turned_middles = (segments.middles - centre) @ turn.T + centre
            nearest_segments = tree.query(turned_middles)[1]
            across, along = segments.coordinates_of(turned_middles, nearest_segments)
            cosines = (segments.normals @ turn.T * segments.normals[nearest_segments]).sum(axis=1)
            used = (cosines >= math.cos(MAX_EDGE_ANGLE)) & (np.abs(across) <= reach)
            used &= np.abs(along) <= segments.half_lengths[nearest_segments] + 1
            rows.append((segments.normals[nearest_segments] @ (np.eye(2) - turn))[used])
            values.append(-across[used])
        if sum(map(len, values)) < MIN_PAIRED_SEGMENTS:
            return np.zeros(2)
        centre = centre + np.linalg.lstsq(np.vstack(rows), np.concatenate(values), rcond=None)[0]
    return centre


def _matching_shares(points: Array, normals: Array) -> Array:
    """Return the share of the edges that each turn brings onto other edges, (ANGLE_COUNT,)."""
    cv2 = load("cv2", "inspection needs")
    radius = math.ceil(float(np.linalg.norm(points, axis=1).max())) + 3
    image = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    at = np.rint(points).astype(int) + radius
    image[at[:, 1], at[:, 0]] = 0
    distance, nearest = cv2.distanceTransformWithLabels(
        image, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    point_of = np.zeros(int(nearest.max()) + 1, int)
    point_of[nearest[at[:, 1], at[:, 0]]] = np.arange(len(at))
    step = max(1, len(points) // MAX_POINTS)
    shares = np.empty(ANGLE_COUNT)
    for index in range(ANGLE_COUNT):
        angle = 2 * math.pi * index / ANGLE_COUNT
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        columns, rows = np.rint(points[::step] @ turn).astype(int).T + radius
        nearest_points = point_of[nearest[rows, columns]]
        is_aligned = (normals[nearest_points] * (normals[::step] @ turn)).sum(axis=1) >= math.cos(
            MAX_EDGE_ANGLE
        )
        shares[index] = (is_aligned & (distance[rows, columns] <= OUTLINE_DISTANCE_PX)).mean()
    return shares


def _find_alike_turns(shares: Array, fold: int) -> tuple[tuple[float, float], ...]:
    """Return the turns within the period after which the part may be mistaken for itself."""
    period = ANGLE_COUNT // fold
    in_period = shares[:period]
    before, after = np.roll(in_period, 1), np.roll(in_period, -1)
    peaks = np.flatnonzero(
        (in_period >= before) & (in_period > after) & (in_period >= MIN_ALIKE_SHARE)
    )
    clear_peaks = peaks[(peaks > ANGLE_COUNT // 36) & (peaks < period - ANGLE_COUNT // 36)]
    order = clear_peaks[np.argsort(-in_period[clear_peaks], kind="stable")][:8]
    return tuple(
        (2 * math.pi * index / ANGLE_COUNT, float(shares[index])) for index in order.tolist()
    )
