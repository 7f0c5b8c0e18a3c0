"""Draw a picture of a calibration that is stored in a file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from smartcam.calibration._drawing.draw import draw_scene, draw_uncertainty, draw_views
from smartcam.calibration._files.store import read_document
from smartcam.calibration._hand_eye.result import HandEyeCalibration
from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
from smartcam.calibration._plane.calibration import PlaneCalibration
from smartcam.calibration._plane.drawing import draw as draw_plane
from smartcam.calibration._stereo.calibration import StereoCalibration
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping

Picture: TypeAlias = Literal["views", "scene", "uncertainty", "plane"]

PICTURES: Final[Mapping[str, tuple[Picture, ...]]] = {
    IntrinsicCalibration.kind: ("views", "scene", "uncertainty"),
    StereoCalibration.kind: ("views", "scene"),
    HandEyeCalibration.kind: ("views", "scene"),
    PlaneCalibration.kind: ("plane",),
}
"""Pictures of each kind of file; the first is drawn by default."""


def draw_file(
    path: str | os.PathLike[str], picture: Picture | None = None, distance: float | None = None
) -> str:
    """Return a picture of the calibration in a file, SVG, with the file's name as title.

    Raises ``WRONG_KIND`` if this kind of file has no such picture, and the errors of the
    calibration's ``load``.
    """
    document = read_document(path)
    available = PICTURES.get(document.kind, ())
    if not available or picture not in {None, *available}:
        expected = picture or " or ".join(PICTURES)
        wanted = f"the picture {picture}" if picture else f"a file of kind {expected}"
        raise Code.WRONG_KIND.error(
            f"{path}: expected {wanted}, got a file of kind {document.kind!r}, which has "
            f"{' and '.join(available) or 'no picture'}",
            expected,
            document.kind,
        )
    title, data = str(path), document.data
    drawn = picture or available[0]
    if document.kind == PlaneCalibration.kind:
        return draw_plane(PlaneCalibration.from_data(data), title=title)
    kinds = (IntrinsicCalibration, StereoCalibration, HandEyeCalibration)
    calibration = next(kind for kind in kinds if kind.kind == document.kind).from_data(data)
    if isinstance(calibration, IntrinsicCalibration) and drawn == "uncertainty":
        return draw_uncertainty(calibration, distance=distance, title=title)
    return (
        draw_scene(calibration, title=title)
        if drawn == "scene"
        else draw_views(calibration, title=title)
    )
