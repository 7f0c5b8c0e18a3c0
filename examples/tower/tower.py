"""Build a tower of blocks by the pictures of a plain camera at the robot's hand.

A block is looked for by its outline, in sizes from that on the table to that on a high tower. Its
size tells how high it is, so the tower's height is measured without depth. A person puts a block on
top meanwhile, and takes one away. All pictures are drawn, and what was found stands beside the
truth.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from smartcam.inspection import load_cell

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from smartcam.inspection import Program

LENGTH, WIDTH, HEIGHT = 75.0, 25.0, 15.0  # of a block, mm
SIZE, FOCAL = (640, 480), 800.0  # pixels
ABOVE = 450.0  # the camera's height above the table, mm
SAMPLES = 3  # along each side of a pixel
TABLE, WOOD, BLACK = 165, 100, 40  # grey levels

PIXELS_PER_MM = FOCAL / (ABOVE - HEIGHT)  # of a block that lies on the table
OUTLINE = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="75mm" height="25mm" viewBox="0 0 75 25">'
    '<rect width="75" height="25"/></svg>'
)
CELL = f"""
cameras:
  hand:
    software:
      frames: pictures
      applications:
        7:
          name: blocks
          locate:
            outline: block.svg
            pixels_per_mm: {PIXELS_PER_MM}
            bright: false
            scale: [0.98, 1.4]
            region: [220, 140, 200, 200]
            most: 2  # the one below may be seen, too
            least_score: 0.55  # beside a black block on a black one, a quarter has no edge
"""


@dataclass
class Block:
    """A block in the robot's frame: mm and radians, y to the left of x."""

    x: float
    y: float
    angle: float
    top: float = HEIGHT
    level: int = BLACK


def picture(blocks: list[Block], x: float, y: float) -> NDArray[np.uint8]:
    """Return what the camera sees from straight above a place, with blur and noise."""
    at = (np.arange(SAMPLES * max(SIZE)) + 0.5) / SAMPLES - 0.5
    u, v = at[: SAMPLES * SIZE[0]] - SIZE[0] / 2, at[: SAMPLES * SIZE[1], None] - SIZE[1] / 2
    fine = np.full((v.size, u.size), TABLE, np.float32)
    for block in sorted(blocks, key=lambda one: one.top):
        cos, sin = math.cos(block.angle), math.sin(block.angle)
        for height, level in ((block.top - HEIGHT, 0.8 * block.level), (block.top, block.level)):
            scale = FOCAL / (ABOVE - height)
            off_u, off_v = u - scale * (block.x - x), -v - scale * (block.y - y)
            along, across = np.abs(cos * off_u + sin * off_v), np.abs(cos * off_v - sin * off_u)
            inside = np.minimum(scale * LENGTH / 2 - along, scale * WIDTH / 2 - across)
            fine += (SAMPLES * inside + 0.5).clip(0, 1) * (level - fine)
    grey = cv2.GaussianBlur(cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA), (0, 0), 0.8)
    noise = np.random.default_rng(1).normal(0, 2, grey.shape)
    seen: NDArray[np.uint8] = np.clip(grey + noise, 0, 255).astype(np.uint8)
    return seen


def highest(program: Program, blocks: list[Block], x: float, y: float) -> tuple[Block, float]:
    """Return the highest block in a picture from above a place, and the sigma of its height."""
    found = program.inspect(picture(blocks, x, y))
    if not found.ok:
        raise RuntimeError(f"no block: {found.reason}")
    part = max(found.findings["locate"].details.parts, key=lambda one: one.pose.scale)
    pose = part.pose
    far = (ABOVE - HEIGHT) / pose.scale  # from the camera to its upper side
    at = np.subtract(pose[:2], (SIZE[0] / 2, SIZE[1] / 2)) * far / FOCAL
    block = Block(x + at[0], y - at[1], -pose.angle, ABOVE - far)
    return block, far * part.sigmas[3] / pose.scale


def measured(program: Program, blocks: list[Block], x: float, y: float) -> tuple[Block, float]:
    """Return the highest block about a place, seen from straight above it: no side is in sight."""
    rough, _ = highest(program, blocks, x, y)
    return highest(program, blocks, rough.x, rough.y)


def main(folder: Path, seed: int = 1) -> None:
    """Build the tower, and say how well each block was seen."""
    (folder / "block.svg").write_text(OUTLINE)
    (folder / "cell.yaml").write_text(CELL)
    program = load_cell(folder / "cell.yaml")["hand"].program(7)
    random = np.random.default_rng(seed)
    tower = [Block(300, 200, 0.3, level=WOOD)]
    tower.append(Block(301, 199, 0.3 + math.pi / 2, 2 * HEIGHT, WOOD))
    worst = [0.0, 0.0, 0.0]
    for number in range(3):
        # a person laid the block down by eye
        lies = [250, -150 + 110 * number, 0] + random.uniform(-1, 1, 3) * (12, 12, 1.5)
        block = Block(*lies.tolist())
        poses = []
        for what, true, place in (
            ("block", [block], (250, -150 + 110 * number)),
            ("top", tower, (300, 200)),
        ):
            found, sigma = measured(program, true, *place)
            poses.append(found)
            off = (
                math.hypot(found.x - true[-1].x, found.y - true[-1].y),
                abs(math.degrees(math.remainder(found.angle - true[-1].angle, math.pi))),
                abs(found.top - true[-1].top),
            )
            worst = [max(pair) for pair in zip(worst, off, strict=True)]
            print(  # noqa: T201
                f"{what:5} at {found.x:6.2f}, {found.y:7.2f} mm, {found.top:6.2f} mm high, sigma "
                f"{sigma:.2f} mm; beside the truth {off[0]:.3f} mm, {off[1]:.3f} degrees, "
                f"{off[2]:.2f} mm"
            )
        seen, top = poses
        # what lies askew in the gripper lies askew on the tower
        block.x, block.y = top.x + block.x - seen.x, top.y + block.y - seen.y
        block.angle += top.angle + math.pi / 2 - seen.angle
        block.top = tower[-1].top + HEIGHT
        tower.append(block)
        if number == 0:
            tower.append(Block(302, 201, top.angle + 0.1, tower[-1].top + HEIGHT, WOOD))
            print("a person puts a wooden block on top")  # noqa: T201
        elif number == 1:
            tower.pop()
            print("a person takes the highest block away")  # noqa: T201
    print(  # noqa: T201
        f"{len(tower)} layers, {tower[-1].top:.0f} mm; all found within {worst[0]:.2f} mm, "
        f"{worst[1]:.2f} degrees and {worst[2]:.2f} mm of height"
    )


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        main(Path(place))
