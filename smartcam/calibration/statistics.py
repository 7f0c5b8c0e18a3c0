"""How likely a sum of squares is, where nothing but the touches' noise is at work."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from smartcam.calibration.optional_imports import load

if TYPE_CHECKING:
    from smartcam.calibration.geometry.rotations import Array

__all__ = ["Noise", "normal_deviations"]


class Noise(NamedTuple):
    """What is known of the touches' noise.

    Attributes:
        variance: of one coordinate, m^2.
        freedom: of the estimate that it comes from; None where it was given.
    """

    variance: float
    freedom: int | None = None

    def chance(self, squares: float, count: int) -> float:
        """Return how likely noise alone gives ``squares`` (m^2) or more.

        Args:
            squares: sum of ``count`` independent squares.
            count: how many of them, 1 or more.

        Returns:
            0 to 1: of a chi-square test where the variance was given, of an F-test where it is an
            estimate from other squares.
        """
        special = load("scipy.special")
        if self.freedom is None:
            return float(special.chdtrc(count, squares / self.variance))
        return float(special.fdtrc(count, self.freedom, squares / count / self.variance))


def normal_deviations(chance: float | Array) -> float:
    """Return how many standard deviations of a normal distribution are as unlikely, both sides."""
    return float(-load("scipy.special").ndtri(0.5 * max(float(chance), 1e-300)))
