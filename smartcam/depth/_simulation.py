"""Simulate a table with wooden blocks, some of them black, and a camera at a robot's hand.

The robot's frame: z up, the table is z = 0. The camera looks straight down. Its pictures are drawn
ray by ray; depth has the noise, holes and mixed pixels of stereo matching.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

BLOCK: Final = (0.075, 0.025, 0.015)
"""Length, width and height of a block, metres."""

SIZE: Final = (640, 480)
"""Width and height of the camera's pictures, pixels."""

FOCAL: Final = 600.0
"""Focal length, pixels."""

BASELINE: Final = 0.05
"""Metres between the two cameras that see depth."""

DISPARITY_SIGMA: Final = 0.1
"""Noise of a disparity, pixels: the noise of a depth is ``Z^2 / (FOCAL * BASELINE)`` times as
much."""

CAMERA_SIGMA: Final = 2e-4
"""Standard deviation of the camera's place at the hand, metres on each axis."""

GRIP_TOLERANCE_METRES: Final = 5e-3
"""Largest distance from a block at which the gripper still grasps it, metres."""

MIN_GAP_METRES: Final = 0.01
"""Least distance between objects on the table, metres, which leaves room for the gripper."""

GREY_SIGMA: Final = 3.0
"""Standard deviation of a picture's grey levels."""

HOLE_SHARES: Final = (0.01, 0.4)
"""Shares of pixels without a depth: among all pixels, and among pixels at jumps of the depth."""

MIN_JUMP_METRES: Final = 0.004
"""Least difference in depth of neighbouring pixels that counts as a jump, metres."""

RAYS_PER_SIDE: Final = 2
"""Number of rays along each side of a pixel."""

AXES: Final = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Rotation from the camera's frame into the robot's: its columns are right, down, ahead."""

COLOURS: Final = {
    "wood": (196.0, 150.0, 96.0),
    "black": (24.0, 23.0, 25.0),
    "table": (158.0, 168.0, 172.0),
}
"""Reflectance of each surface as red, green and blue."""

SHADES: Final = (0.72, 0.84, 1.0)
"""Brightness of the sides along the width, along the length, and of the top."""


@dataclass(slots=True)
class WoodenBlock:
    """A box that lies flat; lengths in metres in the robot's frame, angles in radians."""

    x: float
    y: float
    angle: float  # direction of the block's length, from x towards y
    z: float = 0.0  # height of the block's lower side
    colour: str = "wood"
    size: tuple[float, float, float] = BLOCK

    @property
    def top(self) -> float:
        """Height of the upper side, metres."""
        return self.z + self.size[2]


class TableSight(NamedTuple):
    """A picture and depth maps from one place of the camera."""

    camera: tuple[float, float, float]  # place of the camera, metres
    rgb: NDArray[np.uint8]  # (H, W, 3)
    depth: list[NDArray[np.uint16]]  # (H, W) each, millimetres


def to_robot(
    camera: tuple[float, float, float], x: float, y: float, height: float
) -> tuple[float, float]:
    """Return the point of a pixel's ray at a height, x and y in metres in the robot's frame."""
    ahead = camera[2] - height
    ray = ((x - SIZE[0] / 2) / FOCAL * ahead, (y - SIZE[1] / 2) / FOCAL * ahead, ahead)
    place = AXES @ ray + camera
    return float(place[0]), float(place[1])


class PoseError(NamedTuple):
    """Errors of a grasp or of an estimated pose."""

    off: float  # distance from the true place, metres
    turned: float  # difference from the true angle, radians


class TowerTable:
    """The table, the blocks on it, and a robot with a gripper.

    Args:
        seed: seed of all noise, and of the error of the camera's place.

    Attributes:
        blocks: true blocks on the table, which a building program must not read.
        random: generator of all noise.
        held: block in the gripper; None if it is empty.
    """

    def __init__(self, seed: int) -> None:
        self.random: np.random.Generator = np.random.default_rng(seed)
        self.blocks: list[WoodenBlock] = []
        self.held: WoodenBlock | None = None
        self._camera_error = self.random.normal(0, CAMERA_SIGMA, 3)

    def look(self, camera: tuple[float, float, float], maps: int = 1) -> TableSight:
        """Return a picture and ``maps`` depth maps; the camera's place, metres, is not exact."""
        true_place = np.add(camera, self._camera_error)
        rays = _TableRays((float(true_place[0]), float(true_place[1]), float(true_place[2])))
        for block in self.blocks:
            rays.draw(block)
        levels = rays.picture()
        levels += GREY_SIGMA * self.random.standard_normal(levels.shape, np.float32)
        rgb = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
        return TableSight(camera, rgb, self._make_depth_maps(rays.depth, maps) if maps else [])

    def tower(self) -> list[WoodenBlock]:
        """Return the blocks of the highest stack, the lowest first."""
        top = max(self.blocks, key=lambda block: block.top)
        stack = [block for block in self.blocks if _distance(block, top) < BLOCK[0] / 2]
        return sorted(stack, key=lambda block: block.z)

    def pick(self, x: float, y: float, angle: float) -> PoseError:
        """Close the gripper at a pose on the table, and grasp a block within its tolerance.

        Returns the errors from the nearest black block; ``held`` is None if it is missed.
        """
        gripper = WoodenBlock(x, y, angle)
        loose = [block for block in self.blocks if block.z == 0 and block.colour == "black"]
        block = min(loose, key=lambda block: _distance(block, gripper))
        grip = PoseError(_distance(block, gripper), math.remainder(angle - block.angle, math.pi))
        if grip.off < GRIP_TOLERANCE_METRES and block.size == BLOCK:
            self.blocks.remove(block)
            c, s = math.cos(angle), math.sin(angle)
            x, y = block.x - x, block.y - y
            self.held = WoodenBlock(c * x + s * y, c * y - s * x, -grip.turned, colour="black")
        return grip

    def place(self, x: float, y: float, angle: float) -> WoodenBlock:
        """Put the held block onto the tower, and return it as it lies there."""
        held, self.held = self.held, None
        if held is None:
            raise ValueError("the gripper is empty")
        c, s = math.cos(angle), math.sin(angle)
        held.x, held.y = x + c * held.x - s * held.y, y + s * held.x + c * held.y
        held.angle += angle
        held.z = self.tower()[-1].top
        self.blocks.append(held)
        return held

    def add(self) -> None:
        """Add a wooden block to the tower as a person would: across, and not quite straight."""
        top = self.tower()[-1]
        dx, dy = self.random.uniform(-0.004, 0.004, 2)
        angle = top.angle + math.pi / 2 + self.random.uniform(-0.15, 0.15)
        self.blocks.append(WoodenBlock(top.x + dx, top.y + dy, angle, z=top.top))

    def remove(self) -> None:
        """Remove the highest block as a person would."""
        self.blocks.remove(self.tower()[-1])

    def _make_depth_maps(self, rays: NDArray[np.float32], maps: int) -> list[NDArray[np.uint16]]:
        """Return depth maps as of two cameras: mixed at edges, noisy, with holes."""
        depth = _pixel_means(rays)
        middle = rays[RAYS_PER_SIDE // 2 :: RAYS_PER_SIDE, RAYS_PER_SIDE // 2 :: RAYS_PER_SIDE]
        at_jump = _find_jumps(middle)
        is_hidden = _find_hidden(middle)
        measured: list[NDArray[np.uint16]] = []
        for _ in range(maps):
            sigma = depth**2 / (FOCAL * BASELINE) * DISPARITY_SIGMA
            noisy = depth + sigma * self.random.standard_normal(depth.shape, np.float32)
            chance = self.random.random(depth.shape, np.float32)
            is_hole = is_hidden | (chance < HOLE_SHARES[0]) | (at_jump & (chance < HOLE_SHARES[1]))
            measured.append(np.where(is_hole, 0, np.rint(1e3 * noisy)).astype(np.uint16))
        return measured


def _distance(first: WoodenBlock, other: WoodenBlock) -> float:
    return math.hypot(first.x - other.x, first.y - other.y)


def _pixel_means(rays: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean of the rays of each pixel."""
    places = [(row, column) for row in range(RAYS_PER_SIDE) for column in range(RAYS_PER_SIDE)]
    total = rays[::RAYS_PER_SIDE, ::RAYS_PER_SIDE].copy()
    for row, column in places[1:]:
        total += rays[row::RAYS_PER_SIDE, column::RAYS_PER_SIDE]
    total /= len(places)
    return total


def _find_jumps(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the mask of the pixels next to a jump of the depth."""
    jumps = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis)) > MIN_JUMP_METRES
        first, second = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        jumps[first] |= step
        jumps[second] |= step
    return jumps


def _find_hidden(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the mask of the pixels that the second camera, to the right, does not see."""
    column_in_right = np.arange(depth.shape[1]) - FOCAL * BASELINE / depth
    nearer = np.minimum.accumulate(column_in_right[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(depth.shape, bool)
    hidden[:, :-1] = column_in_right[:, :-1] >= nearer[:, 1:]
    return hidden


class _TableRays:
    """The rays of a camera, with the depth and colour at the end of each ray."""

    def __init__(self, camera: tuple[float, float, float]) -> None:
        width, height = (RAYS_PER_SIDE * count for count in SIZE)
        columns = ((np.arange(width) + 0.5) / RAYS_PER_SIDE - 0.5 - SIZE[0] / 2) / FOCAL
        rows = ((np.arange(height) + 0.5) / RAYS_PER_SIDE - 0.5 - SIZE[1] / 2) / FOCAL
        self._camera = camera
        self._across: NDArray[np.float32] = columns.astype(np.float32)
        self._down: NDArray[np.float32] = rows.astype(np.float32)[:, None]
        self.depth: NDArray[np.float32] = np.full((height, width), camera[2], np.float32)
        self.colour: NDArray[np.float32] = np.empty((height, width, 3), np.float32)
        self.colour[:] = COLOURS["table"]

    def picture(self) -> NDArray[np.float32]:
        """Return the shaded picture, (H, W, 3)."""
        levels = _pixel_means(self.colour)
        x, y, z = self._camera
        light = 1.0 + 0.5 * (x - 0.4 - self._down[::RAYS_PER_SIDE] * z)
        levels *= (light - 0.7 * (y - self._across[::RAYS_PER_SIDE] * z))[..., None]
        return levels

    def draw(self, block: WoodenBlock) -> None:
        """Draw a block where it is nearer than the scene so far, by the slab method."""
        box = self._bounding_box(block)
        across, down = self._across[box[1]], self._down[box[0]]
        shape = np.broadcast_shapes(across.shape, down.shape)
        if 0 in shape:
            return
        c, s = np.float32(math.cos(block.angle)), np.float32(math.sin(block.angle))
        to_camera = np.subtract(self._camera, (block.x, block.y, block.z))
        # AXES: right is -y of the robot, down is -x, ahead is -z
        origin = (
            c * to_camera[0] + s * to_camera[1],
            c * to_camera[1] - s * to_camera[0],
            to_camera[2] - block.size[2] / 2,
        )
        directions = (
            -c * down - s * across,
            s * down - c * across,
            np.full((1, 1), -1.0, np.float32),
        )
        nearest, farthest = np.zeros(shape, np.float32), np.full(shape, np.inf, np.float32)
        side = np.zeros(shape, np.int8)
        for axis, (start, direction, size) in enumerate(
            zip(origin, directions, block.size, strict=True)
        ):
            direction = np.where(np.abs(direction) < 1e-9, np.float32(1e-9), direction)
            first_face, other = ((sign * size / 2 - start) / direction for sign in (-1, 1))
            enters = np.minimum(first_face, other).astype(np.float32)
            side[np.broadcast_to(enters, shape) > nearest] = axis
            nearest = np.maximum(nearest, enters)
            farthest = np.minimum(farthest, np.maximum(first_face, other).astype(np.float32))
        is_hit = (nearest < farthest) & (nearest < self.depth[box])
        self.depth[box][is_hit] = nearest[is_hit]
        along = origin[0] + nearest * directions[0]
        grain = 1 + 0.06 * np.sin(900 * (origin[1] + nearest * directions[1]) + 20 * along)
        shade = np.take(np.asarray(SHADES, np.float32), side) * grain
        self.colour[box][is_hit] = shade[is_hit][:, None] * np.asarray(
            COLOURS[block.colour], np.float32
        )

    def _bounding_box(self, block: WoodenBlock) -> tuple[slice, slice]:
        """Return the rows and columns that the block covers."""
        reach = math.hypot(*block.size[:2]) / 2
        off_x, off_y = block.x - self._camera[0], block.y - self._camera[1]
        lows: list[int] = []
        highs: list[int] = []
        for middle, picture_side in ((-off_x, SIZE[1]), (-off_y, SIZE[0])):
            ends = [
                FOCAL * (middle + sign * reach) / (self._camera[2] - z) + picture_side / 2
                for sign in (-1, 1)
                for z in (block.z, block.top)
            ]
            lows.append(max(0, RAYS_PER_SIDE * (math.floor(min(ends)) - 1)))
            highs.append(max(0, RAYS_PER_SIDE * (math.ceil(max(ends)) + 2)))
        return slice(lows[0], highs[0]), slice(lows[1], highs[1])


# ---------------------------------------------------------------------- a table at the start


def random_table(seed: int, supply: int = 5) -> TowerTable:
    """Return a table with a tower of two wooden blocks and other objects around it.

    ``supply``: number of black blocks within reach of a robot at (0, 0). One more is out of reach,
    two black objects are no blocks, and three blocks are wooden.
    """
    table = TowerTable(seed)
    random = table.random
    x, y = 0.30 + random.uniform(-0.02, 0.02), 0.2 + random.uniform(-0.02, 0.02)
    angle = random.uniform(-math.pi / 2, math.pi / 2)
    table.blocks.append(WoodenBlock(x, y, angle))
    table.blocks.append(WoodenBlock(x, y, angle + math.pi / 2, z=BLOCK[2]))
    table.blocks.append(WoodenBlock(0.56, -0.17, random.uniform(-1.5, 1.5), colour="black"))
    others = [("black", (0.04, 0.04, 0.01)), ("black", (0.13, 0.01, 0.004))]
    objects = [*others, *[("black", BLOCK)] * supply, *[("wood", BLOCK)] * 3]
    for colour, size in objects:
        table.blocks.append(_random_object(table, colour, size))
    return table


def _random_object(table: TowerTable, colour: str, size: tuple[float, float, float]) -> WoodenBlock:
    """Return an object at a random place with room for a gripper, within the robot's reach.

    A high tower must not hide the place from a camera above the middle.
    """
    tower = table.blocks[0]
    for _ in range(100_000):
        x, y = table.random.uniform(0.17, 0.46), table.random.uniform(-0.26, 0.26)
        gap = min(
            math.hypot(x - block.x, y - block.y)
            - math.hypot(*size[:2]) / 2
            - math.hypot(*block.size[:2]) / 2
            for block in table.blocks
        )
        tower_distance = math.hypot(x - tower.x, y - tower.y)
        if gap > MIN_GAP_METRES and tower_distance > 0.13 and 0.2 < math.hypot(x, y) < 0.47:
            angle = table.random.uniform(-math.pi / 2, math.pi / 2)
            return WoodenBlock(x, y, angle, colour=colour, size=size)
    raise ValueError("the table is full")
