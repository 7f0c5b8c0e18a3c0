"""Measure a tool: its tip from touches of one point, its axis from turns in front of a camera.

A wrong tip moves every touch by the same vector *in the flange's frame*. That cancels only as long
as the flange always has the same orientation: an error of 1 mm is 2 mm between two touches that are
half a turn apart (derived).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._views import as_list
from smartcam.geometry._inside import Code, as_motion

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array
    from smartcam.models import Localization

_MIN_ORIENTATION_SPREAD: Final = 0.17
"""Least spread of the orientations: that of two touches 20 degrees apart."""


class ToolTip(NamedTuple):
    """The position of a tool's tip on the flange.

    Attributes:
        tip: (3,), in the flange's frame, metres. Its component along ``blind`` is 0.
        point: (3,), the point that was touched, in the robot's frame, metres. If ``blind`` is not
            None, the point has the same error as the tip.
        residuals: (N, 3), offset of each touch from the point, metres, in the robot's frame.
        blind: (3,), the axis about which the flange was turned, in the flange's frame, if it was
            turned about one axis only: the tip's place along it is not known. None if it was turned
            about two or more.
    """

    tip: Array
    point: Array
    residuals: Array
    blind: Array | None


def fit_tool_tip(flanges: Sequence[Transform]) -> ToolTip:
    """Return the tip of a tool that touched the same point at several poses of the flange.

    Least squares of ``R_i tip + t_i = point``. Two poses turned about the tool's axis determine the
    tip across that axis; three or more, turned about different axes, determine all of it.

    Args:
        flanges: ``T_base_flange`` of each touch.

    Raises:
        CalibrationError: ``TOO_FEW``: fewer than two poses; ``WRONG_FRAME``: poses between
            different frames; ``INSUFFICIENT_ROTATION``: the flange was turned by less than 20
            degrees.
    """
    flanges = [
        as_motion(pose, f"tool tip: pose {number}", "base", "flange")
        for number, pose in enumerate(as_list(flanges, object, "tool tip: pose"))
    ]
    if len(flanges) < 2:
        raise Code.TOO_FEW.unexpected("tool tip: expected two touches or more", 2, len(flanges))
    _check_same([flange.label for flange in flanges], "tool tip: expected poses")
    turns = np.array([flange.rotation for flange in flanges])
    places = np.array([flange.translation for flange in flanges])
    mean_turn, mean_place = turns.mean(axis=0), places.mean(axis=0)
    matrix = (turns - mean_turn).reshape(-1, 3)
    _, values, axes = np.linalg.svd(matrix / np.sqrt(len(flanges)), full_matrices=False)
    seen = int((values > _MIN_ORIENTATION_SPREAD).sum())
    if seen < 2:  # turns about one axis have two equal eigenvalues
        raise Code.INSUFFICIENT_ROTATION.refusal(
            f"tool tip: expected the flange at orientations that differ, got a spread of "
            f"{values[1]:.3g}, which must be above {_MIN_ORIENTATION_SPREAD:g}",
            _MIN_ORIENTATION_SPREAD,
            float(values[1]),
        )
    right = -(places - mean_place).reshape(-1)
    scaled = (axes[:seen] @ (matrix.T @ right)) / (values[:seen] ** 2 * len(flanges))
    tip = axes[:seen].T @ scaled
    touched = turns @ tip + places
    point = touched.mean(axis=0)
    return ToolTip(tip, point, touched - point, None if seen == 3 else axes[2])


class RotationCentre(NamedTuple):
    """The point that a held part turns about, in the camera's coordinates.

    Attributes:
        centre: (2,), in the camera's unit.
        arm: (2,), from the centre to the part's origin when its theta is 0, in the camera's unit.
        residuals: (N, 2), offset of each localization from the circle at its angle.
    """

    centre: Array
    arm: Array
    residuals: Array


def fit_rotation_centre(parts: Iterable[Localization]) -> RotationCentre:
    """Return the centre about which a tool turned a part that it held in front of the camera.

    Least squares of ``p_i = centre + R(theta_i) arm``, with the angles measured by the camera, so
    the sense in which the robot counts angles does not matter. The tool's axis must be at a right
    angle to the camera's plane.

    Args:
        parts: localizations of one part, one at each turn, in the camera's frame.

    Raises:
        CalibrationError: ``TOO_FEW``: fewer than two parts; ``WRONG_FRAME``: parts in different
            frames; ``INSUFFICIENT_ROTATION``: turned by less than 20 degrees.
    """
    poses = [part.pose for part in parts]
    if len(poses) < 2:
        raise Code.TOO_FEW.unexpected(
            "rotation centre: expected two localizations or more", 2, len(poses)
        )
    _check_same([pose.header.frame_id for pose in poses], "rotation centre: expected localizations")
    # as complex numbers, for which a turn is a product
    places = np.array([complex(pose.position.x, pose.position.y) for pose in poses])
    turns = np.exp(1j * np.array([pose.orientation.theta for pose in poses]))
    centred = turns - turns.mean()
    spread = float(np.sqrt(np.mean(np.abs(centred) ** 2)))
    if not spread > _MIN_ORIENTATION_SPREAD:
        raise Code.INSUFFICIENT_ROTATION.refusal(
            f"rotation centre: expected angles that differ, got a spread of {spread:.3g}, which "
            f"must be above {_MIN_ORIENTATION_SPREAD:g}",
            _MIN_ORIENTATION_SPREAD,
            spread,
        )
    arm = np.vdot(centred, places) / np.vdot(centred, centred)
    centre = places.mean() - arm * turns.mean()
    return RotationCentre(_plane(centre), _plane(arm), _plane(places - centre - arm * turns))


def _check_same(frames: Sequence[str], label: str) -> None:
    others = [frame for frame in frames if frame != frames[0]]
    if others:
        raise Code.WRONG_FRAME.refusal(
            f"{label} of one and the same frame, got {frames[0]} and {others[0]}",
            frames[0],
            others[0],
        )


def _plane(numbers: NDArray[np.complex128] | np.complex128) -> Array:
    """Return complex numbers (...) as points (..., 2)."""
    return np.array(numbers, dtype=np.complex128)[..., None].view(np.float64)
