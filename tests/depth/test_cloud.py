"""Clouds: making, refusing and moving them."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from smartcam.calibration import Transform
from smartcam.depth import Cloud
from smartcam.exceptions import ConfigurationError

POINTS = np.array([[0.0, 0.0, 1.0], [0.5, -0.25, 2.0]], np.float32)
COLOURS = np.array([[255, 0, 0], [1, 2, 3]], np.uint8)
MATRIX = np.array([[100.0, 0.0, 2.0], [0.0, 50.0, 1.0], [0.0, 0.0, 1.0]])


def test_arrays_are_checked_and_read_only() -> None:
    cloud = Cloud(POINTS.astype(float).tolist(), COLOURS, [0.25, 0])  # type: ignore[arg-type]
    assert cloud.colours is not None
    assert cloud.sigma is not None
    assert (str(cloud.points.dtype), str(cloud.sigma.dtype)) == ("float32", "float32")
    assert len(cloud) == 2
    assert repr(cloud) == "<Cloud of 2 points, colours, sigma>"
    for array in (cloud.points, cloud.colours, cloud.sigma):
        assert not array.flags.writeable
    assert COLOURS.flags.writeable  # a view, and not the array that was given


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ((np.zeros((2, 2)),), r"points: expected the shape \(any, 3\), got \(2, 2\)"),
        ((np.zeros(3),), "points"),
        ((np.array([[0, 0, np.nan]]),), "points: expected finite float32 values, got 1"),
        ((np.array([[0, 0, 1e39]]),), "points: expected finite"),
        ((np.zeros((1, 3), complex),), "points: expected numbers, got complex128"),
        ((np.zeros((1, 3), bool),), "points: expected numbers, got bool"),
        (([["a", "b", "c"]],), "points: expected numbers"),
        (([[1, 2, 3], [4, 5]],), "points: expected an array, got list"),
        ((POINTS, COLOURS[:1]), r"colours: expected the shape \(2, 3\), got \(1, 3\)"),
        ((POINTS, COLOURS / 255), "colours: expected uint8, got float64"),
        ((POINTS, None, [1.0]), r"sigma: expected the shape \(2\)"),
        ((POINTS, None, [1.0, -1.0]), "sigma: expected 0 or more, got -1"),
    ],
)
def test_wrong_arrays_are_refused(arrays: tuple[object, ...], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        Cloud(*arrays)  # type: ignore[arg-type]


def test_depth_becomes_points_along_the_rays() -> None:
    depth = np.zeros((3, 4), np.float32)
    depth[1, 2], depth[2, 0] = 2.0, 4.0
    colours = np.zeros((3, 4, 3), np.uint8)
    colours[1, 2], colours[2, 0] = (9, 8, 7), (6, 5, 4)
    sigma = np.full((3, 4), 0.5, np.float32)
    cloud = Cloud.from_depth(depth, MATRIX, colours, sigma)
    assert cloud.points.tolist() == [[0, 0, 2], [np.float32(-0.08), np.float32(0.08), 4]]
    assert cloud.colours is not None
    assert cloud.colours.tolist() == [[9, 8, 7], [6, 5, 4]]
    assert cloud.sigma is not None
    assert cloud.sigma == pytest.approx([0.5, 0.5 * np.sqrt(1 + 0.02**2 + 0.02**2)])
    grey = Cloud.from_depth(depth, MATRIX, colours[..., 0])
    assert grey.colours is not None
    assert grey.colours.tolist() == [[9, 9, 9], [6, 6, 6]]
    assert len(Cloud.from_depth(np.zeros((3, 4)), MATRIX, colours)) == 0


def test_points_of_a_depth_project_where_they_were() -> None:
    rng = np.random.default_rng(1)
    skewed = np.array([[410.0, 1.5, 99.5], [0.0, 390.0, 61.25], [0.0, 0.0, 1.0]])
    depth = rng.uniform(0.3, 3.0, (120, 200)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.3] = 0
    cloud = Cloud.from_depth(depth, skewed)
    seen = cloud.points.astype(float) @ skewed.T
    rows, columns = np.nonzero(depth)
    assert np.abs(seen[:, :2] / seen[:, 2:] - np.stack([columns, rows], 1)).max() < 1e-3
    assert np.array_equal(cloud.points[:, 2], depth[rows, columns])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"depth": np.full((2, 2), -1.0)}, "depth: expected metres, 0 for none; got -1"),
        ({"depth": np.full((2, 2), np.nan)}, "depth: expected finite"),
        ({"depth": np.ones(4)}, "depth: expected the shape"),
        ({"matrix": np.eye(4)}, r"matrix: expected the shape \(3, 3\)"),
        ({"matrix": MATRIX.T}, "matrix: expected"),
        ({"matrix": -MATRIX}, "matrix: expected"),
        ({"matrix": MATRIX * np.nan}, "matrix: expected finite"),
        ({"colours": np.zeros((2, 3, 3), np.uint8)}, "colours: expected the shape"),
        ({"colours": np.zeros((2, 2, 4), np.uint8)}, "colours: expected the shape"),
        ({"colours": np.zeros((2, 2))}, "colours: expected uint8"),
        ({"sigma": np.ones((2, 3))}, "sigma: expected the shape"),
    ],
)
def test_wrong_depth_is_refused(given: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        Cloud.from_depth(**({"depth": np.ones((2, 2)), "matrix": MATRIX} | given))  # type: ignore[arg-type]


def test_cloud_moves_with_a_transform() -> None:
    quarter = Transform("robot", "camera", [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1, 2, 3])  # type: ignore[arg-type]
    cloud = Cloud(POINTS, COLOURS, [0.1, 0.2])  # type: ignore[arg-type]
    moved = cloud.transformed(quarter)
    assert moved.points.tolist() == [[1, 2, 4], [1.25, 2.5, 5]]
    assert moved.colours is not None
    assert np.array_equal(moved.colours, COLOURS)
    assert np.array_equal(moved.transformed(quarter.inverse()).points, POINTS)
    with pytest.raises(ConfigurationError, match="expected a Transform, got ndarray"):
        cloud.transformed(np.eye(4))  # type: ignore[arg-type]
    far = Transform("a", "b", np.eye(3), np.array([3e38, 0, 0]))
    with pytest.raises(ConfigurationError, match="finite"):
        Cloud(np.array([[3e38, 0, 0]])).transformed(far)


def test_clouds_are_joined_in_their_order() -> None:
    joined = Cloud.joined([Cloud(POINTS, COLOURS), Cloud(POINTS[:1], COLOURS[1:])])
    assert joined.points.tolist() == [*POINTS.tolist(), POINTS[0].tolist()]
    assert joined.colours is not None
    assert joined.colours.tolist() == [*COLOURS.tolist(), COLOURS[1].tolist()]
    assert joined.sigma is None
    assert len(Cloud.joined([])) == 0
    with pytest.raises(ConfigurationError, match="with colours or none, got 1 of 2"):
        Cloud.joined([Cloud(POINTS, COLOURS), Cloud(POINTS)])


def test_cloud_goes_to_another_process() -> None:
    there = pickle.loads(pickle.dumps(Cloud(POINTS, COLOURS)))  # noqa: S301 - our own
    assert np.array_equal(there.points, POINTS)
    assert np.array_equal(there.colours, COLOURS)
    assert not there.points.flags.writeable


def test_sigma_counts_only_where_there_is_a_depth() -> None:
    depth = np.array([[0.0, 2.0]], np.float32)
    cloud = Cloud.from_depth(depth, np.eye(3), sigma=np.array([[np.nan, 0.5]]))
    assert cloud.sigma is not None
    assert cloud.sigma.tolist() == pytest.approx([0.5 * np.sqrt(2)])
    with pytest.raises(ConfigurationError, match="sigma"):
        Cloud.from_depth(depth, np.eye(3), sigma=np.array([[0.5, np.nan]]))
