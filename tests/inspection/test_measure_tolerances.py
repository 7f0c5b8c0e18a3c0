"""Tolerances: how they are written, and when a value is good."""

from __future__ import annotations

import math

import pytest

from smartcam.exceptions import ConfigurationError
from smartcam.inspection._measure.tolerances import Tolerance


@pytest.mark.parametrize(
    ("text", "least", "most", "unit"),
    [
        ("12.00 +- 0.05 mm", 11.95, 12.05, "mm"),
        ("12 ± 0.05mm", 11.95, 12.05, "mm"),
        ("12+/-0.05 mm", 11.95, 12.05, "mm"),
        ("12 +0.1 -0.05 mm", 11.95, 12.1, "mm"),
        ("12 -0.05 +0.1 mm", 11.95, 12.1, "mm"),
        ("11.9 to 12.1 mm", 11.9, 12.1, "mm"),
        ("-2 to 2 deg", -2, 2, "deg"),
        ("at most 12.1 mm", -math.inf, 12.1, "mm"),
        ("at least 300 um", 0.3, math.inf, "mm"),
        ("<= 1.5 px", -math.inf, 1.5, "px"),
        (">= .5 inch", 12.7, math.inf, "mm"),
        ("1.2 +- 0.1 cm", 11.0, 13.0, "mm"),
        ("-3 +- 1 deg", -4, -2, "deg"),
    ],
)
def test_tolerance_is_read(text: str, least: float, most: float, unit: str) -> None:
    found = Tolerance.parse(text)
    assert (found.least, found.most) == pytest.approx((least, most))
    assert found.unit == unit


@pytest.mark.parametrize(
    "text",
    [
        *("", "mm", "12 mm", "12 +- mm", "12 +- 0.05", "12 +- 0.05 furlongs", "12.1 to 11.9 mm"),
        *("12 +- -1 mm", "nan +- 1 mm", "1e3 +- 1 mm", "12 +0.1 +0.2 mm", "1" * 101 + " mm"),
    ],
)
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="tolerance"):
        Tolerance.parse(text)


def test_value_near_a_limit_is_not_good_as_long_as_it_may_be_outside() -> None:
    tolerance = Tolerance.parse("12.00 +- 0.05 mm")
    assert tolerance.complaint(12.0, 0.004, 2.0) == ""
    assert tolerance.complaint(12.041, 0.004, 2.0) == ""
    assert tolerance.complaint(12.045, 0.004, 0.0) == ""
    assert "too near to the limit: sigma is 0.004 mm" in tolerance.complaint(12.045, 0.004, 2.0)
    assert tolerance.complaint(12.0512, 0.004, 2.0) == "12.0512 mm is above 12.0500 mm"
    assert tolerance.complaint(11.9, 0.004, 2.0) == "11.9000 mm is below 11.9500 mm"


def test_value_whose_sigma_is_larger_than_the_tolerance_is_never_good() -> None:
    tolerance = Tolerance.parse("12.00 +- 0.05 mm")
    assert tolerance.complaint(12.0, 0.03, 2.0)


def test_no_value_is_never_good() -> None:
    assert Tolerance.parse("12 +- 1 mm").complaint(math.nan, 0.1, 0.0)
    assert Tolerance.parse("12 +- 1 mm").complaint(12.0, math.nan, 2.0)


def test_directions_are_compared_whatever_whole_turns_are_between_them() -> None:
    back = Tolerance.parse("180 +- 1 deg")
    for value in (179.99, -179.99, 180.0, -180.0):
        assert back.complaint(value, 0.01, 2.0) == ""
    assert back.complaint(-178.5, 0.01, 2.0) == "181.500 deg is above 181.000 deg"
    assert "too near" in back.complaint(-179.01, 0.01, 2.0)
    assert back.complaint(0.0, 0.01, 2.0)
    assert back.complaint(math.nan, 0.01, 2.0)
    assert Tolerance.parse("-5 to 5 deg").complaint(-179.99, 0.01, 2.0)
    assert Tolerance.parse("180 +- 1 mm").complaint(-180.0, 0.01, 2.0)
