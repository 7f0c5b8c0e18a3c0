"""A target as one image shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np

from smartcam.calibration._files import storage
from smartcam.calibration._geometry.rotations import Array
from smartcam.calibration._targets import MAX_POINTS, Target

if TYPE_CHECKING:
    from collections.abc import Mapping

IDS = storage.Form(
    list[storage.Count],
    read=lambda ids, _: np.array([min(one, MAX_POINTS) for one in ids], dtype=np.intp),
    write=lambda ids: ids.tolist(),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetView(storage.Stored):
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

    _called: ClassVar[str] = "view"
    _keys: ClassVar[storage.Keys] = {"target": ""}
    _later: ClassVar[frozenset[str]] = frozenset({"margin", "name"})

    target: Target
    size: storage.Size
    ids: Annotated[np.ndarray[tuple[int], np.dtype[np.intp]], IDS]
    points: Annotated[Array, storage.rows(storage.Pair, 2)]
    covariance: Annotated[Array, storage.rows(tuple[storage.Pair, storage.Pair], 2, 2)]
    margin: storage.Number | None = None
    name: str = ""

    @classmethod
    def _read(cls, found: dict[str, Any], context: storage.Context) -> TargetView:
        if "target" not in context:
            raise storage.refused(context["called"], "target: expected the one that it shows", None)
        # None where the whole that holds the view is refused for it
        return super()._read({"target": context["target"], **found}, context)

    def _check(self, found: Mapping[str, Any], called: str) -> None:
        count = len(self.ids)
        known = len(self.target.points) if self.target else MAX_POINTS
        if count and self.ids.max() >= known:
            raise storage.refused(called, f"ids: expected less than {known}", int(self.ids.max()))
        storage.check_shape(self.points, (count, 2), called, "points")
        storage.check_shape(self.covariance, (count, 2, 2), called, "covariance of the points")

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
