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
    CurveEdges,
    FoundPoint,
    find_circle,
    find_line,
    find_pair,
    find_point,
    strip_between,
)
from smartcam.inspection._measure.planes import PIXELS, Plane, measuring_plane, picture_plane
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
    direction,
    distance,
    fit_circle_in_plane,
    fit_line_in_plane,
    measure_with_calibration,
    point_in_plane,
    width,
)
from smartcam.inspection._places import PixelPose
from smartcam.inspection._tool import Tool

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from smartcam.frames._inside import Role
    from smartcam.geometry._inside import Array
    from smartcam.inspection._measure.fits import Circle, CurveFit, Line
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
        # loaded now, since the first picture should not wait for it
        load("scipy.special", "measure needs")
        calibration, tolerance = setup.calibration, settings.tolerance
        unit = settings.unit
        if unit is None and tolerance is not None and tolerance.unit != "deg":
            unit = "mm" if tolerance.unit == "mm" else "px"
        if unit is None:
            unit = "mm" if getattr(calibration, "kind", None) in {"plane", "sheet"} else "px"
        self._plane = measuring_plane(calibration) if unit == "mm" else picture_plane(calibration)
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
        finder = _EdgeFinder(view, self._plane)
        search = getattr(self.settings, self.settings.kind)
        try:
            measured = _MEASURES[self.settings.kind](finder, search)
        except NotMeasuredError as trouble:
            return Finding(
                ok=False,
                reason=f"{trouble.reason.value}: {trouble.text}",
                drawings=finder.drawings("", wrong=True),
                details=finder.details(None, self._unit, trouble.reason),
            )
        return self._judge(finder, measured)

    def _judge(self, finder: _EdgeFinder, measured: _MeasuredValue) -> Finding:
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
            values={name: value.value * si, "sigma": value.sigma * si, **measured.other_fields},
            drawings=finder.drawings(text, wrong=bool(reason)),
            reference=measured.reference,
            details=finder.details(value, self._unit, None),
        )


class _MeasuredValue(NamedTuple):
    """A value, other fields of the result, and a frame of reference."""

    value: Value
    other_fields: Mapping[str, Any]
    reference: PixelPose | None


class _EdgeFinder:
    """Find edges in one picture, and collect marks and details."""

    def __init__(self, view: View, plane: Plane) -> None:
        self.plane = plane
        self.reference = view.reference
        self._image = view.picture.levels
        self._top = 2**view.picture.depth - 1
        self._saturation_levels = view.picture.saturation_levels
        self._clipped = view.picture.clipped
        self._regions: list[Array] = []  # corners of each region
        self._edges: list[Array] = []
        self._left_out: list[Array] = []
        self._missed: list[str] = []
        self._curves: list[Array] = []

    def to_picture(self, places: object) -> Array:
        """Convert coordinates of the settings to the picture's pixels."""
        return self.reference.to_picture(np.asarray(places, dtype=np.float64))

    def _settings(self, search: EdgeSearch) -> EdgeSettings:
        return EdgeSettings(
            polarity=search.polarity,
            smoothing=search.smoothing,
            contrast=search.contrast * self._top / 255,
            max_blur=search.blur,
            black=float(self._saturation_levels[0]),
            white=float(self._saturation_levels[1]),
            allow_saturated=search.allow_saturated,
            clipped=self._clipped,
        )

    def _strip(self, search: Across | AcrossPair) -> Strips:
        start, end = self.to_picture(search.across)
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

    def line(self, search: LineSearch) -> tuple[CurveEdges, CurveFit[Line]]:
        """Return the edges of a line, and the line in the picture's pixels."""
        ends, scale = self.to_picture(search.along), self.reference.scale
        length = math.dist(*ends)
        across = (ends[1] - ends[0])[::-1] * [-1.0, 1.0] / length * search.search / 2 * scale
        self._regions.append(np.array([*(ends - across), *(ends[::-1] + across)]))
        found_line = find_line(
            self._image,
            *ends,
            strip_length=search.search * scale,
            width=_width_of(search, length, scale),
            count=search.strips,
            settings=self._settings(search),
            which=search.which,
        )
        found_line = found_line._replace(
            inliers=fit_line_in_plane(found_line, ends, self.plane).inliers
        )
        fit = fit_line_in_plane(found_line, ends, PIXELS)
        line = fit.curve
        self._curves.append(line.middle + np.outer([-line.reach, line.reach], line.direction))
        self._add_details(found_line, fit)
        return found_line, fit

    def circle(self, search: CircleSearch) -> tuple[CurveEdges, CurveFit[Circle]]:
        """Return the edges of a circle, and the circle in the picture's pixels."""
        centre, scale = self.to_picture(search.centre), self.reference.scale
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
            strip_length=search.search * scale,
            width=_width_of(search, (end - begin) * radius, scale),
            count=search.strips,
            settings=self._settings(search),
            which=search.which,
        )
        circle = circle._replace(inliers=fit_circle_in_plane(circle, self.plane).inliers)
        fit = fit_circle_in_plane(circle, PIXELS)
        self._curves.append(fit.curve.centre + fit.curve.radius * rim)
        self._add_details(circle, fit)
        return circle, fit

    def _add_details(self, curve_edges: CurveEdges, fit: CurveFit[Any]) -> None:
        self._edges.append(curve_edges.edges.points[fit.inliers])
        self._left_out.append(curve_edges.edges.points[~fit.inliers])
        self._missed += map(str, curve_edges.troubles)

    def details(
        self, found_value: Value | None, unit: str, reason: NoValueReason | None
    ) -> Measurement:
        """Return the details of the measurement."""
        no_places = [np.zeros((0, 2))]
        value, sigma = (math.nan, math.nan) if found_value is None else found_value
        return Measurement(
            trouble=reason,
            value=value,
            sigma=sigma,
            unit=unit,
            edges=np.concatenate(self._edges or no_places),
            left_out=np.concatenate(self._left_out or no_places),
            missed=tuple(self._missed),
            remark=self.plane.remark,
        )

    def drawings(self, text: str, *, wrong: bool) -> list[Drawing]:
        """Return the marks to draw."""
        role: Role = "wrong" if wrong else "found"
        marks = [Drawing("polygon", _points(region), "region") for region in self._regions]
        marks += [Drawing("points", _points(edge), role) for edge in self._edges]
        marks += [
            Drawing("points", _points(edges), "hint") for edges in self._left_out if len(edges)
        ]
        marks += [Drawing("line", _points(curve), role) for curve in self._curves]
        if text and self._edges:
            marks.append(Drawing("text", _points(self._edges[0][:1]), role, text))
        return marks


def _width_of(search: StripSearch, length: float, scale: float) -> float:
    """Return the width of strips that do not overlap along a length: each pixel counts once."""
    spacing = length / search.strips
    max_width = MAX_WIDTH_PX if search.strip is None else search.strip * scale
    return max(min(max_width, spacing), 1.0)


def _points(points: NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in points)


def _pose(point: Array, direction: Array) -> PixelPose:
    return PixelPose(float(point[0]), float(point[1]), math.atan2(direction[1], direction[0]))


def _position_fields(point: Array, fit: CurveFit[Any]) -> Mapping[str, Any]:
    used = int(np.count_nonzero(fit.inliers))
    x, y = point.tolist()
    return {"x": x, "y": y, "edges": used, "left_out": len(fit.inliers) - used}


def _width(finder: _EdgeFinder, search: AcrossPair) -> _MeasuredValue:
    first, second = finder.pair(search)
    value = measure_with_calibration(lambda plane: width(first, second, plane), finder.plane)
    middle = (first.pixel + second.pixel) / 2
    return _MeasuredValue(value, {}, _pose(middle, first.strip.directions[0]))


def _edge(finder: _EdgeFinder, search: Across) -> _MeasuredValue:
    edge = finder.edge(search)
    start = finder.to_picture(search.across[0])

    def edge_place(plane: Plane) -> Value:
        point = point_in_plane(edge, plane)
        offset = point.position - plane.map_points(start[None])[0]
        length = max(math.hypot(*offset), 1e-12)
        return Value(length, math.sqrt(float(offset @ point.covariance @ offset)) / length)

    x, y = edge.pixel.tolist()
    pose = _pose(edge.pixel, edge.strip.directions[0])
    return _MeasuredValue(
        measure_with_calibration(edge_place, finder.plane), {"x": x, "y": y}, pose
    )


def _line(finder: _EdgeFinder, search: LineSearch) -> _MeasuredValue:
    found_line, fit = finder.line(search)
    ends, line = finder.to_picture(search.along), fit.curve
    axis = np.array([math.cos(finder.reference.angle), math.sin(finder.reference.angle)])

    def line_angle(plane: Plane) -> Value:
        return direction(fit_line_in_plane(found_line, ends, plane).curve, line.middle, axis, plane)

    value = measure_with_calibration(line_angle, finder.plane)
    return _MeasuredValue(
        value, _position_fields(line.middle, fit), _pose(line.middle, line.direction)
    )


def _circle(finder: _EdgeFinder, search: CircleSearch) -> _MeasuredValue:
    found_circle, fit = finder.circle(search)

    def diameter(plane: Plane) -> Value:
        circle = fit_circle_in_plane(found_circle, plane).curve
        return Value(2 * circle.radius, 2 * math.sqrt(float(circle.covariance[2, 2])))

    x, y = fit.curve.centre.tolist()
    pose = PixelPose(x, y, finder.reference.angle)
    return _MeasuredValue(
        measure_with_calibration(diameter, finder.plane),
        _position_fields(fit.curve.centre, fit),
        pose,
    )


def _distance(finder: _EdgeFinder, search: Between) -> _MeasuredValue:
    first, second = _feature_measure(finder, search.first), _feature_measure(finder, search.second)
    value = measure_with_calibration(
        lambda plane: distance(first(plane), second(plane)), finder.plane
    )
    return _MeasuredValue(value, {}, None)


def _angle(finder: _EdgeFinder, search: BetweenLines) -> _MeasuredValue:
    first, second = (
        _line_measure(finder, feature.line) for feature in (search.first, search.second)
    )
    value = measure_with_calibration(lambda plane: angle(first(plane), second(plane)), finder.plane)
    return _MeasuredValue(value, {}, None)


def _line_measure(finder: _EdgeFinder, search: LineSearch) -> Callable[[Plane], Line]:
    line, _ = finder.line(search)
    ends = finder.to_picture(search.along)
    return lambda plane: fit_line_in_plane(line, ends, plane).curve


def _feature_measure(finder: _EdgeFinder, search: FeatureSearch) -> Callable[[Plane], Feature]:
    if search.line is not None:
        return _line_measure(finder, search.line)
    if search.circle is not None:
        circle, _ = finder.circle(search.circle)
        return lambda plane: fit_circle_in_plane(circle, plane).curve
    assert search.edge is not None  # noqa: S101 - one of the three is given
    edge = finder.edge(search.edge)
    return lambda plane: point_in_plane(edge, plane)


_MEASURES: Final[Mapping[str, Callable[[_EdgeFinder, Any], _MeasuredValue]]] = {
    "width": _width,
    "edge": _edge,
    "line": _line,
    "circle": _circle,
    "distance": _distance,
    "angle": _angle,
}
