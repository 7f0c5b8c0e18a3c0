"""Lines and circles through edges: outliers, rough parts, and undetermined fits."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.inspection.inside import (
    PIXELS,
    CurveEdges,
    Edges,
    NotMeasuredError,
    NoValueReason,
    fit_circle,
    fit_circle_in_plane,
    fit_line,
    fit_line_in_plane,
)
from tests.inspection.rendering import Array

AHEAD = np.array([1.0, 0.0])


def on_line(offsets: Array, sigma: float = 0.01) -> Edges:
    count = len(offsets)
    points = np.column_stack([np.linspace(0, 100, count), 50 + offsets])
    return Edges(points, np.tile([0.0, 1.0], (count, 1)), np.full(count, sigma))


def on_circle(
    offsets: Array, arc: float = 360.0, radius: float = 40.0, sigma: float = 0.01
) -> Edges:
    angles = np.radians((np.arange(len(offsets)) + 0.5) / len(offsets) * arc)
    rim = np.column_stack([np.cos(angles), np.sin(angles)])
    return Edges([60.0, 70.0] + (radius + offsets)[:, None] * rim, rim, np.full(len(angles), sigma))


@pytest.mark.parametrize("wrong", [1, 4, 9])
def test_outliers_of_a_line_are_reported_and_do_not_move_it(wrong: int) -> None:
    for seed in range(10):
        random = np.random.default_rng(seed)
        offsets = random.normal(0, 0.01, 20)
        out = random.choice(20, wrong, replace=False)
        offsets[out] += random.choice([-1.0, 1.0], wrong) * random.uniform(0.2, 6.0, wrong)
        fit = fit_line(on_line(offsets), AHEAD)
        assert not fit.inliers[out].any()
        assert fit.inliers.sum() >= 20 - wrong - 2
        assert abs(fit.curve.middle[1] - 50) < 0.03


@pytest.mark.parametrize("wrong", [1, 4, 10])
def test_outliers_of_a_circle_are_reported_and_do_not_move_it(wrong: int) -> None:
    for seed in range(10):
        random = np.random.default_rng(seed)
        offsets = random.normal(0, 0.01, 24)
        out = random.choice(24, wrong, replace=False)
        offsets[out] += random.choice([-1.0, 1.0], wrong) * random.uniform(0.2, 6.0, wrong)
        fit = fit_circle(on_circle(offsets))
        assert not fit.inliers[out].any()
        assert abs(fit.curve.radius - 40) < 0.03


def test_edges_on_two_lines_agree_on_none() -> None:
    offsets = np.where(np.arange(24) % 3 == 0, 0.0, np.where(np.arange(24) % 3 == 1, 4.0, 8.0))
    offsets = offsets + np.random.default_rng(1).normal(0, 0.01, 24)
    with pytest.raises(NotMeasuredError) as caught:
        fit_line_in_plane(
            CurveEdges(on_line(offsets), (), 0.8, 0.0), np.array([[0, 50], [9, 50]]), PIXELS
        )
    assert caught.value.reason is NoValueReason.NO_AGREEMENT


def test_part_that_is_rougher_than_the_noise_keeps_its_edges_and_has_a_larger_sigma() -> None:
    offsets = np.random.default_rng(1).normal(0, 0.1, 40)
    fit = fit_line(on_line(offsets, sigma=0.01), AHEAD)
    assert fit.inliers.sum() >= 36
    assert fit.excess == pytest.approx(10, rel=0.3)
    assert math.sqrt(fit.curve.covariance[0, 0]) == pytest.approx(0.1 / math.sqrt(40), rel=0.3)


@pytest.mark.parametrize(
    ("count", "within"),  # chance does 0.07 and 0.035
    [(100, 0.24), pytest.param(400, 0.12, marks=pytest.mark.long)],
)
def test_sigmas_of_a_line_and_a_circle_are_true(count: int, within: float) -> None:
    line, circle = [], []
    for seed in range(count):
        random = np.random.default_rng(seed)
        fit = fit_line(on_line(random.normal(0, 0.01, 12)), AHEAD)
        line.append(
            (fit.curve.middle[1] - 50) / math.sqrt(fit.curve.offset_variance(np.array([50.0, 50])))
        )
        round_ = fit_circle(on_circle(random.normal(0, 0.01, 16), arc=100.0)).curve
        circle.append((round_.radius - 40) / math.sqrt(round_.covariance[2, 2]))
    assert np.std(line) == pytest.approx(1.0, abs=within)
    assert np.std(circle) == pytest.approx(1.0, abs=within)


def test_line_runs_the_way_that_was_asked_for() -> None:
    edges = on_line(np.zeros(8))
    assert fit_line(edges, AHEAD).curve.direction @ AHEAD > 0.99
    assert fit_line(edges, -AHEAD).curve.direction @ AHEAD < -0.99


def test_rotated_line_has_the_same_offset_variance() -> None:
    edges = on_line(np.random.default_rng(1).normal(0, 0.01, 12))
    one, other = fit_line(edges, AHEAD).curve, fit_line(edges, -AHEAD).curve
    for place in (np.array([-50.0, 40.0]), np.array([180.0, 60.0])):
        assert one.offset_variance(place) == pytest.approx(other.offset_variance(place))
    assert one.offset_variance(np.array([180.0, 50.0])) > 4 * one.offset_variance(one.middle)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_too_few_edges_are_refused(count: int) -> None:
    with pytest.raises(NotMeasuredError) as caught:
        fit_circle(on_circle(np.zeros(count)))
    assert caught.value.reason is NoValueReason.FEW_EDGES


def test_edges_at_one_place_are_refused() -> None:
    edges = Edges(np.full((6, 2), 5.0), np.tile([0.0, 1.0], (6, 1)), np.full(6, 0.1))
    for fit in (lambda: fit_line(edges, AHEAD), lambda: fit_circle(edges)):
        with pytest.raises(NotMeasuredError):
            fit()


def test_straight_edges_are_no_circle() -> None:
    edges = on_line(np.random.default_rng(1).normal(0, 0.01, 12))
    with pytest.raises(NotMeasuredError) as caught:
        fit_circle_in_plane(CurveEdges(edges, (), 0.8, 0.0), PIXELS)
    assert caught.value.reason is NoValueReason.UNCERTAIN


def test_arc_that_is_too_short_for_its_radius_is_refused() -> None:
    edges = on_circle(np.random.default_rng(1).normal(0, 0.05, 12), arc=12.0, sigma=0.05)
    with pytest.raises(NotMeasuredError) as caught:
        fit_circle_in_plane(CurveEdges(edges, (), 0.8, 0.0), PIXELS)
    assert caught.value.reason is NoValueReason.UNCERTAIN


def test_common_error_of_all_edges_is_not_averaged() -> None:
    edges = on_circle(np.random.default_rng(1).normal(0, 0.01, 24))
    found = fit_circle_in_plane(CurveEdges(edges, (), 0.8, 0.2), PIXELS).curve
    assert math.sqrt(found.covariance[2, 2]) == pytest.approx(0.2, rel=0.01)
