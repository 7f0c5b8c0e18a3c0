"""The sorting demonstration of the thesis' 4.3, as a script."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest

SCRIPT = Path(__file__).parents[2] / "examples" / "sorting" / "sorting.py"


def test_sorting_script_sorts_everything(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(SCRIPT), run_name="__main__")
    assert capsys.readouterr().out.splitlines() == [
        "3 screws: screw_1, screw_2, screw_3",
        "3 nuts: nut_1, nut_2, nut_3",
    ]
