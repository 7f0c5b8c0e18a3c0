"""Read outlines of parts from DXF and SVG files, and draw a picture of such a part.

The libraries ezdxf and fontTools read the curves. This module joins lines whose ends meet, and so
makes closed loops. A loop inside another loop is a hole.
"""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple
from xml.etree import ElementTree

import numpy as np

from smartcam._extras import load
from smartcam.inspection._locate.troubles import TeachingError, TeachingTrouble

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array

Unit = Literal["mm", "cm", "m", "inch", "px"]

MM_PER_UNIT: Final[dict[str, float]] = {
    "mm": 1.0,
    "cm": 10.0,
    "m": 1000.0,
    "inch": 25.4,
    "px": 25.4 / 96,
}
"""Millimetres of each unit; px is the pixel of CSS, the unit of a length without a unit in SVG."""

DXF_UNITS: Final = {1: "inch", 4: "mm", 5: "cm", 6: "m"}
"""Units by the numbers that a DXF file has for them in its header, as $INSUNITS."""

SVG_UNITS: Final = {"mm": "mm", "cm": "cm", "in": "inch", "px": "px"}
"""Units by the suffix of a number in SVG."""

SVG_INVISIBLE: Final = frozenset({"defs", "desc", "metadata", "namedview", "style", "title"})
"""Elements of SVG that draw nothing."""

MAX_FILE_BYTES: Final = 1 << 24
"""Largest number of bytes of an outline's file."""

MAX_POINTS: Final = 200_000
"""Largest number of corners of an outline, including corners of curves."""

MAX_NESTED: Final = 30
"""Largest depth of nested groups in SVG."""

MAX_OUTLINE_PX: Final = 4_000_000
"""Largest number of pixels of the picture of an outline."""

FLATNESS_PX: Final = 0.01
"""Largest distance between a curve and its polygon, pixels."""

JOIN_PX: Final = 0.1
"""Ends of two lines within this distance count as one point, pixels."""

MARGIN_PX: Final = 12
"""Margin around the part in its picture, pixels."""

SUBROWS: Final = 16
"""Number of lines through each row of pixels along which the area inside the outline is
measured."""

DARK, CONTRAST, NOISE, BLUR_PX = 60.0, 130.0, 1.0, 0.8
"""Grey level of the darker side, difference to the brighter one, noise in grey levels, and blur in
pixels."""


class Outline(NamedTuple):
    """Closed loops of a drawing."""

    loops: list[
        Array
    ]  # (K, 2) each, pixels of the part's picture from the drawing's origin, y down


def read_outline(
    path: Path, pixels_per_mm: float, unit: Unit | None, layers: Sequence[str]
) -> Outline:
    """Return the outline in a file of DXF or SVG.

    Raises:
        TeachingError: UNREADABLE, UNIT, UNSUPPORTED, NO_OUTLINE or TOO_LARGE.
        MissingExtraError: the extra ``inspection`` is not installed.
    """
    try:
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise TeachingError(
                TeachingTrouble.TOO_LARGE,
                f"{path} has {size} bytes, expected {MAX_FILE_BYTES} at most",
            )
        data = path.read_bytes()
    except OSError as exc:
        raise TeachingError(TeachingTrouble.UNREADABLE, f"{path}: {exc}") from exc
    kind = path.suffix.lower()
    if kind == ".dxf":
        lines = _dxf_lines(path, data, pixels_per_mm, unit, layers)
    elif kind == ".svg":
        lines = _svg_lines(path, data, pixels_per_mm, unit, layers)
    else:
        raise TeachingError(
            TeachingTrouble.UNREADABLE, f"{path}: expected a file with the ending .dxf or .svg"
        )
    outline_lines: list[Array] = []
    count = 0
    for line in lines:
        count += len(line)
        if count > MAX_POINTS or not np.isfinite(line).all():
            raise TeachingError(
                TeachingTrouble.TOO_LARGE,
                f"{path}: expected {MAX_POINTS} corners at most, all of them finite numbers",
            )
        if len(line) > 1:
            outline_lines.append(line)
    return Outline(_join_lines(path, outline_lines, pixels_per_mm))


def _join_lines(path: Path, lines: list[Array], pixels_per_mm: float) -> list[Array]:
    """Join lines (K, 2) to loops."""
    loops: list[Array] = []
    open_lines = list(lines)
    while open_lines:
        loop = open_lines.pop()
        while np.linalg.norm(loop[0] - loop[-1]) > JOIN_PX or len(loop) < 3:
            ends = np.array([line[[0, -1]] for line in open_lines]).reshape(-1, 2)
            distances = np.linalg.norm(ends - loop[-1], axis=1)
            if not len(distances) or distances.min() > JOIN_PX:
                x, y = loop[-1] / pixels_per_mm * [1.0, -1.0]
                raise TeachingError(
                    TeachingTrouble.NO_OUTLINE,
                    f"{path}: expected closed outlines, got a line that ends at {x:.4g}, {y:.4g} mm"
                    " (y up) and meets no other one there",
                )
            nearest = int(np.argmin(distances))
            other = open_lines.pop(nearest // 2)
            loop = np.concatenate([loop, other[::-1] if nearest % 2 else other])
        loops.append(loop)
    if not loops:
        raise TeachingError(
            TeachingTrouble.NO_OUTLINE, f"{path}: expected closed outlines, got no line at all"
        )
    return loops


# ---------------------------------------------------------------------- DXF


def _dxf_lines(
    path: Path, data: bytes, pixels_per_mm: float, unit: Unit | None, layers: Sequence[str]
) -> Iterator[Array]:
    ezdxf, paths = load("ezdxf"), load("ezdxf.path")
    disassemble = load("ezdxf.disassemble")
    if b"SECTION" not in data:
        raise TeachingError(TeachingTrouble.UNREADABLE, f"{path}: expected DXF")
    try:
        drawing = ezdxf.readfile(path)
        unit_name = unit or DXF_UNITS.get(int(drawing.header.get("$INSUNITS", 0)))
        if unit_name is None:
            raise TeachingError(
                TeachingTrouble.UNIT,
                f"{path}: its header names no known unit: set unit to one of "
                f"{', '.join(MM_PER_UNIT)}",
            )
        scale = MM_PER_UNIT[unit_name] * pixels_per_mm
        for entity in disassemble.recursive_decompose(drawing.modelspace()):
            if layers and entity.dxf.layer not in layers:
                continue
            try:
                curve = paths.make_path(entity)
            except TypeError as exc:
                raise TeachingError(
                    TeachingTrouble.UNSUPPORTED,
                    f"{path}: expected lines, arcs, circles, ellipses, polylines and splines, got "
                    f"{entity.dxftype()} in the layer {entity.dxf.layer!r}: name the layers with "
                    "the outline",
                ) from exc
            for part in curve.sub_paths():
                corners = np.array(
                    [tuple(point) for point in part.flattening(FLATNESS_PX / scale, 16)]
                )
                if len(corners) and np.ptp(corners[:, 2]) * scale > JOIN_PX:
                    raise TeachingError(
                        TeachingTrouble.UNSUPPORTED,
                        f"{path}: expected an outline in the plane of x and y, got "
                        f"{entity.dxftype()} whose z changes",
                    )
                yield corners[:, :2] * (scale, -scale)
    except TeachingError:
        raise
    except Exception as exc:
        raise TeachingError(TeachingTrouble.UNREADABLE, f"{path}: no DXF: {exc!r:.200}") from exc


# ---------------------------------------------------------------------- SVG


def _svg_lines(
    path: Path, data: bytes, pixels_per_mm: float, unit: Unit | None, layers: Sequence[str]
) -> Iterator[Array]:
    if b"<!ENTITY" in data:
        raise TeachingError(TeachingTrouble.UNREADABLE, f"{path}: expected SVG without entities")
    try:
        root = ElementTree.fromstring(data)  # noqa: S314 - bounded, and without entities
        if _tag(root) != "svg":
            raise TeachingError(TeachingTrouble.UNREADABLE, f"{path}: expected SVG")
        scale = pixels_per_mm * _svg_scale(path, root, unit)
        reader = _SvgReader(path, scale, layers)
        yield from reader.read(root, np.diag([scale, scale, 1.0]), not layers, 0)
    except TeachingError:
        raise
    except Exception as exc:
        raise TeachingError(TeachingTrouble.UNREADABLE, f"{path}: no SVG: {exc!r:.200}") from exc


def _tag(element: ElementTree.Element) -> str:
    return str(element.tag).rpartition("}")[2]


def _svg_scale(path: Path, root: ElementTree.Element, unit: Unit | None) -> float:
    """Return the millimetres of a user unit, by the drawing's width and ``viewBox``."""
    if unit is not None:
        return MM_PER_UNIT[unit]
    sizes = [_length(root.get(name, "")) for name in ("width", "height")]
    box = [
        float(number) for number in re.split(r"[\s,]+", root.get("viewBox", "").strip()) if number
    ]
    if None in sizes:
        raise TeachingError(
            TeachingTrouble.UNIT,
            f'{path}: its width and height have no unit, such as width="50mm": set unit to one of '
            f"{', '.join(MM_PER_UNIT)}",
        )
    millimetres = [(size[0] * MM_PER_UNIT[size[1]], size[1]) for size in sizes if size is not None]
    if not box:
        return MM_PER_UNIT["px"]
    across, down = (length[0] / side for length, side in zip(millimetres, box[2:], strict=True))
    if not (across > 0 and abs(down / across - 1) < 1e-3):
        raise TeachingError(
            TeachingTrouble.UNIT,
            f"{path}: width and height do not have the proportions of the viewBox: "
            f"{across:.4g} and {down:.4g} mm for a unit",
        )
    return across


def _length(text: str) -> tuple[float, str] | None:
    match = re.fullmatch(r"\s*([\d.eE+-]+)\s*(mm|cm|in|px)\s*", text)
    return None if match is None else (float(match[1]), SVG_UNITS[match[2]])


class _SvgReader:
    """Reads the shapes of an SVG file as lines."""

    def __init__(self, path: Path, scale: float, layers: Sequence[str]) -> None:
        self._path = path
        self._scale = scale
        self._layers = layers

    def read(
        self, element: ElementTree.Element, matrix: Array, in_layer: bool, depth: int
    ) -> Iterator[Array]:
        """Yield the lines (K, 2) of an element and of its children, in pixels.

        ``matrix``: from the element's coordinates to pixels; ``in_layer``: whether
        the element is in one of the layers.
        """
        if depth > MAX_NESTED:
            raise TeachingError(
                TeachingTrouble.UNSUPPORTED,
                f"{self._path}: expected {MAX_NESTED} groups in each other at most",
            )
        tag = _tag(element)
        style = _style(element)
        if tag in SVG_INVISIBLE or "none" in (element.get("display"), style.get("display")):
            return
        if "transform" in style:
            raise TeachingError(
                TeachingTrouble.UNSUPPORTED,
                f"{self._path}: expected transforms as attributes, got one in the style of a "
                f"{tag!r:.40}",
            )
        label = element.get("{http://www.inkscape.org/namespaces/inkscape}label")
        in_layer = in_layer or element.get("id") in self._layers or label in self._layers
        matrix = matrix @ _matrix(element.get("transform", ""))
        if tag in {"svg", "g", "a"} and not (tag == "svg" and depth):
            for child in element:
                yield from self.read(child, matrix, in_layer, depth + 1)
        elif in_layer:
            for line in self._shape(tag, element, self._flatness(matrix)):
                with np.errstate(all="ignore"):
                    yield line @ matrix[:2, :2].T + matrix[:2, 2]

    def _flatness(self, matrix: Array) -> float:
        """Return the flatness in an element's coordinates."""
        return FLATNESS_PX / max(math.sqrt(abs(float(np.linalg.det(matrix[:2, :2])))), 1e-9)

    def _shape(self, tag: str, element: ElementTree.Element, flatness: float) -> Iterator[Array]:
        def number(name: str, default: float = 0.0) -> float:
            return float(element.get(name, default))

        if tag == "path":
            yield from _path_lines(element.get("d", ""), flatness)
        elif tag in {"polygon", "polyline"}:
            numbers = [
                float(number) for number in re.split(r"[\s,]+", element.get("points", "")) if number
            ]
            corners = np.array(numbers).reshape(-1, 2)
            yield corners if tag == "polyline" else _loop(corners)
        elif tag == "line":
            yield np.array([[number(f"x{end}"), number(f"y{end}")] for end in (1, 2)])
        elif tag in {"circle", "ellipse"}:
            radii = [number("r")] * 2 if tag == "circle" else [number("rx"), number("ry")]
            turns = np.linspace(0, 2 * math.pi, 1 + _corner_count(max(radii), flatness))
            around = np.column_stack([np.cos(turns), np.sin(turns)]) * radii
            yield around + np.array([number("cx"), number("cy")])
        elif tag == "rect":
            sides = np.array([number("width"), number("height")])
            across = number("rx", number("ry"))
            rounded = np.minimum([across, number("ry", across)], sides / 2)
            with np.errstate(all="ignore"):
                box = np.array([number("x"), number("y")]) + _round_box(sides, rounded, flatness)
            yield box
        else:
            raise TeachingError(
                TeachingTrouble.UNSUPPORTED,
                f"{self._path}: expected paths, polygons, lines, circles, ellipses and rectangles, "
                f"got {tag!r:.40}: name the groups with the outline as layers",
            )


def _style(element: ElementTree.Element) -> dict[str, str]:
    """Return the values of an element's style, by name."""
    pairs = (declaration.partition(":") for declaration in element.get("style", "").split(";"))
    return {name.strip(): value.strip() for name, _, value in pairs if name.strip()}


def _round_box(sides: Array, radii: Array, flatness: float) -> Array:
    """Return the outline of a box at the origin with round corners; radii of 0: sharp corners."""
    turns = np.linspace(0, math.pi / 2, 1 + _corner_count(float(radii.max()), flatness))
    quarter = np.column_stack([np.cos(turns), np.sin(turns)]) if radii.all() else np.zeros((1, 2))
    corner_arcs = []
    for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1)):  # each corner begins where the last one ended
        corner = quarter if x * y > 0 else quarter[::-1]
        middle = sides / 2 + [x, y] * (sides / 2 - (radii if radii.all() else 0))
        corner_arcs.append(middle + corner * radii * [x, y])
    return _loop(np.concatenate(corner_arcs))


def _loop(corners: Array) -> Array:
    return np.concatenate([corners, corners[:1]])


def _corner_count(radius: float, flatness: float) -> int:
    """Return the number of corners of a polygon that is within ``flatness`` of a circle."""
    return max(16, math.ceil(math.pi / math.sqrt(2 * min(flatness / max(radius, 1e-9), 0.5))))


def _path_lines(text: str, flatness: float) -> Iterator[Array]:
    """Yield the lines of a path's data; curves become polygons."""
    pen = load("fontTools.pens.recordingPen").RecordingPen()
    load("fontTools.svgLib.path").parse_path(text, pen)
    line: list[Any] = []
    for command, places in pen.value:
        if command == "moveTo":
            line = list(places)
        elif command == "lineTo":
            line += places
        elif command in {"curveTo", "qCurveTo"}:
            line += _flatten_curve(np.array([line[-1], *places], np.float64), flatness)
        else:
            yield _loop(np.array(line)) if command == "closePath" else np.array(line)


def _flatten_curve(corners: Array, flatness: float) -> list[Any]:
    """Return the corners of a polygon along a Bezier curve, without the first one."""
    reach = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
    count = min(2 * _corner_count(reach, flatness), 2000)
    fractions = np.linspace(0, 1, count + 1)[1:, None]
    order = len(corners) - 1
    weights = [
        math.comb(order, k) * fractions**k * (1 - fractions) ** (order - k)
        for k in range(order + 1)
    ]
    return [
        *np.sum([weight * corner for weight, corner in zip(weights, corners, strict=True)], axis=0)
    ]


_TRANSFORM: Final = re.compile(r"\s*(\w+)\s*\(([^)]*)\)\s*,?")


def _matrix(text: str) -> Array:
    """Return the matrix (3, 3) of a transform attribute."""
    matrix = np.eye(3)
    at = 0
    while at < len(text):
        match = _TRANSFORM.match(text, at)
        if match is None:
            raise ValueError(f"transform: expected functions, got {text[at:]!r:.60}")
        at = match.end()
        matrix = matrix @ _function_matrix(
            match[1], [float(x) for x in re.findall(r"[^\s,]+", match[2])]
        )
    return matrix


def _function_matrix(name: str, values: list[float]) -> Array:
    match name, values:
        case "matrix", [a, b, c, d, e, f]:
            return np.array([[a, c, e], [b, d, f], [0, 0, 1]])
        case "translate", [x, *rest]:
            return np.array([[1, 0, x], [0, 1, rest[0] if rest else 0], [0, 0, 1]])
        case "scale", [x, *rest]:
            return np.diag([x, rest[0] if rest else x, 1.0])
        case "rotate", [degrees, *middle]:
            x, y = middle or (0.0, 0.0)
            cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
            return np.array(
                [[cos, -sin, x - cos * x + sin * y], [sin, cos, y - sin * x - cos * y], [0, 0, 1]]
            )
        case "skewX", [degrees]:
            return np.array([[1, math.tan(math.radians(degrees)), 0], [0, 1, 0], [0, 0, 1]])
        case "skewY", [degrees]:
            return np.array([[1, 0, 0], [math.tan(math.radians(degrees)), 1, 0], [0, 0, 1]])
        case _:
            raise ValueError(f"transform: {name} of {len(values)} numbers is not known")


# ---------------------------------------------------------------------- picture


def draw_outline(
    outline: Outline, *, bright: bool
) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Return the picture (H, W) of a part, and its first pixel's place in the drawing, pixels."""
    points = np.concatenate(outline.loops)
    low = np.floor(points.min(axis=0)).astype(int) - MARGIN_PX
    width, height = (np.ceil(points.max(axis=0)).astype(int) + MARGIN_PX + 1 - low).tolist()
    if width * height > MAX_OUTLINE_PX:
        raise TeachingError(
            TeachingTrouble.TOO_LARGE,
            f"the part has {width} x {height} pixels at this scale, {MAX_OUTLINE_PX} can be taught",
        )
    shares = _pixel_shares([loop - low + 0.5 for loop in outline.loops], (height, width))
    smooth = load("cv2", "inspection needs").GaussianBlur(shares, (0, 0), BLUR_PX)
    levels = DARK + CONTRAST * (smooth if bright else 1.0 - smooth)
    noise = np.random.default_rng(1).normal(scale=NOISE, size=levels.shape)
    picture: NDArray[np.uint8] = np.rint(levels + noise).clip(0, 255).astype(np.uint8)
    return picture, (float(low[0]), float(low[1]))


def _pixel_shares(loops: list[Array], shape: tuple[int, int]) -> Array:
    """Return the share (H, W) of each pixel that lies in an odd number of loops."""
    rows: list[NDArray[np.int_]] = []
    crossings: list[Array] = []
    for loop in loops:
        for (ax, ay), (bx, by) in zip(loop, np.roll(loop, -1, axis=0), strict=True):
            begin, end = (
                math.ceil(min(ay, by) * SUBROWS - 0.5),
                math.ceil(max(ay, by) * SUBROWS - 0.5),
            )
            if end > begin:
                row = np.arange(begin, end)
                rows.append(row)
                crossings.append(ax + ((row + 0.5) / SUBROWS - ay) / (by - ay) * (bx - ax))
    row, across = np.concatenate(rows), np.concatenate(crossings)
    order = np.lexsort((across, row))
    row, across = row[order], across[order]
    # crossings of a line alternately enter and leave the part; each changes all pixels to its right
    signs = np.where(np.arange(len(row)) % 2, -1.0, 1.0) / SUBROWS
    first = np.floor(across).astype(int)
    canvas = np.zeros((shape[0], shape[1] + 2))
    np.add.at(canvas, (row // SUBROWS, first), signs * (first + 1 - across))
    np.add.at(canvas, (row // SUBROWS, first + 1), signs * (across - first))
    return np.cumsum(canvas, axis=1)[:, : shape[1]]
