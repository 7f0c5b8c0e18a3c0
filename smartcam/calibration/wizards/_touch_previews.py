"""Make previews of a wizard's touches: JSON data, in metres, for a front-end to draw.

A touch is a point that the robot's tip touched, with what the camera sees there.

Touches without a calibration are drawn in the camera's frame. Touches with a calibration are drawn
along the axes of the plane; the centre is the mean of the calibration's own touches.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from smartcam.calibration._plane.calibration import PlaneCalibration
    from smartcam.calibration.wizards._marks import Mark, Touch
    from smartcam.geometry._inside import Array

HEAT_MAP_CELLS = 24
"""Number of cells of the heat map along its longer side."""

MARGIN_RATIO = 0.25
"""Width of the border around the drawn points, as a share of the points' extent."""


def touch_points(touches: Sequence[Touch]) -> dict[str, Any]:
    """Return touches without a calibration: ``points`` of ``label, feature, camera, robot``."""
    points = [
        {
            "label": str(number) if touch.label == "mark" else touch.label,
            "feature": touch.mark.feature,
            "camera": [touch.mark.x, touch.mark.y],
            "robot": list(touch.robot),
        }
        for number, touch in enumerate(touches, 1)
    ]
    return {"points": points}


def next_touch_preview(
    touches: Sequence[Touch], marks: Sequence[Mark], mark: Mark
) -> dict[str, Any] | None:
    """Return touches with the ``marks`` of a picture and the mark to touch ``next``.

    The result is None without marks, since then the camera does not see the next point.
    """
    if not marks:
        return None
    return {
        **touch_points(touches),
        "marks": [[other.x, other.y] for other in marks],
        "next": [mark.x, mark.y],
    }


def compare_touches(
    calibration: PlaneCalibration,
    touches: Sequence[Touch],
    seen: Array,
    offsets: Array,
    held_out: Array | None = None,
    *,
    worst: int,
    excluded: Collection[int] = (),
) -> dict[str, Any]:
    """Return touches compared with a calibration.

    ``seen`` (N, 2): camera points of the touches. ``offsets`` (N, 3): touched minus mapped, metres;
    ``held_out`` (N, 3): touched minus predicted by the other touches; NaN or None: not known.
    ``worst``: index of the worst touch. ``excluded``: indices of the touches that do not count.

    The result has the entries of :func:`touch_points`, each point also with ``at``, ``residual``,
    ``left_out``, ``held_out`` (or None) and ``covariance`` (2 x 2, of the mapped point; None if no
    sigma is known); ``worst``, ``camera_origin``, ``robot_axes``; ``view``, the lower left and
    upper right corner of the drawn area; ``heat``, rows of predicted errors in mm that cover the
    view, the lowest row first, or None.
    """
    preview = touch_points(touches)
    to_plane = calibration.rotation.T
    counted = calibration.robot_points[calibration.weights > 0.0]
    centre = counted.mean(axis=0)
    errors = None if calibration.touch_sigma is None else calibration.covariance_at(seen)
    for index, point in enumerate(preview["points"]):
        held_out_offset = None if held_out is None else (to_plane @ held_out[index]).tolist()
        is_excluded = index in excluded
        point["at"] = (to_plane @ (touches[index].robot - centre)).tolist()
        point["residual"] = (to_plane @ offsets[index]).tolist()
        point["left_out"] = is_excluded
        point["held_out"] = (
            None
            if is_excluded or held_out_offset is None or math.isnan(sum(held_out_offset))
            else held_out_offset
        )
        point["covariance"] = (
            None
            if is_excluded or errors is None
            else (to_plane @ errors[index] @ to_plane.T)[:2, :2].tolist()
        )
    origin = to_plane @ (calibration.origin - centre)
    positions = np.array([touch.robot for touch in touches]).reshape(-1, 3)
    is_left_out = np.isin(np.arange(len(positions)), [*excluded])
    view = _drawn_area(
        to_plane @ (np.concatenate([counted, positions[~is_left_out]]) - centre).T,
        np.column_stack([origin, to_plane @ (positions[is_left_out] - centre).T]),
    )
    return {
        **preview,
        "worst": worst,
        "camera_origin": origin.tolist(),
        "robot_axes": to_plane.T.tolist(),
        "view": view.tolist(),
        "heat": None if errors is None else _heat_map(calibration, view, to_plane, centre),
    }


def _drawn_area(points: Array, others: Array) -> Array:
    """Return two corners of an area with all points (3, N), and with nearby ``others`` (3, K)."""
    low, high = points[:2].min(axis=1), points[:2].max(axis=1)
    half = 0.5 * (high - low)
    other_points = others[:2].T
    visible = other_points[((other_points > low - half) & (other_points < high + half)).all(axis=1)]
    drawn_points = np.vstack([low, high, visible])
    low, high = drawn_points.min(axis=0), drawn_points.max(axis=0)
    margin = MARGIN_RATIO * float((high - low).max())
    return np.array([low - margin, high + margin])


def _heat_map(
    calibration: PlaneCalibration, view: Array, to_plane: Array, centre: Array
) -> list[list[float]] | None:
    """Return the predicted errors at the centres of the view's cells, mm."""
    low, extent = view[0], view[1] - view[0]
    columns, rows = (
        np.maximum(1, np.round(HEAT_MAP_CELLS * extent / extent.max())).astype(int).tolist()
    )
    x = low[0] + extent[0] * (np.arange(columns) + 0.5) / columns
    y = low[1] + extent[1] * (np.arange(rows) + 0.5) / rows
    middles = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    try:
        seen = calibration.inverse(middles @ to_plane[:2] + centre)
        errors = calibration.predicted_error(seen)
    except CalibrationError:  # a part of the view is beyond the camera's horizon
        return None
    table: list[list[float]] = np.round(1e3 * errors, 5).reshape(rows, columns).tolist()
    return table
