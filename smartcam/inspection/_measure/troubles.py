"""Reasons for a missing measurement."""

from __future__ import annotations

import enum


class NoValueReason(enum.Enum):
    """A reason why there is no value."""

    OUTSIDE = "outside"
    """A part of the region lies outside of the picture."""
    TOO_LARGE = "too large"
    """The region has more pixels than the limit."""
    NO_EDGE = "no edge"
    """The grey levels show no edge of the wanted kind."""
    SEVERAL_EDGES = "several edges"
    """There are several edges, or pairs of edges, where one was expected."""
    AT_BORDER = "at border"
    """The edge lies at the end of its region: one side is not visible."""
    SATURATED = "saturated"
    """Grey levels beside the edge are saturated, which moves the edge."""
    BLURRED = "blurred"
    """The edge is more blurred than the settings allow."""
    NOISY = "noisy"
    """The edge's standard deviation from noise is too large."""
    NO_STEP = "no step"
    """Grey levels change, but not as a step between two levels."""
    FEW_EDGES = "few edges"
    """Too few edges were found for a line or a circle."""
    NO_AGREEMENT = "no agreement"
    """No line or circle agrees with enough of the edges."""
    UNCERTAIN = "uncertain"
    """The edges do not determine the result: the arc is too short, or lines are nearly parallel."""
    OFF_CALIBRATION = "off calibration"
    """The calibration does not cover this part of the picture."""


class NotMeasuredError(Exception):
    """Error for a missing value.

    Args:
        reason: reason as an enum.
        text: reason as a text.
    """

    def __init__(self, reason: NoValueReason, text: str) -> None:
        super().__init__(reason, text)
        self.reason: NoValueReason = reason
        self.text: str = text

    def __str__(self) -> str:
        return self.text
