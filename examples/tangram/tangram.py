"""Find the seven pieces of a tangram in a picture, instead of asking an emulated smart camera.

The table and its pieces are the emulator's, so both give the same localizations. Here a picture is
drawn, and a plain camera's program locates the pieces in it by their outlines.
"""

from __future__ import annotations

import asyncio
import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

import smartcam
from smartcam.emulator import TableScene
from smartcam.inspection import PartModel, load_cell

if TYPE_CHECKING:
    from numpy.typing import NDArray

PIXELS_PER_MM = 4.0
SAMPLES = 8  # samples along each side of a pixel

TRIANGLE = [(-1, -1 / 3), (1, -1 / 3), (0, 2 / 3)]
OUTLINES = {  # corners about the centroid, y up, mm
    "big_triangle": 50 * np.array(TRIANGLE),
    "medium_triangle": 50 / math.sqrt(2) * np.array(TRIANGLE),
    "small_triangle": 25 * np.array(TRIANGLE),
    "square": 50 / math.sqrt(8) * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]),
    "parallelogram": 12.5 * np.array([(-3, -1), (1, -1), (3, 1), (-1, 1)]),
}

CELL = """
cameras:
  table:
    software:
      frames: pictures
      applications:
        7:
          name: tangram
          locate: {model: [%s], most: 2, count: 7, seconds: 10}
"""


def shape_of(piece: str) -> str:
    """Return the shape of a piece; several pieces may share one."""
    return piece.rstrip("_12")


def picture(scene: TableScene) -> NDArray[np.uint8]:
    """Return a plain camera's picture of a table: pixels of 8 bits, with blur and noise."""
    fine = np.full((SAMPLES * 1024, SAMPLES * 1280), 60, np.uint8)
    for name, pose in scene.pieces.items():
        u, v, theta = scene.to_pixels(pose)
        corners = OUTLINES[shape_of(name)] * [1, -1] * PIXELS_PER_MM
        cos, sin = math.cos(theta), math.sin(theta)
        corners = corners @ [[cos, sin], [-sin, cos]] + (u, v)
        corners = np.rint(SAMPLES * (corners + 0.5) - 0.5).astype(np.int32)
        cv2.fillPoly(fine, [corners], 190)
    grey = cv2.resize(fine, (1280, 1024), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(1).normal(0, 2, grey.shape)
    seen: NDArray[np.uint8] = np.clip(cv2.GaussianBlur(grey, (0, 0), 0.8) + noise, 0, 255).astype(
        np.uint8
    )
    return seen


def write_cell(folder: Path, scene: TableScene) -> dict[str, PartModel]:
    """Write models of the pieces, a picture and a cell file; return the models."""
    models = {}
    for name, corners in OUTLINES.items():
        points = " ".join(f"{x},{-y}" for x, y in corners)
        drawing = f'<svg xmlns="http://www.w3.org/2000/svg"><polygon points="{points}"/></svg>'
        (folder / f"{name}.svg").write_text(drawing)
        model = PartModel.from_outline(folder / f"{name}.svg", PIXELS_PER_MM, name=name, unit="mm")
        model.write(folder / f"{name}.model")
        models[name] = model
    (folder / "pictures").mkdir()
    cv2.imwrite(str(folder / "pictures" / "table.png"), picture(scene))
    (folder / "cell.yaml").write_text(CELL % ", ".join(f"{name}.model" for name in OUTLINES))
    return models


async def main(folder: Path) -> None:
    """Locate the pieces, and print their found and true places."""
    scene = TableScene(y_down=True, offset=(45.0, 1010.0))
    models = await asyncio.to_thread(write_cell, folder, scene)
    program = load_cell(folder / "cell.yaml")["table"].program(7)
    async with smartcam.connect(
        f"software:{folder / 'cell.yaml'}",
        interpret_as=f"localizations: {program.interpret_as}",
        y_down=True,
    ) as camera:
        result = await camera.trigger(timeout=20.0)
    worst = 0.0
    for part in sorted(result.value, key=lambda one: one.pose.position):
        # a model's reference is the middle of its edges; the scene tells the centroid
        u, v = models[part.feature_id].reference
        cos, sin = math.cos(part.pose.orientation.theta), math.sin(part.pose.orientation.theta)
        x = part.pose.position.x - cos * u - sin * v
        y = part.pose.position.y - sin * u + cos * v
        off = {}
        for name, pose in scene.pieces.items():
            if shape_of(name) == part.feature_id:
                at_u, at_v, _ = scene.to_pixels(pose)
                off[name] = math.hypot(x - at_u, -y - at_v) / PIXELS_PER_MM
        name = min(off, key=off.__getitem__)
        worst = max(worst, off[name])
        said = f"{name:16} at {x:6.1f}, {y:7.1f} px, sigma {part.pose.sigma.worst_xy:.4f} px"
        print(said)  # noqa: T201
    said = f"{len(result.value)} of {len(scene.pieces)} pieces, all within {worst:.3f} mm"
    print(said)  # noqa: T201


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        asyncio.run(main(Path(place)))
