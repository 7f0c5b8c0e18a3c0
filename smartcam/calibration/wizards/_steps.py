"""Define the steps of a sequence: the texts to show, and the answers to ask for.

A step is data with a JSON Schema of its answers, and it checks answers by the same rules. So
front-ends need no code for particular wizards.

Source: the thesis with which smartcam began, 2.2.1 and Figure 2.9 (published), for a step's parts
and for the lists of numbers, texts and options of :func:`as_lists` (six) and :func:`from_lists`
(three).
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from smartcam.calibration._verdict import CalibrationVerdict
    from smartcam.exceptions import CalibrationError

DIALECT = "https://json-schema.org/draft/2020-12/schema"
"""The JSON Schema that steps use."""

Answers = dict[str, Any]
"""Answers by the names of their inputs."""

_MAX_SHOWN_LENGTH = 40
"""Largest number of characters of a wrong answer that a message shows."""

_YES_NO = {"no": False, "yes": True}
"""Values of a flag, by the words for them in the lists of :func:`as_lists`."""


def _short_repr(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _MAX_SHOWN_LENGTH else f"{text[:_MAX_SHOWN_LENGTH]}..."


def _wrong_value_error(value: object, expected: str) -> ValueError:
    return ValueError(f"{_short_repr(value)}: expected {expected}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Input(ABC):
    """One answer that a step asks for.

    Attributes:
        name: name of the answer.
        label: name for people.
        default: value that is filled in at first; None: no value.
    """

    name: str
    label: str
    default: Any = None

    def schema(self) -> dict[str, Any]:
        """Return the input's JSON Schema.

        A unit is in ``x-unit``; each option is a ``const`` and a ``title``.
        """
        return {"title": self.label, **self._schema()}

    def checked(self, value: object) -> Any:
        """Return an answer as its Python value; raise ValueError, which names the expected form."""
        return self._check_value(value)

    @abstractmethod
    def _schema(self) -> dict[str, Any]: ...

    @abstractmethod
    def _check_value(self, value: object) -> Any: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Number(Input):
    """Input for a number.

    Attributes:
        unit: unit of the answer, shown after the number.
        minimum: smallest valid number.
        maximum: largest valid number.
        integer: whether the number must be whole.
        optional: whether the answer may be left out (null).
    """

    default: float | None = None
    unit: str = ""
    minimum: float = -1e9
    maximum: float = 1e9
    integer: bool = False
    optional: bool = False

    def _schema(self) -> dict[str, Any]:
        kind = "integer" if self.integer else "number"
        return {
            "type": [kind, "null"] if self.optional else kind,
            "minimum": self.minimum,
            "maximum": self.maximum,
            **({"x-unit": self.unit} if self.unit else {}),
        }

    def _check_value(self, value: object) -> Any:
        if value is None and self.optional:
            return None
        expected = "a whole number" if self.integer else "a number"
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise _wrong_value_error(value, expected)
        if not self.minimum <= value <= self.maximum:  # NaN is outside of every range
            raise _wrong_value_error(value, f"{expected} from {self.minimum:g} to {self.maximum:g}")
        if not self.integer:
            return float(value)
        if value != math.floor(value):
            raise _wrong_value_error(value, expected)
        return int(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Text(Input):
    """Input for a text of one line.

    Attributes:
        pattern: regular expression that the whole text must match, in the syntax that Python and
            ECMAScript share.
        expected: meaning of the pattern, for people.
        max_length: largest number of characters.
    """

    default: str | None = None
    pattern: str = r"[^\x00-\x1f\x7f]*"
    expected: str = "text in one line"
    max_length: int = 200

    def _schema(self) -> dict[str, Any]:
        # Python's $ would allow a line feed at the end
        pattern = rf"^(?:{self.pattern})(?![\s\S])"
        return {"type": "string", "pattern": pattern, "maxLength": self.max_length}

    def _check_value(self, value: object) -> Any:
        if not isinstance(value, str) or not re.fullmatch(self.pattern, value):
            raise _wrong_value_error(value, self.expected)
        if len(value) > self.max_length:
            raise ValueError(
                f"{len(value)} characters: expected {self.expected}, {self.max_length} at most"
            )
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Option(Input):
    """Input for one of several options; without a default, the first option is preselected.

    Attributes:
        options: texts for people, by the answer that each stands for.
    """

    default: str | None = None
    options: Mapping[str, str]

    def _schema(self) -> dict[str, Any]:
        rows = [{"const": value, "title": text} for value, text in self.options.items()]
        return {"type": "string", "oneOf": rows}

    def _check_value(self, value: object) -> Any:
        if not isinstance(value, str) or value not in self.options:
            raise _wrong_value_error(value, f"one of {', '.join(self.options)}")
        return value


@dataclass(frozen=True, slots=True, kw_only=True)
class Flag(Input):
    """Input for yes or no."""

    default: bool = False

    def _schema(self) -> dict[str, Any]:
        return {"type": "boolean"}

    def _check_value(self, value: object) -> Any:
        if not isinstance(value, bool):
            raise _wrong_value_error(value, "true or false")
        return value


def number_input(name: str, label: str, count: int, default: int) -> Number:
    """Return an input for a number from 1 to ``count``."""
    return Number(name=name, label=label, integer=True, minimum=1, maximum=count, default=default)


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A page of a wizard: texts to show, and inputs to ask for.

    Attributes:
        id: name of the step; a step may come again.
        title: heading of one line.
        description: the task of the user.
        button: text on the button that goes on.
        inputs: inputs to fill in; without any, only the button has to be pressed.
        notes: results so far, a line each; a warning begins with its code and a colon.
        verdict: verdict on the result; None without a result.
        preview: JSON data for a picture; None for no picture. ``choices`` in it are places that may
            be clicked: ``at`` (in the picture), ``label``, and the ``answers`` that a click gives.
        waiting: text that names the awaited event while the step's action runs.
        timeout: seconds that the action of the button may take.
    """

    id: str
    title: str
    description: str = ""
    button: str = "Next"
    inputs: tuple[Input, ...] = ()
    notes: tuple[str, ...] = ()
    verdict: CalibrationVerdict | None = None
    preview: Mapping[str, Any] | None = field(default=None, compare=False)
    waiting: str = ""
    timeout: float = 30.0

    def schema(self) -> dict[str, Any]:
        """Return the JSON Schema (2020-12) of the step's answers."""
        return {
            "$schema": DIALECT,
            "type": "object",
            "properties": {input_field.name: input_field.schema() for input_field in self.inputs},
            "required": [
                input_field.name
                for input_field in self.inputs
                if input_field.name not in self.defaults()
            ],
            "additionalProperties": False,
        }

    def defaults(self) -> Answers:
        """Return the default answers by the names of those inputs that have a default."""
        values: Answers = {}
        for input_field in self.inputs:
            value = input_field.default
            if value is None and isinstance(input_field, Option):
                value = next(iter(input_field.options))
            if value is not None or (isinstance(input_field, Number) and input_field.optional):
                values[input_field.name] = value
        return values

    def with_defaults(self, parameters: Mapping[str, Any]) -> Step:
        """Return the step with parameters as the defaults of the inputs of the same names.

        Raises:
            CalibrationError: WRONG_ANSWERS: a parameter is no valid answer.
        """
        return replace(
            self,
            inputs=tuple(_with_default(input_field, parameters) for input_field in self.inputs),
        )

    def checked(self, answers: object) -> Answers:
        """Return checked answers, with defaults for missing answers.

        Raises:
            CalibrationError: ``WRONG_ANSWERS``; ``got`` has a text for each wrong answer, and under
                ``base`` a text for answers that belong to no input.
        """
        if not isinstance(answers, Mapping):
            raise _wrong_answers_error(
                {"base": f"{_short_repr(answers)}: expected answers by the names of inputs"}
            )
        given = {**self.defaults(), **cast("Mapping[str, Any]", answers)}
        errors: dict[str, str] = {}
        values: Answers = {}
        for input_field in self.inputs:
            try:
                values[input_field.name] = input_field.checked(given.pop(input_field.name))
            except KeyError:
                errors[input_field.name] = "no answer"
            except ValueError as exc:
                errors[input_field.name] = str(exc)
        if given:
            names = ", ".join(input_field.name for input_field in self.inputs) or "nothing"
            errors["base"] = (
                f"{_short_repr(next(iter(given)))}: no such input; this step asks for {names}"
            )
        if errors:
            raise _wrong_answers_error(errors)
        return values


def _with_default(input_field: Input, parameters: Mapping[str, Any]) -> Input:
    value = parameters.get(input_field.name)
    if value is None:
        return input_field
    try:
        return replace(input_field, default=input_field.checked(value))
    except ValueError as exc:
        raise Code.WRONG_ANSWERS.error(
            f"parameter {input_field.name}: {exc}", got={input_field.name: str(exc)}
        ) from exc


def _wrong_answers_error(errors: dict[str, str]) -> CalibrationError:
    text = "; ".join(text if name == "base" else f"{name}: {text}" for name, text in errors.items())
    return Code.WRONG_ANSWERS.error(text, got=errors)


# ---------------------------------------------------------------------- the thesis' lists


def as_lists(step: Step) -> dict[str, list[Any]]:
    """Return a step's inputs as the thesis' six lists.

    Returns:
        ``descriptions_for_needed_values``, ``default_needed_values`` and the same for ``strings``
        and ``options``. An option is one text, ``"DEFAULT OPT1 OPT2 ..."``; a flag is an option of
        ``no`` and ``yes``; a number without a default has 0.0, which stands for no answer if the
        number is optional and cannot be 0.

    Source: thesis Figure 2.9 (published).
    """
    lists: dict[str, list[Any]] = {}
    for kind in ("values", "strings", "options"):
        lists[f"descriptions_for_needed_{kind}"] = []
        lists[f"default_needed_{kind}"] = []
    for input_field in step.inputs:
        kind, default = _list_entry(input_field, step.defaults().get(input_field.name))
        unit = (
            f" [{input_field.unit}]" if isinstance(input_field, Number) and input_field.unit else ""
        )
        lists[f"descriptions_for_needed_{kind}"].append(input_field.label + unit)
        lists[f"default_needed_{kind}"].append(default)
    return lists


def _list_entry(input_field: Input, default: Any) -> tuple[str, Any]:
    match input_field:
        case Number():
            return "values", 0.0 if default is None else float(default)
        case Text():
            return "strings", default or ""
        case Option():
            return "options", " ".join([str(default), *input_field.options])
        case _:
            return "options", " ".join(["yes" if default else "no", *_YES_NO])


def from_lists(
    step: Step,
    values: Sequence[float] = (),
    texts: Sequence[str] = (),
    options: Sequence[str] = (),
) -> Answers:
    """Return the answers in the thesis' three lists, for the step to check.

    Raises:
        CalibrationError: ``WRONG_ANSWERS``, a list is too short or too long.
    """
    given: dict[str, list[Any]] = {
        "values": list(values),
        "strings": list(texts),
        "options": list(options),
    }
    expected_lists = as_lists(step)
    for kind, row in given.items():
        count = len(expected_lists[f"default_needed_{kind}"])
        if len(row) != count:
            raise _wrong_answers_error({"base": f"{len(row)} {kind}: expected {count}"})
    answers: Answers = {}
    for input_field in step.inputs:
        value = given[_list_entry(input_field, None)[0]].pop(0)
        if isinstance(input_field, Flag):
            value = _YES_NO.get(value, value)
        elif (
            isinstance(input_field, Number)
            and input_field.optional
            and value == 0.0 < input_field.minimum
        ):
            value = None
        answers[input_field.name] = value
    return answers
