"""A step's schema and its checks agree; lists in the thesis' form."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam.calibration.wizards import Flag, Number, Option, Step, Text, as_lists, from_lists
from smartcam.exceptions import CalibrationError

jsonschema = pytest.importorskip("jsonschema", reason="needs jsonschema, of the extra dev")
pytestmark = pytest.mark.long

STEP = Step(
    id="all",
    title="All kinds",
    inputs=(
        Number(name="x", label="X", unit="mm", minimum=-5, maximum=5),
        Number(name="n", label="N", integer=True, default=2, minimum=0, maximum=9, optional=True),
        Text(name="t", label="T", pattern="[a-z]*", max_length=3, default=""),
        Option(name="o", label="O", options={"a": "first", "b": "second"}, default="b"),
        Flag(name="f", label="F"),
    ),
)

VALUES = st.one_of(
    st.none(), st.booleans(), st.integers(-10, 10), st.floats(-6, 6), st.sampled_from("ab"),
    st.text("abz\n", max_size=5), st.lists(st.integers(), max_size=1),
)  # fmt: skip


@given(st.dictionaries(st.sampled_from(["x", "n", "t", "o", "f", "z"]), VALUES))
@example({"x": 1.5, "n": None, "t": "abc"})
@example({"x": 1, "n": 3.0, "t": "a\n"})
@example({"x": True})
def test_checked_accepts_the_same_answers_as_the_schema(answers: dict[str, Any]) -> None:
    valid = jsonschema.Draft202012Validator(STEP.schema()).is_valid(answers)
    try:
        STEP.checked(answers)
    except CalibrationError as exc:
        assert exc.code == "WRONG_ANSWERS"  # noqa: PT017  either outcome is right
        assert not valid
    else:
        assert valid


def test_schema_is_one_of_2020_12() -> None:
    jsonschema.Draft202012Validator.check_schema(STEP.schema())
    assert STEP.schema()["properties"]["x"] == {
        "type": "number", "title": "X", "minimum": -5, "maximum": 5, "x-unit": "mm",
    }  # fmt: skip
    assert STEP.schema()["required"] == ["x"]
    jsonschema.validate({**STEP.defaults(), "x": 0}, STEP.schema())


def test_checked_fills_in_defaults_and_converts_numbers() -> None:
    assert STEP.checked({"x": 1, "n": 3.0}) == {"x": 1.0, "n": 3, "t": "", "o": "b", "f": False}
    assert [type(STEP.checked({"x": 1, "n": 3.0})[one]) for one in "xn"] == [float, int]


@pytest.mark.parametrize(
    ("answers", "errors"),
    [
        ({}, {"x": "no answer"}),
        ({"x": float("nan")}, {"x": "nan: expected a number from -5 to 5"}),
        ({"x": 10**400}, {"x": f"1{'0' * 39}...: expected a number from -5 to 5"}),
        ({"x": "1"}, {"x": "'1': expected a number"}),
        ({"x": 0, "n": 1.5}, {"n": "1.5: expected a whole number"}),
        ({"x": 0, "t": "abcd"}, {"t": "4 characters: expected text in one line, 3 at most"}),
        ({"x": 0, "f": 1}, {"f": "1: expected true or false"}),
        ([1], {"base": "[1]: expected answers by the names of inputs"}),
    ],
)
def test_checked_error_names_the_expected_answer(answers: Any, errors: dict[str, str]) -> None:
    with pytest.raises(CalibrationError) as caught:
        STEP.checked(answers)
    assert caught.value.got == errors


def test_lists_are_those_of_the_thesis() -> None:
    assert as_lists(STEP) == {
        "descriptions_for_needed_values": ["X [mm]", "N"],
        "default_needed_values": [0.0, 2.0],
        "descriptions_for_needed_strings": ["T"],
        "default_needed_strings": [""],
        "descriptions_for_needed_options": ["O", "F"],
        "default_needed_options": ["b a b", "no no yes"],
    }


def test_answers_from_lists_are_those_of_the_step() -> None:
    answers = from_lists(STEP, [1.5, 3], ["abc"], ["a", "yes"])
    assert STEP.checked(answers) == {"x": 1.5, "n": 3, "t": "abc", "o": "a", "f": True}


@pytest.mark.parametrize(
    ("lists", "text"),
    [(([1.5], ["a"], ["a", "no"]), "1 values: expected 2"), (([1, 2], [], []), "0 strings: expe")],
)
def test_lists_of_another_length_are_refused(lists: Any, text: str) -> None:
    with pytest.raises(CalibrationError, match=text):
        from_lists(STEP, *lists)
