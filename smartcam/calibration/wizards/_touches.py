"""Ask the user of a wizard for touches with a robot's tip."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.calibration.wizards._marks import Mark, Touch, Vector, ask_marks
from smartcam.calibration.wizards._sequence import ask
from smartcam.calibration.wizards._steps import Number, Option, Step
from smartcam.calibration.wizards._touch_previews import next_touch_preview
from smartcam.geometry._inside import Code
from smartcam.models import Pose, Quaternion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.calibration.wizards._sequence import StepAnswer
    from smartcam.calibration.wizards._steps import Answers
    from smartcam.geometry._inside import Array

ReadRobot = Callable[[], Awaitable[Pose]]
"""Function that returns the pose of the tool's tip in the robot's base, metres; the tip's z axis
points out of the tool."""

UNITS: Mapping[str, float] = {"mm": 1e-3, "m": 1.0}
"""Metres per unit, for the units in which coordinates of the robot may be typed."""

UNIT = Option(
    name="unit",
    label="Unit of the robot's coordinates",
    options={"mm": "millimetres", "m": "metres"},
)
"""Input for one of :data:`UNITS`."""

SIGMA = Number(
    name="touch_sigma",
    label="How well a touch repeats, standard deviation; empty if not known",
    unit="mm",
    minimum=1e-4,
    maximum=100.0,
    optional=True,
)
"""Input for a touch's sigma."""

ALLOWED = Number(
    name="allowed",
    label="Largest error that is good enough; empty: a hundredth of the touched field",
    unit="mm",
    minimum=1e-3,
    maximum=1e4,
    optional=True,
)
"""Input for the allowed error."""

SIDES: Mapping[str, Vector | None] = {
    "-z": (0.0, 0.0, -1.0),
    "+z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "+x": (1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "unknown": None,
}
"""Directions of a tool's axis in the robot's base, by the names that people choose."""

SIDE = Option(
    name="side",
    label="Where the tool points when it touches",
    options={name: f"{name} of the robot" for name in SIDES}
    | {"-z": "down: -z of the robot", "unknown": "not known"},
)
"""Input for one of :data:`SIDES`."""


@dataclass(eq=False)
class Touches:
    """Touches of one run of a wizard; answers and outcomes of steps determine the whole state.

    Attributes:
        about: answers of the first step: ``touch_sigma``, and, if the robot's pose is typed,
            ``unit`` and ``side``.
        marks: marks of the last picture.
        camera_unit: unit of the camera's positions.
        side: one of :data:`SIDES`, the direction of the tool, for robots whose pose is typed.
    """

    about: StepAnswer
    _read_robot: ReadRobot | None  # None if the robot's pose is typed
    camera_unit: str = field(default="m", init=False)

    def __post_init__(self) -> None:
        self.touches: list[Touch] = []
        self.marks: Sequence[Mark] = ()
        self.side = str(self.about.get("side", "unknown"))

    @property
    def tip_positions(self) -> list[Vector]:
        """Positions of the tip at the touches, metres."""
        return [touch.robot for touch in self.touches]

    @property
    def tool_z(self) -> Array | None:
        """Mean direction of the tool's axis; None if it is not known."""
        axes = [touch.tool_z for touch in self.touches if touch.tool_z is not None]
        return np.mean(axes, axis=0) if axes else None

    @property
    def sigma(self) -> float | None:
        """Standard deviation of a touch, metres; None if it is not known."""
        sigma = self.about["touch_sigma"]
        return None if sigma is None else 1e-3 * sigma

    def check_count(self, more: int, max_count: int, noun: str) -> None:
        """Raise SHAPE if ``more`` touches would be too many."""
        count = len(self.touches) + more
        if count > max_count:
            raise Code.SHAPE.error(
                f"{count} {noun}, expected {max_count} at most", max_count, count
            )

    async def add_marks(self, rows: Sequence[Mapping[str, Any]], max_count: int, noun: str) -> None:
        """Ask which marks of a picture will be touched, then for their touches.

        ``rows``: result of :meth:`~smartcam.calibration.wizards._marks.MarkCamera.take_marks`.
        ``max_count``: largest number of touches of a run; raises SHAPE for more. ``noun``: name of
        the points, for people.
        """
        marks = await ask_marks([Mark.of(row) for row in rows], self.camera_unit)
        self.check_count(len(marks), max_count, noun)
        self.marks = marks
        for number, mark in enumerate(marks, 1):
            title = f"Touch mark {number} of {len(marks)}"
            place = mark.text(self.camera_unit)
            self.touches.append(await self.ask_mark_touch(f"touch-{number}", title, place, mark))

    async def ask_mark_touch(
        self, step_id: str, title: str, place: str, mark: Mark, label: str = "mark"
    ) -> Touch:
        """Ask for a touch.

        ``place``: text that names the place to touch. ``mark``: the camera's mark at this place.
        ``label``: label of the :class:`Touch`.
        """
        description = f"Move the tip of the tool onto {place}, with the tool held as at every touch"
        step = Step(
            id=step_id, title=title, description=f"{description}.", **self.step_extras(mark)
        )
        return await self.ask_touch(step, lambda _: mark, label)

    def step_extras(self, mark: Mark) -> dict[str, Any]:
        """Return the ``preview`` of a step that asks for a touch; a subclass may add ``notes``."""
        return {"preview": next_touch_preview(self.touches, self.marks, mark)}

    async def ask_touch(
        self, step: Step, mark_of: Callable[[StepAnswer], Mark], label: str = "mark"
    ) -> Touch:
        """Ask for a touch by a step that names the point.

        ``mark_of``: function that returns the mark for the step's answer.

        If the robot cannot be read, inputs for ``x, y, z`` follow the inputs of the step.
        """
        if self._read_robot is not None:
            answer = await ask(
                replace(step, button="It is there"), partial(_read_pose, self._read_robot)
            )
            x, y, z = answer.outcome["position"]
            axis = _axis_z(Quaternion(*answer.outcome["orientation"]))
            return Touch(mark_of(answer), (x, y, z), axis, label)
        unit = self.about.get("unit", "m")
        position_inputs = tuple(Number(name=axis, label=axis, unit=unit) for axis in "xyz")
        text = f"{step.description} Then read the tip's position, in the robot's base."
        answer = await ask(replace(step, description=text, inputs=(*step.inputs, *position_inputs)))
        x, y, z = (answer[axis] * UNITS[unit] for axis in "xyz")
        return Touch(mark_of(answer), (x, y, z), SIDES[self.side], label)


async def _read_pose(read_robot: ReadRobot, _answers: Answers) -> dict[str, Any]:
    pose = await read_robot()
    return {"position": list(pose.position), "orientation": list(pose.orientation)}


def _axis_z(q: Quaternion) -> Vector:
    """Return the direction of the z axis after a rotation."""
    x, y, z, w = q
    return 2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z
