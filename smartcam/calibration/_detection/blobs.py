"""Spots in an image: filled, as round as a tilted dot, darker than what lies around them.

What is darker than the mean of its surroundings is cut into pieces that hang together. A piece
whose area is that of the ellipse with its second moments is a spot: letters, lines, rings and
corners have less. How large the surroundings are decides how large a dot may be and still be dark
all over; a few sizes cover all grids that an image can show.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.calibration._optional_imports import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._geometry.rotations import Array

LEAST_STEP = 7
"""Grey levels of 255 by which a pixel is darker than the mean around it at least."""

LEAST_AREA = 9
"""Pixels of a spot at least."""

LARGEST_PART = 1 / 16
"""Of an image, the area of a spot at most: a grid has nine dots or more."""

LEAST_FILLED = 0.85
"""Of the ellipse with a piece's second moments, what the piece fills at least: a rectangle has
0.955, a triangle 0.83."""

MOST_LONG = 6.0
"""Times as long as wide at most: a dot that is seen 80 degrees from the front."""


class Spots(NamedTuple):
    """What may be dots."""

    points: Array  # (N, 2), middles, pixels
    areas: Array  # (N,), pixels^2


def dark_spots(image: NDArray[np.uint8], around: int, *, most: int) -> Spots:
    """Return the spots of an image (H, W).

    ``around``: side of the square whose mean a pixel is compared with; about two of the distances
    between dots. ``most``: pieces that are looked at, the largest ones.
    """
    cv2 = load("cv2")
    smooth = cv2.blur(image, (3, 3))
    side = max(3, around | 1)
    dark = cv2.adaptiveThreshold(
        smooth, 1, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, side, LEAST_STEP
    )
    count, labels, boxes, middles = cv2.connectedComponentsWithStats(dark, connectivity=4)
    _, _, wide, high, areas = boxes.T
    chosen = (areas >= LEAST_AREA) & (areas <= LARGEST_PART * image.size)
    chosen &= areas >= wide * high / (2 * MOST_LONG)
    chosen[0] = False
    kept = np.flatnonzero(chosen)
    if len(kept) > most:
        kept = kept[np.argsort(areas[kept])[-most:]]
    number = np.full(count, -1, dtype=np.int32)
    number[kept] = np.arange(len(kept))
    pieces = Spots(middles[kept].astype(np.float64), areas[kept].astype(np.float64))
    good = _filled(number[labels], pieces)
    return Spots(pieces.points[good], pieces.areas[good])


def _filled(number: NDArray[np.int32], pieces: Spots) -> NDArray[np.bool_]:
    """Return whether each piece fills an ellipse that is not too long.

    ``number`` (H, W) says which piece each pixel is of; -1: none.
    """
    count = len(pieces.areas)
    v, u = np.nonzero(number >= 0)
    which = number[v, u]
    x, y = u - pieces.points[which, 0], v - pieces.points[which, 1]
    # An ellipse with half axes a and b has second moments a^2 / 4 and b^2 / 4 along them: its area,
    # pi a b, is 4 pi sqrt(det M). The larger eigenvalue of M over sqrt(det M) is a / b.
    xx, xy, yy = (np.bincount(which, of, count) / pieces.areas for of in (x * x, x * y, y * y))
    xx, yy = xx + 1 / 12, yy + 1 / 12  # a pixel's own: the variance of a side of 1
    spread = np.sqrt(np.maximum(xx * yy - xy * xy, 0))
    mean = (xx + yy) / 2
    longest = mean + np.sqrt(np.maximum(mean * mean - spread * spread, 0))
    filled: NDArray[np.bool_] = (pieces.areas >= LEAST_FILLED * 4 * np.pi * spread) & (
        longest <= MOST_LONG * spread
    )
    return filled
