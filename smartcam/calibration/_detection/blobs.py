"""Find filled, round spots in an image that are darker than their surroundings.

Pixels darker than the mean of their surroundings are joined into connected pieces. A piece whose
area is that of the ellipse with its second moments is a spot: letters, lines, rings and corners
fill less of that ellipse. The size of the surroundings limits the size of the dots that are dark
all over; a few sizes cover all grids that an image can show.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

MIN_CONTRAST = 7
"""A pixel counts as dark if it is this many grey levels (of 255) darker than the mean around it."""

MIN_SPOT_PIXELS = 9
"""A spot has at least this many pixels."""

MIN_SPECK_PIXELS, MAX_SPECK_PIXELS = 3, 24
"""Areas in pixels: a dot below the first is noise; one up to the second is called small."""

MAX_PART_OF_IMAGE = 1 / 16
"""A spot covers at most this part of the image's area: a grid has nine dots or more."""

MIN_ELLIPSE_SHARE = 0.85
"""A dot fills at least this part of the ellipse with its second moments: rectangles fill 0.955,
triangles 0.83."""

MAX_ASPECT_RATIO = 6.0
"""A dot is at most this many times as long as wide, like a circle at a tilt of 80 degrees."""


MIN_RECTANGLE_SHARE = 0.2
"""A dot fills at least this part of the upright rectangle around it: an ellipse six times as long
as wide that lies aslant fills 0.22, if it is filled as little as MIN_ELLIPSE_SHARE allows."""


class Spots(NamedTuple):
    """Dark spots that may be dots of a grid."""

    points: Array  # (N, 2), centres, pixels
    areas: Array  # (N,), pixels^2


class Pieces(NamedTuple):
    """The connected dark pieces of an image."""

    dark: NDArray[np.uint8]  # (H, W), 1 in a dark pixel, else 0
    labels: NDArray[np.int32]  # (H, W), number of the piece that a pixel belongs to, or 0
    # (N, 5): left, top, width, height, area; the first row is the background
    boxes: NDArray[np.int32]
    middles: Array  # (N, 2), pixels

    def spots(self, most: int) -> Spots:
        """Return the filled, round pieces among the ``most`` largest ones."""
        _, _, wide, high, areas = self.boxes.T
        chosen = (areas >= MIN_SPOT_PIXELS) & (areas <= MAX_PART_OF_IMAGE * self.dark.size)
        chosen &= areas >= MIN_RECTANGLE_SHARE * wide * high
        chosen[0] = False
        picked = np.flatnonzero(chosen)
        if len(picked) > most:
            picked = picked[np.argsort(areas[picked])[-most:]]
        number = np.full(len(areas), -1, dtype=np.int32)
        number[picked] = np.arange(len(picked))
        pieces = self._selected(picked)
        good = _filled(self, number, pieces)
        return Spots(pieces.points[good], pieces.areas[good])

    def specks(self) -> Spots:
        """Return the pieces that may be dots that cover only a few pixels."""
        _, _, wide, high, areas = self.boxes.T
        chosen = (areas >= MIN_SPECK_PIXELS) & (areas <= MAX_SPECK_PIXELS)
        chosen &= (wide <= MAX_ASPECT_RATIO / 2 * high) & (high <= MAX_ASPECT_RATIO / 2 * wide)
        chosen[0] = False
        return self._selected(np.flatnonzero(chosen))

    def _selected(self, which: NDArray[np.intp]) -> Spots:
        middles, areas = self.middles[which], self.boxes[which, 4]
        return Spots(middles.astype(np.float64), areas.astype(np.float64))


def dark_pieces(image: NDArray[np.uint8], around: int) -> Pieces:
    """Return the dark pieces of an image (H, W).

    ``around``: side of the square whose mean a pixel is compared with; about twice the distance
    between dots.
    """
    cv2 = load("cv2")
    smooth = cv2.blur(image, (3, 3))
    side = max(3, around | 1)
    dark = cv2.adaptiveThreshold(
        smooth, 1, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, side, MIN_CONTRAST
    )
    _, labels, boxes, middles = cv2.connectedComponentsWithStats(dark, connectivity=4)
    return Pieces(dark, labels, boxes, middles)


def _filled(all_: Pieces, number: NDArray[np.int32], pieces: Spots) -> NDArray[np.bool_]:
    """Return True for each piece that fills an ellipse which is not too long.

    ``number`` (for all pieces) is the index of a piece among ``pieces``, or -1.
    """
    count = len(pieces.areas)
    at = np.flatnonzero(all_.dark)
    which = number[all_.labels.ravel()[at]]
    chosen = which >= 0
    which = which[chosen]
    v, u = np.divmod(at[chosen], all_.dark.shape[1])
    x, y = u - pieces.points[which, 0], v - pieces.points[which, 1]
    # An ellipse with half axes a and b has second moments a^2 / 4 and b^2 / 4 along them: its area,
    # pi a b, is 4 pi sqrt(det M). The larger eigenvalue of M over sqrt(det M) is a / b.
    xx, xy, yy = (np.bincount(which, of, count) / pieces.areas for of in (x * x, x * y, y * y))
    xx, yy = xx + 1 / 12, yy + 1 / 12  # a pixel's own: the variance of a side of 1
    spread = np.sqrt(np.maximum(xx * yy - xy * xy, 0))
    mean = (xx + yy) / 2
    longest = mean + np.sqrt(np.maximum(mean * mean - spread * spread, 0))
    filled: NDArray[np.bool_] = (pieces.areas >= MIN_ELLIPSE_SHARE * 4 * np.pi * spread) & (
        longest <= MAX_ASPECT_RATIO * spread
    )
    return filled
