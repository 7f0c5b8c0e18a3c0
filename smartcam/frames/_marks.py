"""Marks that are drawn on a picture to show people what a tool found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Role = Literal["found", "wrong", "region", "hint"]
Kind = Literal["points", "line", "polygon", "text"]

COLOURS: Final[dict[Role, tuple[int, int, int]]] = {
    "found": (46, 204, 64),
    "wrong": (255, 65, 54),
    "region": (0, 116, 217),
    "hint": (255, 220, 0),
}
"""Red, green and blue of each role's marks."""


@dataclass(frozen=True, slots=True)
class Drawing:
    """A mark that shows people what a tool saw.

    Attributes:
        kind: separate ``points``, a ``line`` through the points, a closed ``polygon``, or a
            ``text`` at the first point.
        points: positions in the picture, pixels; the centre of the upper left pixel is (0, 0).
        role: meaning of the mark: something ``found``, something ``wrong``, the searched
            ``region``, or a ``hint``.
        text: the text, or a word next to the first point.
    """

    kind: Kind
    points: tuple[tuple[float, float], ...]
    role: Role = "found"
    text: str = ""


def stroke_width(width: int, height: int) -> int:
    """Return the width of a mark's lines in a picture of this size, in pixels."""
    return max(1, round(max(width, height) / 800))
