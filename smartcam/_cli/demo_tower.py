"""``smartcam demo --tower``: a robot builds a tower of the black blocks that its camera finds.

The robot only knows how a block looks: it finds a block by its colour, and the place and height of
the tower by the depth. In between, a person adds a block to the tower, and later removes one. The
measured poses are compared with the true ones, which a real cell does not know.
"""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._cli.demo import Steps
from smartcam._cli.texts import table_text
from smartcam.depth import ColourRange, SpatialFilter, TemporalFilter, find_regions, region_depth
from smartcam.depth._inside import AXES, BLOCK, FOCAL, random_table, to_robot
from smartcam.exceptions import FrameFormatError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam._cli.options import Options
    from smartcam.depth._inside import ColourRegion, TableSight, TowerTable, WoodenBlock

LAYERS: Final = 5
"""Number of blocks that the robot puts onto the tower."""

PERSON: Final = {2: "add", 4: "remove"}
"""A person's actions on the tower, by the number of blocks that the robot has put on it before."""

OVERVIEW: Final = (0.38, 0.0, 0.75)
"""Place from which the camera sees the whole table, metres."""

MEASURING_HEIGHT: Final = 0.25
"""Metres above the table at which the camera measures a block's pose."""

TOWER_VIEW_HEIGHT: Final = 0.45
"""Metres above the table at which the camera measures the tower."""

DEPTH_MAP_COUNT: Final = 5
"""Number of depth maps that are averaged."""

MIN_DEPTH_STEP: Final = BLOCK[2] / 2
"""Smallest step of the depth that is not noise, metres: half the height of a block."""

REACH_RANGE: Final = (0.15, 0.50)
"""Least and greatest distance from the robot's foot at which it can grip, metres."""

BLACK: Final = ColourRange(value=(0, 60))
"""The colour of the blocks that the robot has to take."""

AREA_RANGE: Final = (0.6, 1.7)
"""Least and largest area of a block in the picture, relative to the area of its upper side: other
sides may be visible, too."""

SIDE_RATIO_RANGE: Final = (2.2, 3.8)
"""Least and largest ratio of a block's longer side to its shorter side, in the picture."""

MIN_FULLNESS: Final = 0.8
"""Least share of the rectangle around a block that the block fills."""

RIM_WIDTH_PX: Final = 2
"""Width of a region's rim, pixels; a depth there is a mean of two surfaces."""

TOLERANCE: Final = (2e-3, math.radians(1.0), 1e-3)
"""Largest errors of a found block: metres in the plane, radians, and metres of height."""

MISSED_EXIT_CODE: Final = 7
"""Exit code after an error above the tolerance."""

CAMERA_NAME: Final = "camera at the hand"
"""Name of the camera in error texts."""


class BlockPose(NamedTuple):
    """The pose of a block in the robot's frame: metres and radians."""

    x: float
    y: float
    angle: float  # direction of the block's length, from x towards y
    height: float  # height of the block's upper side
    sigma: float = 0.0  # standard deviation of the height, from the depth


class Compared(NamedTuple):
    """The errors of a found pose: metres and radians."""

    what: str
    found: BlockPose
    offset: float
    turned: float
    higher: float

    @property
    def errors(self) -> tuple[float, float, float]:
        """Magnitude of each error, in the order of :data:`TOLERANCE`."""
        return self.offset, abs(self.turned), abs(self.higher)


async def tower(
    options: Options,
    seed: int,
    *,
    table: TowerTable | None = None,
    colours: ColourRange = BLACK,
    layers: int = LAYERS,
) -> None:
    """Build the tower, and report how accurate the measured poses were.

    Args:
        options: the options of the command.
        seed: seed of all places and all noise.
        table: another table; None: one from the seed.
        colours: colours of the blocks.
        layers: number of blocks to put onto the tower.

    Raises:
        FrameFormatError: no block, or no tower, is visible.
        MissingExtraError: the extra ``depth`` is not installed.
        SystemExit: an error was larger than :data:`TOLERANCE`.
    """
    steps = Steps(options)
    table = random_table(seed, layers) if table is None else table
    steps.step(
        "A camera at a robot's hand, a table with wooden and black blocks on it, and a tower of "
        f"two. The robot is to put {layers} black ones on top:",
        layers=layers,
        seed=seed,
    )
    comparisons: list[Compared] = []
    for layer in range(1, layers + 1):
        measurements = await asyncio.to_thread(_measure, table, colours)
        comparisons += _put_block(table, measurements, layer, steps)
        action = PERSON.get(layer)
        if action is not None:
            getattr(table, action)()
            text = {"add": "puts a wooden block on top", "remove": "takes the highest block away"}
            steps.step(f"A person {text[action]}. The robot is not told.", person=action)
    _report_errors(comparisons, table, steps)


class Measurements(NamedTuple):
    """The measurements that the robot makes before it moves a block."""

    blocks: list[BlockPose]  # blocks that lie on the table
    within_reach: list[BlockPose]  # blocks within reach of the gripper
    block: BlockPose  # block to take
    top: BlockPose  # block on top of the tower


def _measure(table: TowerTable, colours: ColourRange) -> Measurements:
    """Measure the blocks on the table, the nearest block within reach, and the tower.

    Raises:
        FrameFormatError: there is no such block, or no tower.
    """
    overview = table.look(OVERVIEW)
    depth = SpatialFilter(delta=MIN_DEPTH_STEP)(overview.depth[0])
    blocks = find_loose_blocks(overview, depth, colours)
    low, high = REACH_RANGE
    within_reach = [block for block in blocks if low <= math.hypot(block.x, block.y) <= high]
    if not within_reach:
        raise FrameFormatError(
            f"{CAMERA_NAME}: expected a block within {low:g} to {high:g} m of the "
            f"robot, got {len(blocks)} that are not: nothing to pick",
            source=CAMERA_NAME,
        )
    nearest = min(within_reach, key=lambda block: math.hypot(block.x, block.y))
    block = measure_block(table, nearest, colours)
    return Measurements(
        blocks, within_reach, block, measure_top(table, *find_tower(overview, depth))
    )


def _put_block(
    table: TowerTable, measurements: Measurements, layer: int, steps: Steps
) -> list[Compared]:
    """Move the block onto the tower; return the errors of the two measured poses.

    Raises:
        FrameFormatError: the gripper missed the block.
    """
    block, top = measurements.block, measurements.top
    true_top = table.tower()[-1]
    grip = table.pick(block.x, block.y, block.angle)
    rows = [
        Compared("block", block, grip.off, grip.turned, 0.0),
        _compare("tower's top", top, true_top),
    ]
    steps.step(
        f"Layer {layer}: {len(measurements.blocks)} black blocks lie on the table, "
        f"{len(measurements.within_reach)} within reach. The nearest, and the tower's top:",
        layer=layer,
        seen=len(measurements.blocks),
        within_reach=len(measurements.within_reach),
    )
    values = [row._asdict() | {"found": row.found._asdict()} for row in rows]
    steps.detail(_text(rows), compared=values)
    if table.held is None:
        raise FrameFormatError(
            f"{CAMERA_NAME}: the gripper closed {1e3 * grip.off:.1f} mm off the block, on nothing",
            source=CAMERA_NAME,
        )
    placed_block = table.place(top.x, top.y, top.angle + math.pi / 2)
    steps.detail(
        f"   picked, and put down crosswise at a height of {1e3 * top.height:.1f} mm; the tower is "
        f"now {1e3 * placed_block.top:.1f} mm high",
        height=placed_block.top,
    )
    return rows


# ---------------------------------------------------------------------- findings


def find_loose_blocks(
    sight: TableSight, depth: NDArray[np.float32], colours: ColourRange
) -> list[BlockPose]:
    """Return the blocks of a colour that lie on the table and not on the tower.

    Raises:
        FrameFormatError: there is no block of the colour; the error describes the largest region.
    """
    blocks: list[BlockPose] = []
    for region in _find_block_regions(sight, colours):
        height = sight.camera[2] - region_depth(depth, region.mask).median
        if abs(height - BLOCK[2]) < MIN_DEPTH_STEP:  # the block is not on the tower
            blocks.append(_block_pose(sight, region, height))
    if not blocks:
        raise _nothing_found_error(sight, colours)
    return blocks


def measure_block(table: TowerTable, rough: BlockPose, colours: ColourRange) -> BlockPose:
    """Move the camera above a block, where its sides are hardly visible, and return its pose.

    Raises:
        FrameFormatError: the block is not there.
    """
    sight = table.look((rough.x, rough.y, MEASURING_HEIGHT), maps=0)
    poses = [_block_pose(sight, region, BLOCK[2]) for region in _find_block_regions(sight, colours)]
    if not poses:
        raise _nothing_found_error(sight, colours)
    block = min(poses, key=lambda pose: math.dist(pose[:2], rough[:2]))
    offset = math.dist(block[:2], rough[:2])
    if offset > BLOCK[1] / 2:
        raise FrameFormatError(
            f"{CAMERA_NAME}: expected the block that was seen from above, got one "
            f"{1e3 * offset:.0f} mm away from it: something has moved",
            source=CAMERA_NAME,
        )
    return block


def find_tower(sight: TableSight, depth: NDArray[np.float32]) -> tuple[float, float]:
    """Return the place of the tower, x and y in metres: the largest region above one block.

    Raises:
        FrameFormatError: nothing is higher than one block.
    """
    region = _find_high_regions(sight, depth)[0]
    height = sight.camera[2] - region_depth(depth, region.mask).median
    return to_robot(sight.camera, *region.centre, height)


def measure_top(table: TowerTable, x: float, y: float) -> BlockPose:
    """Move the camera above the tower and return the pose of its topmost block.

    Raises:
        FrameFormatError: the tower is not there, or its top is no block.
    """
    sight = table.look((x, y, TOWER_VIEW_HEIGHT), DEPTH_MAP_COUNT)
    average, smooth = TemporalFilter(delta=MIN_DEPTH_STEP), SpatialFilter(delta=MIN_DEPTH_STEP)
    depth = smooth([average(each) for each in sight.depth][-1])
    middle = (sight.rgb.shape[1] / 2, sight.rgb.shape[0] / 2)
    regions = _find_high_regions(sight, depth)
    tower_region = min(regions, key=lambda region: math.dist(region.centre, middle))
    # the top block is more than a fifth of the region
    top_depth = np.percentile(depth[tower_region.mask], 20)
    top_mask = tower_region.mask & (np.abs(depth - top_depth) < MIN_DEPTH_STEP)
    top = find_regions(top_mask)[0]
    if not SIDE_RATIO_RANGE[0] <= top.ratio <= SIDE_RATIO_RANGE[1] or top.fullness < MIN_FULLNESS:
        raise FrameFormatError(
            f"{CAMERA_NAME}: expected a block on top of the tower, got {_region_text(top)}",
            source=CAMERA_NAME,
        )
    measured = region_depth(
        depth, _without_rim(top.mask), correlated_pixels=smooth.correlated_pixels
    )
    return _block_pose(sight, top, sight.camera[2] - measured.median)._replace(sigma=measured.sigma)


def _find_block_regions(sight: TableSight, colours: ColourRange) -> list[ColourRegion]:
    """Return the regions whose colour, area and sides are those of a block."""
    return find_regions(
        colours.mask(sight.rgb),
        area=_area_limits(sight),
        ratio=SIDE_RATIO_RANGE,
        fullness=MIN_FULLNESS,
        whole=True,
    )


def _area_limits(sight: TableSight) -> tuple[float, float]:
    """Return the least and largest area of a block on the table, pixels."""
    scale = FOCAL / (sight.camera[2] - BLOCK[2])
    min_area, max_area = (part * BLOCK[0] * BLOCK[1] * scale**2 for part in AREA_RANGE)
    return min_area, max_area


def _find_high_regions(sight: TableSight, depth: NDArray[np.float32]) -> list[ColourRegion]:
    """Return the regions that are higher than one block, the largest first."""
    mask = (depth > 0) & (sight.camera[2] - depth > BLOCK[2] + MIN_DEPTH_STEP)
    regions = find_regions(mask, area=(_area_limits(sight)[0], math.inf))
    if not regions:
        raise FrameFormatError(
            f"{CAMERA_NAME}: expected a tower, got nothing that is higher than a block of "
            f"{1e3 * BLOCK[2]:g} mm",
            source=CAMERA_NAME,
        )
    return regions


def _without_rim(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask of a region without its rim; it must not touch the border of the picture."""
    inner = mask.copy()
    for axis in (0, 1):
        for step in (-RIM_WIDTH_PX, RIM_WIDTH_PX):
            inner &= np.roll(mask, step, axis)
    return inner


def _block_pose(sight: TableSight, region: ColourRegion, height: float) -> BlockPose:
    x, y = to_robot(sight.camera, *region.centre, height)
    direction = AXES @ (math.cos(region.orientation), math.sin(region.orientation), 0.0)
    return BlockPose(x, y, math.remainder(math.atan2(direction[1], direction[0]), math.pi), height)


def _nothing_found_error(sight: TableSight, colours: ColourRange) -> FrameFormatError:
    """Return an error that describes the regions of a colour, none of which is a block."""
    min_area, max_area = _area_limits(sight)
    regions = find_regions(colours.mask(sight.rgb), area=(min_area / 10, math.inf))
    found = "none of it"
    if regions:
        found = f"{len(regions)} regions of it, the largest {_region_text(regions[0])}"
    return FrameFormatError(
        f"{CAMERA_NAME}: expected a block on the table of the colour {colours.as_json()}, "
        f"{min_area:.0f} to {max_area:.0f} pixels with sides of {SIDE_RATIO_RANGE[0]:g}:1 to "
        f"{SIDE_RATIO_RANGE[1]:g}:1, got {found}",
        source=CAMERA_NAME,
    )


def _region_text(region: ColourRegion) -> str:
    return f"{region.area} pixels with sides of {region.ratio:.1f}:1"


# ---------------------------------------------------------------------- comparison


def _compare(label: str, measured: BlockPose, true: WoodenBlock) -> Compared:
    offset = math.hypot(measured.x - true.x, measured.y - true.y)
    turned = math.remainder(measured.angle - true.angle, math.pi)
    return Compared(label, measured, offset, turned, measured.height - true.top)


def _text(rows: list[Compared]) -> str:
    head = ("mm, degrees", *(title.rjust(8) for title in ("x", "y", "angle", "height")))
    titles = [title.rjust(8) for title in ("offset", "turned", "higher", "sigma")]
    cells: list[tuple[Any, ...]] = []
    for label, block, offset, turned, higher in rows:
        values = (1e3 * block.x, 1e3 * block.y, math.degrees(block.angle), 1e3 * block.height)
        errors = (1e3 * offset, math.degrees(turned), 1e3 * higher, 1e3 * block.sigma)
        measured_errors = (
            errors if block.sigma else errors[:2]
        )  # otherwise its height was not measured
        texts = [f"{value:8.2f}" for value in (*values, *measured_errors)]
        cells.append((label, *texts, *[""] * (8 - len(texts))))
    return table_text((*head, *titles), cells)


def _report_errors(comparisons: list[Compared], table: TowerTable, steps: Steps) -> None:
    """Print the largest errors; raise SystemExit if one of them is above its tolerance."""
    offset, turned, higher = (
        max(row.errors[index] for row in comparisons) for index in range(len(TOLERANCE))
    )
    within = all(
        error <= tolerance
        for row in comparisons
        for error, tolerance in zip(row.errors, TOLERANCE, strict=True)
    )
    tolerances = f"{1e3 * TOLERANCE[0]:g} mm, {math.degrees(TOLERANCE[1]):g} degree"
    stack = table.tower()
    steps.step(
        f"The tower has {len(stack)} layers, {1e3 * stack[-1].top:.1f} mm. At worst "
        f"{1e3 * offset:.2f} mm off, {math.degrees(turned):.2f} degrees turned, "
        f"{1e3 * higher:.2f} mm of height: {'all' if within else 'not all'} within {tolerances}, "
        f"{1e3 * TOLERANCE[2]:g} mm",
        within=within,
        offset=offset,
        turned=turned,
        height=higher,
    )
    if not within:
        raise SystemExit(MISSED_EXIT_CODE)
