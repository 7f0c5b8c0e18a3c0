"""Mistaken touches never give the verdict good with an error beyond the allowed one."""

from __future__ import annotations

import itertools
from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam.calibration import fit_plane
from smartcam.calibration._plane.order import find_better_order
from smartcam.exceptions import CalibrationError
from tests.calibration.plane.planekit import SIGMA, SPECIAL, Scene
from tests.calibration.scenes import refused

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.geometry._inside import Array

SCENE = Scene(SPECIAL[3], np.array([1.0, -2.0, 0.5]))
DOWN = -SCENE.turn[:, 2]
FIELD = np.stack(np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 6)), axis=-1).reshape(-1, 2)


def layout(count: int, random: np.random.Generator) -> Array:
    """Return marks in a natural layout: apart, and not in a line."""
    while True:
        marks = random.uniform((0.0, 0.0), (0.3, 0.24), (count, 2))
        apart = np.linalg.norm(marks[:, None] - marks, axis=2) + np.eye(count)
        extents = np.linalg.svd(marks - marks.mean(axis=0), compute_uv=False)
        if apart.min() > 0.04 and extents[1] > 0.4 * extents[0]:
            return marks


def mistakes(touches: Array, random: np.random.Generator, offs: int) -> Iterator[Array]:
    """Yield touches with pairs exchanged, with all shifted, and with ``offs`` a kind off."""
    count = len(touches)
    for pair in itertools.combinations(range(count), 2):
        order = np.arange(count)
        order[[*pair]] = order[[*pair[::-1]]]
        yield touches[order]
    for by in range(1, count):
        yield np.roll(touches, by, axis=0)
    for off, wrong, _ in itertools.product((0.005, 0.01, 0.03, 0.1), (1, 2), range(offs)):
        moved, way = touches.copy(), random.normal(size=(wrong, 3))
        if random.random() < 0.5:
            way[:] = way[0]  # the same mistake twice
        if random.random() < 0.7:
            way = way - np.outer(way @ SCENE.turn[:, 2], SCENE.turn[:, 2])  # in the plane
        way *= off / np.linalg.norm(way, axis=1, keepdims=True)
        moved[random.choice(count, wrong, replace=False)] += way
        yield moved


def outcome(marks: Array, touches: Array, sigma: float | None) -> str:
    """Return the level of the verdict, ``error``, or ``beyond``: good, and off by too much."""
    try:
        found = fit_plane(marks, touches, touch_sigma=sigma, tool_z=DOWN)
    except CalibrationError:
        return "error"
    if found.verdict.level != "good":
        return found.verdict.level
    low, extent = marks.min(axis=0), np.ptp(marks, axis=0)
    field = low + extent * FIELD
    off = np.linalg.norm(found.transform(field) - SCENE.robot(field), axis=1)
    allowed = 0.01 * float(np.linalg.norm(extent))
    return "beyond" if np.percentile(off, 95) > 1.05 * allowed else "good"


@pytest.mark.parametrize(
    ("counts", "offs"),
    [
        ((4, 5, 7), 1),
        pytest.param(range(4, 13), 12, marks=pytest.mark.long),
    ],
)
def test_no_mistake_beyond_the_allowed_error_is_called_good(counts: list[int], offs: int) -> None:
    random, found = np.random.default_rng(41), Counter[str]()
    for count in counts:
        marks = layout(count, random)
        touches = SCENE.touched(marks, count)
        found += Counter(outcome(marks, one, None) for one in mistakes(touches, random, offs))
    assert found["beyond"] == 0, found
    assert found["poor"] + found["error"] > 0.9 * sum(found.values()), found


@pytest.mark.long
@pytest.mark.parametrize("sigma", [None, SIGMA])
def test_honest_touches_are_seldom_called_anything_but_good(sigma: float | None) -> None:
    random = np.random.default_rng(42)
    found = Counter[str]()
    for seed in range(240):
        marks = layout(5 + seed % 8, random)
        found[outcome(marks, SCENE.touched(marks, seed), sigma)] += 1
    assert found["good"] >= 0.96 * sum(found.values()), found
    assert found["beyond"] == 0, found


def test_seven_marks_with_three_in_the_wrong_order_are_put_right() -> None:
    random = np.random.default_rng(3)
    marks = layout(7, random)
    order = np.array([0, 4, 2, 1, 3, 5, 6])
    found = find_better_order(marks, SCENE.touched(marks, 1)[order], 3 * SIGMA)
    assert found is not None
    assert found.sure
    assert order[found.order].tolist() == [*range(7)]
    assert found.moved == (1, 3, 4)


def test_order_of_a_grid_that_fits_from_several_sides_is_not_sure() -> None:
    marks = np.array([(0.15 * i, 0.12 * j) for i in range(3) for j in range(3)])
    touches = SCENE.touched(marks, 1)
    pair = find_better_order(marks, touches[[0, 5, 2, 3, 4, 1, 6, 7, 8]], 3 * SIGMA)
    assert pair is not None
    assert (pair.sure, pair.moved) == (True, (1, 5))
    shifted = find_better_order(marks, np.roll(touches, 1, axis=0), 3 * SIGMA)
    assert shifted is not None
    assert not shifted.sure
    assert find_better_order(marks, touches, 3 * SIGMA) is None


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf"), "0.001", True, [1.0]])
@pytest.mark.parametrize("name", ["allowed_error", "touch_sigma", "nominal_scale"])
def test_option_that_is_no_positive_number_is_refused(name: str, value: Any) -> None:
    marks = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.2], [0.3, 0.2], [0.1, 0.05]])
    options: dict[str, Any] = {name: value}
    with refused("NOT_FINITE", f"{name}: expected a positive number of"):
        fit_plane(marks, np.pad(marks, ((0, 0), (0, 1))), **options)


@pytest.mark.parametrize("sigma", [None, SIGMA])
def test_shifted_rows_of_a_grid_are_reported_though_most_points_agree(
    sigma: float | None,
) -> None:
    marks = np.array([(0.15 * i, 0.12 * j) for j in range(3) for i in range(3)])
    touches = np.roll(SCENE.touched(marks, 1), 3, axis=0)  # two rows agree with each other
    found = fit_plane(marks, touches, touch_sigma=sigma, tool_z=DOWN, robust=True)
    assert "WRONG_ORDER" in {one.code for one in found.warnings}
    assert found.verdict.level == "poor"


def test_exchanged_touches_that_are_left_out_are_reported_once() -> None:
    marks = layout(12, np.random.default_rng(2))
    touches = SCENE.touched(marks, 1)[[1, 0, *range(2, 12)]]
    found = fit_plane(marks, touches, touch_sigma=SIGMA, tool_z=DOWN, robust=True)
    assert found.outliers == (0, 1)
    assert {one.code for one in found.warnings} == {"OUTLIER"}
    assert found.verdict.level == "good"


def test_touches_in_millimetres_are_refused_with_the_question() -> None:
    marks = layout(9, np.random.default_rng(4))
    with refused("UNIT_UNKNOWN", "are they millimetres?"):
        fit_plane(marks, 1000 * SCENE.touched(marks, 1), tool_z=DOWN)
    touches = SCENE.touched(marks, 1)
    touches[3] *= 1000
    with refused("UNIT_UNKNOWN", "are they millimetres?"):
        fit_plane(marks, touches, tool_z=DOWN)


@pytest.mark.parametrize("off", [0.003, 0.02])
@pytest.mark.parametrize("moved", [2, 4])
def test_touches_before_and_after_a_move_are_not_called_good_by_a_robust_fit(
    off: float, moved: int
) -> None:
    random = np.random.default_rng([9, moved])
    marks = layout(9, random)
    touches = SCENE.robot(marks) + SIGMA * random.normal(size=(9, 3))
    touches[-moved:] += off * SCENE.turn[:, 0]
    found = fit_plane(marks, touches, touch_sigma=SIGMA, tool_z=DOWN, robust=True)
    assert found.outliers == tuple(range(9 - moved, 9))
    assert found.verdict.level == "poor"
    assert "moved between the touches" in found.warnings[0].text


def test_robust_fit_of_a_touch_that_was_sent_four_times_is_refused() -> None:
    random = np.random.default_rng([8, 7])
    marks = layout(7, random)
    touches = SCENE.robot(marks) + 2e-4 * random.normal(size=(7, 3))
    touches[4:] = touches[3]
    with refused("SHORT_LEVER"):
        fit_plane(marks, touches, tool_z=DOWN, robust=True)
