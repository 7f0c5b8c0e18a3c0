"""Compute the probability that the touches' noise alone causes a sum of squares."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from smartcam._extras import load

if TYPE_CHECKING:
    from smartcam.geometry._inside import Array


class Noise(NamedTuple):
    """The variance of the touches' noise, and its degrees of freedom."""

    variance: float  # variance of one coordinate, m^2
    # degrees of freedom of the estimate that the variance comes from; None if it was given
    freedom: int | None = None

    def chance(self, squares: float, count: float) -> float:
        """Return the probability that noise alone gives ``squares`` (m^2, of ``count``) or more.

        This is a chi-square test if the variance was given, and an F-test if it was estimated from
        other squares.
        """
        special = load("scipy.special")
        if self.freedom is None:
            return float(special.chdtrc(count, squares / self.variance))
        return float(special.fdtrc(count, self.freedom, squares / count / self.variance))


def normal_deviations(chance: float | Array) -> float:
    """Convert a probability to the number of standard deviations that is as unlikely."""
    return float(-load("scipy.special").ndtri(0.5 * max(float(chance), 1e-300)))
