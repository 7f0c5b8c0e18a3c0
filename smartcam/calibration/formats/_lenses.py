"""Lenses in a file of whatever format: ours, or one of those of other programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.calibration._codes import Code
from smartcam.calibration._files.store import read_document
from smartcam.calibration._hand_eye.result import HandEyeCalibration
from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
from smartcam.calibration._stereo.calibration import StereoCalibration
from smartcam.calibration.formats._cameras import CameraChain, read_cameras
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping

    from smartcam.calibration._geometry.frames import Transform
    from smartcam.calibration._lens.model import CameraModel
    from smartcam.calibration.formats._cameras import CameraForm

HEAD: Final = 1 << 16
"""Bytes of a file by which its format is told."""

MARKS: Final[Mapping[CameraForm, re.Pattern[bytes]]] = {
    "opencv": re.compile(rb"\A\s*%YAML"),
    "kalibr": re.compile(rb"^cam0\s*:", re.MULTILINE),
    "camera_info": re.compile(rb"^camera_matrix\s*:", re.MULTILINE),
}
"""What tells the formats of other programs apart; ours begin with a brace."""


class Lenses(NamedTuple):
    """Lenses of a file.

    Attributes:
        names: of the cameras.
        lenses: as much of each as the file has.
        transforms: ``T_1_0``, ... between neighbours; none of a single camera.
    """

    names: tuple[str, ...]
    lenses: tuple[IntrinsicCalibration | CameraModel, ...]
    transforms: tuple[Transform, ...] = ()


def read_lenses(path: str | os.PathLike[str]) -> Lenses:
    """Return the lenses of a file: a calibration of a lens, a pair, a camera on a robot, or a
    ``camera_info``, a camchain of Kalibr, a file of OpenCV; its content tells which.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``: none of these; ``WRONG_KIND``: a calibration without a
            lens; and what :func:`read_cameras` and ``load`` of the calibrations say.
        MissingExtraError: PyYAML is not installed.
        OSError: it cannot be read.
    """
    with Path(path).open("rb") as stream:
        head = stream.read(HEAD)
    if head.lstrip().startswith(b"{"):
        return _ours(path)
    for form, mark in MARKS.items():
        if mark.search(head):
            return _of_chain(read_cameras(path, form))
    raise CalibrationError(
        f"{path}: expected a calibration of smartcam, or one of {', '.join(MARKS)}; got none of "
        "them",
        code=Code.UNKNOWN_FORMAT,
        expected=list(MARKS),
    )


def _of_chain(chain: CameraChain) -> Lenses:
    return Lenses(chain.names, chain.cameras, chain.transforms)


def _ours(path: str | os.PathLike[str]) -> Lenses:
    document = read_document(path)
    if document.kind == IntrinsicCalibration.kind:
        return Lenses(("camera",), (IntrinsicCalibration.from_data(document.data),))
    if document.kind == StereoCalibration.kind:
        return _of_chain(CameraChain.of(StereoCalibration.from_data(document.data)))
    if document.kind == HandEyeCalibration.kind:
        camera = HandEyeCalibration.from_data(document.data).camera
        if camera is not None:
            return Lenses(("camera",), (camera,))
    raise CalibrationError(
        f"{path}: holds {document.kind!r}, expected a calibration that has a lens",
        code=Code.WRONG_KIND,
        expected="a calibration that has a lens",
        got=document.kind,
    )
