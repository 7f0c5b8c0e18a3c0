"""Fit blurred steps to the pixels of many strips at once.

The fitted model is a step between two grey levels, blurred by a Gaussian of width ``s``, as the
lens does, and averaged over the area of square pixels. A pixel's area, projected along an edge at
an angle, has the profile of a trapezoid: the convolution of two boxes whose widths are the sine and
the cosine of the angle. The share of a pixel that lies after a step at distance d is this trapezoid
convolved with the Gaussian's integral. It has a closed form: differences of the Gaussian's second
integral.

The fit is by Levenberg and Marquardt. Its covariance is the Cramer-Rao bound with the noise of the
residuals; no unbiased estimate can be better.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array
    from smartcam.inspection._measure.strips import StripPixels

MIN_BLUR_PX = 0.05
"""Least blur of a fit, pixels: no lens is sharper, and 0 would be a divisor."""

MAX_BLUR_PX = 20.0
"""Largest blur of a fit, pixels."""

MAX_TILT = 0.7
"""Largest tangent of the angle between a step and the line across its strip."""

MAX_ITERATIONS = 25
"""Largest number of iterations of a fit; most fits take four to eight."""

CONVERGED_PX = 1e-4
"""Largest change of places and blur, pixels, and of the tilt, in the last iteration of a fit."""

MIN_SIDE_PX = 1e-3
"""Least width of a projected pixel, pixels; 0 would be a divisor."""

START_BLURS_PX = (0.4, 0.8, 1.6, 3.2, 5.0)
"""Blurs, pixels, that are tried as the start of a fit."""


class StepFits(NamedTuple):
    """Fits of K steps in each of N strips.

    The values of a strip are K places, the common tangent of the tilt, the common blur, K heights,
    and the level before the first step.
    """

    values: Array  # (N, 2 K + 3)
    cost: Array  # (N,), sum of the squared residuals
    hessian: Array  # (N, M, M)
    counts: Array  # (N,), number of pixels
    converged: NDArray[np.bool_]  # (N,), whether the fit ended within MAX_ITERATIONS

    @property
    def step_count(self) -> int:
        """Number of steps in each strip, K."""
        return (int(self.values.shape[1]) - 3) // 2

    @property
    def places(self) -> Array:
        """Places along the strips, (N, K), pixels."""
        return self.values[:, : self.step_count]

    @property
    def tilts(self) -> Array:
        """Tangents (N,) of the angle between an edge and the line across its strip."""
        tilts: Array = self.values[:, self.step_count]
        return tilts

    @property
    def blurs(self) -> Array:
        """Blurs of the lens (N,), pixels, without the pixels' area."""
        blurs: Array = self.values[:, self.step_count + 1]
        return blurs

    @property
    def heights(self) -> Array:
        """Grey levels after minus before each step, (N, K)."""
        return self.values[:, self.step_count + 2 : -1]

    @property
    def freedom(self) -> Array:
        """Degrees of freedom (N,), at least 1."""
        freedom: Array = np.maximum(self.counts - self.values.shape[1], 1.0)
        return freedom

    @property
    def variance(self) -> Array:
        """Variance of a pixel from the residuals, (N,)."""
        variance: Array = self.cost / self.freedom
        return variance

    def unit_covariance(self) -> Array:
        """Return the covariance (N, M, M) for pixels with a variance of 1."""
        scale = np.sqrt(np.maximum(np.einsum("nii->ni", self.hessian), 1e-30))
        unit = self.hessian / scale[:, :, None] / scale[:, None]
        inverse = np.linalg.inv(unit + 1e-12 * np.eye(unit.shape[1]))
        covariance: Array = inverse / scale[:, :, None] / scale[:, None]
        return covariance


def share_after_step(
    distance: Array, blur: Array, sides: tuple[Array, Array]
) -> tuple[Array, Array, Array]:
    """Return the shares of pixels that lie after a step, with derivatives by distance and blur."""
    # With the trapezoid of half widths p = (a + b) / 2 and m = (a - b) / 2 the share is
    #     [R(d + p) - R(d + m) - R(d - m) + R(d - p)] / (a b),
    # R'' = F, the Gaussian's distribution: R = ((x^2 + s^2) F + s x f) / 2, R' = x F + s f, with f
    # the normal density at x / s. By the heat equation the derivative by s is s times the second
    # one by d, so the same difference of F.
    ndtr = load("scipy.special").ndtr
    first, second = sides
    outer, inner = (first + second) / 2, (first - second) / 2
    square = blur * blur
    value = slope = bend = 0.0
    for sign, at in (
        (1.0, distance + outer),
        (-1.0, distance + inner),
        (-1.0, distance - inner),
        (1.0, distance - outer),
    ):
        normalized = at / blur
        cumulative = ndtr(normalized)
        density = blur / math.sqrt(2 * math.pi) * np.exp(-0.5 * normalized * normalized)
        integral = at * cumulative + density
        value = value + sign * 0.5 * (square * cumulative + at * integral)
        slope = slope + sign * integral
        bend = bend + sign * cumulative
    area = first * second
    return value / area, slope / area, blur * bend / area


def fit_steps(
    pixels: StripPixels, places: Array, *, tilted: bool, blurs: Array | None = None
) -> StepFits:
    """Return the best fit of steps from start places (N, K) that may be wrong by a pixel or two.

    ``tilted``: whether the tilt is fitted, too; else it is 0. ``blurs`` (N,): approximate blurs;
    None: several are tried.
    """
    step_count = places.shape[1]
    starts = START_BLURS_PX if blurs is None else (blurs,)
    free = np.ones(2 * step_count + 3, dtype=np.bool_)
    free[step_count] = tilted
    return _fit_from(pixels, _best_start(pixels, places, starts), free)


def _best_start(pixels: StripPixels, places: Array, starts: Sequence[float | Array]) -> Array:
    """Return start values (N, M): the blur of ``starts`` that fits best, and fitted heights."""
    strip_count, step_count = places.shape
    best = np.zeros((strip_count, 2 * step_count + 3))
    min_cost = np.full(strip_count, np.inf)
    for blur in starts:
        values = np.zeros_like(best)
        values[:, :step_count], values[:, step_count + 1] = places, blur
        cost, hessian, gradient = _normal_equations(pixels, values)
        linear = slice(step_count + 2, None)
        ridge = 1e-9 * np.maximum(pixels.counts, 1.0)[:, None, None] * np.eye(step_count + 1)
        solution = np.linalg.solve(hessian[:, linear, linear] + ridge, gradient[:, linear, None])
        values[:, linear] = solution[:, :, 0]
        cost = cost - np.einsum("nm,nm->n", gradient[:, linear], solution[:, :, 0])
        better = cost < min_cost
        best[better], min_cost[better] = values[better], cost[better]
    return best


def _normal_equations(pixels: StripPixels, values: Array) -> tuple[Array, Array, Array]:
    """Return the cost (N,), the hessian (N, M, M) and the gradient (N, M) at values."""
    step_count = (values.shape[1] - 3) // 2
    tilt, blur = values[:, [step_count]], values[:, [step_count + 1]]
    cosine = 1 / np.sqrt(1 + tilt * tilt)
    sides = _sides(pixels.directions, tilt, cosine)
    columns = np.empty((len(values), values.shape[1], pixels.along.shape[1]))
    columns[:, step_count : step_count + 2] = 0.0
    model = values[:, [-1]] + np.zeros_like(pixels.along)
    for k in range(step_count):
        offset = pixels.along - values[:, [k]] - tilt * pixels.across
        share, slope, by_blur = share_after_step(cosine * offset, blur, sides)
        height = values[:, [step_count + 2 + k]]
        columns[:, k] = -height * cosine * slope
        # d = cosine (along - place - tilt across) with cosine = (1 + tilt^2)^-1/2
        columns[:, step_count] += (
            height * slope * cosine * (-pixels.across - cosine * cosine * tilt * offset)
        )
        columns[:, step_count + 1] += height * by_blur
        columns[:, step_count + 2 + k] = share
        model += height * share
    columns[:, -1] = 1.0
    columns *= pixels.weights[:, None]
    residuals = (pixels.levels - model) * pixels.weights
    hessian = columns @ columns.transpose(0, 2, 1)
    gradient = (columns @ residuals[:, :, None])[:, :, 0]
    return np.einsum("np,np->n", residuals, residuals), hessian, gradient


def _sides(directions: Array, tilt: Array, cosine: Array) -> tuple[Array, Array]:
    """Return the widths (N, P) of the two boxes of pixels, projected along a tilted edge."""
    u, v = directions[..., 0], directions[..., 1]
    return (
        np.maximum(np.abs(cosine * (u + tilt * v)), MIN_SIDE_PX),
        np.maximum(np.abs(cosine * (v - tilt * u)), MIN_SIDE_PX),
    )


def _fit_from(pixels: StripPixels, values: Array, free: NDArray[np.bool_]) -> StepFits:
    strip_count, size = values.shape
    step_count = (size - 3) // 2
    cost, hessian, gradient = _normal_equations(pixels, values)
    active = np.arange(strip_count)
    damping = np.full(strip_count, 1e-3)
    converged = np.zeros(strip_count, dtype=np.bool_)
    active_pixels = pixels
    fixed = np.flatnonzero(~free)
    for _ in range(MAX_ITERATIONS):
        slope, curve = gradient[active].copy(), hessian[active].copy()
        slope[:, fixed] = 0.0
        curve[:, fixed, :] = 0.0
        curve[:, :, fixed] = 0.0
        diagonal = np.einsum("nii->ni", curve).copy()
        diagonal[:, fixed] = 1.0
        diagonal = np.maximum(diagonal, 1e-12)
        scale = np.sqrt(diagonal)
        unit = curve / scale[:, :, None] / scale[:, None]
        unit += (damping[active, None] + 1e-12)[:, :, None] * np.eye(size)
        move = np.linalg.solve(unit, (slope / scale)[:, :, None])[:, :, 0] / scale
        trial = values[active] + move
        trial[:, step_count] = trial[:, step_count].clip(-MAX_TILT, MAX_TILT)
        trial[:, step_count + 1] = trial[:, step_count + 1].clip(MIN_BLUR_PX, MAX_BLUR_PX)
        tried = _normal_equations(active_pixels, trial)
        better = tried[0] <= cost[active] * (1 + 1e-12)
        moved = np.abs(trial - values[active])[:, : step_count + 2].max(axis=1)
        chosen = active[better]
        values[chosen], cost[chosen] = trial[better], tried[0][better]
        hessian[chosen], gradient[chosen] = tried[1][better], tried[2][better]
        damping[active] *= np.where(better, 0.1, 10.0)
        is_finished = (moved < CONVERGED_PX) | (damping[active] > 1e8)
        converged[active[is_finished]] = True
        if is_finished.any():
            active, active_pixels = active[~is_finished], active_pixels.selected(~is_finished)
        if not len(active):
            break
    if fixed.size:
        hessian[:, fixed, :] = 0.0
        hessian[:, :, fixed] = 0.0
        hessian[:, fixed, fixed] = 1.0
    return StepFits(values, cost, hessian, pixels.counts, converged)
