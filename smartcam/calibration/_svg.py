"""Write SVG elements; the same arguments give the same bytes on every machine."""

from __future__ import annotations

import math
from html import escape
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.geometry._inside import Array

    Place = Array | Sequence[float]

STYLE: Final = """\
text { font: 13px sans-serif; fill: #333 } .title { font-size: 16px } .small { font-size: 11px }
.paper { fill: #fff } .first { fill: #0072b2 } .second { fill: #d55e00 } .off { fill: #999 }
.axis { stroke: #777; fill: none } .level { fill: none; stroke-width: 1.5; stroke-dasharray: 6 4 }
.first-line { stroke: #0072b2 } .second-line { stroke: #d55e00 }
.board { fill: #0072b2; fill-opacity: 0.12; stroke: #0072b2 }
.board-off { fill: #999; fill-opacity: 0.12; stroke: #999; stroke-dasharray: 5 3 }
.camera { fill: #d55e00; fill-opacity: 0.15; stroke: #d55e00; stroke-width: 1.2 }
.halo { paint-order: stroke; stroke: #fff; stroke-width: 3 }
.on-map { fill: #fff; paint-order: stroke; stroke: #222; stroke-width: 3 }
.seen { stroke: #fff; stroke-width: 2; stroke-linecap: round; stroke-opacity: 0.7 }
.mark { fill: none; stroke: #fff; stroke-width: 2 } .mark-rim { fill: none; stroke: #222; \
stroke-width: 4 }
@media (prefers-color-scheme: dark) {
text { fill: #ddd } .paper { fill: #181818 } .first { fill: #56b4e9 } .second { fill: #f0a040 }
.off { fill: #777 } .axis { stroke: #999 } .first-line { stroke: #56b4e9 }
.second-line { stroke: #f0a040 } .board { fill: #56b4e9; stroke: #56b4e9 }
.camera { fill: #f0a040; stroke: #f0a040 } .halo { stroke: #181818 } .on-map { fill: #fff } }"""
"""Style sheet of pictures that adapt to a light or a dark page, in colours that colour-blind people
can distinguish.

Source of the colours: Okabe and Ito, Color Universal Design (2008).
"""


def document(width: float, height: float, parts: Iterable[str], style: str = STYLE) -> str:
    """Return an SVG document of a fixed size with ``parts`` as its elements, each on a line."""
    size = f"{width:.0f}", f"{height:.0f}"
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{size[0]}" height="{size[1]}" '
            f'viewBox="0 0 {size[0]} {size[1]}">',
            f"<style>{style}</style>",
            f'<rect width="{size[0]}" height="{size[1]}" class="paper"/>',
            *parts,
            "</svg>\n",
        ]
    )


def line(start: Place, end: Place, css_class: str, attributes: str = "") -> str:
    """Return a line; ``attributes`` begins with a space."""
    return (
        f'<line x1="{start[0]:.2f}" y1="{start[1]:.2f}" x2="{end[0]:.2f}" y2="{end[1]:.2f}" '
        f'class="{css_class}"{attributes}/>'
    )


def text(place: Place, content: str, css_class: str = "", attributes: str = "") -> str:
    """Return a text that begins at ``place``; ``attributes`` begins with a space."""
    class_attribute = f' class="{css_class}"' if css_class else ""
    return (
        f'<text x="{place[0]:.2f}" y="{place[1]:.2f}"{class_attribute}{attributes}>'
        f"{escape(content)}</text>"
    )


def circle(place: Place, radius: float, css_class: str) -> str:
    """Return a circle around a place."""
    return f'<circle cx="{place[0]:.2f}" cy="{place[1]:.2f}" r="{radius:g}" class="{css_class}"/>'


def polygon(corners: Array, css_class: str, title: str = "") -> str:
    """Return a polygon of corners (N, 2); ``title`` is shown while the pointer is on it."""
    places = " ".join(f"{x:.2f},{y:.2f}" for x, y in corners.tolist())
    return f'<polygon points="{places}" class="{css_class}"' + _tag_end("polygon", title)


def rectangle(place: Place, size: Place, paint_attribute: str, title: str = "") -> str:
    """Return a rectangle; ``paint_attribute`` is its ``class`` or ``fill`` attribute."""
    return (
        f'<rect x="{place[0]:.2f}" y="{place[1]:.2f}" width="{size[0]:.2f}" '
        f'height="{size[1]:.2f}" {paint_attribute}' + _tag_end("rect", title)
    )


def _tag_end(element: str, title: str) -> str:
    """Return the end of an element's start tag, its title if it has one, and its end tag."""
    return f"><title>{escape(title)}</title></{element}>" if title else "/>"


def round_down(wanted: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above ``wanted``."""
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * max(step for step in (1, 2, 5) if step * power <= wanted * (1 + 1e-9))
