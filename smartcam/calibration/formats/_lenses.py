"""Read lenses from a file of any format: smartcam's own, or those of other programs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._files.store import read_document
from smartcam.calibration._hand_eye.result import HandEyeCalibration
from smartcam.calibration._lens.comparison import Lens
from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
from smartcam.calibration._stereo.calibration import StereoCalibration
from smartcam.calibration.formats._cameras import read_cameras
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping

    from smartcam.calibration._units import LengthUnit
    from smartcam.calibration.formats._cameras import CameraForm
    from smartcam.geometry import Transform

BEGINNING_BYTES: Final = 1 << 16
"""Number of bytes at a file's beginning in which the format is recognized."""

FORMAT_PATTERNS: Final[Mapping[CameraForm, re.Pattern[bytes]]] = {
    "euroc": re.compile(rb"^sensor_type\s*:\s*camera", re.MULTILINE),
    "kalibr": re.compile(rb"^cam0\s*:", re.MULTILINE),
    "mrcal": re.compile(rb"LENSMODEL_"),
    "basalt": re.compile(rb'\A\s*{\s*"value0"'),
    "multical": re.compile(rb'\A\s*{\s*"cameras"'),
    "colmap": re.compile(rb"^\d+ [A-Z_]+ \d+ \d+ [\d.]", re.MULTILINE),
    "ros_ini": re.compile(rb"^camera matrix\s*$", re.MULTILINE),
    "opencv": re.compile(rb'\A\s*(?:%YAML|<\?xml|<opencv_storage)|"opencv-matrix"'),
    "camera_info": re.compile(rb"^camera_matrix\s*:", re.MULTILINE),
}
"""Patterns by which the formats of other programs are recognized."""


class StoredLenses(NamedTuple):
    """Lenses of a file.

    Attributes:
        names: names of the cameras.
        lenses: lens of each camera, with all that the file has about this lens.
        transforms: ``T_1_0``, ... between neighbours; empty for a single camera.
    """

    names: tuple[str, ...]
    lenses: tuple[Lens, ...]
    transforms: tuple[Transform, ...] = ()


def read_lenses(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    unit: LengthUnit | None = None,
) -> StoredLenses:
    """Return the lenses of a file; its contents show the format.

    The file is a calibration of a lens, of a pair or of a camera on a robot, or has a format of
    :func:`read_cameras`, which explains ``size`` and ``unit``.

    Raises:
        CalibrationError: ``UNKNOWN_FORMAT``: the file has no known format; ``WRONG_KIND``: the
            calibration has no lens; and those of :func:`read_cameras` and of the calibrations'
            ``load``.
        MissingExtraError: PyYAML is not installed.
        OSError: the file cannot be read.
    """
    with Path(path).open("rb") as stream:
        beginning = stream.read(BEGINNING_BYTES)
    for form, pattern in FORMAT_PATTERNS.items():
        if pattern.search(beginning):
            cameras = read_cameras(path, form, size=size, unit=unit)
            lenses = tuple(Lens(camera) for camera in cameras.cameras)
            return StoredLenses(cameras.names, lenses, cameras.transforms)
    if beginning.lstrip().startswith(b"{"):
        return _read_own_file(path)
    raise Code.UNKNOWN_FORMAT.error(
        f"{path}: expected a calibration of smartcam, or one of {', '.join(FORMAT_PATTERNS)}; got "
        "none of them",
        list(FORMAT_PATTERNS),
    )


def _lenses_of_pair(pair: StereoCalibration) -> StoredLenses:
    """Return a pair's lenses, each with the points of the targets that it saw."""
    sides = []
    for side, camera in enumerate((pair.left, pair.right)):
        target_points = [
            fit.transform.apply(view.object_points)
            for fit in pair.pairs
            for view in ((fit.left, fit.right)[side],)
            if fit.used[side] and fit.transform is not None and view is not None
        ]
        points = np.concatenate(target_points) if target_points else None
        if points is not None and side:
            points = pair.transform.apply(points)
        sides.append(Lens(camera, points=points))
    return StoredLenses(
        (pair.transform.source, pair.transform.target), tuple(sides), (pair.transform,)
    )


def _lens_on_robot(hand: HandEyeCalibration) -> StoredLenses | None:
    """Return the lens of a camera on a robot; None: the calibration has no lens."""
    if hand.camera is None:
        return None
    target_points = [
        pose.apply(view.object_points)
        for pose, view, used in zip(hand.target_poses, hand.views, hand.used, strict=False)
        if used
    ]
    points = np.concatenate(target_points) if target_points else None
    return StoredLenses(("camera",), (Lens(hand.camera, points=points),))


def _read_own_file(path: str | os.PathLike[str]) -> StoredLenses:
    document = read_document(path)
    if document.kind == IntrinsicCalibration.kind:
        return StoredLenses(("camera",), (Lens.of(IntrinsicCalibration.from_data(document.data)),))
    if document.kind == StereoCalibration.kind:
        return _lenses_of_pair(StereoCalibration.from_data(document.data))
    if document.kind == HandEyeCalibration.kind:
        lenses = _lens_on_robot(HandEyeCalibration.from_data(document.data))
        if lenses is not None:
            return lenses
    raise Code.WRONG_KIND.error(
        f"{path}: holds {document.kind!r}, expected a calibration that has a lens",
        "a calibration that has a lens",
        document.kind,
    )
