"""The wizard that calibrates a camera's pixels against a robot, by a picture of a printed sheet.

It asks which target lies there and how long its rulers are, takes a picture and finds the target in
it; then the robot touches corners of the target, any number, or the origin and the rays A and B. It
knows no camera and no robot: it is given what takes a picture and, if the robot can be asked, what
reads its pose.

Source: thesis 3.2.3.2 (published) for the origin that a camera finds in its image.
"""

from __future__ import annotations

import asyncio
import math
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam.calibration.codes import Code
from smartcam.calibration.detection.find import find_target
from smartcam.calibration.files.cameras import camera_from_data, camera_to_data
from smartcam.calibration.files.hand_eye import view_from_data, view_to_data
from smartcam.calibration.files.store import write
from smartcam.calibration.plane.robust import LEAST_POINTS
from smartcam.calibration.plane.touches import fit_touches
from smartcam.calibration.sheet.calibration import (
    KIND,
    SheetCalibration,
    calibrate_sheet,
    fit_corners,
)
from smartcam.calibration.sheet.plane import look_at_sheet
from smartcam.calibration.targets import Charuco
from smartcam.calibration.wizards.marks import SIGMA, UNIT, Mark, Touch, touch, with_default
from smartcam.calibration.wizards.pictures import MAX_PREVIEW, PICTURE_TIMEOUT
from smartcam.calibration.wizards.plane import MAX_POINTS, SIDES, figures, review, side, summary
from smartcam.calibration.wizards.plane_drawing import compared, plain
from smartcam.calibration.wizards.sequence import Wizard, ask
from smartcam.calibration.wizards.sheet_drawing import draw_sheet, with_ring
from smartcam.calibration.wizards.steps import Number, Option, Step, Text
from smartcam.calibration.wizards.target_steps import ask_target
from smartcam.exceptions import CalibrationError
from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from smartcam.calibration.geometry.rotations import Array
    from smartcam.calibration.lens.model import CameraModel
    from smartcam.calibration.plane.calibration import PlaneCalibration
    from smartcam.calibration.targets import Target
    from smartcam.calibration.views import TargetView
    from smartcam.calibration.wizards.marks import ReadRobot
    from smartcam.calibration.wizards.pictures import TakePicture
    from smartcam.calibration.wizards.sequence import Answer
    from smartcam.calibration.wizards.steps import Answers

__all__ = ["FIRST", "sheet_wizard"]

FIRST: Final = 4
"""Corners that are touched before it is shown what came out."""

LEAST: Final = 3
"""Corners that a plane takes."""

_DIAGONALS: Final = ((-1.0, -1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, 1.0))
"""Directions in which the outermost points of a target lie, the origin first."""


def sheet_wizard(
    *,
    take_picture: TakePicture,
    save_to: Callable[[str], Path],
    read_robot: ReadRobot | None = None,
    suggested: Target | None = None,
    camera: CameraModel | None = None,
) -> Wizard:
    """Return the wizard.

    Its parameters: ``name`` (of the calibration; what ``save_to`` gets), and as defaults of the
    first step ``method`` (corners, rays), ``camera_frame``, ``robot_frame``, ``tool``, ``unit``
    (mm, m), ``side``, ``touch_sigma`` (mm).

    Its result: as the plane's, and ``seen`` (points of the target in the picture)``, rms_px``
    (of them about their plane); ``predicted_mm`` is at the points that were seen.

    Args:
        take_picture: takes a picture.
        save_to: returns the file for a name.
        read_robot: reads the robot's pose; None: it is typed.
        suggested: the target that lies there, as the default of what is asked.
        camera: the lens, kept with each picture; None: a homography of what is seen.

    Cancellation: a picture under way is given up; what looks for the target in it ends in its
    thread, and what that finds is dropped.
    """

    async def script(parameters: Mapping[str, Any]) -> Any:
        about = await ask(_about(parameters, typed=read_robot is None))
        there = await ask_target(suggested)
        work = _Work(about, there, take_picture, read_robot, camera)
        await work.picture()
        plane = await (work.rays() if about["method"] == "rays" else work.corners())
        calibration = work.calibration(plane)
        name = str(parameters.get("name", KIND))
        file = save_to(name)
        step = Step(
            id="save",
            title=f"Save {name}",
            description="A calibration of that name is kept beside it as a backup.",
            button="Save",
            notes=tuple(_notes(calibration)),
            preview=work.shown(plane),
        )
        await ask(step, partial(work.save, file, calibration))
        return {"name": name, "file": file.name, **_figures(calibration)}

    return Wizard(name=KIND, version=1, script=script)


def _about(parameters: Mapping[str, Any], *, typed: bool) -> Step:
    inputs = (
        Option(
            name="method",
            label="What is touched",
            options={
                "corners": "corners of the target, or its dots; 9 over the whole sheet are good",
                "rays": "the origin and a point on each of the rays A and B",
            },
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
        description="The camera is fixed and gives positions in pixels. A printed sheet lies flat "
        "on the plane that the robot works on, and does not move until all is touched. All touches "
        "are made with one tool, held the same way.",
        inputs=tuple(with_default(one, parameters) for one in inputs),
    )


class _Work:
    """One run of the wizard; holds nothing but what the answers gave."""

    def __init__(
        self,
        about: Answer,
        target: Target,
        take_picture: TakePicture,
        read_robot: ReadRobot | None,
        camera: CameraModel | None,
    ) -> None:
        self._about = about
        self._target = target
        self._take_picture = take_picture
        self._read_robot = read_robot
        self._lens = camera
        self._view: TargetView
        self._camera: CameraModel | None = None
        self._svg = ""
        self._touches: list[Touch] = []
        self._ids: list[int] = []
        self._robust = False

    # ------------------------------------------------------------------ the picture

    async def picture(self) -> None:
        """Take the picture, and keep what was found in it."""
        step = Step(
            id="picture",
            title="The sheet in the camera's field",
            description="Lay the sheet flat into the camera's field and fix it. The robot must not "
            "hide it, and nothing must move until all is touched.",
            button="Take a picture",
            timeout=PICTURE_TIMEOUT,
        )
        found = (await ask(step, self._look)).outcome
        self._view = view_from_data(found["view"], self._target)
        self._camera = None if found["camera"] is None else camera_from_data(found["camera"])
        self._svg = found["preview"]

    async def _look(self, _answers: Answers) -> dict[str, Any]:
        image = await self._take_picture()
        return await asyncio.to_thread(self._found, image)

    def _found(self, image: Any) -> dict[str, Any]:
        view = find_target(image, self._target)
        preview = draw_sheet(image, view, look_at_sheet(view, self._lens).plane)
        return {
            "view": view_to_data(view),
            "camera": None if self._lens is None else camera_to_data(self._lens),
            "preview": preview if len(preview) <= MAX_PREVIEW else "",
        }

    def _picture(self, point: int | None = None) -> dict[str, Any] | None:
        """Return the picture to show, with a ring around a point of the target."""
        if not self._svg:
            return None
        seen = np.flatnonzero(self._view.ids == point)
        if not len(seen):
            return {"svg": self._svg}
        return {"svg": with_ring(self._svg, self._view.size, self._view.points[seen[0]])}

    def _seen(self) -> list[str]:
        """Return what people should know of the picture, a line each."""
        view = self._view
        lines = [f"{len(view.ids)} of {len(self._target.points)} points of the target seen"]
        if view.margin is not None:
            lines.append(
                f"the origin is told from the others by {view.margin:.0f} of 255 grey levels"
            )
        return lines

    # ------------------------------------------------------------------ touches

    def _tool_z(self) -> tuple[float, float, float] | None:
        return SIDES[self._about["side"]] if "side" in self._about else None

    async def _touch(self, step: Step, what: str) -> tuple[Answer, Touch]:
        """Ask for a touch; what the sheet has there is filled in by who knows it."""
        found = await touch(step, self._read_robot, unit=self._about["unit"], tool_z=self._tool_z())
        return found.answer, Touch(Mark("", 0.0, 0.0, 0.0), found.robot, found.tool_z, what)

    async def rays(self) -> PlaneCalibration:
        """Return the plane by touches of the origin and the rays."""
        for letter, what, point in (
            ("O", "the origin, the filled point in the picture", 0),
            ("A", "a point of ray A, as far out as it goes", None),
            ("B", "a point of ray B, as far out as it goes", None),
        ):
            step = Step(
                id=f"touch-{letter}",
                title=f"Touch {letter}",
                description=f"Move the tip of the tool onto {what}, with the tool held as at every "
                "touch.",
                notes=tuple(self._seen()),
                preview=self._picture(point),
            )
            self._touches.append((await self._touch(step, letter))[1])
        plane = self._fit_rays()
        step = Step(
            id="review",
            title="What came out",
            description="Three touches fit any plane: nothing tells how good they were. To know, "
            "touch corners instead.",
            button="Accept",
            notes=tuple(_notes(self.calibration(plane))),
            preview=self.shown(plane),
        )
        await ask(step)
        return plane

    async def corners(self) -> PlaneCalibration:
        """Return the plane by touches of points of the target."""
        wanted = FIRST
        while True:
            while len(self._ids) < wanted:
                await self._touch_corner(len(self._ids))
            plane, notes = self._try_fit()
            step = review(
                plane,
                notes,
                count=len(self._ids),
                more="touch another point",
                robust=self._robust,
                preview=self.shown(plane),
            )
            choice = await ask(step)
            index = choice["point"] - 1
            match choice["next"]:
                case "accept" if plane is not None:
                    return plane
                case "more":
                    wanted = self._room(len(self._ids) + 1)
                case "redo":
                    await self._touch_corner(index)
                case "remove":
                    del self._ids[index], self._touches[index]
                    wanted = max(len(self._ids), LEAST)
                case "robust" | "all":
                    self._robust = choice["next"] == "robust"
                case _:
                    pass

    def _room(self, count: int) -> int:
        if count > MAX_POINTS:
            raise CalibrationError(
                f"{count} points, expected {MAX_POINTS} at most",
                code=Code.SHAPE,
                got=count,
                expected=MAX_POINTS,
            )
        return count

    async def _touch_corner(self, index: int) -> None:
        """Ask for the touch of that index, which is a new one or is made again."""
        again = index < len(self._ids)
        suggested = self._ids[index] if again else self._next()
        columns, rows = _shape(self._target)
        row, column = divmod(suggested, columns)
        step = Step(
            id="redo" if again else f"touch-{index + 1}",
            title=f"Touch point {index + 1}{' again' if again else ''}",
            description=f"Move the tip of the tool onto point {column + 1} of row {row + 1}, which "
            "has a ring in the picture, with the tool held as at every touch; or onto another one, "
            "and say which. The origin is point 1 of row 1, points count along ray A, rows along "
            "ray B.",
            inputs=(
                _place("column", "Point of its row, counted along ray A", column, columns),
                _place("row", "Row, counted along ray B", row, rows),
            ),
            notes=tuple(self._seen()),
            preview=self._picture(suggested),
        )
        answer, found = await self._touch(step, "mark")
        number = (answer["row"] - 1) * columns + answer["column"] - 1
        x, y, _ = self._target.points[number].tolist()
        found.mark = Mark(f"point {answer['column']} of row {answer['row']}", x, y, 0.0)
        self._ids[index : index + 1] = [number]
        self._touches[index : index + 1] = [found]

    def _next(self) -> int:
        """Return the number of the point that is to be touched next.

        First the outermost ones that the picture shows, then the farthest from all touched ones.
        """
        ids = self._view.ids
        places = self._target.points[ids, :2]
        for direction in _DIAGONALS:
            outermost = int(ids[int(np.argmax(places @ direction))])
            if outermost not in self._ids:
                return outermost
        apart = places[:, None] - self._target.points[self._ids, :2]
        nearest = (apart**2).sum(axis=2).min(axis=1).round(12)
        return int(ids[int(np.argmax(nearest))])

    # ------------------------------------------------------------------ numbers

    def calibration(self, plane: PlaneCalibration) -> SheetCalibration:
        """Return what the picture and a plane come to."""
        return calibrate_sheet(
            self._view,
            plane,
            camera=self._camera,
            camera_frame=self._about["camera_frame"] or None,
        )

    def _axis(self) -> Array | None:
        axes = [one.tool_z for one in self._touches if one.tool_z is not None]
        return np.mean(axes, axis=0) if axes else None

    def _sigma(self) -> float | None:
        sigma = self._about["touch_sigma"]
        return None if sigma is None else 1e-3 * sigma

    def _fit_rays(self) -> PlaneCalibration:
        header = Header(0, datetime.fromtimestamp(0, UTC), "")
        origin = Pose(header, Position(0.0, 0.0), Quaternion())
        o, a, b = (one.robot for one in self._touches)
        return fit_touches(
            Localization("origin", 1.0, 0, origin),
            o,
            a,
            b,
            touch_sigma=self._sigma(),
            tool_z=self._axis(),
            robot_frame=self._about["robot_frame"],
        )

    def _try_fit(self) -> tuple[PlaneCalibration | None, list[str]]:
        try:
            plane = fit_corners(
                self._target,
                self._ids,
                [one.robot for one in self._touches],
                touch_sigma=self._sigma(),
                tool_z=self._axis(),
                robust=self._robust and len(self._ids) >= LEAST_POINTS,
                robot_frame=self._about["robot_frame"],
            )
        except CalibrationError as exc:
            return None, [f"{exc.code}: {exc}"]
        return plane, _notes(self.calibration(plane))

    def shown(self, plane: PlaneCalibration | None) -> dict[str, Any]:
        """Return what a picture is drawn from: the touches, on the sheet."""
        if plane is None:
            return plain(self._touches)
        found = compared(
            plane,
            self._touches,
            plane.camera_points,
            plane.residuals,
            plane.leave_one_out,
            worst=plane.worst,
            left_out=plane.outliers,
        )
        return {**found, "of": "sheet"}

    async def save(
        self, file: Path, calibration: SheetCalibration, _answers: Answers
    ) -> dict[str, Any]:
        """Write the calibration, with what was touched: the action of a step."""
        about = self._about
        context = {
            "frames": {"camera": about["camera_frame"] or None, "robot": about["robot_frame"]},
            "camera_unit": "px",
            "tool": about["tool"],
            "method": about["method"],
            "samples": [
                {
                    "touched": one.what if one.what in {"O", "A", "B"} else one.mark.feature,
                    "sheet": [one.mark.x, one.mark.y],
                    "robot": list(one.robot),
                    "tool_z": None if one.tool_z is None else list(one.tool_z),
                }
                for one in self._touches
            ],
        }
        write(file, KIND, calibration.to_data(), context=context)
        return {"file": file.name}


def _shape(target: Target) -> tuple[int, int]:
    """Return how many points a row of a target has, and how many rows there are."""
    if isinstance(target, Charuco):
        return target.columns - 1, target.rows - 1
    return target.columns, target.rows


def _place(name: str, label: str, index: int, count: int) -> Number:
    return Number(name=name, label=label, integer=True, minimum=1, maximum=count, default=index + 1)


def _predicted(calibration: SheetCalibration, pixels: Array) -> float | None:
    """Return the rms of the errors to expect at pixels, mm; None where no sigma is known."""
    if calibration.plane.touch_sigma is None:
        return None
    return 1e3 * math.sqrt(float((calibration.predicted_error(pixels) ** 2).mean()))


def _figures(calibration: SheetCalibration) -> dict[str, Any]:
    view = calibration.view
    return {
        **figures(calibration.plane),
        "predicted_mm": _predicted(calibration, view.points),
        "seen": len(view.ids),
        "rms_px": calibration.rms,
        "remarks": [[remark.code.value, remark.text] for remark in calibration.warnings],
    }


def _notes(calibration: SheetCalibration) -> list[str]:
    """Return what people should know of a calibration, a line each."""
    lines = summary(calibration.plane)
    view = calibration.view
    lines.append(f"{len(view.ids)} points seen, {calibration.rms:.2g} px beside their plane")
    predicted = _predicted(calibration, view.points)
    if predicted is not None:
        unknown = "" if calibration.camera else "; what the lens distorts comes on top"
        lines.append(
            f"predicted error from pixel to robot {predicted:.3f} mm rms where the target was "
            f"seen{unknown}"
        )
    return [*lines, *(f"{one.code}: {one.text}" for one in calibration.remarks)]
