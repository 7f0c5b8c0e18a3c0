"""Fit blurred steps to the pixels of many strips, side by side.

A step from one grey level to another one, seen by a lens that blurs by a Gaussian of width ``s``,
and by square pixels that take the mean over their own area. Seen from the side at an angle, a pixel
is a trapezoid: two boxes, as wide as the sine and the cosine of the angle, one over the other. The
share of a pixel that lies behind a step at a distance d is the Gaussian's integral under that
trapezoid, which has a closed form: differences of the Gaussian's second integral.

The fit is one of Levenberg and Marquardt. Its covariance is that of the Cramer-Rao bound with the
noise that the residuals show; no estimate without a bias can be better.
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
"""Pixels of blur that a fit may have at least: no lens is sharper, and 0 would be divided by."""

MAX_BLUR_PX = 20.0
"""Pixels of blur that a fit may have at most."""

MAX_TILT = 0.7
"""Tangent of the angle to which a step may be turned out of its strip."""

MAX_STEPS = 25
"""Largest number of steps of a fit; most fits take four to eight."""

STILL_PX = 1e-4
"""A fit ends when a step moves places by at most this many pixels."""

MIN_SIDE_PX = 1e-3
"""Pixels that a pixel is wide at least, seen along an edge; 0 would be divided by."""

STARTS_PX = (0.4, 0.8, 1.6, 3.2, 5.0)
"""Pixels of blur that are tried before a fit; the best one begins it."""


class StepFits(NamedTuple):
    """K steps in each of N strips.

    The values are the K places, the tangent of the tilt that the steps of a strip share, their
    blur, K heights, and the level before the first step.
    """

    values: Array  # (N, 2 K + 3)
    cost: Array  # (N,), sum of the squared residuals
    hessian: Array  # (N, M, M)
    counts: Array  # (N,), pixels
    settled: NDArray[np.bool_]  # (N,), whether it came to rest

    @property
    def steps(self) -> int:
        """Number of steps in each strip, K."""
        return (int(self.values.shape[1]) - 3) // 2

    @property
    def places(self) -> Array:
        """(N, K), along the strips, pixels."""
        return self.values[:, : self.steps]

    @property
    def tilts(self) -> Array:
        """(N,), tangents of the angle between an edge and the line across its strip."""
        tilts: Array = self.values[:, self.steps]
        return tilts

    @property
    def blurs(self) -> Array:
        """(N,), pixels; the pixels' own area is not in it."""
        blurs: Array = self.values[:, self.steps + 1]
        return blurs

    @property
    def heights(self) -> Array:
        """(N, K), grey levels behind each step less those before it."""
        return self.values[:, self.steps + 2 : -1]

    @property
    def freedom(self) -> Array:
        """(N,), pixels less values, 1 at least."""
        freedom: Array = np.maximum(self.counts - self.values.shape[1], 1.0)
        return freedom

    @property
    def variance(self) -> Array:
        """(N,), of a pixel, as the residuals show it."""
        variance: Array = self.cost / self.freedom
        return variance

    def unit_covariance(self) -> Array:
        """Return the covariance (N, M, M) for pixels with a variance of 1."""
        scale = np.sqrt(np.maximum(np.einsum("nii->ni", self.hessian), 1e-30))
        unit = self.hessian / scale[:, :, None] / scale[:, None]
        inverse = np.linalg.inv(unit + 1e-12 * np.eye(unit.shape[1]))
        covariance: Array = inverse / scale[:, :, None] / scale[:, None]
        return covariance


def share(distance: Array, blur: Array, sides: tuple[Array, Array]) -> tuple[Array, Array, Array]:
    """Return the share of pixels behind a step, and its derivatives by distance and by blur."""
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
        part = at / blur
        below = ndtr(part)
        density = blur / math.sqrt(2 * math.pi) * np.exp(-0.5 * part * part)
        rise = at * below + density
        value = value + sign * 0.5 * (square * below + at * rise)
        slope = slope + sign * rise
        bend = bend + sign * below
    area = first * second
    return value / area, slope / area, blur * bend / area


def fit_steps(
    pixels: StripPixels, places: Array, *, tilted: bool, blurs: Array | None = None
) -> StepFits:
    """Return the steps (N, K) that fit best, from places (N, K) that are known to a pixel or two.

    ``tilted``: whether the tilt is fitted, too; else it is 0. ``blurs`` (N,): where those are known
    roughly; None: several are tried.
    """
    steps = places.shape[1]
    starts = STARTS_PX if blurs is None else (blurs,)
    free = np.ones(2 * steps + 3, dtype=np.bool_)
    free[steps] = tilted
    return _solve(pixels, _best_start(pixels, places, starts), free)


def _best_start(pixels: StripPixels, places: Array, starts: Sequence[float | Array]) -> Array:
    """Return the values (N, M) at one of several blurs, with the heights that fit best."""
    number, steps = places.shape
    best = np.zeros((number, 2 * steps + 3))
    least = np.full(number, np.inf)
    for blur in starts:
        values = np.zeros_like(best)
        values[:, :steps], values[:, steps + 1] = places, blur
        cost, hessian, gradient = _normal_equations(pixels, values)
        linear = slice(steps + 2, None)
        ridge = 1e-9 * np.maximum(pixels.counts, 1.0)[:, None, None] * np.eye(steps + 1)
        found = np.linalg.solve(hessian[:, linear, linear] + ridge, gradient[:, linear, None])
        values[:, linear] = found[:, :, 0]
        cost = cost - np.einsum("nm,nm->n", gradient[:, linear], found[:, :, 0])
        better = cost < least
        best[better], least[better] = values[better], cost[better]
    return best


def _normal_equations(pixels: StripPixels, values: Array) -> tuple[Array, Array, Array]:
    """Return the cost (N,), the hessian (N, M, M) and the gradient (N, M) at values."""
    steps = (values.shape[1] - 3) // 2
    tilt, blur = values[:, [steps]], values[:, [steps + 1]]
    cosine = 1 / np.sqrt(1 + tilt * tilt)
    sides = _sides(pixels.ahead, tilt, cosine)
    columns = np.empty((len(values), values.shape[1], pixels.along.shape[1]))
    columns[:, steps : steps + 2] = 0.0
    model = values[:, [-1]] + np.zeros_like(pixels.along)
    for k in range(steps):
        off = pixels.along - values[:, [k]] - tilt * pixels.beside
        part, slope, by_blur = share(cosine * off, blur, sides)
        height = values[:, [steps + 2 + k]]
        columns[:, k] = -height * cosine * slope
        # d = cosine (along - place - tilt beside) with cosine = (1 + tilt^2)^-1/2
        columns[:, steps] += (
            height * slope * cosine * (-pixels.beside - cosine * cosine * tilt * off)
        )
        columns[:, steps + 1] += height * by_blur
        columns[:, steps + 2 + k] = part
        model += height * part
    columns[:, -1] = 1.0
    columns *= pixels.weights[:, None]
    residuals = (pixels.levels - model) * pixels.weights
    hessian = columns @ columns.transpose(0, 2, 1)
    gradient = (columns @ residuals[:, :, None])[:, :, 0]
    return np.einsum("np,np->n", residuals, residuals), hessian, gradient


def _sides(ahead: Array, tilt: Array, cosine: Array) -> tuple[Array, Array]:
    """Return the widths (N, P) of the two boxes that pixels are, seen along a tilted edge."""
    u, v = ahead[..., 0], ahead[..., 1]
    return (
        np.maximum(np.abs(cosine * (u + tilt * v)), MIN_SIDE_PX),
        np.maximum(np.abs(cosine * (v - tilt * u)), MIN_SIDE_PX),
    )


def _solve(pixels: StripPixels, values: Array, free: NDArray[np.bool_]) -> StepFits:
    number, size = values.shape
    steps = (size - 3) // 2
    cost, hessian, gradient = _normal_equations(pixels, values)
    active = np.arange(number)
    damping = np.full(number, 1e-3)
    settled = np.zeros(number, dtype=np.bool_)
    part = pixels
    held = np.flatnonzero(~free)
    for _ in range(MAX_STEPS):
        slope, curve = gradient[active].copy(), hessian[active].copy()
        slope[:, held] = 0.0
        curve[:, held, :] = 0.0
        curve[:, :, held] = 0.0
        diagonal = np.einsum("nii->ni", curve).copy()
        diagonal[:, held] = 1.0
        diagonal = np.maximum(diagonal, 1e-12)
        scale = np.sqrt(diagonal)
        unit = curve / scale[:, :, None] / scale[:, None]
        unit += (damping[active, None] + 1e-12)[:, :, None] * np.eye(size)
        move = np.linalg.solve(unit, (slope / scale)[:, :, None])[:, :, 0] / scale
        trial = values[active] + move
        trial[:, steps] = trial[:, steps].clip(-MAX_TILT, MAX_TILT)
        trial[:, steps + 1] = trial[:, steps + 1].clip(MIN_BLUR_PX, MAX_BLUR_PX)
        tried = _normal_equations(part, trial)
        better = tried[0] <= cost[active] * (1 + 1e-12)
        moved = np.abs(trial - values[active])[:, : steps + 2].max(axis=1)
        chosen = active[better]
        values[chosen], cost[chosen] = trial[better], tried[0][better]
        hessian[chosen], gradient[chosen] = tried[1][better], tried[2][better]
        damping[active] *= np.where(better, 0.1, 10.0)
        still = (moved < STILL_PX) | (damping[active] > 1e8)
        settled[active[still]] = True
        if still.any():
            active, part = active[~still], part.some(~still)
        if not len(active):
            break
    if held.size:
        hessian[:, held, :] = 0.0
        hessian[:, :, held] = 0.0
        hessian[:, held, held] = 1.0
    return StepFits(values, cost, hessian, pixels.counts, settled)
