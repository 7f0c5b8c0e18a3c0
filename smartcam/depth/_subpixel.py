"""Refine disparities to subpixel precision by least squares, with their sigma."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Field = NDArray[np.floating[Any]]

MIN_COARSE_SIGMA_PX: Final = 0.5
"""Least sigma of a disparity that least squares could not refine, pixels."""

MAX_GAUSS_NEWTON_STEPS: Final = 3
"""Largest number of steps of Gauss and Newton that refine the disparities."""

MAX_LAST_MOVE_SIGMAS: Final = 1.0
"""RMS change of the disparities by a step, in sigmas, below which the fit ends: another step would
change them by about a tenth of it."""

MAX_SHIFT_PX: Final = 0.5
"""Largest change of a disparity, pixels: a larger change leads to another point."""

MAX_ROUGHNESS_PX: Final = 0.5
"""Largest RMS distance, pixels, of coarse disparities from a plane; if it is larger, there is an
edge in the window."""

MIN_FILLED_SHARE: Final = 0.5
"""Least share of a window's pixels that must have disparities."""

HOLE_MARGIN_PX: Final = 2
"""Distance from a hole, pixels, within which disparities are not refined."""

MIN_VARIANCE: Final = 1 / 6
"""Least variance of the difference of two pictures, whose grey levels are whole numbers."""

MAX_INLIER_SIGMAS: Final = 4.0
"""Difference above which a pixel is an outlier, in standard deviations of its noise."""

MIDDLE_GREY: Final = 128
"""Grey level that is subtracted, so that squares keep their precision."""

MIN_WINDOW_PIXELS: Final = 12
"""Least number of pixels of a window, whose least squares have two unknowns."""

GAIN_SIGMA: Final = 0.3
"""Prior standard deviation of the gain between the pictures around 1."""

MAX_NOISE_LAG_PX: Final = 2
"""Largest distance, in pixels, at which the noise is checked for correlation."""

MIN_NOISE_FACTOR: Final = 0.2
"""Least factor by which correlated noise changes a variance."""


def refine_disparities(
    left: NDArray[np.uint8], right: NDArray[np.uint8], coarse: NDArray[np.float32], window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return disparities and their sigma, both (H, W), NaN where ``coarse`` is NaN.

    In a window the disparity is a plane, and the brightness of the pictures differs by a constant
    and a factor: exposures, gains and the shade of lenses differ. If a window has an edge in it or
    too little texture, or if the result differs too much, the coarse value is kept. Its sigma is
    ``MIN_COARSE_SIGMA_PX``, or the roughness of the window if the roughness is larger.
    """
    known = np.isfinite(coarse)
    sigma = np.where(known, np.float32(MIN_COARSE_SIGMA_PX), np.float32(np.nan))
    if not window or not known.any():
        return coarse, sigma
    sums = _WindowSums(window)
    pictures = left.astype(np.float32), right.astype(np.float32)
    initial = np.where(known, coarse, np.float32(0))
    plane = _fit_planes(initial, known, sums)
    is_refinable = (plane.roughness <= MAX_ROUGHNESS_PX) & (
        plane.pixels >= MIN_FILLED_SHARE * window**2
    )
    is_refinable &= _find_far_from_holes(known)
    # near an edge, a coarse value may belong to the other side of the edge
    found_sigma = np.fmax(sigma, plane.roughness)
    disparity, is_refined = initial, known
    fit = _gauss_newton_step(_linearize(pictures, disparity, known), disparity, None, plane, sums)
    for step in range(MAX_GAUSS_NEWTON_STEPS):
        is_last = step == MAX_GAUSS_NEWTON_STEPS - 1
        if step:
            plane = _fit_planes(disparity, is_refined if is_refined.any() else known, sums)
            linear = _drop_outliers(_linearize(pictures, disparity, known), fit)
            fit = _gauss_newton_step(linear, disparity, is_refined, plane, sums)
            is_last = is_last or _relative_move(fit, disparity, is_refined) < MAX_LAST_MOVE_SIGMAS
        if is_last:
            fit = fit._replace(
                sigma=fit.sigma * np.float32(np.sqrt(_correlation_factor(fit, is_refined)))
            )
        is_refined = (
            is_refinable
            & (fit.sigma < MIN_COARSE_SIGMA_PX)
            & (np.abs(fit.disparity - initial) < MAX_SHIFT_PX)
        )
        disparity = np.where(is_refined, fit.disparity, initial)
        if is_last:
            break
    found_sigma = np.where(is_refined, fit.sigma, found_sigma)
    disparity[~known] = np.nan
    found_sigma[~known] = np.nan
    return disparity.astype(np.float32, copy=False), found_sigma.astype(np.float32, copy=False)


def _relative_move(fit: _RefinedDisparity, before: Field, is_refined: NDArray[np.bool_]) -> float:
    """Return the RMS change of the usable disparities by a step, in sigmas."""
    moves = (fit.disparity - before)[is_refined] / fit.sigma[is_refined]
    return float(np.sqrt((moves**2).mean())) if len(moves) else 0.0


def _find_far_from_holes(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask of the pixels without a hole nearby; edges of near objects have holes."""
    neighbourhood = np.ones((2 * HOLE_MARGIN_PX + 1, 2 * HOLE_MARGIN_PX + 1), np.uint8)
    return np.asarray(load("cv2").erode(known.astype(np.uint8), neighbourhood) > 0)


class _WindowSums:
    """Sums over the window around each pixel; pixels outside of the picture count as 0."""

    def __init__(self, side: int) -> None:
        self._cv2 = load("cv2")
        self._side = (side, side)
        self._ramp = np.arange(side, dtype=np.float32) - side // 2
        self._border = self._cv2.BORDER_CONSTANT

    def __call__(self, values: Field, x_power: int = 0, y_power: int = 0) -> Field:
        """Return sums of values, each times its offset from the window's middle to a power.

        ``x_power`` and ``y_power``: powers of the horizontal and the vertical offset.
        """
        if not (x_power or y_power):
            summed = self._cv2.boxFilter(
                values, -1, self._side, normalize=False, borderType=self._border
            )
        else:
            x, y = self._ramp**x_power, self._ramp**y_power
            summed = self._cv2.sepFilter2D(values, -1, x, y, borderType=self._border)
        return np.asarray(summed, dtype=np.float32)


class _DisparityPlane(NamedTuple):
    """The disparities in each window, as a plane; all are (H, W)."""

    slope_x: Field  # pixels per pixel
    slope_y: Field
    roughness: Field  # RMS distance of the disparities from the plane, pixels
    pixels: Field  # number of pixels with a disparity


def _fit_planes(disparity: Field, known: NDArray[np.bool_], sums: _WindowSums) -> _DisparityPlane:
    mask = known.astype(np.float32)
    # values near 0 keep the precision of the squares below
    values = (disparity - disparity.mean(where=known, dtype=np.float64).astype(np.float32)) * mask
    count = np.maximum(sums(mask), 1)
    total = sums(values)
    residual_squares = sums(values * values) - total * total / count
    x, y = sums(mask, 1, 0), sums(mask, 0, 1)
    xx = np.maximum(sums(mask, 2, 0) - x * x / count, 1)
    yy = np.maximum(sums(mask, 0, 2) - y * y / count, 1)
    xy = sums(mask, 1, 1) - x * y / count
    xd, yd = sums(values, 1, 0) - total * x / count, sums(values, 0, 1) - total * y / count
    determinant = np.maximum(xx * yy - xy * xy, 1)
    slope_x: Field = (yy * xd - xy * yd) / determinant
    slope_y: Field = (xx * yd - xy * xd) / determinant
    residual_squares -= slope_x * xd + slope_y * yd
    return _DisparityPlane(
        slope_x, slope_y, np.sqrt(np.maximum(residual_squares, 0) / count), count
    )


class _LinearMatch(NamedTuple):
    """The difference of the pictures and its slope by disparity; 0 if unknown."""

    e: Field  # left minus right picture, grey levels
    g: Field  # mean slope of both pictures, grey levels per pixel
    r: Field  # right picture, grey levels about the middle of their range
    mask: Field  # 1 where the other fields are known, else 0


def _linearize(
    pictures: tuple[Field, Field], disparity: Field, known: NDArray[np.bool_]
) -> _LinearMatch:
    left, right = pictures
    width = left.shape[1]
    right_columns = np.arange(width, dtype=np.float32) - disparity
    # interpolation uses six pixels
    is_inside = known & (right_columns >= 2) & (right_columns <= width - 4)
    mask = is_inside.astype(np.float32)
    right_levels, slope = _interpolate(right, np.where(is_inside, right_columns, np.float32(2)))
    slope += np.gradient(left, axis=1)
    level = (right_levels - np.float32(MIDDLE_GREY)) * mask
    return _LinearMatch((left - right_levels) * mask, slope * mask / 2, level, mask)


class _RefinedDisparity(NamedTuple):
    """Refined disparities, all (H, W); the sigma is infinite without texture."""

    disparity: Field  # disparities, pixels
    sigma: Field  # sigma from uncorrelated noise, pixels
    linear: _LinearMatch
    # part of linear.e that the constant and the gain of each window explain, grey levels
    expected: Field
    variance: Field  # variance of linear.e, grey levels^2


def _drop_outliers(linear: _LinearMatch, fit: _RefinedDisparity) -> _LinearMatch:
    """Return the equations with 0 for outliers, such as pixels of another surface."""
    is_inlier = np.abs(linear.e - fit.expected) <= MAX_INLIER_SIGMAS * np.sqrt(fit.variance)
    return _LinearMatch(*(term * is_inlier for term in linear))


def _gauss_newton_step(
    linear: _LinearMatch,
    disparity: Field,
    trusted: NDArray[np.bool_] | None,
    plane: _DisparityPlane,
    sums: _WindowSums,
) -> _RefinedDisparity:
    """Take a step of Gauss and Newton in every window, and return the new disparities.

    The noise is estimated from the ``trusted`` pixels.
    """
    # With the right picture's row taken at u - d_q, L - R_q = b + c R_q - g (D + s (q - p) - d_q)
    # + noise for all q of the window around p: linear in D, b and the gain less 1, c. g is the mean
    # of both pictures' slopes, whose noise is not correlated with the noise of their difference.
    e, g, level, mask = linear
    gg, rg, constant = g * g, g * level, e - g * disparity
    n = np.maximum(sums(mask), 1)
    sg, sr, srr_all = sums(g), sums(level), sums(level * level)
    sy, gy, ry = (
        sums(constant_) + plane.slope_x * sums(g_, 1) + plane.slope_y * sums(g_, 0, 1)
        for constant_, g_ in ((constant, g), (constant * g, gg), (constant * level, rg))
    )
    gy -= sg * sy / n
    ry -= sr * sy / n
    if trusted is None:
        m, st, srr, e_, level_ = n, sr, srr_all, e, level
    else:
        e_, level_ = e * trusted, level * trusted
        m, st, srr = np.maximum(sums(mask * trusted), 1), sums(level_), sums(level_ * level)
    se = sums(e_)
    see, sre = sums(e_ * e) - se * se / m, sums(e_ * level) - st * se / m
    srr = np.maximum(srr - st * st / m, 0)
    # the prior uncertainty of the gain, as an additional variance of R
    gain_weight = np.maximum(see / np.maximum(m - 2, 1), MIN_VARIANCE) / np.float32(GAIN_SIGMA**2)
    gain = sre / (srr + gain_weight)
    variance = np.maximum((see - gain * sre) / np.maximum(m - 3, 1), MIN_VARIANCE)
    rr = np.maximum(srr_all - sr * sr / n, 0) + gain_weight
    gr = sums(rg) - sg * sr / n
    curvature = sums(gg) - sg * sg / n - gr * gr / rr
    # the slopes' own noise is no texture: a quarter of a picture's variance, an eighth of e's
    texture = curvature - n * variance / 8
    with np.errstate(divide="ignore", invalid="ignore"):
        correction = (gr * ry / rr - gy) / curvature
        sigma = np.sqrt(variance / texture)
    is_usable = (texture > 0) & np.isfinite(correction) & (n >= MIN_WINDOW_PIXELS)
    return _RefinedDisparity(
        np.where(is_usable, correction, disparity),
        np.where(is_usable, sigma, np.inf),
        linear,
        se / m + gain * (level - st / m),
        variance,
    )


def _interpolate(picture: Field, columns: Field) -> tuple[Field, Field]:
    """Return brightness and slope at columns (H, W) of each row."""
    # Lagrange's polynomial through six pixels. OpenCV's remap is of no use here: its cubic kernel
    # (a = -0.75) moves a ramp by up to 0.03 pixels.
    height, width = picture.shape
    padded = np.pad(picture, ((0, 0), (3, 3)), mode="edge").ravel()
    base = np.floor(columns)
    t = columns - base
    start = base.astype(np.int32) + (1 + np.arange(height, dtype=np.int32) * (width + 6))[:, None]
    pixels = [padded[k:].take(start) for k in range(6)]  # at -2 to 3 from the column
    factors = {node: t - np.float32(node) for node in range(-2, 4)}
    value = np.zeros_like(t)
    for node, pixel in zip(factors, pixels, strict=True):
        others = [other for other in factors if other != node]
        weight = pixel * np.float32(1 / np.prod([node - other for other in others]))
        for other in others:
            weight *= factors[other]
        value += weight
    # central differences as in the left picture, with linear interpolation
    slope = (1 - t) * (pixels[3] - pixels[1]) / 2 + t * (pixels[4] - pixels[2]) / 2
    return value, slope


def _correlation_factor(fit: _RefinedDisparity, trusted: NDArray[np.bool_]) -> float:
    """Return the factor by which the neighbours' correlation changes the variance of sums of g e.

    The factor is 1 without correlation. Pixels of a rectified picture are correlated, since
    neighbours use the same source pixels.
    """
    # Var(sum g e) = sum over all lags of C_ee C_gg + C_eg C_ge for normal values: Isserlis, On a
    # formula for the product-moment coefficient (1918). White noise counts at lag 0 only. Where one
    # picture is sharper, e contains texture, which is correlated with g and mostly cancels.
    mask = fit.linear.mask * trusted
    e, g = fit.linear.e * mask, fit.linear.g * mask
    # one constant and gain for the whole picture, since values for each window would absorb noise
    level = (fit.linear.r - (fit.linear.r * mask).sum() / np.maximum(mask.sum(), 1)) * mask
    e = (e - e.sum() / np.maximum(mask.sum(), 1)) * mask
    e -= level * (float((e * level).sum()) / max(float((level * level).sum()), 1.0))
    height, width = e.shape

    def lagged_product(one: Field, other: Field, u: int, v: int) -> float:
        first = one[v:, max(u, 0) : width + min(u, 0)]
        second = other[: height - v, max(-u, 0) : width + min(-u, 0)]
        return float(np.einsum("ij,ij->", first, second))

    power = lagged_product(e, e, 0, 0) * lagged_product(g, g, 0, 0)
    if power <= 0:
        return 1.0
    total = 1.0
    for v in range(MAX_NOISE_LAG_PX + 1):
        for u in range(-MAX_NOISE_LAG_PX if v else 1, MAX_NOISE_LAG_PX + 1):
            direct = lagged_product(e, e, u, v) * lagged_product(g, g, u, v)
            crossed = lagged_product(e, g, u, v) * lagged_product(g, e, u, v)
            total += 2 * (direct + crossed) / power
    return max(total, MIN_NOISE_FACTOR)
