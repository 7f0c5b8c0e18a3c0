"""Reasons why a part cannot be taught."""

from __future__ import annotations

import enum

from smartcam.exceptions import ConfigurationError


class TeachingTrouble(enum.Enum):
    """A reason why a part cannot be taught."""

    EMPTY = "empty"
    """The region has no pixel in the picture."""
    FEW_EDGES = "few edges"
    """Too few edges whose place can be measured to a fraction of a pixel."""
    BORDER = "border"
    """Too many of the edges lie at the border of the region: it cuts the part."""
    ONE_DIRECTION = "one direction"
    """All edges run in one direction, and do not determine the place along it."""
    TOO_LARGE = "too large"
    """The region or the outline has more pixels, corners or bytes than the limit."""
    UNREADABLE = "unreadable"
    """The file with the outline cannot be read."""
    UNIT = "unit"
    """The file with the outline does not name its unit."""
    UNSUPPORTED = "unsupported"
    """The file with the outline has an object that is no line or curve in a plane."""
    NO_OUTLINE = "no outline"
    """The file's lines form no closed outline."""


class TeachingError(ConfigurationError):
    """A part cannot be taught.

    Args:
        reason: reason for programs, such as ``FEW_EDGES``.
        text: reason for people.

    Attributes:
        reason: reason for programs, such as ``FEW_EDGES``.
    """

    def __init__(self, reason: TeachingTrouble, text: str) -> None:
        super().__init__(f"{reason.value}: {text}")
        self.reason: TeachingTrouble = reason
