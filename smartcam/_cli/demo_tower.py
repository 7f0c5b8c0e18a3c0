"""``smartcam demo --tower``: a robot builds a tower of the black blocks that its camera finds.

The robot only knows the looks of a block: it finds the place of a block by its colour, and the
place and height of the tower by the depth. A person adds a block meanwhile, and removes one. The
findings are compared with the truth, which a real cell does not know.
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
"""The disturbances of the tower by a person, by the number of blocks put on before."""

OVERVIEW: Final = (0.38, 0.0, 0.75)
"""Place from which the camera sees the whole table, metres."""

MEASURING_HEIGHT: Final = 0.25
"""Metres above the table at which the camera measures a block's pose."""

ABOVE: Final = 0.45
"""Metres above the table at which the camera measures the tower."""

MAPS: Final = 5
"""Number of depth maps that are averaged."""

EDGE: Final = BLOCK[2] / 2
"""Metres below which a step of the depth is noise, since no block is so thin."""

REACH: Final = (0.15, 0.50)
"""Least and greatest distance from the robot's foot at which it can grip, metres."""

BLACK: Final = ColourRange(value=(0, 60))
"""The colour of the blocks that the robot has to take."""

AREA: Final = (0.6, 1.7)
"""Area of a block in the picture, in areas of its upper side: other sides may be visible, too."""

SIDE_RATIO: Final = (2.2, 3.8)
"""Longer side of a block in the picture over the shorter one, from least to most."""

MIN_FULLNESS: Final = 0.8
"""Least share of its rectangle that a block fills."""

RIM: Final = 2
"""Width of a region's rim, in pixels; depths there are mixed from two surfaces."""

TOLERANCE: Final = (2e-3, math.radians(1.0), 1e-3)
"""Largest errors of a found block: metres in the plane, radians, and metres of height."""

MISSED: Final = 7
"""Exit code after an error above the tolerance."""

ARM: Final = "camera at the hand"
"""Name of the camera in error texts."""


class BlockPose(NamedTuple):
    """The pose of a block in the robot's frame: metres and radians."""

    x: float
    y: float
    angle: float  # direction of the block's length, from x towards y
    height: float  # height of the block's upper side
    sigma: float = 0.0  # standard deviation of the height, from the depth


class Compared(NamedTuple):
    """A finding beside the truth: metres and radians."""

    what: str
    found: BlockPose
    beside: float
    turned: float
    higher: float

    @property
    def errors(self) -> tuple[float, float, float]:
        """Magnitude of each error, in the order of :data:`TOLERANCE`."""
        return self.beside, abs(self.turned), abs(self.higher)


async def tower(
    options: Options,
    seed: int,
    *,
    table: TowerTable | None = None,
    colours: ColourRange = BLACK,
    layers: int = LAYERS,
) -> None:
    """Build the tower, and report how accurate the findings were.

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
    compared: list[Compared] = []
    for layer in range(1, layers + 1):
        seen = await asyncio.to_thread(_look, table, colours)
        compared += _put_one(table, seen, layer, steps)
        doing = PERSON.get(layer)
        if doing is not None:
            getattr(table, doing)()
            did = {"add": "puts a wooden block on top", "remove": "takes the highest block away"}
            steps.step(f"A person {did[doing]}. The robot is not told.", person=doing)
    _judge(compared, table, steps)


class Seen(NamedTuple):
    """The measurements that the robot makes before it moves a block."""

    blocks: list[BlockPose]  # blocks that lie on the table
    reached: list[BlockPose]  # blocks within reach of the gripper
    block: BlockPose  # block to take
    top: BlockPose  # block on top of the tower


def _look(table: TowerTable, colours: ColourRange) -> Seen:
    """Measure the blocks on the table, the nearest block within reach, and the tower.

    Raises:
        FrameFormatError: there is no such block, or no tower.
    """
    overview = table.look(OVERVIEW)
    depth = SpatialFilter(delta=EDGE)(overview.depth[0])
    blocks = loose_blocks(overview, depth, colours)
    reached = [block for block in blocks if REACH[0] <= math.hypot(block.x, block.y) <= REACH[1]]
    if not reached:
        raise FrameFormatError(
            f"{ARM}: expected a block within {REACH[0]:g} to {REACH[1]:g} m of the robot, got "
            f"{len(blocks)} that are not: nothing to pick",
            source=ARM,
        )
    rough = min(reached, key=lambda block: math.hypot(block.x, block.y))
    block = measured_block(table, rough, colours)
    return Seen(blocks, reached, block, measured_top(table, *tower_place(overview, depth)))


def _put_one(table: TowerTable, seen: Seen, layer: int, steps: Steps) -> list[Compared]:
    """Put the block on top; return the findings beside the truth.

    Raises:
        FrameFormatError: the gripper missed the block.
    """
    block, top = seen.block, seen.top
    true_top = table.tower()[-1]
    grip = table.pick(block.x, block.y, block.angle)
    rows = [
        Compared("block", block, grip.off, grip.turned, 0.0),
        _compared("tower's top", top, true_top),
    ]
    steps.step(
        f"Layer {layer}: {len(seen.blocks)} black blocks lie on the table, {len(seen.reached)} "
        "within reach. The nearest of these, and the tower's top:",
        layer=layer,
        seen=len(seen.blocks),
        reached=len(seen.reached),
    )
    values = [row._asdict() | {"found": row.found._asdict()} for row in rows]
    steps.detail(_text(rows), compared=values)
    if table.held is None:
        raise FrameFormatError(
            f"{ARM}: the gripper closed {1e3 * grip.off:.1f} mm beside the block, on nothing",
            source=ARM,
        )
    lies = table.place(top.x, top.y, top.angle + math.pi / 2)
    steps.detail(
        f"   picked, and put down across at {1e3 * top.height:.1f} mm; the tower is now "
        f"{1e3 * lies.top:.1f} mm high",
        height=lies.top,
    )
    return rows


# ---------------------------------------------------------------------- findings


def loose_blocks(
    sight: TableSight, depth: NDArray[np.float32], colours: ColourRange
) -> list[BlockPose]:
    """Return the blocks of a colour that lie on the table, as seen from far above.

    Raises:
        FrameFormatError: there is no block of the colour; the error describes the largest region.
    """
    lying: list[BlockPose] = []
    for region in _regions(sight, colours):
        height = sight.camera[2] - region_depth(depth, region.mask).median
        if abs(height - BLOCK[2]) < EDGE:  # the block is not on the tower
            lying.append(_pose(sight, region, height))
    if not lying:
        raise _nothing_found_error(sight, colours)
    return lying


def measured_block(table: TowerTable, rough: BlockPose, colours: ColourRange) -> BlockPose:
    """Go above a block and return its pose; from there its sides are hardly visible.

    Raises:
        FrameFormatError: the block is not there.
    """
    sight = table.look((rough.x, rough.y, MEASURING_HEIGHT), maps=0)
    poses = [_pose(sight, region, BLOCK[2]) for region in _regions(sight, colours)]
    if not poses:
        raise _nothing_found_error(sight, colours)
    block = min(poses, key=lambda pose: math.dist(pose[:2], rough[:2]))
    beside = math.dist(block[:2], rough[:2])
    if beside > BLOCK[1] / 2:
        raise FrameFormatError(
            f"{ARM}: expected the block that was seen from above, got one {1e3 * beside:.0f} mm "
            "beside it: something has moved",
            source=ARM,
        )
    return block


def tower_place(sight: TableSight, depth: NDArray[np.float32]) -> tuple[float, float]:
    """Return the place of a region higher than one block, x and y in metres.

    Raises:
        FrameFormatError: no place is higher.
    """
    region = _high(sight, depth)[0]
    height = sight.camera[2] - region_depth(depth, region.mask).median
    return to_robot(sight.camera, *region.centre, height)


def measured_top(table: TowerTable, x: float, y: float) -> BlockPose:
    """Go above the tower and return the pose and the height of its top.

    Raises:
        FrameFormatError: the tower is not there, or its top is no block.
    """
    sight = table.look((x, y, ABOVE), MAPS)
    average, smooth = TemporalFilter(delta=EDGE), SpatialFilter(delta=EDGE)
    depth = smooth([average(each) for each in sight.depth][-1])
    middle = (sight.rgb.shape[1] / 2, sight.rgb.shape[0] / 2)
    high = min(_high(sight, depth), key=lambda region: math.dist(region.centre, middle))
    level = np.percentile(depth[high.mask], 20)  # the top is more than a fifth of the region
    upper = high.mask & (np.abs(depth - level) < EDGE)
    top = find_regions(upper)[0]
    if not SIDE_RATIO[0] <= top.ratio <= SIDE_RATIO[1] or top.fullness < MIN_FULLNESS:
        raise FrameFormatError(
            f"{ARM}: expected a block on top of the tower, got {_shape(top)}", source=ARM
        )
    measured = region_depth(depth, _inner(top.mask), shared=smooth.shared)
    return _pose(sight, top, sight.camera[2] - measured.median)._replace(sigma=measured.sigma)


def _regions(sight: TableSight, colours: ColourRange) -> list[ColourRegion]:
    """Return the regions that may be blocks by their colour, area and sides."""
    return find_regions(
        colours.mask(sight.rgb),
        area=_area(sight),
        ratio=SIDE_RATIO,
        fullness=MIN_FULLNESS,
        whole=True,
    )


def _area(sight: TableSight) -> tuple[float, float]:
    """Return the least and largest area of a block on the table, pixels."""
    scale = FOCAL / (sight.camera[2] - BLOCK[2])
    least, most = (part * BLOCK[0] * BLOCK[1] * scale**2 for part in AREA)
    return least, most


def _high(sight: TableSight, depth: NDArray[np.float32]) -> list[ColourRegion]:
    """Return the regions that are higher than one block, the largest first."""
    mask = (depth > 0) & (sight.camera[2] - depth > BLOCK[2] + EDGE)
    regions = find_regions(mask, area=(_area(sight)[0], math.inf))
    if not regions:
        raise FrameFormatError(
            f"{ARM}: expected a tower, got nothing that is higher than a block of "
            f"{1e3 * BLOCK[2]:g} mm",
            source=ARM,
        )
    return regions


def _inner(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask without its rim."""
    inner = mask.copy()
    for axis in (0, 1):
        for step in (-RIM, RIM):
            inner &= np.roll(mask, step, axis)  # a whole region does not touch the rim
    return inner


def _pose(sight: TableSight, region: ColourRegion, height: float) -> BlockPose:
    x, y = to_robot(sight.camera, *region.centre, height)
    direction = AXES @ (math.cos(region.orientation), math.sin(region.orientation), 0.0)
    return BlockPose(x, y, math.remainder(math.atan2(direction[1], direction[0]), math.pi), height)


def _nothing_found_error(sight: TableSight, colours: ColourRange) -> FrameFormatError:
    """Return an error that describes the regions of a colour, none of which is a block."""
    least, most = _area(sight)
    regions = find_regions(colours.mask(sight.rgb), area=(least / 10, math.inf))
    got = "none of it"
    if regions:
        got = f"{len(regions)} regions of it, the largest {_shape(regions[0])}"
    return FrameFormatError(
        f"{ARM}: expected a block on the table of the colour {colours.as_json()}, {least:.0f} to "
        f"{most:.0f} pixels with sides of {SIDE_RATIO[0]:g}:1 to {SIDE_RATIO[1]:g}:1, got {got}",
        source=ARM,
    )


def _shape(region: ColourRegion) -> str:
    return f"{region.area} pixels with sides of {region.ratio:.1f}:1"


# ---------------------------------------------------------------------- comparison


def _compared(label: str, measured: BlockPose, true: WoodenBlock) -> Compared:
    beside = math.hypot(measured.x - true.x, measured.y - true.y)
    turned = math.remainder(measured.angle - true.angle, math.pi)
    return Compared(label, measured, beside, turned, measured.height - true.top)


def _text(rows: list[Compared]) -> str:
    head = ("mm, degrees", *(title.rjust(8) for title in ("x", "y", "angle", "height")))
    titles = [title.rjust(8) for title in ("beside", "turned", "higher", "sigma")]
    cells: list[tuple[Any, ...]] = []
    for label, block, beside, turned, higher in rows:
        places = (1e3 * block.x, 1e3 * block.y, math.degrees(block.angle), 1e3 * block.height)
        errors = (1e3 * beside, math.degrees(turned), 1e3 * higher, 1e3 * block.sigma)
        known = errors if block.sigma else errors[:2]  # otherwise its height was not measured
        shown = [f"{value:8.2f}" for value in (*places, *known)]
        cells.append((label, *shown, *[""] * (8 - len(shown))))
    return table_text((*head, *titles), cells)


def _judge(compared: list[Compared], table: TowerTable, steps: Steps) -> None:
    """Print the largest errors; raise SystemExit if one of them is above its tolerance."""
    beside, turned, higher = (
        max(row.errors[place] for row in compared) for place in range(len(TOLERANCE))
    )
    within = all(
        error <= most for row in compared for error, most in zip(row.errors, TOLERANCE, strict=True)
    )
    most = f"{1e3 * TOLERANCE[0]:g} mm, {math.degrees(TOLERANCE[1]):g} degree"
    stack = table.tower()
    steps.step(
        f"The tower has {len(stack)} layers, {1e3 * stack[-1].top:.1f} mm. At worst "
        f"{1e3 * beside:.2f} mm beside, {math.degrees(turned):.2f} degrees turned, "
        f"{1e3 * higher:.2f} mm of height: {'all' if within else 'not all'} within {most}, "
        f"{1e3 * TOLERANCE[2]:g} mm",
        within=within,
        beside=beside,
        turned=turned,
        height=higher,
    )
    if not within:
        raise SystemExit(MISSED)
