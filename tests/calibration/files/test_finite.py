"""No file with a right hash gives a calibration whose poses contain NaN."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import (
    Chain,
    HandEyeCalibration,
    PlaneCalibration,
    PlaneProjection,
    RobotSigmas,
    SheetCalibration,
    StereoCalibration,
    calibrate_hand_eye,
    calibrate_sheet,
    calibrate_stereo,
    chain_of,
    fit_corners,
    fit_plane,
)
from smartcam.exceptions import CalibrationError
from smartcam.models import Localization
from tests.calibration.inside import CameraPosition2D, write
from tests.calibration.inside import _scenes as scenes
from tests.calibration.lenskit import pairs
from tests.calibration.scenes import CAMERA as ROBOT_CAMERA
from tests.calibration.scenes import scene
from tests.calibration.sheetkit import CAMERA, LIES, SEEN, TARGET, field, localized

GRID = np.stack(np.meshgrid([0.0, 0.15, 0.3], [0.0, 0.12, 0.24]), axis=-1).reshape(-1, 2)


def part(x: float, y: float, theta: float = 0.0) -> Localization:
    return localized(x, -y, theta)


WRONG = (1e308, -1e308, 1e99, -1e99, 1e-308, 0.0)


def numbers(data: Any, *, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the places of numbers; of long lists and lists of mappings the first one's."""
    if isinstance(data, float):
        yield path
    elif isinstance(data, dict):
        for name, value in data.items():
            yield from numbers(value, path=(*path, name))
    elif isinstance(data, list) and data:
        short = len(data) <= 5 and not isinstance(data[0], dict)
        for index, value in enumerate(data if short else data[:1]):
            yield from numbers(value, path=(*path, index))


def flat(parts: Iterable[Localization]) -> list[float]:
    return [number for one in parts for number in (*one.pose.position, *one.pose.orientation)]


@functools.cache
def plane(model: str) -> PlaneCalibration:
    touches = np.column_stack([0.3 + GRID, np.full(len(GRID), 0.1)])
    return fit_plane(1000.0 * GRID, touches, model=model)  # type: ignore[arg-type]


def plane_gives(found: PlaneCalibration) -> list[np.ndarray]:
    parts = [part(10.0, 20.0, 0.3), part(0.0, 0.0)]
    return [
        np.array(flat(found.to_robot(parts))),
        np.array(flat([found.to_robot(parts[0], tool_flip=True)])),
        found.transform([[10.0, 20.0], [250.0, 200.0]]),
        found.transform(np.full((1000, 2), 20.0)),
        found.inverse([[0.3, 0.1, 0.1]]),
        np.array(flat(chain_of(found).to_robot(parts))),
    ]


@functools.cache
def sheet() -> SheetCalibration:
    view = scenes.view(TARGET, CAMERA, SEEN, sigma=0.0, random=np.random.default_rng(1))
    corners = [0, 8, 45, 53, 22]
    return calibrate_sheet(
        view, fit_corners(TARGET, corners, LIES.apply(TARGET.points[corners])), camera=CAMERA
    )


def sheet_gives(found: SheetCalibration) -> list[np.ndarray]:
    u, v = field()[20]
    parts = [localized(u, v, 0.3)]
    return [
        np.array(flat(found.to_robot(parts))),
        np.array(flat(found.chain.to_robot(parts))),
        found.transform([[u, v]]),
    ]


@functools.cache
def hand_eye() -> HandEyeCalibration:
    poses, views = scene("eye-in-hand").simulate_measurements(
        pixel_sigma=0.0, robot_sigmas=RobotSigmas(0.0, 0.0), random=np.random.default_rng(1)
    )
    return calibrate_hand_eye(poses, views, setup="eye-in-hand", camera=ROBOT_CAMERA)


def hand_eye_gives(found: HandEyeCalibration) -> list[np.ndarray]:
    pose = scene("eye-in-hand").robot_poses[0]
    camera = found.camera_at(pose)
    pixels = ROBOT_CAMERA.matrix[None, :2, 2]
    plane_there = scene("eye-in-hand").target_pose
    return [
        camera.translation,
        camera.quaternion,
        found.to_plane(pixels, plane=plane_there, robot_pose=pose),
    ]


@functools.cache
def stereo() -> StereoCalibration:
    return calibrate_stereo(*pairs(5))


def stereo_gives(found: StereoCalibration) -> list[np.ndarray]:
    points = found.triangulate([[300.0, 240.0], [320.0, 200.0]], [[280.0, 240.0], [290.0, 200.0]])
    return [points[~np.isnan(points)]]  # the intersection of the rays is NaN


CASES: list[tuple[Any, Callable[[Any], list[np.ndarray]]]] = [
    (lambda: plane("similarity"), plane_gives),
    (lambda: plane("homography"), plane_gives),
    (sheet, sheet_gives),
    (hand_eye, hand_eye_gives),
    (stereo, stereo_gives),
]


@pytest.mark.parametrize(
    ("made", "gives"),
    [*CASES[:2], *(pytest.param(*one, marks=pytest.mark.long) for one in CASES[2:])],
    ids=["similarity", "homography", "sheet", "hand-eye", "stereo"],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_file_with_a_right_hash_and_any_number_gives_numbers_or_is_refused(
    made: Callable[[], Any], gives: Callable[[Any], list[np.ndarray]]
) -> None:
    good = made()
    data = good.to_data()
    assert all(np.isfinite(one).all() for one in gives(good))
    for path in numbers(
        {name: one for name, one in data.items() if name[-5:] not in {"views", "poses"}}
    ):
        inner: Any = data
        for step in path[:-1]:
            inner = inner[step]
        right = inner[path[-1]]
        for wrong in WRONG:
            inner[path[-1]] = wrong
            try:
                given = gives(type(good).from_data(data))
            except CalibrationError:
                continue
            for one in given:
                assert np.isfinite(one).all(), (path, wrong)
        inner[path[-1]] = right


def test_file_with_an_invalid_number_is_refused_at_the_load(tmp_path: Path) -> None:
    data = plane("similarity").to_data()
    data["matrix"][0][0] = 1e308
    write(tmp_path / "a.json", "plane", data)
    with pytest.raises(CalibrationError, match=r"matrix\.0\.0: .*a number up to 1e\+100"):
        PlaneCalibration.load(tmp_path / "a.json")
    data["matrix"] = np.zeros((4, 3)).tolist()
    write(tmp_path / "a.json", "plane", data)
    with pytest.raises(CalibrationError, match="plane's matrix: expected finite numbers") as told:
        PlaneCalibration.load(tmp_path / "a.json")
    assert told.value.code == "NOT_FINITE"


@pytest.mark.parametrize("model", ["similarity", "homography"])
@pytest.mark.parametrize("count", [1, 1000])
def test_transform_of_points_beyond_numbers_is_refused_and_nan_stays(
    model: str, count: int
) -> None:
    found = plane(model)
    points = np.full((count, 2), 10.0)
    points[0] = np.nan
    assert np.isnan(found.transform(points)[0]).all()
    assert np.isfinite(found.transform(points)[1:]).all()
    steep = PlaneCalibration.from_data(
        {**found.to_data(), "matrix": [[1e70, 0, 0], [0, 1e70, 0], [0, 0, 0], [0, 0, 1.0]]}
    )
    points[0] = 1e307
    with pytest.raises(CalibrationError, match=r"point \[1e\+307, 1e\+307\]: expected finite"):
        steep.transform(points)


def test_to_robot_of_a_pose_beyond_numbers_names_the_part() -> None:
    steep = PlaneCalibration.from_data(
        {
            **plane("similarity").to_data(),
            "matrix": [[1e70, 0, 0], [0, 1e70, 0], [0, 0, 0], [0, 0, 1]],
        }
    )
    with pytest.raises(CalibrationError, match="pose of 'mark': expected finite") as told:
        steep.to_robot(part(1e300, 1.0)._replace(feature_id="mark"))
    assert told.value.code == "NOT_FINITE"


def test_chain_that_gives_no_numbers_is_refused() -> None:
    flat_one = PlaneProjection([[1, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1]])  # all on a line
    for chain in (Chain([CameraPosition2D((0, 0), 0.0, 1e308)]), Chain([flat_one])):
        with pytest.raises(CalibrationError) as told:
            chain.to_robot(part(10.0, 20.0))
        assert told.value.code == "NOT_FINITE"
