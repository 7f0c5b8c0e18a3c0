"""Find filled, round spots in an image that are darker than their surroundings.

Pixels darker than the mean of their surroundings are joined into connected pieces. A piece whose
area is about that of the ellipse with the same second moments is a spot: letters, lines, rings and
corners fill less of that ellipse. Dots are found only if they are smaller than these surroundings;
a few sizes of surroundings are enough for all grids that an image can show.
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
"""Least and largest area of a speck, a spot of a few pixels; smaller ones are noise."""

MAX_PART_OF_IMAGE = 1 / 16
"""A spot covers at most this fraction of the image's area: a grid has nine dots or more."""

MIN_ELLIPSE_SHARE = 0.85
"""A spot fills at least this fraction of the ellipse with its second moments: rectangles fill
0.955, triangles 0.83."""

MAX_ASPECT_RATIO = 6.0
"""A spot is at most this many times as long as wide, like a circle at a tilt of 80 degrees."""


MIN_RECTANGLE_SHARE = 0.2
"""A spot fills at least this fraction of the upright rectangle around it. A slanted ellipse six
times as long as wide fills 0.22 of its rectangle if MIN_ELLIPSE_SHARE of the ellipse is filled."""


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
    centres: Array  # (N, 2), pixels

    def find_spots(self, max_count: int) -> Spots:
        """Return the filled, round pieces among the ``max_count`` largest candidates."""
        _, _, widths, heights, areas = self.boxes.T
        is_candidate = (areas >= MIN_SPOT_PIXELS) & (areas <= MAX_PART_OF_IMAGE * self.dark.size)
        is_candidate &= areas >= MIN_RECTANGLE_SHARE * widths * heights
        is_candidate[0] = False
        indices = np.flatnonzero(is_candidate)
        if len(indices) > max_count:
            indices = indices[np.argsort(areas[indices])[-max_count:]]
        index_of_piece = np.full(len(areas), -1, dtype=np.int32)
        index_of_piece[indices] = np.arange(len(indices))
        candidates = self._as_spots(indices)
        is_spot = _fills_ellipse(self, index_of_piece, candidates)
        return Spots(candidates.points[is_spot], candidates.areas[is_spot])

    def find_specks(self) -> Spots:
        """Return the pieces that may be dots of only a few pixels."""
        _, _, widths, heights, areas = self.boxes.T
        is_candidate = (areas >= MIN_SPECK_PIXELS) & (areas <= MAX_SPECK_PIXELS)
        is_candidate &= (widths <= MAX_ASPECT_RATIO / 2 * heights) & (
            heights <= MAX_ASPECT_RATIO / 2 * widths
        )
        is_candidate[0] = False
        return self._as_spots(np.flatnonzero(is_candidate))

    def _as_spots(self, indices: NDArray[np.intp]) -> Spots:
        centres, areas = self.centres[indices], self.boxes[indices, 4]
        return Spots(centres.astype(np.float64), areas.astype(np.float64))


def find_dark_pieces(image: NDArray[np.uint8], window: int) -> Pieces:
    """Return the dark pieces of an image (H, W).

    ``window``: side of the square around a pixel, about twice the distance between dots. The pixel
    is compared with the mean of this square.
    """
    cv2 = load("cv2")
    smooth = cv2.blur(image, (3, 3))
    odd_side = max(3, window | 1)
    dark = cv2.adaptiveThreshold(
        smooth, 1, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, odd_side, MIN_CONTRAST
    )
    _, labels, boxes, centres = cv2.connectedComponentsWithStats(dark, connectivity=4)
    return Pieces(dark, labels, boxes, centres)


def _fills_ellipse(
    pieces: Pieces, index_of_piece: NDArray[np.int32], candidates: Spots
) -> NDArray[np.bool_]:
    """Return a mask of the candidates that fill an ellipse which is not too long.

    ``index_of_piece``: index of each piece among ``candidates``, or -1 if the piece is no
    candidate.
    """
    count = len(candidates.areas)
    dark_pixels = np.flatnonzero(pieces.dark)
    candidate_of_pixel = index_of_piece[pieces.labels.ravel()[dark_pixels]]
    is_candidate = candidate_of_pixel >= 0
    candidate_of_pixel = candidate_of_pixel[is_candidate]
    v, u = np.divmod(dark_pixels[is_candidate], pieces.dark.shape[1])
    x, y = (
        u - candidates.points[candidate_of_pixel, 0],
        v - candidates.points[candidate_of_pixel, 1],
    )
    # An ellipse with half axes a and b has second moments a^2 / 4 and b^2 / 4 along them: its area,
    # pi a b, is 4 pi sqrt(det M). The larger eigenvalue of M over sqrt(det M) is a / b.
    xx, xy, yy = (
        np.bincount(candidate_of_pixel, product, count) / candidates.areas
        for product in (x * x, x * y, y * y)
    )
    xx, yy = xx + 1 / 12, yy + 1 / 12  # a pixel's own second moment
    root_determinant = np.sqrt(np.maximum(xx * yy - xy * xy, 0))
    mean = (xx + yy) / 2
    larger_eigenvalue = mean + np.sqrt(
        np.maximum(mean * mean - root_determinant * root_determinant, 0)
    )
    is_filled: NDArray[np.bool_] = (
        candidates.areas >= MIN_ELLIPSE_SHARE * 4 * np.pi * root_determinant
    ) & (larger_eigenvalue <= MAX_ASPECT_RATIO * root_determinant)
    return is_filled
