"""Choose the model of a plane's map (rigid to homography) that the touched points justify.

The rule, from the simplest model upwards: a more general model is chosen if its held-out error is
smaller, and if noise alone would reduce the sum of squared residuals by as much in fewer than three
of 1000 calibrations. A general model always fits better, but it must also predict better.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from smartcam.calibration._plane.fitting import MODELS, fit, held_out
from smartcam.calibration._statistics import Noise
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._plane.fitting import Fit, ModelName, Pairs
    from smartcam.geometry._inside import Array

SIGNIFICANCE_LEVEL = 0.003
"""Probability with which noise alone leads to a more general model. The value comes from a
simulation of nine touches in the middle third of a field: wrong choices cost 1 % of the error at
this level and 4 % at 0.01; both levels find a tilt of one degree."""

ROUNDING_RATIO = 1e-9
"""Residuals below this fraction of the points' extent are rounding errors, not noise."""


def sum_of_squares(residuals: Array, weights: Array) -> float:
    """Return the weighted sum of squares of residuals (N, 3)."""
    return float((weights[:, None] * residuals**2).sum())


def rms(residuals: Array, weights: Array) -> float:
    """Return the weighted RMS length of residuals (N, 3); NaN if one of them is NaN."""
    return math.sqrt(sum_of_squares(residuals, weights) / float(weights.sum()))


def touch_noise(sigma: float | None, squares: float, freedom: int) -> Noise | None:
    """Return the touches' noise from ``sigma`` or, if it is None, from a sum of squared residuals.

    ``freedom``: degrees of freedom of the sum; with 0 the result is None.
    """
    if sigma is not None:
        return Noise(max(sigma, ROUNDING_RATIO) ** 2)
    return Noise(max(squares / freedom, ROUNDING_RATIO**2), freedom) if freedom > 0 else None


class Candidates:
    """The fits of several models to the same points, with their predictions of left-out points.

    Args:
        pairs: the points.
        scale: nominal scale in the units of ``pairs``; None if it was not given: then there is no
            ``rigid``.
    """

    def __init__(self, pairs: Pairs, scale: float | None) -> None:
        self._pairs, self._scale = pairs, 1.0 if scale is None else scale
        self._fits: dict[ModelName, Fit | None] = {}
        self._held_out: dict[ModelName, Array] = {}
        self.names: list[ModelName] = [
            name
            for name, model in MODELS.items()
            if len(pairs.camera) >= model.min_points and (name != "rigid" or scale is not None)
        ]
        """Models for which there are enough points, the simplest first."""

    def get(self, name: ModelName) -> Fit | None:
        """Return a model's fit; None if the points do not determine it."""
        if name not in self._fits:
            try:
                self._fits[name] = fit(name, self._pairs, self._scale)
            except CalibrationError:
                self._fits[name] = None
        return self._fits[name]

    def held_out(self, fitted: Fit) -> Array:
        """Return each point minus the place that a fit of the others predicts, (N, 3)."""
        if fitted.model not in self._held_out:
            self._held_out[fitted.model] = held_out(fitted, self._pairs, self._scale)
        return self._held_out[fitted.model]

    def require(self, name: ModelName) -> Fit:
        """Return a model's fit; raise COLLINEAR if the points do not determine it."""
        return self.get(name) or fit(name, self._pairs, self._scale)

    def simplest_model(self) -> ModelName:
        """Return the simplest model that has a held-out error, or else ``similarity``."""
        first = self.names[0]
        return "similarity" if math.isnan(self.error(first)) else first

    def error(self, name: ModelName) -> float:
        """Return a model's held-out error; NaN if it has none."""
        fitted = self.get(name)
        return math.nan if fitted is None else rms(self.held_out(fitted), self._pairs.weights)

    def choose(self, sigma: float | None, start: ModelName) -> ModelName:
        """Return the model that the points justify: ``start`` or a more general one.

        ``sigma``: standard deviation of a touch, in the units of ``pairs``.
        """
        best = start
        for name in self.names[self.names.index(start) + 1 :]:
            current, general = self.get(best), self.get(name)
            if current is None or general is None:
                continue
            if fits_better(current, general, self._pairs.weights, sigma) and (
                self.error(name) < self.error(best)
            ):
                best = name
        return best

    def errors(self, names: Sequence[ModelName]) -> dict[ModelName, float]:
        """Return the held-out errors of models; NaN for a model without one."""
        return {name: self.error(name) for name in names}


def fits_better(simple: Fit, general: Fit, weights: Array, sigma: float | None) -> bool:
    """Return True if noise alone would hardly make ``general`` fit that much better."""
    simple_squares, general_squares = (
        sum_of_squares(simple.residuals, weights),
        sum_of_squares(general.residuals, weights),
    )
    noise = touch_noise(sigma, general_squares, general.freedom)
    if noise is None:
        return False
    return (
        noise.chance(max(simple_squares - general_squares, 0.0), simple.freedom - general.freedom)
        < SIGNIFICANCE_LEVEL
    )
