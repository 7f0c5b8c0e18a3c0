"""Draw the marks of a program's tools into the picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._extras import load
from smartcam.frames._inside import COLOURS, stroke_width

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.frames._inside import Drawing
    from smartcam.inspection._finding import Inspection

_SHIFT: Final = 4  # OpenCV's coordinates in 1/16 pixel


def draw(inspection: Inspection) -> NDArray[Any]:
    """Return an inspection's picture with the marks of its tools, (H, W, 3), uint8, red first."""
    canvas = inspection.picture.rgb.copy()
    thick = stroke_width(*inspection.picture.size)
    for mark in inspection.drawings:
        _draw_mark(canvas, mark, thick)
    return canvas


def _draw_mark(canvas: NDArray[Any], mark: Drawing, thick: int) -> None:
    cv2 = load("cv2", "inspection needs")
    colour = COLOURS[mark.role]
    if not mark.points or not np.isfinite(mark.points).all():
        return
    limit = 4.0 * max(canvas.shape)  # keeps OpenCV's coordinates within 32 bits
    points = np.clip(np.asarray(mark.points, np.float64), -limit, limit)
    fixed_point = np.rint(points * (1 << _SHIFT)).astype(np.int32)
    if mark.kind in ("line", "polygon"):
        closed = mark.kind == "polygon"
        cv2.polylines(canvas, [fixed_point], closed, colour, thick, cv2.LINE_AA, _SHIFT)
    elif mark.kind == "points":
        for x, y in fixed_point:
            cv2.circle(canvas, (int(x), int(y)), 3 * thick << _SHIFT, colour, thick, 16, _SHIFT)
    if mark.text:
        x, y = points[0]
        _draw_text(canvas, mark.text, (int(x) + 4 * thick, int(y) - 4 * thick), colour, thick)


def _draw_text(
    canvas: NDArray[Any],
    text: str,
    place: tuple[int, int],
    colour: tuple[int, int, int],
    thick: int,
) -> None:
    cv2 = load("cv2", "inspection needs")
    ascii_text = text[:120].encode("ascii", "replace").decode()
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * thick
    cv2.putText(canvas, ascii_text, place, font, size, (0, 0, 0), thick + 2, cv2.LINE_AA)
    cv2.putText(canvas, ascii_text, place, font, size, colour, thick, cv2.LINE_AA)
