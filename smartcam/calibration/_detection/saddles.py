"""Find saddles of the grey levels, at which four squares may meet.

Around a corner of a checkerboard two dark sectors lie opposite each other between two light ones.
Its grey levels are a saddle there, and on a circle around it they come twice: a half turn further
they are the same, and they go up and down twice. The direction of the dark sectors shows which
saddles are neighbours on a board: it is turned by 90 degrees from each corner to the next, from
wherever the sheet is seen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._detection.pixels import Floats
    from smartcam.geometry._inside import Array

SMOOTHING_PX = 1.0
"""The image is smoothed by a Gaussian of this standard deviation, pixels, before its second
derivatives are taken."""

MIN_CURVATURE = 0.3
"""The bend of a saddle, ``f_xy^2 - f_xx f_yy`` in grey levels of 255 and pixels, must be larger
than this; a sharp corner with a step of 15 grey levels has 1."""

CIRCLE_RADIUS_PX = 3.0
"""Radius, pixels, of the circle around a saddle whose grey levels are tested; it fits squares of
seven pixels."""

MIN_SWING = 1.0
"""Along the circle, the grey levels of a corner swing by at least this many."""

MAX_ASYMMETRY = 0.35
"""The squared difference between a circle's halves is at most this part of the squared swing that
they share."""

MAX_SADDLES_KEPT = 600
"""At most this many saddles that look like a corner are kept, the strongest ones."""

MAX_SADDLES_EXAMINED = 1500
"""At most this many saddles of an image, the strongest, are examined, so that leaves and noise take
bounded time."""

_ANGLES = np.arange(16) * np.pi / 8
_CIRCLE = CIRCLE_RADIUS_PX * np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_TWICE = np.column_stack([np.cos(2 * _ANGLES), np.sin(2 * _ANGLES)]) / 16


class Saddles(NamedTuple):
    """Saddles of the grey levels that may be corners."""

    points: Array  # (N, 2), pixels
    # (N, 2), unit vectors, at twice the angle of the direction of the lighter sectors
    turns: Array

    def alike(self, one: NDArray[np.intp], other: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return True for each pair of saddles, by index, that may be neighbours on a board."""
        cosine = (self.turns[one] * self.turns[other]).sum(axis=-1)
        return np.asarray(cosine < -0.5)


def find_saddles(image: NDArray[np.uint8]) -> Saddles:
    """Return the corners that an image (H, W) may show."""
    cv2 = load("cv2")
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTHING_PX)
    xx, yy, xy = (
        cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=0.25)
        for order in ((2, 0), (0, 2), (1, 1))
    )
    bent = xy * xy - xx * yy
    highest = cv2.dilate(bent, np.ones((5, 5), np.uint8))
    peaks = (bent == highest) & (bent > MIN_CURVATURE)
    rim = int(CIRCLE_RADIUS_PX) + 1
    inside = peaks[rim:-rim, rim:-rim]
    v, u = np.divmod(np.flatnonzero(inside), inside.shape[1])
    at = np.column_stack([u, v]) + rim
    if len(at) > MAX_SADDLES_EXAMINED:
        strength = bent[at[:, 1], at[:, 0]]
        at = at[np.argpartition(strength, -MAX_SADDLES_EXAMINED)[-MAX_SADDLES_EXAMINED:]]
    if not len(at):
        return Saddles(np.zeros((0, 2)), np.zeros((0, 2)))
    ring = (at[:, None] + _CIRCLE).astype(np.float32)
    levels = cv2.remap(smooth, ring, None, cv2.INTER_LINEAR).astype(np.float64)
    turns = levels @ _TWICE
    swing = np.linalg.norm(turns, axis=1)
    good = _comes_twice(levels) & (swing > MIN_SWING)
    if good.sum() > MAX_SADDLES_KEPT:
        good &= swing >= np.partition(swing[good], -MAX_SADDLES_KEPT)[-MAX_SADDLES_KEPT]
    at = at[good]
    bends = np.stack([part[at[:, 1], at[:, 0]] for part in (xx, xy, xy, yy)], axis=1)
    return Saddles(at + _steps_to_saddles(smooth, at, bends), turns[good] / swing[good, None])


def _steps_to_saddles(smooth: Floats, at: NDArray[np.intp], bends: Array) -> Array:
    """Return the steps (N, 2), at most a pixel, from pixels to the saddles, where the slope is 0.

    ``bends`` (N, 4): second derivatives at the pixels.
    """
    u, v = at.T
    slopes = np.stack(
        [smooth[v, u + 1] - smooth[v, u - 1], smooth[v + 1, u] - smooth[v - 1, u]], axis=1
    )
    ways = np.linalg.solve(bends.reshape(-1, 2, 2), -slopes[:, :, None] / 2)[:, :, 0]
    return np.asarray(ways.clip(-1, 1), dtype=np.float64)


def _comes_twice(levels: Array) -> NDArray[np.bool_]:
    """Return True for each circle (N, 16) with two like halves, each of a dark and a light part."""
    first, opposite = levels[:, :8], levels[:, 8:]
    common, apart = (first + opposite) / 2, (first - opposite) / 2
    middle = (common.max(axis=1) + common.min(axis=1)) / 2
    light = common > middle[:, None]
    changes = (light != np.roll(light, 1, axis=1)).sum(axis=1)
    spread = common - common.mean(axis=1, keepdims=True)
    same = (apart**2).sum(axis=1) < MAX_ASYMMETRY * (spread**2).sum(axis=1)
    return np.asarray(same & (changes == 2))
