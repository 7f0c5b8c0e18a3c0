"""The wizard that calibrates a smart camera's plane against a robot.

Two ways: *marks*, where each mark that the camera sees is touched with the robot's tip, as many as
one likes; and *rays*, the thesis' way, where the origin mark and one point on each of the printed
rays A and B are touched. It knows no client and no robot: it is given what takes a picture and, if
the robot can be asked, what reads its pose.

Source: thesis 3.2.2 to 3.2.4 (published) for the rays.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

from smartcam.calibration.codes import Code
from smartcam.calibration.sequence import Wizard, ask
from smartcam.calibration.steps import Flag, Number, Option, Step, Text
from smartcam.calibration.store import write
from smartcam.exceptions import CalibrationError
from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from smartcam.calibration.plane import PlaneCalibration
    from smartcam.calibration.sequence import Answer
    from smartcam.calibration.steps import Answers

__all__ = ["KIND", "MAX_MARKS", "MAX_POINTS", "RULER", "Localize", "ReadRobot", "plane_wizard"]

KIND = "plane"
"""What the store calls a calibration of a plane."""

MAX_MARKS = 25
"""Marks of one picture that can be touched: 5 x 5."""

MAX_POINTS = 200
"""Touches of a calibration."""

RULER = 100.0
"""Length of the ruler on the sheet, mm."""

Localize = Callable[[], Awaitable[list[Localization]]]
"""Takes a picture and returns what was found in it."""

ReadRobot = Callable[[], Awaitable[Pose]]
"""Returns where the robot's tip is, in the robot's base, metres; its z points out of the tool."""

_SIDES: Mapping[str, tuple[float, float, float] | None] = {
    "-z": (0.0, 0.0, -1.0),
    "+z": (0.0, 0.0, 1.0),
    "-x": (-1.0, 0.0, 0.0),
    "+x": (1.0, 0.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "unknown": None,
}
_UNITS = {"mm": 1e-3, "m": 1.0}


def plane_wizard(
    *, localize: Localize, save_to: Callable[[str], Path], read_robot: ReadRobot | None = None
) -> Wizard:
    """Return the wizard.

    Its parameters: ``name`` (of the calibration; what ``save_to`` gets), and as defaults of the
    first step ``method`` (marks, rays), ``camera_unit`` (m, px), ``camera_frame``, ``robot_frame``,
    ``tool``, ``unit`` (mm, m), ``side``, ``touch_sigma`` (mm); ``feature``: only marks of this name
    count.

    Its result: ``name, file, model, points, residual_mm, held_out_mm, predicted_mm, remarks``.

    Args:
        localize: takes a picture.
        save_to: returns the file for a name.
        read_robot: reads the robot's pose; None: it is typed.
    """

    async def script(parameters: Mapping[str, Any]) -> Any:
        about = await ask(_about(parameters, typed=read_robot is None))
        work = _Work(
            about=about,
            name=str(parameters.get("name", "plane")),
            feature=str(parameters.get("feature") or ""),
            localize=localize,
            read_robot=read_robot,
        )
        calibration = await (work.rays() if about["method"] == "rays" else work.marks())
        file = save_to(work.name)
        await ask(
            Step(
                id="save",
                title=f"Save {work.name}",
                description="A calibration of that name is kept beside it as a backup.",
                button="Save",
                notes=tuple(_summary(calibration)),
                preview=work.preview(calibration),
            ),
            partial(work.save, file, calibration),
        )
        return {"name": work.name, "file": file.name, **_figures(calibration)}

    return Wizard(name="plane", version=1, script=script)


def _about(parameters: Mapping[str, Any], *, typed: bool) -> Step:
    side = Option(
        name="side",
        label="Where the tool points when it touches",
        options={name: _side_text(name) for name in _SIDES},
    )
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
        Option(
            name="unit",
            label="Unit of the robot's coordinates",
            options={"mm": "millimetres", "m": "metres"},
        ),
        *((side,) if typed else ()),
        Number(
            name="touch_sigma",
            label="How well a touch repeats, standard deviation; empty if not known",
            unit="mm",
            minimum=1e-4,
            maximum=100.0,
            optional=True,
        ),
    )
    return Step(
        id="about",
        title="Camera, robot and tool",
        description="The camera is fixed, and sees the plane that the robot works on. All touches "
        "are made with one tool, held the same way: then what is wrong with its tip is the same in "
        "all of them, and cancels out as long as parts are taken like that.",
        inputs=tuple(_with_default(one, parameters) for one in inputs),
    )


def _with_default(one: Any, parameters: Mapping[str, Any]) -> Any:
    value = parameters.get(one.name)
    if value is None:
        return one
    try:
        return replace(one, default=one.checked(value))
    except ValueError as exc:
        raise CalibrationError(
            f"parameter {one.name}: {exc}", code=Code.WRONG_ANSWERS, got={one.name: str(exc)}
        ) from exc


def _side_text(name: str) -> str:
    return {"-z": "down: -z of the robot", "unknown": "not known"}.get(name, f"{name} of the robot")


@dataclass(frozen=True, slots=True)
class _Mark:
    feature: str
    x: float
    y: float
    theta: float

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> _Mark:
        return cls(row["feature_id"], row["x"], row["y"], row["theta"])

    def __str__(self) -> str:
        name = self.feature if self.feature.isprintable() else repr(self.feature)
        return f"{name or 'mark'} at x {self.x:.6g}, y {self.y:.6g}"


@dataclass(slots=True)
class _Point:
    mark: _Mark
    robot: tuple[float, float, float]
    tool_z: tuple[float, float, float] | None
    what: str = "mark"


class _Work:
    """One run of the wizard; holds nothing but what the answers gave."""

    def __init__(
        self,
        *,
        about: Answer,
        name: str,
        feature: str,
        localize: Localize,
        read_robot: ReadRobot | None,
    ) -> None:
        self.name = name
        self._about = about
        self._feature = feature
        self._localize = localize
        self._read_robot = read_robot
        self._marks: list[_Mark] = []
        self._points: list[_Point] = []

    # ------------------------------------------------------------------ what is done

    async def picture(self, _answers: Answers) -> list[dict[str, Any]]:
        found = await self._localize()
        rows = [
            {
                "feature_id": one.feature_id,
                "quality": one.quality,
                "photo_index": one.photo_index,
                "x": one.pose.position.x,
                "y": one.pose.position.y,
                "theta": one.pose.orientation.theta,
            }
            for one in found
            if self._feature in {"", one.feature_id}
        ]
        if not 0 < len(rows) <= MAX_MARKS:
            wanted = f"{self._feature!r} " if self._feature else ""
            raise CalibrationError(
                f"the camera found {len(rows)} marks {wanted}among {len(found)} localizations; "
                f"expected 1 to {MAX_MARKS}",
                code=Code.TOO_FEW if not rows else Code.SHAPE,
                got=len(rows),
            )
        return rows

    async def _read(self, _answers: Answers) -> dict[str, Any]:
        if self._read_robot is None:
            return {}
        pose = await self._read_robot()
        return {"position": list(pose.position), "orientation": list(pose.orientation)}

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

    async def _touch(self, step_id: str, title: str, what: str, mark: _Mark) -> _Point:
        unit = self._about["unit"]
        where = f"Move the tip of the tool onto {what}, with the tool held as at every touch."
        if self._read_robot is not None:
            step = Step(
                id=step_id,
                title=title,
                description=where,
                button="It is there",
                preview=self._before(mark),
            )
            outcome = (await ask(step, self._read)).outcome
            x, y, z = outcome["position"]
            return _Point(mark, (x, y, z), _axis_z(Quaternion(*outcome["orientation"])))
        step = Step(
            id=step_id,
            title=title,
            description=f"{where} Then take its position from the robot, in its base.",
            inputs=tuple(Number(name=axis, label=axis, unit=unit) for axis in "xyz"),
            preview=self._before(mark),
        )
        answer = await ask(step)
        x, y, z = (answer[axis] * _UNITS[unit] for axis in "xyz")
        return _Point(mark, (x, y, z), _SIDES[self._about["side"]])

    async def _choose(self, marks: list[_Mark], *, one: bool) -> list[_Mark]:
        if len(marks) == 1:
            return marks
        if one:
            options = {str(number): f"{mark}" for number, mark in enumerate(marks, 1)}
            inputs = (Option(name="mark", label="The origin mark", options=options),)
            step = Step(id="which", title="Which one is the origin?", inputs=inputs)
            return [marks[int((await ask(step))["mark"]) - 1]]
        flags = tuple(
            Flag(name=f"mark_{number}", label=f"{number}: {mark}", default=True)
            for number, mark in enumerate(marks, 1)
        )
        answer = await ask(Step(id="which", title="Which ones will be touched?", inputs=flags))
        return [mark for flag, mark in zip(flags, marks, strict=True) if answer[flag.name]]

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
        rows = (await ask(step, self.picture)).outcome
        origin = (await self._choose([_Mark.of(row) for row in rows], one=True))[0]
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
                notes=tuple(_summary(calibration)),
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
            choice = await ask(self._review(calibration, notes))
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
        rows = (await ask(step, self.picture)).outcome
        marks = await self._choose([_Mark.of(row) for row in rows], one=False)
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

    def _review(self, calibration: PlaneCalibration | None, notes: Sequence[str]) -> Step:
        count = len(self._points)
        options = {
            "accept": "accept it",
            "more": "take another picture, for more points",
            "redo": "touch a point again",
            "remove": "remove a point",
        }
        worst = 1
        if calibration is None:
            del options["accept"]
        else:
            worst = int(calibration.worst) + 1
        return Step(
            id="review",
            title="What came out",
            notes=tuple(notes),
            inputs=(
                Option(name="next", label="What next", options=options),
                Number(
                    name="point",
                    label="Point, for the last two; the worst one stands there",
                    integer=True,
                    minimum=1,
                    maximum=count,
                    default=worst,
                ),
            ),
            preview=self.preview(calibration),
        )

    # ------------------------------------------------------------------ numbers

    def _tool_z(self) -> list[float] | None:
        axes = [one.tool_z for one in self._points if one.tool_z is not None]
        if not axes:
            return None
        return [math.fsum(axis[i] for axis in axes) / len(axes) for i in range(3)]

    def _sigma(self) -> float | None:
        sigma = self._about["touch_sigma"]
        return None if sigma is None else 1e-3 * sigma

    def _fit_rays(self, origin: _Mark, scale: float) -> PlaneCalibration:
        from smartcam.calibration.touches import fit_touches

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
        )

    def _try_fit(self) -> tuple[PlaneCalibration | None, list[str]]:
        from smartcam.calibration.plane import fit_plane

        try:
            calibration = fit_plane(
                [(one.mark.x, one.mark.y) for one in self._points],
                [one.robot for one in self._points],
                touch_sigma=self._sigma(),
                nominal_scale=1.0 if self._about["camera_unit"] == "m" else None,
                tool_z=self._tool_z(),
                robot_frame=self._about["robot_frame"],
                camera_frame=self._about["camera_frame"] or None,
            )
        except CalibrationError as exc:
            return None, [f"{exc.code}: {exc}"]
        return calibration, _summary(calibration)

    def _before(self, mark: _Mark) -> dict[str, Any] | None:
        """Return what a picture of a touch that is still to be made is drawn from."""
        if not self._marks:  # the camera does not see where rays are touched
            return None
        seen = [[one.x, one.y] for one in self._marks]
        return {**self.preview(None), "marks": seen, "next": [mark.x, mark.y]}

    def preview(self, calibration: PlaneCalibration | None) -> dict[str, Any]:
        """Return what a picture is drawn from; metres, along the axes of the plane."""
        points: list[dict[str, Any]] = [
            {
                "label": str(number) if one.what == "mark" else one.what,
                "feature": one.mark.feature,
                "camera": [one.mark.x, one.mark.y],
                "robot": list(one.robot),
            }
            for number, one in enumerate(self._points, 1)
        ]
        if calibration is None:
            return {"points": points}
        across = calibration.rotation.T
        centre = calibration.robot_points.mean(axis=0)
        known = calibration.touch_sigma is not None
        errors = calibration.covariance_at(calibration.camera_points) if known else None
        for index, point in enumerate(points):
            point["at"] = (across @ (calibration.robot_points[index] - centre)).tolist()
            point["residual"] = (across @ calibration.residuals[index]).tolist()
            held_out = (across @ calibration.leave_one_out[index]).tolist()
            point["held_out"] = None if math.isnan(sum(held_out)) else held_out
            point["covariance"] = (
                None if errors is None else (across @ errors[index] @ across.T)[:2, :2].tolist()
            )
        return {
            "points": points,
            "worst": int(calibration.worst),
            "camera_origin": (across @ (calibration.origin - centre)).tolist(),
            "robot_axes": across.T.tolist(),
        }


def _axis_z(q: Quaternion) -> tuple[float, float, float]:
    """Return where a turned z axis points."""
    x, y, z, w = q
    return 2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z


def _figures(calibration: PlaneCalibration) -> dict[str, Any]:
    residual = math.sqrt(float((calibration.residuals**2).sum(axis=1).mean()))
    held_out = calibration.held_out_error
    predicted = None
    if calibration.touch_sigma is not None:
        at_points = calibration.predicted_error(calibration.camera_points)
        predicted = 1e3 * math.sqrt(float((at_points**2).mean()))
    return {
        "model": calibration.model,
        "points": len(calibration.robot_points),
        "residual_mm": 1e3 * residual,
        "held_out_mm": None if held_out is None else 1e3 * held_out,
        "predicted_mm": predicted,
        "remarks": [[remark.code.value, remark.text] for remark in calibration.warnings],
    }


def _summary(calibration: PlaneCalibration) -> list[str]:
    """Return what people should know of a calibration, a line each."""
    figures = _figures(calibration)
    lines = [f"model {figures['model']} from {figures['points']} points"]
    lines.append(f"residual {figures['residual_mm']:.3f} mm rms: how well the points fit")
    if figures["held_out_mm"] is not None:
        lines.append(
            f"held-out error {figures['held_out_mm']:.3f} mm rms: each point against a "
            f"calibration from the others; the worst is point {calibration.worst + 1}"
        )
    if figures["predicted_mm"] is not None:
        lines.append(f"predicted error {figures['predicted_mm']:.3f} mm rms at the points")
    lines += [f"{code}: {text}" for code, text in figures["remarks"]]
    return lines
