"""Odd arguments of calibration and depth are refused by an error of the library, or work."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import pytest

from smartcam import SmartCamError, calibration, depth
from tests.measuring_calls import ODD_MEASURED, RETURNED, measuring_calls
from tests.test_arguments import LONGEST_TEXT

NAMES = sorted(
    name
    for module in (calibration, depth)
    for name in module.__all__
    if callable(getattr(module, name)) and name not in RETURNED
)


def outcome(call: Any, given: dict[str, Any]) -> str:
    """Return how a call ends: "" where it does as it should, else the kind of its error."""
    try:
        call(**given)
    except SmartCamError as exc:
        return "" if 0 < len(str(exc)) <= LONGEST_TEXT else f"a text of {len(str(exc))} characters"
    except (FileNotFoundError, IsADirectoryError):  # of a path that could be one
        return ""
    except Exception as exc:  # noqa: BLE001 - whatever it is is judged
        return f"{type(exc).__name__}: {exc!s:.100}"
    return ""


WIDEST = [pytest.mark.long, pytest.mark.widest]


@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=WIDEST) if "hand_eye" in one else one for one in NAMES],
)
def test_odd_arguments_are_refused_by_an_error_of_the_library(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    call, given = measuring_calls()[name]
    found = [
        f"{argument}={odd}: {said}"
        for argument in inspect.signature(call).parameters
        if argument != "parameters"
        for odd, value in ODD_MEASURED.items()
        if (said := outcome(call, {**given, argument: value}))
    ]
    assert found == []
