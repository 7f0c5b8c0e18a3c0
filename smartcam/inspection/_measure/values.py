"""Compute lengths and angles of edges, lines and circles in a plane, with standard deviations."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from smartcam.inspection._measure.fits import (
    Circle,
    CurveFit,
    CurveT,
    Line,
    fit_circle,
    fit_line,
)
from smartcam.inspection._measure.planes import STEP_PX
from smartcam.inspection._measure.troubles import NotMeasuredError, NoValueReason

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.geometry._inside import Array
    from smartcam.inspection._measure.features import CurveEdges, FoundPoint
    from smartcam.inspection._measure.planes import Plane

STEP: float = 1e-3
"""Step of numerical derivatives, pixels for places and tangents for angles."""

MAX_RELATIVE_RADIUS_SIGMA = 0.05
"""Largest relative standard deviation of a radius; a larger one means that the arc is too short."""

MAX_RMS_PX = 1.5
"""Largest RMS distance of edges from their line or circle, in pixels."""

MAX_PARALLEL_ANGLE = math.radians(10.0)
"""Largest angle, radians, between two lines whose distance is measured."""


class Point(NamedTuple):
    """A point in a plane."""

    position: Array  # (2,)
    covariance: Array  # (2, 2)


Feature: TypeAlias = Point | Line | Circle


class Value(NamedTuple):
    """A measured value in the plane's unit, or in radians."""

    value: float
    sigma: float


def point_in_plane(point: FoundPoint, plane: Plane) -> Point:
    """Return an edge as a point of a plane, with uncertainty along its strip only."""
    pixel = point.pixel[None]
    sigma = math.hypot(point.edge.sigma, point.edge.model_error)
    step = plane.jacobians(pixel)[0] @ point.strip.directions[0] * sigma
    return Point(plane.map_points(pixel)[0], np.outer(step, step))


def fit_line_in_plane(line_edges: CurveEdges, ends: Array, plane: Plane) -> CurveFit[Line]:
    """Fit a line to edges in a plane.

    ``ends`` (2, 2): pixels of two points that give the line's direction.
    """
    start, end = plane.map_points(ends)
    fit = fit_line(plane.map_edges(line_edges.edges), end - start, line_edges.inliers)
    return _add_model_error(fit, line_edges, plane, 0)


def fit_circle_in_plane(circle_edges: CurveEdges, plane: Plane) -> CurveFit[Circle]:
    """Fit a circle to edges in a plane.

    Raises:
        NotMeasuredError: UNCERTAIN: the arc is too short to determine the radius.
    """
    fit = fit_circle(plane.map_edges(circle_edges.edges), circle_edges.inliers)
    circle = fit.curve
    sigma = math.sqrt(float(circle.covariance[2, 2]))
    if sigma > MAX_RELATIVE_RADIUS_SIGMA * circle.radius:
        text = (
            f"the arc is too short: its radius is {circle.radius:.3g} {plane.unit}, give or take "
            f"{sigma:.2g} {plane.unit}"
        )
        raise NotMeasuredError(NoValueReason.UNCERTAIN, text)
    return _add_model_error(fit, circle_edges, plane, 2)


def _add_model_error(
    fit: CurveFit[CurveT], curve_edges: CurveEdges, plane: Plane, variance_index: int
) -> CurveFit[CurveT]:
    """Return the fit with the edges' common error added to the variance of offset or radius.

    Raises:
        NotMeasuredError: NO_AGREEMENT: the edges belong to several lines or circles.
    """
    scale = float(np.median(plane.map_edges(curve_edges.edges).sigmas / curve_edges.edges.sigmas))
    spread = float(np.sqrt(np.mean(fit.residuals[fit.inliers] ** 2))) / scale
    if spread > MAX_RMS_PX:
        text = f"the edges are {spread:.1f} px (rms) from one line or circle"
        raise NotMeasuredError(NoValueReason.NO_AGREEMENT, text)
    covariance = fit.curve.covariance.copy()
    covariance[variance_index, variance_index] += (scale * curve_edges.model_error) ** 2
    return fit._replace(curve=fit.curve._replace(covariance=covariance))


def measure_with_calibration(measure: Callable[[Plane], Value], plane: Plane) -> Value:
    """Return the measured value with a sigma that includes the calibration's errors."""
    measured = measure(plane)
    variance = measured.sigma**2
    for variant in plane.variants:
        other = measure(plane._replace(map=variant, variants=()))
        variance += (other.value - measured.value) ** 2
    return Value(measured.value, math.sqrt(variance))


def width(first: FoundPoint, second: FoundPoint, plane: Plane) -> Value:
    """Return the distance between two edges of one strip, perpendicular to the edges."""
    strip = first.strip

    direction = strip.directions[0]
    normal = direction[::-1] * [-1.0, 1.0]

    def measured(values: Array) -> float:
        places, tilts = values[[0, 2]], values[[1, 3]]
        points = strip.middles[0] + places[:, None] * direction
        steps = STEP_PX * (tilts[:, None] * direction + normal)
        ends, after, before = plane.map_points(
            np.concatenate([points, points + steps, points - steps])
        ).reshape(3, 2, 2)
        lines = (after - before) / np.linalg.norm(after - before, axis=1)[:, None]
        across = lines.sum(axis=0)[::-1] * [1.0, -1.0]
        return abs(float((ends[1] - ends[0]) @ across) / math.hypot(*across))

    values, covariance = _joint_parameters(first, second)
    slopes = np.array(
        [
            (measured(values + step) - measured(values - step)) / (2 * STEP)
            for step in STEP * np.eye(4)
        ]
    )
    model_error = abs(slopes[0]) * first.edge.model_error + abs(slopes[2]) * second.edge.model_error
    return Value(measured(values), math.sqrt(float(slopes @ covariance @ slopes + model_error**2)))


def _joint_parameters(first: FoundPoint, second: FoundPoint) -> tuple[Array, Array]:
    """Return places and tilts of two edges (4,), and their covariance (4, 4)."""
    edges = first.edge, second.edge
    values = np.array([parameter for edge in edges for parameter in (edge.place, edge.tilt)])
    covariance = np.zeros((4, 4))
    share_fit = edges[0].unit_covariance is edges[1].unit_covariance
    for i, edge in enumerate(edges):
        for j, other in enumerate(edges):
            if i == j or share_fit:
                rows, columns = [edge.row, -1], [other.row, -1]
                part = edge.unit_covariance[np.ix_(rows, columns)] * edge.noise * other.noise
                covariance[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = part
    return values, covariance


def distance(first: Feature, second: Feature) -> Value:
    """Return the distance of two points, of a point and a line, or of two parallel lines.

    A circle is represented by its centre. Two lines are compared halfway between their middles,
    perpendicular to the mean of their directions.

    Raises:
        NotMeasuredError: UNCERTAIN: the lines are not parallel, so they have no single distance.
    """
    if isinstance(first, Line) and isinstance(second, Line):
        return _distance_between_lines(first, second)
    if isinstance(first, Line):
        return _distance_from_line(first, _as_point(second))
    if isinstance(second, Line):
        return _distance_from_line(second, _as_point(first))
    one, other = _as_point(first), _as_point(second)
    vector = other.position - one.position
    length = math.hypot(*vector)
    covariance = one.covariance + other.covariance
    if length == 0.0:
        return Value(0.0, math.sqrt(float(np.trace(covariance))))
    unit_vector = vector / length
    return Value(length, math.sqrt(float(unit_vector @ covariance @ unit_vector)))


def _as_point(feature: Feature) -> Point:
    if isinstance(feature, Circle):
        return Point(feature.centre, feature.covariance[:2, :2])
    assert isinstance(feature, Point)  # noqa: S101 - lines have been dealt with
    return feature


def _distance_from_line(line: Line, point: Point) -> Value:
    normal = line.normal
    variance = float(normal @ point.covariance @ normal) + line.offset_variance(point.position)
    return Value(abs(float((point.position - line.middle) @ normal)), math.sqrt(variance))


def _distance_between_lines(first: Line, second: Line) -> Value:
    other_direction = (
        second.direction if first.direction @ second.direction > 0 else -second.direction
    )
    angle = math.acos(min(1.0, float(first.direction @ other_direction)))
    if angle > MAX_PARALLEL_ANGLE:
        text = f"the lines are not parallel: {math.degrees(angle):.1f} degrees apart"
        raise NotMeasuredError(NoValueReason.UNCERTAIN, text)
    mean = (first.direction + other_direction) / np.linalg.norm(first.direction + other_direction)
    normal = np.array([-mean[1], mean[0]])
    middle = (first.middle + second.middle) / 2
    places, variance = [], 0.0
    for line in (first, second):
        # offset of the line at the common middle, along the mean normal
        places.append(float((line.middle - middle) @ line.normal / (line.normal @ normal)))
        variance += line.offset_variance(middle)
    return Value(abs(places[1] - places[0]), math.sqrt(variance))


def direction(line: Line, pixel: Array, axis: Array, plane: Plane) -> Value:
    """Return the angle from an axis of the picture to a line, above -pi, up to pi.

    ``axis`` (2,) is a direction at ``pixel`` (2,); angles count from the picture's x to its y.
    """
    jacobian = plane.jacobians(pixel[None])[0]
    start = jacobian @ axis
    cross = start[0] * line.direction[1] - start[1] * line.direction[0]
    angle = math.atan2(float(cross), float(start @ line.direction))
    angle = math.copysign(angle, angle * float(np.linalg.det(jacobian)))
    return Value(angle, math.sqrt(float(line.covariance[1, 1])))


def angle(first: Line, second: Line) -> Value:
    """Return the angle between the directions of two lines, 0 to pi."""
    cross = first.direction[0] * second.direction[1] - first.direction[1] * second.direction[0]
    angle = math.atan2(abs(float(cross)), float(first.direction @ second.direction))
    return Value(angle, math.sqrt(float(first.covariance[1, 1] + second.covariance[1, 1])))
