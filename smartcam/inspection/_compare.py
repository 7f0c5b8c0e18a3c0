"""The tool `compare`: differences between a region and a taught picture."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from pydantic import Field

from smartcam._extras import load
from smartcam.exceptions import ConfigurationError
from smartcam.frames._inside import Drawing
from smartcam.inspection._finding import Finding
from smartcam.inspection._picture import Picture
from smartcam.inspection._tool import Tool, ToolSettings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.inspection._tool import ToolSetup, View

MAX_AREA_PX: Final = 1_000_000_000
"""Largest area that a setting may have, in pixels."""

MAX_SHIFT_PX: Final = 50
"""Largest shift of a part that a search may cover, in pixels; the time grows with its square."""

MAX_DRAWN_DIFFERENCES: Final = 100
"""Largest number of differences that are drawn."""

MAX_GAIN: Final = 2.0
"""Largest factor by which the contrast may rise or fall."""

MAX_ROTATION: Final = math.radians(3.0)
"""Largest rotation of the part, in radians."""

EDGE_TOLERANCE_PX: Final = 0.75
"""Largest distance of an edge from its taught place, in pixels."""

MAX_ITERATIONS: Final = 30
"""Largest number of iterations of the alignment."""

MIN_CORRELATION: Final = 0.5
"""Least correlation of taught and current grey levels at which they are taken for the same part."""

LIGHT_FIT_ROUNDS: Final = 4
"""Number of fits of the light; each fit leaves out the outliers of the fit before."""

MAX_LIGHT_PIXELS: Final = 50_000
"""Largest number of pixels in the fit of the light; a larger region is sampled."""

SURROUNDINGS_PX: Final = 31
"""Side, pixels, of the square around a pixel; the pixel is compared with the darkest and the
brightest pixel of this square."""

OUTLIER_SIGMAS: Final = 2.5
"""Residual, in standard deviations, from which a pixel is an outlier of the light's fit."""


class CompareSettings(ToolSettings):
    """The taught picture, and the allowed differences."""

    taught: str = Field(
        min_length=1,
        description="file with the taught picture, beside this file: a whole picture or the region",
    )
    level: int = Field(40, ge=1, le=255, description="least difference of a pixel, grey levels")
    area: int = Field(
        20,
        ge=1,
        le=MAX_AREA_PX,
        description="least area of a difference, pixels; smaller ones are ignored",
    )
    allowed: int = Field(
        0, ge=0, le=MAX_AREA_PX, description="largest number of differing pixels in all"
    )
    shift: int = Field(3, ge=0, le=MAX_SHIFT_PX, description="largest shift of the part, pixels")
    light: bool = Field(True, description="allow for changes of brightness and contrast")


class Compare(Tool[CompareSettings]):
    """Compare a region with a taught picture."""

    settings_model = CompareSettings

    def __init__(self, settings: CompareSettings, setup: ToolSetup) -> None:
        super().__init__(settings, setup)
        region = settings.region
        self._corner, self._size = (0.0, 0.0), (0, 0)
        self._taught = Picture.read(setup.folder / settings.taught).grey
        height, width = self._taught.shape
        if region is None and settings.follow is not None:
            raise ConfigurationError("expected a region [x, y, width, height] of the followed part")
        if region is not None:
            (x1, y1), (x2, y2) = np.min(region, axis=0), np.max(region, axis=0)
            if len(region) != 4 or {*region} != {(x1, y1), (x2, y1), (x2, y2), (x1, y2)}:
                raise ConfigurationError("expected a region [x, y, width, height] to compare")
            self._corner = float(x1), float(y1)
            size = round(x2 - x1), round(y2 - y1)
            if (width, height) != size:
                left, top = round(x1), round(y1)
                fits = left >= 0 and top >= 0 and left + size[0] <= width
                if settings.follow is not None or not fits or top + size[1] > height:
                    raise ConfigurationError(
                        f"{settings.taught}: expected a picture of {size[0]} x {size[1]} pixels, "
                        f"as the region is, got {width} x {height}"
                    )
                self._taught = self._taught[top : top + size[1], left : left + size[0]]
        self._size = self._taught.shape[1], self._taught.shape[0]
        if min(self._size) < 2 * settings.shift + 8:
            raise ConfigurationError(
                f"expected a region of {2 * settings.shift + 8} pixels or more along each side, "
                f"for a shift of {settings.shift}; got {self._size[0]} x {self._size[1]}"
            )

    @property
    def fields(self) -> str:
        """Return the layout of the differences and the part's shift."""
        return "differing: uint32, count: uint16, shift_x: real32 px, shift_y: real32 px"

    def inspect(self, view: View) -> Finding:
        """Return the number and places of differing pixels."""
        cv2 = load("cv2", "inspection needs")
        if self.settings.region is None and view.picture.size != self._size:
            return Finding(
                ok=False,
                reason=f"the picture has {view.picture.size[0]} x {view.picture.size[1]} pixels, "
                f"the taught one {self._size[0]} x {self._size[1]}",
            )
        patch = self._cut_patch(view)
        motion = self._find_motion(patch)
        size = self._size
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        current = cv2.warpAffine(patch, motion, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        is_covered = cv2.warpAffine(np.full_like(patch, 255), motion, size, flags=flags) == 255
        taught, level = self._taught, float(self.settings.level)
        is_hidden = np.zeros(is_covered.shape, bool)
        too_light = True
        if self.settings.light:
            gain, offset = _fit_light(taught[is_covered], current[is_covered])
            relit = (gain * taught + offset).astype(np.float32)
            taught = np.clip(np.rint(relit), 0, 255).astype(np.uint8)
            level *= min(gain, 1.0)
            is_hidden = _find_hidden(relit, level) & is_covered
            too_light = relit[is_hidden].mean() > 127 if is_hidden.any() else True
        # a remaining shift changes levels at edges in proportion to their slope: it is no
        # difference
        slopes = cv2.morphologyEx(taught, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) / 2.0
        excess = cv2.absdiff(taught, current) - EDGE_TOLERANCE_PX * slopes
        differs = (excess >= level) & is_covered
        large, allowed = self._large_areas(differs), self.settings.allowed
        differing = int(large[:, cv2.CC_STAT_AREA].sum())
        unknown = int(self._large_areas(is_hidden & ~differs)[:, cv2.CC_STAT_AREA].sum())
        ok = differing + unknown <= allowed
        reason = f"{differing} pixels differ, allowed {allowed}"
        if differing <= allowed:
            reason = (
                f"{'over-exposed' if too_light else 'too dark'}: {unknown} pixels cannot be "
                f"judged, {differing} differ, allowed {allowed}"
            )
        return Finding(
            ok=ok,
            reason="" if ok else reason,
            values={
                "differing": differing,
                "count": min(len(large), 0xFFFF),
                **self._shift_values(motion),
            },
            drawings=[
                Drawing(
                    "polygon", tuple((float(x), float(y)) for x, y in view.region.corners), "region"
                ),
                *(
                    self._draw_difference(row, motion, view)
                    for row in large[:MAX_DRAWN_DIFFERENCES]
                ),
            ],
        )

    def _large_areas(self, mask: NDArray[np.bool_]) -> NDArray[Any]:
        """Return OpenCV's statistics of the connected areas that are large enough to count."""
        cv2 = load("cv2", "inspection needs")
        _, _, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
        large: NDArray[Any] = stats[1:][stats[1:, cv2.CC_STAT_AREA] >= self.settings.area]
        return large

    def _cut_patch(self, view: View) -> NDArray[np.uint8]:
        """Return the region's pixels, upright and in the size of the taught picture."""
        width, height = self._size
        if not view.follows:
            x, y = (round(coordinate) for coordinate in self._corner)
            return view.picture.grey[y : y + height, x : x + width]
        cv2 = load("cv2", "inspection needs")
        corners = self._to_picture(np.array([(0, 0), (1, 0), (0, 1)], float), view)
        affine = np.column_stack([corners[1] - corners[0], corners[2] - corners[0], corners[0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        patch: NDArray[np.uint8] = cv2.warpAffine(
            view.picture.grey, affine, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
        return patch

    def _to_picture(self, points: NDArray[Any], view: View) -> NDArray[Any]:
        """Convert points of the upright region to the picture's pixels."""
        if not view.follows:
            return points + np.rint(self._corner)
        return view.reference.to_picture(points + self._corner + 0.5)

    def _find_motion(self, patch: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the small motion (2, 3) of the part between the taught and the current picture."""
        shift = self.settings.shift
        motion = np.eye(2, 3, dtype=np.float32)
        cv2 = load("cv2", "inspection needs")
        inner = self._taught[shift : self._size[1] - shift, shift : self._size[0] - shift]
        if shift == 0 or inner.std() < 1.0:  # no texture to match
            return motion
        score = np.nan_to_num(cv2.matchTemplate(patch, inner, cv2.TM_CCOEFF_NORMED), nan=-1.0)
        row, column = np.unravel_index(int(score.argmax()), score.shape)
        if score[row, column] < MIN_CORRELATION:
            return motion
        motion[:, 2] = column - shift, row - shift
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, MAX_ITERATIONS, 1e-4)
        refined = motion.copy()
        try:
            cv2.findTransformECC(
                self._taught, patch, refined, cv2.MOTION_EUCLIDEAN, criteria, None, 5
            )
        except cv2.error:  # the registration did not converge
            return motion
        turn = abs(math.atan2(refined[1, 0], refined[0, 0]))
        middle = np.array(self._size) / 2
        shift_of_middle = np.abs(refined[:, :2] @ middle + refined[:, 2] - middle)
        is_plausible = (
            np.isfinite(refined).all()
            and turn <= MAX_ROTATION
            and (shift_of_middle <= shift + 0.5).all()
        )
        return refined if is_plausible else motion

    def _shift_values(self, motion: NDArray[np.float32]) -> dict[str, float]:
        """Return the shift of the region's middle."""
        middle = (np.array(self._size) - 1) / 2
        x, y = motion[:, :2] @ middle + motion[:, 2] - middle
        return {"shift_x": float(x), "shift_y": float(y)}

    def _draw_difference(
        self, stats: NDArray[Any], motion: NDArray[np.float32], view: View
    ) -> Drawing:
        left, top, width, height, area = map(int, stats)
        x, y = left - 0.5, top - 0.5
        box = np.array([(x, y), (x + width, y), (x + width, y + height), (x, y + height)])
        places = self._to_picture(box @ motion[:, :2].T + motion[:, 2], view)
        return Drawing(
            "polygon", tuple((float(a), float(b)) for a, b in places), "wrong", f"{area}"
        )


def _find_hidden(relit: NDArray[np.float32], level: float) -> NDArray[np.bool_]:
    """Return a mask of pixels that cannot be judged, since saturation hides their contrast.

    Args:
        relit: taught levels in the current light, (H, W), not limited to 0 to 255.
        level: least difference, grey levels, of a differing pixel.
    """
    if relit.min() >= 0 and relit.max() <= 255:
        return np.zeros(relit.shape, bool)
    cv2 = load("cv2", "inspection needs")

    def compare_surroundings(
        levels: NDArray[np.float32],
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        slopes = cv2.morphologyEx(levels, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) / 2.0
        min_difference = level + EDGE_TOLERANCE_PX * slopes
        surroundings = np.ones((SURROUNDINGS_PX, SURROUNDINGS_PX), np.uint8)
        return (
            cv2.dilate(levels, surroundings) - levels >= min_difference,
            levels - cv2.erode(levels, surroundings) >= min_difference,
        )

    clipped = np.clip(relit, 0, 255)
    darker, lighter = compare_surroundings(relit)
    still_darker, still_lighter = compare_surroundings(clipped)
    # next to a visible edge, a pixel's level lies between the levels of both sides
    edge = cv2.morphologyEx(clipped, cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8))
    is_flat = edge * (1 - EDGE_TOLERANCE_PX / 2) < level
    mask: NDArray[np.bool_] = ((darker & ~still_darker) | (lighter & ~still_lighter)) & is_flat
    return mask


def _fit_light(taught: NDArray[np.uint8], current: NDArray[np.uint8]) -> tuple[float, float]:
    """Return gain and offset of the current light relative to the taught light.

    They are 1 and 0 if the pictures do not correlate: otherwise a missing part could be mistaken
    for a part in bad light.
    """
    step = max(taught.size // MAX_LIGHT_PIXELS, 1) | 1  # an odd step samples all columns
    x, y = (picture.ravel()[::step].astype(np.float64) for picture in (taught, current))
    is_inlier = np.ones(x.shape, bool)
    gain, offset = 1.0, 0.0
    for _ in range(LIGHT_FIT_ROUNDS):
        a, b = x[is_inlier], y[is_inlier]
        da, db = a - a.mean(), b - b.mean()
        sum_xy, sum_xx, sum_yy = float(da @ db), float(da @ da), float(db @ db)
        correlates = sum_xy > MIN_CORRELATION * math.sqrt(sum_xx * sum_yy) and sum_xx > len(a)
        if not correlates:
            return 1.0, 0.0
        gain = min(max(sum_xy / sum_xx, 1 / MAX_GAIN), MAX_GAIN)
        offset = float(np.median(b - gain * a))
        residuals = np.abs(y - gain * x - offset)
        is_inlier = residuals <= max(OUTLIER_SIGMAS * 1.4826 * float(np.median(residuals)), 3.0)
    return gain, offset
