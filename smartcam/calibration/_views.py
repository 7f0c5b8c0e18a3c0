"""The view of a target: the points of the target that were found in one image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, get_args

import numpy as np

from smartcam.calibration._files import storage
from smartcam.calibration._targets import MAX_POINTS, Target
from smartcam.geometry._inside import Array, Code, as_points, check_size

if TYPE_CHECKING:
    from collections.abc import Iterable


IDS = storage.Form(
    list[storage.Count],
    read=lambda ids, _: np.array([min(ident, MAX_POINTS) for ident in ids], dtype=np.intp),
    write=lambda ids: ids.tolist(),
)

MAX_ROUNDING_RATIO: Final = 1e-9
"""Rounding may change elements of a covariance by this fraction of the covariance."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TargetView(storage.Stored):
    """The points of a target in one image.

    Pixels count from the centre of the upper left pixel: u to the right, v down.

    Attributes:
        target: target that the image shows.
        size: width and height of the image, pixels.
        ids: (N,), numbers of the points that were found, ascending. Read-only, as are the next two.
        points: (N, 2), places of these points in the image, pixels.
        covariance: (N, 2, 2), of each point, pixels^2, from the noise of the image; 0 for points
            without noise.
        margin: certainty of the origin: number of grey levels, of 255, by which the origin's mark,
            or the rim of its larger dot, is darker than the same place at the other corners; None
            if ids or colours of squares show the origin, or if the target looks the same when
            turned.
        name: name of the image, for messages.
        warnings: texts about points that were left out because they contradict the target.

    Raises:
        CalibrationError: ``SHAPE``: the target or the size is not valid, arrays do not fit
            together, or ids are unknown to the target, repeated or not ascending; ``NOT_FINITE``;
            ``NOT_A_COVARIANCE``.
    """

    _label: ClassVar[str] = "view"
    _keys: ClassVar[storage.Keys] = {"target": ""}
    _optional_keys: ClassVar[frozenset[str]] = frozenset({"margin", "name", "warnings"})

    target: Target
    size: storage.Size
    ids: Annotated[np.ndarray[tuple[int], np.dtype[np.intp]], IDS]
    points: Annotated[Array, storage.rows(storage.Pair, 2)]
    covariance: Annotated[Array, storage.rows(tuple[storage.Pair, storage.Pair], 2, 2)]
    margin: storage.Number | None = None
    name: str = ""
    warnings: storage.Remarks = ()

    def __post_init__(self) -> None:
        """Copy the arrays as read-only ones, and check them."""
        check_type(self.name, str, "view of a target: name")
        label = f"target in {self.name}" if self.name else "view of a target"
        target = check_type(self.target, get_args(Target), f"{label}: target")
        ids = _as_ids(self.ids, len(target.points), label)
        points = as_points(self.points, 2, f"{label}: points").copy()
        if len(points) != len(ids):
            expected = f"{label}: points: expected shape ({len(ids)}, 2), a row for each id"
            raise Code.SHAPE.error_with_value(expected, (len(ids), 2), points.shape)
        covariance = as_covariances(self.covariance, len(ids), f"{label}: covariance").copy()
        check_size(self.size, label)
        for name, value in (("ids", ids), ("points", points), ("covariance", covariance)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def _read(cls, fields: dict[str, Any], context: storage.Context) -> TargetView:
        if context.get("target") is None:
            raise storage.invalid_data_error(
                context["label"], "target: expected the target of the view", None
            )
        return super()._read({"target": context["target"], **fields}, context)

    @property
    def object_points(self) -> Array:
        """Places of the points on the target, (N, 3), metres."""
        points: Array = self.target.points[self.ids]
        return points

    @property
    def handedness(self) -> float:
        """Handedness, -1 to 1, of the points in the image, compared with the target.

        It is near -1 for the front of a sheet (y points up on the sheet, v down in the image), near
        1 for a mirrored sheet, near 0 if points have wrong ids, NaN if the points are on a line.
        """
        # det(A^T B) is the sum, over all triples of points, of the products of their triangles'
        # signed areas (Cauchy and Binet), and a plane in front of a camera keeps all signs. Divided
        # by the root of det(A^T A) det(B^T B) it is the product of the canonical
        # correlations.
        # Source: Hotelling, Relations Between Two Sets of Variates (1936).
        flat, pixels = self.object_points[:, :2], self.points
        centred = flat - flat.mean(axis=0), pixels - pixels.mean(axis=0)
        spread = math.prod(float(np.linalg.det(points.T @ points)) for points in centred)
        determinant = float(np.linalg.det(centred[0].T @ centred[1]))
        return determinant / math.sqrt(spread) if spread > 0 else math.nan

    @property
    def sigmas(self) -> Array:
        """Standard deviation of a coordinate of each point, (N,), pixels."""
        sigmas: Array = np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 2)
        return sigmas


def view_name(view: TargetView, number: int) -> str:
    """Return a view's name for messages, or its number."""
    return view.name or f"view {number}"


def check_type(value: Any, types: type | tuple[type, ...], label: str) -> Any:
    """Return a value that is of one of the types; otherwise raise ``SHAPE`` with its type."""
    if isinstance(value, types):
        return value
    type_names = [type_.__name__ for type_ in (types if isinstance(types, tuple) else (types,))]
    raise Code.SHAPE.error_with_value(
        f"{label}: expected a {' or '.join(type_names)}", type_names, describe_type(value)
    )


def describe_type(value: Any) -> str:
    """Return the name of a value's type, with the shape of an array."""
    shape = getattr(value, "shape", None)
    kind = "None" if value is None else type(value).__name__
    return kind if shape is None else f"{kind} of shape {tuple(shape)}"


def as_views(views: Iterable[TargetView], label: str) -> list[TargetView]:
    """Return views as a list; raise ``SHAPE`` for no list, or for another type in it."""
    return as_list(views, TargetView, f"{label}: view")


def as_list(values: Any, types: type | tuple[type, ...], label: str) -> list[Any]:
    """Return values as a list; raise ``SHAPE`` unless each is of one of the types."""
    if isinstance(values, str | bytes | dict | np.ndarray) or not hasattr(values, "__iter__"):
        raise Code.SHAPE.error_with_value(
            f"{label}: expected a list", "a list", describe_type(values)
        )
    return [check_type(value, types, f"{label} {number}") for number, value in enumerate(values)]


def as_covariances(values: Any, count: int, label: str) -> Array:
    """Return covariances of points in an image, (``count``, 2, 2).

    Raises SHAPE or NOT_FINITE; or NOT_A_COVARIANCE: a matrix is not symmetric or has a negative
    variance.
    """
    try:
        matrices = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, ArithmeticError) as exc:
        raise Code.SHAPE.error_with_value(f"{label}: expected numbers", (count, 2, 2), exc) from exc
    if matrices.shape != (count, 2, 2):
        raise Code.SHAPE.error_with_value(
            f"{label}: expected shape ({count}, 2, 2)", (count, 2, 2), matrices.shape
        )
    covariances = as_points(matrices.reshape(-1, 4), 4, label).reshape(-1, 2, 2)
    # a symmetric matrix is a covariance if neither its trace nor its determinant is negative
    trace = np.trace(covariances, axis1=1, axis2=2)
    uneven = np.abs(covariances[:, 0, 1] - covariances[:, 1, 0]) > MAX_ROUNDING_RATIO * np.abs(
        covariances
    ).max(axis=(1, 2))
    product = covariances[:, 0, 0] * covariances[:, 1, 1]
    negative = (covariances[:, 0, 0] < 0) | (
        product - covariances[:, 0, 1] ** 2 < -MAX_ROUNDING_RATIO * trace**2
    )
    wrong = np.flatnonzero(uneven | negative | (trace < 0))
    if len(wrong):
        matrix = covariances[wrong[0]].tolist()
        raise Code.NOT_A_COVARIANCE.error(
            f"{label}: expected symmetric matrices of no negative variance, got {matrix} in row "
            f"{wrong[0]}",
            "covariances",
            matrix,
        )
    return covariances


def _as_ids(values: Any, point_count: int, label: str) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    try:
        array = np.asarray(values)
    except ValueError as exc:
        raise Code.SHAPE.error_with_value(
            f"{label}: ids: expected whole numbers", "(N,)", str(exc)
        ) from exc
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        received = f"{array.dtype} of shape {array.shape}"
        raise Code.SHAPE.error_with_value(
            f"{label}: ids: expected whole numbers of shape (N,)", "(N,)", received
        )
    wrong = array[(array < 0) | (array >= point_count)]
    if len(wrong) and wrong[0] < 0:
        raise Code.SHAPE.error_with_value(f"{label}: ids: expected 0 or more", 0, int(wrong[0]))
    if len(wrong):
        raise Code.SHAPE.error_with_value(
            f"{label}: ids: expected less than {point_count}", point_count, int(wrong[0])
        )
    ids = array.astype(np.intp)
    unsorted = np.flatnonzero(np.diff(ids) <= 0)
    if len(unsorted):
        received = ids[unsorted[0] : unsorted[0] + 2].tolist()
        expected = f"{label}: ids: expected each once, ascending (points in the order of the ids)"
        raise Code.SHAPE.error_with_value(expected, "ascending", received)
    return ids
