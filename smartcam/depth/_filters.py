"""Filter clouds: by position, by number of neighbours, or to one point per voxel."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._argument_checks import a_number, check_arguments, numbers, of_class
from smartcam._arguments import check_text, excerpt
from smartcam._extras import load
from smartcam.depth._cloud import Cloud
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import ArrayLike, NDArray

AXES: Final = "xyz"

POINTS_AT_A_TIME: Final = 1 << 17
"""Number of points whose neighbours are searched at a time, which bounds the memory."""

MAX_NEIGHBOURS: Final = 1000


@check_arguments(cloud=of_class("Cloud"), axis=check_text, low=a_number, high=a_number)
def pass_through(cloud: Cloud, axis: str, low: float = -math.inf, high: float = math.inf) -> Cloud:
    """Return the points whose coordinate on an axis is from ``low`` to ``high``, metres.

    Raises:
        ConfigurationError: the axis is none of x, y, z, or the range is not valid.
    """
    if axis not in AXES or len(axis) != 1:
        raise ConfigurationError(f"pass_through: expected x, y or z, got {excerpt(axis)}")
    if not low <= high:
        raise ConfigurationError(
            f"pass_through: expected low <= high, got {excerpt(low)} and {excerpt(high)}"
        )
    coordinates = cloud.points[:, AXES.index(axis)]
    bounds = _as_float32((low, high))
    return cloud.select((coordinates >= bounds[0]) & (coordinates <= bounds[1]))


@check_arguments(cloud=of_class("Cloud"), low=numbers, high=numbers)
def crop_box(cloud: Cloud, low: Sequence[float], high: Sequence[float]) -> Cloud:
    """Return the points in a box with sides along the axes; points on a side are included.

    ``low`` and ``high`` (3,) are opposite corners of the box, in metres.

    Raises:
        ConfigurationError: the corners are not (3,), or one is not below the other.
    """
    corners = [np.asarray(corner, np.float64) for corner in (low, high)]
    if any(corner.shape != (3,) for corner in corners) or not (corners[0] <= corners[1]).all():
        raise ConfigurationError(f"crop_box: expected a low and a high x, y, z; got {low}, {high}")
    bounds = _as_float32(corners)
    inside = np.all((cloud.points >= bounds[0]) & (cloud.points <= bounds[1]), axis=1)
    return cloud.select(np.asarray(inside))


def _as_float32(bounds: ArrayLike) -> NDArray[np.float32]:
    """Return bounds as float32, like points: a bound of 0.1 includes a point at 0.1."""
    with np.errstate(over="ignore"):  # a bound beyond float32 becomes infinite
        return np.asarray(bounds, np.float64).astype(np.float32)


@check_arguments(cloud=of_class("Cloud"), ratio=a_number)
def remove_statistical_outliers(cloud: Cloud, neighbours: int = 20, ratio: float = 2.0) -> Cloud:
    """Return the cloud without the points that are unusually far from their neighbours.

    A point stays if its mean distance to its ``neighbours`` nearest points is at most ``ratio``
    standard deviations above the mean of these distances. An empty cloud is returned as it is.

    Raises:
        ConfigurationError: ``neighbours`` is not 1 to 1000, or not below the number of points; or
            the ratio is below 0.
        MissingExtraError: SciPy is not installed.
    """
    _check_count(neighbours, "remove_statistical_outliers")
    if not ratio >= 0:
        raise ConfigurationError(
            f"remove_statistical_outliers: ratio: expected 0 or more, got {excerpt(ratio)}"
        )
    if not len(cloud):
        return cloud
    if len(cloud) <= neighbours:
        raise ConfigurationError(
            f"remove_statistical_outliers: expected more than {neighbours} points, got {len(cloud)}"
        )
    tree = load("scipy.spatial").cKDTree(cloud.points)
    mean_distances = np.empty(len(cloud))
    for chunk in _chunks(len(cloud)):
        # The nearest point is the point itself, or another point at the same position.
        distances, _ = tree.query(cloud.points[chunk], k=neighbours + 1)
        mean_distances[chunk] = distances[:, 1:].mean(axis=1)
    return cloud.select(
        mean_distances
        <= mean_distances.mean()
        + ratio * mean_distances.std(ddof=1 if len(mean_distances) > 1 else 0)
    )


@check_arguments(cloud=of_class("Cloud"), radius=a_number)
def remove_radius_outliers(cloud: Cloud, radius: float, neighbours: int = 5) -> Cloud:
    """Return the points with at least ``neighbours`` other points within a radius in metres.

    Raises:
        ConfigurationError: the radius is not above 0, or ``neighbours`` is not 1 to 1000.
        MissingExtraError: SciPy is not installed.
    """
    _check_count(neighbours, "remove_radius_outliers")
    _check_length(radius, "remove_radius_outliers: radius")
    if len(cloud) <= neighbours:
        return cloud.select(np.zeros(len(cloud), bool))
    tree = load("scipy.spatial").cKDTree(cloud.points)
    mask = np.empty(len(cloud), bool)
    for chunk in _chunks(len(cloud)):
        # It is enough to know the distance to the last of the required neighbours.
        distances, _ = tree.query(cloud.points[chunk], k=[neighbours + 1])
        mask[chunk] = distances[:, 0] <= radius
    return cloud.select(mask)


@check_arguments(cloud=of_class("Cloud"), size=a_number)
def voxel_grid(cloud: Cloud, size: float) -> Cloud:
    """Return one point per voxel: the mean of its points, with their mean colour.

    Voxels are cubes of ``size`` metres, with a corner at the origin, so the grid is the same for
    every cloud. The points are ordered by x, then y, then z. A voxel's sigma is the RMS of its
    points' sigmas: neighbouring depths have similar errors, which averaging hardly reduces.

    Raises:
        ConfigurationError: the size is not above 0, or so small that the voxels cannot be counted.
    """
    _check_length(size, "voxel_grid: size")
    if not len(cloud):
        return cloud
    voxels = _voxel_indices(cloud, size)
    order = np.argsort(voxels)  # any order within a voxel will do, since the sums are float64
    voxels = voxels[order]
    starts = np.flatnonzero(np.concatenate([[True], voxels[1:] != voxels[:-1]]))
    counts = np.diff(np.append(starts, len(voxels)))

    def means(values: NDArray[Any]) -> NDArray[np.float64]:
        sums: NDArray[np.float64] = np.add.reduceat(values[order].astype(np.float64), starts)
        return sums / counts

    def column_means(values: NDArray[Any]) -> NDArray[np.float64]:
        return np.stack([means(column) for column in values.T], axis=1)

    colours = cloud.colours
    return Cloud(
        column_means(cloud.points).astype(np.float32),
        None if colours is None else np.rint(column_means(colours)).astype(np.uint8),
        None
        if cloud.sigma is None
        else np.sqrt(means(cloud.sigma.astype(np.float64) ** 2)).astype(np.float32),
    )


def _voxel_indices(cloud: Cloud, size: float) -> NDArray[np.int64]:
    """Return the index of each point's voxel, which grows with x, then y, then z."""
    low = np.floor(cloud.points.min(axis=0).astype(np.float64) / size)
    high = np.floor(cloud.points.max(axis=0).astype(np.float64) / size)
    spans = high - low + 1
    if not np.prod(spans) < 2**62 or np.abs([low, high]).max() > 2**52:
        extent = np.ptp(cloud.points, axis=0).tolist()
        raise ConfigurationError(
            f"voxel_grid: expected fewer than 2**62 voxels, got more: voxels of {size:g} m in a "
            f"cloud of {extent} m"
        )
    indices = np.zeros(len(cloud), np.int64)
    for axis, span in enumerate(spans.astype(np.int64)):
        indices *= span
        column = cloud.points[:, axis].astype(np.float64)
        indices += (np.floor(column / size) - low[axis]).astype(np.int64)
    return indices


def _chunks(count: int) -> Iterator[slice]:
    for start in range(0, count, POINTS_AT_A_TIME):
        yield slice(start, min(start + POINTS_AT_A_TIME, count))


def _check_count(value: int, label: str) -> None:
    if not isinstance(value, int) or not 1 <= value <= MAX_NEIGHBOURS:
        raise ConfigurationError(
            f"{label}: neighbours: expected 1 to {MAX_NEIGHBOURS}, got {excerpt(value)}"
        )


def _check_length(value: float, label: str) -> None:
    if not 0 < value < math.inf:
        raise ConfigurationError(f"{label}: expected metres above 0, got {excerpt(value)}")
