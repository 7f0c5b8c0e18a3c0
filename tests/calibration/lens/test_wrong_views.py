"""Invalid and misleading views give a typed error, or a remark with their name."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam.calibration import (
    CameraModel,
    Charuco,
    Checkerboard,
    CircleGrid,
    TargetView,
    Transform,
    calibrate_intrinsics,
    locate,
    target_from_data,
)
from smartcam.calibration._lens.misfit import Equations
from smartcam.calibration._lens.suspicions import stray_squares
from smartcam.geometry._inside import Code
from tests.calibration.lenskit import BOARD, LEFT, poses, seen
from tests.calibration.scenes import refused

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.geometry._inside import Array

VIEW = seen(LEFT, poses(1))[0]
IMAGE = np.zeros((480, 640), dtype=np.uint8)


def changed(view: TargetView, points: Array) -> TargetView:
    return dataclasses.replace(view, points=points)


def flipped(view: TargetView, axis: int) -> TargetView:
    """Return the view in the flipped picture, with corners numbered as they are read there."""
    board = view.target
    assert isinstance(board, Checkerboard)
    numbers = np.arange(len(board.points)).reshape(board.rows, board.columns)[:, ::-1].ravel()
    order = np.argsort(numbers[view.ids])
    points = view.points.copy()
    points[:, axis] = view.size[axis] - 1 - points[:, axis]
    covariance = view.covariance * np.array([[1, -1], [-1, 1]])
    return dataclasses.replace(
        view, ids=numbers[view.ids][order], points=points[order], covariance=covariance[order]
    )


def mirrored(view: TargetView) -> TargetView:
    return changed(view, view.points * [-1, 1] + [view.size[0] - 1, 0])


def doubled(values: Any) -> Any:
    return np.concatenate([values[:1], values[:-1]])


@pytest.mark.parametrize(
    ("changes", "code", "text"),
    [
        (
            {"target": None},
            Code.SHAPE,
            "target: expected a Checkerboard or Charuco or CircleGrid or ",
        ),
        ({"size": (0, 480)}, Code.SHAPE, "size: expected width and height"),
        ({"size": 640}, Code.SHAPE, "size: expected width and height"),
        ({"name": 3}, Code.SHAPE, "name: expected a str, got int"),
        ({"ids": doubled(VIEW.ids)}, Code.SHAPE, "each once, ascending"),
        ({"ids": VIEW.ids[::-1]}, Code.SHAPE, "each once, ascending"),
        ({"ids": VIEW.ids - 1}, Code.SHAPE, "expected 0 or more, got -1"),
        ({"ids": VIEW.ids + 1}, Code.SHAPE, "expected less than 54, got 54"),
        ({"ids": VIEW.ids + 0.5}, Code.SHAPE, "expected whole numbers"),
        ({"ids": None}, Code.SHAPE, "expected whole numbers"),
        ({"points": VIEW.points[1:]}, Code.SHAPE, r"expected shape \(54, 2\)"),
        ({"points": VIEW.points.T}, Code.SHAPE, r"expected shape \(N, 2\)"),
        ({"points": VIEW.points + 1j}, Code.SHAPE, "complex"),
        ({"points": np.full((54, 2), np.inf)}, Code.NOT_FINITE, "finite numbers"),
        ({"covariance": np.ones(54)}, Code.SHAPE, r"expected shape \(54, 2, 2\)"),
        ({"covariance": -VIEW.covariance}, Code.NOT_A_COVARIANCE, "no negative variance"),
        (
            {"covariance": VIEW.covariance + np.triu(np.ones((2, 2)), 1)},
            Code.NOT_A_COVARIANCE,
            "symmetric",
        ),
        ({"covariance": np.tile([[1.0, 2], [2, 1]], (54, 1, 1))}, Code.NOT_A_COVARIANCE, "row 0"),
        ({"covariance": np.nan * VIEW.covariance}, Code.NOT_FINITE, "finite numbers"),
    ],
)
def test_invalid_view_is_refused(changes: dict[str, Any], code: Code, text: str) -> None:
    with pytest.raises(Exception, match=text) as caught:
        dataclasses.replace(VIEW, **changes)
    assert getattr(caught.value, "code", None) == code


def test_view_keeps_read_only_copies() -> None:
    points = VIEW.points.copy()
    view = changed(VIEW, points)
    points[0] = np.nan
    assert np.isfinite(view.points).all()
    with pytest.raises(ValueError, match="read-only"):
        view.points[0] = 0.0


@pytest.mark.parametrize(
    ("make", "code", "text"),
    [
        (mirrored, Code.MIRRORED, "as in a mirror"),
        (lambda view: changed(view, view.points[:, ::-1] * [1.0, 0.7]), Code.MIRRORED, "u and v"),
        (lambda view: changed(view, view.points * 3), Code.WRONG_SIZE, "in the image of 640 x 480"),
        (
            lambda view: changed(view, np.random.default_rng(0).permutation(view.points)),
            Code.POOR_FIT,
            "an order that agrees with it by",
        ),
        (lambda _: None, Code.SHAPE, "expected a TargetView, got None"),
        (lambda _: IMAGE, Code.SHAPE, r"got ndarray of shape \(480, 640\)"),
    ],
)
def test_locate_of_a_view_of_another_target_is_refused(
    make: Callable[[TargetView], Any], code: Code, text: str
) -> None:
    with pytest.raises(Exception, match=text) as caught:
        locate(make(VIEW), LEFT)
    assert getattr(caught.value, "code", None) == code


@pytest.mark.parametrize("views", [None, 3, "views", IMAGE, {}, [None] * 4, [IMAGE] * 4, [VIEW, 3]])
def test_calibrate_intrinsics_of_no_views_is_refused(views: Any) -> None:
    with refused("SHAPE", "intrinsics: view"):
        calibrate_intrinsics(views)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"sheet": "flat"}, "sheet: expected one of"),
        ({"sheet": None}, "sheet: expected one of"),
        ({"distortion_model": []}, "distortion model: expected one of"),
        ({"fixed": "k3"}, "fixed: name: expected a list"),
        ({"fixed": None}, "fixed: name: expected a list"),
        ({"fixed": [3]}, "fixed: name 0: expected a str, got int"),
    ],
)
def test_calibrate_intrinsics_of_wrong_options_is_refused(
    options: dict[str, Any], text: str
) -> None:
    with refused("SHAPE", text):
        calibrate_intrinsics(seen(LEFT, poses(3)), **options)


def test_calibrate_intrinsics_of_mirrored_views_is_refused() -> None:
    views = seen(LEFT, poses(8))
    with refused("MIRRORED", "in 02"):
        calibrate_intrinsics([*views[:2], mirrored(views[2]), *views[3:]])
    with refused("MIRRORED", "in 00"):
        calibrate_intrinsics([mirrored(one) for one in views])


@pytest.mark.long
@pytest.mark.parametrize("ways", [(1,), (0, 1)])
def test_calibrate_intrinsics_of_some_flipped_pictures_names_them(ways: tuple[int, ...]) -> None:
    views = seen(LEFT, poses(15, seed=4), seed=4)
    for number in (4, 7, 9):
        for axis in ways:
            views[number] = flipped(views[number], axis)
    (remark,) = [one for one in calibrate_intrinsics(views).warnings if one.code == Code.MIRRORED]
    assert "flipped" in remark.text
    assert ": 04, 07, 09. " in remark.text
    for other in ("bend anew", "shutter that rolls", "lens of another model"):
        assert other in remark.text


@pytest.mark.long
def test_calibrate_intrinsics_of_a_stretched_sheet_sees_no_flips() -> None:
    views = seen(LEFT, poses(15), points=BOARD.points * [1.01, 1.0, 1.0])
    found = calibrate_intrinsics(views, sheet="exact")
    assert found.rms > 0.2  # flipped pictures would remove half of the squares
    assert {Code.OUTLIER, Code.MIRRORED}.isdisjoint(one.code for one in found.warnings)


@pytest.mark.parametrize(
    "same",
    [
        pytest.param(True, marks=pytest.mark.long),
        pytest.param(False, marks=pytest.mark.long),
    ],
)
def test_calibrate_intrinsics_names_points_that_are_off_and_leaves_them_out(same: bool) -> None:
    views, random = seen(LEFT, poses(9, seed=4), seed=4), np.random.default_rng(0)
    for number, view in enumerate(views):
        row = int(np.flatnonzero(view.ids == 10)[0]) if same else random.integers(len(view.ids))
        points, angle = view.points.copy(), 0.3 if same else random.uniform(0, 2 * math.pi)
        points[row] += 3.0 * np.array([math.cos(angle), math.sin(angle)])
        views[number] = changed(view, points)
    found = calibrate_intrinsics(views, sheet="exact")
    (remark,) = [one for one in found.warnings if one.code == Code.OUTLIER]
    if same:
        assert remark.text.startswith("point 10 of the target is 2.")
        assert "in 9 of 9 views" in remark.text
    else:
        assert "each was not used" in remark.text
        assert "and 4 more" in remark.text
    assert [len(one.view.ids) for one in found.views] == [len(one.ids) - 1 for one in views]
    assert found.rms < 0.055
    assert abs(found.camera.matrix[0, 0] - 530) < 4 * found.deviations["fx"]


def test_calibrate_intrinsics_names_stray_points_that_it_keeps_on_request() -> None:
    views = seen(LEFT, poses(5))
    points = views[2].points.copy()
    points[7] += 3.0
    kept = calibrate_intrinsics([*views[:2], changed(views[2], points), *views[3:]], drop_bad=False)
    assert [one.code for one in kept.warnings][:1] == [Code.OUTLIER]
    assert "have them: 7 in 02 (4.2" in kept.warnings[0].text
    assert kept.warnings[0].text.endswith("pixels): each is used all the same")


def test_calibrate_intrinsics_uses_a_view_without_the_point_that_is_off() -> None:
    views = seen(LEFT, poses(5))
    points = views[2].points.copy()
    points[7] += 3.0
    found = calibrate_intrinsics([*views[:2], changed(views[2], points), *views[3:]])
    assert found.bad_views == ()
    assert len(found.views[2].view.ids) == len(views[2].ids) - 1


def test_calibrate_intrinsics_of_points_of_a_smaller_image_has_a_remark() -> None:
    views = [changed(one, one.points / 2) for one in seen(LEFT, poses(5))]
    found = calibrate_intrinsics([*views, dataclasses.replace(views[0], name="copy")])
    texts = {one.code: one.text for one in found.warnings}
    assert "near the middle of an image of 640 x 480 pixels, got (16" in texts[Code.WRONG_SIZE]
    assert "the same to the last digit: 00, copy" in texts[Code.COINCIDENT]


def test_strays_differ_from_their_neighbours() -> None:
    random = np.random.default_rng(1)
    residuals, by_pose = random.normal(size=(40, 2)), random.normal(size=(40, 2, 6))
    residuals[[3, 30]] += [[15, 0], [0, -20]]
    some = Equations(by_pose, np.zeros((40, 2, 0)), residuals, np.full(40, 0.1))
    assert np.flatnonzero(stray_squares(some, 1.0)).tolist() == [3, 30]
    assert not stray_squares(some, 3.0**2).any()  # seven of these
    assert not stray_squares(some._replace(deviations=np.full(40, 0.01)), 1.0).any()  # 0.2 pixels
    many = residuals + 30 * (np.arange(40) % 3 == 0)[:, None]
    assert not stray_squares(some._replace(residuals=many), 1.0).any()


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: CameraModel(size=None, matrix=LEFT.matrix), "size"),  # type: ignore[arg-type]
        (lambda: CameraModel(size=(640, 480), matrix=[[1], [2, 3]]), "numbers"),  # type: ignore[arg-type]
        (lambda: CameraModel(size=(640, 480), matrix=LEFT.matrix, distortion=[[1], [2, 3]]), "K"),  # type: ignore[arg-type]
        (lambda: Checkerboard(columns=9, rows=6, square=0.02, origin_mark=1), "True or False"),  # type: ignore[arg-type]
        (
            lambda: Charuco(columns=5, rows=6, square=0.02, marker=0.01, dictionary=10),  # type: ignore[arg-type]
            "name of a dictionary",
        ),
        (
            lambda: CircleGrid(
                columns=5, rows=6, spacing=0.02, diameter=0.01, origin_diameter=math.nan
            ),
            "origin_diameter to be a length",
        ),
        (lambda: target_from_data(None), "expected a kind of"),  # type: ignore[arg-type]
        (lambda: Transform(np.eye(3), np.zeros(3), "base", "flange"), "names of two frames"),  # type: ignore[arg-type]
        (lambda: locate(VIEW, None), "expected a CameraModel, got None"),  # type: ignore[arg-type]
    ],
)
def test_values_of_wrong_types_are_refused(make: Callable[[], object], text: str) -> None:
    with refused("SHAPE", text):
        make()
