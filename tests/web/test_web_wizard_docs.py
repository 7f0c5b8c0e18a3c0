"""``docs/calibrating.md``: its table has every call, its numbers are those of the code."""

from __future__ import annotations

from pathlib import Path

from smartcam.calibration.files.directory import MAX_NAME
from smartcam.calibration.files.store import BACKUPS
from smartcam.calibration.wizards.plane import RULER
from smartcam.calibration.wizards.services import JOURNALS
from smartcam.web.wizard import CALLS

PAGE = (Path(__file__).parents[2] / "docs" / "calibrating.md").read_text(encoding="utf-8")


def test_table_has_every_call() -> None:
    table = PAGE.partition("\n## Calls\n")[2].partition("\n`GET /api")[0]
    rows = [[cell.strip() for cell in row.split("|")[1:-1]] for row in table.splitlines()[3:]]
    assert [row for row in rows if row] == [
        [call.method, f"`{call.path}`", call.about, f"`{call.sample}`" if call.sample else ""]
        for call in CALLS
    ]


def test_bounds_are_those_of_the_code() -> None:
    said = {
        f"Names have up to {MAX_NAME} letters",
        f"`NAME.json.1` to `.{BACKUPS}`",
        f"`NAME.journal.1` to `.{JOURNALS}`",
        f"printed {RULER:g} mm ruler",
    }
    assert {text for text in said if text not in PAGE} == set()
