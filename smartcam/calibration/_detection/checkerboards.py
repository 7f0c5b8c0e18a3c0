"""Checkerboards in images: found, refined, numbered from their origin."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from smartcam.calibration._codes import Code
from smartcam.calibration._detection.boards import LEAST_FITTED, PART, boards, completed, parity
from smartcam.calibration._detection.corners import refine_corners
from smartcam.calibration._detection.dots import GridMap
from smartcam.calibration._detection.image import USUAL_SIZE, scaled
from smartcam.calibration._detection.ordering import arrangements, leftmost, marked, rows_of
from smartcam.calibration._detection.sampling import mean_level
from smartcam.calibration._geometry.homography import apply_homography, fit_homography
from smartcam.calibration._optional_imports import load
from smartcam.calibration._targets import AREA_DIAMETER
from smartcam.calibration._views import TargetView
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration._detection.corners import Corners
    from smartcam.calibration._detection.image import GreyImage
    from smartcam.calibration._detection.ordering import Arrangement
    from smartcam.calibration._geometry.rotations import Array
    from smartcam.calibration._targets import Checkerboard

LEAST_SEEN = 10
"""Corners that hang together in what may be a part of a board: pictures of leaves, bricks and noise
have up to nine."""

STRAY = 0.5
"""Pixels by which a corner may lie apart from where the others say it is, beside four times the
median of that."""

AREA_PART = 0.8
"""Of the area outside of a corner that is looked at: not its rim."""

SQUARES = np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5]])
"""Middles of the four squares next to an outer corner, in sides of one."""

DISC = np.array([(x, y) for x in range(-4, 5) for y in range(-4, 5) if x * x + y * y <= 20]) / 4.5
"""(N, 2), points of the unit disc."""


def find_checkerboard(image: GreyImage, target: Checkerboard, name: str = "") -> TargetView:
    """Find a checkerboard's corners.

    Raises TARGET_NOT_FOUND, AMBIGUOUS_ORIGIN, MIRRORED.
    """
    seen = _Search()
    for found in _candidates(image, target, seen):
        corners = refine_corners(image, found, PART * _steps(found, target))
        if _looks_right(corners, target):
            corners = _without_strays(image, corners, target)
            break
    else:
        raise _not_found(target, seen)
    ways = arrangements(corners.points, rows_of(target.columns, target.rows), target)
    way, margin = _number(image, target, corners, ways)
    order = way.order.ravel()
    return TargetView(
        target=target,
        size=image.size,
        ids=np.arange(len(order), dtype=np.intp),
        points=corners.points[order],
        covariance=corners.covariance[order],
        margin=margin,
        name=name,
    )


@dataclass
class _Search:
    """What a search came by, for its error."""

    shape: tuple[int, int] | None = None  # columns and rows of the largest board


def _candidates(image: GreyImage, target: Checkerboard, seen: _Search) -> Iterator[Array]:
    """Yield corners row by row, as we and then OpenCV's detectors see them.

    The latter take much longer and are asked only where a part of such a board is seen.
    """
    count = target.columns * target.rows
    parts = []
    for board in boards(image, count, most=(target.columns + 2) * (target.rows + 2)):
        found = board.by_rows(target.columns, target.rows)
        if found is not None:
            yield found
        if min(board.shape) >= 3 and len(board.places) >= min(LEAST_SEEN, LEAST_FITTED * count):
            parts.append(board)
    for board in sorted(parts, key=lambda part: -len(part.places)):
        whole = completed(image, board)
        if whole is None:
            continue
        found = whole.by_rows(target.columns, target.rows)
        if found is not None:
            yield found
        if seen.shape is None or math.prod(whole.shape) > math.prod(seen.shape):
            seen.shape = whole.shape
        if found is None and whole.is_full:
            return
    if seen.shape is not None:
        yield from _opencvs(image, target)


def _opencvs(image: GreyImage, target: Checkerboard) -> Iterator[Array]:
    """Yield corners row by row, as one of OpenCV's detectors after the other sees them."""
    cv2: Any = load("cv2")
    pattern = (target.columns, target.rows)
    classic = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    sector = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    usual = min(1.0, USUAL_SIZE / max(image.size))
    attempts = [
        (usual, cv2.findChessboardCorners, classic),
        (usual, cv2.findChessboardCornersSB, sector),
        (usual / 2, cv2.findChessboardCorners, classic),
        (2 * usual, cv2.findChessboardCornersSB, sector),
    ]
    for scale, find, flags in attempts:
        ok, corners = find(scaled(image.bytes, scale), pattern, flags=flags)
        if ok and len(corners) == target.columns * target.rows:
            found: Array = np.array(corners, dtype=np.float64).reshape(-1, 2)
            yield (found + 0.5) / scale - 0.5


def _steps(points: Array, target: Checkerboard) -> Array:
    """Return (N, 2, 2): the ways from each corner to the next along columns and rows, pixels."""
    grid = points.reshape(target.rows, target.columns, 2)
    steps = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=2)
    return steps.reshape(-1, 2, 2)


def _without_strays(image: GreyImage, corners: Corners, target: Checkerboard) -> Corners:
    """Return corners of which those that could not be fitted, or lie apart, are looked for again.

    They start from where the others say that they are; what cannot be fitted there, either, has a
    covariance as large as the way.
    """
    flat = rows_of(target.columns, target.rows).astype(np.float64)
    good = corners.fitted
    expected = GridMap(flat[good], corners.points[good])(flat)
    apart = np.linalg.norm(corners.points - expected, axis=1)
    stray = ~good | (apart > STRAY + 4 * np.median(apart[good]))
    if not stray.any():
        return corners
    expected = GridMap(flat[~stray], corners.points[~stray])(flat)
    again = refine_corners(image, expected[stray], PART * _steps(expected, target)[stray])
    back = np.linalg.norm(again.points - expected[stray], axis=1)
    covariance = again.covariance.copy()
    covariance[~again.fitted] += back[~again.fitted, None, None] ** 2 * np.eye(2)
    for mine, other in zip(corners, again._replace(covariance=covariance), strict=True):
        mine[stray] = other
    return corners


def _looks_right(corners: Corners, target: Checkerboard) -> bool:
    colours = parity(rows_of(target.columns, target.rows)) * np.sign(corners.gains) * corners.fitted
    return bool(abs(colours.mean()) >= LEAST_FITTED)


def _not_found(target: Checkerboard, seen: _Search) -> CalibrationError:
    """Return an error that says which board is seen instead, if there is one."""
    shape = seen.shape
    instead = "found none" if shape is None else f"found one of about {shape[0]} x {shape[1]}"
    return CalibrationError(
        f"checkerboard: expected a board of {target.columns} x {target.rows} inner corners that is "
        f"seen as a whole, {instead}",
        code=Code.TARGET_NOT_FOUND,
        expected=(target.columns, target.rows),
        got=shape,
    )


def _number(
    image: GreyImage, target: Checkerboard, corners: Corners, ways: list[Arrangement]
) -> tuple[Arrangement, float | None]:
    what = f"checkerboard of {target.columns} x {target.rows} corners"
    if target.origin_mark:
        shades = {int(way.order[0, 0]): _shades(image, target, corners, way) for way in ways}
        dark, light = np.mean([[shade.black, shade.white] for shade in shades.values()], axis=0)
        outside = sum(shade.area is None for shade in shades.values())
        note = f" ({outside} of the 4 such areas outside of the image)" if outside else ""

        def level(order: NDArray[np.intp]) -> float:
            """Return the level of the area as it would be where all light is as in the mean."""
            black, white, area = shades[int(order[0, 0])]
            part = 1.0 if area is None else (area - black) / max(white - black, 1.0)
            return float(dark + (light - dark) * part)

        return marked(ways, level, f"{what} with a dark area at the origin{note}")
    proper = [way for way in ways if way.proper]
    black = [way for way in proper if _blackness(target, corners, way) > 0]
    if proper and not black and target.columns % 2 == target.rows % 2 == 1:
        raise _white_origin(target, what)
    return leftmost(black or ways, what), None


def _white_origin(target: Checkerboard, what: str) -> CalibrationError:
    """Return an error of a board whose black corners are where the target's white ones are.

    Of counts that are both odd and differ, two corners that lie opposite each other are black, and
    turning the sheet exchanges no black one with a white one.
    """
    return CalibrationError(
        f"{what}: expected a black square outside of the corner at the origin, got a white one: "
        "an image that is mirrored, or a negative, or the board is one of "
        f"{target.rows} x {target.columns}",
        code=Code.MIRRORED,
        expected="a black square",
        got="a white one",
    )


class _Shades(NamedTuple):
    """Grey levels near an outer corner."""

    black: float  # of the two black squares next to it
    white: float  # of the two white ones
    area: float | None  # of the area outside of it; None where that is not in the image


def _shades(image: GreyImage, target: Checkerboard, corners: Corners, way: Arrangement) -> _Shades:
    grid = corners.points[way.order]
    squares = sorted(mean_level(image, _near(grid, at + PART * DISC)) for at in SQUARES)
    area = target.corner_areas[0] / target.square + AREA_PART * AREA_DIAMETER / 2 * DISC
    seen = _near(grid, area)
    inside = ((seen >= 0) & (seen <= np.array(image.size) - 1)).all()
    level = mean_level(image, seen) if inside else None
    return _Shades(sum(squares[:2]) / 2, sum(squares[2:]) / 2, level)


def _blackness(target: Checkerboard, corners: Corners, way: Arrangement) -> float:
    """Count corners by which the outermost square at the origin is black, less the others."""
    order = way.order
    # gains refer to the found grid's columns and rows, which may run against the target's
    against = float(np.sign(order[0, 1] - order[0, 0]) * np.sign(order[1, 0] - order[0, 0]))
    signs = np.sign(corners.gains[order.ravel()])
    return against * float(parity(rows_of(target.columns, target.rows)) @ signs)


def _near(grid: Array, at: Array) -> Array:
    """Return pixels of places (N, 2) near the first corner of a grid (rows, columns, 2).

    Places are in sides of a square from this corner.
    """
    places = rows_of(3, 3).astype(np.float64)
    near = grid[:3, :3].reshape(-1, 2)
    matrix = fit_homography(places, near)
    return np.full_like(at, near[0]) if matrix is None else apply_homography(matrix, at)
