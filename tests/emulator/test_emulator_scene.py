"""The tangram table and its camera."""

from __future__ import annotations

import itertools
import math

import pytest

from smartcam.emulator import TableScene
from smartcam.emulator.scene import PIECES, TABLE_SIZE, Observation, TablePose
from smartcam.exceptions import ConfigurationError

NAMES = [
    "big_triangle_1",
    "big_triangle_2",
    "medium_triangle",
    "small_triangle_1",
    "small_triangle_2",
    "square",
    "parallelogram",
]


def test_pieces_lie_apart_on_the_table() -> None:
    assert list(PIECES) == NAMES
    for pose in PIECES.values():
        assert 0.03 < pose.x < TABLE_SIZE[0] - 0.03
        assert 0.03 < pose.y < TABLE_SIZE[1] - 0.03
    for one, other in itertools.combinations(PIECES.values(), 2):
        assert math.dist(one[:2], other[:2]) > 0.05


@pytest.mark.parametrize("y_down", [False, True])
@pytest.mark.parametrize("rotation", [0.0, 0.3, -3.0])
def test_to_table_without_noise_is_the_inverse_of_to_pixels(rotation: float, y_down: bool) -> None:
    scene = TableScene(scale=2500.0, offset=(12.0, -7.0), rotation=rotation, y_down=y_down)
    for name, pose in PIECES.items():
        seen = Observation(name, *scene.to_pixels(pose), quality=1.0)
        assert scene.to_table(seen) == pytest.approx(pose, abs=1e-12)


def test_to_pixels_scales_turns_and_shifts() -> None:
    scene = TableScene(scale=1000.0, offset=(10.0, 20.0), rotation=math.pi / 2)
    u, v, theta = scene.to_pixels(TablePose(0.1, 0.0, 0.5))
    assert (u, v, theta) == pytest.approx((10.0, 120.0, 0.5 + math.pi / 2))


def test_to_pixels_y_down_mirrors_v_and_theta() -> None:
    scene = TableScene(scale=1000.0, offset=(0.0, 500.0), rotation=0.0, y_down=True)
    assert scene.to_pixels(TablePose(0.0, 0.1, 0.5)) == pytest.approx((0.0, 400.0, -0.5))


def test_measure_lies_within_tenths_of_a_millimetre_of_the_truth() -> None:
    scene = TableScene(seed=7)
    for _ in range(50):
        found = scene.measure()
        assert [seen.name for seen in found] == NAMES
        for seen in found:
            pose, truth = scene.to_table(seen), scene.pieces[seen.name]
            assert math.dist(pose[:2], truth[:2]) < 0.0004
            assert abs(pose.theta - truth.theta) < 0.02
            assert 0.0 <= seen.u < 1280.0
            assert 0.0 <= seen.v < 1024.0
            assert 0.95 <= seen.quality <= 1.0


def test_measure_same_seed_same_observations() -> None:
    assert TableScene(seed=3).measure() == TableScene(seed=3).measure()
    assert TableScene(seed=3).measure() != TableScene(seed=4).measure()


def test_measure_without_noise_is_exact() -> None:
    scene = TableScene(pixel_noise=0.0)
    for seen in scene.measure():
        assert scene.to_table(seen) == pytest.approx(scene.pieces[seen.name], abs=1e-12)


def test_measure_sees_a_moved_piece() -> None:
    scene = TableScene(pixel_noise=0.0)
    scene.pieces = {"square": TablePose(0.1, 0.2, math.pi)}
    (seen,) = scene.measure()
    assert scene.to_table(seen)[:2] == pytest.approx((0.1, 0.2))
    assert abs(scene.to_table(seen).theta) == pytest.approx(math.pi)
    assert scene.pieces is not TableScene().pieces


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"scale": 0.0}, "scale must be positive, got 0.0"),
        ({"scale": float("inf")}, "scale must be positive"),
        ({"pixel_noise": -1.0}, "pixel_noise must not be negative, got -1.0"),
        ({"pixel_noise": float("nan")}, "pixel_noise must not be negative"),
    ],
)
def test_scene_impossible_camera_is_refused(options: dict[str, float], text: str) -> None:
    with pytest.raises(ConfigurationError, match=text):
        TableScene(**options)  # type: ignore[arg-type]  # one keyword each
