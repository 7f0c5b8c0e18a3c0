"""Files of calibrations that bring localizations to the robot, whichever kind they hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from smartcam.calibration._codes import Code
from smartcam.calibration._files.store import Document, read_document
from smartcam.calibration._plane.calibration import PlaneCalibration
from smartcam.calibration._sheet.calibration import SheetCalibration
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping

AnyCalibration: TypeAlias = PlaneCalibration | SheetCalibration

KINDS: Final[Mapping[str, type[AnyCalibration]]] = {
    one.kind: one for one in (PlaneCalibration, SheetCalibration)
}
"""What a file may hold."""


def load_calibration(path: str | os.PathLike[str]) -> AnyCalibration:
    """Load the calibration that a file holds: a plane's, or a sheet's.

    Raises:
        CalibrationError: the file is damaged, newer, or holds something else.
        OSError: it is not there, or cannot be read.
    """
    return of_document(read_document(path), str(path))


def of_document(document: Document, name: str) -> AnyCalibration:
    """Return the calibration that a document holds; ``name`` of the file is for messages.

    Raises WRONG_KIND, or SHAPE: its data are no calibration.
    """
    if document.kind in KINDS:
        return KINDS[document.kind].from_data(document.data)
    expected = " or ".join(map(repr, KINDS))
    raise CalibrationError(
        f"{name}: holds {document.kind!r}, expected {expected}",
        code=Code.WRONG_KIND,
        got=document.kind,
        expected=expected,
    )
