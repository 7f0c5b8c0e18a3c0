"""Find edges, lines and circles in a picture's regions.

Regions and edges are in pixels; a plane turns edges into points, lines and circles.
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
    choose,
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
"""Ratio of an edge's noise to the median noise, above which its own noise is used."""


class FoundPoint(NamedTuple):
    """An edge where it crosses the middle of its strip."""

    strip: Strips  # a single strip
    edge: Edge

    @property
    def pixel(self) -> Array:
        """Place in the picture, (2,)."""
        at: Array = self.strip.points(np.array([self.edge.place]), np.zeros(1))[0]
        return at


class FoundShape(NamedTuple):
    """Edges of a line or a circle, in pixels."""

    edges: Edges
    troubles: tuple[NotMeasuredError, ...]  # errors of the strips without an edge
    blur: float  # median standard deviation of the edges' slopes, pixels
    misfit: float  # possible common error of all edges, pixels
    kept: NDArray[np.bool_] | None = None  # (N,), mask of inliers; None: not known yet


def strip_between(start: Array, end: Array, width: float) -> Strips:
    """Return the strip between two points."""
    ahead = end - start
    length = float(np.hypot(*ahead))
    return Strips((start + end)[None] / 2, ahead[None] / length, length, width)


def find_point(image: Image, strip: Strips, settings: EdgeSettings, which: Choice) -> FoundPoint:
    """Return the edge that crosses a strip."""
    tilted = strip.width >= MIN_TILT_WIDTH_PX
    edges = find_edges(image, strip, settings, tilted=tilted)[0]
    return FoundPoint(strip, choose(edges, which))


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
    search: float,
    width: float,
    count: int,
    settings: EdgeSettings,
    which: Choice,
) -> FoundShape:
    """Return the edges of a line near the line from ``start`` to ``end``.

    Strips of ``search`` pixels cross the line from its left to its right side.
    """
    parts = (np.arange(count) + 0.5) / count
    strips = _across(start, end - start, parts, search, width)
    first = _collected(image, strips, settings, which)
    ahead = end - start
    line = fit_line(first.edges, ahead).shape
    # strips again, at right angles to the found line, so that edges are not tilted
    begin, stop = (
        line.at + ((end_point - line.at) @ line.direction) * line.direction
        for end_point in (start, end)
    )
    strips = _across(begin, stop - begin, parts, min(search, _short(first)), width)
    return _collected(image, strips, settings, "nearest")


def _across(start: Array, along: Array, parts: Array, search: float, width: float) -> Strips:
    direction = np.array([-along[1], along[0]]) / np.hypot(*along)
    middles = start + parts[:, None] * along
    return Strips(middles, np.tile(direction, (len(parts), 1)), search, width)


def find_circle(
    image: Image,
    centre: Array,
    radius: float,
    *,
    arc: tuple[float, float],
    search: float,
    width: float,
    count: int,
    settings: EdgeSettings,
    which: Choice,
) -> FoundShape:
    """Return the edges of a circle near the given circle.

    Strips of ``search`` pixels cross the circle from inside to outside; ``arc``: angles that limit
    the strips, radians from u to v.
    """
    angles = arc[0] + (np.arange(count) + 0.5) / count * (arc[1] - arc[0])
    strips = Sectors(centre, radius, angles, search, width)
    first = _collected(image, strips, settings, which)
    circle = fit_circle(first.edges).shape
    radial = strips.middles - circle.centre  # places relative to the better centre
    angles = np.arctan2(radial[:, 1], radial[:, 0])
    width *= min(circle.radius / radius, 1.0)
    strips = Sectors(circle.centre, circle.radius, angles, min(search, _short(first)), width)
    return _collected(image, strips, settings, "nearest")


def _collected(
    image: Image, strips: Strips | Sectors, settings: EdgeSettings, which: Choice
) -> FoundShape:
    """Return the chosen edge of each strip; raise NotMeasuredError if too few strips have one."""
    owners, edges, troubles = [], [], []
    for owner, strip_edges in enumerate(find_edges(image, strips, settings)):
        try:
            edges.append(choose(strip_edges, which))
        except NotMeasuredError as trouble:
            troubles.append(trouble)
        else:
            owners.append(owner)
    number = len(edges) + len(troubles)
    if len(edges) < MIN_FOUND_SHARE * number:
        raise _too_few_error(troubles, number)
    places = np.array([edge.place for edge in edges])
    noises = np.array([edge.noise for edge in edges])
    noise = float(np.median(noises))
    noises = np.where(noises > OWN_NOISE_FACTOR * noise, noises, noise)
    blur = math.sqrt(float(np.median([edge.blur for edge in edges])) ** 2 + PIXEL_VARIANCE)
    strips_used, middle = strips.selected(np.array(owners)), np.zeros(len(owners))
    if isinstance(strips, Sectors):
        # blur moves the rim of a disc inwards by s^2 / (2 r)
        places = places + blur**2 / (2 * (strips.radius + places))
    unit = np.array([edge.unit_sigma for edge in edges])
    seen = Edges(
        strips_used.points(places, middle), np.array(strips_used.ahead(middle)), unit * noises
    )
    misfit = float(np.median([edge.misfit for edge in edges]))
    return FoundShape(seen, tuple(troubles), blur, misfit)


def _too_few_error(troubles: list[NotMeasuredError], number: int) -> NotMeasuredError:
    """Return the error for a line or a circle with too few strips with an edge."""
    kinds = [trouble.why for trouble in troubles]
    most = max(kinds, key=kinds.count)
    example = next(trouble for trouble in troubles if trouble.why is most)
    text = f"{len(troubles)} of {number} strips have no edge: {example.text}"
    return NotMeasuredError(most, text)


def _short(shape: FoundShape) -> float:
    """Return the length of a strip that contains an edge and both sides, pixels."""
    return 2 * (FIT_REACH_BLURS * shape.blur + FIT_REACH_PX)
