"""Say why something could not be measured."""

from __future__ import annotations

import enum


class NoValueReason(enum.Enum):
    """A reason why there is no value."""

    OUTSIDE = "outside"
    """A part of the region lies outside of the picture."""
    TOO_LARGE = "too large"
    """The region has more pixels than are looked at."""
    NO_EDGE = "no edge"
    """No grey levels change as an edge of the wanted kind does."""
    TWO_EDGES = "two edges"
    """There are several edges where one was expected, or several pairs of them."""
    AT_BORDER = "at border"
    """The edge lies at the end of its region: one of its sides cannot be seen."""
    SATURATED = "saturated"
    """Grey levels beside the edge are cut off at black or at white, which moves the edge."""
    BLURRED = "blurred"
    """The edge is more blurred than the settings allow."""
    NOISY = "noisy"
    """Noise leaves the edge's place open by more than is useful."""
    NO_STEP = "no step"
    """Grey levels change, but not from one level to another one as an edge does."""
    FEW_EDGES = "few edges"
    """Too few edges were found for a line or a circle."""
    NO_AGREEMENT = "no agreement"
    """No line or circle agrees with enough of the edges."""
    UNCERTAIN = "uncertain"
    """The edges leave the result open: an arc that is too short, lines that are nearly parallel."""
    OFF_CALIBRATION = "off calibration"
    """The calibration says nothing about this part of the picture."""


class NotMeasuredError(Exception):
    """There is no value.

    Args:
        why: reason for programs.
        text: reason for people.
    """

    def __init__(self, why: NoValueReason, text: str) -> None:
        super().__init__(why, text)
        self.why: NoValueReason = why
        self.text: str = text

    def __str__(self) -> str:
        return self.text
