"""Write a page of black shapes in true size, as SVG and as PDF.

A page's coordinates are millimetres from its lower left corner, y up. Shapes are filled and have no
stroke, so the printed outline is exactly that of the coordinates. The same shapes always give the
same bytes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Final, TypeAlias, assert_never

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

Point: TypeAlias = tuple[float, float]
"""x and y, mm."""

POINTS_PER_MM: Final = 72 / 25.4
"""PDF's units (points) per millimetre."""

ARC_CONTROL_RATIO: Final = 4 / 3 * (math.sqrt(2) - 1)
"""Distance between an end of a quarter circle and the next control point of its Bezier curve, as a
fraction of the radius; the curve is off by at most 0.03 % of the radius."""


@dataclass(frozen=True, slots=True)
class Polygon:
    """A filled polygon; points in clockwise order make a hole in the polygon around it."""

    points: tuple[Point, ...]


@dataclass(frozen=True, slots=True)
class Disc:
    """A filled circle."""

    centre: Point
    radius: float


@dataclass(frozen=True, slots=True)
class Label:
    """A line of text; ``place`` is its lower left corner, ``size`` its height."""

    place: Point
    text: str
    size: float
    runs_upwards: bool = False


Shape: TypeAlias = Polygon | Disc | Label
"""A polygon, a disc or a label."""


@dataclass(frozen=True, slots=True)
class PrintedPage:
    """The content of one sheet of paper."""

    width: float  # width, mm
    height: float  # height, mm
    title: str  # title of the document
    description: str  # hidden ASCII text that the document carries
    shapes: tuple[Shape, ...]  # visible shapes


def rectangle(left: float, low: float, width: float, height: float) -> Polygon:
    """Return a rectangle from its lower left corner."""
    right, high = left + width, low + height
    return Polygon(((left, low), (right, low), (right, high), (left, high)))


def svg(page: PrintedPage) -> str:
    """Return an SVG document whose coordinates are in millimetres."""
    width, height = _length(page.width), _length(page.height)
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}" shape-rendering="geometricPrecision">',
        f"<title>{escape(page.title)}</title>",
        f"<metadata>{escape(page.description, quote=False)}</metadata>",
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
        '<path fill="#000" d="',
        *_svg_paths(page.shapes, page.height),
        '"/>',
        '<g fill="#000" font-family="Helvetica, Arial, sans-serif">',
        *_svg_texts(page.shapes, page.height),
        "</g>",
        "</svg>",
    ]
    return "\n".join(lines) + "\n"


def _svg_paths(shapes: Sequence[Shape], height: float) -> Iterator[str]:
    for shape in shapes:
        match shape:
            case Polygon(points):
                corners = " ".join(_lengths(x, height - y) for x, y in points)
                yield f"M{corners}Z"
            case Disc((x, y), radius):
                r = _length(radius)
                left, right = (_lengths(x + side * radius, height - y) for side in (-1, 1))
                yield f"M{left}A{r} {r} 0 0 0 {right}A{r} {r} 0 0 0 {left}Z"
            case Label():
                pass
            case _:
                assert_never(shape)


def _svg_texts(shapes: Iterable[Shape], height: float) -> Iterator[str]:
    for shape in shapes:
        if isinstance(shape, Label):
            x, y = _length(shape.place[0]), _length(height - shape.place[1])
            turn = f' transform="rotate(-90 {x} {y})"' if shape.runs_upwards else ""
            yield (
                f'<text x="{x}" y="{y}" font-size="{_length(shape.size)}"{turn}>'
                f"{escape(shape.text)}</text>"
            )


def pdf(page: PrintedPage) -> bytes:
    """Return a PDF document of one page, which asks its viewer to print it at its true size."""
    scale = f"{POINTS_PER_MM:.9f} 0 0 {POINTS_PER_MM:.9f} 0 0 cm"
    lines = [scale, *_pdf_paths(page.shapes), "f", *_pdf_texts(page.shapes)]
    content = "\n".join(lines).encode("latin-1", "replace")
    size = " ".join(_length(POINTS_PER_MM * side) for side in (page.width, page.height))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {size}] /Contents 4 0 R "
        "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%b\nendstream" % (len(content), content),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        f"<< /Title {_pdf_string(page.title)} /Subject {_pdf_string(page.description)} >>".encode(),
    ]
    document = bytearray(b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n")
    offsets = []
    for number, body in enumerate(objects, 1):
        offsets.append(len(document))
        document += b"%d 0 obj\n%b\nendobj\n" % (number, body)
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    table_offset = len(document)
    document += (
        f"xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}"
        f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R /Info 6 0 R >>\n"
        f"startxref\n{table_offset}\n%%EOF\n"
    ).encode()
    return bytes(document)


def _pdf_paths(shapes: Iterable[Shape]) -> Iterator[str]:
    for shape in shapes:
        match shape:
            case Polygon(points):
                first, *others = (_lengths(x, y) for x, y in points)
                yield " ".join([f"{first} m", *(f"{point} l" for point in others), "h"])
            case Disc((x, y), radius):
                yield _pdf_circle(x, y, radius)
            case Label():
                pass
            case _:
                assert_never(shape)


def _pdf_circle(x: float, y: float, radius: float) -> str:
    commands = [f"{_lengths(x + radius, y)} m"]
    for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        first_control, second_control, end = (
            _lengths(x + radius * (dx * a - dy * b), y + radius * (dy * a + dx * b))
            for a, b in ((1, ARC_CONTROL_RATIO), (ARC_CONTROL_RATIO, 1), (0, 1))
        )
        commands.append(f"{first_control} {second_control} {end} c")
    return " ".join([*commands, "h"])


def _pdf_texts(shapes: Iterable[Shape]) -> list[str]:
    return [
        f"BT /F {_length(shape.size)} Tf {'0 1 -1 0' if shape.runs_upwards else '1 0 0 1'} "
        f"{_lengths(*shape.place)} Tm {_pdf_string(shape.text)} Tj ET"
        for shape in shapes
        if isinstance(shape, Label)
    ]


def _pdf_string(text: str) -> str:
    """Return a text as a PDF string."""
    for sign in "\\()":
        text = text.replace(sign, f"\\{sign}")
    return f"({text})"


def _lengths(x: float, y: float) -> str:
    return f"{_length(x)} {_length(y)}"


def _length(value: float) -> str:
    """Return a length as text, rounded to a tenth of a micrometre."""
    text = f"{value:.4f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
