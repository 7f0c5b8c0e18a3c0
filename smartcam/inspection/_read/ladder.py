"""Read codes that a first reading has missed: prepare the picture in several ways, and read again.

A *rung* is one way to prepare the picture, such as sharpened or twice as large. Each rung reads
some codes of the test pictures that the rungs before it miss. Rungs that read more additional codes
per second come first; ``tests.inspection.proofs.codes`` measures that.
"""

from __future__ import annotations

import math
import time
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.inspection._read.codes import ReadCode, read_codes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Affine = NDArray[np.float64]
    Prepared = tuple[NDArray[np.uint8], Affine]

MAX_RUNG_PIXELS: Final = 16_000_000
"""Largest number of pixels of a prepared picture; rungs that would make a larger one are
skipped."""

KINDS_TO_CONFIRM: Final = frozenset(
    {
        *("Codabar", "Code32", "Code39", "Code39Ext", "Code39Std", "Code93", "Code128"),
        *("DXFilmEdge", "EAN13", "EAN8", "EANUPC", "ISBN", "ITF", "ITF14", "PZN", "UPCA", "UPCE"),
        *("Telepen", "TelepenAlpha", "TelepenNumeric", "OtherBarcode"),
        *("DataBar", "DataBarLtd", "DataBarOmni", "DataBarStk", "DataBarStkOmni"),
        *("PDF417", "CompactPDF417", "MicroPDF417"),
    }
)
"""Kinds of codes that may be misread: those with a weak checksum or none, and those of stacked
rows. In a prepared picture, such a code counts only if it is read twice, with equal contents: by
another rung, or by the same rung in a smaller picture."""

CONFIRMING_SCALE: Final = 0.9
"""Scale of the picture for the second reading by the same rung, so that its pixels are at other
places of the code."""

MAX_SAME_PLACE: Final = 0.5
"""Largest distance between two readings of one code, as a share of the code's longest edge."""


class Rung(NamedTuple):
    """One preparation of the picture.

    Attributes:
        name: description of the preparation.
        prepare: function that returns the prepared picture, and the affine map from its pixels to
            pixels of the given picture.
        scale: ratio of the prepared picture's width to the width of the given picture.
        binarizer: zxing-cpp's name of the binarizer.
    """

    name: str
    prepare: Callable[[NDArray[np.uint8]], Prepared]
    scale: float = 1.0
    binarizer: str = "LocalAverage"


class CodeSearch(NamedTuple):
    """The picture to read, and the wanted codes.

    Attributes:
        grey: picture, (H, W).
        formats: wanted kinds.
        origin: place of the first pixel of ``grey`` in the picture to which corners refer.
        is_in_region: function that returns whether a code lies in the region.
    """

    grey: NDArray[np.uint8]
    formats: Any
    origin: tuple[float, float]
    is_in_region: Callable[[ReadCode], bool]


def read_again(
    search: CodeSearch, codes_read: Sequence[ReadCode], count: int, deadline: float, duration: float
) -> list[ReadCode]:
    """Try rungs until enough codes are read; return ``codes_read`` and the additional codes.

    Args:
        search: the picture and the wanted codes.
        codes_read: codes that the first reading has found.
        count: number of codes that is enough.
        deadline: time of ``time.monotonic()`` at which this function must end; rungs that would
            probably take longer are skipped.
        duration: duration of the first reading, seconds, from which a rung's is estimated.
    """
    grey = search.grey
    codes = list(codes_read)
    unconfirmed: list[ReadCode] = []
    for rung in RUNGS:
        if len(codes) >= count:
            break
        cost = max(rung.scale**2, 1.0)
        if cost * grey.size > MAX_RUNG_PIXELS or time.monotonic() + cost * duration > deadline:
            continue
        codes_in_smaller: list[ReadCode] | None = None
        for code in _read_with_rung(rung, search):
            if not search.is_in_region(code) or any(_is_same_code(code, other) for other in codes):
                continue
            if code.kind in KINDS_TO_CONFIRM and not any(
                _is_same_code(code, other) for other in unconfirmed
            ):
                if codes_in_smaller is None:
                    codes_in_smaller = _read_with_rung(rung, search, CONFIRMING_SCALE)
                if not any(_is_same_code(code, other) for other in codes_in_smaller):
                    unconfirmed.append(code)
                    continue
            codes.append(code)
    return codes


def _read_with_rung(rung: Rung, search: CodeSearch, scale: float = 1.0) -> list[ReadCode]:
    """Return the codes that one rung finds, in the picture or in a scaled copy."""
    grey = search.grey if scale == 1.0 else _resize(search.grey, scale)
    prepared, to_picture = rung.prepare(grey)
    scale_map = _scale_map(scale)
    to_picture = scale_map[:, :2] @ to_picture + np.column_stack(
        [np.zeros((2, 2)), scale_map[:, 2]]
    )
    to_picture[:, 2] += search.origin
    contiguous = np.ascontiguousarray(prepared)
    return read_codes(contiguous, search.formats, to_picture, rung.binarizer, rung.name)


def _is_same_code(one: ReadCode, other: ReadCode) -> bool:
    if one.data != other.data or one.kind != other.kind:
        return False
    longest_edge = max(
        math.dist(a, b) for a, b in zip(other.corners, other.corners[1:], strict=False)
    )
    return math.dist(one.centre, other.centre) <= MAX_SAME_PLACE * max(longest_edge, 1.0)


# ---------------------------------------------------------------------- preparations


def _scale_map(scale: float) -> Affine:
    """Return the affine map from a scaled picture's pixels to the unscaled picture's pixels."""
    shift = 0.5 / scale - 0.5
    return np.array([[1 / scale, 0, shift], [0, 1 / scale, shift]])


def _resize(grey: NDArray[np.uint8], scale: float) -> NDArray[np.uint8]:
    cv2 = load("cv2", "inspection needs")
    flags = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    size = [max(round(side * scale), 1) for side in (grey.shape[1], grey.shape[0])]
    resized: NDArray[np.uint8] = cv2.resize(grey, size, interpolation=flags)
    return resized


def _blur(grey: NDArray[np.uint8], sigma: float) -> NDArray[np.uint8]:
    blurred: NDArray[np.uint8] = load("cv2", "inspection needs").GaussianBlur(grey, (0, 0), sigma)
    return blurred


def _sharpen(grey: NDArray[np.uint8], sigma: float, amount: float) -> NDArray[np.uint8]:
    cv2 = load("cv2", "inspection needs")
    sharp: NDArray[np.uint8] = cv2.addWeighted(grey, 1 + amount, _blur(grey, sigma), -amount, 0)
    return sharp


def _local_contrast(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    cv2 = load("cv2", "inspection needs")
    equalized: NDArray[np.uint8] = cv2.createCLAHE(3.0, (8, 8)).apply(grey)
    return equalized


def _median(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    smooth: NDArray[np.uint8] = load("cv2", "inspection needs").medianBlur(grey, 5)
    return smooth


def _threshold(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a binary picture by Otsu's threshold."""
    cv2 = load("cv2", "inspection needs")
    binary: NDArray[np.uint8] = cv2.threshold(grey, 0, 255, cv2.THRESH_OTSU)[1]
    return binary


def _local_threshold(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a binary picture with the neighbourhood's mean as the threshold."""
    cv2 = load("cv2", "inspection needs")
    flags = cv2.ADAPTIVE_THRESH_GAUSSIAN_C
    binary: NDArray[np.uint8] = cv2.adaptiveThreshold(grey, 255, flags, cv2.THRESH_BINARY, 51, 4)
    return binary


def _rotate(grey: NDArray[np.uint8], degrees: float) -> Prepared:
    """Return the picture, rotated clockwise on a white background."""
    cv2 = load("cv2", "inspection needs")
    height, width = grey.shape
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    size = (
        math.ceil(width * abs(cos) + height * abs(sin)),
        math.ceil(width * abs(sin) + height * abs(cos)),
    )
    to_picture = np.array([[cos, sin, 0.0], [-sin, cos, 0.0]])
    middle = (np.array(size) - 1) / 2
    to_picture[:, 2] = ((width - 1) / 2, (height - 1) / 2) - to_picture[:, :2] @ middle
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    rotated: NDArray[np.uint8] = cv2.warpAffine(
        grey, to_picture, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=255
    )
    return rotated, to_picture


def _make_rung(
    name: str,
    *steps: Callable[[NDArray[np.uint8]], NDArray[np.uint8]],
    scale: float = 1.0,
    binarizer: str = "LocalAverage",
) -> Rung:
    """Return the rung that scales the picture, then applies the steps."""

    def prepare(grey: NDArray[np.uint8]) -> Prepared:
        result = grey if scale == 1.0 else _resize(grey, scale)
        for step in steps:
            result = step(result)
        return result, _scale_map(scale)

    return Rung(name, prepare, scale, binarizer)


def _make_rotation_rung(degrees: float) -> Rung:
    return Rung(f"turned by {degrees:g} degrees", lambda grey: _rotate(grey, degrees), 1.3)


_FIXED: Final = "FixedThreshold"

RUNGS: Final[tuple[Rung, ...]] = (
    _make_rung(
        "half as large, blurred, threshold",
        partial(_blur, sigma=1.0),
        _threshold,
        scale=0.5,
        binarizer=_FIXED,
    ),
    _make_rung("local contrast", _local_contrast),
    _make_rung("median, threshold", _median, _threshold, binarizer=_FIXED),
    _make_rung("a quarter as large, blurred", partial(_blur, sigma=1.0), scale=0.25),
    _make_rung("inverted, threshold", np.invert, _threshold, binarizer=_FIXED),
    _make_rung("1.5 times as large", scale=1.5),
    _make_rotation_rung(-22),
    _make_rung("local threshold", _local_threshold, binarizer=_FIXED),
    _make_rung("twice as large, sharpened", partial(_sharpen, sigma=3.0, amount=3.0), scale=2),
    _make_rung("twice as large, local contrast", _local_contrast, scale=2),
    _make_rotation_rung(22),
    _make_rotation_rung(45),
    _make_rung("twice as large, one threshold", scale=2, binarizer="GlobalHistogram"),
    _make_rung(
        "twice as large, sharpened, local contrast",
        partial(_sharpen, sigma=3.0, amount=2.0),
        _local_contrast,
        scale=2,
    ),
)
"""All rungs in the order in which they are tried."""
