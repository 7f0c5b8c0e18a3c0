"""Clean depth maps: smooth noise, keep edges, fill holes.

A hole is a pixel without a depth: its value is 0. No average includes holes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, get_args

import numpy as np

from smartcam._argument_checks import a_number, an_integer, as_array, check_arguments
from smartcam._arguments import check_text, excerpt
from smartcam.exceptions import ConfigurationError, FrameFormatError

if TYPE_CHECKING:
    from numpy.typing import NDArray

HoleFill: TypeAlias = Literal["left", "nearest", "farthest"]
"""Choice of the neighbour whose depth fills a hole."""

MILLIMETRE: Final = 1e-3
"""Default step of a depth map of 16 bits, metres."""

MAX_PASSES: Final = 16
"""Largest number of iterations of a filter, and largest width of a filled rim, pixels."""

MIN_NEW_SCENE_SHARE: Final = 0.5
"""Least share of the pixels that must jump for the averages of all pixels to restart."""


@check_arguments(scale=a_number)
def as_metres(depth: NDArray[Any], scale: float = MILLIMETRE) -> NDArray[np.float32]:
    """Return a depth map as float32 metres, 0 for pixels without depth.

    Args:
        depth: (H, W): uint16 in steps of ``scale``, or float of any width in metres (disparities in
            pixels work, too). 0, negative and not finite values mean that there is no depth.
        scale: metres of a step of uint16.

    Returns:
        (H, W), a copy.

    Raises:
        ConfigurationError: a scale that is not above 0.
        FrameFormatError: another shape or type.
    """
    if not (scale > 0 and math.isfinite(scale)):
        raise ConfigurationError(
            f"depth: scale: expected the metres of one step, above 0, got {excerpt(scale)}"
        )
    given: NDArray[Any] = as_array(depth, "depth")
    if (
        given.ndim != 2
        or not given.size
        or not (given.dtype == np.uint16 or given.dtype.kind == "f")
    ):
        raise FrameFormatError(
            f"depth: expected (H, W) of uint16 or float, got {given.shape} of {given.dtype}"
        )
    if given.dtype == np.uint16:
        return given * np.float32(scale)
    metres = given.astype(np.float32)
    metres[~(metres > 0) | np.isinf(metres)] = 0.0
    return metres


class SpatialFilter:
    """Smooth a depth map and keep its edges.

    The filter is a recursive exponential average along rows, then along columns, each forwards and
    backwards. Each pixel is moved towards the smoothed pixel before it, by ``1 - alpha`` of their
    difference. The average restarts at holes and at steps of ``delta`` or more. Holes stay holes.

    Args:
        alpha: weight of the pixel itself, above 0; 1 changes nothing.
        delta: least step that counts as an edge: metres, or pixels of disparity. About four times
            the noise is a good value.
        iterations: number of times that the filter runs.

    Raises:
        ConfigurationError: a number out of its range.
    """

    @check_arguments(alpha=a_number, delta=a_number, iterations=an_integer)
    def __init__(self, alpha: float = 0.5, delta: float = 0.02, iterations: int = 2) -> None:
        _check_average("SpatialFilter", alpha, delta)
        if not 1 <= iterations <= MAX_PASSES:
            raise ConfigurationError(
                f"SpatialFilter: iterations: expected 1 to {MAX_PASSES}, got {excerpt(iterations)}"
            )
        self.alpha: float = alpha
        self.delta: float = delta
        self.iterations: int = iterations

    def __call__(self, depth: NDArray[Any], scale: float = MILLIMETRE) -> NDArray[np.float32]:
        """Return a smoothed copy of a map, (H, W) float32; maps of uint16 become metres.

        Raises:
            FrameFormatError: the array is no depth map.
        """
        smooth = as_metres(depth, scale)
        holes = smooth == 0
        smooth[holes] = np.nan  # comparisons with NaN are false: holes do not enter the average
        with np.errstate(invalid="ignore"):
            for _ in range(self.iterations):
                for _ in range(2):  # along rows, then along columns
                    smooth = np.ascontiguousarray(smooth.T)
                    self._smooth(smooth)
        smooth[holes] = 0.0
        return smooth

    @property
    def correlated_pixels(self) -> float:
        """Number of pixels over which noise is correlated after filtering, away from edges."""
        reach = min(1000, math.ceil(8 / self.alpha))
        single_pass = (1 - self.alpha) ** np.abs(np.arange(-reach, reach + 1))
        kernel = single_pass = single_pass / single_pass.sum()
        for _ in range(self.iterations - 1):
            kernel = np.convolve(kernel, single_pass)
        return float(1 / np.sum(kernel**2) ** 2)

    def _smooth(self, lines: NDArray[np.float32]) -> None:
        """Smooth along the first axis, forwards and backwards, in place."""
        step, size = np.empty_like(lines[0]), np.empty_like(lines[0])
        is_near = np.empty(lines.shape[1], bool)
        weight_before, delta = np.float32(1 - self.alpha), np.float32(self.delta)
        for line, before in _forth_and_back(len(lines)):
            np.subtract(lines[line], lines[before], out=step)
            np.less(np.abs(step, out=size), delta, out=is_near)
            np.multiply(step, weight_before, out=step)
            np.subtract(lines[line], step, out=lines[line], where=is_near)


def _forth_and_back(count: int) -> list[tuple[int, int]]:
    """Return the indices of each line and its predecessor, first forwards, then backwards."""
    forth = [(line, line - 1) for line in range(1, count)]
    return forth + [(before, line) for line, before in reversed(forth)]


class TemporalFilter:
    """Average the depth maps of a camera that does not move, each pixel separately.

    The average of a pixel restarts at a difference of ``delta`` or more: something moved. If half
    of the picture jumps, or the size of the maps changes, all pixels restart. A hole is not
    averaged. It keeps the earlier average for ``persistence`` maps, unless a neighbouring pixel
    restarts.

    Args:
        alpha: weight of the newest map, above 0; 1 averages nothing.
        delta: least difference that restarts the average: metres, or pixels of disparity.
        persistence: number of maps for which a hole keeps the earlier average.

    Raises:
        ConfigurationError: a number out of its range.
    """

    @check_arguments(alpha=a_number, delta=a_number, persistence=an_integer)
    def __init__(self, alpha: float = 0.4, delta: float = 0.02, persistence: int = 3) -> None:
        _check_average("TemporalFilter", alpha, delta)
        if not 0 <= persistence < 255:
            raise ConfigurationError(
                f"TemporalFilter: persistence: expected 0 to 254 maps, got {excerpt(persistence)}"
            )
        self.alpha: float = alpha
        self.delta: float = delta
        self.persistence: int = persistence
        self._average: NDArray[np.float32] | None = None
        self._hole_ages: NDArray[np.uint8] | None = None  # maps since each pixel had a depth

    def reset(self) -> None:
        """Restart the average, as after a move of the camera or a long pause."""
        self._average = self._hole_ages = None

    def __call__(self, depth: NDArray[Any], scale: float = MILLIMETRE) -> NDArray[np.float32]:
        """Add a map, and return the average, (H, W) float32; maps of uint16 become metres.

        Raises:
            FrameFormatError: the array is no depth map; the average is unchanged.
        """
        new = as_metres(depth, scale)
        average, hole_ages = self._average, self._hole_ages
        if average is None or hole_ages is None or average.shape != new.shape:
            return self._restart(new)
        has_depth = new > 0
        in_both = has_depth & (average > 0)
        difference = new - average
        has_jumped = in_both & (np.abs(difference) >= self.delta)
        if np.count_nonzero(has_jumped) > MIN_NEW_SCENE_SHARE * np.count_nonzero(in_both):
            return self._restart(new)
        is_steady = in_both & ~has_jumped
        np.add(average, np.float32(self.alpha) * difference, out=average, where=is_steady)
        np.copyto(average, new, where=has_depth & ~is_steady)
        hole_ages += hole_ages < 255
        hole_ages[has_depth] = 0
        hole_ages[_dilate(has_jumped) & ~has_depth] = 255
        average[hole_ages > self.persistence] = 0.0
        return average.copy()

    def _restart(self, new: NDArray[np.float32]) -> NDArray[np.float32]:
        self._average = new.copy()
        self._hole_ages = np.where(new > 0, 0, 255).astype(np.uint8)
        return new


@check_arguments(how=check_text, reach=an_integer, scale=a_number)
def fill_holes(
    depth: NDArray[Any],
    how: HoleFill = "farthest",
    *,
    reach: int = 8,
    scale: float = MILLIMETRE,
) -> NDArray[np.float32]:
    """Return a depth map whose holes are filled from their rim inwards, (H, W) float32.

    Filled depths are guesses for viewing; do not measure with them.

    Args:
        depth: (H, W), float, or uint16, which becomes metres.
        how: ``"left"``: the next depth to the left; ``"nearest"`` or ``"farthest"``: the least or
            the largest of the eight neighbours, ring by ring. Near an edge, where one of two
            cameras sees nothing, ``"farthest"`` is the correct choice.
        reach: width, pixels, of the rim of a hole that is filled, 1 to 16.
        scale: metres of a step of uint16.

    Raises:
        ConfigurationError: another ``how``, or a reach out of its range.
        FrameFormatError: the array is no depth map.
    """
    if how not in get_args(HoleFill):
        raise ConfigurationError(
            f"fill_holes: how: expected one of {get_args(HoleFill)}, got {excerpt(how)}"
        )
    if not 1 <= reach <= MAX_PASSES:
        raise ConfigurationError(
            f"fill_holes: reach: expected 1 to {MAX_PASSES}, got {excerpt(reach)}"
        )
    filled = as_metres(depth, scale)
    for _ in range(reach):
        holes = filled == 0
        if not holes.any():
            break
        neighbours = _shift_right(filled) if how == "left" else _extreme_neighbours(filled, how)
        np.copyto(filled, neighbours, where=holes)
    return filled


def _shift_right(metres: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.pad(metres[:, :-1], ((0, 0), (1, 0)))


def _extreme_neighbours(metres: NDArray[np.float32], how: HoleFill) -> NDArray[np.float32]:
    """Return the least or largest depth among each pixel and its neighbours, 0 if all are holes."""
    if how == "farthest":
        return _join_neighbours(metres, np.maximum)
    least = _join_neighbours(np.where(metres > 0, metres, np.float32(np.inf)), np.minimum)
    return np.where(np.isinf(least), np.float32(0.0), least)


def _dilate(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return _join_neighbours(mask, np.logical_or) if mask.any() else mask


def _join_neighbours(values: NDArray[Any], join: np.ufunc) -> NDArray[Any]:
    """Return each pixel joined with its eight neighbours by a ufunc, such as ``np.maximum``."""
    for _ in range(2):
        wide = values.copy()
        join(wide[1:], values[:-1], out=wide[1:])
        join(wide[:-1], values[1:], out=wide[:-1])
        values = wide.T
    return values


def _check_average(caller: str, alpha: float, delta: float) -> None:
    if not 0 < alpha <= 1:
        raise ConfigurationError(
            f"{caller}: alpha: expected above 0, up to 1, got {excerpt(alpha)}"
        )
    if not (delta > 0 and math.isfinite(delta)):
        raise ConfigurationError(f"{caller}: delta: expected a step above 0, got {excerpt(delta)}")
