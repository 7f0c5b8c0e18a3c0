"""Registration, judged by known motions: pose, uncertainty and refused arguments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import pytest

from smartcam.calibration import Transform
from smartcam.depth import Cloud, register
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Shape: TypeAlias = Callable[[np.random.Generator, int], Array]

pytest.importorskip("small_gicp", reason="needs the extra depth")

Method: TypeAlias = Literal["gicp", "icp", "plane"]
METHODS: tuple[Method, ...] = ("gicp", "icp", "plane")

MOTION = Transform.from_quaternion(
    "map", "camera", [0.012, -0.02, 0.008], np.array([0.01, -0.015, 0.005, 0.99983])
)
NOISE = 0.001


def plane(rng: np.random.Generator, count: int) -> Array:
    points = rng.random((count, 3))
    points[:, 2] = 0
    return points


def room(rng: np.random.Generator, count: int) -> Array:
    """Return three walls near their corner, away from the origin."""
    points = 0.1 + 0.9 * rng.random((count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = 0
    points += [1, 0, 2]
    return points


def edge(rng: np.random.Generator, count: int) -> Array:
    points = rng.random((count, 3))
    points[np.arange(count), rng.integers(0, 2, count)] = 0
    return points


def cylinder(rng: np.random.Generator, count: int) -> Array:
    angle = 2 * np.pi * rng.random(count)
    return np.stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), rng.random(count)], axis=1)


def ball(rng: np.random.Generator, count: int) -> Array:
    points = rng.normal(size=(count, 3))
    points *= 0.3 / np.linalg.norm(points, axis=1, keepdims=True)
    points += [0, 0, 2]
    return points


def pair(shape: Shape, seed: int, noise: float = NOISE, count: int = 3000) -> tuple[Cloud, Cloud]:
    """Return a moved source and a target with other points of the same shape."""
    rng = np.random.default_rng(seed)
    target = shape(rng, count)
    source = MOTION.inverse().apply(shape(rng, count))
    return tuple(Cloud(one + rng.normal(0, noise, one.shape)) for one in (source, target))  # type: ignore[return-value]


def error(found: Any) -> Array:
    """Return turn and shift (6,) from the true to the found pose, in the covariance's order."""
    return MOTION.rigid.target_steps_to(found.pose.rigid)


@pytest.mark.parametrize("method", METHODS)
def test_known_motion_is_found(method: Method) -> None:
    source, target = pair(room, 1)
    start = Transform("map", "camera", np.eye(3), np.zeros(3))
    found = register(source, target, method=method, max_distance=0.1, initial=start)
    assert found.converged, found.reason
    assert found.reason == ""
    assert (found.pose.target, found.pose.source) == ("map", "camera")
    assert found.pose.rotation.T @ found.pose.rotation == pytest.approx(np.eye(3), abs=1e-12)
    moved = found.pose.apply(source.points) - MOTION.apply(source.points)
    assert np.sqrt((moved**2).sum(axis=1).mean()) < (0.003 if method == "icp" else 0.0005)
    assert found.overlap > 0.97
    assert found.matched == pytest.approx(found.overlap * len(source))
    assert len(found.undetermined) == 0
    if method == "icp":
        assert found.covariance is None
    else:
        # both clouds' noise across the walls
        assert found.rms == pytest.approx(np.sqrt(2) * NOISE, rel=0.15)
        assert found.covariance is not None
        off = error(found)
        assert off @ np.linalg.solve(found.covariance, off) < 30


def test_start_is_used() -> None:
    source, target = pair(room, 1)
    turned = Transform.from_quaternion("map", "room", [0.4, -2, 1], [0.5, 0.5, -0.5, 0.5])
    away = Cloud(turned.apply(target.points))
    start = turned @ Transform("room", "camera", np.eye(3), np.zeros(3))
    found = register(source, away, max_distance=0.1, initial=start)
    assert found.converged, found.reason
    assert (turned.inverse() @ found.pose).translation == pytest.approx(
        MOTION.translation, abs=0.002
    )
    lost = register(source, away, max_distance=0.1)
    assert not lost.converged
    assert "points of the source lie on the target" in lost.reason


def test_voxels_thin_both() -> None:
    source, target = pair(room, 2, count=10000)
    found = register(source, target, voxel=0.04, max_distance=0.1)
    assert found.converged, found.reason
    assert found.matched < 3000
    assert np.abs(error(found)[:3]).max() < 0.002


def test_too_little_overlap_is_reported() -> None:
    source, target = pair(room, 3)
    part = source.select(source.points[:, 1] < 0.4)
    beside = Cloud.joined([part, Cloud(part.points + np.float32(5)), Cloud(part.points + 9)])
    found = register(beside, target, max_distance=0.1, min_overlap=0.5)
    assert not found.converged
    assert found.overlap == pytest.approx(1 / 3, abs=0.02)
    assert "expected 50%" in found.reason
    assert register(beside, target, max_distance=0.1, min_overlap=0.3).converged
    nothing = register(Cloud(part.points + 99), target)
    assert not nothing.converged
    assert (nothing.matched, nothing.covariance) == (0, None)
    assert np.isnan(nothing.rms)


def span_of(steps: Array) -> Array:
    return np.linalg.qr(steps.T)[0]


@pytest.mark.parametrize(("method", "noise"), [("gicp", 0.0003), ("icp", 0.003), ("plane", 0.001)])
@pytest.mark.parametrize(
    ("shape", "open_steps", "said"),
    [
        (plane, [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 1, 0]], "turn about (0.0"),
        (edge, [[0, 0, 0, 0, 0, 1]], "shift along (0.0"),
        (cylinder, [[0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 1]], "turn about (0.0"),
    ],
)
def test_undetermined_directions_are_reported(
    shape: Shape, open_steps: list[list[float]], said: str, method: Method, noise: float
) -> None:
    rng = np.random.default_rng(4)
    clouds = [Cloud(shape(rng, 2000) + rng.normal(0, noise, (2000, 3))) for _ in range(2)]
    found = register(*clouds, method=method)
    assert not found.converged
    assert f"the surfaces do not determine a {said}" in found.reason.replace("-0.0", "0.0")
    assert found.covariance is None
    assert len(found.undetermined) == len(open_steps)
    # about the source's origin as it lies in the target, which is where it was
    basis = span_of(np.array(open_steps, float))
    for step in found.undetermined:
        assert np.linalg.norm(step - basis @ (basis.T @ step)) < 0.06 * np.linalg.norm(step)


@pytest.mark.parametrize("noise", [0.0005, 0.003])
def test_ball_turns_about_its_own_centre(noise: float) -> None:
    source, target = pair(ball, 5, noise)
    found = register(source, target, max_distance=0.1)
    assert not found.converged
    assert found.reason.count("turn about") == 3
    centre = np.array([0, 0, 2])
    for step in found.undetermined:
        at = step[3:] + np.cross(step[:3], centre - found.pose.translation)
        assert np.linalg.norm(at) < 0.05  # so far the ball's centre moves where its points go 1 m


def test_information_is_that_of_small_steps() -> None:
    source, target = pair(room, 6)
    found = register(source, target, method="plane", max_distance=0.1)
    across = np.linalg.eigvalsh(found.information[3:, 3:])
    # each of three walls of a third of the points, across one axis
    assert across == pytest.approx([found.matched / 3] * 3, rel=0.12)
    assert np.linalg.eigvalsh(found.information).min() > 0
    assert found.covariance is not None
    plain = found.rms**2 * np.linalg.inv(found.information)
    # a little more than that, since points of the target are beside several of the source
    ratio = np.diag(found.covariance) / np.diag(plain)
    assert 1 < ratio.min() < ratio.max() < 2.5


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"method": "ndt"}, "method: expected one of gicp, icp, plane"),
        ({"max_distance": 0}, "max_distance"),
        ({"max_distance": float("inf")}, "max_distance"),
        ({"min_overlap": 1.5}, "min_overlap"),
        ({"initial": np.eye(4)}, "initial: expected a Transform"),
        ({"voxel": -1}, "voxel_grid: size"),
        ({"voxel": 9.0}, "target: expected 20 points or more, thinned to 9 m"),
        ({"source": Cloud(np.zeros((19, 3)))}, "source: expected 20 points or more, got 19"),
    ],
)
def test_wrong_arguments_are_refused(given: dict[str, object], said: str) -> None:
    _, target = pair(room, 7, count=100)
    wanted = {"source": Cloud(np.random.default_rng(0).random((100, 3)) * 99), "target": target}
    with pytest.raises(ConfigurationError, match=said):
        register(**(wanted | given))  # type: ignore[arg-type]


def test_points_at_one_place_give_no_pose() -> None:
    same = Cloud(np.ones((50, 3)))
    found = register(same, same)
    assert not found.converged
    assert found.covariance is None


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "noise"),
    [("plane", (0.0005, 0.002)), ("plane", (0.002, 0.002)), ("gicp", (0.002, 0.002))],
)
def test_covariance_equals_the_scatter(method: Method, noise: tuple[float, float]) -> None:
    rng = np.random.default_rng(8)
    off, told = [], []
    for _ in range(70):
        target = room(rng, 4000)
        source = MOTION.inverse().apply(room(rng, 2000))
        clouds = [
            Cloud(one + rng.normal(0, sigma, one.shape))
            for one, sigma in zip((source, target), (noise[1], noise[0]), strict=True)
        ]
        found = register(*clouds, method=method, max_distance=0.1)
        assert found.converged, found.reason
        assert found.covariance is not None
        off.append(error(found))
        told.append(np.diag(found.covariance))
    ratio = np.sqrt(np.mean(told, axis=0)) / np.std(off, axis=0)
    assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.2, ratio
    assert ratio == pytest.approx(np.ones(6), abs=0.4)
