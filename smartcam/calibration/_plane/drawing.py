"""Draw a plane calibration as SVG: the touched points, their residuals, the predicted error.

The picture shows the camera's plane as the camera sees it, x to the right and y up. Errors are too
small to see, so residuals and ellipses are enlarged by a factor that the picture names.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam.calibration._svg import circle, document, line, polygon, rectangle, round_down, text

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from smartcam.calibration._plane.calibration import PlaneCalibration
    from smartcam.geometry._inside import Array
    from smartcam.models import Localization

PLOT_WIDTH_PX: Final = 900.0
"""Width of the plot area, pixels; its height follows from the points."""

BORDER_PX: Final = 60.0
LEGEND_HEIGHT_PX: Final = 130.0
"""Height of the legend below the plot, pixels."""

MARGIN_RATIO: Final = 0.15
"""Free margin around the points, as a fraction of their extent."""

HEAT_COLUMNS: Final = 30
"""Number of columns of the heat map; it has at most twice as many rows, to keep cells square."""

ELLIPSE_SIGMAS: Final = math.sqrt(-2.0 * math.log(0.05))
"""Radius, in standard deviations, that holds 95 % of a normal distribution in a plane."""

ELLIPSE_POINTS: Final = 24
"""An ellipse is drawn with this many points."""

MIN_ENLARGED_RATIO: Final = 1e-9
"""Errors below this fraction of the plot's width are not enlarged."""

LOW_ERROR_COLOUR, HIGH_ERROR_COLOUR = (240, 247, 252), (246, 196, 140)
"""Colours of the smallest and the largest predicted error."""

STYLE: Final = """\
.paper { fill: #fff }
marker { overflow: visible } text { font: 13px sans-serif; fill: #333 } .title { font-size: 16px }
.camera { stroke: #777; fill: none; stroke-width: 2 } .robot { stroke: #1f5fbf; fill: none; \
stroke-width: 2 }
.camera-name { fill: #777 } .robot-name { fill: #1f5fbf }
.touch { fill: #333 } .residual { stroke: #c0392b; stroke-width: 1.5 }
.left-out { stroke: #777; stroke-width: 1.5 }
.ellipse { fill: none; stroke: #7d3c98 } .part { stroke: #0b7a4b; fill: none; stroke-width: 1.5 }
.part-name { fill: #0b7a4b }"""

ARROW_HEADS: Final = "".join(
    f'<marker id="{kind}-head" refX="8" refY="4" orient="auto" '
    f'markerUnits="userSpaceOnUse"><path d="M0 0 L8 4 L0 8" class="{kind}"/></marker>'
    for kind in ("camera", "robot")
)
"""SVG markers for the heads of the axes' arrows."""


class _DrawnPlane:
    """The plot area: the drawn part of the camera's plane, and its map to pixels of the picture.

    Args:
        visible_points: (N, 2), points that must be inside of the drawn part.
    """

    def __init__(self, visible_points: Array) -> None:
        low, high = visible_points.min(axis=0), visible_points.max(axis=0)
        margin = MARGIN_RATIO * float((high - low).max())
        self.low: Array = low - margin
        self.high: Array = high + margin
        width, height = (self.high - self.low).tolist()
        self.zoom: float = PLOT_WIDTH_PX / width
        self.height: float = height * self.zoom
        self.legend_top: float = 2 * BORDER_PX + self.height

    def pixels(self, points: Array) -> Array:
        """Map points (..., 2) to pixels."""
        corner = np.array([BORDER_PX, BORDER_PX + self.height])
        pixels: Array = corner + (points - self.low) * self.zoom * [1.0, -1.0]
        return pixels


def draw(
    calibration: PlaneCalibration, parts: Iterable[Localization] = (), *, title: str = ""
) -> str:
    """Return a picture of a calibration.

    The camera's axes are grey, the robot's axes, projected into the plane, are blue: an axis that
    rises from the plane is drawn shorter. Touched points are black; the red line from each is its
    residual. The background shows the predicted error, and violet ellipses hold 95 % of
    the errors. Both are missing if the touches' sigma is not known. Points that a robust fit left
    out are grey crosses without residual and ellipse; one that lies far beyond the others is not
    shown.

    ``parts`` are localizations in the camera's frame, drawn in green. ``title`` is a line on top.
    The SVG document has a fixed width and loads no other file; its lines end with line feeds.
    """
    part_list = list(parts)
    is_used = calibration.weights > 0.0
    points, left_out = calibration.camera_points[is_used], calibration.camera_points[~is_used]
    part_places = np.array([part.pose.position[:2] for part in part_list]).reshape(-1, 2)
    points_and_parts = np.concatenate([points, part_places])
    low, high = points_and_parts.min(axis=0), points_and_parts.max(axis=0)
    is_near = (np.abs(left_out - (low + high) / 2) < high - low).all(axis=1)
    plot = _DrawnPlane(np.concatenate([points_and_parts, left_out[is_near]]))
    residuals = calibration.inverse(calibration.robot_points[is_used]) - points
    outlines = _ellipse_outlines(calibration, points_and_parts)
    vectors = np.concatenate([residuals, outlines[: len(points)].reshape(-1, 2)])
    largest = plot.zoom * float(np.linalg.norm(vectors, axis=1).max())
    enlargement = (
        round_down(0.06 * PLOT_WIDTH_PX / largest)
        if largest > MIN_ENLARGED_RATIO * PLOT_WIDTH_PX
        else 1.0
    )
    shapes = [
        f"<defs>{ARROW_HEADS}</defs>",
        *_heat_map(calibration, plot),
        *_axes(calibration, plot),
        *(
            polygon(plot.pixels(outline), "ellipse")
            for outline in points_and_parts[: len(outlines), None] + enlargement * outlines
        ),
        *_touch_marks(calibration, plot, points + enlargement * residuals),
        *(
            _part_mark(part, place)
            for part, place in zip(part_list, plot.pixels(part_places), strict=True)
        ),
        *_legend(calibration, plot, enlargement, title),
    ]
    return document(
        PLOT_WIDTH_PX + 2 * BORDER_PX, plot.legend_top + LEGEND_HEIGHT_PX, shapes, STYLE
    )


def _ellipse_outlines(calibration: PlaneCalibration, points: Array) -> Array:
    """Return the outlines of the 95 % ellipses around points, in the camera's plane.

    The outlines are (N, ELLIPSE_POINTS, 2), relative to each point; empty if the touches' sigma is
    not known.
    """
    if calibration.touch_sigma is None:
        return np.zeros((0, ELLIPSE_POINTS, 2))
    plane_axes = calibration.rotation[:, :2]
    covariances = plane_axes.T @ calibration.covariance_at(points) @ plane_axes
    values, vectors = np.linalg.eigh(covariances)
    lengths = ELLIPSE_SIGMAS * np.sqrt(np.maximum(values, 0.0))
    # an eigenvector's sign is arbitrary; the symmetric root does not depend on it
    roots = (vectors * lengths[:, None, :]) @ vectors.swapaxes(1, 2)
    angles = np.linspace(0.0, math.tau, ELLIPSE_POINTS, endpoint=False)
    unit_circle = np.stack([np.cos(angles), np.sin(angles)])
    outlines = (roots @ unit_circle).swapaxes(1, 2) @ plane_axes.T  # metres in the robot's space
    centres = calibration.transform(points)
    camera_points = calibration.inverse((centres[:, None] + outlines).reshape(-1, 3))
    return camera_points.reshape(len(points), ELLIPSE_POINTS, 2) - points[:, None]


def _heat_map(calibration: PlaneCalibration, plot: _DrawnPlane) -> Iterator[str]:
    """Yield the predicted error as coloured cells."""
    if calibration.touch_sigma is None:
        return
    cell = PLOT_WIDTH_PX / HEAT_COLUMNS
    rows = min(2 * HEAT_COLUMNS, max(1, round(plot.height / cell)))
    height = plot.height / rows
    corners = [[x * cell, y * height] for y in range(rows) for x in range(HEAT_COLUMNS)]
    centres = np.array(corners) + np.array([cell / 2, height / 2])
    camera_points = (
        plot.low + np.column_stack([centres[:, 0], plot.height - centres[:, 1]]) / plot.zoom
    )
    errors = calibration.predicted_error(camera_points)
    low, high = float(errors.min()), float(errors.max())
    fractions = (errors - low) / (high - low) if high > low else np.zeros_like(errors)
    yield '<g shape-rendering="crispEdges">'
    for (x, y), fraction in zip(corners, fractions.tolist(), strict=True):
        yield _cell(BORDER_PX + x, BORDER_PX + y, cell, height, fraction)
    yield "</g>"
    for step in range(11):
        yield _cell(BORDER_PX + 20 * step, plot.legend_top + 45, 20, 14, step / 10)
    label = f"predicted error: {1e3 * low:.3f} mm to {1e3 * high:.3f} mm rms"
    yield _text((BORDER_PX + 232, plot.legend_top + 57), label)


def _cell(x: float, y: float, width: float, height: float, fraction: float) -> str:
    """Return a cell, in one of 21 colours, so that rounding errors do not change the picture."""
    level = round(20 * fraction) / 20
    channels = (
        round(a + level * (b - a)) for a, b in zip(LOW_ERROR_COLOUR, HIGH_ERROR_COLOUR, strict=True)
    )
    colour = "".join(f"{channel:02x}" for channel in channels)
    return rectangle((x, y), (width, height), f'fill="#{colour}"')


def _axes(calibration: PlaneCalibration, plot: _DrawnPlane) -> Iterator[str]:
    """Yield the axes of the camera and of the robot.

    The camera's axes are at its origin if the origin is in the picture, else at a corner. The
    robot's axes, projected into the plane, are below the plot's lower right corner.
    """
    start = plot.pixels(np.clip(np.zeros(2), plot.low, plot.high))
    yield from _axis(start, np.array([70.0, 0.0]), "camera", "camera x")
    yield from _axis(start, np.array([0.0, -70.0]), "camera", "y")
    start = np.array([BORDER_PX + PLOT_WIDTH_PX - 90, plot.legend_top + 35])
    for axis, name in zip(calibration.rotation[:, :2], ("robot x", "y", "z"), strict=True):
        if np.linalg.norm(axis) < 0.05:  # the axis is at a right angle to the plane
            yield circle(start, 4, "robot")
            yield _text(start, name, "robot-name", offset=(7, 15))
        else:
            yield from _axis(start, 60 * axis * [1, -1], "robot", name)


def _axis(start: Array, vector: Array, css_class: str, name: str) -> Iterator[str]:
    end = start + vector
    yield line(start, end, css_class, f' marker-end="url(#{css_class}-head)"')
    yield _text(end + 8 * vector / np.linalg.norm(vector), name, f"{css_class}-name", offset=(0, 4))


def _touch_marks(calibration: PlaneCalibration, plot: _DrawnPlane, ends: Array) -> Iterator[str]:
    is_used = calibration.weights > 0.0
    places = plot.pixels(calibration.camera_points)
    numbers = np.flatnonzero(is_used)
    for number, place, end in zip(numbers, places[is_used], plot.pixels(ends), strict=True):
        yield line(place, end, "residual")
        yield circle(place, 4, "touch")
        yield _text(place, str(1 + number), offset=(7, -7))
    for index in calibration.outliers:
        point, place = calibration.camera_points[index], places[index]
        if (point > plot.low).all() and (point < plot.high).all():
            for diagonal in (np.array([5.0, 5.0]), np.array([5.0, -5.0])):
                yield line(place - diagonal, place + diagonal, "left-out")
            yield _text(place, str(1 + index), offset=(7, -7))


def _part_mark(part: Localization, place: Array) -> str:
    theta = part.pose.orientation.theta
    direction = 18 * np.array([math.cos(theta), -math.sin(theta)])
    name = _text(place, part.feature_id, "part-name", offset=(10, 20))
    return circle(place, 7, "part") + line(place, place + direction, "part") + name


def _legend(
    calibration: PlaneCalibration, plot: _DrawnPlane, enlargement: float, title: str
) -> Iterator[str]:
    if title:
        yield _text((BORDER_PX, 30), title, "title")
    error, count = calibration.held_out_error, len(calibration.camera_points)
    left_out = len(calibration.outliers)
    yield _text(
        (BORDER_PX, plot.legend_top),
        f"{calibration.model}, {f'{count - left_out} of ' if left_out else ''}{count} touches; "
        f"held-out error {'not known' if error is None else f'{1e3 * error:.3f} mm rms'}",
    )
    yield _text(
        (BORDER_PX, plot.legend_top + 25),
        f"residuals (red) and 95 % ellipses (violet) {enlargement:g} times larger than they are"
        f"{'; crosses: left out' if left_out else ''}",
    )
    per_metre = plot.zoom / calibration.scale
    metres = round_down(0.2 * PLOT_WIDTH_PX / per_metre)
    end = np.array([BORDER_PX + PLOT_WIDTH_PX - 220, plot.legend_top])
    start = end - [metres * per_metre, 0.0]
    yield line(start, end, "camera")
    yield _text(start, f"{1e3 * metres:g} mm", offset=(0, 18))


def _text(
    place: Array | tuple[float, float],
    label: str,
    css_class: str = "",
    *,
    offset: tuple[float, float] = (0.0, 0.0),
) -> str:
    return text((place[0] + offset[0], place[1] + offset[1]), label, css_class)
