"""A target as one image shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.targets import Target

__all__ = ["TargetView"]


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetView:
    """Where the points of a target are in an image.

    Pixels count from the middle of the upper left one: u to the right, v down.

    Attributes:
        target: what was looked for.
        size: width and height of the image, pixels.
        ids: (N,), numbers of the points that were found, ascending.
        points: (N, 2), where they are, pixels.
        covariance: (N, 2, 2), of each, pixels^2, as the noise of the image leads to.
        margin: how clearly the origin was told from the other corners: by how many grey levels of
            255 its mark, or the rim by which its dot is larger, is darker there; None where the
            target says it by itself (ids, colours of squares), or looks the same when turned.
        name: of the image, for messages.
    """

    target: Target
    size: tuple[int, int]
    ids: np.ndarray[tuple[int], np.dtype[np.intp]]
    points: Array
    covariance: Array
    margin: float | None = None
    name: str = ""

    @property
    def object_points(self) -> Array:
        """(N, 3), where they are on the target, metres."""
        points: Array = self.target.points[self.ids]
        return points

    @property
    def sigmas(self) -> Array:
        """(N,), standard deviation of a coordinate, pixels."""
        sigmas: Array = np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 2)
        return sigmas
