"""Convert colours by OpenCV if it is installed; its values may differ by one from exact ones."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._extras import load
from smartcam.exceptions import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MIN_LIMITED_Y: Final = 16
"""Y of black in limited range; OpenCV's conversions raise a smaller Y to this value."""

BAND_BYTES: Final = 1 << 17
"""Number of bytes of colours that are computed at a time, so that intermediate values stay in the
processor's cache."""


@cache
def opencv() -> Any:
    """Return OpenCV; None if it is not installed."""
    try:
        return load("cv2")
    except MissingExtraError:
        return None


def apply_table(table: NDArray[Any], samples: NDArray[np.uint8]) -> NDArray[Any]:
    """Return the table's value for each sample, from a table of 256 values."""
    cv2 = opencv()
    values: NDArray[Any]
    values = table.take(samples, mode="clip") if cv2 is None else cv2.LUT(samples, table)
    return values


def pairs_to_rgb(pairs: NDArray[np.uint8], y: int) -> NDArray[np.uint8] | None:
    """Return the colours (H, W, 3) of pairs of BT.601 in limited range.

    Args:
        pairs: (H, W, 2): Y, and alternately U or V; W is even.
        y: index of Y in a pair.

    Returns:
        The colours; None if a Y is below limited range, or OpenCV is not installed.
    """
    cv2 = opencv()
    if cv2 is None or pairs.min(axis=0)[:, y].min() < MIN_LIMITED_Y:
        return None
    result: NDArray[np.uint8]
    result = cv2.cvtColor(pairs, cv2.COLOR_YUV2RGB_UYVY if y else cv2.COLOR_YUV2RGB_YUY2)
    return result


def planes_to_rgb(
    y: NDArray[Any],
    chroma: Sequence[NDArray[Any]],
    weights: NDArray[np.float64],
    max_value: int,
    *,
    is_bt601: bool,
) -> NDArray[Any]:
    """Return the colours (H, W, 3) of planes, by OpenCV.

    Args:
        y: (H, W).
        chroma: U and V, (h, w) each, or one plane (h, w, 2) with both; each value is taken for all
            the pixels that share it.
        weights: (3, 4), weights of Y, U, V and 1 in red, green and blue.
        max_value: largest value of a sample.
        is_bt601: whether the planes have 8 bits, BT.601 and limited range.
    """
    cv2, (height, width), (rows, columns) = opencv(), y.shape, chroma[0].shape[:2]
    if is_bt601 and (height, width) == (2 * rows, 2 * columns) and y.min() >= MIN_LIMITED_Y:
        result: NDArray[Any]
        result = cv2.cvtColorTwoPlane(y, cv2.merge(chroma), cv2.COLOR_YUV2RGB_NV12)
        return result
    across, down = 1 + (columns < width), 1 + (rows < height)
    colours, has_spare_bits = (
        np.empty((height, width, 3), y.dtype),
        max_value < np.iinfo(y.dtype).max,
    )
    step = -(-BAND_BYTES // (colours.strides[0] * down))
    for top in range(0, rows, step):
        chroma_band = [plane[top : top + step] for plane in chroma]
        if across * down > 1:
            interleaved = cv2.merge(chroma_band)
            chroma_band = [_repeat_pixels(interleaved, across, down)]
        band = slice(top * down, (top + step) * down)
        merged = cv2.merge(
            [y[band], *(plane[: height - band.start, :width] for plane in chroma_band)]
        )
        if has_spare_bits:  # bits above the depth have no meaning
            cv2.threshold(merged, max_value, 0, cv2.THRESH_TRUNC, merged)
        rgb = cv2.transform(merged, weights)
        colours[band] = (
            cv2.threshold(rgb, max_value, 0, cv2.THRESH_TRUNC)[1] if has_spare_bits else rgb
        )
    return colours


def _repeat_pixels(chroma: NDArray[Any], across: int, down: int) -> NDArray[Any]:
    """Return U and V (h * down, w * across, 2) for the pixels that share them.

    ``chroma``: (h, w, 2), contiguous; ``across`` and ``down`` are 1 or 2.
    """
    cv2, (height, width, _) = opencv(), chroma.shape
    repeated: NDArray[Any]
    if (across, down) == (2, 1):  # merging is five times as fast as resizing
        both = chroma.view(f"i{2 * chroma.itemsize}")
        repeated = cv2.merge([both, both]).view(chroma.dtype).reshape(height, 2 * width, 2)
        return repeated
    size = (width * across, height * down)
    repeated = cv2.resize(chroma, size, interpolation=cv2.INTER_NEAREST)
    return repeated
