"""Cut out the pixels around points, and compute the grey levels of a blurred edge, for fits."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from smartcam.calibration._detection.image import GreyImage
    from smartcam.geometry._inside import Array

Floats: TypeAlias = NDArray[np.float32]

LINEAR: Final = 1.12967583
CUBIC: Final = 0.0997927
"""``erf(x)`` is approximated by ``tanh(x * (LINEAR + CUBIC * x^2))``: the error is at most 0.0003,
far below one grey level, and it takes a tenth of the time. Both values were fitted."""

MIN_REACH_PX = 3
"""A window reaches at least this many pixels to each side."""


class Windows(NamedTuple):
    """The pixels around each of N points, P for each."""

    centre: NDArray[np.intp]  # (N, 2), the centre pixel of each window
    x: Floats  # (P,), columns from the middle
    y: Floats  # (P,), rows from the middle
    levels: Floats  # (N, P), 0 to 255; 0 where the weight is 0
    weights: Floats  # (N, P), 1 for a pixel that counts, 0 for one that does not

    @property
    def counts(self) -> Array:
        """Number of pixels with the weight 1 in each window, (N,)."""
        counts: Array = self.weights.sum(axis=1, dtype=np.float64)
        return counts

    def without_discs(self, points: Array, radius: float) -> Windows:
        """Return the windows with weight 0 for the pixels within a radius of points (N, 2)."""
        u, v = (points - self.centre).astype(np.float32).T[:, :, None]
        is_outside = ((self.x - u) ** 2 + (self.y - v) ** 2 > radius**2).astype(np.float32)
        return self._replace(levels=self.levels * is_outside, weights=self.weights * is_outside)

    def subset(self, mask: NDArray[np.bool_]) -> Windows:
        """Return the windows where a mask (N,) is True."""
        if mask.all():
            return self
        return self._replace(
            centre=self.centre[mask], levels=self.levels[mask], weights=self.weights[mask]
        )


def cut_windows(
    image: GreyImage,
    points: Array,
    half_sides: Array,
    max_reach: int,
    *,
    elliptical: bool,
    arm_widths: Array | None = None,
) -> Windows:
    """Return the pixels around points (N, 2).

    ``half_sides`` (N, 2, 2): half sides of the parallelogram around each point whose pixels count,
    or, if ``elliptical``, half axes of an ellipse. A window reaches at most ``max_reach`` pixels to
    each side. ``arm_widths`` (N, 2): of the parallelogram only a cross counts, whose pixels are
    nearer to the point than this fraction of a half side; None: all of it counts. Pixels nearer
    than MIN_REACH_PX count always.
    """
    reach = (
        np.hypot(half_sides[:, 0], half_sides[:, 1])
        if elliptical
        else np.abs(half_sides).sum(axis=1)
    )
    half = int(np.clip(np.ceil(reach.max()), MIN_REACH_PX, max_reach))
    span = np.arange(-half, half + 1)
    y, x = (axis_offsets.ravel() for axis_offsets in np.meshgrid(span, span, indexing="ij"))
    centre = np.rint(points).astype(np.intp)
    columns, rows = centre[:, :1] + x, centre[:, 1:] + y
    width, height = image.size
    is_in_image = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    levels = image.levels[rows.clip(0, height - 1), columns.clip(0, width - 1)]
    # coordinates of each pixel along the two half sides
    coordinates = np.linalg.inv(half_sides.transpose(0, 2, 1)) @ np.stack([x, y])
    is_in_shape = (
        (coordinates**2).sum(axis=1) <= 1 if elliptical else (np.abs(coordinates) <= 1).all(axis=1)
    )
    if arm_widths is not None:
        is_in_shape &= (np.abs(coordinates) <= arm_widths[:, :, None]).any(axis=1)
    is_near = np.maximum(np.abs(x), np.abs(y)) < MIN_REACH_PX
    weights = (is_in_image & (is_in_shape | is_near)).astype(np.float32)
    return Windows(centre, x.astype(np.float32), y.astype(np.float32), levels * weights, weights)


def edge_profile(distance: Floats) -> tuple[Floats, Floats]:
    """Return a blurred edge's ``erf`` and slope; ``distance`` is divided by ``sqrt(2) * blur``."""
    square = distance * distance
    shape = np.tanh(distance * (LINEAR + CUBIC * square))
    return shape, (1 - shape * shape) * (LINEAR + 3 * CUBIC * square)
