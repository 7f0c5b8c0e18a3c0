from __future__ import annotations

import json
import math
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam import CalibrationError
from smartcam.calibration import PlaneCalibration, fit_plane
from smartcam.calibration._plane import robust as robust_module
from smartcam.calibration._plane.robust import (
    MAP_SOLVERS,
    MAX_FITTED_PROPOSALS,
    MAX_SUBSETS_TRIED,
    find_agreeing,
)
from smartcam.geometry._inside import Array, Code
from tests.calibration.inside import Fit, fit
from tests.calibration.plane.planekit import GRID, SIGMA, SPECIAL, Scene, grid, scenes, spread
from tests.geometry.rigid import FEW, refused

SCENE = Scene(SPECIAL[3], np.array([1.0, -2.0, 0.5]))
DOWN = -SCENE.turn[:, 2]
SIX, FIVE_BY_FIVE = grid(3, 2), grid(5, 5)


def with_wrong(marks: Array, wrong: list[int], seed: int = 1, scene: Scene = SCENE) -> Array:
    """Return touches, some of them 5 to 15 mm off in any direction."""
    random = np.random.default_rng([seed, len(marks)])
    touches = scene.touched(marks, seed)
    directions = random.normal(size=(len(wrong), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    touches[wrong] += random.uniform(0.005, 0.015, (len(wrong), 1)) * directions
    return touches


def robust(marks: Array, touches: Array, **options: Any) -> PlaneCalibration:
    return fit_plane(marks, touches, robust=True, tool_z=DOWN, **options)


@pytest.mark.parametrize("sigma", [SIGMA, None])
@pytest.mark.parametrize(
    ("marks", "wrong"),
    [(SIX, [4]), (GRID, [0, 8]), (GRID, [1, 3, 4]), (FIVE_BY_FIVE, [*range(0, 22, 2)])],
)
def test_fit_plane_robust_equals_the_fit_without_the_wrong_points(
    marks: Array, wrong: list[int], sigma: float | None
) -> None:
    touches, kept = with_wrong(marks, wrong), np.delete(np.arange(len(marks)), wrong)
    found = robust(marks, touches, touch_sigma=sigma, model="similarity")
    expected = fit_plane(marks[kept], touches[kept], touch_sigma=sigma, model="similarity")
    assert found.outliers == tuple(wrong)
    assert found.matrix.tobytes() == expected.matrix.tobytes()
    assert found.unit_covariance.tobytes() == expected.unit_covariance.tobytes()
    assert found.held_out_error == pytest.approx(expected.held_out_error, rel=1e-12)
    assert (found.freedom, found.touch_sigma) == (expected.freedom, expected.touch_sigma)


def test_fit_plane_robust_names_left_out_points_first() -> None:
    touches = with_wrong(GRID, [3, 7])
    found = robust(GRID, touches, touch_sigma=SIGMA)
    assert [one.code for one in found.warnings] == ["OUTLIER", "OUTLIER"]
    distance = 1e3 * float(np.linalg.norm(touches[7] - found.transform(GRID[7:8])[0]))
    assert found.warnings[1].text == (
        f"point 8 is left out: it lies {distance:.3g} mm from where the others predict it; "
        "touching errors alone would give 0.396 mm rms"
    )


def test_fit_plane_robust_keeps_wrong_points_with_weight_0() -> None:
    touches = with_wrong(GRID, [2])
    weights = np.linspace(1.0, 2.0, 9)
    found = robust(GRID, touches, touch_sigma=SIGMA, weights=weights)
    assert found.robot_points.tobytes() == touches.tobytes()
    assert found.weights.tolist() == [*weights[:2], 0.0, *weights[3:]]
    assert found.residuals == pytest.approx(touches - found.transform(GRID), abs=1e-15)
    assert found.leave_one_out[2].tolist() == found.residuals[2].tolist()
    assert found.worst != 2


def test_fit_plane_robust_warns_of_points_by_their_numbers_among_all() -> None:
    touches = SCENE.touched(FIVE_BY_FIVE, 1)
    touches[0] += 0.01
    bumps = 0.0003 * np.where(np.arange(25) % 2, 1.0, -1.0)
    bumps[[0, 20]] = 0.0, -0.0007
    touches += bumps[:, None] * SCENE.turn[:, 2]
    found = robust(FIVE_BY_FIVE, touches, touch_sigma=SIGMA, model="similarity")
    texts = {one.code: one.text for one in reversed(found.warnings)}
    assert found.outliers[0] == 0
    assert "point 1 is left out" in texts[Code.OUTLIER]
    assert "point 21 is the furthest" in texts[Code.NOT_PLANAR]


def test_fit_plane_robust_of_points_that_all_agree_is_the_ordinary_fit() -> None:
    touches = SCENE.touched(GRID, 1)
    plain = fit_plane(GRID, touches, touch_sigma=SIGMA, tool_z=DOWN)
    assert robust(GRID, touches, touch_sigma=SIGMA).to_data() == plain.to_data()


@pytest.mark.long
@pytest.mark.parametrize(("sigma", "most"), [(SIGMA, 5), (None, 8)])
def test_fit_plane_robust_leaves_out_a_good_point_seldom(sigma: float | None, most: int) -> None:
    ones = np.ones(9)
    left_out = sum(
        not find_agreeing(GRID, SCENE.touched(GRID, seed), ones, sigma).all()
        for seed in range(1000, 1150)
    )
    assert left_out <= most


@pytest.mark.long
@pytest.mark.parametrize(
    ("marks", "count", "sigma"),
    [(SIX, 1, None), (GRID, 0, SIGMA), (GRID, 2, None), (FIVE_BY_FIVE, 8, SIGMA)],
)
def test_fit_plane_robust_predicted_error_is_the_observed_one(
    marks: Array, count: int, sigma: float | None
) -> None:
    places = np.array([[0.0, 0.0], [0.15, 0.12], [0.35, 0.1]])
    observed = predicted = 0.0
    for seed in range(2000, 2060):
        wrong = np.random.default_rng(seed).permutation(len(marks))[:count].tolist()
        touches = with_wrong(marks, wrong, seed)
        found = robust(marks, touches, touch_sigma=sigma, model="similarity")
        observed += float(((found.transform(places) - SCENE.robot(places)) ** 2).sum())
        predicted += float((found.predicted_error(places) ** 2).sum())
    assert math.sqrt(predicted / observed) == pytest.approx(1.0, abs=0.13)


@pytest.mark.parametrize("count", [20, pytest.param(150, marks=pytest.mark.long)])
def test_agreeing_with_two_wrong_of_six_never_takes_one_for_right(count: int) -> None:
    found = []
    for seed in range(count):
        touches = with_wrong(SIX, [seed % 6, (seed + 1 + seed % 5) % 6], seed)
        with suppress(CalibrationError):  # a good point is an outlier, too
            found.append((seed, np.flatnonzero(~find_agreeing(SIX, touches, np.ones(6), SIGMA))))
    assert len(found) >= 0.95 * count
    for seed, left_out in found:
        assert {seed % 6, (seed + 1 + seed % 5) % 6} == set(left_out.tolist()), seed


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("model", ["auto", "similarity", "homography"])
def test_fit_plane_robust_of_a_tilted_camera_leaves_no_corner_out(model: Any) -> None:
    centred = FIVE_BY_FIVE - (0.15, 0.12)
    seen = 1200.0 * centred / (0.5 + centred[:, :1] * math.sin(math.radians(5))) + 500.0
    found = robust(seen, with_wrong(FIVE_BY_FIVE, [6, 24]), touch_sigma=SIGMA, model=model)
    assert found.outliers == (6, 24)
    warned = {one.code for one in found.warnings}
    assert (Code.NOT_SIMILAR in warned) == (model != "homography")
    assert (Code.POOR_FIT in warned) == (model == "similarity")


def test_fit_plane_robust_of_swapped_marks_finds_both() -> None:
    touches = SCENE.touched(GRID, 1)
    touches[[0, 8]] = touches[[8, 0]]
    assert robust(GRID, touches, touch_sigma=SIGMA).outliers == (0, 8)


def test_fit_plane_robust_of_a_touch_a_kilometre_off_finds_it() -> None:
    touches = SCENE.touched(GRID, 1)
    touches[4] += 1000.0
    with refused("UNIT_UNKNOWN"):
        fit_plane(GRID, touches, touch_sigma=SIGMA)
    found = robust(GRID, touches, touch_sigma=SIGMA)
    assert found.outliers == (4,)
    assert spread(found.transform(GRID), SCENE.robot(GRID)) < 5 * SIGMA


def test_fit_plane_robust_without_noise_finds_an_outlier_of_a_micrometre() -> None:
    touches = SCENE.robot(GRID)
    touches[5] += 1e-6
    assert robust(GRID, touches).outliers == (5,)


def test_fit_plane_robust_a_coarse_touch_may_lie_further_off() -> None:
    touches = SCENE.touched(GRID, 1)
    touches[4] += [0.002, 0.0, 0.0]
    weights = np.ones(9)
    assert robust(GRID, touches, touch_sigma=SIGMA).outliers == (4,)
    weights[4] = 0.01
    assert robust(GRID, touches, touch_sigma=SIGMA, weights=weights).outliers == ()


@FEW
@given(scenes(), st.permutations(range(16)), st.booleans(), st.integers(0, 2**32 - 1))
@example(Scene(np.eye(3), np.zeros(3)), [*range(15, -1, -1)], False, 0)
def test_fit_plane_robust_p10_order_of_points_is_irrelevant(
    scene: Scene, order: list[int], given_sigma: bool, seed: int
) -> None:
    marks = grid(4, 4)
    seen, touches = scene.camera(marks), with_wrong(marks, [0, 5, 6, 11], seed, scene)
    assert math.comb(16, 4) > MAX_SUBSETS_TRIED  # the picture shows them
    options: dict[str, Any] = {"robust": True, "touch_sigma": SIGMA if given_sigma else None}
    first = fit_plane(seen, touches, **options)
    second = fit_plane(seen[order], touches[order], **options)
    assert sorted(order[one] for one in second.outliers) == list(first.outliers)
    assert {0, 5, 6, 11} <= set(first.outliers)
    assert second.model == first.model
    assert spread(second.transform(seen), first.transform(seen)) < 1e-9


@FEW
@given(scenes(), st.integers(0, 2**32 - 1))
def test_fit_plane_robust_p16_stored_data_give_the_same_bits(scene: Scene, seed: int) -> None:
    touches = with_wrong(GRID, [3], seed, scene)
    found = fit_plane(scene.camera(GRID), touches, touch_sigma=SIGMA, robust=True)
    again = PlaneCalibration.from_data(json.loads(json.dumps(found.to_data())))
    assert again.to_data() == found.to_data()
    assert 3 in again.outliers
    assert again.held_out_error == found.held_out_error


def test_fit_plane_robust_saved_is_loaded_with_its_outliers(tmp_path: Path) -> None:
    found = robust(GRID, with_wrong(GRID, [3]), touch_sigma=SIGMA)
    found.save(tmp_path / "table.json")
    again = PlaneCalibration.load(tmp_path / "table.json")
    assert (again.outliers, again.warnings) == ((3,), found.warnings)


def test_plane_data_has_the_fields_of_version_1_0() -> None:
    """A file without later fields is read: a robust fit adds only a weight of 0."""
    data = fit_plane(GRID, with_wrong(GRID, [3]), robust=True, touch_sigma=SIGMA).to_data()
    required = {
        *("model", "camera_points", "robot_points", "weights", "matrix", "place", "residuals"),
        *("unit_covariance", "leave_one_out", "freedom", "touch_sigma", "sigma_given"),
        *("candidates", "nominal_scale", "robot_frame", "warnings"),
    }
    assert {*data} - required == {
        *("tool_z", "height", "camera_frame", "y_down", "allowed_error"),
    }
    kept = {name: data[name] for name in required}
    assert PlaneCalibration.from_data(kept).to_data() == data
    for name in required:
        with pytest.raises(ValueError, match=f"plane calibration: {name}: Field required"):
            PlaneCalibration.from_data({key: kept[key] for key in required - {name}})


@pytest.mark.parametrize(
    ("weights", "text"),
    [
        ([-1.0] + [1.0] * 8, "weights.0: .*greater than"),
        ([1.0] * 2 + [0.0] * 7, "weights: expected 3 that are not 0"),
    ],
)
def test_from_data_with_unfit_weights_raises(weights: list[float], text: str) -> None:
    data = robust(GRID, SCENE.touched(GRID, 1)).to_data()
    with pytest.raises(ValueError, match=f"stored plane calibration: {text}"):
        PlaneCalibration.from_data(data | {"weights": weights})


def test_fit_plane_robust_of_five_points_raises() -> None:
    with refused("TOO_FEW", "robust: expected at least 6 points, got 5"):
        robust(GRID[:5], SCENE.robot(GRID[:5]))


def test_fit_plane_robust_of_points_that_do_not_agree_raises() -> None:
    touches = with_wrong(GRID, [0, 1, 4, 6, 8])
    with refused("OUTLIER", "at least 5 of 9 points that agree with one map, got 4"):
        robust(GRID, touches, touch_sigma=SIGMA)


def test_fit_plane_robust_of_touches_anywhere_raises_without_a_sigma() -> None:
    touches = np.random.default_rng(1).uniform(0, 0.3, (12, 3)) * [1.0, 1.0, 0.05]
    with refused("SHORT_LEVER", "20 sigmas of a touch"):
        fit_plane(grid(4, 3), touches, robust=True, model="similarity")


@pytest.mark.parametrize(
    ("marks", "code"), [(GRID[[1] * 6], "COINCIDENT"), (GRID[:3].repeat(3, axis=0), "COLLINEAR")]
)
def test_fit_plane_robust_of_points_without_width_raises(marks: Array, code: str) -> None:
    with refused(code, "camera points"):
        fit_plane(marks, SCENE.robot(GRID[: len(marks)]), robust=True)


def test_fit_plane_robust_of_a_point_behind_the_horizon_raises() -> None:
    centred = FIVE_BY_FIVE - (0.15, 0.12)
    seen = 1200.0 * centred / (0.5 + centred[:, :1] * math.sin(math.radians(20))) + 500.0
    seen[3, 0] = 1e6
    with refused("OUT_OF_FIELD", "behind its horizon"):
        robust(seen, SCENE.touched(FIVE_BY_FIVE, 1), touch_sigma=SIGMA)


def test_agreeing_of_200_points_takes_few_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    marks = grid(20, 10)
    touches = with_wrong(marks, [*range(0, 180, 2)])
    proposed: list[int] = []
    fitted: list[Fit] = []
    for name, propose in MAP_SOLVERS.items():

        def counted(camera: Array, touched: Array, propose: Any = propose) -> Array:
            proposed.append(len(camera))
            maps: Array = propose(camera, touched)
            return maps

        monkeypatch.setitem(MAP_SOLVERS, name, counted)

    def kept(*given: Any) -> Fit:
        fitted.append(fit(*given))
        return fitted[-1]

    monkeypatch.setattr(robust_module, "fit", kept)
    mask = find_agreeing(marks, touches, np.ones(200), SIGMA)
    assert np.flatnonzero(~mask).tolist() == [*range(0, 180, 2)]
    assert len(proposed) == 2
    assert max(proposed) <= MAX_SUBSETS_TRIED
    assert (
        len(fitted) <= 2 * MAX_FITTED_PROPOSALS * 3
    )  # a round for each point, one that judges again, and one that confirms
