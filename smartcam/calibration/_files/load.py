"""Load a calibration that maps localizations to the robot: that of a plane or of a sheet."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, TypeAlias

from smartcam._argument_checks import check_arguments
from smartcam._arguments import check_path
from smartcam.calibration._files.store import Document, read_document
from smartcam.calibration._plane.calibration import PlaneCalibration
from smartcam.calibration._sheet.calibration import SheetCalibration
from smartcam.calibration._verdict import warn_unless_good
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping

AnyCalibration: TypeAlias = PlaneCalibration | SheetCalibration

KINDS: Final[Mapping[str, type[AnyCalibration]]] = {
    kind.kind: kind for kind in (PlaneCalibration, SheetCalibration)
}
"""Calibrations that a file may hold, by their kinds."""


@check_arguments(path=check_path)
def load_calibration(path: str | os.PathLike[str]) -> AnyCalibration:
    """Load the calibration of a plane or a sheet from a file.

    If the calibration is not good, a warning is logged.

    Raises:
        CalibrationError: the file is damaged, newer, or of another kind.
        OSError: the file does not exist, or cannot be read.
    """
    return calibration_from_document(read_document(path), str(path))


def calibration_from_document(document: Document, name: str) -> AnyCalibration:
    """Return the calibration that a document holds; ``name``, of the file, is for messages.

    Raises WRONG_KIND: another kind of calibration; SHAPE: the data are no calibration.
    """
    if document.kind in KINDS:
        calibration = KINDS[document.kind].from_data(document.data)
        warn_unless_good(calibration, name)
        return calibration
    expected = " or ".join(map(repr, KINDS))
    raise Code.WRONG_KIND.error(
        f"{name}: holds {document.kind!r}, expected {expected}", expected, document.kind
    )
