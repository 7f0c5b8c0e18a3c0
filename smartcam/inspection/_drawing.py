"""Draw the findings of a program's tools into their picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._extras import load
from smartcam.frames._inside import COLOURS, stroke_width

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.frames._inside import Drawing
    from smartcam.inspection._finding import Inspection

_SHIFT: Final = 4  # OpenCV draws at sixteenths of a pixel


def draw(inspection: Inspection) -> NDArray[Any]:
    """Return an inspection's picture with the marks of its tools, (H, W, 3), uint8, red first."""
    canvas = inspection.picture.rgb.copy()
    thick = stroke_width(*inspection.picture.size)
    for mark in inspection.drawings:
        _draw(canvas, mark, thick)
    return canvas


def _draw(canvas: NDArray[Any], mark: Drawing, thick: int) -> None:
    cv2 = load("cv2", "inspection needs")
    colour = COLOURS[mark.role]
    if not mark.points or not np.isfinite(mark.points).all():
        return
    limit = 4.0 * max(canvas.shape)  # OpenCV's coordinates are integers of 32 bits
    places = np.clip(np.asarray(mark.points, np.float64), -limit, limit)
    fixed = np.rint(places * (1 << _SHIFT)).astype(np.int32)
    if mark.kind in ("line", "polygon"):
        closed = mark.kind == "polygon"
        cv2.polylines(canvas, [fixed], closed, colour, thick, cv2.LINE_AA, _SHIFT)
    elif mark.kind == "points":
        for x, y in fixed:
            cv2.circle(canvas, (int(x), int(y)), 3 * thick << _SHIFT, colour, thick, 16, _SHIFT)
    if mark.text:
        x, y = places[0]
        _write(canvas, mark.text, (int(x) + 4 * thick, int(y) - 4 * thick), colour, thick)


def _write(
    canvas: NDArray[Any],
    text: str,
    place: tuple[int, int],
    colour: tuple[int, int, int],
    thick: int,
) -> None:
    cv2 = load("cv2", "inspection needs")
    plain = text[:120].encode("ascii", "replace").decode()
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * thick
    cv2.putText(canvas, plain, place, font, size, (0, 0, 0), thick + 2, cv2.LINE_AA)
    cv2.putText(canvas, plain, place, font, size, colour, thick, cv2.LINE_AA)
