"""Make sheets to print: a target, two rays A and B from its origin along x and y, and rulers.

::

    sheet = make_sheet(Checkerboard(columns=9, rows=6, square=0.025), page="A4")
    Path("sheet.svg").write_text(sheet.svg())
    Path("sheet.pdf").write_bytes(sheet.pdf())
    ...
    target = scale_target(sheet.target, (99.2, 99.3))  # measured lengths of the rulers, mm

A title is printed on each sheet. The SVG and the PDF also hold the target's description as JSON, as
:func:`~smartcam.calibration.target_from_data` reads it.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Final, TypeVar

from smartcam._argument_checks import a_number, check_arguments, each
from smartcam._arguments import check_text
from smartcam.calibration._printing.page import (
    Disc,
    Polygon,
    PrintedPage,
    pdf,
    svg,
)
from smartcam.calibration._printing.page_layout import (
    AREA_REACH_SQUARES,
    BORDER_MM,
    RULER_MM,
    PageLayout,
)
from smartcam.calibration._printing.shapes import (
    MM_PER_METRE,
    Box,
    origin_mark_shapes,
    pattern_shapes,
)
from smartcam.calibration._targets import (
    Charuco,
    Checkerboard,
    CircleGrid,
    MarkerGrid,
    resized,
    target_from_data,
)
from smartcam.calibration._views import check_type
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.calibration._printing.page import Shape
    from smartcam.calibration._targets import Target
    from smartcam.exceptions import CalibrationError

PAGES_MM: Final[Mapping[str, tuple[float, float]]] = {
    "A5": (148.0, 210.0),
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "Letter": (215.9, 279.4),
    "Legal": (215.9, 355.6),
    "Tabloid": (279.4, 431.8),
}
"""Width and height of pages, mm; a sheet uses them in portrait or landscape format, as it fits."""

MAX_PAGE_MM: Final = 3000.0
"""Longest side of a page, mm."""

MAX_SCALE_CHANGE: Final = 0.05
"""Largest deviation of a printer's scale, as a fraction of it."""

MAX_SCALE_DIFFERENCE: Final = 0.005
"""Largest difference between the scales along x and y, as a fraction of them: about the error of
reading a ruler twice."""

LENGTH_DIGITS: Final = 9
"""Number of decimals of a length in metres: nanometres."""


@dataclass(frozen=True, kw_only=True)
class Rays:
    """A sheet of only rays and an origin mark, for a camera that localizes the mark by itself.

    Attributes:
        diameter: diameter of the origin mark, metres; the mark has two black quarters, which meet
            in the origin, and a white dot in the quarter between the rays.
    """

    kind: ClassVar[str] = "rays"

    diameter: float = 0.02

    def __post_init__(self) -> None:
        is_number = isinstance(self.diameter, int | float) and not isinstance(self.diameter, bool)
        if not (is_number and math.isfinite(self.diameter) and self.diameter > 0):
            raise Code.SHAPE.error(
                f"rays: expected diameter to be a length in metres, got {self.diameter!r}",
                "metres",
                self.diameter,
            )


T = TypeVar("T", bound=Checkerboard | Charuco | CircleGrid | MarkerGrid | Rays)


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A target on a page.

    Attributes:
        target: target, or rays, on the sheet.
        width: width of the page, mm.
        height: height of the page, mm.
        origin: the target's origin from the page's lower left corner, mm; x and y are those of the
            page.
        shapes: printed shapes.
    """

    target: Target | Rays
    width: float
    height: float
    origin: tuple[float, float]
    shapes: tuple[Shape, ...]

    @property
    def data(self) -> dict[str, Any]:
        """Description of the target, as JSON takes it."""
        return _description(self.target)

    @property
    def id(self) -> str:
        """Eight hexadecimal digits, printed on the sheet; the same for every page and format."""
        return _sheet_id(self.target)

    @property
    def title(self) -> str:
        """One line with id, kind, counts and lengths, as it is printed."""
        return _title(self.target)

    def svg(self) -> str:
        """Return the sheet as an SVG document to scale; its ``metadata`` is the description."""
        return svg(self._page)

    def pdf(self) -> bytes:
        """Return the sheet as a PDF document to scale; its subject is the description."""
        return pdf(self._page)

    @property
    def _page(self) -> PrintedPage:
        description = json.dumps(self.data)
        return PrintedPage(self.width, self.height, self.title, description, self.shapes)


@check_arguments(page=check_text)
def make_sheet(target: Target | Rays, *, page: str = "A4") -> Sheet:
    """Lay out a sheet.

    Args:
        target: target, or rays, on the sheet; lengths are printed as they are.
        page: one of ``PAGES_MM``, in portrait or landscape format as the target fits, or width and
            height in mm, such as ``300x200``, which is not turned.

    Raises:
        CalibrationError: PAGE_TOO_SMALL; SHAPE: the page is unknown, or the dictionary of markers
            is, or it has too few.
        MissingExtraError: a ChArUco target needs OpenCV.
    """
    pattern, box = _shapes_of(target)
    width, height = page_size(page)
    formats = [(width, height), (height, width)] if page in PAGES_MM else [(width, height)]
    has_mark = isinstance(target, Checkerboard) and target.origin_mark
    pitch = _pitch(target)
    layouts = [
        PageLayout(
            box,
            pitch=pitch,
            area_reach=AREA_REACH_SQUARES * pitch if has_mark else 0.0,
            texts=(_title(target), ADVICE.format(origin=ORIGINS[type(target)], ruler=RULER_MM)),
            width=format_width,
            height=format_height,
        )
        for format_width, format_height in formats
    ]
    layout = min(layouts, key=lambda layout: layout.excess)
    if layout.excess > 0:
        raise _page_too_small_error(target, page, layout)
    moved_shapes = (_move_shape(shape, *layout.origin) for shape in pattern)
    return Sheet(
        target=target,
        width=layout.width,
        height=layout.height,
        origin=layout.origin,
        shapes=(*moved_shapes, *layout.extra_shapes()),
    )


def _page_too_small_error(target: Target | Rays, page: str, layout: PageLayout) -> CalibrationError:
    needed = (layout.needed_width, layout.needed_height)
    size = (layout.width, layout.height)
    excesses = [
        f"{needed_side - available:.1f} mm too {side}"
        for needed_side, available, side in zip(needed, size, ("wide", "high"), strict=True)
        if needed_side > available
    ]
    size_text = f"{size[0]:g} x {size[1]:g} mm"
    page_text = f"{page} ({size_text})" if page in PAGES_MM else size_text
    return Code.PAGE_TOO_SMALL.error(
        f"{_title(target).partition(': ')[2]}: does not fit on {page_text}: with rays, rulers and "
        f"a border of {BORDER_MM:g} mm it takes {needed[0]:.1f} x {needed[1]:.1f} mm, "
        f"{' and '.join(excesses)}",
        needed,
        size,
    )


def target_from_description(data: Mapping[str, Any]) -> Target | Rays:
    """Return the target, or the rays, that a sheet's ``data`` describes; raise SHAPE otherwise."""
    if data.get("kind") != Rays.kind or set(data) != {"kind", "diameter"}:
        return target_from_data(data)
    return Rays(diameter=data["diameter"])


def page_size(page: str) -> tuple[float, float]:
    """Return width and height, mm, of the page that a text names; raise SHAPE for another text."""
    if page in PAGES_MM:
        return PAGES_MM[page]
    sides = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", page)
    size = (float(sides[1]), float(sides[2])) if sides else (0.0, 0.0)
    if not 0 < min(size) <= max(size) <= MAX_PAGE_MM:
        raise Code.SHAPE.error(
            f"page: expected one of {', '.join(PAGES_MM)}, or width and height in mm up to "
            f"{MAX_PAGE_MM:g}, such as 300x200, got {page[:64]!r}",
            list(PAGES_MM),
            page[:64],
        )
    return size


@check_arguments(measured_ruler=each(a_number, 2))
def scale_target(target: T, measured_ruler: tuple[float, float]) -> T:
    """Return a target with its lengths as they are on paper.

    Args:
        target: the target with its nominal lengths.
        measured_ruler: measured lengths of the printed rulers along x and along y, mm. A target has
            one scale, the mean of both. If the rulers differ by more than half a percent, the
            printer pulls the paper unevenly.

    Raises:
        CalibrationError: SCALE_MISMATCH: a ruler is more than 5 % off 100 mm, or the rulers differ
            by more than 0.5 %.
    """
    factors = [length / RULER_MM for length in measured_ruler]
    for axis, factor in zip("xy", factors, strict=True):
        if not abs(factor - 1) <= MAX_SCALE_CHANGE:
            raise Code.SCALE_MISMATCH.error(
                f"ruler along {axis}: expected {RULER_MM:g} mm within {MAX_SCALE_CHANGE:.0%}, "
                f"got {RULER_MM * factor:g} mm; print at 100 %, not fitted to the page",
                RULER_MM,
                RULER_MM * factor,
            )
    if abs(factors[0] - factors[1]) > MAX_SCALE_DIFFERENCE:
        raise Code.SCALE_MISMATCH.error(
            f"rulers: expected the same length along x and y within {MAX_SCALE_DIFFERENCE:.1%}, "
            f"got {measured_ruler[0]:g} and {measured_ruler[1]:g} mm; measure again, or print "
            "with another printer",
            MAX_SCALE_DIFFERENCE,
            tuple(measured_ruler),
        )
    return resized(target, sum(factors) / 2, LENGTH_DIGITS)


# ---------------------------------------------------------------------- texts


def _description(target: Target | Rays) -> dict[str, Any]:
    return {"kind": target.kind, **dataclasses.asdict(target)}


def _sheet_id(target: Target | Rays) -> str:
    text = json.dumps(_description(target), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _title(target: Target | Rays) -> str:
    match target:
        case Checkerboard():
            mark_text = ", marked origin" if target.origin_mark else ""
            summary = (
                f"checkerboard, {target.columns} x {target.rows} corners, "
                f"squares of {_mm(target.square)}{mark_text}"
            )
        case Charuco():
            legacy_text = ", legacy pattern" if target.legacy_pattern else ""
            summary = (
                f"ChArUco, {target.columns} x {target.rows} squares of {_mm(target.square)}, "
                f"markers of {_mm(target.marker)}, {target.dictionary}{legacy_text}"
            )
        case CircleGrid():
            kind = "asymmetric circles" if target.asymmetric else "circles"
            origin = target.origin_diameter
            origin_text = "" if origin is None else f", origin {_mm(origin)}"
            summary = (
                f"{kind}, {target.columns} x {target.rows}, {_mm(target.spacing)} apart, "
                f"diameter {_mm(target.diameter)}{origin_text}"
            )
        case MarkerGrid():
            kind = "AprilGrid of Kalibr" if target.kalibr else "grid of markers"
            summary = (
                f"{kind}, {target.columns} x {target.rows} of {_mm(target.marker)}, "
                f"{_mm(target.gap)} apart, {target.dictionary} from {target.first_id}"
            )
        case Rays():
            summary = f"rays A and B, origin mark of {_mm(target.diameter)}"
    return f"smartcam sheet {_sheet_id(target)}: {summary}"


ORIGINS: Final[Mapping[type[Target | Rays], str]] = {
    Checkerboard: "the corner of four squares",
    Charuco: "the corner of four squares",
    CircleGrid: "the middle of the dot",
    MarkerGrid: "the corner of the marker",
    Rays: "the point",
}
ADVICE: Final = (
    "Origin: {origin} where the lines of A and B meet. "
    "Print at 100 % and measure both rulers: {ruler:g} mm."
)


def _mm(metres: float) -> str:
    return f"{MM_PER_METRE * metres:.6g} mm"


# ---------------------------------------------------------------------- shapes


def _shapes_of(target: Target | Rays) -> tuple[tuple[Polygon | Disc, ...], Box]:
    check_type(target, (Checkerboard, Charuco, CircleGrid, MarkerGrid, Rays), "make_sheet: target")
    if isinstance(target, Rays):
        return origin_mark_shapes(MM_PER_METRE * target.diameter / 2)
    return pattern_shapes(target)


def _pitch(target: Target | Rays) -> float:
    """Return the distance between two neighbouring points, mm."""
    match target:
        case Checkerboard() | Charuco():
            return MM_PER_METRE * target.square
        case CircleGrid():
            return MM_PER_METRE * target.spacing
        case MarkerGrid():
            return MM_PER_METRE * (target.marker + target.gap)
        case Rays():
            return MM_PER_METRE * target.diameter


def _move_shape(shape: Polygon | Disc, x: float, y: float) -> Shape:
    if isinstance(shape, Polygon):
        return Polygon(tuple((x + px, y + py) for px, py in shape.points))
    return Disc((x + shape.centre[0], y + shape.centre[1]), shape.radius)
