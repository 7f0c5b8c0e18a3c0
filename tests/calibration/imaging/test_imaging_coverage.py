from __future__ import annotations

import math

import numpy as np
import pytest

from smartcam.calibration.lens.coverage import Coverage, coverage

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def test_coverage_of_one_place_is_nothing() -> None:
    assert coverage([100 * SQUARE, 100 * SQUARE], (640, 480)) == (0.0, 0.0, 0.0, 0.0)
    assert coverage([], (640, 480)) == (0.0, 0.0, 0.0, 0.0)


def test_coverage_from_corner_to_corner_fills_the_bars_of_place() -> None:
    there = 100 * SQUARE + [540, 380]
    bars = coverage([100 * SQUARE, there], (640, 480))
    assert (bars.x, bars.y, bars.size, bars.skew) == (1.0, 1.0, 0.0, 0.0)
    assert bars.lacking == ("size", "skew")


def test_coverage_of_a_part_of_the_way_is_that_part_of_what_is_enough() -> None:
    middle = 100 * SQUARE + [0.35 * 540, 0]
    assert coverage([100 * SQUARE, middle], (640, 480)).x == pytest.approx(0.5)


def test_coverage_from_far_to_near_fills_the_bar_of_size() -> None:
    near = 480 * SQUARE
    expected = (480 - 48) / math.sqrt(640 * 480) / 0.4
    assert coverage([48 * SQUARE, 240 * SQUARE], (640, 480)).size == pytest.approx(
        (240 - 48) / math.sqrt(640 * 480) / 0.4
    )
    assert expected > 1.0
    assert coverage([48 * SQUARE, near], (640, 480)).size == 1.0


def test_coverage_of_a_tilted_view_fills_the_bar_of_skew() -> None:
    sheared = 100 * SQUARE @ np.array([[1.0, 0.0], [math.tan(0.125), 1.0]])
    assert coverage([100 * SQUARE, sheared], (640, 480)).skew == pytest.approx(0.5)


def test_coverage_lacking_of_full_bars_is_empty() -> None:
    assert Coverage(1.0, 1.0, 1.0, 1.0).lacking == ()
