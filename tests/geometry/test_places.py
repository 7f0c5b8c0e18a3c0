"""Patterns of places: each place's pose, and touches that are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given

from smartcam.exceptions import CalibrationError, ConfigurationError
from smartcam.geometry import PlacePattern, Transform
from tests.geometry.rigid import close, refused, transforms

FLAT = Transform("robot", "place", np.eye(3), np.array([0.4, -0.1, 0.02]))


@given(transforms("robot", "place"))
def test_pattern_of_three_touches_has_the_touched_places(frame: Transform) -> None:
    corners = frame.apply([[0.0, 0, 0], [0.12, 0, 0], [0, 0.05, 0]])
    pattern = PlacePattern.from_touches(*corners, rows=2, columns=4, layers=3, height=0.01)
    assert len(pattern) == len(list(pattern)) == 24
    for number, place in enumerate(pattern):
        row, column, layer = pattern.row_column_layer(number)
        assert number == (layer * 2 + row) * 4 + column
        true = frame.apply([0.04 * column, 0.05 * row, 0.01 * layer])
        np.testing.assert_allclose(place.translation, true, atol=1e-9)
        np.testing.assert_allclose(place.rotation, frame.rotation, atol=1e-9)
    assert close(pattern[-1], pattern[23], 0)
    assert [one.label for one in pattern[3:5]] == ["T_robot_place"] * 2


def test_touches_that_are_not_quite_square_give_places_in_square_rows() -> None:
    pattern = PlacePattern.from_touches(
        [0, 0, 0], [0.1, 0, 0], [0.001, 0.05, 0], rows=2, columns=2, robot_frame="cell"
    )
    np.testing.assert_allclose(pattern[2].translation, [0, np.hypot(0.001, 0.05), 0])
    assert pattern.frame.target == "cell"


def test_pattern_of_one_place_needs_no_distance() -> None:
    (place,) = PlacePattern(frame=FLAT)
    assert close(place, FLAT, 0)
    column = PlacePattern(frame=FLAT, layers=2, pitch=(0, 0, 0.03))
    np.testing.assert_allclose(column[1].translation, [0.4, -0.1, 0.05])
    with pytest.raises(IndexError):
        column[2]


@pytest.mark.parametrize(
    ("column_end", "code"),
    [
        ([0.2, 0.0, 0.0], "NOT_RIGID"),
        ([0.0, 0.0, 0.0], "NOT_RIGID"),
        ([0.0, np.nan, 0.0], "NOT_FINITE"),
        ([0.0, 0.1], "SHAPE"),
    ],
)
def test_touches_that_make_no_pattern_are_refused(column_end: list[float], code: str) -> None:
    with refused(code):
        PlacePattern.from_touches([0, 0, 0], [0.1, 0, 0], column_end, rows=2, columns=2)


def test_numbers_that_cannot_be_are_refused() -> None:
    wrongs: list[dict[str, Any]] = [
        {"rows": 0},
        {"columns": 1.5},
        {"layers": 1001},
        {"rows": 2},
        {"pitch": (1, 2)},
    ]
    for wrong in wrongs:
        with pytest.raises(ConfigurationError, match="PlacePattern"):
            PlacePattern(frame=FLAT, **wrong)
    with pytest.raises(ConfigurationError, match=r"columns: expected .* 2"):
        PlacePattern.from_touches([0, 0, 0], [1, 0, 0], [0, 1, 0], rows=2, columns=1)
    with pytest.raises(ConfigurationError, match="number"):
        PlacePattern(frame=FLAT).row_column_layer(1)
    with pytest.raises(CalibrationError, match="expected a Transform"):
        PlacePattern(frame=np.eye(4))  # type: ignore[arg-type]
