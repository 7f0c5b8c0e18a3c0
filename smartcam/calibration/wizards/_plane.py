"""The wizard that calibrates a smart camera's plane against a robot.

The camera localizes marks, and the robot's tip touches any number of them; or the camera localizes
the origin mark of the printed rays. The wizard does not depend on any client or robot: it is given
a function that takes a picture and, if the robot can be read, a function that reads the robot's
pose.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.calibration._plane.calibration import KIND, fit_plane
from smartcam.calibration._printing.page_layout import RULER_MM
from smartcam.calibration.wizards._marks import Mark, MarkCamera, clickable_preview
from smartcam.calibration.wizards._points import (
    MAX_POINTS,
    PointSource,
    about_step,
    plane_outcome,
)
from smartcam.calibration.wizards._sequence import Wizard, ask
from smartcam.calibration.wizards._steps import Number, Option, Step
from smartcam.calibration.wizards._target_steps import ruler_input

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from smartcam.calibration._plane.calibration import PlaneCalibration
    from smartcam.calibration.wizards._marks import Localize, Touch
    from smartcam.calibration.wizards._points import CalibrationOutcome
    from smartcam.calibration.wizards._sequence import StepAnswer
    from smartcam.calibration.wizards._steps import Answers
    from smartcam.calibration.wizards._touches import ReadRobot


def plane_wizard(
    *,
    localize: Localize,
    save_to: Callable[[str], Path],
    read_robot: ReadRobot | None = None,
    y_down: bool | None = None,
    connect: Mapping[str, Any] | None = None,
) -> Wizard:
    """Return the wizard of a plane calibration.

    Its parameters: ``name`` (of the calibration, passed to ``save_to``), and as defaults of the
    first step ``method`` (marks, rays), ``camera_unit`` (m, px), ``camera_frame``, ``robot_frame``,
    ``tool``, ``unit`` (mm, m), ``side``, ``touch_sigma`` (mm); ``feature``: only marks with this
    name count.

    Its result has the entries ``name``, ``file``, ``model``, ``points``, ``left_out`` (numbers of
    points, from 1), ``residual_mm``, ``held_out_mm``, ``predicted_mm``, ``remarks``, ``path`` (of
    the file), ``good_for_mm`` (error that 95 of 100 new points do not exceed; None: not known, or
    not good), and ``use`` (lines that use the result: ``command`` and ``python``). Points that were
    left out count in none of the errors.

    Args:
        localize: function that takes a picture and localizes marks in it.
        save_to: function that returns the file for a name.
        read_robot: function that reads the robot's pose; None: the pose is typed.
        y_down: whether the camera's own y axis points down; ``localize`` then reverses y; None: not
            known. The value is stored with the calibration, and must be the same for all pictures.
        connect: arguments of :func:`smartcam.connect` for the camera, ``url`` included, for the
            lines that use the result; None: the camera cannot be asked.
    """

    async def script(parameters: Mapping[str, Any]) -> Any:
        feature = str(parameters.get("feature") or "")
        camera = MarkCamera(localize=localize, feature=feature, y_down=y_down)
        step = about_step(
            "The camera is fixed, and sees the plane that the robot works on. All touches are made "
            "with one tool, held the same way: then the error of its tip is the same in all "
            "of them, and cancels out as long as the robot picks with the tool held like that.",
            {
                "marks": "each mark that the camera sees; 9 over the whole field are good",
                "rays": "the origin mark and a point on each of the rays A and B of its sheet",
            },
            parameters,
            Option(
                name="camera_unit",
                label="Unit of the camera's positions",
                options={"m": "metres, as its own calibration gives them", "px": "pixels"},
            ),
            typed=read_robot is None,
        )
        about = await ask(step)
        source = _MarkSource(about, read_robot, camera)
        source.connect = connect
        return await source.run(str(parameters.get("name", KIND)), save_to)

    return Wizard(name=KIND, version=1, script=script, steps=9)


class _MarkSource(PointSource):
    """Marks that a camera localizes."""

    KIND = KIND
    POINTS = "marks"
    ORIGIN = "the origin mark"
    MORE = "take another picture, for more points"

    def __init__(self, about: StepAnswer, read_robot: ReadRobot | None, camera: MarkCamera) -> None:
        super().__init__(about, read_robot)
        self.camera_frame = about["camera_frame"] or None
        self.camera_unit = about["camera_unit"]
        self._camera = camera

    async def add_points(self) -> None:
        done = len(self.touches)
        step = Step(
            id="picture",
            title="Marks in the camera's field",
            description="Lay one mark or several where the camera sees them, over the whole field "
            "and at the height where parts lie; the robot must not hide them. They must not move "
            "until they have been touched.",
            button="Take a picture",
            notes=(f"{done} points so far",) if done else (),
        )
        await self.add_marks(await self._ask_for_picture(step), MAX_POINTS, "points")

    async def ask_again(self, index: int) -> None:
        mark = self.touches[index].mark
        title = f"Touch point {index + 1} again"
        self.touches[index] = await self.ask_mark_touch(
            "redo", title, mark.text(self.camera_unit), mark
        )

    async def find_ray_origin(self) -> tuple[Mark, float]:
        scale = await self._nominal_scale()
        step = Step(
            id="origin",
            title="The origin mark",
            description="Lay the calibration sheet into the camera's field and fix it. The robot "
            "must not hide the origin mark.",
            button="Take a picture",
        )
        marks = [Mark.of(row) for row in await self._ask_for_picture(step)]
        if len(marks) == 1:
            return marks[0], scale
        unit = self.camera_unit
        options = {str(number): mark.text(unit) for number, mark in enumerate(marks, 1)}
        step = Step(
            id="which",
            title="Which one is the origin?",
            inputs=(Option(name="mark", label="The origin mark", options=options),),
            preview=clickable_preview(marks, [{"mark": number} for number in options]),
        )
        return marks[int((await ask(step))["mark"]) - 1], scale

    async def _nominal_scale(self) -> float:
        """Ask for the metres per unit of the camera, since touches of rays do not tell them."""
        if self.camera_unit == "px":
            label = "Size of a pixel on the plane"
            pixel = Number(name="pixel", label=label, unit="mm", minimum=1e-6, maximum=100.0)
            step = Step(id="scale", title="Scale", inputs=(pixel,))
            return 1e-3 * float((await ask(step))["pixel"])
        step = Step(
            id="scale",
            title="Was the sheet printed true to size?",
            description="Printers often change the size. The camera's metres assume that the sheet "
            "has its nominal size; the printed ruler shows the true one.",
            inputs=(ruler_input("ruler"),),
        )
        return float((await ask(step))["ruler"]) / RULER_MM

    async def _ask_for_picture(self, step: Step) -> Sequence[Mapping[str, Any]]:
        """Ask for a picture, and remember the direction of the camera's y axis."""
        rows: Sequence[Mapping[str, Any]] = (await ask(step, self._take_checked_picture)).outcome
        directions = [row.get("y_down") for row in rows]
        self.y_down = next(
            (direction for direction in directions if direction is not None), self.y_down
        )
        return rows

    async def _take_checked_picture(self, answers: Answers) -> list[dict[str, Any]]:
        self._camera.check_y_down(self.y_down, "the previous picture")
        return await self._camera.take_marks(answers)

    def fit(self, *, robust: bool) -> PlaneCalibration:
        return fit_plane(
            [(touch.mark.x, touch.mark.y) for touch in self.touches],
            self.tip_positions,
            touch_sigma=self.sigma,
            nominal_scale=1.0 if self.camera_unit == "m" else None,
            tool_z=self.tool_z,
            robust=robust,
            robot_frame=self.about["robot_frame"],
            camera_frame=self.camera_frame,
            y_down=self.y_down,
        )

    def sample_entries(self, touch: Touch) -> dict[str, Any]:
        mark = touch.mark
        camera = [mark.x, mark.y, mark.theta]
        return {"touched": touch.label, "feature_id": mark.feature, "camera": camera}

    def example_point(self) -> tuple[float, float]:
        mark = self.touches[0].mark
        return mark.x, mark.y

    def calibration_outcome(self, plane: PlaneCalibration) -> CalibrationOutcome:
        return plane_outcome(plane)
