"""A drawn table for ``smartcam demo --pick --plain``: a plain camera above it, a robot beside it.

Parts lie on the table at true poses that only the comparison uses. The camera's pictures are
drawn from them: each pixel is the mean of the blurred parts, with noise.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import time
from typing import TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.emulator import TablePose, TableScene
from smartcam.emulator._inside import TABLE_SIZE
from smartcam.exceptions import ConfigurationError
from smartcam.frames import Frame, Moment, StreamFormat, find_format
from smartcam.frames._inside import TaskDriver
from smartcam.geometry import Transform
from smartcam.registry import FRAMES

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.frames import FrameAddress, FrameSink
    from smartcam.geometry import PlacePattern

    Array = NDArray[np.float64]

SCHEME: Final = "drawn"
"""Scheme of the source's address."""

SIZE_PX: Final = (1280, 1024)
"""Width and height of a picture."""

FRAMES_PER_SECOND: Final = 8.0
"""Pictures a second while there is a reader."""

DARK, CONTRAST, NOISE = 60.0, 130.0, 2.0
"""Grey level of the table; by how much parts are brighter; standard deviation of the noise."""

BLUR_PX: Final = 0.8
"""Standard deviation of the lens' blur."""

SAMPLES: Final = 8
"""Samples along each side of a pixel."""

TOUCH_SIGMA: Final = 2e-4
"""Standard deviation of a touch along each of the robot's axes, metres."""

MAX_GRIP_ERROR: Final = 2e-3
"""Largest distance from a part at which the gripper can take it, metres."""

HEIGHT: Final = 0.008
"""Thickness of a part, metres."""

PITCH: Final = (0.040, 0.035)
"""Distances of the true pallet's columns and rows, metres."""

MIN_GAP: Final = 0.004
"""Metres between the circles around two parts, and around a part and the table's edge."""


class PaintedShape(NamedTuple):
    """A polygon of a part."""

    level: float  # 0 to 1: from the table's grey level to the part's
    corners: Array  # (K, 2), metres in the part's own frame


def _disc(level: float, x: float, y: float, radius: float) -> PaintedShape:
    angles = np.linspace(0.0, math.tau, 120, endpoint=False)
    return PaintedShape(
        level, np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])
    )


def _polygon(level: float, *corners: tuple[float, float]) -> PaintedShape:
    return PaintedShape(level, np.array(corners))


PART_SHAPES: Final[dict[str, tuple[PaintedShape, ...]]] = {
    "mark": (_disc(1.0, 0, 0, 0.009), _disc(0.0, 0, 0, 0.004)),
    "bracket": (
        _polygon(
            1.0,
            *((-0.015, -0.010), (0.010, -0.010), (0.010, -0.001)),
            *((0.0, 0.001), (0.0, 0.010), (-0.015, 0.010)),
        ),
        _disc(0.0, -0.0095, 0.0045, 0.003),
        _disc(0.0, 0.005, -0.0055, 0.0018),
    ),
}
"""The shapes of each kind of part."""


def radius_of(kind: str) -> float:
    """Return the distance of the farthest edge of a part from its own frame's origin, metres."""
    return max(float(np.linalg.norm(shape.corners, axis=1).max()) for shape in PART_SHAPES[kind])


class TablePart(NamedTuple):
    """A part on the table."""

    kind: str
    pose: TablePose


class DrawnTable:
    """Parts on a table, and the camera above it, as a source of frames.

    Args:
        seed: seed of the noise.

    Attributes:
        parts: parts on the table; a change is seen in the next picture.
        address: address of the camera's frames.
    """

    _numbers: ClassVar[itertools.count[int]] = itertools.count(1)

    def __init__(self, seed: int) -> None:
        self.parts: list[TablePart] = []
        self.address: str = f"{SCHEME}://table{next(self._numbers)}"
        self._camera = TableScene(y_down=True, offset=(45.0, 1010.0))
        self._random = np.random.default_rng(seed)
        self._last_drawn: tuple[list[TablePart], NDArray[np.float32]] | None = None

    @property
    def pixel(self) -> float:
        """Side of a pixel on the table, metres."""
        return 1.0 / self._camera.scale

    def to_pixels(self, pose: TablePose) -> tuple[float, float, float]:
        """Return a pose in the picture: x, y (pixels), angle from x towards y (radians)."""
        return self._camera.to_pixels(pose)

    def lay_parts(self, kind: str, count: int) -> None:
        """Replace the parts on the table by ``count`` parts at random poses that do not touch."""
        margin = radius_of(kind) + MIN_GAP
        low, high = np.array([margin, margin]), np.array(TABLE_SIZE) - margin
        places: list[Array] = []
        for place in self._random.uniform(low, high, (2000, 2)):
            if all(np.linalg.norm(place - other) > 2 * margin for other in places):
                places.append(place)
                if len(places) == count:
                    break
        else:
            raise ConfigurationError(f"demo: the table has no room for {count} parts")
        angles = self._random.uniform(-math.pi, math.pi, count)
        self.parts = [
            TablePart(kind, TablePose(float(x), float(y), float(angle)))
            for (x, y), angle in zip(places, angles, strict=True)
        ]

    def take_picture(self) -> NDArray[np.uint8]:
        """Return a picture of the table as it is now, (H, W), with new noise."""
        parts = list(self.parts)
        if self._last_drawn is None or self._last_drawn[0] != parts:
            self._last_drawn = parts, self._draw_levels(parts)
        levels = self._last_drawn[1]
        noise = self._random.standard_normal(levels.shape, np.float32)
        return np.clip(np.rint(levels + NOISE * noise), 0, 255).astype(np.uint8)

    def _draw_levels(self, parts: list[TablePart]) -> NDArray[np.float32]:
        """Return the grey levels of the parts without noise."""
        canvas = np.full(SIZE_PX[::-1], DARK, np.float32)
        for part in parts:
            corner, coverage = self._draw_part(part)
            low = np.maximum(corner, 0)
            high = np.minimum(corner + coverage.shape[::-1], SIZE_PX)
            visible = coverage[low[1] - corner[1] : high[1] - corner[1], low[0] - corner[0] :]
            canvas[low[1] : high[1], low[0] : high[0]] += CONTRAST * visible[:, : high[0] - low[0]]
        return canvas

    def _draw_part(self, part: TablePart) -> tuple[NDArray[np.int_], NDArray[np.float32]]:
        """Return a patch with a drawn part: its first pixel, and the part's brightness, 0 to 1."""
        cv2 = load("cv2", "inspection needs")
        u, v, _ = self.to_pixels(part.pose)
        half_side = math.ceil(radius_of(part.kind) / self.pixel + 5 * BLUR_PX + 1)
        corner = np.array([math.floor(u) - half_side, math.floor(v) - half_side])
        side = 2 * half_side + 2
        fine = np.zeros((side * SAMPLES, side * SAMPLES), np.uint8)
        for shape in PART_SHAPES[part.kind]:
            pixels = (self._part_to_pixels(part.pose, shape.corners) - corner + 0.5) * SAMPLES - 0.5
            level = round(255 * shape.level)
            cv2.fillPoly(fine, [np.rint(16 * pixels).astype(np.int32)], level, cv2.LINE_8, 4)
        smooth = cv2.GaussianBlur(fine.astype(np.float32), (0, 0), BLUR_PX * SAMPLES)
        coverage = cv2.resize(smooth, (side, side), interpolation=cv2.INTER_AREA) / 255
        return corner, np.asarray(coverage, np.float32)

    def _part_to_pixels(self, pose: TablePose, points: Array) -> Array:
        """Return the pixels (N, 2) of points in the frame of a part."""
        cos, sin = math.cos(pose.theta), math.sin(pose.theta)
        placed = points @ [[cos, sin], [-sin, cos]] + (pose.x, pose.y)
        return np.array([self.to_pixels(TablePose(x, y, 0.0))[:2] for x, y in placed])

    def reference_pose(self, taught_part: TablePart, reference: tuple[float, float]) -> TablePose:
        """Return the pose of a model's reference in its part's own frame.

        ``taught_part``: the part in the picture from which the model was taught; ``reference``: the
        model's reference in this picture, pixels. A real cell does not know this true pose.
        """
        origin = self._pixel_to_table(*reference)
        next_pixel = self._pixel_to_table(reference[0] + 1.0, reference[1])
        part = taught_part.pose
        angle = math.atan2(next_pixel[1] - origin[1], next_pixel[0] - origin[0]) - part.theta
        cos, sin = math.cos(part.theta), math.sin(part.theta)
        x, y = origin[0] - part.x, origin[1] - part.y
        return TablePose(cos * x + sin * y, cos * y - sin * x, angle)

    def _pixel_to_table(self, u: float, v: float) -> tuple[float, float]:
        """Return the point of the table that a pixel shows, metres."""
        origin, x_end = self.to_pixels(TablePose(0, 0, 0)), self.to_pixels(TablePose(1, 0, 0))
        x_axis = complex(x_end[0] - origin[0], -(x_end[1] - origin[1]))
        point = complex(u - origin[0], -(v - origin[1])) / x_axis
        return point.real, point.imag


class TableDriver(TaskDriver):
    """The pictures of a :class:`DrawnTable`, by its address."""

    sets_captured = True
    tables: ClassVar[dict[str, DrawnTable]] = {}

    def __init__(self, address: FrameAddress) -> None:
        super().__init__(address)
        if address.url not in self.tables:
            raise ConfigurationError(f"frame source {address.url!r}: there is no such table")
        self._table = self.tables[address.url]
        self._number = 0

    async def open(self) -> StreamFormat:
        """Return the format, size and rate of the pictures."""
        return StreamFormat(find_format("Mono8"), *SIZE_PX, (FRAMES_PER_SECOND,))

    async def deliver(self, sink: FrameSink) -> None:
        """Draw pictures of the table."""
        while True:
            captured, utc = time.monotonic(), time.time()
            picture = await asyncio.to_thread(self._table.take_picture)
            self._number += 1
            sink.frame(
                Frame(
                    data=picture.tobytes(),
                    format=find_format("Mono8"),
                    width=SIZE_PX[0],
                    height=SIZE_PX[1],
                    stride=SIZE_PX[0],
                    captured=captured,
                    utc=utc,
                    moment=Moment.EXPOSURE_START,
                    sequence=self._number,
                    source=self.name,
                )
            )
            await asyncio.sleep(max(0.0, captured + 1 / FRAMES_PER_SECOND - time.monotonic()))


FRAMES.register(SCHEME, TableDriver)


class Placed(NamedTuple):
    """The outcome of picking a part and putting it onto the pallet."""

    x: float  # place that the robot went to, metres in the robot's frame: x
    y: float  # y
    error: float  # distance from there to the part, metres
    heading_error: float  # error of the gripper's heading, radians
    taken: bool  # whether the gripper was near enough
    off_place: float  # distance of the part from its place on the pallet, metres; NaN: none there


class TableRobot:
    """A robot beside a level table at an unknown place, with a pallet.

    Args:
        table: the table.
        seed: seed of the places of table and pallet, and of the noise of the touches.
    """

    def __init__(self, table: DrawnTable, seed: int) -> None:
        self._table = table
        self._random = np.random.default_rng([seed, 1])
        self._table_pose = self._random_level_pose("table", 0.0)
        self._pallet_pose = self._random_level_pose("pallet", 0.8)

    def _random_level_pose(self, name: str, distance: float) -> Transform:
        """Return a random pose with z upwards, about ``distance`` metres along the robot's x."""
        x, y, z, angle = self._random.uniform(
            [distance - 0.2, -0.4, 0, -3], [distance + 0.2, 0.4, 0.3, 3]
        )
        cos, sin = math.cos(angle), math.sin(angle)
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        return Transform("robot", name, rotation, np.array([x, y, z]))

    def touch_table(self, pose: TablePose) -> list[float]:
        """Return the robot's reading when its tip touches a place on the table, metres."""
        return self._add_touch_noise(self._table_pose.apply([pose.x, pose.y, 0.0]))

    def touch_pallet(self, column: int, row: int) -> list[float]:
        """Return the robot's reading when its tip touches a place of the pallet, metres."""
        return self._add_touch_noise(
            self._pallet_pose.apply([column * PITCH[0], row * PITCH[1], 0.0])
        )

    def _add_touch_noise(self, true_point: Array) -> list[float]:
        reading: list[float] = (true_point + self._random.normal(0.0, TOUCH_SIGMA, 3)).tolist()
        return reading

    def palletize(
        self,
        pose: tuple[float, float, float],
        reference: TablePose,
        pattern: PlacePattern,
        number: int,
    ) -> Placed:
        """Pick the part that is nearest to a found pose, and put it onto a place of the pallet.

        ``pose``: x and y (metres) and heading of the part's reference in the robot's frame;
        ``reference``: the true pose of the reference in the part's frame.
        """
        offset, part = min(
            ((self._reference_error(part, pose, reference), part) for part in self._table.parts),
            key=lambda pair: abs(pair[0][0]),
        )
        error, heading_error = abs(offset[0]), offset[1]
        if error > MAX_GRIP_ERROR:
            return Placed(pose[0], pose[1], error, heading_error, False, math.nan)
        self._table.parts.remove(part)
        row, column, layer = pattern.row_column_layer(number)
        true_place = self._pallet_pose.apply([column * PITCH[0], row * PITCH[1], layer * HEIGHT])
        # the part does not move in the gripper, so its offset turns with the gripper
        place = pattern[number]
        part_offset = place.rotation[:2, :2] @ _rotate([offset[0].real, offset[0].imag], -pose[2])
        off_place = float(np.linalg.norm(place.translation[:2] + part_offset - true_place[:2]))
        return Placed(pose[0], pose[1], error, heading_error, True, off_place)

    def _reference_error(
        self, part: TablePart, found_pose: tuple[float, float, float], reference: TablePose
    ) -> tuple[complex, float]:
        """Return the offset of a part's true reference from the found pose, and its rotation."""
        pose = part.pose
        x, y = _rotate([reference.x, reference.y], pose.theta).tolist()
        true_point = self._table_pose.apply([pose.x + x, pose.y + y, 0.0])
        heading = pose.theta + reference.theta + math.atan2(*self._table_pose.rotation[1::-1, 0])
        offset = complex(true_point[0] - found_pose[0], true_point[1] - found_pose[1])
        return offset, math.remainder(found_pose[2] - heading, math.tau)


def _rotate(vector: Any, angle: float) -> Array:
    cos, sin = math.cos(angle), math.sin(angle)
    rotated: Array = np.array([[cos, -sin], [sin, cos]]) @ np.asarray(vector)
    return rotated
