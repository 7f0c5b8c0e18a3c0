"""From what a camera sends to red, green and blue, and from these to grey."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


FRACTION_BITS: Final = 16
"""Bits behind the binary point of the sums below, for samples of 8 bits."""

DEEP_FRACTION_BITS: Final = 12
"""Bits behind the binary point of the sums below, for samples of up to 16 bits: the sums have room
in 32."""


class Matrix(NamedTuple):
    """The meaning of Y, U and V.

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
"""The matrices of ITU-R BT.601, as V4L2 takes it for cameras and JPEG has it with full range, of
BT.709 (HD video) and of BT.2020 with non-constant luminance (UHD video)."""


@lru_cache(maxsize=8)
def _tables(matrix: Matrix, depth: int) -> dict[str, NDArray[np.int32]]:
    """Return the share of each value of Y, U and V in a colour, as a whole number of fractions."""
    green = 1 - matrix.red - matrix.blue
    step, most = 2 ** (depth - 8), 2**depth - 1
    luma, chroma = (1.0, 1.0) if matrix.full else (most / 219 / step, most / 224 / step)
    of_v, of_u = 2 * (1 - matrix.red) * chroma, 2 * (1 - matrix.blue) * chroma
    value = np.arange(2.0**depth)
    middle = 128 * step
    parts = {
        "y": luma * (value - (0 if matrix.full else 16 * step)) + 0.5,
        "red of v": of_v * (value - middle),
        "green of v": -of_v * matrix.red / green * (value - middle),
        "green of u": -of_u * matrix.blue / green * (value - middle),
        "blue of u": of_u * (value - middle),
    }
    one = 2 ** _fraction_bits(depth)
    return {name: np.rint(part * one).astype(np.int32) for name, part in parts.items()}


def _fraction_bits(depth: int) -> int:
    return FRACTION_BITS if depth == 8 else DEEP_FRACTION_BITS


def yuv_to_rgb(
    y: NDArray[Any], u: NDArray[Any], v: NDArray[Any], matrix: Matrix, depth: int = 8
) -> NDArray[Any]:
    """Return the colours, (H, W, 3); each U and V is taken for all the pixels that share it.

    Args:
        y: brightness, (H, W), unsigned.
        u: difference of blue, with as many or fewer rows and columns.
        v: difference of red, of the same shape.
        matrix: the meaning of the three.
        depth: bits of a sample, 8 to 16; the colours have as many.
    """
    tables, most = _tables(matrix, depth), 2**depth - 1
    if depth < 8 * y.dtype.itemsize:  # bits above the depth, which mean nothing
        y, u, v = (np.minimum(one, most) for one in (y, u, v))
    bright = tables["y"][y]
    shares = (
        tables["red of v"][v],
        tables["green of v"][v] + tables["green of u"][u],
        tables["blue of u"][u],
    )
    colours = np.empty((*y.shape, 3), y.dtype)
    fraction = _fraction_bits(depth)
    for channel, share in enumerate(shares):
        total = (bright + _spread(share, *y.shape)) >> fraction
        colours[..., channel] = np.clip(total, 0, most)
    return colours


def _spread(share: NDArray[np.int32], height: int, width: int) -> NDArray[np.int32]:
    for axis, size in ((0, height), (1, width)):
        if share.shape[axis] != size:
            share = np.repeat(share, 2, axis=axis)
    return share[:height, :width]


class Colours(NamedTuple):
    """The conversions of a picture's samples to grey and to colours.

    Attributes:
        grey: function that makes the brightness of the samples; None: they have none.
        rgb: function that makes red, green and blue of the samples; None: they have none.
        is_grey: True if the samples are the brightness themselves.
    """

    grey: Callable[[NDArray[Any]], NDArray[Any]] | None
    rgb: Callable[[NDArray[Any]], NDArray[Any]] | None
    is_grey: bool = False


def _itself(samples: NDArray[Any]) -> NDArray[Any]:
    return samples


def _threefold(samples: NDArray[Any]) -> NDArray[Any]:
    return np.broadcast_to(samples[..., None], (*samples.shape, 3))


def _swapped(samples: NDArray[Any]) -> NDArray[Any]:
    return samples[..., 2::-1]


def _without_alpha(samples: NDArray[Any]) -> NDArray[Any]:
    return samples[..., :3]


def _widened(samples: NDArray[Any]) -> NDArray[Any]:
    """Return the full range of samples of 16 to 235."""
    wide: NDArray[Any] = _wider()[samples]
    return wide


@lru_cache(maxsize=1)
def _wider() -> NDArray[np.uint8]:
    wide = (np.arange(256.0) - 16) * 255 / 219
    return np.clip(np.rint(wide), 0, 255).astype(np.uint8)


def _brightness(rgb: NDArray[Any]) -> NDArray[Any]:
    """Return Y of BT.601, full range, rounded."""
    weights = np.array([19595, 38470, 7471], np.uint32)  # 0.299, 0.587, 0.114 times 2 ** 16
    total: NDArray[np.uint32] = rgb @ weights
    return ((total + 2**15) >> 16).astype(rgb.dtype)


def _demosaiced(pattern: str, to: str) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return a function that makes grey or colours of a Bayer pattern, named by its first pixels.

    OpenCV names a pattern by the second row's second and third pixel, so RG is its BG.
    """
    named = {"RG": "BG", "GR": "GB", "GB": "GR", "BG": "RG"}[pattern]

    def convert(samples: NDArray[Any]) -> NDArray[Any]:
        cv2 = load("cv2")
        made: NDArray[Any] = cv2.cvtColor(samples, getattr(cv2, f"COLOR_Bayer{named}2{to}"))
        return made

    return convert


COLOURS: Final = {
    "grey": Colours(_itself, _threefold, is_grey=True),
    "rgb": Colours(_brightness, _itself),
    "bgr": Colours(lambda samples: _brightness(_swapped(samples)), _swapped),
    "rgba": Colours(lambda samples: _brightness(samples[..., :3]), _without_alpha),
    "bgra": Colours(lambda samples: _brightness(_swapped(samples)), _swapped),
    "rgb limited": Colours(lambda samples: _brightness(_widened(samples)), _widened),
    "bgr limited": Colours(
        lambda samples: _brightness(_widened(_swapped(samples))),
        lambda samples: _widened(_swapped(samples)),
    ),
    "depth": Colours(None, None),
} | {
    pattern: Colours(_demosaiced(pattern, "GRAY"), _demosaiced(pattern, "RGB"))
    for pattern in ("RG", "GR", "GB", "BG")
}
"""Conversions by their names in the formats' table; the last four are Bayer patterns."""
