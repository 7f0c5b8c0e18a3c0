"""Compute the disparity of two rectified pictures with OpenCV's matchers, and reject errors."""

from __future__ import annotations

import math
import threading
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._argument_checks import a_number, an_integer, check_arguments, or_none
from smartcam._arguments import check_text, excerpt
from smartcam._extras import load
from smartcam._suggestions import did_you_mean
from smartcam.depth._subpixel import refine_disparities
from smartcam.exceptions import ConfigurationError, FrameFormatError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Literal

    from numpy.typing import NDArray

    Value = int | str

SUBPIXELS: Final = 16
"""Number of OpenCV's disparity steps per pixel."""

WINDOWS: Final = (0, 5, 7, 9, 11, 13, 15)
"""Sides of the window in which disparities are refined, pixels; 0: no refinement."""

MAX_DISPARITIES: Final = 4096
"""Largest range of disparities that can be searched, pixels."""


class Disparity(NamedTuple):
    """The disparities that a :class:`StereoMatcher` finds.

    Attributes:
        pixels: (H, W), float32: distance by which a point of the left picture is farther left in
            the right picture; NaN: no match.
        sigma: (H, W), float32: standard deviation of ``pixels``, pixels; NaN where ``pixels`` is
            NaN.
    """

    pixels: NDArray[np.float32]
    sigma: NDArray[np.float32]


class _WholeParameter(NamedTuple):
    """A parameter that is a whole number."""

    default: int
    low: int
    high: int
    multiple: int = 1  # values are ``low`` plus a multiple of this number

    def __str__(self) -> str:
        other_step = f", a multiple of {self.multiple}"
        step = {1: "", 2: ", odd" if self.low % 2 else ", even"}.get(self.multiple, other_step)
        return f"{self.low} to {self.high}{step}"

    def check(self, value: object) -> int | None:
        """Return a value for OpenCV; None if it is not allowed."""
        if not isinstance(value, int | np.integer) or isinstance(value, bool):
            return None
        number = int(value)
        is_allowed = self.low <= number <= self.high and (number - self.low) % self.multiple == 0
        return number if is_allowed else None


class _WordParameter(NamedTuple):
    """A parameter with a list of words as values; the first word is the default."""

    words: tuple[str, ...]
    prefix: str  # prefix of OpenCV's constants

    @property
    def default(self) -> str:
        """Default value."""
        return self.words[0]

    def __str__(self) -> str:
        return " or ".join(self.words)

    def check(self, value: object) -> int | None:
        """Return OpenCV's number for a word; None if the word is unknown."""
        if value not in self.words:
            return None
        return int(getattr(load("cv2"), self.prefix + str(value).upper()))


_COMMON_PARAMETERS: Final[dict[str, _WholeParameter | _WordParameter]] = {
    "min_disparity": _WholeParameter(0, -MAX_DISPARITIES, MAX_DISPARITIES),
    "num_disparities": _WholeParameter(128, 16, MAX_DISPARITIES, 16),
    "speckle_window_size": _WholeParameter(100, 0, 1_000_000),
    "speckle_range": _WholeParameter(1, 0, 1000),
}

_PARAMETERS: Final[dict[str, dict[str, _WholeParameter | _WordParameter]]] = {
    "sgbm": {
        **_COMMON_PARAMETERS,
        "block_size": _WholeParameter(3, 1, 51, 2),
        "P1": _WholeParameter(0, 0, 1_000_000),
        "P2": _WholeParameter(0, 0, 1_000_000),
        "uniqueness_ratio": _WholeParameter(5, 0, 100),
        "pre_filter_cap": _WholeParameter(63, 1, 63),
        "mode": _WordParameter(("sgbm_3way", "sgbm", "hh", "hh4"), "StereoSGBM_MODE_"),
    },
    "bm": {
        **_COMMON_PARAMETERS,
        "block_size": _WholeParameter(15, 5, 255, 2),
        "uniqueness_ratio": _WholeParameter(5, 0, 100),
        "pre_filter_type": _WordParameter(("xsobel", "normalized_response"), "StereoBM_PREFILTER_"),
        "pre_filter_size": _WholeParameter(9, 5, 255, 2),
        "pre_filter_cap": _WholeParameter(31, 1, 63),
        "texture_threshold": _WholeParameter(10, 0, 1_000_000),
    },
}
"""Parameters by OpenCV's names in snake case; some defaults differ from OpenCV's."""


class StereoMatcher:
    """Compute the disparity of two rectified pictures.

    ::

        matcher = StereoMatcher("sgbm", num_disparities=96, block_size=5)
        disparity = matcher(left, right)
        disparity.pixels, disparity.sigma

    OpenCV's matcher runs from left to right and from right to left; disparities on which the two
    directions do not agree, and speckles, are dropped. The other disparities are refined by least
    squares in a window, which also estimates their sigma: see ``docs/depth.md``. Points near the
    left border, which OpenCV by itself leaves out, are matched, too. Colours are converted to grey.

    Args:
        algorithm: ``sgbm``, semi-global, or ``bm``, blocks: three times faster, with more holes.
        left_right: largest difference between the two directions, pixels; None: no comparison.
        refine: side of the window for refinement, odd, 5 to 15 pixels; 0: keep OpenCV's steps of
            1/16 pixel.
        wls: lambda and sigma of OpenCV's weighted least squares filter, such as (8000, 1.5), which
            smooths disparities between edges and fills holes; None: no filter.
        parameters: parameters of OpenCV's matcher, by its names with underscores:
            ``num_disparities``, ``block_size``, ``P1``, ``uniqueness_ratio``, ``mode="hh"``. 0 for
            ``P1`` or ``P2`` means 8 or 32 times ``block_size`` squared.

    Raises:
        ConfigurationError: the algorithm, parameter or value is unknown, or ``wls`` is given but
            ``cv2.ximgproc`` is missing, which is in OpenCV's contrib packages only.
        MissingExtraError: OpenCV (extra ``depth``) is not installed.
    """

    @check_arguments(algorithm=check_text, left_right=or_none(a_number), refine=an_integer)
    def __init__(
        self,
        algorithm: Literal["sgbm", "bm"] = "sgbm",
        *,
        left_right: float | None = 1.0,
        refine: int = 9,
        wls: tuple[float, float] | None = None,
        **parameters: Value,
    ) -> None:
        if algorithm not in _PARAMETERS:
            raise ConfigurationError(
                f"StereoMatcher: expected {' or '.join(_PARAMETERS)}, got {excerpt(algorithm)}"
            )
        self.algorithm = algorithm
        self.parameters: Mapping[str, Value] = _merge_parameters(algorithm, parameters)
        if left_right is not None and not 0 <= left_right <= MAX_DISPARITIES:
            raise _argument_error(
                "left_right", f"0 to {MAX_DISPARITIES} pixels or None", left_right
            )
        if refine not in WINDOWS:
            raise _argument_error("refine", f"one of {WINDOWS}", refine)
        self._left_right, self._refine = left_right, refine
        self._wls_filter = None if wls is None else _make_wls_filter(wls)
        opencv_values = {
            name: _PARAMETERS[algorithm][name].check(value)
            for name, value in self.parameters.items()
        }
        # OpenCV's own check compares only its first estimates, in whole pixels. -1 does not switch
        # this check off for SGBM.
        opencv_values["disp12_max_diff"] = (
            MAX_DISPARITIES if left_right is None else math.ceil(left_right)
        )
        self._compute = _ALGORITHMS[algorithm](opencv_values)
        self._lock = threading.Lock()  # OpenCV's matchers reuse their buffers

    @property
    def max_disparity(self) -> int:
        """Largest disparity that is found, pixels."""
        return int(self.parameters["min_disparity"]) + int(self.parameters["num_disparities"]) - 1

    def __call__(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> Disparity:
        """Return the disparity of two rectified pictures.

        Blocks until it is done: call it in a thread, not in a coroutine. Calls of several threads
        run one after the other.

        Args:
            left: (H, W) or, red first, (H, W, 3); uint8.
            right: picture of the same shape and type as ``left``.

        Raises:
            FrameFormatError: the pictures have other shapes or types, or are too small.
        """
        first, second = _as_grey(left, "left"), _as_grey(right, "right")
        window = int(self.parameters["block_size"])
        if first.shape != second.shape or min(first.shape) < window:
            raise FrameFormatError(
                f"stereo: expected two pictures of one size, {window} pixels or more along a side, "
                f"got {first.shape[1]}x{first.shape[0]} and {second.shape[1]}x{second.shape[0]}"
            )
        with self._lock:
            disparity = self._match(first, second)
        return Disparity(*refine_disparities(first, second, disparity, self._refine))

    def _match(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return OpenCV's disparities, NaN for pixels without one."""
        cv2 = load("cv2")
        invalid = (int(self.parameters["min_disparity"]) - 1) * SUBPIXELS
        sixteenths = self._match_padded(left, right)
        if self._wls_filter is not None:
            sixteenths = self._wls_filter(
                sixteenths, left, np.negative(self._match_reverse(left, right))
            )
        elif self._left_right is not None:
            difference = _direction_difference(
                sixteenths, self._match_reverse(left, right), invalid
            )
            sixteenths[~(difference <= self._left_right * SUBPIXELS)] = invalid
        column = np.arange(left.shape[1])
        right_column = column - np.round(sixteenths / SUBPIXELS)
        sixteenths[(right_column < 0) | (right_column >= left.shape[1])] = invalid
        size = int(self.parameters["speckle_window_size"])
        if size:
            reach = int(self.parameters["speckle_range"]) * SUBPIXELS
            cv2.filterSpeckles(sixteenths, invalid, size, reach)
        return np.where(
            sixteenths > invalid, sixteenths / np.float32(SUBPIXELS), np.float32(np.nan)
        )

    def _match_reverse(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8]
    ) -> NDArray[np.int16]:
        """Return disparities from right to left in 1/16 pixel, with the sign of left to right."""
        # the mirrored right picture is the left picture of a mirrored pair
        return np.ascontiguousarray(self._match_padded(right[:, ::-1], left[:, ::-1])[:, ::-1])

    def _match_padded(self, left: NDArray[Any], right: NDArray[Any]) -> NDArray[np.int16]:
        """Return disparities in 1/16 pixel, also near borders, where OpenCV leaves them out."""
        cv2 = load("cv2")
        before = max(0, self.max_disparity + 1)
        after = max(0, -int(self.parameters["min_disparity"]))
        wide = [
            cv2.copyMakeBorder(
                np.ascontiguousarray(picture), 0, 0, before, after, cv2.BORDER_REPLICATE
            )
            for picture in (left, right)
        ]
        width = left.shape[1]
        computed = np.asarray(self._compute(*wide))[:, before : before + width]
        return np.ascontiguousarray(computed)


def _merge_parameters(algorithm: str, given: Mapping[str, Value]) -> dict[str, Value]:
    """Return all parameters of an algorithm."""
    known = _PARAMETERS[algorithm]
    for name, value in given.items():
        if name not in known:
            raise ConfigurationError(
                f"StereoMatcher {algorithm}: no parameter {excerpt(name)}; there are "
                f"{', '.join(known)}{did_you_mean(name, known)}"
            )
        if known[name].check(value) is None:
            raise _argument_error(f"{algorithm}: {name}", str(known[name]), value)
    merged: dict[str, Value] = {name: spec.default for name, spec in known.items()} | dict(given)
    if algorithm == "sgbm":
        area = int(merged["block_size"]) ** 2
        merged["P1"] = merged["P1"] or 8 * area
        merged["P2"] = merged["P2"] or max(32 * area, 4 * int(merged["P1"]))
        if int(merged["P2"]) <= int(merged["P1"]):
            raise _argument_error("sgbm: P2", f"more than P1, {merged['P1']}", merged["P2"])
    return merged


def _argument_error(label: str, expected: str, actual: object) -> ConfigurationError:
    return ConfigurationError(f"StereoMatcher: {label}: expected {expected}, got {excerpt(actual)}")


def _as_grey(picture: NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    shape = picture.shape
    if picture.dtype != np.uint8 or not (len(shape) == 2 or (len(shape) == 3 and shape[2] == 3)):
        raise FrameFormatError(
            f"stereo: {name}: expected (H, W) or (H, W, 3) of uint8, got {shape} of {picture.dtype}"
        )
    if len(shape) == 2:
        return picture
    cv2 = load("cv2")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _direction_difference(
    forward: NDArray[np.int16], backward: NDArray[np.int16], invalid: int
) -> NDArray[np.float32]:
    """Return the differences, in 1/16 pixel, between both directions' disparities of a point.

    A difference is infinite if a disparity is missing, or the point is outside of the right
    picture.
    """
    width = forward.shape[1]
    column = np.arange(width, dtype=np.int32)[None] - ((forward.astype(np.int32) + 8) >> 4)
    inside = (column >= 0) & (column < width) & (forward > invalid)
    other = np.take_along_axis(backward, np.clip(column, 0, width - 1), axis=1)
    difference = np.abs(other.astype(np.float32) - forward)
    return np.where(inside & (other > invalid), difference, np.float32(np.inf))


def _make_wls_filter(wls: tuple[float, float]) -> Callable[..., Any]:
    """Return OpenCV's weighted least squares filter for disparities in 1/16 pixel."""
    cv2 = load("cv2")
    if not hasattr(cv2, "ximgproc"):
        raise ConfigurationError(
            f"StereoMatcher: wls: expected an OpenCV with ximgproc (the packages "
            f"opencv-contrib-python and opencv-contrib-python-headless have it), got "
            f"{cv2.__version__} without; leave wls out"
        )
    try:
        smoothness, edges = (float(number) for number in wls)
    except (TypeError, ValueError, ArithmeticError):
        smoothness = edges = -1.0
    if not (0 < smoothness < 1e9 and 0 < edges < 1e3):
        raise _argument_error("wls", "lambda and sigma above 0, such as (8000, 1.5)", wls)
    wls_filter = cv2.ximgproc.createDisparityWLSFilterGeneric(True)  # True: with confidences
    wls_filter.setLambda(smoothness)
    wls_filter.setSigmaColor(edges)

    def apply_filter(
        sixteenths: NDArray[np.int16], left: NDArray[np.uint8], back: NDArray[np.int16]
    ) -> NDArray[np.int16]:
        return np.array(wls_filter.filter(sixteenths, left, None, back), dtype=np.int16)

    return apply_filter


def _make_sgbm(numbers: Mapping[str, int | None]) -> Callable[..., Any]:
    names = {
        "min_disparity": "minDisparity",
        "num_disparities": "numDisparities",
        "block_size": "blockSize",
        "P1": "P1",
        "P2": "P2",
        "uniqueness_ratio": "uniquenessRatio",
        "pre_filter_cap": "preFilterCap",
        "mode": "mode",
        "disp12_max_diff": "disp12MaxDiff",
    }
    given = {names[name]: value for name, value in numbers.items() if name in names}
    # speckles are removed after both directions were compared
    compute: Callable[..., Any] = (
        load("cv2").StereoSGBM_create(**given, speckleWindowSize=0).compute
    )
    return compute


def _make_bm(numbers: Mapping[str, int | None]) -> Callable[..., Any]:
    matcher = load("cv2").StereoBM_create(numbers["num_disparities"], numbers["block_size"])
    matcher.setMinDisparity(numbers["min_disparity"])
    matcher.setUniquenessRatio(numbers["uniqueness_ratio"])
    matcher.setPreFilterType(numbers["pre_filter_type"])
    matcher.setPreFilterSize(numbers["pre_filter_size"])
    matcher.setPreFilterCap(numbers["pre_filter_cap"])
    matcher.setTextureThreshold(numbers["texture_threshold"])
    matcher.setDisp12MaxDiff(numbers["disp12_max_diff"])
    matcher.setSpeckleWindowSize(0)
    compute: Callable[..., Any] = matcher.compute
    return compute


_ALGORITHMS: Final[dict[str, Callable[[Mapping[str, int | None]], Callable[..., Any]]]] = {
    "sgbm": _make_sgbm,
    "bm": _make_bm,
}
