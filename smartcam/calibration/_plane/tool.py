"""Measure a tool: its tip from touches of one point, its axis from turns before a camera.

A tip that is taken for somewhere else than it is moves every touch by the same vector *in the
flange's frame*. It cancels only as long as the flange always has the same orientation: an error of
1 mm is 2 mm between two touches that are half a turn apart (derived).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._views import as_list
from smartcam.geometry import Code
from smartcam.geometry._inside import as_motion

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array
    from smartcam.models import Localization

_TURN: Final = 0.17
"""Least spread of the orientations that counts: that of two touches 20 degrees apart."""


class ToolTip(NamedTuple):
    """The position of a tool's tip on the flange.

    Attributes:
        tip: (3,), in the flange's frame, metres. Along ``blind`` it is 0.
        point: (3,), the point that was touched, in the robot's frame, metres. Where ``blind`` is
            not None, it is off by what the tip is off.
        residuals: (N, 3), by how much each touch misses it, metres, in the robot's frame.
        blind: (3,), the axis about which the flange was turned, in the flange's frame, where it was
            turned about one axis only: along it the tip cannot be seen. None where it was turned
            about two or more.
    """

    tip: Array
    point: Array
    residuals: Array
    blind: Array | None


def fit_tool_tip(flanges: Sequence[Transform]) -> ToolTip:
    """Return the tip of a tool that touched one point at each of these poses of the flange.

    Least squares of ``R_i tip + t_i = point``. Two poses that are turned about the tool's axis give
    the tip across that axis; three or more, turned about different ones, give all of it.

    Args:
        flanges: ``T_base_flange`` of each touch.

    Raises:
        CalibrationError: ``TOO_FEW``: fewer than two; ``WRONG_FRAME``: between different frames;
            ``INSUFFICIENT_ROTATION``: the flange was turned by less than 20 degrees.
    """
    flanges = [
        as_motion(one, f"tool tip: pose {number}", "base", "flange")
        for number, one in enumerate(as_list(flanges, object, "tool tip: pose"))
    ]
    if len(flanges) < 2:
        raise Code.TOO_FEW.unexpected("tool tip: expected two touches or more", 2, len(flanges))
    _check_same([flange.label for flange in flanges], "tool tip: expected poses")
    turns = np.array([flange.rotation for flange in flanges])
    places = np.array([flange.translation for flange in flanges])
    mean_turn, mean_place = turns.mean(axis=0), places.mean(axis=0)
    matrix = (turns - mean_turn).reshape(-1, 3)
    _, values, axes = np.linalg.svd(matrix / np.sqrt(len(flanges)), full_matrices=False)
    seen = int((values > _TURN).sum())
    if seen < 2:  # a turn about one axis has two alike
        raise Code.INSUFFICIENT_ROTATION.refusal(
            f"tool tip: expected the flange at orientations that differ, got a spread of "
            f"{values[1]:.3g}, which must be above {_TURN:g}",
            _TURN,
            float(values[1]),
        )
    right = -(places - mean_place).reshape(-1)
    scaled = (axes[:seen] @ (matrix.T @ right)) / (values[:seen] ** 2 * len(flanges))
    tip = axes[:seen].T @ scaled
    touched = turns @ tip + places
    point = touched.mean(axis=0)
    return ToolTip(tip, point, touched - point, None if seen == 3 else axes[2])


class RotationCentre(NamedTuple):
    """The point that a held part turns about, as the camera sees it.

    Attributes:
        centre: (2,), in the camera's unit.
        arm: (2,), from the centre to the part's origin when its theta is 0, in the camera's unit.
        residuals: (N, 2), by how much each sight misses the circle at its angle.
    """

    centre: Array
    arm: Array
    residuals: Array


def fit_rotation_centre(parts: Iterable[Localization]) -> RotationCentre:
    """Return the centre about which a tool turned a part that it held before the camera.

    Least squares of ``p_i = centre + R(theta_i) arm``, with the angles that the camera saw: so it
    does not matter which way round the robot counts its own. The tool's axis stands on the camera's
    plane.

    Args:
        parts: localizations of one part, one at each turn, in the camera's frame.

    Raises:
        CalibrationError: ``TOO_FEW``: fewer than two; ``WRONG_FRAME``: in different frames;
            ``INSUFFICIENT_ROTATION``: turned by less than 20 degrees.
    """
    poses = [part.pose for part in parts]
    if len(poses) < 2:
        raise Code.TOO_FEW.unexpected("rotation centre: expected two sights or more", 2, len(poses))
    _check_same([pose.header.frame_id for pose in poses], "rotation centre: expected sights")
    # as complex numbers, where a turn is a product
    places = np.array([complex(pose.position.x, pose.position.y) for pose in poses])
    turns = np.exp(1j * np.array([pose.orientation.theta for pose in poses]))
    near = turns - turns.mean()
    spread = float(np.sqrt(np.mean(np.abs(near) ** 2)))
    if not spread > _TURN:
        raise Code.INSUFFICIENT_ROTATION.refusal(
            f"rotation centre: expected angles that differ, got a spread of {spread:.3g}, which "
            f"must be above {_TURN:g}",
            _TURN,
            spread,
        )
    arm = np.vdot(near, places) / np.vdot(near, near)
    centre = places.mean() - arm * turns.mean()
    return RotationCentre(_plane(centre), _plane(arm), _plane(places - centre - arm * turns))


def _check_same(frames: Sequence[str], what: str) -> None:
    others = [frame for frame in frames if frame != frames[0]]
    if others:
        raise Code.WRONG_FRAME.refusal(
            f"{what} of one and the same frame, got {frames[0]} and {others[0]}",
            frames[0],
            others[0],
        )


def _plane(numbers: NDArray[np.complex128] | np.complex128) -> Array:
    """Return complex numbers (...) as points (..., 2)."""
    return np.array(numbers, dtype=np.complex128)[..., None].view(np.float64)
