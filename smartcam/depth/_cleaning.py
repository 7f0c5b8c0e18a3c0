"""Depth maps made cleaner: noise taken out and edges kept, holes filled as far as that is sound.

A hole is a pixel without a depth, 0. It has no part in any average.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, get_args

import numpy as np

from smartcam._argument_checks import a_number, an_integer, as_array, takes
from smartcam._arguments import check_text, shown
from smartcam.exceptions import ConfigurationError, FrameFormatError

if TYPE_CHECKING:
    from numpy.typing import NDArray

HoleFill: TypeAlias = Literal["left", "nearest", "farthest"]
"""The neighbour that a hole takes its depth from."""

MILLIMETRE: Final = 1e-3
"""Metres for one step of a depth map of 16 bits, by default."""

MAX_PASSES: Final = 16
"""Iterations, and pixels that holes are filled over: 8 times as many are still a few seconds."""

MIN_NEW_SCENE_SHARE: Final = 0.5
"""Share of the pixels that must change by more than an edge for a new scene."""


@takes(scale=a_number)
def as_metres(depth: NDArray[Any], scale: float = MILLIMETRE) -> NDArray[np.float32]:
    """Return a depth map as float32 metres, 0 where there is none.

    Args:
        depth: (H, W): uint16 in steps of ``scale``, or float of any width in metres (or whatever
            else: disparities are passed on as they are). 0, negative and not finite values stand
                for no disparity.
        scale: metres of a step of uint16.

    Returns:
        (H, W), a copy.

    Raises:
        ConfigurationError: a scale that is not above 0.
        FrameFormatError: another shape or type.
    """
    if not (scale > 0 and math.isfinite(scale)):
        raise ConfigurationError(
            f"depth: scale: expected metres a step above 0, got {shown(scale)}"
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
    """Smooths a depth map and keeps its edges.

    It is a recursive exponential average along rows, then along columns, each forth and back. A
    pixel takes ``1 - alpha`` of its difference to the one before, which was smoothed already,
    unless that differs by ``delta`` or more, or is a hole. There the average begins anew. Holes
    stay holes.

    Args:
        alpha: weight of the pixel itself, above 0; 1 changes nothing.
        delta: the least step that is an edge: metres, or pixels where the map is one of
            disparities. About four times the noise.
        iterations: how often all of it is done.

    Raises:
        ConfigurationError: a number out of its range.
    """

    @takes(alpha=a_number, delta=a_number, iterations=an_integer)
    def __init__(self, alpha: float = 0.5, delta: float = 0.02, iterations: int = 2) -> None:
        _check_average("SpatialFilter", alpha, delta)
        if not 1 <= iterations <= MAX_PASSES:
            raise ConfigurationError(
                f"SpatialFilter: iterations: expected 1 to {MAX_PASSES}, got {shown(iterations)}"
            )
        self.alpha: float = alpha
        self.delta: float = delta
        self.iterations: int = iterations

    def __call__(self, depth: NDArray[Any], scale: float = MILLIMETRE) -> NDArray[np.float32]:
        """Return a map smoothed, (H, W) float32; of uint16 in metres. The given one stays.

        Raises:
            FrameFormatError: no map of depth.
        """
        smooth = as_metres(depth, scale)
        holes = smooth == 0
        smooth[holes] = np.nan  # no comparison with it is true: nothing is taken from it
        with np.errstate(invalid="ignore"):
            for _ in range(self.iterations):
                for _ in range(2):  # along rows, then along columns
                    smooth = np.ascontiguousarray(smooth.T)
                    self._smooth(smooth)
        smooth[holes] = 0.0
        return smooth

    @property
    def shared(self) -> float:
        """Pixels that share one noise afterwards, far from edges: see :func:`region_depth`."""
        reach = min(1000, math.ceil(8 / self.alpha))
        once = (1 - self.alpha) ** np.abs(np.arange(-reach, reach + 1))
        kernel = once = once / once.sum()
        for _ in range(self.iterations - 1):
            kernel = np.convolve(kernel, once)
        return float(1 / np.sum(kernel**2) ** 2)

    def _smooth(self, lines: NDArray[np.float32]) -> None:
        """Smooth along the first axis, forth and back; all of the second one at a time."""
        step, size = np.empty_like(lines[0]), np.empty_like(lines[0])
        near = np.empty(lines.shape[1], bool)
        rest, delta = np.float32(1 - self.alpha), np.float32(self.delta)
        for line, before in _forth_and_back(len(lines)):
            np.subtract(lines[line], lines[before], out=step)
            np.less(np.abs(step, out=size), delta, out=near)
            np.multiply(step, rest, out=step)
            np.subtract(lines[line], step, out=lines[line], where=near)


def _forth_and_back(count: int) -> list[tuple[int, int]]:
    """Return each line but the first with the one before it, then the same from the end."""
    forth = [(line, line - 1) for line in range(1, count)]
    return forth + [(before, line) for line, before in reversed(forth)]


class TemporalFilter:
    """Averages the depth maps of a camera that stands still, each pixel for itself.

    A pixel that differs from its average by ``delta`` or more begins anew: something moved, or an
    edge went over it. Where half of the picture jumps, or maps of another size come, all of it
    begins anew. A hole takes no part, and for ``persistence`` maps it shows the average that was
    there before, unless a pixel beside it begins anew.

    Args:
        alpha: weight of the newest map, above 0; 1 averages nothing.
        delta: the least step that is a change: metres, or pixels of disparity.
        persistence: maps for which a hole shows what was there; 0: none.

    Raises:
        ConfigurationError: a number out of its range.
    """

    @takes(alpha=a_number, delta=a_number, persistence=an_integer)
    def __init__(self, alpha: float = 0.4, delta: float = 0.02, persistence: int = 3) -> None:
        _check_average("TemporalFilter", alpha, delta)
        if not 0 <= persistence < 255:
            raise ConfigurationError(
                f"TemporalFilter: persistence: expected 0 to 254 maps, got {shown(persistence)}"
            )
        self.alpha: float = alpha
        self.delta: float = delta
        self.persistence: int = persistence
        self._average: NDArray[np.float32] | None = None
        self._holes: NDArray[np.uint8] | None = None  # maps since a pixel had a depth

    def reset(self) -> None:
        """Begin anew: the camera has moved, or has not been looked at for long."""
        self._average = self._holes = None

    def __call__(self, depth: NDArray[Any], scale: float = MILLIMETRE) -> NDArray[np.float32]:
        """Take the next map; return the average, (H, W) float32, of uint16 in metres.

        Raises:
            FrameFormatError: no map of depth; nothing has changed then.
        """
        new = as_metres(depth, scale)
        average, holes = self._average, self._holes
        if average is None or holes is None or average.shape != new.shape:
            return self._begin(new)
        there = new > 0
        both = there & (average > 0)
        step = new - average
        changed = both & (np.abs(step) >= self.delta)
        if np.count_nonzero(changed) > MIN_NEW_SCENE_SHARE * np.count_nonzero(both):
            return self._begin(new)
        kept = both & ~changed
        np.add(average, np.float32(self.alpha) * step, out=average, where=kept)
        np.copyto(average, new, where=there & ~kept)
        holes += holes < 255
        holes[there] = 0
        holes[_dilated(changed) & ~there] = 255
        average[holes > self.persistence] = 0.0
        return average.copy()

    def _begin(self, new: NDArray[np.float32]) -> NDArray[np.float32]:
        self._average = new.copy()
        self._holes = np.where(new > 0, 0, 255).astype(np.uint8)
        return new


@takes(how=check_text, reach=an_integer, scale=a_number)
def fill_holes(
    depth: NDArray[Any],
    how: HoleFill = "farthest",
    *,
    reach: int = 8,
    scale: float = MILLIMETRE,
) -> NDArray[np.float32]:
    """Return a depth map whose holes are filled from their rim inwards, (H, W) float32.

    What is filled in is a guess, and good to look at; measure with what was measured.

    Args:
        depth: (H, W); of uint16 metres come out.
        how: ``"left"``: the next depth to the left; ``"nearest"`` or ``"farthest"``: the least or
            the largest of the eight neighbours, ring by ring. Behind an edge, where one of two
            cameras sees nothing, the farthest is right.
        reach: pixels that a depth is carried at most, 1 to 16; what is farther inside stays a hole.
        scale: metres of a step of uint16.

    Raises:
        ConfigurationError: another ``how``, or a reach out of its range.
        FrameFormatError: no map of depth.
    """
    if how not in get_args(HoleFill):
        raise ConfigurationError(
            f"fill_holes: how: expected one of {get_args(HoleFill)}, got {shown(how)}"
        )
    if not 1 <= reach <= MAX_PASSES:
        raise ConfigurationError(
            f"fill_holes: reach: expected 1 to {MAX_PASSES}, got {shown(reach)}"
        )
    filled = as_metres(depth, scale)
    for _ in range(reach):
        holes = filled == 0
        if not holes.any():
            break
        around = _left(filled) if how == "left" else _extreme(filled, how)
        np.copyto(filled, around, where=holes)
    return filled


def _left(metres: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.pad(metres[:, :-1], ((0, 0), (1, 0)))


def _extreme(metres: NDArray[np.float32], how: HoleFill) -> NDArray[np.float32]:
    """Return the least or largest depth of each pixel and its neighbours, 0 where none has one."""
    if how == "farthest":
        return _widened(metres, np.maximum)
    least = _widened(np.where(metres > 0, metres, np.float32(np.inf)), np.minimum)
    return np.where(np.isinf(least), np.float32(0.0), least)


def _dilated(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return _widened(mask, np.logical_or) if mask.any() else mask


def _widened(values: NDArray[Any], join: np.ufunc) -> NDArray[Any]:
    """Return each pixel joined with its eight neighbours."""
    for _ in range(2):
        wide = values.copy()
        join(wide[1:], values[:-1], out=wide[1:])
        join(wide[:-1], values[1:], out=wide[:-1])
        values = wide.T
    return values


def _check_average(who: str, alpha: float, delta: float) -> None:
    if not 0 < alpha <= 1:
        raise ConfigurationError(f"{who}: alpha: expected above 0, up to 1, got {shown(alpha)}")
    if not (delta > 0 and math.isfinite(delta)):
        raise ConfigurationError(f"{who}: delta: expected a step above 0, got {shown(delta)}")
