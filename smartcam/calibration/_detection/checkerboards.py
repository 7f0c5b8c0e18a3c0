"""Find checkerboards in images, refine their corners, and number the corners from the origin."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._detection.boards import (
    FITTED_SHARE,
    MIN_FITTED_SHARE,
    colour_signs,
    complete_board,
    find_boards,
    looks_like_corners,
)
from smartcam.calibration._detection.corners import UNREFINED_SIGMA_PX, Corners, refine_corners
from smartcam.calibration._detection.dots import GridMap
from smartcam.calibration._detection.ordering import (
    MIN_ORIGIN_CONTRAST,
    choose_marked,
    choose_rightward,
    find_arrangements,
    positions_row_by_row,
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
"""A part of a board is accepted only with at least this many connected corners: pictures of leaves,
bricks and noise have up to nine."""

MAX_STRAY_PX = 0.5
"""A corner is a stray if it is farther from its predicted place than this many pixels plus four
times the median distance."""

AVERAGED_DOT_RATIO = 0.8
"""Only this fraction of the diameter of the dot outside of a corner is averaged, which leaves out
the dot's rim."""

DOT_RING_SIDES = 0.3
"""Distance from the centre of the dot at the origin to the paper around it, in sides of a
square."""

RING_ANGLES = np.arange(8) * np.pi / 4

SQUARE_CENTRES = np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5]])
"""Centres of the four squares next to an outer corner, in sides of a square."""

DISC_POINTS = (
    np.array([(x, y) for x in range(-4, 5) for y in range(-4, 5) if x * x + y * y <= 20]) / 4.5
)
"""(N, 2), points of the unit disc."""


def find_checkerboard(image: GreyImage, target: Checkerboard, name: str = "") -> TargetView:
    """Find a checkerboard's corners.

    Raises TARGET_NOT_FOUND, AMBIGUOUS_ORIGIN, MIRRORED.
    """
    search = _Search()
    for candidate in _find_candidates(image, target, search):
        part = candidate.part
        corners = _refine(image, candidate, _grid_steps(candidate.points, part))
        if not _has_board_colours(corners, part):
            continue
        corners = _refit_strays(image, corners, candidate.is_seen, part)
        arrangements = find_arrangements(
            corners.points, positions_row_by_row(part.columns, part.rows), part
        )
        if part == target:
            arrangement, margin = _number_board(image, target, corners, arrangements)
        else:
            arranged = _number_part(image, part, corners, arrangements)
            if arranged is None:
                continue
            arrangement, margin = arranged
        break
    else:
        raise _not_found_error(target, search)
    order = arrangement.order.ravel()
    indices_shown = np.flatnonzero((candidate.is_seen | corners.fitted)[order])
    row, column = np.divmod(indices_shown, part.columns)
    order = order[indices_shown]
    return TargetView(
        target=target,
        size=image.size,
        ids=row * target.columns + column,
        points=corners.points[order],
        covariance=corners.covariance[order],
        margin=margin,
        name=name,
        warnings=(_TWIN_REMARK,) if candidate.has_twin else (),
    )


_TWIN_REMARK: Final = Code.WRONG_TARGET.remark(
    "expected one such board in the picture, got several: the meant one is unknown; cover "
    "the others, or use ChArUco boards of other markers"
)


@dataclass
class _Search:
    """The findings of a search, for the text of its error."""

    largest_counts: tuple[int, int] | None = None  # columns and rows of the largest board found


class _BoardCorners(NamedTuple):
    """Candidates for the corners of a board, row by row."""

    points: Array  # (N, 2), pixels
    # (N,), whether the corner was found; the place of any other is predicted from its neighbours
    is_seen: NDArray[np.bool_]
    part: Checkerboard  # the target, or a smaller board with the columns and rows that are seen
    has_twin: bool = False  # whether the image has another complete board


def _find_candidates(
    image: GreyImage, target: Checkerboard, search: _Search
) -> Iterator[_BoardCorners]:
    """Yield the corners of boards: first of boards that are seen as a whole, then of parts.

    Corners that were not found are at the places that the other corners predict.
    """
    count = target.columns * target.rows
    completed_boards: list[Board] = []
    for board in find_boards(image, count, max_count=(target.columns + 2) * (target.rows + 2)):
        grid = board.points_by_rows(target.columns, target.rows)
        if grid is not None:
            yield _BoardCorners(grid, np.ones(count, dtype=np.bool_), target, board.has_twin)
        is_too_small = min(board.counts) < 3 or len(board.grid_positions) < min(
            MIN_CORNERS_CONNECTED, MIN_FITTED_SHARE * count
        )
        if is_too_small or any(
            earlier_board.shows_same_board(board) for earlier_board in completed_boards
        ):
            continue
        completed_board = complete_board(image, board)
        if completed_board is None:
            continue
        completed_boards.append(completed_board)
        if search.largest_counts is None or math.prod(completed_board.counts) > math.prod(
            search.largest_counts
        ):
            search.largest_counts = completed_board.counts
        filled = completed_board.fill_missing()
        for part in _possible_parts(target, completed_board.counts):
            grid = filled.points_by_rows(part.columns, part.rows)
            if grid is not None and len(completed_board.grid_positions) >= MIN_FITTED_SHARE * len(
                grid
            ):
                is_seen = np.asarray(np.isin(grid, completed_board.points).all(axis=1))
                yield _BoardCorners(grid, is_seen, part)
        if (
            completed_board.is_full
            and len(completed_board.grid_positions) >= MIN_FITTED_SHARE * count
        ):
            return


def _possible_parts(target: Checkerboard, counts: tuple[int, int]) -> Iterator[Checkerboard]:
    """Yield the target if it has these columns and rows, else its parts that include the mark."""
    for columns, rows in dict.fromkeys((counts, counts[::-1])):
        if (columns, rows) == (target.columns, target.rows):
            yield target
        elif target.origin_mark and columns <= target.columns and rows <= target.rows:
            yield replace(target, columns=columns, rows=rows)


def _refine(image: GreyImage, board: _BoardCorners, steps: Array) -> Corners:
    """Return the refined corners; an invisible corner keeps its place and is not ``fitted``.

    ``steps`` (N, 2, 2) lead to the next corners, pixels.
    """
    points, is_visible = board.points, board.is_seen.copy()
    is_inside = ((points >= 0) & (points <= np.array(image.size) - 1)).all(axis=1)
    is_doubted = is_inside & ~is_visible
    is_visible[is_doubted] = looks_like_corners(image, points[is_doubted], steps[is_doubted])
    is_visible &= is_inside
    if is_visible.all():
        return refine_corners(image, points, FITTED_SHARE * steps)
    covariance = np.tile(UNREFINED_SIGMA_PX**2 * np.eye(2), (len(points), 1, 1))
    corners = Corners(points.copy(), covariance, np.zeros(len(points)), np.zeros_like(is_visible))
    if is_visible.any():
        refined = refine_corners(image, points[is_visible], FITTED_SHARE * steps[is_visible])
        for array, other in zip(corners, refined, strict=True):
            array[is_visible] = other
    return corners


def _grid_steps(points: Array, target: Checkerboard) -> Array:
    """Return the steps (N, 2, 2) from each corner to the next along columns and rows, pixels."""
    grid = points.reshape(target.rows, target.columns, 2)
    steps = np.stack([np.gradient(grid, axis=1), np.gradient(grid, axis=0)], axis=2)
    return steps.reshape(-1, 2, 2)


def _refit_strays(
    image: GreyImage, corners: Corners, is_seen: NDArray[np.bool_], target: Checkerboard
) -> Corners:
    """Return the corners after fitting strays again from the places that other corners predict.

    A stray is a corner that was not fitted, or is far from its predicted place. If a corner is a
    stray again after the second fit, its distance from the predicted place is added to its
    covariance.
    """
    grid_positions = positions_row_by_row(target.columns, target.rows).astype(np.float64)
    is_good = corners.fitted
    expected = GridMap(grid_positions[is_good], corners.points[is_good])(grid_positions)
    distances = np.linalg.norm(corners.points - expected, axis=1)
    max_distance = MAX_STRAY_PX + 4 * float(np.median(distances[is_good]))
    is_stray = ~is_good | (distances > max_distance)
    if not is_stray.any():
        return corners
    expected = GridMap(grid_positions[~is_stray], corners.points[~is_stray])(grid_positions)
    refitted = _refine(
        image,
        _BoardCorners(expected[is_stray], is_seen[is_stray], target),
        _grid_steps(expected, target)[is_stray],
    )
    refitted_distances = np.linalg.norm(refitted.points - expected[is_stray], axis=1)
    covariance = refitted.covariance.copy()
    is_doubted = ~refitted.fitted | (refitted_distances > max_distance)
    covariance[is_doubted] += refitted_distances[is_doubted, None, None] ** 2 * np.eye(2)
    for array, other in zip(corners, refitted._replace(covariance=covariance), strict=True):
        array[is_stray] = other
    return corners


def _has_board_colours(corners: Corners, target: Checkerboard) -> bool:
    signs = (
        colour_signs(positions_row_by_row(target.columns, target.rows))
        * np.sign(corners.gains)
        * corners.fitted
    )
    return bool(abs(signs.mean()) >= MIN_FITTED_SHARE)


def _not_found_error(target: Checkerboard, search: _Search) -> CalibrationError:
    """Return the error that says which board was found instead, if there is one."""
    counts = search.largest_counts
    instead = "found none" if counts is None else f"found one of about {counts[0]} x {counts[1]}"
    return Code.TARGET_NOT_FOUND.error(
        f"checkerboard: expected a board of {target.columns} x {target.rows} inner corners that is "
        f"seen as a whole, {instead}",
        (target.columns, target.rows),
        counts,
    )


def _number_board(
    image: GreyImage, target: Checkerboard, corners: Corners, arrangements: list[Arrangement]
) -> tuple[Arrangement, float | None]:
    name = f"checkerboard of {target.columns} x {target.rows} corners"
    if target.origin_mark:
        levels_by_origin = {
            int(arrangement.order[0, 0]): _origin_levels(image, target, corners, arrangement)
            for arrangement in arrangements
        }
        mean_black, mean_white = np.mean(
            [[levels.black, levels.white] for levels in levels_by_origin.values()], axis=0
        )
        outside_count = sum(levels.dot is None for levels in levels_by_origin.values())
        note = (
            f" ({outside_count} of its 4 possible places outside of the image)"
            if outside_count
            else ""
        )

        def level(order: NDArray[np.intp]) -> float:
            """Return the grey level outside of the origin, corrected for uneven light."""
            black, white, dot_level = levels_by_origin[int(order[0, 0])]
            share = 1.0 if dot_level is None else (dot_level - black) / max(white - black, 1.0)
            return float(mean_black + (mean_white - mean_black) * share)

        return choose_marked(arrangements, level, f"{name} with a dark dot at the origin{note}")
    front_views = [arrangement for arrangement in arrangements if arrangement.is_front]
    with_black_origin = [
        arrangement
        for arrangement in front_views
        if _black_origin_score(target, corners, arrangement) > 0
    ]
    if front_views and not with_black_origin and target.columns % 2 == target.rows % 2 == 1:
        raise _white_origin_error(target, name)
    return choose_rightward(with_black_origin or arrangements, name), None


def _white_origin_error(target: Checkerboard, label: str) -> CalibrationError:
    """Return the error for a board whose corner squares are black where the target's are white.

    If columns and rows are both odd and differ, two opposite corner squares are black, and no turn
    of the sheet brings a white one to the place of a black one.
    """
    return Code.MIRRORED.error(
        f"{label}: expected a black square outside of the corner at the origin, got a white one: "
        "an image that is mirrored, or a negative, or the board is one of "
        f"{target.rows} x {target.columns}",
        "a black square",
        "a white one",
    )


def _number_part(
    image: GreyImage, part: Checkerboard, corners: Corners, arrangements: list[Arrangement]
) -> tuple[Arrangement, float] | None:
    """Return the numbering of a part of a board by its mark; None if no mark is seen.

    The paper must be light around the dark dot at the origin, and along the two edges of the board
    that meet there. So a dark place inside of the board, or on another object, is not taken for the
    mark.
    """
    arranged = []
    for arrangement in arrangements:
        if not arrangement.is_front or _black_origin_score(part, corners, arrangement) <= 0:
            continue
        levels = _origin_levels(image, part, corners, arrangement)
        paper_level = min(_paper_levels(image, corners.points[arrangement.order]), default=0.0)
        threshold = (levels.black + levels.white) / 2
        if (
            levels.dot is not None
            and paper_level - levels.dot >= MIN_ORIGIN_CONTRAST
            and paper_level > threshold
        ):
            arranged.append((arrangement, paper_level - levels.dot))
    return arranged[0] if len(arranged) == 1 else None


def _paper_levels(image: GreyImage, grid: Array) -> Iterator[float]:
    """Yield the levels of the paper around the dot, and along the two edges that meet there.

    The level of a place outside of the image is 0.
    """
    rows, columns, _ = grid.shape
    low = -(1 + AREA_DISTANCE_SQUARES)
    dot_ring = DOT_RING_SIDES * np.column_stack([np.cos(RING_ANGLES), np.sin(RING_ANGLES)]) + low
    edge_places = (
        [(index + 0.5, low) for index in range(columns - 1)],
        [(low, index + 0.5) for index in range(rows - 1)],
    )
    grid_positions = positions_row_by_row(columns, rows).astype(np.float64)
    pixels = GridMap(grid_positions, grid.reshape(-1, 2))(np.concatenate([dot_ring, *edge_places]))
    last_pixel = np.array(image.size) - 1
    for pixel in pixels:
        is_inside = bool(((pixel >= 0) & (pixel <= last_pixel)).all())
        yield mean_level(image, pixel[None]) if is_inside else 0.0


class _OriginLevels(NamedTuple):
    """Grey levels near the outer corner that a numbering takes for the origin."""

    black: float  # mean level of the two black squares next to the corner
    white: float  # mean level of the two white squares next to the corner
    dot: float | None  # level where the origin's dot would be; None if that is not in the image


def _origin_levels(
    image: GreyImage, target: Checkerboard, corners: Corners, arrangement: Arrangement
) -> _OriginLevels:
    grid = corners.points[arrangement.order]
    square_levels = sorted(
        mean_level(image, _map_near_origin(grid, centre + FITTED_SHARE * DISC_POINTS))
        for centre in SQUARE_CENTRES
    )
    dot_places = (
        target.corner_areas[0] / target.square
        + AVERAGED_DOT_RATIO * AREA_DIAMETER_SQUARES / 2 * DISC_POINTS
    )
    dot_pixels = _map_near_origin(grid, dot_places)
    is_inside = ((dot_pixels >= 0) & (dot_pixels <= np.array(image.size) - 1)).all()
    level = mean_level(image, dot_pixels) if is_inside else None
    return _OriginLevels(sum(square_levels[:2]) / 2, sum(square_levels[2:]) / 2, level)


def _black_origin_score(target: Checkerboard, corners: Corners, arrangement: Arrangement) -> float:
    """Return the number of corners whose colours fit a black origin, minus all other corners."""
    order = arrangement.order
    # the sign of a gain depends on the directions of the found grid's columns and rows, which may
    # differ from those of the target
    direction = float(np.sign(order[0, 1] - order[0, 0]) * np.sign(order[1, 0] - order[0, 0]))
    signs = np.sign(corners.gains[order.ravel()])
    return direction * float(
        colour_signs(positions_row_by_row(target.columns, target.rows)) @ signs
    )


def _map_near_origin(grid: Array, grid_positions: Array) -> Array:
    """Map grid positions (N, 2) near the first corner of a grid (rows, columns, 2) to pixels.

    Positions are relative to this corner, in sides of a square.
    """
    first_places = positions_row_by_row(3, 3).astype(np.float64)
    first_corners = grid[:3, :3].reshape(-1, 2)
    matrix = fit_homography(first_places, first_corners)
    return (
        np.full_like(grid_positions, first_corners[0])
        if matrix is None
        else apply_homography(matrix, grid_positions)
    )
