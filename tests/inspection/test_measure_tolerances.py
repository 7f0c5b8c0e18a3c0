"""Tolerances: their notation, verdicts on values, and learning from pictures."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from smartcam.exceptions import ConfigurationError
from smartcam.inspection import Finding
from smartcam.inspection._inside import learn_tolerances
from smartcam.inspection._learning import TOLERANCE_COVERAGE, Lesson
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
    assert (found.min_value, found.max_value) == pytest.approx((least, most))
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


def test_directions_are_compared_modulo_a_turn() -> None:
    back = Tolerance.parse("180 +- 1 deg")
    for value in (179.99, -179.99, 180.0, -180.0):
        assert back.complaint(value, 0.01, 2.0) == ""
    assert back.complaint(-178.5, 0.01, 2.0) == "181.500 deg is above 181.000 deg"
    assert "too near" in back.complaint(-179.01, 0.01, 2.0)
    assert back.complaint(0.0, 0.01, 2.0)
    assert back.complaint(math.nan, 0.01, 2.0)
    assert Tolerance.parse("-5 to 5 deg").complaint(-179.99, 0.01, 2.0)
    assert Tolerance.parse("180 +- 1 mm").complaint(-180.0, 0.01, 2.0)


# ---------------------------------------------------------------------- learned ones

SIGMA = 0.01


def lesson(
    values: list[float], before: str | None = None, *, unit: str = "px", **more: Any
) -> Lesson:
    """Return the lesson of good pictures with these measured values; NaN: no edge was found."""
    good: dict[str, Any] = {}
    for number, value in enumerate(values, 1):
        there = math.isfinite(value)
        details = SimpleNamespace(value=value, sigma=SIGMA if there else math.nan, unit=unit)
        found = Finding(ok=there, reason="" if there else "no edge: none", details=details)
        good[f"part{number}.png"] = SimpleNamespace(findings={"measure": found})
    settings = {"width": {}, **more, **({} if before is None else {"tolerance": before})}
    return learn_tolerances({"measure": settings}, good)


def tolerance(found: Lesson) -> Tolerance:
    return Tolerance.parse(found.tools["measure"]["tolerance"])


def values_of(number: int, seed: int, mean: float = 92.4, spread: float = 0.05) -> list[float]:
    given: list[float] = np.random.default_rng(seed).normal(mean, spread, number).tolist()
    return given


def test_learned_tolerance_contains_good_values_with_guard_and_is_explained() -> None:
    values = values_of(20, 1)
    found = lesson(values)
    limits = tolerance(found)
    assert all(limits.complaint(one, SIGMA, 2.0) == "" for one in values)
    assert limits.complaint(92.9, SIGMA, 2.0)
    (remark,) = found.remarks
    assert remark.startswith(f"measure: tolerance {limits.text}, from 20 pictures: mean 92.")
    assert "standard deviation 0.0" in remark
    assert "of which the measurement causes 0.01 px" in remark
    assert "Not learned from" not in remark


@pytest.mark.parametrize("number", [5, 20, 100])
def test_other_good_parts_are_inside_in_as_many_lessons_as_promised(number: int) -> None:
    lessons, shares = 200, []
    for seed in range(lessons):
        found = lesson(values_of(number, seed, 0.0, 1.0), guard=0)
        if "tolerance" not in found.tools["measure"]:
            continue  # one of five was left out
        limits = tolerance(found)
        inside = [math.erf(one / math.sqrt(2)) / 2 for one in (limits.min_value, limits.max_value)]
        shares.append(inside[1] - inside[0] >= TOLERANCE_COVERAGE)
    assert len(shares) >= 0.95 * lessons
    assert sum(shares) >= 0.91 * len(shares)  # 95 % are promised, give or take 1.5 %


def test_a_value_far_from_the_others_is_left_out_and_named() -> None:
    values = [*values_of(12, 3), 99.0, math.nan]
    found = lesson(values)
    limits = tolerance(found)
    assert limits.complaint(99.0, SIGMA, 2.0)
    assert limits.max_value < 93
    assert found.remarks[0].endswith(
        "Not learned from: part14.png (no edge), part13.png (99 px is far from the others)."
    )


@pytest.mark.parametrize("values", [[92.4] * 4, [math.nan] * 9, [92.4, 92.5, 92.4, 92.6, 120.0]])
def test_too_few_values_leave_the_tolerance_as_it_is(values: list[float]) -> None:
    found = lesson(values, "90 to 95 px")
    assert found.tools["measure"]["tolerance"] == "90 to 95 px"
    assert "expected at least 5 good pictures with a value, got" in found.remarks[0]


@pytest.mark.parametrize(
    ("before", "form", "unit"),
    [
        ("at most 99 um", "at most ", " um"),
        ("at least 0.1 cm", "at least ", " cm"),
        ("11 to 12 inch", "", " inch"),
        ("9 +- 1 px", "", " mm"),
        (None, "", " mm"),
    ],
)
def test_form_and_unit_of_a_tolerance_are_kept(before: str | None, form: str, unit: str) -> None:
    values = values_of(10, 4, 12.0, 0.02)
    found = lesson(values, before, unit="mm")
    limits = tolerance(found)
    assert limits.text.startswith(form)
    assert limits.text.endswith(unit)
    assert (form == "") == math.isfinite(limits.max_value - limits.min_value)
    assert all(limits.complaint(one, SIGMA, 2.0) == "" for one in values)


def test_directions_on_both_sides_of_a_half_turn_are_near_each_other() -> None:
    values = [179.9, -179.9, 179.95, -179.95, 180.0, -179.98]
    limits = tolerance(lesson(values, unit="deg"))
    assert limits.max_value - limits.min_value < 3
    assert all(limits.complaint(one, SIGMA, 2.0) == "" for one in values)


def test_equal_pictures_get_a_tolerance_for_the_measuring_error() -> None:
    limits = tolerance(lesson([92.4] * 6))
    assert limits.complaint(92.4, SIGMA, 2.0) == ""
    assert 0.02 < limits.max_value - 92.4 < 0.1


def test_a_tool_that_was_not_asked_teaches_nothing() -> None:
    good: Any = {
        "a.png": SimpleNamespace(findings={"present": Finding(ok=False, reason="outside")}),
        "b.png": SimpleNamespace(findings={"present": Finding(ok=True, values={"count": 2})}),
    }
    found = learn_tolerances({"present": {}}, good)
    assert found.tools == {"present": {"count": [2, 2]}}
    assert found.remarks == [
        "present: 2 spots in 1 picture; the setting `area` stays as it is, since the setting "
        "`most` leaves some of them out of the result. Not learned from: a.png (outside)."
    ]
    del good["b.png"]
    assert learn_tolerances({"present": {"count": 3}}, good).tools == {"present": {"count": 3}}
