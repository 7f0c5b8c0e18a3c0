"""From what a camera sends to red, green and blue, and from these to grey."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam.frames._optional_imports import load

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray


FRACTION: Final = 16
"""Bits behind the point of the sums below."""


class Matrix(NamedTuple):
    """What Y, U and V mean.

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
}
"""ITU-R BT.601 as V4L2 takes it for cameras, as JPEG has it, and BT.709 as in HD video."""


@lru_cache(maxsize=len(MATRICES))
def _tables(matrix: Matrix) -> dict[str, NDArray[np.int32]]:
    """Return what each value of Y, U and V adds to a colour, times 2 ** FRACTION."""
    green = 1 - matrix.red - matrix.blue
    luma, chroma = (1.0, 1.0) if matrix.full else (255 / 219, 255 / 224)
    of_v, of_u = 2 * (1 - matrix.red) * chroma, 2 * (1 - matrix.blue) * chroma
    value = np.arange(256.0)
    parts = {
        "y": luma * (value - (0 if matrix.full else 16)) + 0.5,
        "red of v": of_v * (value - 128),
        "green of v": -of_v * matrix.red / green * (value - 128),
        "green of u": -of_u * matrix.blue / green * (value - 128),
        "blue of u": of_u * (value - 128),
    }
    return {name: np.rint(part * 2**FRACTION).astype(np.int32) for name, part in parts.items()}


def yuv_to_rgb(
    y: NDArray[np.uint8], u: NDArray[np.uint8], v: NDArray[np.uint8], matrix: Matrix
) -> NDArray[np.uint8]:
    """Return the colours, (H, W, 3); each U and V is taken for all the pixels that share it."""
    tables = _tables(matrix)
    bright = tables["y"][y]
    shares = (
        tables["red of v"][v],
        tables["green of v"][v] + tables["green of u"][u],
        tables["blue of u"][u],
    )
    colours = np.empty((*y.shape, 3), np.uint8)
    for channel, share in enumerate(shares):
        total = (bright + _spread(share, *y.shape)) >> FRACTION
        colours[..., channel] = np.clip(total, 0, 255)
    return colours


def _spread(share: NDArray[np.int32], height: int, width: int) -> NDArray[np.int32]:
    for axis, size in ((0, height), (1, width)):
        if share.shape[axis] != size:
            share = np.repeat(share, 2, axis=axis)
    return share[:height, :width]


class Colours(NamedTuple):
    """What the samples of a picture mean.

    Attributes:
        grey: makes the brightness of them; None: they have none.
        rgb: makes red, green and blue of them; None: they have none.
        is_grey: they are the brightness; nothing is made.
    """

    grey: Callable[[NDArray[Any]], NDArray[Any]] | None
    rgb: Callable[[NDArray[Any]], NDArray[Any]] | None
    is_grey: bool = False


def _itself(samples: NDArray[Any]) -> NDArray[Any]:
    return samples


def _threefold(samples: NDArray[Any]) -> NDArray[Any]:
    return np.broadcast_to(samples[..., None], (*samples.shape, 3))


def _swapped(samples: NDArray[Any]) -> NDArray[Any]:
    return samples[..., ::-1]


def _brightness(rgb: NDArray[Any]) -> NDArray[Any]:
    """Return Y of BT.601, full range, rounded."""
    weights = np.array([19595, 38470, 7471], np.uint32)  # 0.299, 0.587, 0.114 times 2 ** 16
    total: NDArray[np.uint32] = rgb @ weights
    return ((total + 2**15) >> 16).astype(rgb.dtype)


def _demosaiced(pattern: str, to: str) -> Callable[[NDArray[Any]], NDArray[Any]]:
    """Return what makes grey or colours of a Bayer pattern, which begins as its name says.

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
    "depth": Colours(None, None),
} | {
    pattern: Colours(_demosaiced(pattern, "GRAY"), _demosaiced(pattern, "RGB"))
    for pattern in ("RG", "GR", "GB", "BG")
}
"""By what the formats' table calls them; the last four are Bayer patterns by their first row."""
