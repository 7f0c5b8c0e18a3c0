"""Files of calibrations that bring localizations to the robot, whichever kind they hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, TypeAlias

from smartcam.calibration.codes import Code
from smartcam.calibration.files.store import Document, read_document
from smartcam.calibration.plane.calibration import KIND as PLANE
from smartcam.calibration.plane.calibration import PlaneCalibration
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    import os

    from smartcam.calibration.sheet.calibration import SheetCalibration

    AnyCalibration: TypeAlias = PlaneCalibration | SheetCalibration

__all__ = ["KINDS", "load_calibration", "of_document"]

SHEET: Final = "sheet"
"""What the files of calibrations by a picture of a sheet are called."""

KINDS: Final = (PLANE, SHEET)
"""What a file may hold."""


def load_calibration(path: str | os.PathLike[str]) -> AnyCalibration:
    """Return what a file holds: a plane's calibration, or that of a sheet.

    Raises:
        CalibrationError: the file is damaged, newer, or holds something else.
        OSError: it is not there, or cannot be read.
    """
    return of_document(read_document(path), str(path))


def of_document(document: Document, name: str) -> AnyCalibration:
    """Return the calibration that a document holds.

    Args:
        document: a file's content.
        name: of the file, for messages.

    Raises:
        CalibrationError: WRONG_KIND; SHAPE: its data are no calibration.
    """
    data: dict[str, Any] = document.data
    if document.kind == PLANE:
        return PlaneCalibration.from_data(data)
    if document.kind == SHEET:
        from smartcam.calibration.sheet.calibration import SheetCalibration

        return SheetCalibration.from_data(data)
    expected = " or ".join(map(repr, KINDS))
    raise CalibrationError(
        f"{name}: holds {document.kind!r}, expected {expected}",
        code=Code.WRONG_KIND,
        got=document.kind,
        expected=expected,
    )
