"""A cell that sorts: screws into one container, nuts into the other.

A smart camera above a table reports the parts and their places, and a calibration converts them to
the robot's coordinates. The robot picks one part after the other, and drops it into the container
of its kind. ``python sorting.py`` simulates camera and robot.
"""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from typing import TYPE_CHECKING, Protocol

import smartcam
from smartcam.calibration import PlaneCalibration, Transform, fit_plane
from smartcam.emulator import EmulatedCamera, TablePose, TableScene
from smartcam.models import Pose, Position

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam import Camera

__all__ = ["APPLICATION", "CONTAINERS", "Robot", "TableRobot", "calibrate", "sort"]

APPLICATION = 7

CONTAINERS = {"screw": Position(0.30, -0.25, 0.05), "nut": Position(0.30, 0.25, 0.05)}
"""Places where the robot opens its gripper, by kind of part; metres in the robot's frame."""

TRIES = 3
"""Largest number of pictures in a row without a part taken."""


class Robot(Protocol):
    """The functions of a robot that the cell needs; your robot has them under its own names."""

    async def touch(self, mark: str) -> Position:
        """Wait until the tip is at a mark, and return its position in the robot's frame."""
        ...

    async def pick(self, pose: Pose) -> bool:
        """Close the gripper at a pose; return False if it is empty then."""
        ...

    async def drop(self, place: Position) -> None:
        """Open the gripper at a place."""
        ...


async def calibrate(camera: Camera, robot: Robot) -> PlaneCalibration:
    """Calibrate camera and robot: the robot touches each mark that the camera sees."""
    seen = (await camera.trigger(timeout=2.0)).value
    touched = [await robot.touch(mark.feature_id) for mark in seen]
    return fit_plane([mark.pose.position[:2] for mark in seen], touched)


async def sort(
    camera: Camera,
    robot: Robot,
    calibration: PlaneCalibration,
    containers: Mapping[str, Position] = CONTAINERS,
) -> Counter[str]:
    """Sort the parts that the camera sees until no part with a container is left.

    Returns:
        Number of sorted parts of each kind. A part without a container stays on the table, and so
        does a part that could not be picked in three tries.
    """
    sorted_parts: Counter[str] = Counter()
    tries = 0
    while tries < TRIES:
        result = await camera.trigger(timeout=2.0)
        parts = [part for part in result.value if kind_of(part.feature_id) in containers]
        if not parts:
            break
        tries += 1
        for part in calibration.to_robot(parts, tool_flip=True):
            kind = kind_of(part.feature_id)
            if await robot.pick(part.pose):
                await robot.drop(containers[kind])
                sorted_parts[kind] += 1
                tries = 0
    return sorted_parts


def kind_of(feature_id: str) -> str:
    """Return the kind of a part: ``screw_2`` is a screw."""
    return feature_id.partition("_")[0]


class TableRobot:
    """A simulated robot: it takes parts from the emulated camera's table.

    Args:
        scene: the table.
        grip: largest distance from a part at which the robot still picks it, metres.
        noise: standard deviation of a touch along each axis, metres.
    """

    def __init__(self, scene: TableScene, *, grip: float = 0.002, noise: float = 0.0002) -> None:
        self._scene = scene
        self._grip = grip
        self._random = random.Random(3)  # noqa: S311  noise, not a secret
        self._noise = noise
        self._table = Transform.from_quaternion(
            "robot", "table", (0.35, -0.12, 0.02), (0.01, -0.02, 0.6, 0.7997)
        )
        self._held = ""
        self.contents: dict[Position, list[str]] = {}
        """Dropped parts of each container."""

    async def touch(self, mark: str) -> Position:
        """Return the position of a mark, with noise."""
        pose = self._scene.pieces[mark]
        true = self._table.apply((pose.x, pose.y, 0.0)).tolist()
        return Position(*(value + self._random.gauss(0.0, self._noise) for value in true))

    async def pick(self, pose: Pose) -> bool:
        """Take the part at the pose, if there is one."""
        x, y, z = self._table.inverse().apply(pose.position).tolist()
        for name, part in list(self._scene.pieces.items()):
            if (x - part.x) ** 2 + (y - part.y) ** 2 + z**2 < self._grip**2:
                del self._scene.pieces[name]
                self._held = name
                return True
        return False

    async def drop(self, place: Position) -> None:
        """Drop the part."""
        self.contents.setdefault(place, []).append(self._held)


async def main() -> None:
    """Sort six parts in a simulated cell."""
    async with EmulatedCamera(seed=2) as emulator:
        robot = TableRobot(emulator.scene)
        async with smartcam.connect(
            emulator.url, application=APPLICATION, interpret_as="localizations"
        ) as camera:
            lay(emulator.scene, MARKS)
            calibration = await calibrate(camera, robot)
            lay(emulator.scene, PARTS)
            counts = await sort(camera, robot, calibration)
    for kind, place in CONTAINERS.items():
        print(f"{counts[kind]} {kind}s: {', '.join(robot.contents[place])}")  # noqa: T201


def lay(scene: TableScene, things: Mapping[str, TablePose]) -> None:
    """Clear the table, and put these things onto it."""
    scene.pieces.clear()
    scene.pieces.update(things)


MARKS = {
    f"mark_{number}": TablePose(x, y, 0.0)
    for number, (x, y) in enumerate([(0.03, 0.03), (0.27, 0.03), (0.03, 0.22), (0.27, 0.22)])
}

PARTS = {
    "screw_1": TablePose(0.05, 0.06, 0.4),
    "nut_1": TablePose(0.11, 0.17, -1.1),
    "screw_2": TablePose(0.16, 0.05, 2.9),
    "screw_3": TablePose(0.19, 0.13, -2.2),
    "nut_2": TablePose(0.22, 0.20, 1.6),
    "nut_3": TablePose(0.25, 0.08, 0.0),
}


if __name__ == "__main__":
    asyncio.run(main())
