"""``smartcam demo --inspect``: a software camera checks drawn parts, whose faults are known."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._cli.demo import Steps
from smartcam._cli.options import label_file_errors
from smartcam._cli.texts import table_text
from smartcam._extras import load

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from smartcam._cli.options import Options
    from smartcam.inspection import Inspection

    Pixels = NDArray[np.uint8]

CV2_PURPOSE: Final = "inspection needs"
"""Beginning of the error if cv2 is missing."""

SIZE_PX: Final = (640, 400)
"""Width and height of a picture, pixels."""

PART_PX: Final = (320, 180)
"""Width and height of the part, pixels."""

OVERSAMPLING: Final = 3
"""Number of samples per pixel along each side."""

LOGO: Final = (-40, 20, 160, 50)
"""The print, in the part's frame of reference: x, y, width, height, pixels."""

CELL: Final = f"""\
cameras:
  desk/drawn:
    software:
      frames: pictures
      applications:
        1:
          name: part
          present: {{grey: [175, 255], area: [40000, 70000]}}
        2:
          name: label
          read: {{codes: DataMatrix, expect: 'LOT-\\d{{4}}'}}
        3:
          name: check
          read: {{codes: DataMatrix, expect: 'LOT-\\d{{4}}'}}
          present hole:
            {{follow: part, region: [-155, -85, 60, 60], grey: [0, 90], area: [700, 1500]}}
          compare print:
            {{follow: part, taught: print.png, region: {list(LOGO)}, shift: 6, area: 40}}
"""


class DrawnPart(NamedTuple):
    """A part on the table.

    Attributes:
        name: name of its picture.
        fault: fault of the part; "" for none.
        x: column of its middle, pixels.
        y: row of its middle, pixels.
        degrees: angle of the part, clockwise.
        code: text of its code.
        print: text of its print.
        hole: whether the part has its hole.
        noise: standard deviation of the noise, grey levels.
    """

    name: str
    fault: str
    x: float = 320.0
    y: float = 200.0
    degrees: float = 0.0
    code: str = "LOT-4711"
    print: str = "smartcam"
    hole: bool = True
    noise: float = 3.0


PARTS: Final = (
    DrawnPart("good", ""),
    DrawnPart("turned", "", 300.0, 215.0, 14.0),
    DrawnPart("noisy", "", 330.0, 190.0, -11.0, noise=9.0),
    DrawnPart("no-hole", "hole", 310.0, 205.0, 5.0, hole=False),
    DrawnPart("wrong-code", "read", 325.0, 195.0, -6.0, code="LOT-47X1"),
    DrawnPart("bad-print", "print", 315.0, 210.0, 9.0, print="smartcar"),
)
"""The parts that the demonstration draws."""


async def inspect(options: Options, folder: Path, seed: int) -> None:
    """Draw parts, write a cell file, and inspect the pictures."""
    from smartcam.inspection import Picture, load_cell

    steps = Steps(options)
    with label_file_errors(f"--folder {folder}"):
        await asyncio.to_thread(_write_folder, folder, seed)
    steps.step(
        f"A folder with synthetic pictures of {len(PARTS)} parts, and a file with the expected "
        f"findings: {folder / 'cell.yaml'}",
        folder=str(folder),
    )
    camera = load_cell(folder / "cell.yaml")["desk/drawn"]
    check = camera.program("check")
    steps.step("The application 3 reads, looks for a hole, and compares a print. Its results are:")
    steps.detail(f"   {check.interpret_as}", layout=check.interpret_as)
    steps.step("Faults that the inspection found, next to the true ones:")
    rows: list[tuple[object, ...]] = []
    parts: list[dict[str, Any]] = []
    for part in PARTS:
        picture = await asyncio.to_thread(Picture.read, folder / "pictures" / f"{part.name}.png")
        inspection = await asyncio.to_thread(check.inspect, picture)
        with label_file_errors(f"--folder {folder}"):
            await asyncio.to_thread(
                _save_findings, folder / "seen" / f"{part.name}.png", inspection
            )
        failed_tools = [name for name, finding in inspection.findings.items() if not finding.ok]
        milliseconds = 1e3 * sum(inspection.seconds.values())
        rows.append(
            (
                part.name,
                part.fault or "none",
                ", ".join(failed_tools) or "none",
                f"{milliseconds:.1f} ms",
            )
        )
        parts.append({"picture": part.name, "fault": part.fault, "found": failed_tools})
    steps.detail(table_text(("picture", "fault", "found", "took"), rows), parts=parts)
    steps.step(
        f"What the tools saw stands in {folder / 'seen'}. Change {folder / 'cell.yaml'}, and try "
        "it:"
    )
    steps.detail(f"   smartcam inspect {folder}/cell.yaml desk/drawn check {folder}/pictures")


def _write_folder(folder: Path, seed: int) -> None:
    for name in ("pictures", "seen"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(seed)
    good_picture = draw_part(PARTS[0], random)
    x, y = round(PARTS[0].x) + LOGO[0], round(PARTS[0].y) + LOGO[1]
    _save(folder / "print.png", good_picture[y : y + LOGO[3], x : x + LOGO[2]])
    for part in PARTS:
        _save(folder / "pictures" / f"{part.name}.png", draw_part(part, random))
    (folder / "cell.yaml").write_text(CELL, encoding="utf-8")


def _save_findings(path: Path, inspection: Inspection) -> None:
    _save(path, inspection.drawn()[:, :, ::-1])


def _save(path: Path, pixels: NDArray[Any]) -> None:
    path.write_bytes(load("cv2", CV2_PURPOSE).imencode(".png", pixels)[1].tobytes())


def draw_part(part: DrawnPart, random: np.random.Generator) -> Pixels:
    """Return a picture of a part, (H, W), uint8."""
    cv2 = load("cv2", CV2_PURPOSE)
    part_picture = _draw_upright_part(part)
    cos, sin = math.cos(math.radians(part.degrees)), math.sin(math.radians(part.degrees))
    rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0]])
    middle = (np.array(part_picture.shape[::-1]) - 1) / 2
    centre = OVERSAMPLING * (np.array([part.x, part.y]) + 0.5) - 0.5
    rotation[:, 2] = centre - rotation[:, :2] @ middle
    canvas_size = tuple(OVERSAMPLING * side for side in SIZE_PX)
    canvas = cv2.warpAffine(
        part_picture, rotation, canvas_size, flags=cv2.INTER_LINEAR, borderValue=120
    )
    levels = cv2.resize(canvas, SIZE_PX, interpolation=cv2.INTER_AREA).astype(np.float64)
    levels += random.normal(0.0, part.noise, levels.shape)
    picture: Pixels = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    return picture


def _draw_upright_part(part: DrawnPart) -> Pixels:
    """Return an oversampled picture of the part from above, upright."""
    cv2, zxing = load("cv2", CV2_PURPOSE), load("zxingcpp", "codes need")
    scale = OVERSAMPLING
    part_picture = np.full((scale * PART_PX[1], scale * PART_PX[0]), 215, np.uint8)
    if part.hole:
        cv2.circle(part_picture, (scale * 35, scale * 35), scale * 18, 40, -1, cv2.LINE_AA)
    code = np.array(
        zxing.create_barcode(part.code, zxing.BarcodeFormat.DataMatrix).to_image(scale=4 * scale)
    )
    rows, columns = code.shape
    left = part_picture.shape[1] - columns - scale * 12
    part_picture[scale * 10 : scale * 10 + rows, left : left + columns] = np.clip(code, 30, 215)
    text_origin = (scale * 124, scale * 146)
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(
        part_picture, part.print, text_origin, font, 0.95 * scale, 30, 2 * scale, cv2.LINE_AA
    )
    return part_picture
