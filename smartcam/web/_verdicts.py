"""Decide whether a result passed or failed, by the names of its truth values."""

from __future__ import annotations

import functools
from typing import Any, Final, Literal, TypeAlias

from smartcam._meanings import good_value_of
from smartcam.models import Localization, jsonable

MAX_JUDGED: Final = 200
"""Largest number of records of a result that are judged; further records are ignored."""

Outcome: TypeAlias = Literal["passed", "failed", "other", "errors"]
"""Outcome of a result; a result without a verdict is "other"."""


def verdicts(value: Any) -> list[dict[str, Any]]:
    """Return the truth values of a record or a list of records, with their verdicts.

    ``true`` is the number of records in which the value is true, ``of`` the number of all records.
    """
    rows: list[Any] = value if isinstance(value, list) else [value]
    if not (rows and all(isinstance(row, dict) for row in rows)):
        return []
    names = [str(name) for name, field in rows[0].items() if isinstance(field, bool)]
    return [_verdict(name, [row.get(name) is True for row in rows]) for name in names]


def _verdict(name: str, values: list[bool]) -> dict[str, Any]:
    good_value = _good_value_of(name)
    verdict = (
        None
        if good_value is None
        else "pass"
        if all(value is good_value for value in values)
        else "fail"
    )
    return {"name": name, "true": sum(values), "of": len(values), "verdict": verdict}


_good_value_of = functools.lru_cache(maxsize=4096)(good_value_of)


def outcome_of(value: Any) -> Outcome:
    """Return the outcome of a result, by the names of its truth values."""
    rows = value if isinstance(value, list) else [value]
    verdict: Outcome = "other"
    for row in rows[:MAX_JUDGED]:
        if isinstance(row, Localization) or not hasattr(row, "_asdict"):
            return "other"
        for name, field in row._asdict().items():
            if field is True or field is False:
                good_value = _good_value_of(name)
                if good_value is not None and field is not good_value:
                    return "failed"
                if good_value is not None:
                    verdict = "passed"
    return verdict


def describe_failures(value: Any) -> str:
    """Return a text that names the truth values that say "failed"; "" if there are none."""
    failures = [row for row in verdicts(jsonable(value)) if row["verdict"] == "fail"]
    texts = []
    for row in failures:
        wanted = "true" if _good_value_of(row["name"]) else "false"
        records = "" if row["of"] == 1 else f" in {row['true']} of {row['of']} records"
        actual = {"true": "false", "false": "true"}[wanted] if row["of"] == 1 else "true"
        texts.append(f"{row['name']} is {actual}{records}, expected {wanted}")
    return "; ".join(texts)
