"""Find taught parts in a picture: find candidate places, fit a pose at each, and judge it."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam._extras import load
from smartcam.inspection._locate.coarse import PicturePyramid, Ranges, find_candidates
from smartcam.inspection._locate.fine import FineSettings, fit_pose
from smartcam.inspection._measure.edges import noise_of
from smartcam.inspection._places import PixelPose

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from smartcam.geometry._inside import Array
    from smartcam.inspection._locate.coarse import RoughPlace
    from smartcam.inspection._locate.fine import FinePose
    from smartcam.inspection._locate.model import PartModel
    from smartcam.inspection._picture import Picture

CONTRAST_SHARE: Final = 0.12
"""Default of the least contrast of a found edge, as a share of the edge's taught contrast."""

MIN_CONTRAST: Final = 8.0
"""Default of the least contrast of a found edge, grey levels of 255."""

MAX_FITS: Final = 12
"""Largest number of places that are fitted, in addition to four for each wanted part."""

SCORE_MARGIN: Final = 0.1
"""Largest amount by which a fit is expected to raise a place's coarse score. Once enough parts are
found, places whose coarse score is lower than the parts' scores by more than this are not
fitted."""

EQUAL_SCORE_DIFFERENCE: Final = 0.02
"""Largest difference of two scores that count as equal."""

RANGE_MARGIN: Final = math.radians(1.0)
"""Margin by which a fitted pose may exceed the searched ranges: in radians for the angle, and the
same number as a share of the scale."""


SIZE_MARGIN: Final = 0.03
"""Share of the size by which a found part may be larger or smaller if only one size is searched.
The pose has the part's true size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PartSearch:
    """The poses that are searched, and the conditions for a found part.

    Attributes:
        angles: smallest and largest rotation since the taught picture, radians.
        scales: smallest and largest scale.
        max_parts: largest number of found parts of each model.
        min_score: least share of the edges that must be visible.
        overlap: largest common area of two parts, as a share of the smaller one's.
        any_polarity: whether dark and bright may be exchanged.
        contrast: least contrast of an edge, grey levels of 255; None: a share of the taught one.
        seconds: seconds after which no further place is fitted.
    """

    angles: tuple[float, float] = (-math.pi, math.pi)
    scales: tuple[float, float] = (1.0, 1.0)
    max_parts: int = 1
    min_score: float = 0.7
    overlap: float = 0.5
    any_polarity: bool = False
    contrast: float | None = None
    seconds: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LocatedPart:
    """A part that was found, or a candidate that was refused.

    Attributes:
        name: name of the model.
        pose: place of the model's reference in the picture, and rotation and scale relative to the
            taught part.
        covariance: (4, 4), of x and y (pixels), the angle (radians) and the scale.
        score: share of the part's edges that is visible, 0 to 1.
        edges: places of the edges that determine the pose, (N, 2), pixels.
        missing: places of edges that are not visible, (M, 2), pixels.
        noise: standard deviation of the picture's noise, grey levels.
        blur: standard deviation of the edges' blur, pixels.
        chi_square: ratio of the edges' squared residuals to the squares that noise explains.
        refusal: reason why the part counts as not found; "" for a found part.
        doubt: reason why the part may be rotated in another way; "" if there is no doubt.
        hull: convex hull of the part, (K, 2), pixels of the picture.
        contours: polygons (K, 2) to be drawn along the part's edges, pixels of the picture; empty
            for a refused part.
    """

    name: str
    pose: PixelPose
    covariance: Array
    score: float
    edges: Array = field(default_factory=lambda: np.zeros((0, 2)), repr=False)
    missing: Array = field(default_factory=lambda: np.zeros((0, 2)), repr=False)
    noise: float = math.nan
    blur: float = math.nan
    chi_square: float = math.nan
    refusal: str = ""
    doubt: str = ""
    hull: Array = field(default_factory=lambda: np.zeros((0, 2)), repr=False)
    contours: tuple[Array, ...] = field(default=(), repr=False)

    @property
    def sigmas(self) -> tuple[float, float, float, float]:
        """Standard deviations of x and y (pixels), the angle (radians) and the scale."""
        x, y, angle, scale = np.sqrt(np.diag(self.covariance)).tolist()
        return x, y, angle, scale


@dataclass(frozen=True, slots=True)
class Located:
    """The parts that were found in a picture.

    Attributes:
        parts: found parts, the best first.
        best_refused: best refused part; None: no candidate was refused.
    """

    parts: tuple[LocatedPart, ...]
    best_refused: LocatedPart | None


def locate(
    picture: Picture,
    models: Sequence[PartModel],
    search: PartSearch,
    *,
    box: tuple[int, int, int, int] | None = None,
    allowed: Callable[[tuple[float, float]], bool] | None = None,
) -> Located:
    """Return the parts in a picture.

    ``box`` (left, top, right, bottom): area in which the references of the parts may be;
    ``allowed``: function that returns whether a reference may be at a place in this area.
    """
    deadline = time.monotonic() + search.seconds
    searched: dict[tuple[int, int, int, int], _SearchedPicture] = {}
    parts: list[LocatedPart] = []
    refused: list[LocatedPart] = []
    for model in models:
        area = _search_area(picture, box, model.radius * search.scales[1])
        if area not in searched:
            searched[area] = _SearchedPicture(picture, area)
        parts_found, refused_parts = searched[area].find(model, search, deadline, allowed)
        parts += parts_found
        refused += refused_parts
    best = _drop_overlapping(parts, search.overlap)
    refused.sort(key=lambda part: -part.score)
    return Located(tuple(best), refused[0] if refused else None)


def _search_area(
    picture: Picture, box: tuple[int, int, int, int] | None, radius: float
) -> tuple[int, int, int, int]:
    """Return the area of the picture that parts with references in a box may cover."""
    width, height = picture.size
    if box is None:
        return 0, 0, width, height
    reach = math.ceil(radius) + 2
    left, top, right, bottom = box
    return (
        max(left - reach, 0),
        max(top - reach, 0),
        min(right + reach, width),
        min(bottom + reach, height),
    )


class _SearchedPicture:
    """An area of a picture with its pyramid, in which any number of models is searched."""

    def __init__(self, picture: Picture, area: tuple[int, int, int, int]) -> None:
        left, top, right, bottom = area
        self._corner = left, top
        self._grey_values = picture.levels
        self._grey_scale = float(2**picture.depth - 1) / 255  # grey values per level of 255
        grey = np.ascontiguousarray(picture.grey[top:bottom, left:right])
        self._noise = noise_of(grey)
        self._pyramid = PicturePyramid(grey, self._noise)

    def find(
        self,
        model: PartModel,
        search: PartSearch,
        deadline: float,
        allowed: Callable[[tuple[float, float]], bool] | None,
    ) -> tuple[list[LocatedPart], list[LocatedPart]]:
        """Return the found parts of one model, and the refused ones."""
        ranges = search_ranges(model, search)
        candidates, refused_place = find_candidates(
            self._pyramid, model.coarse, ranges, search.max_parts
        )
        refused_parts = (
            []
            if refused_place is None
            else [_make_refused_part(model, self._in_picture(refused_place), search, "")]
        )
        parts: list[LocatedPart] = []
        for index, candidate in enumerate(candidates[: MAX_FITS + 4 * search.max_parts]):
            place = self._in_picture(candidate)
            if time.monotonic() > deadline and index:
                refused_parts.append(
                    _make_refused_part(model, place, search, "there was no time left to look at it")
                )
                break
            if _cannot_improve(parts, place, search) or any(
                _is_near(place, other) for other in parts
            ):
                continue
            part = self._judge_candidate(model, place, search, allowed)
            if part.refusal:
                refused_parts.append(part)
            else:
                parts.append(part)
        best = _drop_overlapping(parts, search.overlap)[: search.max_parts]
        return [self._add_doubt(model, part, search) for part in best], refused_parts

    def _in_picture(self, place: RoughPlace) -> RoughPlace:
        """Convert a candidate's place to pixels of the whole picture."""
        return place._replace(x=place.x + self._corner[0], y=place.y + self._corner[1])

    def _fit(self, model: PartModel, start: PixelPose, search: PartSearch) -> FinePose | None:
        settings = FineSettings(
            min_contrasts(model, search) * self._grey_scale,
            self._noise * self._grey_scale,
            search.any_polarity,
            search.scales[1] > search.scales[0],
            search.min_score,
            model.symmetry.fold != 0,
        )
        bands = model.bands_at(start.scale)
        return fit_pose(self._grey_values, model.segments, bands, start, settings)

    def _judge_candidate(
        self,
        model: PartModel,
        place: RoughPlace,
        search: PartSearch,
        allowed: Callable[[tuple[float, float]], bool] | None,
    ) -> LocatedPart:
        """Fit the part at a place; return it, with a refusal if it does not count as found."""
        start = PixelPose(place.x, place.y, place.angle, place.scale)
        fine = self._fit(model, start, search)
        if fine is None:
            return _make_refused_part(model, place, search, "too few of its edges agree on a pose")
        part = _make_located_part(model, fine)
        pose = part.pose
        refusal = ""
        if part.score < search.min_score:
            refusal = _low_score_text(part.score, fine, search)
        elif not _is_in_angles(pose, model, search):
            low, high = np.degrees(search.angles).tolist()
            refusal = (
                f"it is turned by {math.degrees(pose.angle):.1f} degrees, expected {low:.4g} to "
                f"{high:.4g}"
            )
        elif not _is_in_scales(pose, search):
            low, high = search.scales
            wanted = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            refusal = f"its size is {pose.scale:.3f} of the taught one, expected {wanted}"
        elif allowed is not None and not allowed((pose.x, pose.y)):
            refusal = "its reference is outside of the region"
        return dataclasses.replace(part, refusal=refusal)

    def _add_doubt(self, model: PartModel, part: LocatedPart, search: PartSearch) -> LocatedPart:
        """Return a part, to which a doubt is added if another rotation fits as well."""
        for angle, coinciding_share in model.symmetry.alike:
            if part.score >= coinciding_share + EQUAL_SCORE_DIFFERENCE:
                continue  # edges were seen that the other rotation does not have
            start = _rotate_pose(part.pose, model.symmetry.centre, angle)
            other = self._fit(model, start, search)
            if other is not None and other.score >= part.score - EQUAL_SCORE_DIFFERENCE:
                doubt = (
                    f"as much of it is seen if it is turned by {math.degrees(angle):.0f} degrees"
                )
                return dataclasses.replace(part, doubt=doubt)
        return part


def search_ranges(model: PartModel, search: PartSearch) -> Ranges:
    """Return the ranges of the coarse search for a model."""
    contrast = float(np.median(min_contrasts(model, search)))
    return Ranges(
        angles=(0.0, 0.0) if model.symmetry.fold == 0 else search.angles,
        scales=search.scales,
        period=model.symmetry.period,
        any_polarity=search.any_polarity,
        contrast=contrast,
        min_score=search.min_score,
    )


def min_contrasts(model: PartModel, search: PartSearch) -> Array:
    """Return the least contrast of each edge of a part, (N,), grey levels of 255."""
    taught_contrasts = model.segments.heights
    if search.contrast is not None:
        return np.full(len(taught_contrasts), search.contrast)
    return np.maximum(MIN_CONTRAST, CONTRAST_SHARE * taught_contrasts)


def _make_located_part(model: PartModel, fine: FinePose) -> LocatedPart:
    pose = fine.pose
    if model.symmetry.fold == 0:
        pose = pose._replace(angle=0.0)
    else:
        pose = pose._replace(angle=math.remainder(pose.angle, model.symmetry.period))
    middles = fine.pose.to_picture(model.segments.middles)
    return LocatedPart(
        name=model.name,
        pose=pose,
        covariance=fine.covariance,
        score=fine.score,
        edges=middles[fine.inliers],
        missing=middles[~fine.visible],
        noise=fine.noise,
        blur=fine.blur,
        chi_square=fine.chi_square,
        hull=fine.pose.to_picture(model.hull),
        contours=tuple(fine.pose.to_picture(contour) for contour in model.contours),
    )


def _rotate_pose(pose: PixelPose, centre: tuple[float, float], angle: float) -> PixelPose:
    """Return the pose of a part after a rotation about one of its points."""
    cos, sin = math.cos(angle), math.sin(angle)
    x, y = centre
    place = pose.to_picture((x - cos * x + sin * y, y - sin * x - cos * y))
    return PixelPose(float(place[0]), float(place[1]), pose.angle + angle, pose.scale)


def _low_score_text(score: float, fine: FinePose, search: PartSearch) -> str:
    text = f"{100 * score:.0f} % of its edges are seen, expected {100 * search.min_score:.0f} %"
    if fine.reversed_share > 0.1:
        text += f"; {100 * fine.reversed_share:.0f} % are there with dark and bright exchanged"
    return text


def _make_refused_part(
    model: PartModel, place: RoughPlace, search: PartSearch, reason: str
) -> LocatedPart:
    pose = PixelPose(
        place.x, place.y, math.remainder(place.angle, model.symmetry.period), place.scale
    )
    return LocatedPart(
        name=model.name,
        pose=pose,
        covariance=np.full((4, 4), np.nan),
        score=place.score,
        refusal=reason
        or f"about {100 * place.score:.0f} % of its edges agree, expected "
        f"{100 * search.min_score:.0f} %",
        hull=pose.to_picture(model.hull),
    )


def _is_in_angles(pose: PixelPose, model: PartModel, search: PartSearch) -> bool:
    """Return True if a pose's angle is in the searched range, with a margin."""
    low, high = search.angles
    if not model.symmetry.fold or high - low >= model.symmetry.period - 1e-9:
        return True
    deviation = math.remainder(pose.angle - (low + high) / 2, model.symmetry.period)
    return abs(deviation) <= (high - low) / 2 + RANGE_MARGIN


def _is_in_scales(pose: PixelPose, search: PartSearch) -> bool:
    """Return True if a pose's scale is in the searched range, with a margin."""
    low, high = search.scales
    margin = SIZE_MARGIN if low == high else RANGE_MARGIN
    return low * (1 - margin) <= pose.scale <= high * (1 + margin)


def _cannot_improve(parts: Sequence[LocatedPart], place: RoughPlace, search: PartSearch) -> bool:
    """Return True if enough parts were found, and a place cannot be better than they are."""
    best = sorted(part.score for part in parts)[-search.max_parts :]
    return len(best) == search.max_parts and place.score < best[0] - SCORE_MARGIN


def _is_near(place: RoughPlace, other: LocatedPart) -> bool:
    """Return True if a candidate is the place of a part that was already found."""
    angle = abs(math.remainder(place.angle - other.pose.angle, 2 * math.pi))
    return math.hypot(place.x - other.pose.x, place.y - other.pose.y) < 4 and angle < 0.1


def _drop_overlapping(parts: Sequence[LocatedPart], overlap: float) -> list[LocatedPart]:
    """Drop each part that overlaps a better one by more than is allowed."""
    best: list[LocatedPart] = []
    for part in sorted(parts, key=lambda part: (-part.score, part.chi_square)):
        if all(_overlap_share(part.hull, other.hull) <= overlap for other in best):
            best.append(part)
    return best


def _overlap_share(one: NDArray[Any], other: NDArray[Any]) -> float:
    """Return the common area of two convex hulls, as a share of the smaller one."""
    cv2 = load("cv2", "inspection needs")
    hulls = [np.asarray(hull - one[0], np.float32) for hull in (one, other)]
    common, _ = cv2.intersectConvexConvex(*hulls)
    smaller_area = min(float(cv2.contourArea(hull)) for hull in hulls)
    return float(common) / max(smaller_area, 1e-6)
