"""Draw targets and cameras in space, as seen from a corner of the room.

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
"""Margins beside, above and below the scene, pixels."""

AZIMUTH, ELEVATION = math.radians(-38.0), math.radians(24.0)
"""Direction of the viewer: angle about the vertical, and angle above the ground."""

FRUSTUM_RATIO: Final = 0.16
"""Length of a camera's frustum, as a fraction of the scene's extent; with many cameras it is
shorter."""

AXIS_RATIO: Final = 0.12
"""Length of the axes of a frame, as a fraction of the scene's extent."""

LETTER_PX: Final = (7.5, 15.0)
"""Approximate width and height of a letter, pixels."""

LABEL_OFFSET_PX: Final = np.array([0.0, 14.0])
"""Offset of a label from its object, pixels."""

LABEL_TRIAL_OFFSETS_PX: Final = [(0.0, 0.0)] + [
    (reach * math.cos(angle), 0.7 * reach * math.sin(angle))
    for reach in (18, 30, 44, 60, 80, 105)
    for angle in np.linspace(0.0, math.tau, 12, endpoint=False).tolist()
]
"""Offsets of a label that are tried, pixels; the first free place is used."""


class DrawnBoard(NamedTuple):
    """A target in the scene."""

    name: str
    corners: Array  # (4, 3), metres
    is_left_out: bool = False  # True if it was left out of the calibration


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
    """The objects of one drawing, in a common frame."""

    boards: Sequence[DrawnBoard]
    cameras: Sequence[DrawnCamera]
    axes: Sequence[Axes] = ()
    # direction of "up" in the scene's frame: that of the camera's image, or a robot's z
    up: tuple[float, float, float] = (0.0, -1.0, 0.0)


class _DrawnObject(NamedTuple):
    depth: float
    svg: str
    label: str
    label_place: Array  # (2,), pixels


class _ViewerProjection:
    """The projection from points of a scene to pixels of the drawing."""

    def __init__(self, scene: DrawnScene, points: Array) -> None:
        # make the scene upright (z up), turn it about the vertical, and tilt it towards the viewer
        up = np.array(scene.up)
        forward = np.array([0.0, 0.0, 1.0]) if abs(up[2]) < 0.5 else np.array([0.0, 1.0, 0.0])
        side = np.cross(forward, up)
        upright = np.array([side, forward, up])
        turn, rise = (
            (math.cos(AZIMUTH), math.sin(AZIMUTH)),
            (math.cos(ELEVATION), math.sin(ELEVATION)),
        )
        about_vertical = np.array(
            [[turn[0], -turn[1], 0.0], [turn[1], turn[0], 0.0], [0.0, 0.0, 1.0]]
        )
        tilt = np.array([[1.0, 0.0, 0.0], [0.0, rise[0], -rise[1]], [0.0, rise[1], rise[0]]])
        self.axes: Array = tilt @ about_vertical @ upright  # axes of the viewer: right, away, up
        viewer_points = points @ self.axes.T
        low, high = viewer_points.min(axis=0), viewer_points.max(axis=0)
        span = np.maximum(high - low, 1e-9)
        self.zoom = float(min(WIDTH / span[0], HEIGHT / span[2]))
        self.centre: Array = (low + high) / 2

    def pixels(self, points: Array) -> Array:
        """Project points (..., 3) to pixels (..., 2)."""
        viewer_points = points @ self.axes.T - self.centre
        image_centre = np.array([BORDER + WIDTH / 2, HEAD + HEIGHT / 2])
        projected: Array = image_centre + viewer_points[..., [0, 2]] * [self.zoom, -self.zoom]
        return projected

    def depth(self, points: Array) -> float:
        """Return the mean depth of points along the line of sight."""
        return float((points @ self.axes[1]).mean())


def draw_scene(scene: DrawnScene, title: str) -> str:
    """Draw a scene: cameras in orange, boards in blue, dashed if they were left out."""
    points = np.concatenate(
        [
            *(board.corners for board in scene.boards),
            *(np.atleast_2d(camera.pose.translation) for camera in scene.cameras),
            *(np.atleast_2d(axes.pose.translation) for axes in scene.axes),
        ]
    )
    extent = float(np.ptp(points, axis=0).max()) or 1.0
    length = extent * FRUSTUM_RATIO / (1.0 if len(scene.cameras) < 4 else 2.0)
    frustums = [_frustum(camera, length) for camera in scene.cameras]
    axis_tips = [axes.pose.apply(AXIS_RATIO * extent * np.eye(3)) for axes in scene.axes]
    projection = _ViewerProjection(scene, np.concatenate([points, *frustums, *axis_tips]))
    objects = [
        _DrawnObject(
            projection.depth(board.corners),
            polygon(
                projection.pixels(board.corners),
                "board-off" if board.is_left_out else "board",
                board.name,
            ),
            board.name,
            projection.pixels(board.corners.mean(axis=0)),
        )
        for board in scene.boards
    ]
    objects += [
        _draw_camera(projection, camera, frustum)
        for camera, frustum in zip(scene.cameras, frustums, strict=True)
    ]
    objects.sort(key=lambda object_: -object_.depth)  # draw far objects first
    elements = [text((BORDER, 28), title, "title")] if title else []
    elements += [object_.svg for object_ in objects]
    for axes, tips in zip(scene.axes, axis_tips, strict=True):
        start = projection.pixels(axes.pose.translation)
        for tip, axis in zip(projection.pixels(tips), "xyz", strict=True):
            elements.append(line(start, tip, "axis", ' stroke-width="1.5"'))
            objects.append(_DrawnObject(0.0, "", axis, tip))
        objects.append(_DrawnObject(0.0, "", axes.name, start + LABEL_OFFSET_PX))
    elements += _labels(
        [(object_.label, object_.label_place) for object_ in objects[::-1] if object_.label]
    )
    elements += _scale_bar(projection)
    return document(WIDTH + 2 * BORDER, HEAD + HEIGHT + FOOT, elements)


def _frustum(camera: DrawnCamera, length: float) -> Array:
    """Return a camera's centre, and the corners of its field of view at a depth, (5, 3)."""
    x, y = 0.5, 0.375  # coordinates of a corner at depth 1
    if camera.model is not None:
        x, y = (math.tan(min(view_angle, 2.0) / 2) for view_angle in camera.model.field_of_view)
    corners = [[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]
    return camera.pose.apply(length * np.array([[0.0, 0.0, 0.0], *corners]))


def _draw_camera(
    projection: _ViewerProjection, camera: DrawnCamera, frustum: Array
) -> _DrawnObject:
    centre, *corners = projection.pixels(frustum)
    sides = [line(centre, corner, "camera") for corner in corners]
    svg = "".join([polygon(np.array(corners), "camera", camera.name), *sides])
    return _DrawnObject(projection.depth(frustum), svg, camera.name, centre + LABEL_OFFSET_PX)


def _labels(labels: Sequence[tuple[str, Array]]) -> Iterator[str]:
    """Yield labels that do not cover each other; labels without room are left out."""
    boxes: list[tuple[float, float, float, float]] = []
    low = np.array([BORDER / 2, HEAD - 10])
    high = np.array([BORDER * 1.5 + WIDTH, HEAD + HEIGHT + 10])
    for label, place in labels:
        width, height = LETTER_PX[0] * len(label) + 6.0, LETTER_PX[1]
        for offset in LABEL_TRIAL_OFFSETS_PX:
            x, y = place + offset
            box = (x - width / 2, y - height / 2, x + width / 2, y + height / 2)
            is_outside = box[0] < low[0] or box[1] < low[1] or box[2] > high[0] or box[3] > high[1]
            if not is_outside and not any(_overlap(box, other) for other in boxes):
                boxes.append(box)
                if math.hypot(*offset) > 25:
                    yield line(place, (x, y), "axis", ' stroke-opacity="0.6"')
                yield text((x, y + 5), label, "halo", ' text-anchor="middle"')
                break


def _overlap(first: Sequence[float], second: Sequence[float]) -> bool:
    return (
        first[0] < second[2]
        and second[0] < first[2]
        and first[1] < second[3]
        and second[1] < first[3]
    )


def _scale_bar(projection: _ViewerProjection) -> Iterator[str]:
    metres = round_down(0.2 * WIDTH / projection.zoom)
    start = np.array([BORDER, HEAD + HEIGHT + 30])
    end = start + np.array([metres * projection.zoom, 0.0])
    yield line(start, end, "axis", ' stroke-width="2"')
    yield text((end[0] + 10, end[1] + 5), f"{1e3 * metres:g} mm")
