"""Disparities between the pixels: by least squares, which tell how sure they are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._optional_imports import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Field = NDArray[np.float64]

COARSE: Final = 0.5
"""Least sigma of a disparity that least squares could not refine, pixels."""

STEPS: Final = 3
"""Of Gauss and Newton."""

FARTHEST: Final = 0.5
"""Pixels by which a disparity may be moved: farther off is another point."""

ROUGHEST: Final = 0.5
"""Pixels, rms, of coarse disparities from a plane; a window with more has an edge in it."""

FILLED: Final = 0.5
"""Part of a window that has disparities, at least."""

BESIDE: Final = 2
"""Pixels from a hole within which nothing is refined."""

LAGS: Final = 2
"""Pixels over which noise is looked at for correlation."""

LEAST: Final = 0.2
"""Of what is found there."""


def refined(
    left: NDArray[np.uint8], right: NDArray[np.uint8], coarse: NDArray[np.float32], window: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return disparities and their sigma, both (H, W), NaN where ``coarse`` is.

    In a window the disparity is a plane, and the brightness of the pictures differs by a constant.
    Where a window has an edge in it, too little texture, or the least squares lead too far, the
    coarse value stays: its sigma is ``COARSE``, or how rough the window is where that is more.
    """
    known = np.isfinite(coarse)
    sigma = np.where(known, np.float32(COARSE), np.float32(np.nan))
    if not window or not known.any():
        return coarse, sigma
    sums = _Windows(window)
    start = np.where(known, coarse, 0).astype(np.float64)
    plane = _plane(start, known, sums)
    smooth = (plane.rough <= ROUGHEST) & (plane.count >= FILLED * window**2)
    smooth &= _whole_around(known)
    # near an edge of depth a coarse value may be that of its other side
    told = np.fmax(sigma, plane.rough)
    found, usable = start, known
    for step in range(STEPS):
        if step:
            plane = _plane(found, known, sums)
        fit = _fitted((left, right), found, known, usable, plane, sums)
        usable = smooth & (fit.sigma < COARSE) & (np.abs(fit.disparity - start) < FARTHEST)
        found = np.where(usable, fit.disparity, start)
    found[~known] = np.nan
    told = np.where(usable, fit.sigma, told)
    told[~known] = np.nan
    return found.astype(np.float32), told.astype(np.float32)


def _whole_around(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return what has no hole next to it: behind a near thing's edge there is one."""
    around = np.ones((2 * BESIDE + 1, 2 * BESIDE + 1), np.uint8)
    return np.asarray(load("cv2").erode(known.astype(np.uint8), around) > 0)


class _Windows:
    """Sums over the window around each pixel."""

    def __init__(self, side: int) -> None:
        self._ones = np.ones(side)
        self._ramp = np.arange(side) - side // 2.0
        self._border = load("cv2").BORDER_CONSTANT

    def __call__(self, values: Field, across: int = 0, down: int = 0) -> Field:
        """Return the sums of values times powers of the distance from the window's middle."""
        x, y = self._ramp**across, self._ramp**down
        return np.asarray(load("cv2").sepFilter2D(values, -1, x, y, borderType=self._border))


class _Plane(NamedTuple):
    """The disparities in each window, as a plane; all are (H, W)."""

    across: Field  # slope, pixels a pixel
    down: Field
    rough: Field  # how far the disparities are from it, rms, pixels
    count: Field  # of disparities


def _plane(disparity: Field, known: NDArray[np.bool_], sums: _Windows) -> _Plane:
    mask = known.astype(np.float64)
    # near 0, so that the squares below keep their digits
    values = (disparity - disparity.mean(where=known)) * mask
    count = np.maximum(sums(mask), 1)
    total = sums(values)
    left = sums(values * values) - total * total / count
    slopes = []
    for across, down in ((1, 0), (0, 1)):
        first = sums(mask, across, down)
        spread = np.maximum(sums(mask, 2 * across, 2 * down) - first * first / count, 1)
        slope = (sums(values, across, down) - total * first / count) / spread
        left -= slope * slope * spread
        slopes.append(slope)
    return _Plane(slopes[0], slopes[1], np.sqrt(np.maximum(left, 0) / count), count)


class _Fit(NamedTuple):
    """Both (H, W), pixels; the sigma is infinite where there is no texture."""

    disparity: Field
    sigma: Field


def _fitted(
    pictures: tuple[NDArray[np.uint8], NDArray[np.uint8]],
    disparity: Field,
    known: NDArray[np.bool_],
    trusted: NDArray[np.bool_],
    plane: _Plane,
    sums: _Windows,
) -> _Fit:
    """Return one step of Gauss and Newton for every window.

    What noise there is follows from the ``trusted`` pixels.
    """
    # With the right picture's row taken at u - d_q, L - R_q = b - g (D + s (q - p) - d_q) + noise
    # for all q of the window around p: linear in D and b. g is the mean of both pictures' slopes,
    # whose noise does not go with that of their difference.
    left, right = pictures
    width = left.shape[1]
    there = np.arange(width) - disparity
    inside = known & (there >= 1) & (there <= width - 2)
    moved, slope = _sampled(right, np.where(inside, there, 1.0))
    mask = inside.astype(np.float64)
    e = (left - moved) * mask
    g = (np.gradient(left.astype(np.float64), axis=1) + slope) / 2 * mask
    d = disparity * mask
    gg = g * g
    n = np.maximum(sums(mask), 1)
    sg, sgg = sums(g), sums(gg)
    sgd = sums(g * d) - plane.across * sums(g, 1) - plane.down * sums(g, 0, 1)
    sggd = sums(gg * d) - plane.across * sums(gg, 1) - plane.down * sums(gg, 0, 1)
    sgy, sy = sums(g * e) - sggd, sums(e) - sgd
    curvature = sgg - sg * sg / n
    trust = mask * trusted
    m = np.maximum(sums(trust), 1)
    se = sums(e * trust)
    variance = np.maximum(sums(e * e * trust) - se * se / m, 0) / np.maximum(m - 2, 1)
    # the slopes' own noise is no texture: a quarter of a picture's variance, an eighth of e's
    texture = curvature - n * variance / 8
    with np.errstate(divide="ignore", invalid="ignore"):
        found = -(sgy - sg * sy / n) / curvature
        sigma = np.sqrt(variance * _correlation(e * trust, g * trust, trust) / texture)
    usable = (texture > 0) & np.isfinite(found) & inside
    return _Fit(np.where(usable, found, disparity), np.where(usable, sigma, np.inf))


def _sampled(picture: NDArray[np.uint8], columns: Field) -> tuple[Field, Field]:
    """Return brightness and slope at columns (H, W) of each row."""
    # Lagrange's polynomial through six pixels. OpenCV's remap is of no use here: its cubic kernel
    # (a = -0.75) moves a ramp by up to 0.03 pixels.
    height, width = picture.shape
    wide = np.pad(picture, ((0, 0), (3, 3)), mode="edge").astype(np.float64).ravel()
    whole = np.floor(columns)
    t = columns - whole
    start = whole.astype(np.int64) + 1 + (np.arange(height) * (width + 6))[:, None]
    pixels = [wide.take(start + k) for k in range(6)]  # at -2 to 3 from the column
    factors = {node: t - node for node in range(-2, 4)}
    value = np.zeros_like(t)
    for node, pixel in zip(factors, pixels, strict=True):
        others = [one for one in factors if one != node]
        weight = pixel / np.prod([node - one for one in others])
        for one in others:
            weight *= factors[one]
        value += weight
    # central differences, as those of the left picture, and linear between
    slope = (1 - t) * (pixels[3] - pixels[1]) / 2 + t * (pixels[4] - pixels[2]) / 2
    return value, slope


def _correlation(e: Field, g: Field, mask: Field) -> float:
    """Return by how much the noise e of neighbours is correlated, as it counts for sums of g e.

    1: not at all. A picture that was rectified has some: its pixels share those of the source.
    """
    # Var(sum g e) = sum over all lags of C_g C_e; of white noise only lag 0 is there
    e = e - e.sum() / max(mask.sum(), 1) * mask
    height, width = e.shape
    power = float((e * e).sum() * (g * g).sum())
    if power <= 0:
        return 1.0
    whole = 1.0
    for v in range(LAGS + 1):
        for u in range(-LAGS if v else 1, LAGS + 1):
            here = slice(v, height), slice(max(u, 0), width + min(u, 0))
            there = slice(0, height - v), slice(max(-u, 0), width + min(-u, 0))
            both = float((e[here] * e[there]).sum() * (g[here] * g[there]).sum())
            whole += 2 * both / power
    return max(whole, LEAST)
