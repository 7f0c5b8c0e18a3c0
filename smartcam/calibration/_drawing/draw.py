"""Draw a calibration from images: its views, its scene, its uncertainty."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._argument_checks import a_number, check_arguments, or_none
from smartcam._arguments import check_text
from smartcam.calibration._drawing.bars import Chart, Series, draw_bars, short_names
from smartcam.calibration._drawing.maps import Map, draw_maps
from smartcam.calibration._drawing.scene import Axes, DrawnBoard, DrawnCamera, DrawnScene
from smartcam.calibration._drawing.scene import draw_scene as _draw_scene
from smartcam.calibration._hand_eye.result import HandEyeCalibration
from smartcam.calibration._lens.comparison import LensComparison
from smartcam.calibration._lens.intrinsics import IntrinsicCalibration
from smartcam.calibration._lens.uncertainty import ProjectionUncertainty
from smartcam.calibration._stereo.calibration import StereoCalibration
from smartcam.calibration._views import view_name
from smartcam.geometry._inside import IDENTITY, Code

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from smartcam.calibration._lens.uncertainty import MapFigures
    from smartcam.calibration._targets import Target
    from smartcam.exceptions import CalibrationError
    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array

FromImages = IntrinsicCalibration | StereoCalibration | HandEyeCalibration
"""Calibrations from images."""

MILLIMETRES: Final = 1e3


@check_arguments(title=check_text)
def draw_views(calibration: FromImages, *, title: str = "") -> str:
    """Return a picture of each view's errors as bars, SVG.

    For a lens the bars are the RMS of the residuals and the held-out error, in pixels; for a pair
    of cameras the RMS of each side in pixels and the held-out error of lengths in millimetres; for
    a camera on a robot the fitted and the held-out error on the target, in millimetres. Dashed
    lines are the overall values of all views; grey bars are views that were left out. ``title`` is
    a line on top. The document has a fixed size, loads no other files, and adapts to a dark page.

    Raises:
        CalibrationError: ``WRONG_KIND``: this is no calibration from images.
    """
    return draw_bars(_choose_drawing(calibration, _CHARTS, "draw_views")(calibration), title)


@check_arguments(title=check_text)
def draw_scene(calibration: FromImages, *, title: str = "") -> str:
    """Return a picture of targets and cameras in space, SVG, otherwise as :func:`draw_views`.

    For a lens or a pair the picture is drawn in the camera's frame, for a robot in the frame of its
    base. Targets are blue, with the views' names; targets that were left out are dashed. Cameras
    are orange.
    """
    return _draw_scene(_choose_drawing(calibration, _SCENES, "draw_scene")(calibration), title)


@check_arguments(distance=or_none(a_number), title=check_text)
def draw_uncertainty(
    shown: IntrinsicCalibration | ProjectionUncertainty | LensComparison,
    *,
    distance: float | None = None,
    title: str = "",
) -> str:
    """Return a map of the uncertainty of a lens, SVG, otherwise as :func:`draw_views`.

    A comparison of two lenses gives two maps: their difference, and the difference that noise alone
    causes. Colours follow the logarithm of the uncertainty, from dark (small) to light (large).
    Numbers are the RMS of one coordinate, pixels. A white cross marks the largest value; white dots
    are the points in the views of a calibration. ``distance`` is as in
    :meth:`~smartcam.calibration.IntrinsicCalibration.uncertainty`.
    """
    if isinstance(shown, LensComparison):
        maps = [
            Map("difference", _size(shown.pixels), shown.lengths, _figures_text(shown.observed))
        ]
        if shown.expected is not None and shown.predicted is not None:
            expected = np.sqrt(np.trace(shown.expected, axis1=2, axis2=3) / 2)
            caption = _figures_text(shown.predicted)
            maps.append(Map("expected from noise", _size(shown.pixels), expected, caption))
        return draw_maps(maps, title, "px")
    points = np.zeros((0, 2))
    if isinstance(shown, IntrinsicCalibration):
        points = np.concatenate([fit.view.points for fit in shown.views if fit.used])
        shown = shown.uncertainty(distance=distance)
    if not isinstance(shown, ProjectionUncertainty):
        raise _argument_error(
            "draw_uncertainty", "a calibration of a lens, its map or a comparison", shown
        )
    distance_text = "infinity" if shown.distance is None else f"{shown.distance:g} m"
    name = f"standard deviation of the projection of a point at {distance_text}"
    caption = _figures_text(shown.figures)
    if not (is_reached := np.isfinite(shown.sigma)).all():
        caption += f"; the lens model does not reach {1 - is_reached.mean():.1%} of the image"
    return draw_maps([Map(name, shown.size, shown.sigma, caption, points)], title, "px")


def _choose_drawing(
    calibration: object, table: Mapping[type, Any], label: str
) -> Callable[[Any], Any]:
    drawing = next(
        (drawing for kind, drawing in table.items() if isinstance(calibration, kind)), None
    )
    if drawing is None:
        raise _argument_error(
            label, "a calibration of a lens, a pair, or a camera on a robot", calibration
        )
    function: Callable[[Any], Any] = drawing
    return function


def _argument_error(label: str, expected: str, actual: object) -> CalibrationError:
    return Code.WRONG_KIND.error_with_value(
        f"{label}: expected {expected}", expected, type(actual).__name__
    )


def _size(pixels: Array) -> tuple[int, int]:
    width, height = (pixels[-1, -1] + 1).round().astype(int).tolist()
    return width, height


def _figures_text(figures: MapFigures) -> str:
    finite = {name: figure for name, figure in figures._asdict().items() if math.isfinite(figure)}
    return ", ".join(f"{name} {value:.2g}" for name, value in finite.items())


# ---------------------------------------------------------------------- bars


def _lens_chart(calibration: IntrinsicCalibration) -> list[Chart]:
    return [
        Chart(
            "px",
            [
                Series("residuals", [fit.rms for fit in calibration.views], calibration.rms),
                Series(
                    "held out", [fit.held_out for fit in calibration.views], calibration.held_out
                ),
            ],
            [view_name(fit.view, number) for number, fit in enumerate(calibration.views)],
            [not fit.used for fit in calibration.views],
        )
    ]


def _pair_charts(calibration: StereoCalibration) -> list[Chart]:
    names = _pair_names(calibration)
    left_out = [not any(fit.used) for fit in calibration.pairs]
    sides = [
        Series(f"residuals, {side}", [fit.rms[number] for fit in calibration.pairs])
        for number, side in enumerate(("left", "right"))
    ]
    held_out = [MILLIMETRES * fit.held_out for fit in calibration.pairs]
    return [
        Chart("px", sides, names, left_out),
        Chart(
            "mm",
            [Series("held out, lengths", held_out, MILLIMETRES * calibration.held_out)],
            names,
            left_out,
        ),
    ]


def _robot_chart(calibration: HandEyeCalibration) -> list[Chart]:
    overall = (
        math.nan if calibration.held_out_error is None else MILLIMETRES * calibration.held_out_error
    )
    return [
        Chart(
            "mm",
            [
                Series("on the target", (MILLIMETRES * calibration.errors).tolist()),
                Series("held out", (MILLIMETRES * calibration.leave_one_out).tolist(), overall),
            ],
            _robot_names(calibration),
            [not used for used in calibration.used],
        )
    ]


def _pair_names(calibration: StereoCalibration) -> list[str]:
    views = [fit.left or fit.right for fit in calibration.pairs]
    return [view_name(view, n) if view else f"pair {n}" for n, view in enumerate(views)]


def _robot_names(calibration: HandEyeCalibration) -> list[str]:
    if calibration.views:
        return [view_name(view, number) for number, view in enumerate(calibration.views)]
    return [f"pose {number}" for number in range(len(calibration.robot_poses))]


# ---------------------------------------------------------------------- scenes


def _corners(target: Target | None) -> Array:
    """Return the corners (4, 3) of a target, or of a square of 100 mm for an unknown one."""
    if target is None:
        return 0.05 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    (left, low, _), (right, high, _) = target.points.min(axis=0), target.points.max(axis=0)
    return np.array([[left, low, 0.0], [right, low, 0.0], [right, high, 0.0], [left, high, 0.0]])


def _boards(
    names: Iterable[str], poses: Iterable[Transform | None], unused: Iterable[bool], target: Target
) -> list[DrawnBoard]:
    return [
        DrawnBoard(name, pose.apply(_corners(target)), left_out)
        for name, pose, left_out in zip(names, poses, unused, strict=True)
        if pose is not None
    ]


def _lens_scene(calibration: IntrinsicCalibration) -> DrawnScene:
    names = short_names(
        [view_name(fit.view, number) for number, fit in enumerate(calibration.views)]
    )
    poses, left_out = (
        [fit.transform for fit in calibration.views],
        [not fit.used for fit in calibration.views],
    )
    boards = _boards(names, poses, left_out, calibration.views[0].view.target)
    return DrawnScene(boards, [DrawnCamera("camera", IDENTITY, calibration.camera)])


def _pair_scene(calibration: StereoCalibration) -> DrawnScene:
    first_view = next(
        view for fit in calibration.pairs for view in (fit.left, fit.right) if view is not None
    )
    poses, left_out = (
        [fit.transform for fit in calibration.pairs],
        [not any(fit.used) for fit in calibration.pairs],
    )
    boards = _boards(short_names(_pair_names(calibration)), poses, left_out, first_view.target)
    right = calibration.transform.rigid.inverse()
    return DrawnScene(
        boards,
        [
            DrawnCamera("left", IDENTITY, calibration.left),
            DrawnCamera("right", right, calibration.right),
        ],
    )


def _robot_scene(calibration: HandEyeCalibration) -> DrawnScene:
    names = short_names(_robot_names(calibration))
    corners = _corners(calibration.target)
    base = [Axes("base", IDENTITY)]
    flanges = [pose.rigid for pose in calibration.robot_poses]
    up = (0.0, 0.0, 1.0)
    if calibration.setup == "eye-in-hand":
        board = DrawnBoard("target", calibration.target_pose.apply(corners))
        cameras = [
            DrawnCamera(name, flange @ calibration.camera_pose.rigid, calibration.camera)
            for name, flange in zip(names, flanges, strict=True)
        ]
        return DrawnScene([board], cameras, base, up)
    boards = [
        DrawnBoard(name, (flange @ calibration.target_pose.rigid).apply(corners), not used)
        for name, flange, used in zip(names, flanges, calibration.used, strict=True)
    ]
    return DrawnScene(
        boards, [DrawnCamera("camera", calibration.camera_pose.rigid, calibration.camera)], base, up
    )


_CHARTS: Final[Mapping[type, Callable[[Any], list[Chart]]]] = {
    IntrinsicCalibration: _lens_chart,
    StereoCalibration: _pair_charts,
    HandEyeCalibration: _robot_chart,
}

_SCENES: Final[Mapping[type, Callable[[Any], DrawnScene]]] = {
    IntrinsicCalibration: _lens_scene,
    StereoCalibration: _pair_scene,
    HandEyeCalibration: _robot_scene,
}
