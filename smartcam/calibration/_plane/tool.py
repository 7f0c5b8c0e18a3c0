"""Compute the position of a tool's tip from touches of one point.

A wrong tip moves every touch by the same vector *in the flange's frame*. This error cancels only if
the flange has the same orientation at all touches: between two touches that are half a turn apart,
an error of 1 mm becomes 2 mm.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._views import as_list
from smartcam.geometry._inside import Code, as_motion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.geometry import Transform
    from smartcam.geometry._inside import Array

MIN_ORIENTATION_SPREAD: Final = 0.17
"""Singular values of the differences of rotations count only above this; two touches 20 degrees
apart reach it."""


class ToolTip(NamedTuple):
    """The position of a tool's tip on the flange.

    Attributes:
        tip: (3,), in the flange's frame, metres. Its component along ``unknown_axis`` is 0.
        point: (3,), the point that was touched, in the robot's frame, metres. If
            ``unknown_axis`` is not None, the point has the same error as the tip.
        residuals: (N, 3), offset of each touch from the point, metres, in the robot's frame.
        unknown_axis: (3,), the axis about which the flange was turned, in the flange's frame, if
            it was turned about one axis only: the tip's place along it is not known. None if it
            was turned about two or more.
    """

    tip: Array
    point: Array
    residuals: Array
    unknown_axis: Array | None


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
        raise Code.TOO_FEW.error_with_value(
            "tool tip: expected two touches or more", 2, len(flanges)
        )
    label = flanges[0].label
    for flange in flanges:
        if flange.label != label:
            raise Code.WRONG_FRAME.error(
                f"tool tip: expected poses of one and the same frame, got {label} and "
                f"{flange.label}",
                label,
                flange.label,
            )
    rotations = np.array([flange.rotation for flange in flanges])
    positions = np.array([flange.translation for flange in flanges])
    mean_rotation, mean_position = rotations.mean(axis=0), positions.mean(axis=0)
    matrix = (rotations - mean_rotation).reshape(-1, 3)
    _, values, axes = np.linalg.svd(matrix / np.sqrt(len(flanges)), full_matrices=False)
    rank = int((values > MIN_ORIENTATION_SPREAD).sum())
    if rank < 2:  # turns about one axis have two equal eigenvalues
        raise Code.INSUFFICIENT_ROTATION.error(
            f"tool tip: expected the flange at orientations that differ, got a spread of "
            f"{values[1]:.3g}, which must be above {MIN_ORIENTATION_SPREAD:g}",
            MIN_ORIENTATION_SPREAD,
            float(values[1]),
        )
    right = -(positions - mean_position).reshape(-1)
    components = (axes[:rank] @ (matrix.T @ right)) / (values[:rank] ** 2 * len(flanges))
    tip = axes[:rank].T @ components
    touched_points = rotations @ tip + positions
    point = touched_points.mean(axis=0)
    return ToolTip(tip, point, touched_points - point, None if rank == 3 else axes[2])
