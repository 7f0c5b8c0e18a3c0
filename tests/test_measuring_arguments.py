"""Odd arguments of calibration and depth are refused by an error of the library, or work."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Iterator
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


LONG, WIDEST = [pytest.mark.long], [pytest.mark.long, pytest.mark.widest]

DEAR = frozenset(
    {
        *("CameraModel", "calibrate_intrinsics", "calibrate_sheet", "calibrate_stereo"),
        *("fit_corners", "fit_plane", "fit_touches", "suggest_views"),
    }
)
"""Functions that calculate for long where an odd value is one of those that they take."""


def widths() -> Iterator[Any]:
    """Yield each name, and how many odd values it is from one that is tried to the next."""
    for name in NAMES:
        if "hand_eye" in name:
            yield pytest.param(name, 1, marks=WIDEST)
        elif name in DEAR:
            yield pytest.param(name, 1, marks=LONG)
            yield name, 13
        else:
            yield name, 1


@pytest.mark.parametrize(("name", "every"), list(widths()))
def test_odd_arguments_are_refused_by_an_error_of_the_library(
    name: str, every: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    call, given = measuring_calls()[name]
    arguments = [one for one in inspect.signature(call).parameters if one != "parameters"]
    tried = list(itertools.product(arguments, ODD_MEASURED))[::every]
    found = [
        f"{argument}={odd}: {said}"
        for argument, odd in tried
        if (said := outcome(call, {**given, argument: ODD_MEASURED[odd]}))
    ]
    assert found == []
    assert {argument for argument, _ in tried} == {*arguments}
