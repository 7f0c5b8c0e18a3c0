"""The list of a folder's calibrations."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import pytest

from smartcam.calibration import Folder, PlaneCalibration, fit_plane
from smartcam.calibration._files.directory import MAX_NAME_LENGTH
from smartcam.calibration._inside import list_calibrations
from smartcam.calibration.wizards import CalibrationService
from smartcam.calibration.wizards._services import MAX_EARLIER_JOURNALS
from tests import ROOT
from tests.calibration.inside import BACKUPS, RULER_MM, read_document, write

if TYPE_CHECKING:
    from pathlib import Path

MARKS = np.array([(0.0, 0.0), (0.3, 0.0), (0.0, 0.2), (0.3, 0.2)])


def saved(folder: Path, name: str, points: int = 4) -> PlaneCalibration:
    touches = np.column_stack([MARKS, np.zeros(4)])
    touches[1] += (0.0005, 0.0, 0.0)
    found = fit_plane(MARKS[:points], touches[:points], touch_sigma=0.0002)
    found.save(folder / f"{name}.json")
    return found


def check(folder: Path, name: str, calibration: str, *, stale: bool) -> None:
    row = {"at": "2026-02-03T04:05:06+00:00", "calibration": calibration, "stale": stale}
    with (folder / f"{name}.checks.jsonl").open("a") as stream:
        stream.write(json.dumps(row) + "\n")


def test_listing_has_date_error_and_last_check(tmp_path: Path) -> None:
    found = saved(tmp_path, "table")
    at = read_document(tmp_path / "table.json").written_at
    (tmp_path / "table.checks.jsonl").write_text('{"schema": "smartcam.checks/1"}\n')
    check(tmp_path, "table", at, stale=False)
    check(tmp_path, "table", at, stale=True)
    (row,) = list_calibrations(Folder(tmp_path))
    assert found.held_out_error is not None
    assert row == {
        "name": "table",
        "kind": "plane",
        "written_at": at,
        "held_out_mm": pytest.approx(1e3 * found.held_out_error),
        "checked_at": "2026-02-03T04:05:06+00:00",
        "stale": True,
        "problem": None,
    }


def test_listing_takes_no_check_of_a_calibration_before_and_no_half_line(tmp_path: Path) -> None:
    saved(tmp_path, "table")
    check(tmp_path, "table", "2020-01-01T00:00:00+00:00", stale=True)
    assert list_calibrations(Folder(tmp_path))[0]["checked_at"] is None
    check(tmp_path, "table", read_document(tmp_path / "table.json").written_at, stale=False)
    with (tmp_path / "table.checks.jsonl").open("a") as stream:
        stream.write('{"at": "2026-09')
    (row,) = CalibrationService(tmp_path).listing
    assert (row["stale"], row["checked_at"][:7]) == (False, "2026-02")


def test_listing_of_three_touches_knows_no_error(tmp_path: Path) -> None:
    saved(tmp_path, "table", points=3)
    assert list_calibrations(Folder(tmp_path))[0]["held_out_mm"] is None


def test_listing_names_unreadable_files_and_goes_on(tmp_path: Path) -> None:
    saved(tmp_path, "b")
    (tmp_path / "a.json").write_text("{")
    write(tmp_path / "c.json", "other", {})
    (tmp_path / "c.checks.jsonl").write_text("no JSON\n")
    rows = {row["name"]: row for row in list_calibrations(Folder(tmp_path))}
    assert list(rows) == ["a", "b", "c"]
    assert "no JSON" in rows["a"]["problem"]
    assert rows["b"]["problem"] is None
    assert (rows["c"]["kind"], rows["c"]["held_out_mm"], rows["c"]["stale"]) == (
        "other",
        None,
        None,
    )


def test_wizards_bounds_are_those_of_the_code() -> None:
    said = {
        f"`NAME` has at most {MAX_NAME_LENGTH} letters",
        f"`NAME.json.1` to `.{BACKUPS}`",
        f"`NAME.journal.1` to `.{MAX_EARLIER_JOURNALS}`",
        f"printed {RULER_MM:g} mm ruler",
    }
    page = (ROOT / "docs" / "calibrating.md").read_text(encoding="utf-8")
    assert {text for text in said if text not in page} == set()
