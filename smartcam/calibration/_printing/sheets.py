"""Make sheets to print: a target, the thesis' rays A and B from its origin, and rulers.

::

    sheet = make_sheet(Checkerboard(columns=9, rows=6, square=0.025), page="A4")
    Path("sheet.svg").write_text(sheet.svg())
    Path("sheet.pdf").write_bytes(sheet.pdf())
    ...
    target = scaled(sheet.target, (99.2, 99.3))  # measured lengths of the rulers, mm

A description is printed on each sheet; both files carry the target's description, as
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

from smartcam._argument_checks import a_number, each, takes
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
from smartcam.calibration._printing.shapes import MM_PER_METRE, Box, ink, quartered
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
"""Largest deviation of a printer's scale, as a part of it."""

MAX_UNEQUAL_SCALES: Final = 0.005
"""Largest difference between the scales along x and y, as a part: about that of reading a ruler
twice."""

DIGITS: Final = 9
"""Digits of a length in metres: nanometres."""


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
        number = isinstance(self.diameter, int | float) and not isinstance(self.diameter, bool)
        if not (number and math.isfinite(self.diameter) and self.diameter > 0):
            raise Code.SHAPE.refusal(
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
        return _data(self.target)

    @property
    def id(self) -> str:
        """Eight hexadecimal digits, printed on the sheet; the same for every page and format."""
        return _identity(self.target)

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


@takes(page=check_text)
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
    pattern, box = _pattern(target)
    width, height = page_size(page)
    turns = [(width, height), (height, width)] if page in PAGES_MM else [(width, height)]
    marked = isinstance(target, Checkerboard) and target.origin_mark
    pitch = _pitch(target)
    layouts = [
        PageLayout(
            box,
            pitch=pitch,
            areas=AREA_REACH_SQUARES * pitch if marked else 0.0,
            texts=(_title(target), ADVICE.format(origin=ORIGINS[type(target)], ruler=RULER_MM)),
            width=wide,
            height=high,
        )
        for wide, high in turns
    ]
    layout = min(layouts, key=lambda layout: layout.excess)
    if layout.excess > 0:
        raise _page_too_small_error(target, page, layout)
    moved = (_moved(shape, *layout.origin) for shape in pattern)
    return Sheet(
        target=target,
        width=layout.width,
        height=layout.height,
        origin=layout.origin,
        shapes=(*moved, *layout.furniture()),
    )


def _page_too_small_error(target: Target | Rays, page: str, layout: PageLayout) -> CalibrationError:
    needed = (layout.needed_width, layout.needed_height)
    size = (layout.width, layout.height)
    over = [
        f"{need - available:.1f} mm too {side}"
        for need, available, side in zip(needed, size, ("wide", "high"), strict=True)
        if need > available
    ]
    text = f"{size[0]:g} x {size[1]:g} mm"
    named = f"{page} ({text})" if page in PAGES_MM else text
    return Code.PAGE_TOO_SMALL.refusal(
        f"{_title(target).partition(': ')[2]}: does not fit on {named}: with rays, rulers and a "
        f"border of {BORDER_MM:g} mm it takes {needed[0]:.1f} x {needed[1]:.1f} mm, "
        f"{' and '.join(over)}",
        needed,
        size,
    )


def on_paper(data: Mapping[str, Any]) -> Target | Rays:
    """Return the target, or the rays, that a sheet's ``data`` describes; raise SHAPE otherwise."""
    if data.get("kind") != Rays.kind or set(data) != {"kind", "diameter"}:
        return target_from_data(data)
    return Rays(diameter=data["diameter"])


def page_size(page: str) -> tuple[float, float]:
    """Return a page's width and height, mm; raise SHAPE if it has none."""
    if page in PAGES_MM:
        return PAGES_MM[page]
    sides = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)", page)
    size = (float(sides[1]), float(sides[2])) if sides else (0.0, 0.0)
    if not 0 < min(size) <= max(size) <= MAX_PAGE_MM:
        raise Code.SHAPE.refusal(
            f"page: expected one of {', '.join(PAGES_MM)}, or width and height in mm up to "
            f"{MAX_PAGE_MM:g}, such as 300x200, got {page[:64]!r}",
            list(PAGES_MM),
            page[:64],
        )
    return size


@takes(measured_ruler=each(a_number, 2))
def scaled(target: T, measured_ruler: tuple[float, float]) -> T:
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
            raise Code.SCALE_MISMATCH.refusal(
                f"ruler along {axis}: expected {RULER_MM:g} mm within {MAX_SCALE_CHANGE:.0%}, "
                f"got {RULER_MM * factor:g} mm; print at 100 %, not fitted to the page",
                RULER_MM,
                RULER_MM * factor,
            )
    if abs(factors[0] - factors[1]) > MAX_UNEQUAL_SCALES:
        raise Code.SCALE_MISMATCH.refusal(
            f"rulers: expected the same length along x and y within {MAX_UNEQUAL_SCALES:.1%}, "
            f"got {measured_ruler[0]:g} and {measured_ruler[1]:g} mm; measure again, or print "
            "with another printer",
            MAX_UNEQUAL_SCALES,
            tuple(measured_ruler),
        )
    return resized(target, sum(factors) / 2, DIGITS)


# ---------------------------------------------------------------------- texts


def _data(target: Target | Rays) -> dict[str, Any]:
    return {"kind": target.kind, **dataclasses.asdict(target)}


def _identity(target: Target | Rays) -> str:
    text = json.dumps(_data(target), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _title(target: Target | Rays) -> str:
    match target:
        case Checkerboard():
            marked = ", marked origin" if target.origin_mark else ""
            about = (
                f"checkerboard, {target.columns} x {target.rows} corners, "
                f"squares of {_mm(target.square)}{marked}"
            )
        case Charuco():
            legacy = ", legacy pattern" if target.legacy_pattern else ""
            about = (
                f"ChArUco, {target.columns} x {target.rows} squares of {_mm(target.square)}, "
                f"markers of {_mm(target.marker)}, {target.dictionary}{legacy}"
            )
        case CircleGrid():
            kind = "asymmetric circles" if target.asymmetric else "circles"
            origin = target.origin_diameter
            larger = "" if origin is None else f", origin {_mm(origin)}"
            about = (
                f"{kind}, {target.columns} x {target.rows}, {_mm(target.spacing)} apart, "
                f"diameter {_mm(target.diameter)}{larger}"
            )
        case MarkerGrid():
            kind = "AprilGrid of Kalibr" if target.kalibr else "grid of markers"
            about = (
                f"{kind}, {target.columns} x {target.rows} of {_mm(target.marker)}, "
                f"{_mm(target.gap)} apart, {target.dictionary} from {target.first_id}"
            )
        case Rays():
            about = f"rays A and B, origin mark of {_mm(target.diameter)}"
    return f"smartcam sheet {_identity(target)}: {about}"


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


def _pattern(target: Target | Rays) -> tuple[tuple[Polygon | Disc, ...], Box]:
    check_type(target, (Checkerboard, Charuco, CircleGrid, MarkerGrid, Rays), "make_sheet: target")
    if isinstance(target, Rays):
        return quartered(MM_PER_METRE * target.diameter / 2)
    return ink(target)


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


def _moved(shape: Polygon | Disc, x: float, y: float) -> Shape:
    if isinstance(shape, Polygon):
        return Polygon(tuple((x + one, y + other) for one, other in shape.points))
    return Disc((x + shape.centre[0], y + shape.centre[1]), shape.radius)
