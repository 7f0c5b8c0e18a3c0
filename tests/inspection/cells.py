"""Cell files and pictures for tests."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.inspection import load_cell

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from smartcam.inspection import Inspection, Program

HEAD = """\
cameras:
  line1/cam1:
    software:
      frames: pictures
      applications:
"""

GREY = 100
"""Grey level of the background of :func:`board`."""


def write_cell(folder: Path, *applications: str, head: str = HEAD) -> Path:
    """Write a cell file with these applications, and return its path."""
    path = folder / "cell.yaml"
    path.write_text(head + "".join(f"        {one}\n" for one in applications), encoding="utf-8")
    return path


def programs(folder: Path, *applications: str) -> dict[int, Program]:
    """Return the programs of a cell with these applications."""
    return dict(load_cell(write_cell(folder, *applications))["line1/cam1"].programs)


def inspected(
    folder: Path, application: str, picture: NDArray[Any], *, given: bytes = b""
) -> Inspection:
    """Return an application's inspection of a picture."""
    (program,) = programs(folder, f"7: {application}").values()
    return program.inspect(picture, input=given)


def board(*spots: tuple[int, int, int, int, int]) -> NDArray[np.uint8]:
    """Return a grey picture of 200 x 100 pixels with rectangles: x, y, width, height, level."""
    picture = np.full((100, 200), GREY, np.uint8)
    for x, y, width, height, level in spots:
        picture[y : y + height, x : x + width] = level
    return picture
