"""The wizard that calibrates a smart camera's plane against a robot.

Two ways: *marks*, where each mark that the camera sees is touched with the robot's tip, as many as
one likes; and *rays*, the thesis' way, where the origin mark and one point on each of the printed
rays A and B are touched. It knows no client and no robot: it is given what takes a picture and, if
the robot can be asked, what reads its pose.

Source: thesis 3.2.2 to 3.2.4 (published) for the rays.
"""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

from smartcam.calibration.codes import Code
from smartcam.calibration.files.store import write
from smartcam.calibration.plane.robust import LEAST_POINTS
from smartcam.calibration.wizards.marks import (
    SIGMA,
    UNIT,
    Mark,
    Station,
    Touch,
    choose,
    with_default,
)
from smartcam.calibration.wizards.plane_drawing import before, compared, plain
from smartcam.calibration.wizards.sequence import Wizard, ask
from smartcam.calibration.wizards.steps import Number, Option, Step, Text
from smartcam.exceptions import CalibrationError
from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from smartcam.calibration.plane.calibration import PlaneCalibration
    from smartcam.calibration.wizards.marks import Localize, ReadRobot
    from smartcam.calibration.wizards.sequence import Answer
    from smartcam.calibration.wizards.steps import Answers

__all__ = [
    "KIND",
    "MAX_POINTS",
    "RULER",
    "SIDES",
    "figures",
    "plane_wizard",
    "review",
    "side",
    "summary",
]

KIND = "plane"
"""What the store calls a calibration of a plane."""

MAX_POINTS = 200
"""Touches of a calibration."""

RULER = 100.0
"""Length of the ruler on the sheet, mm."""

SIDES: Mapping[str, tuple[float, float, float] | None] = {
    "-z": (0.0, 0.0, -1.0),
    "+z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "+x": (1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "unknown": None,
}
"""Directions of a tool's axis in the robot's base, by what people choose."""

_SIGNS_OF_OUTLIERS = frozenset({Code.OUTLIER, Code.POOR_FIT, Code.NOT_PLANAR})
"""Warnings after which points may be left out; two that are wrong can hide each other."""


def plane_wizard(
    *,
    localize: Localize,
    save_to: Callable[[str], Path],
    read_robot: ReadRobot | None = None,
    y_down: bool | None = None,
) -> Wizard:
    """Return the wizard.

    Its parameters: ``name`` (of the calibration; what ``save_to`` gets), and as defaults of the
    first step ``method`` (marks, rays), ``camera_unit`` (m, px), ``camera_frame``, ``robot_frame``,
    ``tool``, ``unit`` (mm, m), ``side``, ``touch_sigma`` (mm); ``feature``: only marks of this name
    count.

    Its result: ``name, file, model, points, left_out`` (numbers of points, from 1)``, residual_mm,
    held_out_mm, predicted_mm, remarks``. Points left out count in none of the errors.

    Args:
        localize: takes a picture.
        save_to: returns the file for a name.
        read_robot: reads the robot's pose; None: it is typed.
        y_down: whether ``localize`` turns the camera's y axis, which points down, up; None: not
            known. It is kept with the calibration, and the same for all of its pictures.
    """

    async def script(parameters: Mapping[str, Any]) -> Any:
        about = await ask(_about(parameters, typed=read_robot is None))
        work = _Work(
            about=about,
            name=str(parameters.get("name", "plane")),
            station=Station(
                localize=localize,
                read_robot=read_robot,
                feature=str(parameters.get("feature") or ""),
                y_down=y_down,
            ),
        )
        calibration = await (work.rays() if about["method"] == "rays" else work.marks())
        file = save_to(work.name)
        await ask(
            Step(
                id="save",
                title=f"Save {work.name}",
                description="A calibration of that name is kept beside it as a backup.",
                button="Save",
                notes=tuple(summary(calibration)),
                preview=work.preview(calibration),
            ),
            partial(work.save, file, calibration),
        )
        return {"name": work.name, "file": file.name, **figures(calibration)}

    return Wizard(name="plane", version=1, script=script)


def _about(parameters: Mapping[str, Any], *, typed: bool) -> Step:
    inputs = (
        Option(
            name="method",
            label="What is touched",
            options={
                "marks": "each mark that the camera sees; 9 over the whole field are good",
                "rays": "the origin mark and a point on each of the rays A and B of its sheet",
            },
        ),
        Option(
            name="camera_unit",
            label="Unit of the camera's positions",
            options={"m": "metres, as its own calibration gives them", "px": "pixels"},
        ),
        Text(
            name="camera_frame",
            label="Name of the only frame that localizations may come in; empty: any",
            default="",
        ),
        Text(name="robot_frame", label="Name of the robot's frame", default="robot"),
        Text(name="tool", label="Which tool touches", default=""),
        UNIT,
        *((side(),) if typed else ()),
        SIGMA,
    )
    return Step(
        id="about",
        title="Camera, robot and tool",
        description="The camera is fixed, and sees the plane that the robot works on. All touches "
        "are made with one tool, held the same way: then what is wrong with its tip is the same in "
        "all of them, and cancels out as long as parts are taken like that.",
        inputs=tuple(with_default(one, parameters) for one in inputs),
    )


async def _choose_origin(marks: list[Mark]) -> Mark:
    if len(marks) == 1:
        return marks[0]
    options = {str(number): f"{mark}" for number, mark in enumerate(marks, 1)}
    inputs = (Option(name="mark", label="The origin mark", options=options),)
    step = Step(id="which", title="Which one is the origin?", inputs=inputs)
    return marks[int((await ask(step))["mark"]) - 1]


def side() -> Option:
    """Return what asks for one of :data:`SIDES`."""
    return Option(
        name="side",
        label="Where the tool points when it touches",
        options={name: _side_text(name) for name in SIDES},
    )


def _side_text(name: str) -> str:
    return {"-z": "down: -z of the robot", "unknown": "not known"}.get(name, f"{name} of the robot")


class _Work:
    """One run of the wizard; holds nothing but what the answers gave."""

    def __init__(
        self,
        *,
        about: Answer,
        name: str,
        station: Station,
    ) -> None:
        self.name = name
        self._about = about
        self._station = station
        self._marks: list[Mark] = []
        self._points: list[Touch] = []
        self._y_down: bool | None = None
        self._robust = False

    # ------------------------------------------------------------------ what is done

    async def _picture(self, answers: Answers) -> list[dict[str, Any]]:
        self._station.check_y_down(self._y_down, "the picture before was taken")
        return await self._station.picture(answers)

    def _seen(self, rows: Sequence[Mapping[str, Any]]) -> list[Mark]:
        """Return the marks of a picture, and remember which way its y axis was taken."""
        told = [row.get("y_down") for row in rows]
        self._y_down = next((one for one in told if one is not None), self._y_down)
        return [Mark.of(row) for row in rows]

    async def save(
        self, file: Path, calibration: PlaneCalibration, _answers: Answers
    ) -> dict[str, Any]:
        about = self._about
        context = {
            "frames": {"camera": about["camera_frame"] or None, "robot": about["robot_frame"]},
            "camera_unit": about["camera_unit"],
            "tool": about["tool"],
            "method": about["method"],
            "samples": [
                {
                    "touched": one.what,
                    "feature_id": one.mark.feature,
                    "camera": [one.mark.x, one.mark.y, one.mark.theta],
                    "robot": list(one.robot),
                    "tool_z": None if one.tool_z is None else list(one.tool_z),
                }
                for one in self._points
            ],
        }
        write(file, KIND, calibration.to_data(), context=context)
        return {"file": file.name}

    # ------------------------------------------------------------------ steps

    async def _touch(self, step_id: str, title: str, what: str, mark: Mark) -> Touch:
        about = self._about
        return await self._station.touch(
            step_id,
            title,
            what,
            mark,
            unit=about["unit"],
            tool_z=SIDES[about["side"]] if "side" in about else None,
            preview=before(self._points, self._marks, mark),
        )

    async def _nominal_scale(self) -> float:
        """Ask for metres for each unit of the camera, which touches of rays do not tell."""
        if self._about["camera_unit"] == "px":
            pixel = Number(name="pixel", label="Size of a pixel on the plane", unit="mm")
            pixel = replace(pixel, minimum=1e-6, maximum=100.0)
            step = Step(id="scale", title="Scale", inputs=(pixel,))
            return 1e-3 * float((await ask(step))["pixel"])
        ruler = Number(
            name="ruler",
            label=f"Length of the printed ruler, which should be {RULER:g} mm",
            unit="mm",
            default=RULER,
            minimum=0.5 * RULER,
            maximum=2.0 * RULER,
        )
        step = Step(
            id="scale",
            title="Was the sheet printed true to size?",
            description="Printers scale. The camera took its metres from the sheet as it should "
            "be, so what the ruler really measures is the scale.",
            inputs=(ruler,),
        )
        return float((await ask(step))["ruler"]) / RULER

    async def rays(self) -> PlaneCalibration:
        scale = await self._nominal_scale()
        step = Step(
            id="origin",
            title="The origin mark",
            description="Lay the calibration sheet into the camera's field and fix it. The robot "
            "must not hide the origin mark.",
            button="Take a picture",
        )
        rows = (await ask(step, self._picture)).outcome
        origin = await _choose_origin(self._seen(rows))
        for letter, what in (
            ("O", "the origin mark"),
            ("A", "a point of ray A, as far out as it goes"),
            ("B", "a point of ray B, as far out as it goes"),
        ):
            point = await self._touch(f"touch-{letter}", f"Touch {letter}", what, origin)
            point.what = letter
            self._points.append(point)
        calibration = self._fit_rays(origin, scale)
        await ask(
            Step(
                id="review",
                title="What came out",
                description="Three touches fit any plane: nothing tells how good they were. To "
                "know, touch marks instead.",
                button="Accept",
                notes=tuple(summary(calibration)),
                preview=self.preview(calibration),
            )
        )
        return calibration

    async def marks(self) -> PlaneCalibration:
        picture = True
        while True:
            if picture:
                await self._take_marks()
            if len(self._points) < 3:
                continue
            calibration, notes = self._try_fit()
            step = review(
                calibration,
                notes,
                count=len(self._points),
                more="take another picture, for more points",
                robust=self._robust,
                preview=self.preview(calibration),
            )
            choice = await ask(step)
            index = choice["point"] - 1
            picture = choice["next"] == "more"
            match choice["next"]:
                case "accept" if calibration is not None:
                    return calibration
                case "redo":
                    mark = self._points[index].mark
                    self._points[index] = await self._touch(
                        "redo", f"Touch point {index + 1} again", str(mark), mark
                    )
                case "remove":
                    del self._points[index]
                    picture = len(self._points) < 3
                case "robust" | "all":
                    self._robust = choice["next"] == "robust"
                case _:
                    pass

    async def _take_marks(self) -> None:
        done = len(self._points)
        step = Step(
            id="picture",
            title="Marks in the camera's field",
            description="Lay one mark or several where the camera sees them, over the whole field "
            "and at the height where parts lie; the robot must not hide them. They must not move "
            "until they have been touched.",
            button="Take a picture",
            notes=(f"{done} points so far",) if done else (),
        )
        rows = (await ask(step, self._picture)).outcome
        marks = await choose(self._seen(rows))
        if done + len(marks) > MAX_POINTS:
            raise CalibrationError(
                f"{done + len(marks)} points, expected {MAX_POINTS} at most",
                code=Code.SHAPE,
                got=done + len(marks),
                expected=MAX_POINTS,
            )
        self._marks = marks
        for number, mark in enumerate(marks, 1):
            title = f"Touch mark {number} of {len(marks)}"
            self._points.append(await self._touch(f"touch-{number}", title, str(mark), mark))

    # ------------------------------------------------------------------ numbers

    def _tool_z(self) -> list[float] | None:
        axes = [one.tool_z for one in self._points if one.tool_z is not None]
        if not axes:
            return None
        return [math.fsum(axis[i] for axis in axes) / len(axes) for i in range(3)]

    def _sigma(self) -> float | None:
        sigma = self._about["touch_sigma"]
        return None if sigma is None else 1e-3 * sigma

    def _fit_rays(self, origin: Mark, scale: float) -> PlaneCalibration:
        from smartcam.calibration.plane.touches import fit_touches

        header = Header(0, datetime.fromtimestamp(0, UTC), self._about["camera_frame"])
        pose = Pose(header, Position(origin.x, origin.y), Quaternion.from_theta(origin.theta))
        o, a, b = (one.robot for one in self._points)
        return fit_touches(
            Localization(origin.feature, 1.0, 0, pose),
            o,
            a,
            b,
            nominal_scale=scale,
            touch_sigma=self._sigma(),
            tool_z=self._tool_z(),
            robot_frame=self._about["robot_frame"],
            camera_frame=self._about["camera_frame"] or None,
            y_down=self._y_down,
        )

    def _try_fit(self) -> tuple[PlaneCalibration | None, list[str]]:
        from smartcam.calibration.plane.calibration import fit_plane

        try:
            calibration = fit_plane(
                [(one.mark.x, one.mark.y) for one in self._points],
                [one.robot for one in self._points],
                touch_sigma=self._sigma(),
                nominal_scale=1.0 if self._about["camera_unit"] == "m" else None,
                tool_z=self._tool_z(),
                robust=self._robust and len(self._points) >= LEAST_POINTS,
                robot_frame=self._about["robot_frame"],
                camera_frame=self._about["camera_frame"] or None,
                y_down=self._y_down,
            )
        except CalibrationError as exc:
            return None, [f"{exc.code}: {exc}"]
        return calibration, summary(calibration)

    def preview(self, calibration: PlaneCalibration | None) -> dict[str, Any]:
        """Return what a picture is drawn from."""
        if calibration is None:
            return plain(self._points)
        return compared(
            calibration,
            self._points,
            calibration.camera_points,
            calibration.residuals,
            calibration.leave_one_out,
            worst=calibration.worst,
            left_out=calibration.outliers,
        )


def review(
    calibration: PlaneCalibration | None,
    notes: Sequence[str],
    *,
    count: int,
    more: str,
    robust: bool,
    preview: Mapping[str, Any] | None = None,
) -> Step:
    """Return the step that shows what came out of touches, and asks what next.

    Its answers: ``next`` (``accept``, ``more``, ``redo``, ``remove``, ``robust``, ``all``) and
    ``point``, from 1.

    Args:
        calibration: what came out; None: nothing did, and it cannot be accepted.
        notes: of the step.
        count: of touches.
        more: what the option ``more`` says.
        robust: whether points that do not agree are left out.
        preview: of the step.
    """
    options = {
        "accept": "accept it",
        "more": more,
        "redo": "touch a point again",
        "remove": "remove a point",
    }
    point = 1
    if calibration is None:
        del options["accept"]
    else:
        point = 1 + min(calibration.outliers, default=calibration.worst)
    if robust:
        options["all"] = "count all points, also those that do not agree with the others"
    elif count >= LEAST_POINTS and _doubtful(calibration):
        options["robust"] = "leave out the points that do not agree with the others"
    return Step(
        id="review",
        title="What came out",
        notes=tuple(notes),
        inputs=(
            Option(name="next", label="What next", options=options),
            Number(
                name="point",
                label="Point, to touch again or to remove; the worst one stands there",
                integer=True,
                minimum=1,
                maximum=count,
                default=point,
            ),
        ),
        preview=preview,
    )


def _doubtful(calibration: PlaneCalibration | None) -> bool:
    """Return whether a point or more may be wrong."""
    if calibration is None:
        return True
    return any(remark.code in _SIGNS_OF_OUTLIERS for remark in calibration.warnings)


def figures(calibration: PlaneCalibration) -> dict[str, Any]:
    """Return what a wizard's result says of a calibration, JSON-able; lengths in mm."""
    counted = calibration.weights > 0.0
    residual = math.sqrt(float((calibration.residuals[counted] ** 2).sum(axis=1).mean()))
    held_out = calibration.held_out_error
    predicted = None
    if calibration.touch_sigma is not None:
        at_points = calibration.predicted_error(calibration.camera_points[counted])
        predicted = 1e3 * math.sqrt(float((at_points**2).mean()))
    return {
        "model": calibration.model,
        "points": int(counted.sum()),
        "left_out": [1 + index for index in calibration.outliers],
        "residual_mm": 1e3 * residual,
        "held_out_mm": None if held_out is None else 1e3 * held_out,
        "predicted_mm": predicted,
        "remarks": [[remark.code.value, remark.text] for remark in calibration.warnings],
    }


def summary(calibration: PlaneCalibration) -> list[str]:
    """Return what people should know of a calibration, a line each."""
    found = figures(calibration)
    left_out = len(found["left_out"])
    of = f" of {found['points'] + left_out}" if left_out else ""
    lines = [f"model {found['model']} from {found['points']}{of} points"]
    lines.append(f"residual {found['residual_mm']:.3f} mm rms: how well the points fit")
    if found["held_out_mm"] is not None:
        lines.append(
            f"held-out error {found['held_out_mm']:.3f} mm rms: each point against a "
            f"calibration from the others; the worst is point {calibration.worst + 1}"
        )
    if found["predicted_mm"] is not None:
        lines.append(f"predicted error {found['predicted_mm']:.3f} mm rms at the points")
    lines += [f"{code}: {text}" for code, text in found["remarks"]]
    return lines
