"""Test whether noise alone explains residuals, and whether offsets are one common shift."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from smartcam.geometry._inside import Array

MAX_MOVE_SPREAD: Final = 0.2
"""Offsets of left-out points are one common shift, which is reported, if none differs from their
mean by more than this fraction of the mean. Without this remark, calibrations were called good
although the sheet was pushed by 3 to 50 mm before the last two to four of nine touches, or by 20 mm
before the last three of fourteen views."""


class Noise(NamedTuple):
    """The variance of the noise of touched points or views, and its degrees of freedom."""

    variance: float  # variance of one coordinate, m^2
    # degrees of freedom of the estimate that the variance comes from; None if it was given
    freedom: int | None = None

    def chance(self, squares: float, count: float) -> float:
        """Return the p-value: the probability that noise gives ``squares`` (m^2) or more.

        ``squares``: sum of ``count`` squared residuals. This is a chi-square test
        if the variance was given, and an F-test if it was estimated from other squares.
        """
        special = load("scipy.special")
        if self.freedom is None:
            return float(special.chdtrc(count, squares / self.variance))
        return float(special.fdtrc(count, self.freedom, squares / count / self.variance))


def normal_deviations(chance: float | Array) -> float:
    """Convert a probability to the number of standard deviations that is as unlikely."""
    return float(-load("scipy.special").ndtri(0.5 * max(float(chance), 1e-300)))


def common_move(offsets: Array) -> Array | None:
    """Return the mean of two or more offsets (N, K) if they are nearly the same, else None."""
    if len(offsets) < 2:
        return None
    mean: Array = offsets.mean(axis=0)
    distances = np.linalg.norm(offsets - mean, axis=1)
    is_common = float(distances.max()) < MAX_MOVE_SPREAD * float(np.linalg.norm(mean))
    return mean if is_common else None
