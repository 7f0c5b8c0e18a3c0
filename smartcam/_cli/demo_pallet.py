"""``smartcam demo --pick --plain``: locate parts in a plain camera's pictures, and palletize them.

A part and a mark are taught from drawn pictures. The robot touches the mark at nine places, and
these pairs give the calibration. Then the tool ``locate`` gives each part's pose in the
robot's frame, and its uncertainty. The robot's actions are compared with the true poses,
which are unknown in a real cell.
"""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import smartcam
from smartcam._cli.demo import Steps
from smartcam._cli.demo_pick import nine_marks
from smartcam._cli.demo_table import (
    HEIGHT,
    NOISE,
    TOUCH_SIGMA,
    DrawnTable,
    Placed,
    TableDriver,
    TablePart,
    TableRobot,
    radius_of,
)
from smartcam._cli.options import label_file_errors
from smartcam._cli.texts import table_text
from smartcam._extras import load
from smartcam.emulator import TablePose
from smartcam.geometry import PlacePattern

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam._cli.options import Options
    from smartcam.calibration import PlaneCalibration
    from smartcam.inspection import PartModel

MARKS_FILE, CELL_FILE = "marks.yaml", "cell.yaml"
"""Cell files before and after the calibration."""

MAX_PARTS: Final = 8
"""Largest number of parts that lie on the table at once."""

DOWN: Final = (0.0, 0.0, -1.0)
"""Direction of the robot's tool when it touches."""

TAUGHT_PART: Final = TablePart("bracket", TablePose(0.15, 0.125, 0.4))
"""The part in the picture from which it is taught."""

MARKS_CELL: Final = """\
cameras:
  desk/camera:
    software:
      frames: {address} # the demo's own; yours is gige://HOST, v4l2:///dev/video0, rtsp://...
      applications:
        1: {{name: mark, locate: {{model: mark.model}}}}
"""

CELL: Final = """\
cameras:
  desk/camera:
    software:
      frames: {address} # the demo's own; yours is gige://HOST, v4l2:///dev/video0, rtsp://...
      calibration: plane.json # results are in the robot's millimetres
      keep: {{folder: judged, which: all}}
      applications:
        1: {{name: brackets, locate: {{model: bracket.model, most: {most}, seconds: 10}}}}
"""


class Grid(NamedTuple):
    """The size of a pallet."""

    rows: int
    columns: int
    layers: int


async def palletize(options: Options, folder: Path, seed: int, grid: Grid) -> None:
    """Teach, calibrate, and move parts from a table onto a pallet until it is full.

    ``folder``: folder for the models, the calibration, the cell files and the pictures; ``seed``:
    seed of all noise and places. Raises MissingExtraError: the extra ``inspection`` is not
    installed; ConfigurationError: the folder cannot be written.
    """
    load("scipy", "calibration needs")  # first, so that it fails before the other steps
    steps = Steps(options)
    with label_file_errors(f"--folder {folder}"):
        await asyncio.to_thread(folder.mkdir, parents=True, exist_ok=True)
    table = DrawnTable(seed)
    TableDriver.tables[table.address] = table
    try:
        await _run(_Demo(options, steps, folder, table, TableRobot(table, seed), grid))
    finally:
        del TableDriver.tables[table.address]


class _Demo(NamedTuple):
    options: Options
    steps: Steps
    folder: Path
    table: DrawnTable
    robot: TableRobot
    grid: Grid


async def _run(demo: _Demo) -> None:
    steps, table = demo.steps, demo.table
    steps.step(
        f"A simulated camera, which is not smart, above a level table: {1e3 * table.pixel:g} mm a "
        f"pixel, noise of {NOISE:g} grey levels. A robot beside it, which does not know where the "
        "table is.",
        address=table.address,
    )
    bracket = await _teach_parts(demo)
    reference = table.reference_pose(TAUGHT_PART, bracket.reference)
    await _calibrate(demo)
    pattern = _touch_pallet(demo)
    await _write_file(demo, CELL_FILE, CELL.format(address=table.address, most=MAX_PARTS))
    placed: list[Placed] = []
    expected: list[float] = []
    async with smartcam.connect(f"software:{demo.folder / CELL_FILE}") as camera:
        timeout = demo.options.step_timeout(10.0)
        while len(placed) < len(pattern):
            if not table.parts:
                table.lay_parts("bracket", min(MAX_PARTS, len(pattern) - len(placed)))
            result = await camera.trigger(timeout=timeout)
            _move_parts(demo, result.value, reference, pattern, placed, expected)
            if not result.value.locate:
                break
        last_value = (await camera.trigger(timeout=timeout)).value
        reason = last_value.reason or f"{len(last_value.locate)} found"
        steps.step(f"Triggered once more: {reason}.", reason=reason, left=len(table.parts))
    errors = [part.error for part in placed]
    place_offsets = [part.off_place for part in placed if part.taken]
    steps.detail(
        f"   error {1e3 * _rms(errors):.3f} mm rms, predicted {1e3 * _rms(expected):.3f} mm; "
        f"{len(place_offsets)} of {len(pattern)} places filled, parts lie "
        f"{1e3 * _rms(place_offsets):.2f} mm rms beside them",
        error=_rms(errors),
        predicted=_rms(expected),
        filled=len(place_offsets),
        places=len(pattern),
    )
    steps.step(
        f"Models, calibration, cell file and pictures are in {demo.folder}. Try changed settings "
        "on the pictures:"
    )
    cell, pictures = demo.folder / CELL_FILE, demo.folder / "judged"
    steps.detail(f"   smartcam inspect {cell} desk/camera 1 {pictures}")


async def _teach_parts(demo: _Demo) -> PartModel:
    """Teach the mark and the bracket from one picture each; return the model of the bracket."""
    demo.steps.step("Taught from one picture each, by a region around the part:")
    rows: list[tuple[object, ...]] = []
    for part in (TablePart("mark", TablePose(0.15, 0.125, 0.0)), TAUGHT_PART):
        demo.table.parts = [part]
        with label_file_errors(f"--folder {demo.folder}"):
            model = await asyncio.to_thread(_teach_part, demo, part)
        position_sigma, angle_sigma = model.predicted_sigma()
        rows.append(
            (
                part.kind,
                model.symmetry.text(),
                str(len(model.segments.half_lengths)),
                f"{1e3 * position_sigma * demo.table.pixel:.4f} mm",
                "-" if math.isnan(angle_sigma) else f"{math.degrees(angle_sigma):.4f} deg",
            )
        )
    head = ("part", "symmetry", "pieces of edges", "sigma of a pose", "")
    demo.steps.detail(table_text(head, rows))
    return model


def _teach_part(demo: _Demo, part: TablePart) -> PartModel:
    from smartcam.inspection import PartModel, Region

    picture = demo.table.take_picture()
    x, y, _ = demo.table.to_pixels(part.pose)
    half_side = radius_of(part.kind) / demo.table.pixel + 12
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    region = Region((x + half_side * right, y + half_side * down) for right, down in signs)
    model = PartModel.teach(picture, region, name=part.kind)
    model.write(demo.folder / f"{part.kind}.model")
    return model


async def _calibrate(demo: _Demo) -> PlaneCalibration:
    """Locate the mark at nine places by the camera, and touch it there by the robot."""
    from smartcam.calibration import fit_plane

    await _write_file(demo, MARKS_FILE, MARKS_CELL.format(address=demo.table.address))
    mark_points: list[tuple[float, float]] = []
    touched_points: list[list[float]] = []
    async with smartcam.connect(f"software:{demo.folder / MARKS_FILE}") as camera:
        for pose in nine_marks().values():
            demo.table.parts = [TablePart("mark", pose)]
            result = await camera.trigger(timeout=demo.options.step_timeout(10.0))
            (mark,) = result.value.locate
            mark_points.append((mark.x, -mark.y))  # y up, as in calibrations
            touched_points.append(demo.robot.touch_table(pose))
    demo.table.parts = []
    calibration = fit_plane(
        mark_points, touched_points, touch_sigma=TOUCH_SIGMA, tool_z=DOWN, y_down=True
    )
    with label_file_errors(f"--folder {demo.folder}"):
        await asyncio.to_thread(calibration.save, demo.folder / "plane.json")
    held_out = calibration.held_out_error or math.nan
    demo.steps.step(
        f"The mark, located and touched at nine places ({1e3 * TOUCH_SIGMA:g} mm of noise on each "
        f"axis). Calibrated ({calibration.model}): each touch against a calibration from the "
        f"others, {1e3 * held_out:.2f} mm rms, the touch's own noise included",
        model=calibration.model,
        held_out_error=held_out,
        warnings=[remark.text for remark in calibration.warnings],
    )
    return calibration


def _touch_pallet(demo: _Demo) -> PlacePattern:
    """Let the robot touch three corners of the pallet; return the pattern of its places."""
    rows, columns, layers = demo.grid
    corners = ((0, 0), (columns - 1, 0), (0, rows - 1))
    first, row_end, column_end = (demo.robot.touch_pallet(*end) for end in corners)
    pattern = PlacePattern.from_touches(
        first, row_end, column_end, rows=rows, columns=columns, layers=layers, height=HEIGHT
    )
    column_pitch, row_pitch, _ = pattern.pitch
    demo.steps.step(
        f"A pallet of {rows} rows, {columns} columns and {layers} layers, of which the robot "
        f"touched three corners: {1e3 * column_pitch:.2f} mm from column to column, "
        f"{1e3 * row_pitch:.2f} mm from row to row",
        places=len(pattern),
    )
    return pattern


def _move_parts(
    demo: _Demo,
    value: Any,
    reference: TablePose,
    pattern: PlacePattern,
    placed: list[Placed],
    expected: list[float],
) -> None:
    """Move each part that was found to the next place of the pallet, and print the errors."""
    rows: list[tuple[object, ...]] = []
    for part in value.locate:
        number = sum(part.taken for part in placed)
        if number == len(pattern):
            break
        pose = (part.x, part.y, part.theta)
        sigma = math.hypot(part.sigma_x, part.sigma_y)
        placed_part = demo.robot.palletize(pose, reference, pattern, number)
        placed.append(placed_part)
        expected.append(sigma)
        rows.append(
            (
                *(f"{1e3 * length:.2f}".rjust(8) for length in (part.x, part.y)),
                *(f"{1e3 * length:.3f}" for length in (placed_part.error, sigma)),
                f"{math.degrees(placed_part.heading_error):+.3f}",
                f"{math.degrees(part.sigma_theta):.3f}",
                "/".join(str(1 + count) for count in pattern.row_column_layer(number))
                if placed_part.taken
                else "missed",
                f"{1e3 * placed_part.off_place:.2f}",
            )
        )
    demo.steps.step(
        f"Triggered: {len(value.locate)} parts in the robot's frame. It moves each of them to the "
        "next place (row/column/layer), mm and degrees:"
        if rows
        else f"Triggered: {value.reason}"
    )
    head = ("x", "y", "error", "predicted", "turned by", "predicted", "place", "off it")
    if rows:
        demo.steps.detail(table_text(head, rows), placed=placed[-len(rows) :])


async def _write_file(demo: _Demo, name: str, text: str) -> None:
    with label_file_errors(f"--folder {demo.folder}"):
        await asyncio.to_thread((demo.folder / name).write_text, text, encoding="utf-8")


def _rms(values: list[float]) -> float:
    return math.hypot(*values) / math.sqrt(max(len(values), 1))
