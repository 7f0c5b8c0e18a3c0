"""Compute the probability of a sum of squares where only the touches' noise is at work."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from smartcam._extras import load

if TYPE_CHECKING:
    from smartcam.geometry._inside import Array


class Noise(NamedTuple):
    """The variance of the touches' noise, and how well it is known."""

    variance: float  # of one coordinate, m^2
    freedom: int | None = None  # of the estimate that it comes from; None where it was given

    def chance(self, squares: float, count: float) -> float:
        """Return the probability that noise alone gives ``squares`` (m^2, of ``count``) or more.

        Of a chi-square test where the variance was given, of an F-test where it is an estimate from
        other squares.
        """
        special = load("scipy.special")
        if self.freedom is None:
            return float(special.chdtrc(count, squares / self.variance))
        return float(special.fdtrc(count, self.freedom, squares / count / self.variance))


def normal_deviations(chance: float | Array) -> float:
    """Return the number of standard deviations of a normal distribution that is as unlikely."""
    return float(-load("scipy.special").ndtri(0.5 * max(float(chance), 1e-300)))
