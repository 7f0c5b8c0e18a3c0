"""Lenses in a file of whatever format: ours, or one of those of other programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._codes import Code
from smartcam.calibration._files.store import read_document
from smartcam.calibration._hand_eye.result import HandEyeCalibration
from smartcam.calibration._lens.comparison import Lens
from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
from smartcam.calibration._stereo.calibration import StereoCalibration
from smartcam.calibration.formats._cameras import read_cameras
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping

    from smartcam.calibration._geometry.frames import Transform
    from smartcam.calibration.formats._cameras import CameraChain, CameraForm

HEAD: Final = 1 << 16
"""Bytes of a file by which its format is told."""

MARKS: Final[Mapping[CameraForm, re.Pattern[bytes]]] = {
    "opencv": re.compile(rb"\A\s*%YAML"),
    "kalibr": re.compile(rb"^cam0\s*:", re.MULTILINE),
    "camera_info": re.compile(rb"^camera_matrix\s*:", re.MULTILINE),
}
"""What tells the formats of other programs apart; ours begin with a brace."""


class StoredLenses(NamedTuple):
    """Lenses of a file.

    Attributes:
        names: of the cameras.
        lenses: as much of each as the file has.
        transforms: ``T_1_0``, ... between neighbours; none of a single camera.
    """

    names: tuple[str, ...]
    lenses: tuple[Lens, ...]
    transforms: tuple[Transform, ...] = ()


def read_lenses(path: str | os.PathLike[str]) -> StoredLenses:
    """Return the lenses of a file; its content tells the format.

    It may be a calibration of a lens, of a pair or of a camera on a robot, a ``camera_info``, a
    camchain of Kalibr, or a file of OpenCV.

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


def _of_chain(chain: CameraChain) -> StoredLenses:
    return StoredLenses(chain.names, tuple(Lens(one) for one in chain.cameras), chain.transforms)


def _of_pair(pair: StereoCalibration) -> StoredLenses:
    """Return a pair's lenses, each with where it saw the target."""
    sides = []
    for number, camera in enumerate((pair.left, pair.right)):
        seen = [
            one.transform.apply(view.object_points)
            for one in pair.pairs
            for view in ((one.left, one.right)[number],)
            if one.used[number] and one.transform is not None and view is not None
        ]
        points = np.concatenate(seen) if seen else None
        if points is not None and number:
            points = pair.transform.apply(points)
        sides.append(Lens(camera, points=points))
    return StoredLenses(
        (pair.transform.source, pair.transform.target), tuple(sides), (pair.transform,)
    )


def _of_robot(hand: HandEyeCalibration) -> StoredLenses | None:
    """Return the lens of a camera on a robot; None where it has none."""
    if hand.camera is None:
        return None
    seen = [
        pose.apply(view.object_points)
        for pose, view, used in zip(hand.target_poses, hand.views, hand.used, strict=False)
        if used
    ]
    points = np.concatenate(seen) if seen else None
    return StoredLenses(("camera",), (Lens(hand.camera, points=points),))


def _ours(path: str | os.PathLike[str]) -> StoredLenses:
    document = read_document(path)
    if document.kind == IntrinsicCalibration.kind:
        return StoredLenses(("camera",), (Lens.of(IntrinsicCalibration.from_data(document.data)),))
    if document.kind == StereoCalibration.kind:
        return _of_pair(StereoCalibration.from_data(document.data))
    if document.kind == HandEyeCalibration.kind:
        found = _of_robot(HandEyeCalibration.from_data(document.data))
        if found is not None:
            return found
    raise CalibrationError(
        f"{path}: holds {document.kind!r}, expected a calibration that has a lens",
        code=Code.WRONG_KIND,
        expected="a calibration that has a lens",
        got=document.kind,
    )
