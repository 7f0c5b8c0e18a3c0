"""Marks that a camera sees and a robot touches: what the wizards that use them have in common."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.calibration.codes import Code
from smartcam.calibration.wizards.sequence import ask
from smartcam.calibration.wizards.steps import Flag, Number, Option, Step
from smartcam.exceptions import CalibrationError
from smartcam.models import Localization, Pose, Quaternion

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.calibration.wizards.sequence import Answer
    from smartcam.calibration.wizards.steps import Answers, Input

__all__ = [
    "MAX_MARKS",
    "SIGMA",
    "UNIT",
    "UNITS",
    "Localize",
    "Mark",
    "ReadRobot",
    "Station",
    "Touch",
    "Touched",
    "choose",
    "touch",
    "with_default",
]

MAX_MARKS = 25
"""Marks of one picture that can be touched: 5 x 5."""

Localize = Callable[[], Awaitable[list[Localization]]]
"""Takes a picture and returns what was found in it."""

ReadRobot = Callable[[], Awaitable[Pose]]
"""Returns where the robot's tip is, in the robot's base, metres; its z points out of the tool."""

UNITS: Mapping[str, float] = {"mm": 1e-3, "m": 1.0}
"""Metres, by the units that coordinates of the robot may be typed in."""

UNIT = Option(
    name="unit",
    label="Unit of the robot's coordinates",
    options={"mm": "millimetres", "m": "metres"},
)
"""Asks for one of :data:`UNITS`."""

SIGMA = Number(
    name="touch_sigma",
    label="How well a touch repeats, standard deviation; empty if not known",
    unit="mm",
    minimum=1e-4,
    maximum=100.0,
    optional=True,
)
"""Asks for a touch's sigma."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Mark:
    """A mark as the camera sees it.

    Attributes:
        feature: its name; may be empty.
        x: in the camera's unit.
        y: in the camera's unit.
        theta: radians.
    """

    feature: str
    x: float
    y: float
    theta: float

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> Mark:
        """Return the mark of a row that :meth:`Station.picture` gave."""
        return cls(row["feature_id"], row["x"], row["y"], row["theta"])

    def __str__(self) -> str:
        name = self.feature if self.feature.isprintable() else repr(self.feature)
        return f"{name or 'mark'} at x {self.x:.6g}, y {self.y:.6g}"


@dataclass(slots=True)
class Touch:
    """A touch.

    Attributes:
        mark: what the camera sees of it; of a ray its origin.
        robot: where the tip was, in the robot's base, metres.
        tool_z: where the tool pointed; None if that is not known.
        what: ``mark``, or the letter of a point of the rays.
    """

    mark: Mark
    robot: Vector
    tool_z: Vector | None
    what: str = "mark"


@dataclass(frozen=True, slots=True, kw_only=True)
class Station:
    """A camera and a robot, as a wizard uses them.

    Attributes:
        localize: takes a picture.
        read_robot: reads the robot's pose; None: it is typed.
        feature: only localizations of this name are marks; empty: all of them.
        y_down: whether ``localize`` turns the camera's y axis, which points down, up; None: not
            known.
    """

    localize: Localize
    read_robot: ReadRobot | None
    feature: str = ""
    y_down: bool | None = None

    async def picture(self, _answers: Answers) -> list[dict[str, Any]]:
        """Take a picture: the action of a step.

        Returns:
            A row for each mark: ``feature_id, quality, photo_index, frame_id, x, y, theta,
            y_down``.

        Raises:
            CalibrationError: TOO_FEW: no mark; SHAPE: more than :data:`MAX_MARKS`.

        Cancellation: as that of ``localize``.
        """
        found = await self.localize()
        rows = [
            {
                "feature_id": one.feature_id,
                "quality": one.quality,
                "photo_index": one.photo_index,
                "frame_id": one.pose.header.frame_id,
                "x": one.pose.position.x,
                "y": one.pose.position.y,
                "theta": one.pose.orientation.theta,
                "y_down": self.y_down,
            }
            for one in found
            if self.feature in {"", one.feature_id}
        ]
        if not 0 < len(rows) <= MAX_MARKS:
            wanted = f"{self.feature!r} " if self.feature else ""
            raise CalibrationError(
                f"the camera found {len(rows)} marks {wanted}among {len(found)} localizations; "
                f"expected 1 to {MAX_MARKS}",
                code=Code.TOO_FEW if not rows else Code.SHAPE,
                got=len(rows),
            )
        return rows

    def check_y_down(self, before: bool | None, what: str) -> None:
        """Raise where the camera's y axis is taken another way than before.

        Args:
            before: how it was taken then; None: not known.
            what: what was made then, for people.

        Raises:
            CalibrationError: MIRRORED.
        """
        if None not in {before, self.y_down} and before != self.y_down:
            raise CalibrationError(
                f"{what} with y_down={before}, now it is {self.y_down}, and everything would be "
                f"mirrored; expected y_down={before}",
                code=Code.MIRRORED,
                got=self.y_down,
                expected=before,
            )

    async def touch(
        self,
        step_id: str,
        title: str,
        what: str,
        mark: Mark,
        *,
        unit: str,
        tool_z: Vector | None = None,
        preview: Mapping[str, Any] | None = None,
    ) -> Touch:
        """Ask for a touch.

        Args:
            step_id: of the step.
            title: of the step.
            what: what is to be touched, for people.
            mark: what the camera sees of it.
            unit: of what is typed, one of :data:`UNITS`.
            tool_z: where the tool points when its position is typed.
            preview: of the step.
        """
        step = Step(
            id=step_id,
            title=title,
            description=f"Move the tip of the tool onto {what}, with the tool held as at every "
            "touch.",
            preview=preview,
        )
        touched = await touch(step, self.read_robot, unit=unit, tool_z=tool_z)
        return Touch(mark, touched.robot, touched.tool_z)


class Touched(NamedTuple):
    """What :func:`touch` gives.

    Attributes:
        answer: of the step.
        robot: where the tip was, in the robot's base, metres.
        tool_z: where the tool pointed; None if that is not known.
    """

    answer: Answer
    robot: Vector
    tool_z: Vector | None


async def touch(
    step: Step, read_robot: ReadRobot | None, *, unit: str, tool_z: Vector | None = None
) -> Touched:
    """Ask for a touch.

    Args:
        step: says what is to be touched; where the robot is not read, ``x, y, z`` are asked for
            behind its inputs.
        read_robot: reads the robot's pose; None: it is typed.
        unit: of what is typed, one of :data:`UNITS`.
        tool_z: where the tool points when its position is typed.
    """
    if read_robot is not None:
        answer = await ask(replace(step, button="It is there"), partial(_read, read_robot))
        x, y, z = answer.outcome["position"]
        return Touched(answer, (x, y, z), _axis_z(Quaternion(*answer.outcome["orientation"])))
    place = tuple(Number(name=axis, label=axis, unit=unit) for axis in "xyz")
    about = f"{step.description} Then take its position from the robot, in its base."
    answer = await ask(replace(step, description=about, inputs=(*step.inputs, *place)))
    x, y, z = (answer[axis] * UNITS[unit] for axis in "xyz")
    return Touched(answer, (x, y, z), tool_z)


async def _read(read_robot: ReadRobot, _answers: Answers) -> dict[str, Any]:
    pose = await read_robot()
    return {"position": list(pose.position), "orientation": list(pose.orientation)}


async def choose(marks: list[Mark]) -> list[Mark]:
    """Ask which marks will be touched, where there are several."""
    if len(marks) == 1:
        return marks
    flags = tuple(
        Flag(name=f"mark_{number}", label=f"{number}: {mark}", default=True)
        for number, mark in enumerate(marks, 1)
    )
    answer = await ask(Step(id="which", title="Which ones will be touched?", inputs=flags))
    return [mark for flag, mark in zip(flags, marks, strict=True) if answer[flag.name]]


def with_default(one: Input, parameters: Mapping[str, Any]) -> Input:
    """Return an input with the parameter of its name as its default, where there is one.

    Raises:
        CalibrationError: WRONG_ANSWERS: the parameter is no answer to it.
    """
    value = parameters.get(one.name)
    if value is None:
        return one
    try:
        return replace(one, default=one.checked(value))
    except ValueError as exc:
        raise CalibrationError(
            f"parameter {one.name}: {exc}", code=Code.WRONG_ANSWERS, got={one.name: str(exc)}
        ) from exc


def _axis_z(q: Quaternion) -> Vector:
    """Return where a turned z axis points."""
    x, y, z, w = q
    return 2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z
