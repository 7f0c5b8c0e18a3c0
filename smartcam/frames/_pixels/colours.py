"""Convert a camera's samples to red, green and blue, and these to grey."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.frames._pixels.compiled import looked_up, opencv, planes_to_rgb

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    _Conversion = Callable[[NDArray[Any]], NDArray[Any]]

FRACTION_BITS: Final = 16
"""Number of fractional bits of the fixed-point sums below, for samples of 8 bits."""

DEEP_FRACTION_BITS: Final = 12
"""Number of fractional bits of the fixed-point sums below, for samples of up to 16 bits, so that
the sums fit into 32 bits."""


class Matrix(NamedTuple):
    """The coefficients that define Y, U and V.

    Attributes:
        red: share of red in Y.
        blue: share of blue in Y.
        full: Y is 0 to 255, else 16 to 235 with U and V from 16 to 240.
    """

    red: float
    blue: float
    full: bool


MATRICES: Final = {
    "601": Matrix(0.299, 0.114, full=False),
    "601 full": Matrix(0.299, 0.114, full=True),
    "709": Matrix(0.2126, 0.0722, full=False),
    "709 full": Matrix(0.2126, 0.0722, full=True),
    "2020": Matrix(0.2627, 0.0593, full=False),
    "2020 full": Matrix(0.2627, 0.0593, full=True),
}
"""The matrices of ITU-R BT.601 (the default of V4L2 for cameras, and of JPEG with full range), of
BT.709 (HD video) and of BT.2020 with non-constant luminance (UHD video)."""


class _Weights(NamedTuple):
    """The weights of Y, U and V in the colours."""

    luma: float
    red_of_v: float
    green_of_u: float
    green_of_v: float
    blue_of_u: float
    black: float  # value of Y for black
    middle: float  # value of U and V without colour


def _weights(matrix: Matrix, depth: int) -> _Weights:
    green = 1 - matrix.red - matrix.blue
    step, most = 2 ** (depth - 8), 2**depth - 1
    luma, chroma = (1.0, 1.0) if matrix.full else (most / 219 / step, most / 224 / step)
    of_v, of_u = 2 * (1 - matrix.red) * chroma, 2 * (1 - matrix.blue) * chroma
    return _Weights(
        luma,
        of_v,
        -of_u * matrix.blue / green,
        -of_v * matrix.red / green,
        of_u,
        0 if matrix.full else 16 * step,
        128 * step,
    )


@lru_cache(maxsize=8)
def _rows(matrix: Matrix, depth: int) -> NDArray[np.float64]:
    """Return the weights of Y, U, V and 1 in red, green and blue, (3, 4)."""
    weights = _weights(matrix, depth)
    shares = np.array(
        [
            [weights.luma, 0, weights.red_of_v],
            [weights.luma, weights.green_of_u, weights.green_of_v],
            [weights.luma, weights.blue_of_u, 0],
        ]
    )
    return np.column_stack([shares, -shares @ [weights.black, weights.middle, weights.middle]])


@lru_cache(maxsize=8)
def _tables(matrix: Matrix, depth: int) -> dict[str, NDArray[np.int32]]:
    """Return the contribution of each value of Y, U and V to a colour, as a fixed-point integer."""
    weights = _weights(matrix, depth)
    value = np.arange(2.0**depth)
    chroma = value - weights.middle
    parts = {
        "y": weights.luma * (value - weights.black) + 0.5,
        "red of v": weights.red_of_v * chroma,
        "green of v": weights.green_of_v * chroma,
        "green of u": weights.green_of_u * chroma,
        "blue of u": weights.blue_of_u * chroma,
    }
    scale = 2 ** _fraction_bits(depth)
    return {name: np.rint(part * scale).astype(np.int32) for name, part in parts.items()}


def _fraction_bits(depth: int) -> int:
    return FRACTION_BITS if depth == 8 else DEEP_FRACTION_BITS


def yuv_to_rgb(
    y: NDArray[Any], chroma: Sequence[NDArray[Any]], matrix: Matrix, depth: int = 8
) -> NDArray[Any]:
    """Return the colours, (H, W, 3); each U and V holds for all pixels that share it.

    The colours are exact to the nearest integer; with OpenCV, which is faster, to one level.

    Args:
        y: brightness, (H, W), unsigned.
        chroma: differences of blue and of red, U and V, (h, w) each, with the same or smaller
            numbers of rows and columns; or one array (h, w, 2) with both.
        matrix: definition of Y, U and V.
        depth: bits of a sample, 8 to 16, and of a colour.
    """
    if opencv() is not None:
        usual = depth == 8 and matrix == MATRICES["601"]
        return planes_to_rgb(y, chroma, _rows(matrix, depth), 2**depth - 1, usual=usual)
    u, v = chroma if len(chroma) == 2 else (chroma[0][..., 0], chroma[0][..., 1])
    return _by_tables(y, u, v, _tables(matrix, depth), depth)


def _by_tables(
    y: NDArray[Any],
    u: NDArray[Any],
    v: NDArray[Any],
    tables: dict[str, NDArray[np.int32]],
    depth: int,
) -> NDArray[Any]:
    """Compute the colours of planes by NumPy."""
    # bits above the depth have no meaning: larger values use the table's last entry
    bright = tables["y"].take(y, mode="clip")
    shares = (
        tables["red of v"].take(v, mode="clip"),
        tables["green of v"].take(v, mode="clip") + tables["green of u"].take(u, mode="clip"),
        tables["blue of u"].take(u, mode="clip"),
    )
    colours = np.empty((*y.shape, 3), y.dtype)
    fraction = _fraction_bits(depth)
    for channel, share in enumerate(shares):
        total = bright + _spread(share, *y.shape)
        total >>= fraction
        colours[..., channel] = np.clip(total, 0, 2**depth - 1, out=total)
    return colours


def _spread(share: NDArray[np.int32], height: int, width: int) -> NDArray[np.int32]:
    for axis, size in ((0, height), (1, width)):
        if share.shape[axis] != size:
            share = np.repeat(share, 2, axis=axis)
    return share[:height, :width]


class Colours(NamedTuple):
    """The conversions of a picture's samples to grey and to colours.

    Attributes:
        grey: function that computes the brightness; None if the samples have none.
        rgb: function that computes red, green and blue; None if the samples have none.
        is_grey: True if the samples are brightness.
    """

    grey: _Conversion | None
    rgb: _Conversion | None
    is_grey: bool = False


def _itself(samples: NDArray[Any]) -> NDArray[Any]:
    return samples


def _threefold(samples: NDArray[Any]) -> NDArray[Any]:
    return np.broadcast_to(samples[..., None], (*samples.shape, 3))


def _swapped(samples: NDArray[Any]) -> NDArray[Any]:
    return samples[..., 2::-1]


def _without_alpha(samples: NDArray[Any]) -> NDArray[Any]:
    return samples[..., :3]


def _to_rgb(order: str, plainly: _Conversion) -> _Conversion:
    """Return a function that converts samples to colours by OpenCV's conversion ``order``."""

    def convert(samples: NDArray[Any]) -> NDArray[Any]:
        cv2 = opencv()
        if cv2 is None:
            return plainly(samples)
        made: NDArray[Any] = cv2.cvtColor(samples, getattr(cv2, f"COLOR_{order}2RGB"))
        return made

    return convert


def _to_grey(order: str, plainly: _Conversion) -> _Conversion:
    """Return a function that converts samples to brightness by OpenCV's conversion ``order``."""

    def convert(samples: NDArray[Any]) -> NDArray[Any]:
        cv2 = opencv()
        if cv2 is None or samples.dtype != np.uint8:  # OpenCV's result may differ by two levels
            return _brightness(plainly(samples))
        made: NDArray[Any] = cv2.cvtColor(samples, getattr(cv2, f"COLOR_{order}2GRAY"))
        return made

    return convert


def _widened(samples: NDArray[Any]) -> NDArray[Any]:
    """Widen samples of 16 to 235 to the full range."""
    return looked_up(_wider(), samples)


def _of_limited(convert: _Conversion) -> _Conversion:
    return lambda samples: convert(_widened(samples))


@lru_cache(maxsize=1)
def _wider() -> NDArray[np.uint8]:
    wide = (np.arange(256.0) - 16) * 255 / 219
    return np.clip(np.rint(wide), 0, 255).astype(np.uint8)


def _brightness(rgb: NDArray[Any]) -> NDArray[Any]:
    """Return Y of BT.601, full range, rounded."""
    cv2 = opencv()
    if cv2 is not None:
        bright: NDArray[Any] = cv2.transform(rgb, np.array([[0.299, 0.587, 0.114]]))
        return bright
    weights = np.array([19595, 38470, 7471], np.uint32)  # 0.299, 0.587, 0.114 times 2 ** 16
    total: NDArray[np.uint32] = rgb @ weights
    return ((total + 2**15) >> 16).astype(rgb.dtype)


def _demosaiced(pattern: str, to: str) -> _Conversion:
    """Return a function that demosaics a Bayer pattern, named by its first pixels.

    OpenCV names a pattern by the second row's second and third pixel, so RG is its BG.
    """
    named = {"RG": "BG", "GR": "GB", "GB": "GR", "BG": "RG"}[pattern]

    def convert(samples: NDArray[Any]) -> NDArray[Any]:
        cv2 = load("cv2")
        made: NDArray[Any] = cv2.cvtColor(samples, getattr(cv2, f"COLOR_Bayer{named}2{to}"))
        return made

    return convert


COLOURS: Final = {
    "grey": Colours(_itself, _to_rgb("GRAY", _threefold), is_grey=True),
    "rgb": Colours(_to_grey("RGB", _itself), _itself),
    "bgr": Colours(_to_grey("BGR", _swapped), _to_rgb("BGR", _swapped)),
    "rgba": Colours(_to_grey("RGBA", _without_alpha), _to_rgb("RGBA", _without_alpha)),
    "bgra": Colours(_to_grey("BGRA", _swapped), _to_rgb("BGRA", _swapped)),
    "rgb limited": Colours(_of_limited(_to_grey("RGB", _itself)), _widened),
    "bgr limited": Colours(
        _of_limited(_to_grey("BGR", _swapped)), _of_limited(_to_rgb("BGR", _swapped))
    ),
    "depth": Colours(None, None),
} | {
    pattern: Colours(_demosaiced(pattern, "GRAY"), _demosaiced(pattern, "RGB"))
    for pattern in ("RG", "GR", "GB", "BG")
}
"""Conversions by their names in the formats' table; the last four are Bayer patterns."""
