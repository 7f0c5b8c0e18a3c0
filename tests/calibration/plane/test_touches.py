from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from smartcam import CalibrationError
from smartcam.calibration import PlaneCalibration, fit_touches
from smartcam.geometry._inside import Array, rotate_ccw
from tests.calibration.plane.planekit import SIGMA, SPECIAL, Scene, part, spread

SCENE = Scene(SPECIAL[4], np.array([1.0, -2.0, 0.5]))
PLACE, THETA = np.array([0.1, 0.05]), 0.6
ORIGIN = part(0.1, 0.05, THETA)


def marks(*along: float, ray: int) -> Array:
    """Return places on ray A (0) or B (1) of the sheet, in the camera's frame."""
    steps = np.zeros((len(along), 2))
    steps[:, ray] = along
    return PLACE + rotate_ccw(steps, THETA)


def touched(seed: int, *, a: float = 0.2, b: float = 0.15, sigma: float = SIGMA) -> list[Array]:
    places = np.concatenate([PLACE[None], marks(a, ray=0), marks(b, ray=1)])
    return list(SCENE.touched(places, seed, sigma))


def fitted(seed: int, **options: Any) -> PlaneCalibration:
    return fit_touches(ORIGIN, *touched(seed), **{"touch_sigma": SIGMA, **options})


def test_fit_touches_without_noise_maps_the_whole_field() -> None:
    found = fit_touches(ORIGIN, *touched(0, sigma=0.0))
    field = np.array([[0.0, 0.0], [0.3, -0.2], [-0.1, 0.4]])
    assert spread(found.transform(field), SCENE.robot(field)) < 1e-12
    assert found.model == "touches"
    assert found.rotation[:, 2] == pytest.approx(SCENE.turn[:, 2])


def test_fit_touches_reports_the_unchecked_values() -> None:
    found = fitted(1)
    assert [one.code for one in found.warnings] == ["SCALE_ASSUMED", "NOT_HELD_OUT", "SIDE_UNKNOWN"]
    assert found.held_out_error is None
    assert found.residuals == pytest.approx(
        found.robot_points - found.transform(found.camera_points), abs=1e-12
    )


@pytest.mark.parametrize("y_down", [True, False, None])
def test_fit_touches_y_down_is_kept(y_down: bool | None) -> None:
    found = fitted(1, y_down=y_down)
    assert PlaneCalibration.from_data(found.to_data()).y_down is y_down


def test_fit_touches_without_sigma_estimates_it_badly_with_a_remark() -> None:
    found = fitted(1, touch_sigma=None, tool_z=-SCENE.turn[:, 2])
    assert found.warnings[0].code == "UNVERIFIED"
    assert "estimated from 1 degrees of freedom" in found.warnings[0].text
    assert found.freedom == 1


@pytest.mark.long
def test_fit_touches_predicted_error_equals_the_observed_one() -> None:
    places = np.array([[0.1, 0.05], [0.3, 0.2], [0.0, 0.3]])
    found = [fitted(seed) for seed in range(400)]
    errors = np.array([one.transform(places) - SCENE.robot(places) for one in found])
    observed = np.sqrt((errors**2).sum(axis=2).mean(axis=0))
    assert found[0].predicted_error(places) == pytest.approx(observed, rel=0.1)


@pytest.mark.long
def test_fit_touches_beats_the_frame_from_three_points() -> None:
    place = np.array([[0.1, 0.05]]) + rotate_ccw([[0.2, 0.2]], THETA)
    ours, plain = 0.0, 0.0
    for seed in range(300):
        o, a, b = touched(seed, a=0.1, b=0.2)
        ours += float(((fitted_from(o, a, b).transform(place) - SCENE.robot(place)) ** 2).sum())
        x = (a - o) / np.linalg.norm(a - o)
        normal = np.cross(x, b - o)
        y = np.cross(normal / np.linalg.norm(normal), x)
        plain += float(((o + 0.2 * x + 0.2 * y - SCENE.robot(place)) ** 2).sum())
    assert math.sqrt(ours) < 0.95 * math.sqrt(plain)


def fitted_from(o: Array, a: Array, b: Array) -> PlaneCalibration:
    return fit_touches(ORIGIN, o, a, b, touch_sigma=SIGMA)


def test_fit_touches_more_touches_of_a_ray_are_better() -> None:
    origin = SCENE.robot(np.array([PLACE, PLACE]))
    a, b = (SCENE.robot(marks(0.1, 0.2, 0.3, ray=ray)) for ray in (0, 1))
    found = fit_touches(ORIGIN, origin, a, b, touch_sigma=SIGMA)
    assert found.freedom == 12
    assert found.camera_points[4] == pytest.approx(marks(0.3, ray=0)[0])
    assert (found.predicted_error([PLACE]) < 0.75 * fitted(1).predicted_error([PLACE])).all()


def test_fit_touches_uncertain_theta_counts_with_distance() -> None:
    plain, uncertain = fitted(1), fitted(1, theta_sigma=math.radians(0.1))
    far = marks(0.3, ray=0)
    more = uncertain.predicted_error(far) ** 2 - plain.predicted_error(far) ** 2
    assert np.sqrt(more) == pytest.approx([0.3 * math.radians(0.1)], rel=0.01)
    assert uncertain.predicted_error([PLACE]) == pytest.approx(plain.predicted_error([PLACE]))


def test_fit_touches_of_rays_not_at_right_angles_warns() -> None:
    o, a, b = touched(1)
    found = fit_touches(ORIGIN, o, a, b + 0.1 * (a - o), touch_sigma=SIGMA)
    assert found.warnings[0].code == "POOR_FIT"
    assert "beside rays at right angles" in found.warnings[0].text


@pytest.mark.parametrize(
    ("change", "code", "text"),
    [
        ({"a": 0.0}, "COINCIDENT", "a vector of length 0"),
        ({"a": 0.003}, "SHORT_LEVER", r"at least 20 sigmas of a touch \(4 mm\).*got 3 mm"),
        ({"b": math.nan}, "NOT_FINITE", "touches of ray B: expected finite numbers"),
    ],
)
def test_fit_touches_of_useless_points_raises(
    change: dict[str, float], code: str, text: str
) -> None:
    with pytest.raises(CalibrationError, match=text) as caught:
        fit_touches(ORIGIN, *touched(1, sigma=0.0, **change), touch_sigma=SIGMA)
    assert caught.value.code == code


def test_fit_touches_of_one_ray_twice_raises() -> None:
    o, a, _ = touched(1)
    with pytest.raises(CalibrationError, match="at least 10 degrees") as caught:
        fit_touches(ORIGIN, o, a, a + 0.01 * (a - o))
    assert caught.value.code == "COLLINEAR"


def test_fit_touches_of_swapped_rays_is_mirrored() -> None:
    o, a, b = touched(1)
    with pytest.raises(CalibrationError, match="y axis points the wrong way") as caught:
        fit_touches(ORIGIN, o, b, a, tool_z=-SCENE.turn[:, 2])
    assert caught.value.code == "MIRRORED"


def test_fit_touches_with_a_scale_maps_pixels() -> None:
    origin = part(100.0, 50.0, THETA)
    found = fit_touches(origin, *touched(0, sigma=0.0), nominal_scale=0.001)
    field = np.array([[0.0, 0.0], [0.3, -0.2]])
    assert spread(found.transform(1000 * field), SCENE.robot(field)) < 1e-12
    assert found.scale == pytest.approx(0.001)


@pytest.mark.parametrize("sigma", [-0.001, math.nan, math.inf])
def test_fit_touches_with_an_impossible_theta_sigma_raises(sigma: float) -> None:
    with pytest.raises(CalibrationError, match="theta_sigma: expected a number") as caught:
        fitted(1, theta_sigma=sigma)
    assert caught.value.code == "NOT_FINITE"


def test_fit_touches_without_a_touch_of_a_ray_names_the_ray() -> None:
    o, _, b = touched(1)
    with pytest.raises(CalibrationError, match="touches of ray A: expected one or more") as caught:
        fit_touches(ORIGIN, o, np.empty((0, 3)), b)
    assert caught.value.code == "TOO_FEW"
