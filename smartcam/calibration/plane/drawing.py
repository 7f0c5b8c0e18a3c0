"""A picture of a plane calibration, as SVG: what was touched, how well it fits, how good it is.

It shows the camera's plane as the camera sees it, x to the right and y up. Errors are far too small
to be seen, so residuals and ellipses are drawn larger, by a factor that the picture names.
"""

from __future__ import annotations

import math
from html import escape
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.plane.calibration import PlaneCalibration
    from smartcam.models import Localization

__all__ = ["draw"]

WIDTH: Final = 900.0
"""Of the field, pixels; the height follows from the points."""

BORDER: Final = 60.0
FOOT: Final = 130.0
"""Pixels around the field, and for the legend below it."""

MARGIN: Final = 0.15
"""Of the extent of what is shown, around it."""

COLUMNS: Final = 30
"""Cells of the heat map across; as many down as make them square, at most twice that."""

ELLIPSE: Final = math.sqrt(-2.0 * math.log(0.05))
"""Standard deviations in which 95 % of a plane's normal distribution lie."""

OUTLINE: Final = 24
"""Points of an ellipse."""

LOW, HIGH = (240, 247, 252), (246, 196, 140)
"""Colours of the smallest and the largest predicted error."""

STYLE: Final = """\
text { font: 13px sans-serif; fill: #333 } .title { font-size: 16px }
.camera { stroke: #777; fill: none; stroke-width: 2 } .robot { stroke: #1f5fbf; fill: none; \
stroke-width: 2 }
.camera-name { fill: #777 } .robot-name { fill: #1f5fbf }
.touch { fill: #333 } .residual { stroke: #c0392b; stroke-width: 1.5 }
.left-out { stroke: #777; stroke-width: 1.5 }
.ellipse { fill: none; stroke: #7d3c98 } .part { stroke: #0b7a4b; fill: none; stroke-width: 1.5 }
.part-name { fill: #0b7a4b }"""


class _View(NamedTuple):
    """How the camera's plane becomes pixels of the picture."""

    low: Array
    high: Array
    zoom: float

    @property
    def height(self) -> float:
        return float((self.high - self.low)[1]) * self.zoom

    def pixels(self, points: Array) -> Array:
        """Return points (N, 2) in pixels."""
        x, y = ((points - self.low) * self.zoom).T
        return np.column_stack([BORDER + x, BORDER + self.height - y])


def draw(
    calibration: PlaneCalibration, parts: Iterable[Localization] = (), *, title: str = ""
) -> str:
    """Return a picture of a calibration.

    Grey is the camera's frame, blue the directions of the robot's axes as they lie in the plane:
    the longer, the flatter they lie. Black points were touched; from each a red line goes to where
    the touch says that it is, its residual. The background is the predicted error, violet ellipses
    hold 95 % of it. Where nothing tells how well points were touched, both are missing. Points that
    a robust fit left out are grey crosses, without residual and ellipse; one that lies far beyond
    the others is not shown.

    Args:
        calibration: what is shown.
        parts: localizations in the camera's frame that are shown, too, in green.
        title: a line on top.

    Returns:
        An SVG document with a size of its own and no parts elsewhere; lines end with a line feed.
    """
    found = list(parts)
    view = _view(calibration, np.array([part.pose.position[:2] for part in found]).reshape(-1, 2))
    larger = _enlargement(calibration, view)
    width, height = WIDTH + 2 * BORDER, view.height + 2 * BORDER + FOOT
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
        f'viewBox="0 0 {width:.0f} {height:.0f}">',
        f"<style>{STYLE}</style>",
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#fff"/>',
        *_heat(calibration, view),
        *_camera_frame(view),
        *_robot_frame(calibration, view),
        *_touches(calibration, view, larger),
        *_parts(calibration, view, larger, found),
        *_legend(calibration, view, larger, title),
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _view(calibration: PlaneCalibration, parts: Array) -> _View:
    shown = np.concatenate([_counted(calibration), parts])
    low, high = shown.min(axis=0), shown.max(axis=0)
    half, others = 0.5 * (high - low), calibration.camera_points[[*calibration.outliers]]
    near = others[((others > low - half) & (others < high + half)).all(axis=1)]
    shown = np.concatenate([shown, near])
    low, high = shown.min(axis=0), shown.max(axis=0)
    margin = MARGIN * float((high - low).max())
    low, high = low - margin, high + margin
    return _View(low, high, WIDTH / float((high - low)[0]))


def _enlargement(calibration: PlaneCalibration, view: _View) -> float:
    """Return 1, 2 or 5 times a power of ten, by which the errors become well visible."""
    sizes = np.linalg.norm(_residuals(calibration), axis=1) * view.zoom
    if calibration.touch_sigma is not None:
        ellipses = _ellipses(calibration, _counted(calibration)) * view.zoom
        sizes = np.concatenate([sizes, np.linalg.norm(ellipses, axis=2).max(axis=1)])
    largest = float(sizes.max())
    if not largest > 1e-9 * WIDTH:
        return 1.0
    wanted = 0.06 * WIDTH / largest
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))


def _counted(calibration: PlaneCalibration) -> Array:
    """Return the camera's points that the calibration was made of, (N, 2)."""
    counted: Array = calibration.camera_points[calibration.weights > 0.0]
    return counted


def _residuals(calibration: PlaneCalibration) -> Array:
    """Return the residuals of the points that count as the camera would see them, (N, 2)."""
    touched: Array = calibration.inverse(calibration.robot_points[calibration.weights > 0.0])
    return touched - _counted(calibration)


def _ellipses(calibration: PlaneCalibration, points: Array) -> Array:
    """Return the outlines of the 95 % ellipses about points, as the camera would see them.

    They are (N, OUTLINE, 2), from each point.
    """
    inside = calibration.rotation[:, :2]
    covariances = inside.T @ calibration.covariance_at(points) @ inside
    values, vectors = np.linalg.eigh(covariances)
    lengths = ELLIPSE * np.sqrt(np.maximum(values, 0.0))
    # the symmetric root: axes alone may point to either side
    half = (vectors * lengths[:, None, :]) @ vectors.swapaxes(1, 2)
    angles = np.linspace(0.0, math.tau, OUTLINE, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    outlines = (half @ circle).swapaxes(1, 2) @ inside.T  # metres in the robot's space
    centres = calibration.transform(points)
    seen = calibration.inverse((centres[:, None] + outlines).reshape(-1, 3))
    return seen.reshape(len(points), OUTLINE, 2) - points[:, None]


def _heat(calibration: PlaneCalibration, view: _View) -> Iterator[str]:
    """Yield the predicted error as coloured cells."""
    if calibration.touch_sigma is None:
        return
    cell = WIDTH / COLUMNS
    rows = min(2 * COLUMNS, max(1, round(view.height / cell)))
    tall = view.height / rows
    middles = np.array(
        [
            [(column + 0.5) * cell, view.height - (row + 0.5) * tall]
            for row in range(rows)
            for column in range(COLUMNS)
        ]
    )
    errors = calibration.predicted_error(view.low + middles / view.zoom)
    low, high = float(errors.min()), float(errors.max())
    parts = (errors - low) / (high - low) if high > low else np.zeros_like(errors)
    yield '<g shape-rendering="crispEdges">'
    for number, part in enumerate(parts.tolist()):
        row, column = divmod(number, COLUMNS)
        yield (
            f'<rect x="{BORDER + column * cell:.2f}" y="{BORDER + row * tall:.2f}" '
            f'width="{cell:.2f}" height="{tall:.2f}" fill="{_colour(part)}"/>'
        )
    yield "</g>"
    foot = 2 * BORDER + view.height + 45
    for step in range(11):
        yield (
            f'<rect x="{BORDER + 20 * step:.0f}" y="{foot:.2f}" width="20" height="14" '
            f'fill="{_colour(step / 10)}"/>'
        )
    yield _text(
        (BORDER + 232, foot + 12),
        f"predicted error: {1e3 * low:.3f} mm to {1e3 * high:.3f} mm rms",
    )


def _colour(part: float) -> str:
    """Return a colour between the two, in steps that rounding does not change."""
    level = round(20 * part) / 20
    channels = (round(a + level * (b - a)) for a, b in zip(LOW, HIGH, strict=True))
    return "#" + "".join(f"{channel:02x}" for channel in channels)


def _camera_frame(view: _View) -> Iterator[str]:
    """Yield the camera's axes: from its origin where that is shown, else from a corner."""
    origin = np.clip(np.zeros(2), view.low, view.high)
    start = view.pixels(origin[None])[0]
    yield from _axis(start, np.array([70.0, 0.0]), "camera", "camera x")
    yield from _axis(start, np.array([0.0, -70.0]), "camera", "y")


def _robot_frame(calibration: PlaneCalibration, view: _View) -> Iterator[str]:
    """Yield the robot's axes, as they lie in the plane, below the field's lower right corner."""
    start = np.array([BORDER + WIDTH - 90, 2 * BORDER + view.height + 35])
    inside = calibration.rotation[:, :2].T
    for axis, name in enumerate(("robot x", "y", "z")):
        along = inside[:, axis] * 60
        if np.linalg.norm(along) < 3:  # it stands on the plane
            yield f'<circle cx="{start[0]:.2f}" cy="{start[1]:.2f}" r="4" class="robot"/>'
            yield _text(start, name, "robot-name", beside=(7, 15))
        else:
            yield from _axis(start, along * [1, -1], "robot", name)


def _axis(start: Array, along: Array, kind: str, name: str) -> Iterator[str]:
    end = start + along
    yield _line(start, end, kind)
    direction = along / np.linalg.norm(along)
    for side in (-1, 1):
        back = np.array(
            [-direction[0] - side * direction[1] / 2, -direction[1] + side * direction[0] / 2]
        )
        yield _line(end, end + 8 * back, kind)
    yield _text(end + 8 * direction, name, f"{kind}-name", beside=(0, 4))


def _touches(calibration: PlaneCalibration, view: _View, larger: float) -> Iterator[str]:
    points = _counted(calibration)
    ends = view.pixels(points + larger * _residuals(calibration))
    if calibration.touch_sigma is not None:
        yield from _outlines(points, _ellipses(calibration, points), view, larger)
    numbers = 1 + np.flatnonzero(calibration.weights)
    for number, place, end in zip(numbers, view.pixels(points), ends, strict=True):
        yield _line(place, end, "residual")
        yield f'<circle cx="{place[0]:.2f}" cy="{place[1]:.2f}" r="4" class="touch"/>'
        yield _text(place, str(number), beside=(7, -7))
    for index in calibration.outliers:
        point = calibration.camera_points[index]
        if (point > view.low).all() and (point < view.high).all():
            place = view.pixels(point[None])[0]
            for stroke in (np.array([5.0, 5.0]), np.array([5.0, -5.0])):
                yield _line(place - stroke, place + stroke, "left-out")
            yield _text(place, str(1 + index), beside=(7, -7))


def _parts(
    calibration: PlaneCalibration, view: _View, larger: float, parts: Sequence[Localization]
) -> Iterator[str]:
    if not parts:
        return
    points = np.array([part.pose.position[:2] for part in parts])
    if calibration.touch_sigma is not None:
        yield from _outlines(points, _ellipses(calibration, points), view, larger)
    for part, place in zip(parts, view.pixels(points), strict=True):
        theta = part.pose.orientation.theta
        along = 18 * np.array([math.cos(theta), -math.sin(theta)])
        yield f'<circle cx="{place[0]:.2f}" cy="{place[1]:.2f}" r="7" class="part"/>'
        yield _line(place, place + along, "part")
        yield _text(place, part.feature_id, "part-name", beside=(10, 20))


def _outlines(points: Array, outlines: Array, view: _View, larger: float) -> Iterator[str]:
    for point, outline in zip(points, outlines, strict=True):
        corners = view.pixels(point + larger * outline)
        text = " ".join(f"{x:.2f},{y:.2f}" for x, y in corners)
        yield f'<polygon points="{text}" class="ellipse"/>'


def _legend(calibration: PlaneCalibration, view: _View, larger: float, title: str) -> Iterator[str]:
    foot = 2 * BORDER + view.height
    if title:
        yield _text((BORDER, 30), title, "title")
    error = calibration.held_out_error
    count = str(len(calibration.camera_points))
    if calibration.outliers:
        count = f"{len(_counted(calibration))} of {count}"
    yield _text(
        (BORDER, foot),
        f"{calibration.model}, {count} touches; held-out error "
        + ("not known" if error is None else f"{1e3 * error:.3f} mm rms"),
    )
    yield _text(
        (BORDER, foot + 25),
        f"residuals (red) and 95 % ellipses (violet) {larger:g} times larger than they are"
        + ("; crosses: left out" if calibration.outliers else ""),
    )
    bar, name = _bar(calibration, view)
    start = np.array([BORDER + WIDTH - 220 - bar, foot])
    yield _line(start, start + np.array([bar, 0.0]), "camera")
    yield _text(start, name, beside=(0, 18))


def _bar(calibration: PlaneCalibration, view: _View) -> tuple[float, str]:
    """Return the length in pixels of a round distance on the plane, and its name."""
    per_metre = view.zoom / calibration.scale
    wanted = 0.2 * WIDTH / per_metre
    power = 10.0 ** math.floor(math.log10(wanted))
    metres = power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))
    return metres * per_metre, f"{1e3 * metres:g} mm"


def _line(start: Array, end: Array, kind: str) -> str:
    return (
        f'<line x1="{start[0]:.2f}" y1="{start[1]:.2f}" x2="{end[0]:.2f}" y2="{end[1]:.2f}" '
        f'class="{kind}"/>'
    )


def _text(
    place: Array | tuple[float, float],
    text: str,
    kind: str = "",
    *,
    beside: tuple[float, float] = (0.0, 0.0),
) -> str:
    of_kind = f' class="{kind}"' if kind else ""
    x, y = place[0] + beside[0], place[1] + beside[1]
    return f'<text x="{x:.2f}" y="{y:.2f}"{of_kind}>{escape(text)}</text>'
