"""Make previews of a wizard's touches: JSON data, in metres, for a front-end to draw.

Touches without a calibration are drawn in the camera's frame; others are drawn along the axes of
the plane, from the centre of the touches that the calibration was made from.
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
"""Width of the border around the drawn points, as a part of their extent."""


def plain(touches: Sequence[Touch]) -> dict[str, Any]:
    """Return touches without a calibration: ``points`` of ``label, feature, camera, robot``."""
    points = [
        {
            "label": str(number) if touch.what == "mark" else touch.what,
            "feature": touch.mark.feature,
            "camera": [touch.mark.x, touch.mark.y],
            "robot": list(touch.robot),
        }
        for number, touch in enumerate(touches, 1)
    ]
    return {"points": points}


def before(touches: Sequence[Touch], marks: Sequence[Mark], mark: Mark) -> dict[str, Any] | None:
    """Return touches with the ``marks`` of a picture and the mark to touch ``next``.

    None if no marks are given, since the camera does not see the next point.
    """
    if not marks:
        return None
    return {
        **plain(touches),
        "marks": [[other.x, other.y] for other in marks],
        "next": [mark.x, mark.y],
    }


def compared(
    calibration: PlaneCalibration,
    touches: Sequence[Touch],
    seen: Array,
    offsets: Array,
    held_out: Array | None = None,
    *,
    worst: int,
    left_out: Collection[int] = (),
) -> dict[str, Any]:
    """Return touches compared with a calibration.

    ``seen`` (N, 2): camera points of the touches. ``offsets`` (N, 3): touched minus mapped, metres;
    ``held_out`` (N, 3): touched minus predicted by the other touches; NaN or None: not known.
    ``worst``: index of the worst touch. ``left_out``: indices of the touches that do not count.

    The result is that of :func:`plain`, each point with ``at``, ``residual``, ``left_out``,
    ``held_out`` (or None) and ``covariance`` (2 x 2, of the mapped point; None if no sigma is
    known); ``worst``, ``camera_origin``, ``robot_axes``; ``view``, the lower left and upper right
    corner of the drawn area; ``heat``, rows of predicted errors in mm that cover the view, the
    lowest row first, or None.
    """
    preview = plain(touches)
    across = calibration.rotation.T
    counted = calibration.robot_points[calibration.weights > 0.0]
    centre = counted.mean(axis=0)
    errors = None if calibration.touch_sigma is None else calibration.covariance_at(seen)
    for index, point in enumerate(preview["points"]):
        without = None if held_out is None else (across @ held_out[index]).tolist()
        out = index in left_out
        point["at"] = (across @ (touches[index].robot - centre)).tolist()
        point["residual"] = (across @ offsets[index]).tolist()
        point["left_out"] = out
        point["held_out"] = None if out or without is None or math.isnan(sum(without)) else without
        point["covariance"] = (
            None if out or errors is None else (across @ errors[index] @ across.T)[:2, :2].tolist()
        )
    origin = across @ (calibration.origin - centre)
    at = np.array([touch.robot for touch in touches]).reshape(-1, 3)
    is_left_out = np.isin(np.arange(len(at)), [*left_out])
    view = _view(
        across @ (np.concatenate([counted, at[~is_left_out]]) - centre).T,
        np.column_stack([origin, across @ (at[is_left_out] - centre).T]),
    )
    return {
        **preview,
        "worst": worst,
        "camera_origin": origin.tolist(),
        "robot_axes": across.T.tolist(),
        "view": view.tolist(),
        "heat": None if errors is None else _heat(calibration, view, across, centre),
    }


def _view(points: Array, others: Array) -> Array:
    """Return the corners of the area with the points (3, N), and those of others (3, K) nearby."""
    low, high = points[:2].min(axis=1), points[:2].max(axis=1)
    half = 0.5 * (high - low)
    flat = others[:2].T
    visible = flat[((flat > low - half) & (flat < high + half)).all(axis=1)]
    shown = np.vstack([low, high, visible])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = MARGIN_RATIO * float((high - low).max())
    return np.array([low - margin, high + margin])


def _heat(
    calibration: PlaneCalibration, view: Array, across: Array, centre: Array
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
        seen = calibration.inverse(middles @ across[:2] + centre)
        errors = calibration.predicted_error(seen)
    except CalibrationError:  # a part of the view is beyond the camera's horizon
        return None
    table: list[list[float]] = np.round(1e3 * errors, 5).reshape(rows, columns).tolist()
    return table
