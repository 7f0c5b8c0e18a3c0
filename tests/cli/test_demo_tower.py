"""``smartcam demo --tower``: blocks are found by colour, the tower by depth, or not."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from smartcam._cli import demo_tower
from smartcam._cli.demo_tower import MISSED_EXIT_CODE, BlockPose, measure_block, tower
from smartcam.depth import ColourRange
from smartcam.depth._inside import BLOCK, TowerTable, WoodenBlock, random_table, to_robot
from smartcam.exceptions import FrameFormatError
from tests.cli.commandline import run
from tests.cli.inside import Options

pytest.importorskip("cv2", reason="needs the extra depth")

Lines = list[dict[str, Any]]


def lines(capsys: pytest.CaptureFixture[str]) -> Lines:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


async def built(capsys: pytest.CaptureFixture[str], seed: int, **other: Any) -> Lines:
    """Run the demo with JSON and return its lines."""
    await tower(Options(as_json=True), seed, **other)
    return lines(capsys)


async def test_block_is_found_picked_and_put_on_top(capsys: pytest.CaptureFixture[str]) -> None:
    table = random_table(3, 2)
    told = await built(capsys, 3, table=table, layers=1)
    (rows,) = (line["compared"] for line in told if "compared" in line)
    assert [row["what"] for row in rows] == ["block", "tower's top"]
    assert all(row["offset"] < 2e-3 and abs(row["turned"]) < math.radians(1) for row in rows)
    assert abs(rows[1]["higher"]) < 1e-3
    assert 0 < rows[1]["found"]["sigma"] < 1e-3
    layer = next(line for line in told if "layer" in line)
    assert (layer["seen"], layer["within_reach"]) == (3, 2)
    # and the truth: three blocks lie on each other, the highest is a black one, across
    stack = table.tower()
    assert [one.colour for one in stack] == ["wood", "wood", "black"]
    assert [one.z for one in stack] == pytest.approx([0, 0.015, 0.03])
    assert math.hypot(stack[2].x - stack[1].x, stack[2].y - stack[1].y) < 3e-3
    across = math.remainder(stack[2].angle - stack[1].angle - math.pi / 2, math.pi)
    assert abs(across) < math.radians(2)
    assert told[-1]["within"]


async def test_too_coarse_is_reported_and_the_exit_code_shows_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo_tower, "TOLERANCE", (1e-9, 1.0, 1e-3))
    with pytest.raises(SystemExit) as ended:
        await tower(Options(), 1, layers=1)
    assert ended.value.code == MISSED_EXIT_CODE
    assert "not all within" in capsys.readouterr().out


async def test_wrong_colour_finds_no_block_and_says_what_there_is(
    capsys: pytest.CaptureFixture[str],
) -> None:
    green = ColourRange(hue=(50, 70), saturation=(150, 255), value=(50, 255))
    with pytest.raises(FrameFormatError, match=r"expected a block on the table .*got none of it"):
        await tower(Options(as_json=True), 1, colours=green)
    everything = ColourRange(value=(70, 255))  # the table, too
    with pytest.raises(FrameFormatError, match=r"got \d+ regions of it, the largest \d{6} pixels"):
        await tower(Options(as_json=True), 1, colours=everything)
    assert [line for line in lines(capsys) if "compared" in line] == []


async def test_missing_block_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    table = random_table(2, 1)
    table.blocks = [one for one in table.blocks if one.colour != "black" or one.size != BLOCK]
    with pytest.raises(FrameFormatError, match=r"got [12] regions of it") as caught:
        await tower(Options(as_json=True), 2, table=table)  # a square and a stick are black, too
    assert caught.value.source == demo_tower.CAMERA_NAME
    too_far = random_table(2, 0)
    with pytest.raises(FrameFormatError, match=r"within 0.15 to 0.5 m .* got 1 that are not"):
        await tower(Options(as_json=True), 2, table=too_far)
    assert [line for line in lines(capsys) if "compared" in line] == []


async def test_missing_tower_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    table = random_table(2, 1)
    table.remove()
    with pytest.raises(FrameFormatError, match="expected a tower, got nothing that is higher"):
        await tower(Options(as_json=True), 2, table=table)


def test_block_that_moved_between_two_looks_is_not_picked_elsewhere() -> None:
    table = TowerTable(1)
    table.blocks.append(WoodenBlock(0.33, 0.0, 0.3, colour="black"))
    rough = BlockPose(0.30, 0.0, 0.3, BLOCK[2])
    with pytest.raises(FrameFormatError, match=r"one 30 mm away from it: something has moved"):
        measure_block(table, rough, demo_tower.BLACK)
    table.blocks.clear()
    with pytest.raises(FrameFormatError, match="got none of it"):
        measure_block(table, rough, demo_tower.BLACK)


def test_gripper_that_closes_beside_a_block_is_empty() -> None:
    table = TowerTable(1)
    table.blocks.append(WoodenBlock(0.3, 0.0, 0.3, colour="black"))
    grip = table.pick(0.306, 0.0, 0.2)
    assert grip.off == pytest.approx(0.006)
    assert grip.turned == pytest.approx(-0.1)
    assert table.held is None
    with pytest.raises(ValueError, match="gripper is empty"):
        table.place(0, 0, 0)


def test_how_a_block_lies_in_the_gripper_is_how_it_lies_on_the_tower() -> None:
    table = TowerTable(1)
    table.blocks = [WoodenBlock(0.4, 0.1, 0.0), WoodenBlock(0.3, 0.0, 0.3, colour="black")]
    table.pick(0.301, 0.002, 0.25)
    lies = table.place(0.4, 0.1, 0.25 + math.pi / 2)
    # the gripper turned by a right angle, and the block with it
    assert (lies.x, lies.y) == pytest.approx((0.4 + 0.002, 0.1 - 0.001))
    assert lies.angle == pytest.approx(0.3 + math.pi / 2)
    assert lies.z == BLOCK[2]


# ---------------------------------------------------------------------- the simulation itself


def test_simulated_block_is_where_its_corners_are_seen() -> None:
    table = TowerTable(5)
    camera = (0.4, 0.05, 0.5)
    table.blocks.append(WoodenBlock(0.37, 0.09, 0.4, z=0.03, colour="black"))
    rows, columns = np.nonzero(ColourRange(value=(0, 60)).mask(table.look(camera, 0).rgb))
    c, s = math.cos(0.4), math.sin(0.4)
    corners = [
        (0.37 + c * x - s * y, 0.09 + s * x + c * y)
        for x in (-BLOCK[0] / 2, BLOCK[0] / 2)
        for y in (-BLOCK[1] / 2, BLOCK[1] / 2)
    ]
    seen = [to_robot(camera, float(x), float(y), 0.045) for x, y in zip(columns, rows, strict=True)]
    for corner in corners:  # a pixel is 0.8 mm, and the camera is not quite where it is said to be
        assert min(math.dist(corner, one) for one in seen) < 2e-3


# ---------------------------------------------------------------------- all of it


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 6, 13])
async def test_tower_is_built_with_a_person_beside(
    capsys: pytest.CaptureFixture[str], seed: int
) -> None:
    told = await built(capsys, seed)
    rows = [row for line in told for row in line.get("compared", [])]
    assert [row["what"] for row in rows] == ["block", "tower's top"] * 5
    heights = [row["found"]["height"] for row in rows[1::2]]
    # two blocks at first; a person adds one after two, and takes one after four
    assert heights == pytest.approx([0.03, 0.045, 0.075, 0.09, 0.09], abs=1e-3)
    assert [line["person"] for line in told if "person" in line] == ["add", "remove"]
    assert [line["seen"] for line in told if "layer" in line and "seen" in line] == [6, 5, 4, 3, 2]
    assert told[-1]["within"]
    assert told[-1]["height"] < 1e-3


@pytest.mark.long
def test_demo_with_tower_is_a_command_and_the_same_each_time() -> None:
    first, second = (run("demo", "--tower", "--seed", "4").done().out for _ in range(2))
    assert first == second
    assert "The tower has 7 layers, 105.0 mm" in first
    assert "all within 2 mm, 1 degree, 1 mm" in first


def test_demos_are_run_one_at_a_time() -> None:
    outcome = run("demo", "--tower", "--pick")
    assert outcome.code == 2
    assert "--pick and --tower do not go together" in outcome.err
