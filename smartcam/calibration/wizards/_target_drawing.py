"""Draw an SVG for a step that takes a picture of a target: found points and covered areas.

The background is the camera's picture, grey and reduced, since a page loads it at every step.
"""

from __future__ import annotations

import base64
import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.image import grey_image
from smartcam.calibration._svg import circle, document, line, polygon, rectangle, round_down, text
from smartcam.geometry._inside import Code, as_points

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import ArrayLike, NDArray

    from smartcam.calibration._sheet.plane import SheetPlane
    from smartcam.calibration._views import TargetView
    from smartcam.geometry._inside import Array

MAX_SIDE_PX: Final = 640
"""Largest width and height of the camera's picture in the preview, pixels."""

CELLS: Final = (6, 8)
"""Numbers of rows and columns of cells of an image; a calibration's views should cover all
cells."""

PICTURE_WIDTH: Final = 900.0
BORDER, HEAD_HEIGHT, FOOT_HEIGHT = 20.0, 40.0, 60.0
"""Margins of the preview, pixels: at each side, above and below the picture."""

LONGEST_RESIDUAL_SHARE: Final = 0.05
"""Approximate length of the longest drawn residual, as a share of the picture's width."""

END_TAG: Final = "</svg>"

STYLE: Final = """\
text { font: 13px sans-serif; fill: #333 } .title { font-size: 16px } .paper { fill: #fff }
.covered { fill: #2e8b57; fill-opacity: 0.25 } .point { fill: none; stroke: #1f5fbf; \
stroke-width: 1.5 }
.origin { fill: #1f5fbf } .residual { stroke: #c0392b; stroke-width: 1.5 }
.x { stroke: #c0392b; stroke-width: 3 } .y { stroke: #2e8b57; stroke-width: 3 }
.z { stroke: #1f5fbf; stroke-width: 3 }
.name { fill: #fff; stroke: #333; stroke-width: 3; paint-order: stroke }
.suggested { fill: none; stroke: #e67e22; stroke-width: 3; stroke-dasharray: 12 8 }"""


def cell_counts(views: Sequence[TargetView]) -> NDArray[np.intp]:
    """Count the points of one camera's views in each cell of its image, ``CELLS``."""
    counts = np.zeros(CELLS, dtype=np.intp)
    for view in views:
        # pixels have whole numbers at their centres, so the image's edge is at -0.5
        fractions = (view.points + 0.5) / view.size
        column, row = np.floor(fractions * CELLS[::-1]).astype(np.intp).T
        inside = (row >= 0) & (row < CELLS[0]) & (column >= 0) & (column < CELLS[1])
        np.add.at(counts, (row[inside], column[inside]), 1)
    return counts


def draw_preview(
    image: Any,
    *,
    view: TargetView | None = None,
    earlier: Sequence[TargetView] = (),
    predicted: ArrayLike | None = None,
    axes: ArrayLike | None = None,
    suggested: ArrayLike | None = None,
    title: str = "",
) -> str:
    """Draw a preview.

    Blue circles are found points; the filled circle is the target's origin. Green cells have points
    of some view. From each point a red line points to the place where the calibration predicts this
    point; the lines are enlarged by a factor that the preview names. Thick lines are the target's x
    (red), y (green) and z (blue). An orange outline shows the most useful next view.

    ``image``: uint8 or uint16, (H, W) or (H, W, 3) with blue, green, red. ``view``: view found in
    the image; None: no target was found. ``earlier``: the views before. ``predicted`` (N, 2):
    places where a calibration predicts the points of ``view``, pixels; None without a calibration.
    ``axes`` (4, 2): the target's origin and the ends of its x, y and z, pixels. ``suggested`` (M,
    2): outline of the target in the suggested next view, pixels. ``title``: a line on top.

    The SVG document has a fixed size and loads no other files; its text has line feeds. Raises
    SHAPE if there is no image, the view has another size, or an array another shape; NOT_FINITE.
    """
    grey = grey_image(image)
    if view is not None and view.size != grey.size:
        raise Code.SHAPE.error(
            f"preview: expected a view of an image of {grey.size[0]} x {grey.size[1]} pixels, "
            f"got one of {view.size[0]} x {view.size[1]}",
            grey.size,
            view.size,
        )
    canvas = _Canvas(*grey.size)
    width, height = PICTURE_WIDTH + 2 * BORDER, canvas.height + HEAD_HEIGHT + FOOT_HEIGHT
    counts = cell_counts([*earlier, view] if view is not None else earlier)
    lines = [
        f'<image x="{BORDER:.0f}" y="{HEAD_HEIGHT:.0f}" width="{PICTURE_WIDTH:.0f}" height="'
        f'{canvas.height:.2f}" href="data:image/png;base64,{_encode_png(grey.uint8_levels)}"/>',
        *canvas.draw_covered_cells(counts),
    ]
    summary = f"{len(view.ids)} of {len(view.target.points)} points" if view else "no target found"
    texts = [summary, _coverage_text(counts, earlier, view)]
    if suggested is not None:
        lines.append(canvas.draw_outline(as_points(suggested, 2, "suggested outline")))
    if view is not None and predicted is not None:
        residuals, caption = canvas.draw_residuals(view, _check_points(predicted, len(view.points)))
        lines += residuals
        texts.append(caption)
    if view is not None:
        lines += canvas.draw_points(view)
    if axes is not None:
        lines += canvas.draw_axes(_check_points(axes, 4))
    if title:
        lines.append(text((BORDER, 26), title, "title"))
    lines.append(text((BORDER, HEAD_HEIGHT + canvas.height + 24), "; ".join(texts)))
    return document(width, height, lines, STYLE)


def draw_sheet(image: Any, view: TargetView, plane: SheetPlane) -> str:
    """Return a picture with the target's points and the directions of the rays A and B, as SVG.

    ``plane``: map from the view's pixels to the sheet. Raises the errors of :func:`draw_preview`.
    """
    reach = view.target.points.max(axis=0)
    rays = plane.in_image([[0.0, 0.0], [reach[0], 0.0], [0.0, reach[1]]])
    origin, *ends = _Canvas(*view.size).to_preview(rays)
    parts: list[str] = []
    for (u, v), name, kind in zip(ends, "AB", "xy", strict=True):
        if np.isfinite([*origin, u, v]).all():
            large = ' style="font-size:26px"'
            parts += [line(origin, (u, v), kind), text((u + 8, v - 8), name, "name", large)]
    return _insert_parts(
        draw_preview(image, view=view, title="The sheet, its origin and rays"), parts
    )


def preview_coordinates(size: tuple[int, int], pixels: Array) -> Array:
    """Convert pixels (N, 2) to the SVG's coordinates in a picture of :func:`draw_preview`.

    ``size``: width and height of the camera's image, pixels.
    """
    return _Canvas(*size).to_preview(pixels)


def add_ring(svg: str, size: tuple[int, int], pixel: Array) -> str:
    """Return a picture of :func:`draw_sheet` with a ring around a pixel (2,), v down.

    ``size``: width and height of the camera's image, pixels.
    """
    return _insert_parts(svg, [circle(_Canvas(*size).to_preview(pixel), 24, "suggested")])


def _insert_parts(svg: str, parts: Sequence[str]) -> str:
    head, _, tail = svg.rpartition(END_TAG)
    return "\n".join([head.rstrip("\n"), *parts, END_TAG]) + tail


def _coverage_text(
    counts: NDArray[np.intp], earlier: Sequence[TargetView], view: TargetView | None
) -> str:
    views = len(earlier) + (view is not None)
    plural = "" if views == 1 else "s"
    return f"{np.count_nonzero(counts)} of {counts.size} cells seen by {views} view{plural}"


def _check_points(given: ArrayLike, count: int) -> Array:
    points = as_points(given, 2, "preview")
    if len(points) != count:
        raise Code.SHAPE.error_with_value(f"preview: expected {count} points", count, len(points))
    return points


def _encode_png(image: NDArray[np.uint8]) -> str:
    cv2 = load("cv2")
    height, width = image.shape
    factor = MAX_SIDE_PX / max(width, height)
    if factor < 1:
        size = (max(round(width * factor), 1), max(round(height * factor), 1))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".png", image)
    return base64.b64encode(encoded.tobytes()).decode()


class _Canvas:
    """The map from an image's pixels to the preview."""

    def __init__(self, width: int, height: int) -> None:
        self.zoom = PICTURE_WIDTH / width
        self.height = height * self.zoom

    def to_preview(self, pixels: Array) -> Array:
        """Map pixels (..., 2) to the preview's coordinates."""
        places: Array = (pixels + 0.5) * self.zoom + [BORDER, HEAD_HEIGHT]
        return places

    def draw_covered_cells(self, counts: NDArray[np.intp]) -> Iterator[str]:
        rows, columns = counts.shape
        width, height = PICTURE_WIDTH / columns, self.height / rows
        for row, column in np.argwhere(counts).tolist():
            corner = (BORDER + column * width, HEAD_HEIGHT + row * height)
            yield rectangle(corner, (width, height), 'class="covered"')

    def draw_points(self, view: TargetView) -> Iterator[str]:
        for number, place in zip(view.ids.tolist(), self.to_preview(view.points), strict=True):
            yield circle(place, 5, "point" if number else "point origin")

    def draw_residuals(self, view: TargetView, predicted: Array) -> tuple[list[str], str]:
        """Return the lines, and the text that explains them."""
        residuals = predicted - view.points
        lengths = np.linalg.norm(residuals, axis=1)
        factor = _enlargement(float(lengths.max(initial=0.0)) * self.zoom)
        ends = self.to_preview(view.points + factor * residuals)
        lines = [
            line(start, end, "residual")
            for start, end in zip(self.to_preview(view.points), ends, strict=True)
        ]
        rms = math.sqrt(float(np.mean(lengths**2))) if len(lengths) else 0.0
        return lines, f"residuals (red) {factor:g} times larger than they are, {rms:.3f} px rms"

    def draw_axes(self, axes: Array) -> Iterator[str]:
        origin, *ends = self.to_preview(axes)
        for end, name in zip(ends, "xyz", strict=True):
            yield line(origin, end, name)
            yield text((end[0] + 6, end[1] + 4), name, "name")

    def draw_outline(self, corners: Array) -> str:
        return polygon(self.to_preview(corners), "suggested")


def _enlargement(longest: float) -> float:
    """Return a factor, 1, 2 or 5 times a power of ten, that makes the longest residual visible."""
    if not longest > 1e-6:
        return 1.0
    return round_down(LONGEST_RESIDUAL_SHARE * PICTURE_WIDTH / longest)
