"""Compute lengths and angles of edges, lines and circles in a plane, with standard deviations."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from smartcam.inspection._measure.fits import (
    Circle,
    Line,
    ShapeFit,
    ShapeT,
    fit_circle,
    fit_line,
)
from smartcam.inspection._measure.planes import STEP_PX
from smartcam.inspection._measure.troubles import NotMeasuredError, NoValueReason

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.geometry._inside import Array
    from smartcam.inspection._measure.features import FoundPoint, FoundShape
    from smartcam.inspection._measure.planes import Plane

STEP: float = 1e-3
"""Step of numerical derivatives, in pixels and tangents of angles."""

MAX_RELATIVE_RADIUS_SIGMA = 0.05
"""Largest relative standard deviation of a radius; a larger one means that the arc is too short."""

MAX_RMS_PX = 1.5
"""Largest RMS distance of edges from their line or circle, in pixels."""

MAX_PARALLEL_ANGLE = math.radians(10.0)
"""Largest angle, radians, between two lines that have a distance."""


class Point(NamedTuple):
    """A point in a plane."""

    at: Array  # (2,)
    covariance: Array  # (2, 2)


Feature: TypeAlias = Point | Line | Circle


class Value(NamedTuple):
    """A measured value in the plane's unit, or in radians."""

    value: float
    sigma: float


def point_of(point: FoundPoint, plane: Plane) -> Point:
    """Return an edge as a point of a plane, with uncertainty along its strip only."""
    pixel = point.pixel[None]
    sigma = math.hypot(point.edge.sigma, point.edge.misfit)
    step = plane.slopes(pixel)[0] @ point.strip.directions[0] * sigma
    return Point(plane.points(pixel)[0], np.outer(step, step))


def line_of(line: FoundShape, ahead: Array, plane: Plane) -> ShapeFit[Line]:
    """Fit a line to edges in a plane.

    ``ahead`` (2, 2): pixels of two points that give the line's direction.
    """
    start, end = plane.points(ahead)
    fit = fit_line(plane.edges(line.edges), end - start, line.kept)
    return _checked(fit, line, plane, 0)


def circle_of(circle_points: FoundShape, plane: Plane) -> ShapeFit[Circle]:
    """Fit a circle to edges in a plane.

    Raises:
        NotMeasuredError: UNCERTAIN: the arc is too short to determine the radius.
    """
    fit = fit_circle(plane.edges(circle_points.edges), circle_points.kept)
    circle = fit.shape
    sigma = math.sqrt(float(circle.covariance[2, 2]))
    if sigma > MAX_RELATIVE_RADIUS_SIGMA * circle.radius:
        text = (
            f"the arc is too short: its radius is {circle.radius:.3g} {plane.unit}, give or take "
            f"{sigma:.2g} {plane.unit}"
        )
        raise NotMeasuredError(NoValueReason.UNCERTAIN, text)
    return _checked(fit, circle_points, plane, 2)


def _checked(
    fit: ShapeFit[ShapeT], shape: FoundShape, plane: Plane, which: int
) -> ShapeFit[ShapeT]:
    """Return the fit with the edges' common error added to the variance of offset or radius.

    Raises:
        NotMeasuredError: NO_AGREEMENT: the edges belong to several lines or circles.
    """
    scale = float(np.median(plane.edges(shape.edges).sigmas / shape.edges.sigmas))
    spread = float(np.sqrt(np.mean(fit.residuals[fit.kept] ** 2))) / scale
    if spread > MAX_RMS_PX:
        text = f"the edges are {spread:.1f} px (rms) from one line or circle"
        raise NotMeasuredError(NoValueReason.NO_AGREEMENT, text)
    covariance = fit.shape.covariance.copy()
    covariance[which, which] += (scale * shape.misfit) ** 2
    return fit._replace(shape=fit.shape._replace(covariance=covariance))


def with_calibration(measure: Callable[[Plane], Value], plane: Plane) -> Value:
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

    ahead = strip.directions[0]
    aside = ahead[::-1] * [-1.0, 1.0]

    def measured(values: Array) -> float:
        places, tilts = values[[0, 2]], values[[1, 3]]
        at = strip.middles[0] + places[:, None] * ahead
        along = STEP_PX * (tilts[:, None] * ahead + aside)
        ends, after, before = plane.points(np.concatenate([at, at + along, at - along])).reshape(
            3, 2, 2
        )
        lines = (after - before) / np.linalg.norm(after - before, axis=1)[:, None]
        across = lines.sum(axis=0)[::-1] * [1.0, -1.0]
        return abs(float((ends[1] - ends[0]) @ across) / math.hypot(*across))

    values, covariance = _joint(first, second)
    slopes = np.array(
        [
            (measured(values + step) - measured(values - step)) / (2 * STEP)
            for step in STEP * np.eye(4)
        ]
    )
    misfit = abs(slopes[0]) * first.edge.misfit + abs(slopes[2]) * second.edge.misfit
    return Value(measured(values), math.sqrt(float(slopes @ covariance @ slopes + misfit**2)))


def _joint(first: FoundPoint, second: FoundPoint) -> tuple[Array, Array]:
    """Return places and tilts of two edges (4,), and their covariance (4, 4)."""
    edges = first.edge, second.edge
    values = np.array([parameter for edge in edges for parameter in (edge.place, edge.tilt)])
    covariance = np.zeros((4, 4))
    together = edges[0].unit_covariance is edges[1].unit_covariance
    for i, edge in enumerate(edges):
        for j, other in enumerate(edges):
            if i == j or together:
                rows, columns = [edge.number, -1], [other.number, -1]
                part = edge.unit_covariance[np.ix_(rows, columns)] * edge.noise * other.noise
                covariance[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = part
    return values, covariance


def distance(first: Feature, second: Feature) -> Value:
    """Return the distance of two points, of a point and a line, or of two parallel lines.

    A circle is represented by its centre. Two lines are compared halfway between their middles,
    perpendicular to the mean of their directions.

    Raises:
        NotMeasuredError: UNCERTAIN: lines that are not parallel.
    """
    if isinstance(first, Line) and isinstance(second, Line):
        return _between_lines(first, second)
    if isinstance(first, Line):
        return _from_line(first, _as_point(second))
    if isinstance(second, Line):
        return _from_line(second, _as_point(first))
    one, other = _as_point(first), _as_point(second)
    towards = other.at - one.at
    length = math.hypot(*towards)
    covariance = one.covariance + other.covariance
    if length == 0.0:
        return Value(0.0, math.sqrt(float(np.trace(covariance))))
    ahead = towards / length
    return Value(length, math.sqrt(float(ahead @ covariance @ ahead)))


def _as_point(feature: Feature) -> Point:
    if isinstance(feature, Circle):
        return Point(feature.centre, feature.covariance[:2, :2])
    assert isinstance(feature, Point)  # noqa: S101 - lines have been dealt with
    return feature


def _from_line(line: Line, point: Point) -> Value:
    normal = line.normal
    variance = float(normal @ point.covariance @ normal) + line.offset_variance(point.at)
    return Value(abs(float((point.at - line.at) @ normal)), math.sqrt(variance))


def _between_lines(first: Line, second: Line) -> Value:
    ahead = second.direction if first.direction @ second.direction > 0 else -second.direction
    angle = math.acos(min(1.0, float(first.direction @ ahead)))
    if angle > MAX_PARALLEL_ANGLE:
        text = f"the lines are not parallel: {math.degrees(angle):.1f} degrees apart"
        raise NotMeasuredError(NoValueReason.UNCERTAIN, text)
    mean = (first.direction + ahead) / np.linalg.norm(first.direction + ahead)
    normal = np.array([-mean[1], mean[0]])
    middle = (first.at + second.at) / 2
    places, variance = [], 0.0
    for line in (first, second):
        # offset of the line at the common middle, along the mean normal
        places.append(float((line.at - middle) @ line.normal / (line.normal @ normal)))
        variance += line.offset_variance(middle)
    return Value(abs(places[1] - places[0]), math.sqrt(variance))


def direction(line: Line, pixel: Array, axis: Array, plane: Plane) -> Value:
    """Return the angle from an axis of the picture to a line, above -pi, up to pi.

    ``axis`` (2,) is a direction at ``pixel`` (2,); angles count from the picture's x to its y.
    """
    slopes = plane.slopes(pixel[None])[0]
    start = slopes @ axis
    cross = start[0] * line.direction[1] - start[1] * line.direction[0]
    turned = math.atan2(float(cross), float(start @ line.direction))
    turned = math.copysign(turned, turned * float(np.linalg.det(slopes)))
    return Value(turned, math.sqrt(float(line.covariance[1, 1])))


def angle(first: Line, second: Line) -> Value:
    """Return the angle between the directions of two lines, 0 to pi."""
    cross = first.direction[0] * second.direction[1] - first.direction[1] * second.direction[0]
    between = math.atan2(abs(float(cross)), float(first.direction @ second.direction))
    return Value(between, math.sqrt(float(first.covariance[1, 1] + second.covariance[1, 1])))
