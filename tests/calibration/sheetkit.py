"""A tilted camera with a lens that distorts, a sheet below it, and a robot that touches it."""

from __future__ import annotations

import asyncio
import functools
import json
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from smartcam.calibration import CameraModel, Checkerboard, Transform
from smartcam.calibration._inside import Target
from smartcam.calibration.simulation import render
from smartcam.calibration.wizards import WizardSession, sheet_wizard
from smartcam.geometry._inside import Array
from smartcam.models import Header, Localization, Pose, Position, Quaternion
from tests.calibration.inside import Journal

CAMERA = CameraModel(
    size=(800, 600),
    matrix=np.array([[750.0, 0, 402], [0, 748.0, 297], [0, 0, 1]]),
    distortion=np.array([-0.15, 0.03, 0.0005, -0.0003, 0.0]),
)
STRAIGHT = CameraModel(size=CAMERA.size, matrix=CAMERA.matrix)
TARGET = Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True)

_TURN = Rotation.from_euler("xyz", [192, 8, 10], degrees=True).as_matrix()
SEEN = Transform(
    "camera", "target", _TURN, np.array([0, 0, 0.5]) - _TURN @ TARGET.points.mean(axis=0)
)
"""The sheet in the frame of the camera, which is tilted by 14 degrees."""

LIES = Transform.from_quaternion(
    "robot",
    "target",
    (0.5, 0.1, 0.03),
    Rotation.from_euler("xyz", [3, -2, 130], degrees=True).as_quat(),
)
"""The sheet in the robot's frame."""

TOOL_Z = -LIES.rotation[:, 2]
SIGMA = 2e-4
"""Standard deviation of a touch, metres."""


def field(count: int = 7, border: float = 60.0) -> Array:
    """Return pixels (count^2, 2) over the image."""
    width, height = CAMERA.size
    u, v = np.meshgrid(
        np.linspace(border, width - border, count), np.linspace(border, height - border, count)
    )
    return np.column_stack([u.ravel(), v.ravel()])


def truth(pixels: Array, camera: CameraModel = CAMERA) -> Array:
    """Return the robot's coordinates (N, 3) of the plane's points that pixels show."""
    rays = np.column_stack([camera.directions(pixels), np.ones(len(pixels))])
    normal = SEEN.rotation[:, 2]
    depths = (normal @ SEEN.translation) / (rays @ normal)
    return LIES.apply((rays * depths[:, None] - SEEN.translation) @ SEEN.rotation)


def localized(u: float, v: float, theta: float = 0.0, frame: str = "camera") -> Localization:
    """Return a camera's result for a part, with the y axis turned up."""
    pose = Pose(
        Header(1, datetime(2026, 1, 1, tzinfo=UTC), frame),
        Position(u, -v),
        Quaternion.from_theta(theta),
    )
    return Localization("part", 0.9, 0, pose)


@functools.cache
def picture(number: int, *, straight: bool = False) -> Any:
    """Return the camera's view of the sheet; each picture has its own noise."""
    random = np.random.default_rng([5, number])
    return render(TARGET, STRAIGHT if straight else CAMERA, SEEN, noise=2.0, random=random)


class Cell:
    """A camera and a robot; ``pictures`` are taken before the sheet's own."""

    def __init__(
        self, camera: CameraModel = CAMERA, sigma: float = SIGMA, scale: float = 1.0
    ) -> None:
        self.camera = camera  # the real lens, CAMERA or STRAIGHT
        self.sigma = sigma  # of a touch, metres
        self.scale = scale  # of the print
        self.pictures: list[Any] = []
        self.taken = 0
        self._random = np.random.default_rng(5)

    async def take_picture(self) -> Any:
        self.taken += 1
        if self.pictures:
            return self.pictures.pop(0)
        return picture(self.taken, straight=self.camera is STRAIGHT)

    def touched(self, points: Sequence[Sequence[float]]) -> Array:
        """Return the robot's touches of points (N, 2) of the sheet, metres."""
        flat = np.column_stack([np.array(points), np.zeros(len(points))])
        return LIES.apply(self.scale * flat) + self._random.normal(0.0, self.sigma, (len(flat), 3))

    def touch(self, x: float, y: float) -> dict[str, float]:
        """Return the answer, in mm, of a touch of a point of the sheet."""
        place = self.touched([(x, y)])[0]
        return {axis: 1e3 * value for axis, value in zip("xyz", place.tolist(), strict=True)}

    def corner(self, view: dict[str, Any]) -> dict[str, float]:
        """Return the answer to a step that suggests a corner."""
        number = (view["defaults"]["row"] - 1) * TARGET.columns + view["defaults"]["column"] - 1
        return self.touch(*TARGET.points[number, :2].tolist())


def begin(
    folder: Path,
    cell: Cell,
    *,
    target: Target | None = TARGET,
    camera: CameraModel | None = CAMERA,
    journal: Path | None = None,
    **parameters: Any,
) -> WizardSession:
    """Return a session of the wizard; the robot's pose is typed."""
    wizard = sheet_wizard(
        take_picture=cell.take_picture,
        save_to=lambda name: folder / f"{name}.json",
        suggested=target,
        camera=camera,
    )
    opened = None if journal is None else Journal(journal)
    return WizardSession(
        wizard, opened, parameters={"name": "table", "side": "unknown", **parameters}
    )


ABOUT = {"touch_sigma": 1e3 * SIGMA}
CORNERS: list[dict[str, Any]] = [ABOUT, {}, {}, {}, *[{}] * 4, {"next": "accept"}, {}]
"""An answer for each step of the wizard; touches are the cell's."""


async def next_answer(view: dict[str, Any], cell: Cell) -> dict[str, Any]:
    """Return the answer to the step of a view."""
    answer = CORNERS[view["number"] - 1]
    return {**answer, **cell.corner(view)} if view["step"].startswith("touch-") else answer


async def _main(folder: Path) -> None:
    """Resume the wizard; each line of stdin answers a step, stdout shows the next one."""
    cell = Cell(sigma=0.0)
    session = begin(folder, cell, journal=folder / "table.journal")
    view = session.current
    while True:
        say = {"number": view["number"], "type": view["type"], "taken": cell.taken}
        sys.stdout.write(json.dumps(say) + "\n")
        sys.stdout.flush()
        if not sys.stdin.readline():
            break
        view = await session.submit(session.token, await next_answer(view, cell))
    session.close()


if __name__ == "__main__":
    asyncio.run(_main(Path(sys.argv[1])))
