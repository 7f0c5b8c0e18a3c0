"""Draw boards and cameras in space, seen from a corner of the room.

The projection is parallel: far objects are as large as near ones, so one scale holds for the whole
picture.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from smartcam.calibration._svg import document, line, polygon, round_down, text

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from smartcam.geometry import CameraModel
    from smartcam.geometry._inside import Array, Rigid

WIDTH, HEIGHT = 900.0, 560.0
"""Largest width and height of a scene, pixels."""

BORDER, HEAD, FOOT = 40.0, 56.0, 50.0
"""Pixels beside, above and below the scene."""

AZIMUTH, ELEVATION = math.radians(-38.0), math.radians(24.0)
"""Direction of the viewer: angle about the vertical, and angle above the ground."""

FRUSTUM: Final = 0.16
"""Length of a camera's frustum, as a part of the scene's extent; with many cameras it is
shorter."""

ARROW: Final = 0.12
"""Length of the axes of a frame, as a part of the scene's extent."""

LETTER_PX: Final = (7.5, 15.0)
"""Approximate width and height of a letter, pixels."""

LABEL_OFFSET_PX: Final = np.array([0.0, 14.0])
"""Offset of a label from its object, pixels."""

LABEL_TRIAL_OFFSETS_PX: Final = [(0.0, 0.0)] + [
    (reach * math.cos(angle), 0.7 * reach * math.sin(angle))
    for reach in (18, 30, 44, 60, 80, 105)
    for angle in np.linspace(0.0, math.tau, 12, endpoint=False).tolist()
]
"""Further offsets of a label, pixels; the first free one is used."""


class DrawnBoard(NamedTuple):
    """A target in the scene."""

    name: str
    corners: Array  # (4, 3), metres
    off: bool = False  # True if it was left out of the calibration


class DrawnCamera(NamedTuple):
    """A camera in the scene."""

    name: str
    pose: Rigid  # transform from the camera's frame into the scene's
    model: CameraModel | None = None


class Axes(NamedTuple):
    """A frame in the scene."""

    name: str
    pose: Rigid


class DrawnScene(NamedTuple):
    """The objects of one drawing, in a frame of the drawing's own."""

    boards: Sequence[DrawnBoard]
    cameras: Sequence[DrawnCamera]
    axes: Sequence[Axes] = ()
    # direction of "up" in the scene's frame: that of the camera's image, or a robot's z
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)


class _Drawn(NamedTuple):
    depth: float
    svg: str
    label: str
    at: Array  # (2,), pixels


class _ViewerProjection:
    """The projection from points of a scene to pixels of the drawing."""

    def __init__(self, scene: DrawnScene, points: Array) -> None:
        # make the scene upright (z up), turn it about the vertical, and tilt it towards the viewer
        up = np.array(scene.up)
        ahead = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.5 else np.array([0.0, 1.0, 0.0])
        side = np.cross(ahead, up)
        upright = np.array([side, ahead, up])
        turn, rise = (
            (math.cos(AZIMUTH), math.sin(AZIMUTH)),
            (math.cos(ELEVATION), math.sin(ELEVATION)),
        )
        around = np.array([[turn[0], -turn[1], 0.0], [turn[1], turn[0], 0.0], [0.0, 0.0, 1.0]])
        tilted = np.array([[1.0, 0.0, 0.0], [0.0, rise[0], -rise[1]], [0.0, rise[1], rise[0]]])
        self.axes: Array = tilted @ around @ upright  # axes of the viewer: right, away, up
        seen = points @ self.axes.T
        low, high = seen.min(axis=0), seen.max(axis=0)
        span = np.maximum(high - low, 1e-9)
        self.zoom = float(min(WIDTH / span[0], HEIGHT / span[2]))
        self.middle: Array = (low + high) / 2

    def pixels(self, points: Array) -> Array:
        """Project points (..., 3) to pixels (..., 2)."""
        seen = points @ self.axes.T - self.middle
        centre = np.array([BORDER + WIDTH / 2, HEAD + HEIGHT / 2])
        places: Array = centre + seen[..., [0, 2]] * [self.zoom, -self.zoom]
        return places

    def depth(self, points: Array) -> float:
        """Return the mean depth of points along the line of sight."""
        return float((points @ self.axes[1]).mean())


def draw_scene(scene: DrawnScene, title: str) -> str:
    """Draw a scene: cameras in orange, boards in blue, dashed if they were left out."""
    places = np.concatenate(
        [
            *(board.corners for board in scene.boards),
            *(np.atleast_2d(camera.pose.translation) for camera in scene.cameras),
            *(np.atleast_2d(axes.pose.translation) for axes in scene.axes),
        ]
    )
    extent = float(np.ptp(places, axis=0).max()) or 1.0
    length = extent * FRUSTUM / (1.0 if len(scene.cameras) < 4 else 2.0)
    shapes = [_frustum(camera, length) for camera in scene.cameras]
    ends = [axes.pose.apply(ARROW * extent * np.eye(3)) for axes in scene.axes]
    sight = _ViewerProjection(scene, np.concatenate([places, *shapes, *ends]))
    items = [
        _Drawn(
            sight.depth(board.corners),
            polygon(sight.pixels(board.corners), "board-off" if board.off else "board", board.name),
            board.name,
            sight.pixels(board.corners.mean(axis=0)),
        )
        for board in scene.boards
    ]
    items += [
        _camera(sight, camera, shape) for camera, shape in zip(scene.cameras, shapes, strict=True)
    ]
    items.sort(key=lambda item: -item.depth)  # draw far objects first
    parts = [text((BORDER, 28), title, "title")] if title else []
    parts += [item.svg for item in items]
    for axes, tips in zip(scene.axes, ends, strict=True):
        start = sight.pixels(axes.pose.translation)
        for tip, axis in zip(sight.pixels(tips), "xyz", strict=True):
            parts.append(line(start, tip, "axis", ' stroke-width="1.5"'))
            items.append(_Drawn(0.0, "", axis, tip))
        items.append(_Drawn(0.0, "", axes.name, start + LABEL_OFFSET_PX))
    parts += _labels([(item.label, item.at) for item in items[::-1] if item.label])
    parts += _scale(sight)
    return document(WIDTH + 2 * BORDER, HEAD + HEIGHT + FOOT, parts)


def _frustum(camera: DrawnCamera, length: float) -> Array:
    """Return a camera's centre, and the corners of its field of view at a depth, (5, 3)."""
    x, y = 0.5, 0.375  # coordinates of a corner at depth 1
    if camera.model is not None:
        x, y = (math.tan(min(view_angle, 2.0) / 2) for view_angle in camera.model.field_of_view)
    rim = [[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]
    return camera.pose.apply(length * np.array([[0.0, 0.0, 0.0], *rim]))


def _camera(sight: _ViewerProjection, camera: DrawnCamera, shape: Array) -> _Drawn:
    centre, *rim = sight.pixels(shape)
    sides = [line(centre, corner, "camera") for corner in rim]
    svg = "".join([polygon(np.array(rim), "camera", camera.name), *sides])
    return _Drawn(sight.depth(shape), svg, camera.name, centre + LABEL_OFFSET_PX)


def _labels(wanted: Sequence[tuple[str, Array]]) -> Iterator[str]:
    """Yield labels that cover no other label; those without room are left out."""
    occupied: list[tuple[float, float, float, float]] = []
    low = np.array([BORDER / 2, HEAD - 10])
    high = np.array([BORDER * 1.5 + WIDTH, HEAD + HEIGHT + 10])
    for label, at in wanted:
        width, height = LETTER_PX[0] * len(label) + 6.0, LETTER_PX[1]
        for offset in LABEL_TRIAL_OFFSETS_PX:
            x, y = at + offset
            box = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
            outside = box[0] < low[0] or box[1] < low[1] or box[2] > high[0] or box[3] > high[1]
            if not outside and not any(_overlap(box, placed) for placed in occupied):
                occupied.append(box)
                if math.hypot(*offset) > 25:
                    yield line(at, (x, y), "axis", ' stroke-opacity="0.6"')
                yield text((x, y + 5), label, "halo", ' text-anchor="middle"')
                break


def _overlap(one: Sequence[float], other: Sequence[float]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def _scale(sight: _ViewerProjection) -> Iterator[str]:
    metres = round_down(0.2 * WIDTH / sight.zoom)
    start = np.array([BORDER, HEAD + HEIGHT + 30])
    end = start + np.array([metres * sight.zoom, 0.0])
    yield line(start, end, "axis", ' stroke-width="2"')
    yield text((end[0] + 10, end[1] + 5), f"{1e3 * metres:g} mm")
