"""Define the model of a taught part, made from a picture or a drawn outline, and kept in a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from smartcam._arguments import (
    check_choice,
    check_flag,
    check_kind,
    check_number,
    check_path,
    check_text,
    wrong_argument,
)
from smartcam._extras import load
from smartcam._forks import cached_property
from smartcam._whole_files import replace_file
from smartcam.exceptions import ConfigurationError
from smartcam.inspection._locate.coarse import MAX_PYRAMID_LEVELS, MIN_RADIUS_PX, CoarseModel
from smartcam.inspection._locate.edges import (
    divide_into_segments,
    find_edge_points,
    fit_segments,
    measure_blur_shifts,
)
from smartcam.inspection._locate.fine import FineSettings, fit_pose
from smartcam.inspection._locate.outlines import MM_PER_UNIT, draw_outline, read_outline
from smartcam.inspection._locate.segments import (
    BAND_PX,
    BLURS_PX2,
    Bands,
    Segments,
    make_bands,
)
from smartcam.inspection._locate.symmetry import Symmetry, find_symmetry
from smartcam.inspection._locate.troubles import TeachingError, TeachingTrouble
from smartcam.inspection._measure.edges import noise_of
from smartcam.inspection._picture import Picture
from smartcam.inspection._places import PixelPose, Region, place_region

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from smartcam.frames import Frame
    from smartcam.geometry._inside import Array
    from smartcam.inspection._locate.outlines import Unit

VERSION: Final = 3
"""Version of the files of models."""

MAX_FILE_BYTES: Final = 1 << 21
"""Largest number of bytes of a model's file."""

MAX_SEGMENTS: Final = 400
"""Largest number of segments of a model; if there are more, they are thinned evenly. More segments
would take more time, and hardly improve poses."""

MAX_REGION_PX: Final = 25_000_000
"""Largest number of pixels of a taught region."""

MIN_SEGMENTS: Final = 12
"""Least number of a part's segments whose place can be measured to a fraction of a pixel."""

MIN_TOP_POINTS: Final = 16
"""Least number of points of a part at the smallest level of the pyramid."""

BORDER_PX: Final = 3.0
"""Edges that are nearer than this to the region's border, pixels, are left out."""

MAX_BORDER_SHARE: Final = 0.1
"""Largest share of the edges that may lie at the region's border."""

MIN_ACROSS: Final = 0.02
"""Least share of the edges that must run across the main direction, since only such edges determine
the part's place along the main direction."""

MIN_DIRECTION_COSINE: Final = math.cos(math.radians(35.0))
"""Cosine of the largest angle between a level's gradient and a visible segment's normal."""

ROUND_TURNS: Final = 8
"""Number of rotations at which a round part is located in its own picture."""

MIN_SELF_CONTRAST: Final = 1.0
"""Least contrast, grey levels, of an edge of a part that is located in its own picture."""

MIN_PYRAMID_RESPONSE: Final = 0.8
"""Least response of Sobel's operator, in a picture of the pyramid, to an edge of one grey level."""

MIN_CONTRAST_SIGMAS: Final = 6.0
"""Least contrast of a taught edge, in standard deviations of the noise."""

MAX_BAND_STEP: Final = 4
"""Largest number of steps, each a factor of the square root of two, by which the bands of a smaller
part are widened."""

MAX_CONTOURS, MAX_CONTOUR_CORNERS, MIN_CONTOUR_PX = 12, 150, 8
"""Largest number of drawn contours of a part, largest number of a contour's corners, and least
length of a contour in pixels."""

MAX_GREY_LEVEL: Final = 255.0
"""Largest contrast or noise that a caller may give, grey levels of 255."""

DEFAULT_CONTRAST: Final = 12.0
"""Default of the least contrast of a taught edge, grey levels of 255."""


@dataclass(frozen=True, kw_only=True)
class PartModel:
    """A taught part: its edges with their subpixel places.

    ::

        model = PartModel.teach(Picture.read("bolt.png"), region, name="bolt")
        model.symmetry.text(), model.predicted_sigma()
        model.write("bolt.model")

    Attributes:
        name: name of the part, the ``feature_id`` of its localizations.
        segments: pieces of the part's edges that determine poses; places relative to the reference.
        outline: places of all edges of the part, (M, 2), pixels relative to the reference.
        levels: indices of the segments that are visible at each level of the pyramid.
        symmetry: rotations after which the part looks like itself.
        reference: place of the reference in the taught picture, pixels.
        border: share of the edges that was left out at the region's border.
        noise: standard deviation of the noise of the taught picture, grey levels of 255.
    """

    name: str
    segments: Segments
    outline: Array = field(repr=False)
    levels: tuple[NDArray[np.intp], ...] = field(repr=False)
    symmetry: Symmetry
    reference: tuple[float, float]
    border: float = 0.0
    noise: float = 0.0

    @classmethod
    def teach(
        cls,
        picture: Frame | Picture | NDArray[Any],
        region: Region | NDArray[np.bool_] | None = None,
        *,
        name: str = "part",
        contrast: float | None = None,
    ) -> PartModel:
        """Return the model of a part in a picture.

        Args:
            picture: the picture, with a sharp view of the part, without shadows.
            region: region with the part and nothing else, or a mask (H, W) of its pixels; None:
                the whole picture.
            name: name of the part.
            contrast: least contrast of an edge, grey levels of 255; None: a contrast well above
                the noise.

        Raises:
            TeachingError: the part cannot be taught; see its ``reason``.
            FrameFormatError: the image is no picture.
            MissingExtraError: the extra ``inspection`` is not installed.
        """
        name = check_text(name, "name", "PartModel.teach", least=1)
        if contrast is not None:
            contrast = check_number(contrast, "contrast", 0, MAX_GREY_LEVEL, "PartModel.teach")
        return _teach(Picture.of(picture), region, name, contrast)

    @classmethod
    def from_outline(
        cls,
        path: str | Path,
        pixels_per_mm: float,
        *,
        name: str = "part",
        bright: bool = True,
        unit: Unit | None = None,
        layers: Sequence[str] = (),
    ) -> PartModel:
        """Return the model of a part whose outline is in a DXF or SVG file.

        The part counts as flat and of one grey level. The ``reference`` of the model is in the
        file's coordinates: pixels from the drawing's origin, y down.

        Args:
            path: file with the suffix ``.dxf`` or ``.svg``, whose lines form closed outlines. An
                outline inside another one is a hole.
            pixels_per_mm: pixels of the picture per millimetre of the part.
            name: name of the part.
            bright: whether the part is brighter than its background.
            unit: unit of the file's coordinates; None: the unit that the file names.
            layers: names of the layers with the outline, in SVG ids or labels of groups; empty: all
                layers.

        Raises:
            TeachingError: the part cannot be taught; see its ``reason``.
            ConfigurationError: an argument is wrong.
            MissingExtraError: the extra ``inspection`` is not installed.
        """
        caller = "PartModel.from_outline"
        path = check_path(path, "path", caller)
        scale = check_number(pixels_per_mm, "pixels_per_mm", 0, 1e4, caller, exclusive=True)
        name = check_text(name, "name", caller, least=1)
        bright = check_flag(bright, "bright", caller)
        if unit is not None:
            check_choice(unit, "unit", tuple(MM_PER_UNIT), caller)
        if isinstance(layers, str | bytes) or not isinstance(layers, Sequence):
            raise wrong_argument("layers", "a sequence of names", layers, caller)
        layers = [check_text(layer, "layers", caller, least=1) for layer in layers]
        picture, (x, y) = draw_outline(read_outline(path, scale, unit, layers), bright=bright)
        model = _teach(Picture.of(picture), None, name, None)
        return replace(model, reference=(model.reference[0] + x, model.reference[1] + y))

    @classmethod
    def read(cls, path: str | Path) -> PartModel:
        """Return the model in a file.

        Raises:
            ConfigurationError: the file cannot be read, or is no model of this version.
        """
        path = check_path(path, "path", "PartModel.read")
        try:
            with path.open("rb") as file:
                data = file.read(MAX_FILE_BYTES + 1)
        except OSError as exc:
            raise ConfigurationError(f"model {path}: {exc}") from exc
        if len(data) > MAX_FILE_BYTES:
            raise ConfigurationError(f"model {path}: expected {MAX_FILE_BYTES} bytes at most")
        try:
            return _ModelFile.model_validate_json(data).model()
        except ValidationError as exc:
            first = exc.errors(include_url=False)[0]
            place = ".".join(map(str, first["loc"])) or "model"
            text = first["msg"].removeprefix("Value error, ")
            raise ConfigurationError(
                f"model {path}: {place}: {text}; expected a file that "
                "PartModel.write of this version made"
            ) from exc

    def write(self, path: str | Path) -> None:
        """Write the model into a file; an existing file is replaced.

        Raises:
            ConfigurationError: the file cannot be written.
        """
        path = check_path(path, "path", "PartModel.write")
        try:
            replace_file(path, _ModelFile.of(self).model_dump_json().encode())
        except OSError as exc:
            raise ConfigurationError(f"model {path} cannot be written: {exc}") from exc

    @property
    def radius(self) -> float:
        """Distance of the farthest edge from the reference, pixels."""
        return float(np.linalg.norm(self.outline, axis=1).max())

    def predicted_sigma(self, noise: float | None = None) -> tuple[float, float]:
        """Return the expected error of a pose in a picture like the taught one.

        Args:
            noise: standard deviation of the picture's noise, grey levels of 255; None: that of the
                taught picture.

        Returns:
            Standard deviations of the place along its least certain direction, pixels, and of the
            angle, radians.
        """
        if noise is not None:
            noise = check_number(noise, "noise", 0, MAX_GREY_LEVEL, "PartModel.predicted_sigma")
        noise_factor = 1.0 if noise is None else math.hypot(1.0, noise / max(self.noise, 0.01))
        sigmas = self.segments.sigmas * (math.sqrt(2) if noise is None else noise_factor)
        arms, normals = self.segments.middles, self.segments.normals
        torques = arms[:, 0] * normals[:, 1] - arms[:, 1] * normals[:, 0]
        rows = np.column_stack([normals, torques]) / sigmas[:, None]
        parameter_count = 2 if self.symmetry.fold == 0 else 3
        covariance = np.linalg.inv(rows[:, :parameter_count].T @ rows[:, :parameter_count])
        worst = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        return worst, math.sqrt(float(covariance[2, 2])) if parameter_count == 3 else math.nan

    @cached_property
    def coarse(self) -> CoarseModel:
        """The points for the coarse search."""
        chosen = [self.segments.selected(level) for level in self.levels]
        return CoarseModel(
            tuple(level.middles for level in chosen), tuple(level.normals for level in chosen)
        )

    def bands_at(self, scale: float) -> Bands:
        """Return the bands of the segments, wider for a smaller part to have enough pixels."""
        step = min(max(round(-2 * math.log2(scale)), 0), MAX_BAND_STEP)
        if step not in self._bands:
            self._bands[step] = make_bands(self.segments, self.outline, BAND_PX * 2 ** (step / 2))
        return self._bands[step]

    @cached_property
    def _bands(self) -> dict[int, Bands]:
        return {}

    @cached_property
    def hull(self) -> Array:
        """The convex hull of the outline, (K, 2)."""
        cv2 = load("cv2", "inspection needs")
        hull_points: Array = cv2.convexHull(self.outline.astype(np.float32))[:, 0].astype(
            np.float64
        )
        return hull_points

    @cached_property
    def contours(self) -> tuple[Array, ...]:
        """Polygons (K, 2) to be drawn, within a pixel of the edges, the longest first."""
        cv2 = load("cv2", "inspection needs")
        low = np.floor(self.outline.min(axis=0)).astype(int) - 3
        pixels = np.rint(self.outline - low).astype(int)
        mask = np.zeros(pixels.max(axis=0)[::-1] + 4, np.uint8)
        mask[pixels[:, 1], pixels[:, 0]] = 1
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        contours, (tree,) = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        outer = [
            outline for outline, (_, _, _, parent) in zip(contours, tree, strict=True) if parent < 0
        ]
        outer.sort(key=len, reverse=True)
        polygons = [
            _simplify(outline) for outline in outer[:MAX_CONTOURS] if len(outline) >= MIN_CONTOUR_PX
        ]
        return tuple(polygon.astype(np.float64) + low for polygon in polygons)


def _simplify(contour: NDArray[Any]) -> NDArray[Any]:
    """Return a polygon (K, 2) of few corners along a contour (N, 1, 2)."""
    cv2 = load("cv2", "inspection needs")
    tolerance = 0.7
    while len(polygon := cv2.approxPolyDP(contour, tolerance, True)) > MAX_CONTOUR_CORNERS:
        tolerance *= 1.5
    corners: NDArray[Any] = polygon[:, 0]
    return corners


# ---------------------------------------------------------------------- teaching


def _teach(
    picture: Picture,
    region: Region | NDArray[np.bool_] | None,
    name: str,
    contrast: float | None,
) -> PartModel:
    mask, corner = _region_mask(region, picture)
    rows, columns = (
        slice(at, at + size) for at, size in zip(corner[::-1], mask.shape, strict=True)
    )
    grey, grey_values = picture.grey[rows, columns], picture.levels[rows, columns]
    top = float(2**picture.depth - 1)
    noise = noise_of(grey_values) * 255 / top
    if contrast is None:
        contrast = max(DEFAULT_CONTRAST, MIN_CONTRAST_SIGMAS * noise)
    image_edges = find_edge_points(grey, contrast)
    inside_mask, border = _select_inside(image_edges.points, mask)
    image_edges = type(image_edges)(*(array[inside_mask] for array in image_edges))
    if border > MAX_BORDER_SHARE:
        raise TeachingError(
            TeachingTrouble.BORDER,
            f"{100 * border:.0f} % of the edges lie at the border of the region: expected a region "
            "that goes around the part, some pixels away from it",
        )
    rough = divide_into_segments(image_edges)
    has_segments = len(rough.half_lengths) > 0
    edges = fit_segments(grey_values, rough, image_edges.points, top) if has_segments else None
    exact = np.zeros(0, int) if edges is None else np.flatnonzero(edges.exact)
    if edges is None or len(exact) < MIN_SEGMENTS:
        raise TeachingError(
            TeachingTrouble.FEW_EDGES,
            f"{len(exact)} pieces of edges whose place can be measured, expected {MIN_SEGMENTS} or "
            f"more, of {contrast:.0f} grey levels at least: is the part sharp and in the region?",
        )
    segments = edges.segments.selected(exact)
    blur_shifts = measure_blur_shifts(grey_values, segments, image_edges.points)
    segments = segments._replace(blur_shifts=blur_shifts)
    _check_directions(segments)
    centre = image_edges.points.mean(axis=0)
    segments = _order_segments(segments._replace(middles=segments.middles - centre))
    symmetry, shift = find_symmetry(segments, image_edges.points - centre, image_edges.normals)
    segments, centre = segments._replace(middles=segments.middles - shift), centre + shift
    shift = _find_centre_shift(
        segments, image_edges.points - centre, symmetry.fold, (grey_values, centre, noise)
    )
    segments, centre = segments._replace(middles=segments.middles - shift), centre + shift
    return PartModel(
        name=name,
        segments=segments,
        outline=image_edges.points - centre,
        levels=_visible_by_level(segments, grey, centre),
        symmetry=symmetry,
        reference=(float(centre[0]) + corner[0], float(centre[1]) + corner[1]),
        border=border,
        noise=noise,
    )


def _find_centre_shift(
    segments: Segments, outline: Array, fold: int, own_picture: tuple[NDArray[Any], Array, float]
) -> Array:
    """Return the centre of a part's symmetry, (2,), relative to the reference.

    ``own_picture``: the taught picture, the reference in it, and the picture's noise. The part is
    located in this picture at each of the rotations; the mean of the found places is the centre.
    """
    grey_values, (x, y), noise = own_picture
    turn_count, bands = fold or ROUND_TURNS, make_bands(segments, outline)
    settings = FineSettings(
        np.full(len(segments.half_lengths), MIN_SELF_CONTRAST), noise, fits_angle=fold != 0
    )
    offsets = []
    for turn_index in range(turn_count if fold != 1 else 0):
        start = PixelPose(float(x), float(y), 2 * math.pi * turn_index / turn_count)
        fine = fit_pose(grey_values, segments, bands, start, settings)
        if fine is None:
            return np.zeros(2)
        offsets.append((fine.pose.x - x, fine.pose.y - y))
    return np.mean(offsets, axis=0) if offsets else np.zeros(2)


def _region_mask(
    region: Region | NDArray[np.bool_] | None, picture: Picture
) -> tuple[NDArray[np.bool_], tuple[int, int]]:
    """Return the mask (H, W) of the taught pixels, and the mask's corner in the picture."""
    if isinstance(region, np.ndarray):
        if region.dtype != np.bool_ or region.shape != picture.size[::-1]:
            raise wrong_argument(
                "region", f"a mask of bool of the shape {picture.size[::-1]}", region
            )
        mask, corner = region, (0, 0)
    else:
        if region is not None:
            check_kind(region, Region, "region", "a Region, a mask or None", "PartModel.teach")
        placed = place_region(region, None, picture.size)
        if placed.is_empty:
            raise TeachingError(
                TeachingTrouble.EMPTY,
                f"the region has no pixel in the picture of {picture.size[0]} x {picture.size[1]}",
            )
        mask, corner = placed.mask() > 0, (placed.left, placed.top)
    if not mask.any():
        raise TeachingError(TeachingTrouble.EMPTY, "the region has no pixel in the picture")
    if mask.size > MAX_REGION_PX:
        raise TeachingError(
            TeachingTrouble.TOO_LARGE,
            f"the region has {mask.size} pixels, expected {MAX_REGION_PX} at most",
        )
    return mask, corner


def _select_inside(points: Array, mask: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], float]:
    """Return the mask of edges inside the region, and the share of edges at the region's border."""
    cv2 = load("cv2", "inspection needs")
    padded = np.pad(mask, 1).astype(np.uint8)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    at = np.rint(points).astype(int)
    at = at.clip(0, np.array(mask.shape[::-1]) - 1)
    depths = depth[at[:, 1], at[:, 0]]
    is_inside = depths > BORDER_PX
    border_count = int(np.count_nonzero((depths > 0) & ~is_inside))
    return is_inside, border_count / max(border_count + int(np.count_nonzero(is_inside)), 1)


def _order_segments(segments: Segments) -> Segments:
    """Return segments in their order around the reference, evenly thinned if they are too many."""
    order = np.argsort(np.arctan2(segments.middles[:, 1], segments.middles[:, 0]), kind="stable")
    if len(order) > MAX_SEGMENTS:
        order = order[np.linspace(0, len(order) - 1, MAX_SEGMENTS).round().astype(int)]
    return segments.selected(order)


def _check_directions(segments: Segments) -> None:
    """Raise if the edges' directions do not determine a place."""
    weights = segments.half_lengths / segments.half_lengths.sum()
    square = (segments.normals * weights[:, None]).T @ segments.normals
    if float(np.linalg.eigvalsh(square)[0]) < MIN_ACROSS:
        raise TeachingError(
            TeachingTrouble.ONE_DIRECTION,
            "all edges run in one direction, and do not determine the place along it: expected a "
            "region with edges of other directions, too",
        )


def _visible_by_level(
    segments: Segments, grey: NDArray[np.uint8], centre: Array
) -> tuple[NDArray[np.intp], ...]:
    """Return the segments that are visible at each level of the pyramid, from level 0."""
    cv2 = load("cv2", "inspection needs")
    levels = [np.arange(len(segments.half_lengths))]
    radius = float(np.linalg.norm(segments.middles, axis=1).max())
    for level in range(1, MAX_PYRAMID_LEVELS):
        grey = cv2.pyrDown(grey)
        visible = _visible_at(segments, grey, centre, level)
        if len(visible) < MIN_TOP_POINTS or radius / 2**level < MIN_RADIUS_PX:
            break
        levels.append(visible)
    return tuple(levels)


def _visible_at(
    segments: Segments, grey: NDArray[np.uint8], centre: Array, level: int
) -> NDArray[np.intp]:
    """Return the segments whose direction is visible at a level, at most one for each pixel."""
    cv2 = load("cv2", "inspection needs")
    across, down = (cv2.Sobel(grey, cv2.CV_32F, *direction) for direction in ((1, 0), (0, 1)))
    level_places = (segments.middles + centre) / 2**level
    limit = np.array(grey.shape[::-1]) - 1
    is_visible = np.zeros(len(level_places), dtype=np.bool_)
    for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):  # the search reads neighbouring pixels, too
        x, y = (np.floor(level_places).astype(int) + corner).clip(0, limit).T
        gradient = np.column_stack([across[y, x], down[y, x]])
        magnitude = np.maximum(np.linalg.norm(gradient, axis=1), 1e-9)
        alike = (gradient * segments.normals).sum(axis=1) / magnitude >= MIN_DIRECTION_COSINE
        is_visible |= alike & (magnitude >= MIN_PYRAMID_RESPONSE * segments.heights)
    _, first = np.unique(np.rint(level_places).astype(int) @ [1, 1 << 20], return_index=True)
    is_first = np.zeros(len(level_places), dtype=np.bool_)
    is_first[first] = True
    return np.flatnonzero(is_visible & is_first)


# ---------------------------------------------------------------------- files

Number = Annotated[float, Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
Place = Annotated[float, Field(allow_inf_nan=False, ge=-20_000, le=20_000)]
Component = Annotated[float, Field(allow_inf_nan=False, ge=-1.001, le=1.001)]
Length = Annotated[float, Field(allow_inf_nan=False, gt=0, le=20)]
Height = Annotated[float, Field(allow_inf_nan=False, gt=0, le=1000)]
Row = tuple[Place, Place, Component, Component, Component, Length, Height, Length, Length]
Shift = Annotated[float, Field(allow_inf_nan=False, ge=-2, le=2)]
Shifts = Annotated[list[Shift], Field(min_length=len(BLURS_PX2), max_length=len(BLURS_PX2))]


class _ModelFile(BaseModel):
    """The file of a model."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        extra="forbid", frozen=True, hide_input_in_errors=True
    )

    kind: Literal["smartcam part model"] = "smartcam part model"
    version: Literal[3] = VERSION
    name: Annotated[str, Field(min_length=1, max_length=50)]
    reference: tuple[Number, Number]
    border: Annotated[float, Field(ge=0, le=1)]
    noise: Annotated[float, Field(ge=0, le=1000)]
    fold: Annotated[int, Field(ge=0, le=1000)]
    alike: Annotated[list[tuple[Number, Number]], Field(max_length=100)]
    symmetry_centre: tuple[Number, Number]
    segments: Annotated[list[Row], Field(min_length=MIN_SEGMENTS, max_length=MAX_SEGMENTS)]
    blur_shifts: Annotated[list[Shifts], Field(min_length=MIN_SEGMENTS, max_length=MAX_SEGMENTS)]
    levels: Annotated[list[list[Annotated[int, Field(ge=0)]]], Field(min_length=1, max_length=20)]
    outline: Annotated[list[tuple[Place, Place]], Field(min_length=3, max_length=1_000_000)]

    @model_validator(mode="after")
    def _check_consistency(self) -> _ModelFile:
        for number, level in enumerate(self.levels):
            if not level or max(level) >= len(self.segments):
                raise ValueError(f"levels.{number}: expected indices of segments")
        if len(self.blur_shifts) != len(self.segments):
            raise ValueError("blur_shifts: expected as many as segments")
        places = np.array([row[:2] for row in self.segments] + self.outline)
        if float(np.prod(np.ptp(places, axis=0))) > MAX_REGION_PX:
            raise ValueError(f"expected a part of {MAX_REGION_PX} pixels at most")
        if min(math.hypot(*row[2:4]) for row in self.segments) < 0.9:
            raise ValueError("segments: expected normals of the length 1")
        return self

    @classmethod
    def of(cls, model: PartModel) -> _ModelFile:
        """Return the file of a model, with rounded numbers."""
        segments = model.segments
        rows = np.column_stack(
            [
                segments.middles,
                segments.normals,
                segments.bends,
                segments.half_lengths,
                segments.heights,
                segments.blurs,
                segments.sigmas,
            ]
        )
        return cls(
            name=model.name,
            reference=model.reference,
            border=model.border,
            noise=model.noise,
            fold=model.symmetry.fold,
            alike=list(model.symmetry.alike),
            symmetry_centre=model.symmetry.centre,
            segments=[tuple(row) for row in rows.round(6).tolist()],
            blur_shifts=segments.blur_shifts.round(5).tolist(),
            levels=[level.tolist() for level in model.levels],
            outline=[tuple(row) for row in model.outline.round(2).tolist()],
        )

    def model(self) -> PartModel:
        """Return the model of the file."""
        rows = np.array(self.segments, np.float64)
        numbers = (rows[:, 4], rows[:, 5], rows[:, 6], rows[:, 7], rows[:, 8])
        normals = rows[:, 2:4] / np.maximum(np.linalg.norm(rows[:, 2:4], axis=1), 1e-9)[:, None]
        return PartModel(
            name=self.name,
            segments=Segments(rows[:, :2], normals, *numbers, np.array(self.blur_shifts)),
            outline=np.array(self.outline, np.float64).reshape(-1, 2),
            levels=tuple(np.array(level, np.intp) for level in self.levels),
            symmetry=Symmetry(self.fold, tuple(self.alike), self.symmetry_centre),
            reference=self.reference,
            border=self.border,
            noise=self.noise,
        )
