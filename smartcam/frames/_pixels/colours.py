"""Convert a camera's samples to red, green and blue, and these to grey."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.frames._pixels.compiled import apply_table, opencv, planes_to_rgb

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    _Conversion = Callable[[NDArray[Any]], NDArray[Any]]

FRACTION_BITS: Final = 16
"""Number of fractional bits in fixed-point sums of colours, for samples of 8 bits."""

DEEP_FRACTION_BITS: Final = 12
"""Number of fractional bits in fixed-point sums of colours, for samples of up to 16 bits, so that
the sums fit into 32 bits."""


class Matrix(NamedTuple):
    """The coefficients that define Y, U and V.

    Attributes:
        red: share of red in Y.
        blue: share of blue in Y.
        is_full_range: whether Y is 0 to 255; else Y is 16 to 235, and U and V are 16 to 240.
    """

    red: float
    blue: float
    is_full_range: bool


MATRICES: Final = {
    "601": Matrix(0.299, 0.114, is_full_range=False),
    "601 full": Matrix(0.299, 0.114, is_full_range=True),
    "709": Matrix(0.2126, 0.0722, is_full_range=False),
    "709 full": Matrix(0.2126, 0.0722, is_full_range=True),
    "2020": Matrix(0.2627, 0.0593, is_full_range=False),
    "2020 full": Matrix(0.2627, 0.0593, is_full_range=True),
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
    neutral: float  # value of U and V without colour


def _weights(matrix: Matrix, depth: int) -> _Weights:
    green = 1 - matrix.red - matrix.blue
    step, max_value = 2 ** (depth - 8), 2**depth - 1
    luma, chroma = (
        (1.0, 1.0) if matrix.is_full_range else (max_value / 219 / step, max_value / 224 / step)
    )
    red_of_v, blue_of_u = 2 * (1 - matrix.red) * chroma, 2 * (1 - matrix.blue) * chroma
    return _Weights(
        luma,
        red_of_v,
        -blue_of_u * matrix.blue / green,
        -red_of_v * matrix.red / green,
        blue_of_u,
        0 if matrix.is_full_range else 16 * step,
        128 * step,
    )


@lru_cache(maxsize=8)
def _rgb_weights(matrix: Matrix, depth: int) -> NDArray[np.float64]:
    """Return the weights of Y, U, V and the constant 1 in red, green and blue, (3, 4)."""
    weights = _weights(matrix, depth)
    shares = np.array(
        [
            [weights.luma, 0, weights.red_of_v],
            [weights.luma, weights.green_of_u, weights.green_of_v],
            [weights.luma, weights.blue_of_u, 0],
        ]
    )
    return np.column_stack([shares, -shares @ [weights.black, weights.neutral, weights.neutral]])


@lru_cache(maxsize=8)
def _tables(matrix: Matrix, depth: int) -> dict[str, NDArray[np.int32]]:
    """Return the contribution of each value of Y, U and V to a colour, as a fixed-point integer."""
    weights = _weights(matrix, depth)
    value = np.arange(2.0**depth)
    chroma = value - weights.neutral
    contributions = {
        "y": weights.luma * (value - weights.black) + 0.5,
        "red of v": weights.red_of_v * chroma,
        "green of v": weights.green_of_v * chroma,
        "green of u": weights.green_of_u * chroma,
        "blue of u": weights.blue_of_u * chroma,
    }
    scale = 2 ** _fraction_bits(depth)
    return {
        name: np.rint(contribution * scale).astype(np.int32)
        for name, contribution in contributions.items()
    }


def _fraction_bits(depth: int) -> int:
    return FRACTION_BITS if depth == 8 else DEEP_FRACTION_BITS


def yuv_to_rgb(
    y: NDArray[Any], chroma: Sequence[NDArray[Any]], matrix: Matrix, depth: int = 8
) -> NDArray[Any]:
    """Return the colours, (H, W, 3); each U and V is used for all pixels that share it.

    The colours are rounded exactly; OpenCV is faster, and may differ by one level.

    Args:
        y: brightness, (H, W), unsigned.
        chroma: differences of blue and of red, U and V, (h, w) each, with the same or smaller
            numbers of rows and columns; or one array (h, w, 2) with both.
        matrix: definition of Y, U and V.
        depth: bits of a sample, 8 to 16, and of a colour.
    """
    if opencv() is not None:
        is_bt601 = depth == 8 and matrix == MATRICES["601"]
        weights = _rgb_weights(matrix, depth)
        return planes_to_rgb(y, chroma, weights, 2**depth - 1, is_bt601=is_bt601)
    u, v = chroma if len(chroma) == 2 else (chroma[0][..., 0], chroma[0][..., 1])
    return _yuv_to_rgb_by_tables(y, u, v, _tables(matrix, depth), depth)


def _yuv_to_rgb_by_tables(
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
        total = bright + _repeat_chroma(share, *y.shape)
        total >>= fraction
        colours[..., channel] = np.clip(total, 0, 2**depth - 1, out=total)
    return colours


def _repeat_chroma(share: NDArray[np.int32], height: int, width: int) -> NDArray[np.int32]:
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


def _unchanged(samples: NDArray[Any]) -> NDArray[Any]:
    return samples


def _grey_to_rgb(samples: NDArray[Any]) -> NDArray[Any]:
    return np.broadcast_to(samples[..., None], (*samples.shape, 3))


def _bgr_to_rgb(samples: NDArray[Any]) -> NDArray[Any]:
    return samples[..., 2::-1]


def _without_alpha(samples: NDArray[Any]) -> NDArray[Any]:
    return samples[..., :3]


def _to_rgb(kind: str, by_numpy: _Conversion) -> _Conversion:
    """Return a function that converts samples to colours by OpenCV's ``COLOR_<kind>2RGB``."""

    def convert(samples: NDArray[Any]) -> NDArray[Any]:
        cv2 = opencv()
        if cv2 is None:
            return by_numpy(samples)
        result: NDArray[Any] = cv2.cvtColor(samples, getattr(cv2, f"COLOR_{kind}2RGB"))
        return result

    return convert


def _to_grey(kind: str, by_numpy: _Conversion) -> _Conversion:
    """Return a function that converts samples to brightness by OpenCV's ``COLOR_<kind>2GRAY``."""

    def convert(samples: NDArray[Any]) -> NDArray[Any]:
        cv2 = opencv()
        if cv2 is None or samples.dtype != np.uint8:  # of 16 bits, OpenCV may err by two levels
            return _brightness(by_numpy(samples))
        result: NDArray[Any] = cv2.cvtColor(samples, getattr(cv2, f"COLOR_{kind}2GRAY"))
        return result

    return convert


def _to_full_range(samples: NDArray[Any]) -> NDArray[Any]:
    """Widen samples of 16 to 235 to the full range."""
    return apply_table(_full_range_table(), samples)


def _from_limited(convert: _Conversion) -> _Conversion:
    return lambda samples: convert(_to_full_range(samples))


@lru_cache(maxsize=1)
def _full_range_table() -> NDArray[np.uint8]:
    full_range = (np.arange(256.0) - 16) * 255 / 219
    return np.clip(np.rint(full_range), 0, 255).astype(np.uint8)


def _brightness(rgb: NDArray[Any]) -> NDArray[Any]:
    """Return Y of BT.601, full range, rounded."""
    cv2 = opencv()
    if cv2 is not None:
        bright: NDArray[Any] = cv2.transform(rgb, np.array([[0.299, 0.587, 0.114]]))
        return bright
    weights = np.array([19595, 38470, 7471], np.uint32)  # 0.299, 0.587, 0.114 times 2 ** 16
    total: NDArray[np.uint32] = rgb @ weights
    return ((total + 2**15) >> 16).astype(rgb.dtype)


def _demosaicing(pattern: str, target: str) -> _Conversion:
    """Return a function that demosaics a Bayer pattern, named by its first pixels.

    OpenCV names a pattern by the second row's second and third pixel, so RG is its BG.
    """
    opencv_pattern = {"RG": "BG", "GR": "GB", "GB": "GR", "BG": "RG"}[pattern]

    def convert(samples: NDArray[Any]) -> NDArray[Any]:
        cv2 = load("cv2")
        result: NDArray[Any] = cv2.cvtColor(
            samples, getattr(cv2, f"COLOR_Bayer{opencv_pattern}2{target}")
        )
        return result

    return convert


COLOURS: Final = {
    "grey": Colours(_unchanged, _to_rgb("GRAY", _grey_to_rgb), is_grey=True),
    "rgb": Colours(_to_grey("RGB", _unchanged), _unchanged),
    "bgr": Colours(_to_grey("BGR", _bgr_to_rgb), _to_rgb("BGR", _bgr_to_rgb)),
    "rgba": Colours(_to_grey("RGBA", _without_alpha), _to_rgb("RGBA", _without_alpha)),
    "bgra": Colours(_to_grey("BGRA", _bgr_to_rgb), _to_rgb("BGRA", _bgr_to_rgb)),
    "rgb limited": Colours(_from_limited(_to_grey("RGB", _unchanged)), _to_full_range),
    "bgr limited": Colours(
        _from_limited(_to_grey("BGR", _bgr_to_rgb)), _from_limited(_to_rgb("BGR", _bgr_to_rgb))
    ),
    "depth": Colours(None, None),
} | {
    pattern: Colours(_demosaicing(pattern, "GRAY"), _demosaicing(pattern, "RGB"))
    for pattern in ("RG", "GR", "GB", "BG")
}
"""Conversions by their names in the formats' table; the last four are Bayer patterns."""
