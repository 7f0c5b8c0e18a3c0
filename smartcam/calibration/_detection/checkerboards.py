"""Find checkerboards in images, refine their corners and number them from their origin."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._detection.boards import (
    FITTED_SHARE,
    MIN_FITTED_SHARE,
    boards,
    completed,
    like_corners,
    parity,
)
from smartcam.calibration._detection.corners import UNREFINED_SIGMA_PX, Corners, refine_corners
from smartcam.calibration._detection.dots import GridMap
from smartcam.calibration._detection.ordering import (
    MIN_ORIGIN_CONTRAST,
    arrangements,
    marked,
    most_rightward,
    places_row_by_row,
)
from smartcam.calibration._detection.sampling import mean_level
from smartcam.calibration._homography import apply_homography, fit_homography
from smartcam.calibration._targets import AREA_DIAMETER_SQUARES, AREA_DISTANCE_SQUARES
from smartcam.calibration._views import TargetView
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from smartcam.calibration._detection.boards import Board
    from smartcam.calibration._detection.image import GreyImage
    from smartcam.calibration._detection.ordering import Arrangement
    from smartcam.calibration._targets import Checkerboard
    from smartcam.exceptions import CalibrationError
    from smartcam.geometry._inside import Array

MIN_CORNERS_CONNECTED = 10
"""A part of a board has at least this many connected corners: pictures of leaves, bricks and noise
have up to nine."""

MAX_STRAY_PX = 0.5
"""A corner may lie this many pixels plus four times the median distance off the place that the
others predict."""

OUTER_AREA_RATIO = 0.8
"""The grey level outside of a corner is averaged over this part of the area's diameter, so not at
its rim."""

DOT_RING_SIDES = 0.3
"""Distance from the centre of the dot at the origin to the paper around it, in sides of a
square."""

RING_ANGLES = np.arange(8) * np.pi / 4

SQUARES = np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5]])
"""Centres of the four squares next to an outer corner, in sides of a square."""

DISC = np.array([(x, y) for x in range(-4, 5) for y in range(-4, 5) if x * x + y * y <= 20]) / 4.5
"""(N, 2), points of the unit disc."""


def find_checkerboard(image: GreyImage, target: Checkerboard, name: str = "") -> TargetView:
    """Find a checkerboard's corners.

    Raises TARGET_NOT_FOUND, AMBIGUOUS_ORIGIN, MIRRORED.
    """
    seen = _Search()
    for candidate in _candidates(image, target, seen):
        part = candidate.part
        corners = _refined(image, candidate, _steps(candidate.points, part))
        if not _looks_right(corners, part):
            continue
        corners = _without_strays(image, corners, candidate.seen, part)
        ways = arrangements(corners.points, places_row_by_row(part.columns, part.rows), part)
        if part == target:
            arrangement, margin = _number(image, target, corners, ways)
        else:
            numbered = _number_part(image, part, corners, ways)
            if numbered is None:
                continue
            arrangement, margin = numbered
        break
    else:
        raise _not_found_error(target, seen)
    order = arrangement.order.ravel()
    shown = np.flatnonzero((candidate.seen | corners.fitted)[order])
    row, column = np.divmod(shown, part.columns)
    order = order[shown]
    return TargetView(
        target=target,
        size=image.size,
        ids=row * target.columns + column,
        points=corners.points[order],
        covariance=corners.covariance[order],
        margin=margin,
        name=name,
        warnings=(_ANOTHER,) if candidate.again else (),
    )


_ANOTHER: Final = Code.WRONG_TARGET.remark(
    "expected one such board in the picture, got several: the meant one is unknown; cover "
    "the others, or use ChArUco boards of other markers"
)


@dataclass
class _Search:
    """The findings of a search, kept for the text of its error."""

    shape: tuple[int, int] | None = None  # columns and rows of the largest board found


class _BoardCorners(NamedTuple):
    """Corners of a board, row by row."""

    points: Array  # (N, 2), pixels
    # (N,), whether the corner was seen; the place of any other is predicted from its neighbours
    seen: NDArray[np.bool_]
    part: Checkerboard  # the target, or the part of its columns and rows that is seen
    again: bool = False  # whether the image has another complete board


def _candidates(image: GreyImage, target: Checkerboard, seen: _Search) -> Iterator[_BoardCorners]:
    """Yield corners row by row: first of boards seen as a whole, then of those seen in part.

    Corners that were not found are at the places that the others predict.
    """
    count = target.columns * target.rows
    looked_at: list[Board] = []
    for board in boards(image, count, most=(target.columns + 2) * (target.rows + 2)):
        grid = board.by_rows(target.columns, target.rows)
        if grid is not None:
            yield _BoardCorners(grid, np.ones(count, dtype=np.bool_), target, board.again)
        small = min(board.shape) < 3 or len(board.places) < min(
            MIN_CORNERS_CONNECTED, MIN_FITTED_SHARE * count
        )
        if small or any(seen_board.shows(board) for seen_board in looked_at):
            continue
        completed_board = completed(image, board)
        if completed_board is None:
            continue
        looked_at.append(completed_board)
        if seen.shape is None or math.prod(completed_board.shape) > math.prod(seen.shape):
            seen.shape = completed_board.shape
        filled = completed_board.filled()
        for part in _parts(target, completed_board.shape):
            grid = filled.by_rows(part.columns, part.rows)
            if grid is not None and len(completed_board.places) >= MIN_FITTED_SHARE * len(grid):
                same = np.asarray(np.isin(grid, completed_board.points).all(axis=1))
                yield _BoardCorners(grid, same, part)
        if completed_board.is_full and len(completed_board.places) >= MIN_FITTED_SHARE * count:
            return


def _parts(target: Checkerboard, shape: tuple[int, int]) -> Iterator[Checkerboard]:
    """Yield the target if it has this shape, else its parts of this shape with the mark."""
    for columns, rows in dict.fromkeys((shape, shape[::-1])):
        if (columns, rows) == (target.columns, target.rows):
            yield target
        elif target.origin_mark and columns <= target.columns and rows <= target.rows:
            yield replace(target, columns=columns, rows=rows)


def _refined(image: GreyImage, board: _BoardCorners, steps: Array) -> Corners:
    """Return the refined corners; one that is not visible keeps its place, as not fitted.

    ``steps`` (N, 2, 2) lead to the next corners, pixels.
    """
    points, seen = board.points, board.seen.copy()
    inside = ((points >= 0) & (points <= np.array(image.size) - 1)).all(axis=1)
    doubted = inside & ~seen
    seen[doubted] = like_corners(image, points[doubted], steps[doubted])
    seen &= inside
    if seen.all():
        return refine_corners(image, points, FITTED_SHARE * steps)
    covariance = np.tile(UNREFINED_SIGMA_PX**2 * np.eye(2), (len(points), 1, 1))
    corners = Corners(points.copy(), covariance, np.zeros(len(points)), np.zeros_like(seen))
    if seen.any():
        found_there = refine_corners(image, points[seen], FITTED_SHARE * steps[seen])
        for array, other in zip(corners, found_there, strict=True):
            array[seen] = other
    return corners


def _steps(points: Array, target: Checkerboard) -> Array:
    """Return the steps from each corner to the next along columns and rows, (N, 2, 2), pixels."""
    grid = points.reshape(target.rows, target.columns, 2)
    steps = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=2)
    return steps.reshape(-1, 2, 2)


def _without_strays(
    image: GreyImage, corners: Corners, seen: NDArray[np.bool_], target: Checkerboard
) -> Corners:
    """Return the corners after a second search for those not fitted or far off their place.

    The second search starts from the place that the other corners predict. A corner that cannot be
    fitted there either, or is far off again, gets a covariance as large as its distance from there.
    """
    flat = places_row_by_row(target.columns, target.rows).astype(np.float64)
    good = corners.fitted
    expected = GridMap(flat[good], corners.points[good])(flat)
    distances = np.linalg.norm(corners.points - expected, axis=1)
    most = MAX_STRAY_PX + 4 * float(np.median(distances[good]))
    stray = ~good | (distances > most)
    if not stray.any():
        return corners
    expected = GridMap(flat[~stray], corners.points[~stray])(flat)
    again = _refined(
        image, _BoardCorners(expected[stray], seen[stray], target), _steps(expected, target)[stray]
    )
    back = np.linalg.norm(again.points - expected[stray], axis=1)
    covariance = again.covariance.copy()
    doubted = ~again.fitted | (back > most)
    covariance[doubted] += back[doubted, None, None] ** 2 * np.eye(2)
    for array, other in zip(corners, again._replace(covariance=covariance), strict=True):
        array[stray] = other
    return corners


def _looks_right(corners: Corners, target: Checkerboard) -> bool:
    colours = (
        parity(places_row_by_row(target.columns, target.rows))
        * np.sign(corners.gains)
        * corners.fitted
    )
    return bool(abs(colours.mean()) >= MIN_FITTED_SHARE)


def _not_found_error(target: Checkerboard, seen: _Search) -> CalibrationError:
    """Return an error that says which board is seen instead, if there is one."""
    shape = seen.shape
    instead = "found none" if shape is None else f"found one of about {shape[0]} x {shape[1]}"
    return Code.TARGET_NOT_FOUND.refusal(
        f"checkerboard: expected a board of {target.columns} x {target.rows} inner corners that is "
        f"seen as a whole, {instead}",
        (target.columns, target.rows),
        shape,
    )


def _number(
    image: GreyImage, target: Checkerboard, corners: Corners, ways: list[Arrangement]
) -> tuple[Arrangement, float | None]:
    name = f"checkerboard of {target.columns} x {target.rows} corners"
    if target.origin_mark:
        shades = {
            int(arrangement.order[0, 0]): _shades(image, target, corners, arrangement)
            for arrangement in ways
        }
        dark, light = np.mean([[shade.black, shade.white] for shade in shades.values()], axis=0)
        outside = sum(shade.area is None for shade in shades.values())
        note = f" ({outside} of the 4 such areas outside of the image)" if outside else ""

        def level(order: NDArray[np.intp]) -> float:
            """Return the grey level that the area would have in the board's mean light."""
            black, white, area = shades[int(order[0, 0])]
            part = 1.0 if area is None else (area - black) / max(white - black, 1.0)
            return float(dark + (light - dark) * part)

        return marked(ways, level, f"{name} with a dark area at the origin{note}")
    proper = [arrangement for arrangement in ways if arrangement.proper]
    black = [arrangement for arrangement in proper if _blackness(target, corners, arrangement) > 0]
    if proper and not black and target.columns % 2 == target.rows % 2 == 1:
        raise _white_origin_error(target, name)
    return most_rightward(black or ways, name), None


def _white_origin_error(target: Checkerboard, label: str) -> CalibrationError:
    """Return the error for a board whose black corners are where the target has white ones.

    If the counts of columns and rows are both odd and differ, two corners that lie opposite each
    other are black, and turning the sheet exchanges no black one with a white one.
    """
    return Code.MIRRORED.refusal(
        f"{label}: expected a black square outside of the corner at the origin, got a white one: "
        "an image that is mirrored, or a negative, or the board is one of "
        f"{target.rows} x {target.columns}",
        "a black square",
        "a white one",
    )


def _number_part(
    image: GreyImage, part: Checkerboard, corners: Corners, ways: list[Arrangement]
) -> tuple[Arrangement, float] | None:
    """Return the numbering of a part of a board by its mark; None if no mark is seen.

    Beside the dark dot at the origin the paper is light: around the dot, and along the two edges of
    the board that meet at the dot. So a place inside the board, or on another object, is not taken
    for its corner.
    """
    numbered = []
    for arrangement in ways:
        if not arrangement.proper or _blackness(part, corners, arrangement) <= 0:
            continue
        shades = _shades(image, part, corners, arrangement)
        light = min(_margin_levels(image, corners.points[arrangement.order]), default=0.0)
        middle = (shades.black + shades.white) / 2
        if (
            shades.area is not None
            and light - shades.area >= MIN_ORIGIN_CONTRAST
            and light > middle
        ):
            numbered.append((arrangement, light - shades.area))
    return numbered[0] if len(numbered) == 1 else None


def _margin_levels(image: GreyImage, grid: Array) -> Iterator[float]:
    """Yield the levels of the paper around the dot, and along the two edges beside it.

    Places outside of the image have the level 0.
    """
    rows, columns, _ = grid.shape
    low = -(1 + AREA_DISTANCE_SQUARES)
    around = DOT_RING_SIDES * np.column_stack([np.cos(RING_ANGLES), np.sin(RING_ANGLES)]) + low
    along = (
        [(at + 0.5, low) for at in range(columns - 1)],
        [(low, at + 0.5) for at in range(rows - 1)],
    )
    flat = places_row_by_row(columns, rows).astype(np.float64)
    seen = GridMap(flat, grid.reshape(-1, 2))(np.concatenate([around, *along]))
    last = np.array(image.size) - 1
    for place in seen:
        inside = bool(((place >= 0) & (place <= last)).all())
        yield mean_level(image, place[None]) if inside else 0.0


class _Shades(NamedTuple):
    """Grey levels near an outer corner."""

    black: float  # mean level of the two black squares next to the corner
    white: float  # mean level of the two white ones
    area: float | None  # level of the area outside of the corner; None if that is not in the image


def _shades(
    image: GreyImage, target: Checkerboard, corners: Corners, arrangement: Arrangement
) -> _Shades:
    grid = corners.points[arrangement.order]
    squares = sorted(
        mean_level(image, _mapped_near(grid, at + FITTED_SHARE * DISC)) for at in SQUARES
    )
    area = (
        target.corner_areas[0] / target.square + OUTER_AREA_RATIO * AREA_DIAMETER_SQUARES / 2 * DISC
    )
    seen = _mapped_near(grid, area)
    inside = ((seen >= 0) & (seen <= np.array(image.size) - 1)).all()
    level = mean_level(image, seen) if inside else None
    return _Shades(sum(squares[:2]) / 2, sum(squares[2:]) / 2, level)


def _blackness(target: Checkerboard, corners: Corners, arrangement: Arrangement) -> float:
    """Return the number of corners that show a black square at the origin, minus the others."""
    order = arrangement.order
    # gains refer to the found grid's columns and rows, which may run against the target's
    against = float(np.sign(order[0, 1] - order[0, 0]) * np.sign(order[1, 0] - order[0, 0]))
    signs = np.sign(corners.gains[order.ravel()])
    return against * float(parity(places_row_by_row(target.columns, target.rows)) @ signs)


def _mapped_near(grid: Array, at: Array) -> Array:
    """Map places (N, 2) near the first corner of a grid (rows, columns, 2) to pixels.

    A place is given from this corner, in sides of a square.
    """
    places = places_row_by_row(3, 3).astype(np.float64)
    nearest = grid[:3, :3].reshape(-1, 2)
    matrix = fit_homography(places, nearest)
    return np.full_like(at, nearest[0]) if matrix is None else apply_homography(matrix, at)
