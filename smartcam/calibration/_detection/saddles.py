"""Find saddles of the grey levels, at which four squares may meet.

Around a corner of a checkerboard two dark sectors lie opposite each other between two light ones.
Its grey levels are a saddle there, and along a circle around it they go up
and down twice, the same in both halves. The direction of the light sectors shows which
saddles are neighbours on a board: it is turned by 90 degrees from each corner to the next,
in every view of the sheet.
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
"""Radius, pixels, of the circle around a saddle along which grey levels are tested; the circle fits
into squares of seven pixels."""

MIN_SWING = 1.0
"""Along the circle, the grey levels of a corner swing by at least this many."""

MAX_ASYMMETRY = 0.35
"""The squared difference between a circle's halves is at most this fraction of the squared swing of
their mean."""

MAX_SADDLES_KEPT = 600
"""At most this many saddles that look like a corner are kept, the strongest ones."""

MAX_SADDLES_EXAMINED = 1500
"""At most this many saddles of an image, the strongest, are examined, which limits the time for
pictures of leaves or noise."""

_ANGLES = np.arange(16) * np.pi / 8
_CIRCLE = CIRCLE_RADIUS_PX * np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_DOUBLED_ANGLES = np.column_stack([np.cos(2 * _ANGLES), np.sin(2 * _ANGLES)]) / 16


class Saddles(NamedTuple):
    """Saddles of the grey levels that may be corners."""

    points: Array  # (N, 2), pixels
    # (N, 2), unit vectors, at twice the angle of the direction of the light sectors
    doubled_directions: Array

    def may_be_neighbours(
        self, first: NDArray[np.intp], second: NDArray[np.intp]
    ) -> NDArray[np.bool_]:
        """Return a mask of the pairs of saddles, by index, that may be neighbours on a board."""
        cosine = (self.doubled_directions[first] * self.doubled_directions[second]).sum(axis=-1)
        return np.asarray(cosine < -0.5)


def find_saddles(image: NDArray[np.uint8]) -> Saddles:
    """Return the saddles of an image (H, W) that look like corners of squares."""
    cv2 = load("cv2")
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTHING_PX)
    xx, yy, xy = (
        cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3, scale=0.25)
        for order in ((2, 0), (0, 2), (1, 1))
    )
    curvature = xy * xy - xx * yy
    local_maximum = cv2.dilate(curvature, np.ones((5, 5), np.uint8))
    is_peak = (curvature == local_maximum) & (curvature > MIN_CURVATURE)
    rim = int(CIRCLE_RADIUS_PX) + 1
    is_inner_peak = is_peak[rim:-rim, rim:-rim]
    v, u = np.divmod(np.flatnonzero(is_inner_peak), is_inner_peak.shape[1])
    pixels = np.column_stack([u, v]) + rim
    if len(pixels) > MAX_SADDLES_EXAMINED:
        strength = curvature[pixels[:, 1], pixels[:, 0]]
        pixels = pixels[np.argpartition(strength, -MAX_SADDLES_EXAMINED)[-MAX_SADDLES_EXAMINED:]]
    if not len(pixels):
        return Saddles(np.zeros((0, 2)), np.zeros((0, 2)))
    ring = (pixels[:, None] + _CIRCLE).astype(np.float32)
    levels = cv2.remap(smooth, ring, None, cv2.INTER_LINEAR).astype(np.float64)
    waves = levels @ _DOUBLED_ANGLES
    swing = np.linalg.norm(waves, axis=1)
    is_corner = _has_two_periods(levels) & (swing > MIN_SWING)
    if is_corner.sum() > MAX_SADDLES_KEPT:
        is_corner &= swing >= np.partition(swing[is_corner], -MAX_SADDLES_KEPT)[-MAX_SADDLES_KEPT]
    pixels = pixels[is_corner]
    second_derivatives = np.stack(
        [derivative[pixels[:, 1], pixels[:, 0]] for derivative in (xx, xy, xy, yy)], axis=1
    )
    return Saddles(
        pixels + _steps_to_saddles(smooth, pixels, second_derivatives),
        waves[is_corner] / swing[is_corner, None],
    )


def _steps_to_saddles(smooth: Floats, pixels: NDArray[np.intp], second_derivatives: Array) -> Array:
    """Return the steps (N, 2) from pixels to the next saddles, at most a pixel along u and v each.

    ``second_derivatives`` (N, 4): of the grey levels at the pixels.
    """
    u, v = pixels.T
    slopes = np.stack(
        [smooth[v, u + 1] - smooth[v, u - 1], smooth[v + 1, u] - smooth[v - 1, u]], axis=1
    )
    steps = np.linalg.solve(second_derivatives.reshape(-1, 2, 2), -slopes[:, :, None] / 2)[:, :, 0]
    return np.asarray(steps.clip(-1, 1), dtype=np.float64)


def _has_two_periods(levels: Array) -> NDArray[np.bool_]:
    """Return a mask of circles (N, 16) with equal halves, each of one dark and one light part."""
    first, opposite = levels[:, :8], levels[:, 8:]
    mean, difference = (first + opposite) / 2, (first - opposite) / 2
    threshold = (mean.max(axis=1) + mean.min(axis=1)) / 2
    is_light = mean > threshold[:, None]
    change_count = (is_light != np.roll(is_light, 1, axis=1)).sum(axis=1)
    swing = mean - mean.mean(axis=1, keepdims=True)
    is_periodic = (difference**2).sum(axis=1) < MAX_ASYMMETRY * (swing**2).sum(axis=1)
    return np.asarray(is_periodic & (change_count == 2))
