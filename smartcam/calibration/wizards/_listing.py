"""List the calibrations of a folder: the date of each, its error, and its last check."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

from smartcam.calibration._files.load import KINDS
from smartcam.calibration._files.store import read_document
from smartcam.calibration._hand_eye.result import HandEyeCalibration
from smartcam.calibration._sheet.calibration import SheetCalibration
from smartcam.calibration.wizards._journal import MAX_LINE_BYTES
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.calibration._files.directory import Folder

MAX_CALIBRATIONS: Final = 200
"""Largest number of calibrations that are listed, those whose names are first in order."""


def list_calibrations(folder: Folder) -> list[dict[str, Any]]:
    """Return a row of JSON data for each calibration of a folder, sorted by name.

    Its keys are ``name``, ``kind``, ``written_at`` (UTC, ISO 8601), ``held_out_mm`` (RMS; None: not
    known), ``checked_at`` and ``stale`` of the last check (None without a check), and ``problem``
    (None if the file can be read). A file that cannot be read has only a name and a ``problem``.
    """
    return [_listing_row(folder, name) for name in folder.names()[:MAX_CALIBRATIONS]]


def _listing_row(folder: Folder, name: str) -> dict[str, Any]:
    row: dict[str, Any] = dict.fromkeys(
        ("name", "kind", "written_at", "held_out_mm", "checked_at", "stale", "problem")
    )
    row["name"] = name
    try:
        document = read_document(folder.find(name))
        row |= {"kind": document.kind, "written_at": document.written_at}
        row["held_out_mm"] = _held_out_mm(document.kind, document.data)
        check = _last_check(folder.checks(name))
        # a check before this calibration was written does not count
        if check.get("calibration") == document.written_at:
            row |= {"checked_at": check.get("at"), "stale": check.get("stale")}
    except (CalibrationError, OSError) as exc:
        row["problem"] = str(exc)
    return row


def _held_out_mm(kind: str, data: dict[str, Any]) -> float | None:
    """Return the held-out error of a calibration, mm."""
    if kind == HandEyeCalibration.kind:
        error = HandEyeCalibration.from_data(data).held_out_error
    elif kind in KINDS:
        calibration = KINDS[kind].from_data(data)
        plane = calibration.plane if isinstance(calibration, SheetCalibration) else calibration
        error = plane.held_out_error
    else:
        return None
    return None if error is None else 1e3 * error


def _last_check(path: Path) -> dict[str, Any]:
    """Return the last complete line of a file of checks, to which another process may write."""
    try:
        with path.open("rb") as stream:
            stream.seek(max(0, stream.seek(0, 2) - 2 * MAX_LINE_BYTES))
            *lines, _ = stream.read(2 * MAX_LINE_BYTES).split(b"\n")
    except FileNotFoundError:
        return {}
    try:
        check = json.loads(lines[-1])
    except (IndexError, ValueError):
        return {}
    return check if isinstance(check, dict) else {}
