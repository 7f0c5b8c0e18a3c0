"""Draw images of targets as a camera would take them, for tests with known truth.

Each pixel is the mean, over its own square, of the image of a lens with a Gaussian blur. Edges are
drawn by the part of each sample that they cover, without rounding to a raster: a corner is at its
place by :meth:`~smartcam.calibration.CameraModel.project`, to a few thousandths of a pixel.
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
        blur: standard deviation of the lens' blur, pixels; the square of each pixel adds to it.
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
    left, top, right, bottom = _box(paper, camera, T_camera_target, 2 + 4 * blur)
    if left < right and top < bottom:
        u, v = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
        sheet = _sheet(camera, T_camera_target, u, v)
        inked = white + (black - white) * _black(target, sheet)
        fine = background + (inked - background) * _rectangle(sheet, paper)
        if blur > 0:
            fine = cv2.GaussianBlur(
                fine, (0, 0), blur * SAMPLES_PER_SIDE, borderType=cv2.BORDER_REPLICATE
            )
        size = (right - left, bottom - top)
        image[top:bottom, left:right] = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
    if noise > 0:
        source = np.random.default_rng(0) if random is None else random
        image += np.asarray(source.normal(scale=noise, size=image.shape), dtype=np.float32)
    levels: NDArray[np.uint8] = np.rint(image).clip(0, 255).astype(np.uint8)
    return levels


class _Samples(NamedTuple):
    """The samples of a part of an image on a sheet; all of the same shape."""

    x: Floats  # x of each sample, metres, in the target's frame
    y: Floats  # y of each sample, metres, in the target's frame
    x_grain: Floats  # extent of a sample along x, metres
    y_grain: Floats  # extent of a sample along y, metres


def _outline(target: Target, quiet: float = 0.0) -> Array:
    """Return the lower left and the upper right corner of the print, (2, 2), metres.

    A margin of ``quiet`` times a square's side, or the distance of two dots, is included.
    """
    if isinstance(target, Charuco | Checkerboard):
        pitch = reach = target.square
    elif isinstance(target, MarkerGrid):
        pitch, reach = target.marker, target.gap if target.kalibr else 0.0
    else:
        pitch, reach = target.spacing, max(target.diameter, target.origin_diameter or 0.0) / 2
    flat, beyond = target.points[:, :2], reach + quiet * pitch
    return np.stack([flat.min(axis=0) - beyond, flat.max(axis=0) + beyond])


def _box(paper: Array, camera: CameraModel, pose: Transform, more: float) -> tuple[int, ...]:
    """Return the columns and rows that show the paper: left, top, right, bottom."""
    if float(pose.rotation[:, 2] @ pose.translation) >= 0:
        raise Code.MIRRORED.refusal(
            f"{pose.label}: expected the sheet's front towards the camera, got its back",
            "the target's z towards the camera",
            "its z away from the camera",
        )
    along = np.linspace(0.0, 1.0, 50)
    zero, ones = np.zeros(50), np.ones(50)
    parts = np.column_stack([np.r_[along, ones, along, zero], np.r_[zero, along, ones, along]])
    rim = (paper[0] + parts * (paper[1] - paper[0])) @ pose.rotation[:, :2].T + pose.translation
    nearest = float(rim[:, 2].min())
    if not nearest > 0:
        raise Code.OUT_OF_FIELD.refusal(
            f"{pose.label}: expected the sheet in front of the camera, got a corner at z = "
            f"{nearest:.3g} m",
            "z > 0",
            nearest,
        )
    seen, size = camera.project(rim), np.array(camera.size)
    low, high = np.floor(seen.min(axis=0) - more), np.ceil(seen.max(axis=0) + more)
    if (low < -size / 2).any() or (high > 1.5 * size).any():
        # a lens model may fold points this far outside of the image back into it
        return 0, 0, *camera.size
    left, top = np.maximum(low, 0).astype(int).tolist()
    right, bottom = np.minimum(high + 1, size).astype(int).tolist()
    return left, top, right, bottom


def _sheet(
    camera: CameraModel, pose: Transform, u: NDArray[np.intp], v: NDArray[np.intp]
) -> _Samples:
    cv2 = load("cv2")
    flat = camera.directions(np.column_stack([u.ravel(), v.ravel()]))
    rays = np.column_stack([flat, np.ones(len(flat))])
    normal = pose.rotation[:, 2]
    slope = np.minimum(rays @ normal, -1e-6)  # beyond the horizon: far away
    seen = (rays * (normal @ pose.translation / slope)[:, None] - pose.translation) @ pose.rotation
    rows, columns = u.shape
    fine = (columns * SAMPLES_PER_SIDE, rows * SAMPLES_PER_SIDE)
    parts = []
    for axis in (0, 1):
        coarse = seen[:, axis].reshape(rows, columns).astype(np.float32)
        place = cv2.resize(coarse, fine, interpolation=cv2.INTER_LINEAR)
        by_row, by_column = np.gradient(coarse)
        grain = (np.abs(by_row) + np.abs(by_column)) / SAMPLES_PER_SIDE
        parts += [place, cv2.resize(grain, fine, interpolation=cv2.INTER_LINEAR)]
    return _Samples(parts[0], parts[2], parts[1], parts[3])


def _share(distance: Floats, grain: Floats) -> Floats:
    """Return the part of a sample that lies on the positive side of an edge."""
    share: Floats = distance / grain
    share += np.float32(0.5)
    return share.clip(0, 1, out=share)


def _rectangle(sheet: _Samples, outline: Array) -> Floats:
    (left, low), (right, high) = outline.astype(np.float32)
    across = _share(np.minimum(sheet.x - left, right - sheet.x), sheet.x_grain)
    return across * _share(np.minimum(sheet.y - low, high - sheet.y), sheet.y_grain)


def _black(target: Target, sheet: _Samples) -> Floats:
    """Return the part of each sample that is black."""
    match target:
        case Checkerboard():
            black = _squares(sheet, _outline(target), target.square)
            if target.origin_mark:
                dot = _disc(sheet, target.corner_areas[0], target.corner_area_diameter)
                black = np.maximum(black, dot)
        case Charuco():
            black = _charuco(target, sheet)
        case MarkerGrid():
            black = _marker_grid(target, sheet)
        case _:
            black = _dots(target, sheet)
    return black


def _squares(sheet: _Samples, outline: Array, side: float) -> Floats:
    """Return the black parts of squares that begin with a black one at the lower left."""
    across = _turns(sheet.x, sheet.x_grain, outline[0, 0], side)
    upwards = _turns(sheet.y, sheet.y_grain, outline[0, 1], side)
    shares: Floats = np.float32(0.5) + across * upwards * np.float32(0.5)
    shares *= _rectangle(sheet, outline)
    return shares


def _turns(place: Floats, grain: Floats, least: float, side: float) -> Floats:
    """Return 1 in the first stripe after ``least``, -1 in the next, and so on."""
    # a wave of triangles: 1/2 in the middle of a stripe, 0 at its edges, -1/2 in the next middle
    wave = (place - np.float32(least)) * np.float32(0.5 / side) + np.float32(0.25)
    wave -= np.floor(wave)
    inside = np.float32(side) * (np.float32(0.5) - 2 * np.abs(wave - np.float32(0.5)))
    return 2 * _share(inside, grain) - 1


def _disc(sheet: _Samples, middle: Array, diameter: float) -> Floats:
    x, y = sheet.x - np.float32(middle[0]), sheet.y - np.float32(middle[1])
    return _share(np.float32(diameter / 2) - np.hypot(x, y), _round_grain(sheet))


def _round_grain(sheet: _Samples) -> Floats:
    grain: Floats = np.sqrt((sheet.x_grain**2 + sheet.y_grain**2) / np.float32(2))
    return grain


def _dots(target: CircleGrid, sheet: _Samples) -> Floats:
    """Return the black parts of dots; shifted rows are a lattice of their own."""
    pitch, grain = target.spacing, _round_grain(sheet)
    last_x, last_y = target.columns - 1, target.rows - 1
    if target.asymmetric:
        lattices = [(0.0, last_y // 2), (pitch / 2, (last_y - 1) // 2)]
    else:
        lattices = [(0.0, last_y)]
    black = np.zeros_like(sheet.x)
    for start, last in lattices:
        x = sheet.x - np.float32(start)
        y = sheet.y - np.float32(start)
        x -= np.float32(pitch) * np.clip(np.rint(x / np.float32(pitch)), 0, last_x)
        y -= np.float32(pitch) * np.clip(np.rint(y / np.float32(pitch)), 0, last)
        inside = np.float32(target.diameter / 2) - np.hypot(x, y)
        black = np.maximum(black, _share(inside, grain))
    if target.origin_diameter is not None:
        black = np.maximum(black, _disc(sheet, np.zeros(2), target.origin_diameter))
    return black


def _charuco(target: Charuco, sheet: _Samples) -> Floats:
    """Return black squares where OpenCV's board has no markers, and its markers."""
    board = charuco_board(target)
    dictionary, outline = board.getDictionary(), _outline(target)
    modules = dictionary.markerSize + 2
    middles = np.array([np.mean(points, axis=0)[:2] for points in board.getObjPoints()])
    columns, rows = np.floor(middles / target.square).astype(np.intp).T
    rows = target.rows - 1 - rows  # OpenCV counts from the upper left
    black = _squares(sheet, outline, target.square)
    if (columns[0] + rows[0]) % 2 == 0:
        black = _rectangle(sheet, outline) - black
    x = (sheet.x - np.float32(outline[0, 0])) / np.float32(target.square)
    y = (sheet.y - np.float32(outline[0, 1])) / np.float32(target.square)
    column, row = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    numbers = np.full((target.rows, target.columns), -1)
    numbers[rows, columns] = np.asarray(board.getIds()).ravel()
    inside = (column >= 0) & (column < target.columns) & (row >= 0) & (row < target.rows)
    cells = np.nonzero(inside)
    number = numbers[row[cells], column[cells]]
    part = target.marker / target.square / modules
    across = np.floor((x[cells] - column[cells] - 0.5) / part + modules / 2).astype(np.intp)
    down = np.floor(modules / 2 - (y[cells] - row[cells] - 0.5) / part).astype(np.intp)
    marked = (number >= 0) & (across >= 0) & (across < modules) & (down >= 0) & (down < modules)
    patterns = np.zeros((number.max() + 1, modules, modules), dtype=np.bool_)
    for marker in np.unique(number[marked]):
        patterns[marker] = dictionary.generateImageMarker(int(marker), modules) == 0
    dark = np.zeros(len(number), dtype=np.bool_)
    dark[marked] = patterns[number[marked], down[marked], across[marked]]
    black[cells] = np.maximum(black[cells], dark)
    return black


def _marker_grid(target: MarkerGrid, sheet: _Samples) -> Floats:
    """Return markers, and for Kalibr's grids the squares between their corners."""
    pitch, side, gap = (
        np.float32(length) for length in (target.marker + target.gap, target.marker, target.gap)
    )
    places, parts, markers, between = [], [], [], []
    for at, grain, count in (
        (sheet.x, sheet.x_grain, target.columns),
        (sheet.y, sheet.y_grain, target.rows),
    ):
        place = np.floor((at + gap / 2) / pitch)
        part = at - place * pitch
        inside = (place >= 0) & (place < count)
        places.append(place.clip(0, count - 1).astype(np.intp))
        parts.append(part / side)
        markers.append(inside * _share(np.minimum(part, side - part), grain))
        # the nearer gap: before or after the marker
        distance = np.where(part < side / 2, part + gap, part - side)
        is_inside = (at > -1.5 * gap) & (at < count * pitch + gap / 2)
        between.append(is_inside * _share(np.minimum(distance, gap - distance), grain))
    (column, row), (across, up) = places, parts
    numbers = column + target.columns * (row if target.kalibr else target.rows - 1 - row)
    patterns = marker_patterns(target)
    modules = patterns.shape[1]
    x, y = ((modules * part).astype(np.intp).clip(0, modules - 1) for part in (across, up))
    white = ~patterns[numbers, modules - 1 - y, x]
    inner = np.minimum(np.minimum(across, 1 - across), np.minimum(up, 1 - up)) > 0.5 / modules
    black: Floats = (markers[0] * markers[1] * ~(white & inner)).astype(np.float32)
    if target.kalibr:
        black = np.maximum(black, (between[0] * between[1]).astype(np.float32))
    return black
