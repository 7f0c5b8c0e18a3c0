"""Find edges, lines and circles in a picture's regions.

Regions and edges are in pixels of the picture. The module ``values`` maps the edges to the
measuring plane, and fits points, lines and circles there.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam.inspection._measure.edges import (
    FIT_REACH_BLURS,
    FIT_REACH_PX,
    PIXEL_VARIANCE,
    Edge,
    choose_edge,
    choose_pair,
    find_edges,
)
from smartcam.inspection._measure.fits import Edges, fit_circle, fit_line
from smartcam.inspection._measure.strips import Sectors, Strips
from smartcam.inspection._measure.troubles import NotMeasuredError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array
    from smartcam.inspection._measure.edges import Choice, EdgeSettings, PairChoice

    Image = NDArray[np.generic]

MIN_TILT_WIDTH_PX = 5.0
"""Least width of a strip, pixels, to fit the tilt of its edge."""

MIN_FOUND_SHARE = 0.5
"""Least share of the strips of a line or a circle that must have an edge."""

OWN_NOISE_FACTOR = 2.0
"""Ratio of an edge's noise to the median of all edges' noise. If it is larger, the edge's sigma is
computed from the edge's own noise, else from the median."""


class FoundPoint(NamedTuple):
    """An edge at the point where it crosses the middle line of its strip."""

    strip: Strips  # a single strip
    edge: Edge

    @property
    def pixel(self) -> Array:
        """Place in the picture, (2,)."""
        point: Array = self.strip.points(np.array([self.edge.place]), np.zeros(1))[0]
        return point


class CurveEdges(NamedTuple):
    """Edges of a line or a circle, in pixels."""

    edges: Edges
    troubles: tuple[NotMeasuredError, ...]  # errors of the strips without an edge
    blur: float  # median standard deviation of the edges' blur, pixels
    model_error: float  # possible common error of all edges from a wrong model, pixels
    inliers: NDArray[np.bool_] | None = None  # (N,), mask of the edges; None: not known yet


def strip_between(start: Array, end: Array, width: float) -> Strips:
    """Return the strip between two points."""
    vector = end - start
    length = float(np.hypot(*vector))
    return Strips((start + end)[None] / 2, vector[None] / length, length, width)


def find_point(image: Image, strip: Strips, settings: EdgeSettings, which: Choice) -> FoundPoint:
    """Return the edge that crosses a strip."""
    tilted = strip.width >= MIN_TILT_WIDTH_PX
    edges = find_edges(image, strip, settings, tilted=tilted)[0]
    return FoundPoint(strip, choose_edge(edges, which))


def find_pair(
    image: Image, strip: Strips, settings: EdgeSettings, which: PairChoice
) -> tuple[FoundPoint, FoundPoint]:
    """Return the two edges of a bar that crosses a strip."""
    tilted = strip.width >= MIN_TILT_WIDTH_PX
    first, second = choose_pair(find_edges(image, strip, settings, tilted=tilted)[0], which)
    return FoundPoint(strip, first), FoundPoint(strip, second)


def find_line(
    image: Image,
    start: Array,
    end: Array,
    *,
    strip_length: float,
    width: float,
    count: int,
    settings: EdgeSettings,
    which: Choice,
) -> CurveEdges:
    """Return the edges of a line near the line from ``start`` to ``end``.

    Strips of ``strip_length`` pixels cross the line from its left to its right side.
    """
    fractions = (np.arange(count) + 0.5) / count
    strips = _strips_across(start, end - start, fractions, strip_length, width)
    first = _collect_edges(image, strips, settings, which)
    direction = end - start
    line = fit_line(first.edges, direction).curve
    # strips again, at right angles to the found line, so that edges are not tilted
    begin, stop = (
        line.middle + ((end_point - line.middle) @ line.direction) * line.direction
        for end_point in (start, end)
    )
    strips = _strips_across(
        begin, stop - begin, fractions, min(strip_length, _fit_strip_length(first)), width
    )
    return _collect_edges(image, strips, settings, "nearest")


def _strips_across(
    start: Array, vector: Array, fractions: Array, strip_length: float, width: float
) -> Strips:
    direction = np.array([-vector[1], vector[0]]) / np.hypot(*vector)
    middles = start + fractions[:, None] * vector
    return Strips(middles, np.tile(direction, (len(fractions), 1)), strip_length, width)


def find_circle(
    image: Image,
    centre: Array,
    radius: float,
    *,
    arc: tuple[float, float],
    strip_length: float,
    width: float,
    count: int,
    settings: EdgeSettings,
    which: Choice,
) -> CurveEdges:
    """Return the edges of a circle near the given circle.

    Strips of ``strip_length`` pixels cross the circle from inside to outside; ``arc``: angles that
    limit the strips, radians from the picture's x axis towards its y axis.
    """
    angles = arc[0] + (np.arange(count) + 0.5) / count * (arc[1] - arc[0])
    strips = Sectors(centre, radius, angles, strip_length, width)
    first = _collect_edges(image, strips, settings, which)
    circle = fit_circle(first.edges).curve
    radial = strips.middles - circle.centre  # places relative to the better centre
    angles = np.arctan2(radial[:, 1], radial[:, 0])
    width *= min(circle.radius / radius, 1.0)
    strips = Sectors(
        circle.centre, circle.radius, angles, min(strip_length, _fit_strip_length(first)), width
    )
    return _collect_edges(image, strips, settings, "nearest")


def _collect_edges(
    image: Image, strips: Strips | Sectors, settings: EdgeSettings, which: Choice
) -> CurveEdges:
    """Return the chosen edge of each strip; raise NotMeasuredError if too few strips have one."""
    strip_indices, edges, troubles = [], [], []
    for strip_index, strip_edges in enumerate(find_edges(image, strips, settings)):
        try:
            edges.append(choose_edge(strip_edges, which))
        except NotMeasuredError as trouble:
            troubles.append(trouble)
        else:
            strip_indices.append(strip_index)
    strip_count = len(edges) + len(troubles)
    if len(edges) < MIN_FOUND_SHARE * strip_count:
        raise _too_few_error(troubles, strip_count)
    places = np.array([edge.place for edge in edges])
    noises = np.array([edge.noise for edge in edges])
    noise = float(np.median(noises))
    noises = np.where(noises > OWN_NOISE_FACTOR * noise, noises, noise)
    blur = math.sqrt(float(np.median([edge.blur for edge in edges])) ** 2 + PIXEL_VARIANCE)
    strips_used, middle = strips.selected(np.array(strip_indices)), np.zeros(len(strip_indices))
    if isinstance(strips, Sectors):
        # blur moves the rim of a disc inwards by s^2 / (2 r)
        places = places + blur**2 / (2 * (strips.radius + places))
    unit_sigmas = np.array([edge.unit_sigma for edge in edges])
    curve_edges = Edges(
        strips_used.points(places, middle),
        np.array(strips_used.directions_at(middle)),
        unit_sigmas * noises,
    )
    model_error = float(np.median([edge.model_error for edge in edges]))
    return CurveEdges(curve_edges, tuple(troubles), blur, model_error)


def _too_few_error(troubles: list[NotMeasuredError], strip_count: int) -> NotMeasuredError:
    """Return the error for a line or a circle of which too few strips have an edge."""
    reasons = [trouble.reason for trouble in troubles]
    commonest = max(reasons, key=reasons.count)
    example = next(trouble for trouble in troubles if trouble.reason is commonest)
    text = f"{len(troubles)} of {strip_count} strips have no edge: {example.text}"
    return NotMeasuredError(commonest, text)


def _fit_strip_length(found: CurveEdges) -> float:
    """Return the length of a strip that is just long enough to fit an edge, pixels."""
    return 2 * (FIT_REACH_BLURS * found.blur + FIT_REACH_PX)
