"""The picture of a sheet that the wizard shows: what was found, the rays, the point to touch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam.calibration.wizards.target_drawing import BORDER, HEAD, WIDTH, draw

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.sheet.plane import SheetPlane
    from smartcam.calibration.views import TargetView

__all__ = ["draw_sheet", "with_ring"]

END: Final = "</svg>"


def draw_sheet(image: Any, view: TargetView, plane: SheetPlane) -> str:
    """Return a picture with the target's points and the directions of the rays A and B, as SVG.

    Args:
        image: as :func:`~smartcam.calibration.wizards.target_drawing.draw` takes it.
        view: what was found in it.
        plane: from its pixels to the sheet.

    Raises:
        CalibrationError: as :func:`~smartcam.calibration.wizards.target_drawing.draw`.
    """
    reach = view.target.points.max(axis=0)
    ends = plane.in_image([[0.0, 0.0], [reach[0], 0.0], [0.0, reach[1]]])
    places = _places(ends, view.size)
    parts: list[str] = []
    for end, name, kind in ((places[1], "A", "x"), (places[2], "B", "y")):
        if np.isfinite([*places[0], *end]).all():
            (x, y), (u, v) = places[0].tolist(), end.tolist()
            parts += [
                f'<line x1="{x:.2f}" y1="{y:.2f}" x2="{u:.2f}" y2="{v:.2f}" class="{kind}"/>',
                f'<text x="{u + 8:.2f}" y="{v - 8:.2f}" class="name" style="font-size:26px">'
                f"{name}</text>",
            ]
    return _with(draw(image, view=view, title="The sheet, its origin and rays"), parts)


def with_ring(svg: str, size: tuple[int, int], pixel: Array) -> str:
    """Return a picture of :func:`draw_sheet` with a ring around a pixel.

    Args:
        svg: the picture.
        size: width and height of the camera's image, pixels.
        pixel: (2,), v down.
    """
    x, y = _places(pixel.reshape(1, 2), size)[0].tolist()
    return _with(svg, [f'<circle cx="{x:.2f}" cy="{y:.2f}" r="24" class="suggested"/>'])


def _places(pixels: Array, size: tuple[int, int]) -> Array:
    places: Array = (pixels + 0.5) * (WIDTH / size[0]) + [BORDER, HEAD]
    return places


def _with(svg: str, parts: Sequence[str]) -> str:
    head, _, tail = svg.rpartition(END)
    return "\n".join([head.rstrip("\n"), *parts, END]) + tail
