"""The tool `measure`: a width, distance, line, circle or angle, with a verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.frames._inside import Drawing
from smartcam.inspection._finding import Finding
from smartcam.inspection._measure.edges import MAX_WIDTH_PX, EdgeSettings
from smartcam.inspection._measure.features import (
    FoundPoint,
    FoundShape,
    find_circle,
    find_line,
    find_pair,
    find_point,
    strip_between,
)
from smartcam.inspection._measure.planes import PIXELS, Plane, picture_of, plane_of
from smartcam.inspection._measure.settings import (
    MAX_LENGTH_PX,
    Across,
    AcrossPair,
    Between,
    BetweenLines,
    CircleSearch,
    EdgeSearch,
    FeatureSearch,
    LineSearch,
    MeasureSettings,
    StripSearch,
)
from smartcam.inspection._measure.tolerances import digits_of
from smartcam.inspection._measure.troubles import NotMeasuredError, NoValueReason
from smartcam.inspection._measure.values import (
    Value,
    angle,
    circle_of,
    direction,
    distance,
    line_of,
    point_of,
    width,
    with_calibration,
)
from smartcam.inspection._places import PixelPose
from smartcam.inspection._tool import Tool

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from smartcam.frames._inside import Role
    from smartcam.geometry._inside import Array
    from smartcam.inspection._measure.fits import Circle, Line, ShapeFit
    from smartcam.inspection._measure.strips import Strips
    from smartcam.inspection._measure.values import Feature
    from smartcam.inspection._tool import ToolSetup, View

CIRCLE_CORNERS: Final = 72
"""Number of corners of the polygon that draws a circle."""

SI_PER_UNIT: Final = {"mm": 1e-3, "px": 1.0, "deg": math.pi / 180}
"""Factors from displayed units to SI units; pixels stay pixels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """Details of a measurement, beyond the fields of its result.

    Attributes:
        trouble: reason why there is no value; None: there is a value.
        value: measured value in ``unit``; NaN without a value.
        sigma: standard deviation of the value, in ``unit``, from the picture's noise and, if there
            is a calibration, its errors.
        unit: ``mm``, ``px`` or ``deg``.
        edges: places of the used edges, (N, 2), pixels.
        left_out: places of outliers of the line or circle, (K, 2), pixels.
        missed: reasons of the strips without an edge.
        remark: text about errors that ``sigma`` does not include; mostly empty.
    """

    trouble: NoValueReason | None = None
    value: float = math.nan
    sigma: float = math.nan
    unit: str = "px"
    edges: Array = field(default_factory=lambda: np.zeros((0, 2)))
    left_out: Array = field(default_factory=lambda: np.zeros((0, 2)))
    missed: tuple[str, ...] = ()
    remark: str = ""


class Measure(Tool[MeasureSettings]):
    """Measure one value with its sigma."""

    settings_model = MeasureSettings

    def __init__(self, settings: MeasureSettings, setup: ToolSetup) -> None:
        super().__init__(settings, setup)
        load("scipy.special", "measure needs")  # spares the first picture the wait
        calibration, tolerance = setup.calibration, settings.tolerance
        unit = settings.unit
        if unit is None and tolerance is not None and tolerance.unit != "deg":
            unit = "mm" if tolerance.unit == "mm" else "px"
        if unit is None:
            unit = "mm" if getattr(calibration, "kind", None) in {"plane", "sheet"} else "px"
        self._plane = plane_of(calibration) if unit == "mm" else picture_of(calibration)
        self._unit = "deg" if settings.kind in {"line", "angle"} else self._plane.unit

    @property
    def fields(self) -> str:
        """Fields: the value, named after its kind, its sigma and its place."""
        kind, unit = self.settings.kind, self._unit
        name = {"edge": "place", "line": "angle", "circle": "diameter"}.get(kind, kind)
        text = f"{name}: real32 {unit}, sigma: real32 {unit}"
        if kind in {"edge", "line", "circle"}:
            text += ", x: real32 px, y: real32 px"
        if kind in {"line", "circle"}:
            text += ", edges: uint16, left_out: uint16"
        return text

    def inspect(self, view: View) -> Finding:
        """Return the measured value with its verdict."""
        look = _EdgeFinder(view, self._plane)
        search = getattr(self.settings, self.settings.kind)
        try:
            measured = _MEASURES[self.settings.kind](look, search)
        except NotMeasuredError as trouble:
            return Finding(
                ok=False,
                reason=f"{trouble.why.value}: {trouble.text}",
                drawings=look.drawn("", wrong=True),
                details=look.details(None, self._unit, trouble.why),
            )
        return self._judged(look, measured)

    def _judged(self, look: _EdgeFinder, measured: _MeasuredValue) -> Finding:
        settings, si = self.settings, SI_PER_UNIT[self._unit]
        value = (
            Value(*(number / si for number in measured.value))
            if self._unit == "deg"
            else measured.value
        )
        reason = ""
        if settings.tolerance is not None:
            reason = settings.tolerance.complaint(value.value, value.sigma, settings.guard)
        name = self.fields.partition(":")[0]
        text = f"{value.value:.{digits_of(value.sigma)}f} {self._unit}"
        return Finding(
            ok=not reason,
            reason=reason,
            values={name: value.value * si, "sigma": value.sigma * si, **measured.values},
            drawings=look.drawn(text, wrong=bool(reason)),
            reference=measured.reference,
            details=look.details(value, self._unit, None),
        )


class _MeasuredValue(NamedTuple):
    """A value, other fields of the result, and a frame of reference."""

    value: Value
    values: Mapping[str, Any]
    reference: PixelPose | None


class _EdgeFinder:
    """Find edges in one picture, and collect marks and details."""

    def __init__(self, view: View, plane: Plane) -> None:
        self.plane = plane
        self.reference = view.reference
        self._image = view.picture.levels
        self._top = 2**view.picture.depth - 1
        self._ends = view.picture.ends
        self._clipped = view.picture.clipped
        self._regions: list[Array] = []  # corners of each region
        self._edges: list[Array] = []
        self._left_out: list[Array] = []
        self._missed: list[str] = []
        self._shapes: list[Array] = []

    def at(self, places: object) -> Array:
        """Return coordinates of the settings in the picture's pixels."""
        return self.reference.to_picture(np.asarray(places, dtype=np.float64))

    def _settings(self, search: EdgeSearch) -> EdgeSettings:
        return EdgeSettings(
            polarity=search.polarity,
            smoothing=search.smoothing,
            contrast=search.contrast * self._top / 255,
            most_blur=search.blur,
            black=float(self._ends[0]),
            white=float(self._ends[1]),
            cut_off=search.cut_off,
            clipped=self._clipped,
        )

    def _strip(self, search: Across | AcrossPair) -> Strips:
        start, end = self.at(search.across)
        strip = strip_between(start, end, search.strip * self.reference.scale)
        if not 2 <= strip.length <= MAX_LENGTH_PX:
            text = f"a strip of {strip.length:.0f} px, 2 to {MAX_LENGTH_PX:.0f} px can be measured"
            raise NotMeasuredError(NoValueReason.TOO_LARGE, text)
        half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2 * [strip.length, strip.width]
        self._regions.append(strip.points(half[None, :, 0], half[None, :, 1])[0])
        return strip

    def edge(self, search: Across) -> FoundPoint:
        """Return the edge in a strip."""
        point = find_point(self._image, self._strip(search), self._settings(search), search.which)
        self._edges.append(point.pixel[None])
        return point

    def pair(self, search: AcrossPair) -> tuple[FoundPoint, FoundPoint]:
        """Return the two edges of a bar."""
        pair = find_pair(self._image, self._strip(search), self._settings(search), search.which)
        self._edges += [point.pixel[None] for point in pair]
        return pair

    def line(self, search: LineSearch) -> tuple[FoundShape, ShapeFit[Line]]:
        """Return the edges of a line, and the line in the picture's pixels."""
        ends, scale = self.at(search.along), self.reference.scale
        length = math.dist(*ends)
        across = (ends[1] - ends[0])[::-1] * [-1.0, 1.0] / length * search.search / 2 * scale
        self._regions.append(np.array([*(ends - across), *(ends[::-1] + across)]))
        found_line = find_line(
            self._image,
            *ends,
            search=search.search * scale,
            width=_width_of(search, length, scale),
            count=search.strips,
            settings=self._settings(search),
            which=search.which,
        )
        found_line = found_line._replace(kept=line_of(found_line, ends, self.plane).kept)
        fit = line_of(found_line, ends, PIXELS)
        line = fit.shape
        self._shapes.append(line.at + np.outer([-line.reach, line.reach], line.direction))
        self._keep(found_line, fit)
        return found_line, fit

    def circle(self, search: CircleSearch) -> tuple[FoundShape, ShapeFit[Circle]]:
        """Return the edges of a circle, and the circle in the picture's pixels."""
        centre, scale = self.at(search.centre), self.reference.scale
        begin, end = (math.radians(degrees) + self.reference.angle for degrees in search.arc)
        radius, reach = search.radius * scale, search.search / 2 * scale
        turn = np.linspace(begin, end, CIRCLE_CORNERS + 1)
        rim = np.column_stack([np.cos(turn), np.sin(turn)])
        self._regions += [centre + (radius + side) * rim for side in (-reach, reach)]
        circle = find_circle(
            self._image,
            centre,
            radius,
            arc=(begin, end),
            search=search.search * scale,
            width=_width_of(search, (end - begin) * radius, scale),
            count=search.strips,
            settings=self._settings(search),
            which=search.which,
        )
        circle = circle._replace(kept=circle_of(circle, self.plane).kept)
        fit = circle_of(circle, PIXELS)
        self._shapes.append(fit.shape.centre + fit.shape.radius * rim)
        self._keep(circle, fit)
        return circle, fit

    def _keep(self, shape: FoundShape, fit: ShapeFit[Any]) -> None:
        self._edges.append(shape.edges.points[fit.kept])
        self._left_out.append(shape.edges.points[~fit.kept])
        self._missed += map(str, shape.troubles)

    def details(
        self, found_value: Value | None, unit: str, why: NoValueReason | None
    ) -> Measurement:
        """Return the details of the measurement."""
        none = [np.zeros((0, 2))]
        value, sigma = (math.nan, math.nan) if found_value is None else found_value
        return Measurement(
            trouble=why,
            value=value,
            sigma=sigma,
            unit=unit,
            edges=np.concatenate(self._edges or none),
            left_out=np.concatenate(self._left_out or none),
            missed=tuple(self._missed),
            remark=self.plane.remark,
        )

    def drawn(self, text: str, *, wrong: bool) -> list[Drawing]:
        """Return the marks to draw."""
        role: Role = "wrong" if wrong else "found"
        marks = [Drawing("polygon", _corners(region), "region") for region in self._regions]
        marks += [Drawing("points", _corners(edge), role) for edge in self._edges]
        marks += [
            Drawing("points", _corners(edges), "hint") for edges in self._left_out if len(edges)
        ]
        marks += [Drawing("line", _corners(shape), role) for shape in self._shapes]
        if text and self._edges:
            marks.append(Drawing("text", _corners(self._edges[0][:1]), role, text))
        return marks


def _width_of(search: StripSearch, length: float, scale: float) -> float:
    """Return the width of strips along a length without overlap, so that each pixel counts once."""
    spacing = length / search.strips
    wanted = MAX_WIDTH_PX if search.strip is None else search.strip * scale
    return max(min(wanted, spacing), 1.0)


def _corners(points: NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in points)


def _pose(at: Array, ahead: Array) -> PixelPose:
    return PixelPose(float(at[0]), float(at[1]), math.atan2(ahead[1], ahead[0]))


def _fields(at: Array, fit: ShapeFit[Any]) -> Mapping[str, Any]:
    used = int(np.count_nonzero(fit.kept))
    x, y = at.tolist()
    return {"x": x, "y": y, "edges": used, "left_out": len(fit.kept) - used}


def _width(look: _EdgeFinder, search: AcrossPair) -> _MeasuredValue:
    first, second = look.pair(search)
    value = with_calibration(lambda plane: width(first, second, plane), look.plane)
    middle = (first.pixel + second.pixel) / 2
    return _MeasuredValue(value, {}, _pose(middle, first.strip.directions[0]))


def _edge(look: _EdgeFinder, search: Across) -> _MeasuredValue:
    edge = look.edge(search)
    start = look.at(search.across[0])

    def place(plane: Plane) -> Value:
        point = point_of(edge, plane)
        offset = point.at - plane.points(start[None])[0]
        length = max(math.hypot(*offset), 1e-12)
        return Value(length, math.sqrt(float(offset @ point.covariance @ offset)) / length)

    x, y = edge.pixel.tolist()
    pose = _pose(edge.pixel, edge.strip.directions[0])
    return _MeasuredValue(with_calibration(place, look.plane), {"x": x, "y": y}, pose)


def _line(look: _EdgeFinder, search: LineSearch) -> _MeasuredValue:
    found_line, fit = look.line(search)
    ends, line = look.at(search.along), fit.shape
    axis = np.array([math.cos(look.reference.angle), math.sin(look.reference.angle)])

    def turned(plane: Plane) -> Value:
        return direction(line_of(found_line, ends, plane).shape, line.at, axis, plane)

    value = with_calibration(turned, look.plane)
    return _MeasuredValue(value, _fields(line.at, fit), _pose(line.at, line.direction))


def _circle(look: _EdgeFinder, search: CircleSearch) -> _MeasuredValue:
    found_circle, fit = look.circle(search)

    def diameter(plane: Plane) -> Value:
        circle = circle_of(found_circle, plane).shape
        return Value(2 * circle.radius, 2 * math.sqrt(float(circle.covariance[2, 2])))

    x, y = fit.shape.centre.tolist()
    pose = PixelPose(x, y, look.reference.angle)
    return _MeasuredValue(
        with_calibration(diameter, look.plane), _fields(fit.shape.centre, fit), pose
    )


def _distance(look: _EdgeFinder, search: Between) -> _MeasuredValue:
    first, second = _feature(look, search.first), _feature(look, search.second)
    value = with_calibration(lambda plane: distance(first(plane), second(plane)), look.plane)
    return _MeasuredValue(value, {}, None)


def _angle(look: _EdgeFinder, search: BetweenLines) -> _MeasuredValue:
    first, second = (_line_in(look, feature.line) for feature in (search.first, search.second))
    value = with_calibration(lambda plane: angle(first(plane), second(plane)), look.plane)
    return _MeasuredValue(value, {}, None)


def _line_in(look: _EdgeFinder, search: LineSearch) -> Callable[[Plane], Line]:
    line, _ = look.line(search)
    ends = look.at(search.along)
    return lambda plane: line_of(line, ends, plane).shape


def _feature(look: _EdgeFinder, search: FeatureSearch) -> Callable[[Plane], Feature]:
    if search.line is not None:
        return _line_in(look, search.line)
    if search.circle is not None:
        circle, _ = look.circle(search.circle)
        return lambda plane: circle_of(circle, plane).shape
    assert search.edge is not None  # noqa: S101 - one of the three is given
    edge = look.edge(search.edge)
    return lambda plane: point_of(edge, plane)


_MEASURES: Final[Mapping[str, Callable[[_EdgeFinder, Any], _MeasuredValue]]] = {
    "width": _width,
    "edge": _edge,
    "line": _line,
    "circle": _circle,
    "distance": _distance,
    "angle": _angle,
}
