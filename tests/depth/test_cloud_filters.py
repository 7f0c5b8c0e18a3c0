"""Filters of clouds, compared with small-gicp's and with SciPy over all pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from smartcam.depth import (
    Cloud,
    crop_box,
    pass_through,
    remove_radius_outliers,
    remove_statistical_outliers,
    voxel_grid,
)
from smartcam.depth import _filters as filters_module
from smartcam.exceptions import ConfigurationError

spatial = pytest.importorskip("scipy.spatial", reason="needs the extra depth")


def scattered(count: int = 2000, seed: int = 1, colours: bool = True) -> Cloud:
    """Return a wavy surface with a few outliers."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[:, 2] = 1 + 0.05 * np.sin(9 * points[:, 0]) + rng.normal(0, 0.002, count)
    points[: count // 50, 2] += rng.uniform(0.2, 0.6, count // 50)
    picked = rng.integers(0, 256, (count, 3), dtype=np.uint8) if colours else None
    return Cloud(points.astype(np.float32), picked, rng.random(count).astype(np.float32))


def kept(cloud: Cloud, part: Cloud) -> list[int]:
    """Return the set of remaining points with all their values."""
    assert cloud.sigma is not None
    assert part.sigma is not None
    place = {value: index for index, value in enumerate(cloud.sigma.tolist())}
    index = [place[value] for value in part.sigma.tolist()]
    assert np.array_equal(cloud.points[index], part.points)
    if cloud.colours is not None:
        assert part.colours is not None
        assert np.array_equal(cloud.colours[index], part.colours)
    return index


def test_ranges_and_boxes_include_their_ends() -> None:
    cloud = Cloud(np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4]], np.float32))
    assert pass_through(cloud, "z", 2, 3).points[:, 2].tolist() == [2, 3]
    assert pass_through(cloud, "x", low=1).points[:, 0].tolist() == [1, 2]
    assert pass_through(cloud, "y", high=1).points[:, 1].tolist() == [1]
    assert crop_box(cloud, [0, 2, 0], [1, 9, 9]).points.tolist() == [[1, 2, 3]]
    tenth = Cloud(np.array([[0.1, 0, 0]]))  # which is no float32
    assert len(pass_through(tenth, "x", 0.1, 0.1)) == 1
    assert len(crop_box(tenth, [0.1, 0, 0], [0.1, 1e300, 0])) == 1


@pytest.mark.parametrize("axis", ["", "w", "xy", "X"])
def test_wrong_axis_is_refused(axis: str) -> None:
    with pytest.raises(ConfigurationError, match="expected x, y or z"):
        pass_through(scattered(10), axis)


def test_wrong_ranges_are_refused() -> None:
    cloud = scattered(10)
    for low, high in ((1, 0), (float("nan"), 1)):
        with pytest.raises(ConfigurationError, match="low <= high"):
            pass_through(cloud, "x", low, high)
    for low_corner, high_corner in (([0, 0, 0], [1, -1, 1]), ([0, 0], [1, 1])):
        with pytest.raises(ConfigurationError, match="crop_box"):
            crop_box(cloud, low_corner, high_corner)


def test_statistical_outliers_equal_those_of_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filters_module, "POINTS_AT_A_TIME", 300)  # several parts, the last not full
    cloud = scattered(1000)
    pairs = np.sort(spatial.distance.cdist(cloud.points, cloud.points), axis=1)
    means = pairs[:, 1:13].mean(axis=1)
    wanted = np.flatnonzero(means <= means.mean() + 1.5 * means.std(ddof=1))
    left = remove_statistical_outliers(cloud, neighbours=12, ratio=1.5)
    assert kept(cloud, left) == wanted.tolist()
    assert 900 < len(left) < 1000
    assert left.points[:, 2].max() < 1.2  # all that stood off is gone


def test_radius_outliers_equal_those_of_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(filters_module, "POINTS_AT_A_TIME", 300)
    cloud = scattered(1000)
    near = spatial.distance.cdist(cloud.points, cloud.points) <= 0.06
    wanted = np.flatnonzero(near.sum(axis=1) - 1 >= 4)
    left = remove_radius_outliers(cloud, 0.06, neighbours=4)
    assert kept(cloud, left) == wanted.tolist()
    assert 500 < len(left) < 1000
    assert len(remove_radius_outliers(scattered(4), 9.0, neighbours=4)) == 0


def test_outliers_of_few_points() -> None:
    empty = Cloud(np.empty((0, 3)))
    assert len(remove_statistical_outliers(empty)) == 0
    with pytest.raises(ConfigurationError, match="more than 20 points, got 20"):
        remove_statistical_outliers(scattered(20))
    same = Cloud(np.zeros((30, 3)))
    assert len(remove_statistical_outliers(same)) == 30
    for wrong in (0, 1001, 2.0):
        with pytest.raises(ConfigurationError, match="neighbours: expected 1 to 1000"):
            remove_statistical_outliers(scattered(30), neighbours=wrong)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="ratio"):
        remove_statistical_outliers(scattered(30), ratio=-1)


def by_voxel(cloud: Cloud, size: float) -> dict[tuple[int, ...], list[int]]:
    found: dict[tuple[int, ...], list[int]] = {}
    for index, point in enumerate(cloud.points.astype(float).tolist()):
        found.setdefault(tuple(int(np.floor(one / size)) for one in point), []).append(index)
    return found


def test_voxels_are_means_in_their_order() -> None:
    cloud = scattered(3000)
    groups = by_voxel(cloud, 0.07)
    thin = voxel_grid(cloud, 0.07)
    assert len(thin) == len(groups) < 1500
    assert cloud.colours is not None
    assert cloud.sigma is not None
    assert thin.colours is not None
    assert thin.sigma is not None
    for place, key in enumerate(sorted(groups)):
        index = groups[key]
        assert thin.points[place] == pytest.approx(cloud.points[index].mean(axis=0), abs=1e-6)
        assert np.abs(thin.colours[place] - cloud.colours[index].mean(axis=0)).max() <= 0.5
        rms = np.sqrt((cloud.sigma[index].astype(float) ** 2).mean())
        assert thin.sigma[place] == pytest.approx(rms, rel=1e-5)


def test_voxels_equal_those_of_small_gicp() -> None:
    gicp: Any = pytest.importorskip("small_gicp", reason="needs the extra depth")
    cloud = scattered(20000)
    theirs = gicp.voxelgrid_sampling(cloud.points.astype(np.float64), 0.02).points()[:, :3]
    ours = voxel_grid(cloud, 0.02).points
    assert len(ours) == len(theirs) > 2000
    distances, index = spatial.cKDTree(theirs).query(ours)
    assert distances.max() < 1e-6
    assert len(set(index.tolist())) == len(ours)


def test_voxels_do_not_depend_on_the_points_order() -> None:
    cloud = scattered(3000)
    mixed = cloud.select(np.random.default_rng(2).permutation(3000))
    assert np.allclose(voxel_grid(cloud, 0.05).points, voxel_grid(mixed, 0.05).points, atol=1e-6)
    assert np.array_equal(voxel_grid(cloud, 0.05).points, voxel_grid(cloud, 0.05).points)


def test_voxels_that_cannot_be_counted_are_refused() -> None:
    cloud = Cloud(np.array([[0, 0, 0], [1e9, 1e9, 1e9]]))
    assert len(voxel_grid(cloud, 1000)) == 2
    with pytest.raises(ConfigurationError, match="fewer than 2"):
        voxel_grid(cloud, 1e-6)
    for wrong in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ConfigurationError, match="metres above 0"):
            voxel_grid(cloud, wrong)
    assert len(voxel_grid(Cloud(np.empty((0, 3))), 1)) == 0
