"""Draw images of targets as a camera would take them, for tests with known truth.

Each pixel is the mean, over its square, of the image of a lens with a Gaussian blur. A sample that
an edge divides has a mean of the levels on both sides, so edges do not snap to the raster of
samples: a corner is where :meth:`~smartcam.calibration.CameraModel.project` says, to a few
thousandths of a pixel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.calibration._detection.charucos import charuco_board
from smartcam.calibration._detection.marker_grids import marker_patterns
from smartcam.calibration._targets import Charuco, Checkerboard, MarkerGrid
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.calibration._detection.pixels import Floats
    from smartcam.calibration._targets import CircleGrid, Target
    from smartcam.geometry import CameraModel, Transform
    from smartcam.geometry._inside import Array

SAMPLES_PER_SIDE = 4
"""A pixel is drawn from this many samples along each side."""

QUIET_ZONE_SQUARES = 1.0
"""Width of the white paper around a target, in sides of its squares or distances of its dots."""


def render(
    target: Target,
    camera: CameraModel,
    T_camera_target: Transform,  # noqa: N803
    *,
    blur: float = 0.7,
    noise: float = 0.0,
    black: float = 30.0,
    white: float = 210.0,
    background: float = 120.0,
    random: np.random.Generator | None = None,
) -> NDArray[np.uint8]:
    """Draw a camera's image of a target on white paper.

    Args:
        target: the printed target.
        camera: lens that sees the target; its image size is that of the result.
        T_camera_target: pose of the target in the camera's frame.
        blur: standard deviation of the lens' blur, pixels; averaging over a pixel's area adds to
            it.
        noise: standard deviation of each pixel, grey levels of 255.
        black: grey level of the print.
        white: grey level of the paper.
        background: grey level around the paper.
        random: source of the noise; None for reproducible noise.

    Returns:
        (H, W).

    Raises:
        CalibrationError: MIRRORED: the camera is behind the sheet; OUT_OF_FIELD: a part of the
            sheet is behind the camera.
    """
    cv2 = load("cv2")
    image = np.full(camera.size[::-1], background, dtype=np.float32)
    paper = _outline(target, QUIET_ZONE_SQUARES)
    left, top, right, bottom = _paper_box(paper, camera, T_camera_target, 2 + 4 * blur)
    if left < right and top < bottom:
        u, v = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
        sheet_samples = _sample_sheet(camera, T_camera_target, u, v)
        print_levels = white + (black - white) * _black_share(target, sheet_samples)
        levels_of_samples = background + (print_levels - background) * _rectangle_share(
            sheet_samples, paper
        )
        if blur > 0:
            levels_of_samples = cv2.GaussianBlur(
                levels_of_samples, (0, 0), blur * SAMPLES_PER_SIDE, borderType=cv2.BORDER_REPLICATE
            )
        size = (right - left, bottom - top)
        image[top:bottom, left:right] = cv2.resize(
            levels_of_samples, size, interpolation=cv2.INTER_AREA
        )
    if noise > 0:
        source = np.random.default_rng(0) if random is None else random
        image += np.asarray(source.normal(scale=noise, size=image.shape), dtype=np.float32)
    levels: NDArray[np.uint8] = np.rint(image).clip(0, 255).astype(np.uint8)
    return levels


class _Samples(NamedTuple):
    """The places on a sheet of an image's samples; all arrays have the same shape."""

    x: Floats  # x of each sample, metres, in the target's frame
    y: Floats  # y of each sample, metres, in the target's frame
    x_grain: Floats  # extent of a sample along x, metres
    y_grain: Floats  # extent of a sample along y, metres


def _outline(target: Target, margin: float = 0.0) -> Array:
    """Return the lower left and the upper right corner of the print, (2, 2), metres.

    ``margin``: paper to include around the print, in sides of a square or distances of two dots.
    """
    if isinstance(target, Charuco | Checkerboard):
        pitch = overhang = target.square
    elif isinstance(target, MarkerGrid):
        pitch, overhang = target.marker, target.gap if target.kalibr else 0.0
    else:
        pitch, overhang = target.spacing, max(target.diameter, target.origin_diameter or 0.0) / 2
    points, border = target.points[:, :2], overhang + margin * pitch
    return np.stack([points.min(axis=0) - border, points.max(axis=0) + border])


def _paper_box(
    paper: Array, camera: CameraModel, pose: Transform, margin: float
) -> tuple[int, ...]:
    """Return the box of pixels that shows the paper and a margin: left, top, right, bottom."""
    if float(pose.rotation[:, 2] @ pose.translation) >= 0:
        raise Code.MIRRORED.error(
            f"{pose.label}: expected the sheet's front towards the camera, got its back",
            "the target's z towards the camera",
            "its z away from the camera",
        )
    steps = np.linspace(0.0, 1.0, 50)
    zero, ones = np.zeros(50), np.ones(50)
    fractions = np.column_stack([np.r_[steps, ones, steps, zero], np.r_[zero, steps, ones, steps]])
    rim_points = (paper[0] + fractions * (paper[1] - paper[0])) @ pose.rotation[
        :, :2
    ].T + pose.translation
    nearest = float(rim_points[:, 2].min())
    if not nearest > 0:
        raise Code.OUT_OF_FIELD.error(
            f"{pose.label}: expected the sheet in front of the camera, got a corner at z = "
            f"{nearest:.3g} m",
            "z > 0",
            nearest,
        )
    pixels, size = camera.project(rim_points), np.array(camera.size)
    low, high = np.floor(pixels.min(axis=0) - margin), np.ceil(pixels.max(axis=0) + margin)
    if (low < -size / 2).any() or (high > 1.5 * size).any():
        # a lens model may fold points this far outside of the image back into it
        return 0, 0, *camera.size
    left, top = np.maximum(low, 0).astype(int).tolist()
    right, bottom = np.minimum(high + 1, size).astype(int).tolist()
    return left, top, right, bottom


def _sample_sheet(
    camera: CameraModel, pose: Transform, u: NDArray[np.intp], v: NDArray[np.intp]
) -> _Samples:
    cv2 = load("cv2")
    directions = camera.directions(np.column_stack([u.ravel(), v.ravel()]))
    rays = np.column_stack([directions, np.ones(len(directions))])
    normal = pose.rotation[:, 2]
    slope = np.minimum(rays @ normal, -1e-6)  # limits rays beyond the horizon
    points = (
        rays * (normal @ pose.translation / slope)[:, None] - pose.translation
    ) @ pose.rotation
    rows, columns = u.shape
    sample_shape = (columns * SAMPLES_PER_SIDE, rows * SAMPLES_PER_SIDE)
    arrays = []
    for axis in (0, 1):
        coarse = points[:, axis].reshape(rows, columns).astype(np.float32)
        coordinate = cv2.resize(coarse, sample_shape, interpolation=cv2.INTER_LINEAR)
        by_row, by_column = np.gradient(coarse)
        grain = (np.abs(by_row) + np.abs(by_column)) / SAMPLES_PER_SIDE
        arrays += [coordinate, cv2.resize(grain, sample_shape, interpolation=cv2.INTER_LINEAR)]
    return _Samples(arrays[0], arrays[2], arrays[1], arrays[3])


def _positive_share(distance: Floats, grain: Floats) -> Floats:
    """Return the part of a sample that lies on the positive side of an edge."""
    share: Floats = distance / grain
    share += np.float32(0.5)
    return share.clip(0, 1, out=share)


def _rectangle_share(sheet: _Samples, outline: Array) -> Floats:
    (left, low), (right, high) = outline.astype(np.float32)
    x_share = _positive_share(np.minimum(sheet.x - left, right - sheet.x), sheet.x_grain)
    return x_share * _positive_share(np.minimum(sheet.y - low, high - sheet.y), sheet.y_grain)


def _black_share(target: Target, sheet: _Samples) -> Floats:
    """Return the part of each sample that is black."""
    match target:
        case Checkerboard():
            black = _square_shares(sheet, _outline(target), target.square)
            if target.origin_mark:
                dot = _disc_share(sheet, target.corner_areas[0], target.corner_area_diameter)
                black = np.maximum(black, dot)
        case Charuco():
            black = _charuco_shares(target, sheet)
        case MarkerGrid():
            black = _marker_shares(target, sheet)
        case _:
            black = _dot_shares(target, sheet)
    return black


def _square_shares(sheet: _Samples, outline: Array, side: float) -> Floats:
    """Return the black part of each sample, for squares with a black one at the lower left."""
    x_signs = _stripe_signs(sheet.x, sheet.x_grain, outline[0, 0], side)
    y_signs = _stripe_signs(sheet.y, sheet.y_grain, outline[0, 1], side)
    shares: Floats = np.float32(0.5) + x_signs * y_signs * np.float32(0.5)
    shares *= _rectangle_share(sheet, outline)
    return shares


def _stripe_signs(coordinates: Floats, grain: Floats, start: float, side: float) -> Floats:
    """Return 1 in the first stripe after ``start``, -1 in the next stripe, and so on."""
    # a wave of triangles: 1/2 in the middle of a stripe, 0 at its edges, -1/2 in the next middle
    wave = (coordinates - np.float32(start)) * np.float32(0.5 / side) + np.float32(0.25)
    wave -= np.floor(wave)
    distance = np.float32(side) * (np.float32(0.5) - 2 * np.abs(wave - np.float32(0.5)))
    return 2 * _positive_share(distance, grain) - 1


def _disc_share(sheet: _Samples, centre: Array, diameter: float) -> Floats:
    x, y = sheet.x - np.float32(centre[0]), sheet.y - np.float32(centre[1])
    return _positive_share(np.float32(diameter / 2) - np.hypot(x, y), _mean_grain(sheet))


def _mean_grain(sheet: _Samples) -> Floats:
    grain: Floats = np.sqrt((sheet.x_grain**2 + sheet.y_grain**2) / np.float32(2))
    return grain


def _dot_shares(target: CircleGrid, sheet: _Samples) -> Floats:
    """Return the black part of each sample, for dots."""
    pitch, grain = target.spacing, _mean_grain(sheet)
    last_x, last_y = target.columns - 1, target.rows - 1
    if target.asymmetric:
        lattices = [(0.0, last_y // 2), (pitch / 2, (last_y - 1) // 2)]
    else:
        lattices = [(0.0, last_y)]
    black = np.zeros_like(sheet.x)
    for start, last_row in lattices:
        x = sheet.x - np.float32(start)
        y = sheet.y - np.float32(start)
        x -= np.float32(pitch) * np.clip(np.rint(x / np.float32(pitch)), 0, last_x)
        y -= np.float32(pitch) * np.clip(np.rint(y / np.float32(pitch)), 0, last_row)
        distance = np.float32(target.diameter / 2) - np.hypot(x, y)
        black = np.maximum(black, _positive_share(distance, grain))
    if target.origin_diameter is not None:
        black = np.maximum(black, _disc_share(sheet, np.zeros(2), target.origin_diameter))
    return black


def _charuco_shares(target: Charuco, sheet: _Samples) -> Floats:
    """Return the black part of each sample, for OpenCV's board of squares and markers."""
    board = charuco_board(target)
    dictionary, outline = board.getDictionary(), _outline(target)
    modules = dictionary.markerSize + 2
    centres = np.array([np.mean(points, axis=0)[:2] for points in board.getObjPoints()])
    columns, rows = np.floor(centres / target.square).astype(np.intp).T
    rows = target.rows - 1 - rows  # OpenCV counts from the upper left
    black = _square_shares(sheet, outline, target.square)
    if (columns[0] + rows[0]) % 2 == 0:
        black = _rectangle_share(sheet, outline) - black
    x = (sheet.x - np.float32(outline[0, 0])) / np.float32(target.square)
    y = (sheet.y - np.float32(outline[0, 1])) / np.float32(target.square)
    column, row = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    numbers = np.full((target.rows, target.columns), -1)
    numbers[rows, columns] = np.asarray(board.getIds()).ravel()
    is_inside = (column >= 0) & (column < target.columns) & (row >= 0) & (row < target.rows)
    cells = np.nonzero(is_inside)
    number = numbers[row[cells], column[cells]]
    module_size = target.marker / target.square / modules
    module_column = np.floor((x[cells] - column[cells] - 0.5) / module_size + modules / 2).astype(
        np.intp
    )
    module_row = np.floor(modules / 2 - (y[cells] - row[cells] - 0.5) / module_size).astype(np.intp)
    is_marker = (
        (number >= 0)
        & (module_column >= 0)
        & (module_column < modules)
        & (module_row >= 0)
        & (module_row < modules)
    )
    patterns = np.zeros((number.max() + 1, modules, modules), dtype=np.bool_)
    for marker in np.unique(number[is_marker]):
        patterns[marker] = dictionary.generateImageMarker(int(marker), modules) == 0
    is_dark = np.zeros(len(number), dtype=np.bool_)
    is_dark[is_marker] = patterns[
        number[is_marker], module_row[is_marker], module_column[is_marker]
    ]
    black[cells] = np.maximum(black[cells], is_dark)
    return black


def _marker_shares(target: MarkerGrid, sheet: _Samples) -> Floats:
    """Return the black part of each sample, for markers and Kalibr's squares between them."""
    pitch, side, gap = (
        np.float32(length) for length in (target.marker + target.gap, target.marker, target.gap)
    )
    cells, fractions, marker_shares, gap_shares = [], [], [], []
    for coordinates, grain, count in (
        (sheet.x, sheet.x_grain, target.columns),
        (sheet.y, sheet.y_grain, target.rows),
    ):
        cell = np.floor((coordinates + gap / 2) / pitch)
        offset = coordinates - cell * pitch
        is_in_grid = (cell >= 0) & (cell < count)
        cells.append(cell.clip(0, count - 1).astype(np.intp))
        fractions.append(offset / side)
        marker_shares.append(is_in_grid * _positive_share(np.minimum(offset, side - offset), grain))
        # distance into the nearer gap, before or after the marker
        distance = np.where(offset < side / 2, offset + gap, offset - side)
        is_near_grid = (coordinates > -1.5 * gap) & (coordinates < count * pitch + gap / 2)
        gap_shares.append(
            is_near_grid * _positive_share(np.minimum(distance, gap - distance), grain)
        )
    (column, row), (x_fraction, y_fraction) = cells, fractions
    numbers = column + target.columns * (row if target.kalibr else target.rows - 1 - row)
    patterns = marker_patterns(target)
    modules = patterns.shape[1]
    x, y = (
        (modules * fraction).astype(np.intp).clip(0, modules - 1)
        for fraction in (x_fraction, y_fraction)
    )
    is_white = ~patterns[numbers, modules - 1 - y, x]
    is_inner = (
        np.minimum(np.minimum(x_fraction, 1 - x_fraction), np.minimum(y_fraction, 1 - y_fraction))
        > 0.5 / modules
    )
    black: Floats = (marker_shares[0] * marker_shares[1] * ~(is_white & is_inner)).astype(
        np.float32
    )
    if target.kalibr:
        black = np.maximum(black, (gap_shares[0] * gap_shares[1]).astype(np.float32))
    return black
