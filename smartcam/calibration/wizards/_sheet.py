"""The wizard that calibrates a camera's pixels against a robot, by a picture of a printed sheet.

The wizard asks for the target and the lengths of the printed rulers, takes a picture and finds the
target in it. Then the robot touches any number of the target's corners, or the origin and a point
on each of the rays A and B: half-lines from the origin along the sheet's axes. The wizard does not
depend on any camera or robot: it is given a function that takes a picture and, if the robot can be
read, a function that reads the robot's pose.

Source: the thesis with which smartcam began, 3.2.3.2 (published) for the origin that a camera finds
in its image.
"""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from smartcam.calibration._detection.find import find_target
from smartcam.calibration._sheet.calibration import KIND, calibrate_sheet, fit_corners
from smartcam.calibration._sheet.plane import fit_sheet_view
from smartcam.calibration._targets import Charuco
from smartcam.calibration._views import TargetView
from smartcam.calibration.wizards._marks import Mark
from smartcam.calibration.wizards._pictures import (
    MAX_PREVIEW_BYTES,
    PICTURE_TIMEOUT,
    picture_instruction,
    picture_taker,
)
from smartcam.calibration.wizards._points import (
    MAX_POINTS,
    CalibrationOutcome,
    PointSource,
    about_step,
    plane_outcome,
)
from smartcam.calibration.wizards._sequence import Wizard, ask
from smartcam.calibration.wizards._steps import Step, number_input
from smartcam.calibration.wizards._target_drawing import add_ring, draw_sheet, preview_coordinates
from smartcam.calibration.wizards._target_steps import ask_target
from smartcam.geometry import CameraModel

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from numpy.typing import ArrayLike

    from smartcam.calibration._plane.calibration import PlaneCalibration
    from smartcam.calibration._targets import Target
    from smartcam.calibration.wizards._marks import Touch
    from smartcam.calibration.wizards._pictures import Pictures, TakePicture
    from smartcam.calibration.wizards._sequence import StepAnswer
    from smartcam.calibration.wizards._steps import Answers
    from smartcam.calibration.wizards._touches import ReadRobot

DIAGONALS: Final = ((-1.0, -1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, 1.0))
"""Directions towards the outermost points of a target; the first one leads to the origin."""


def sheet_wizard(
    *,
    take_picture: TakePicture | Pictures,
    save_to: Callable[[str], Path],
    read_robot: ReadRobot | None = None,
    suggested: Target | None = None,
    camera: CameraModel | None = None,
    lens_covariance: ArrayLike | None = None,
    connect: Mapping[str, Any] | None = None,
    awaited: str = "",
) -> Wizard:
    """Return the wizard of a calibration by a sheet.

    Its parameters: ``name`` (of the calibration, passed to ``save_to``), and as defaults of the
    first step ``method`` (corners, rays), ``camera_frame``, ``robot_frame``, ``tool``, ``unit``
    (mm, m), ``side``, ``touch_sigma`` (mm); ``target``: a description of the target on the sheet;
    the wizard then does not ask for the target.

    Its result has the entries of the plane wizard's result, and ``seen`` (number of the target's
    points in the picture) and ``rms_px`` (RMS distance of these points from their fit).
    ``predicted_mm`` is the predicted error, RMS over the points that were seen.

    Args:
        take_picture: function that takes a picture; or an open source of frames, whose first frame
            after the button was pressed is used.
        save_to: function that returns the file for a name.
        read_robot: function that reads the robot's pose; None: the pose is typed.
        suggested: default of the question for the target.
        camera: the lens, stored with each picture; None: a homography is fitted instead.
        lens_covariance: covariance of the lens' values, as for :func:`calibrate_sheet`.
        connect: arguments of :func:`smartcam.connect` for the camera, ``url`` included, for the
            lines that use the result; None: the camera cannot be asked.
        awaited: description, for people, of the picture that ``take_picture`` waits for, as from
            :attr:`PictureFolder.awaited`; empty if ``take_picture`` takes one.

    Cancellation: a picture under way is given up; the search for the target in it ends in its
    thread, and its result is dropped.
    """

    async def script(parameters: Mapping[str, Any]) -> Any:
        step = about_step(
            "The camera is fixed and gives positions in pixels. A printed sheet lies flat on the "
            "plane that the robot works on, and does not move until all is touched. All touches "
            "are made with one tool, held the same way.",
            {
                "corners": "corners of the target, or its dots; 9 over the whole sheet are good",
                "rays": "the origin and a point on each of the rays A and B",
            },
            parameters,
            typed=read_robot is None,
        )
        about = await ask(step)
        target = await ask_target(
            suggested, known=parameters.get("target"), square=parameters.get("square")
        )
        source = _SheetSource(about, read_robot, target)
        # The pixels' v points down: y_down makes localizations from this camera have y up, as the
        # calibration expects.
        source.connect = None if connect is None else {**connect, "y_down": True}
        await source.ask_picture(picture_taker(take_picture), camera, lens_covariance, awaited)
        return await source.run(str(parameters.get("name", KIND)), save_to)

    return Wizard(name=KIND, version=1, script=script, steps=10)


class _SheetSource(PointSource):
    """Points of a sheet that is found in a picture."""

    KIND = KIND
    MIN_TOUCHES_FOR_RESULT = 4
    POINTS = "corners"
    ORIGIN = "the origin, the filled point in the picture"
    MORE = "touch another point"
    PREVIEW_EXTRAS: ClassVar[Mapping[str, str]] = {"of": "sheet"}

    def __init__(self, about: StepAnswer, read_robot: ReadRobot | None, target: Target) -> None:
        super().__init__(about, read_robot)
        self.camera_unit = "px"
        self._target = target
        self._view: TargetView
        self._camera: CameraModel | None = None
        self._lens_covariance: list[list[float]] | None = None
        self._svg = ""

    async def ask_picture(
        self,
        take_picture: TakePicture,
        lens: CameraModel | None,
        lens_covariance: ArrayLike | None,
        awaited: str,
    ) -> None:
        """Ask for the picture, and keep the view found in it."""

        async def find_sheet(_answers: Answers) -> dict[str, Any]:
            image = await take_picture()
            sighting = await asyncio.to_thread(_find_sheet, image, self._target, lens)
            covariance = None if lens_covariance is None else np.asarray(lens_covariance).tolist()
            return {**sighting, "lens_covariance": covariance}

        step = Step(
            id="picture",
            title="The sheet in the camera's field",
            description="Lay the sheet flat into the camera's field and fix it. The robot must not "
            f"hide it, and nothing must move until all is touched.{picture_instruction(awaited)}",
            button="Wait for the picture" if awaited else "Take a picture",
            notes=("picture 1 of 1; to end without it, abort",) if awaited else (),
            waiting=f"Waiting: {awaited}" if awaited else "",
            timeout=PICTURE_TIMEOUT,
        )
        outcome = (await ask(step, find_sheet)).outcome
        self._view = TargetView.from_data(outcome["view"], target=self._target)
        self._camera = (
            None if outcome["camera"] is None else CameraModel.from_data(outcome["camera"])
        )
        self._lens_covariance = outcome.get("lens_covariance")  # missing in older journals
        self._svg = outcome["preview"]

    def step_extras(self, mark: Mark) -> dict[str, Any]:
        """Return notes on the picture, and the picture with a ring around a mark, for a step."""
        view = self._view
        notes = [f"{len(view.ids)} of {len(self._target.points)} points of the target seen"]
        if view.margin is not None:
            notes.append(
                f"the origin differs from the other corners by {view.margin:.0f} of 255 grey levels"
            )
        svg, index_in_view = self._svg, np.flatnonzero(view.ids == mark.number)
        if svg and len(index_in_view):
            svg = add_ring(svg, view.size, view.points[index_in_view[0]])
        preview = {"svg": svg, "choices": self._clickable_corners()} if svg else None
        return {"notes": tuple(notes), "preview": preview}

    def _clickable_corners(self) -> list[dict[str, Any]]:
        """Return clickable choices for the visible points, at the points' places in the picture."""
        columns, view = grid_size(self._target)[0], self._view
        places = np.round(preview_coordinates(view.size, view.points), 1).tolist()
        return [
            {"at": at, "label": f"{1 + column}, {1 + row}", "answers": _corner_answers(column, row)}
            for at, number in zip(places, view.ids.tolist(), strict=True)
            for row, column in [divmod(number, columns)]
        ]

    async def find_ray_origin(self) -> tuple[Mark, float]:
        return Mark("", 0.0, 0.0, 0.0, number=0), 1.0  # places on the sheet are in metres

    async def add_points(self) -> None:
        self.check_count(1, MAX_POINTS, "points")
        number = len(self.touches) + 1
        touched = await self._touch_corner(
            f"touch-{number}", f"Touch point {number}", self._choose_next_point()
        )
        self.touches.append(touched)

    async def ask_again(self, index: int) -> None:
        number = self.touches[index].mark.number or 0
        self.touches[index] = await self._touch_corner(
            "redo", f"Touch point {index + 1} again", number
        )

    async def _touch_corner(self, step_id: str, title: str, suggested: int) -> Touch:
        """Ask for the touch of the suggested point, or of another point that the user names."""
        columns, rows = grid_size(self._target)
        row, column = divmod(suggested, columns)
        step = Step(
            id=step_id,
            title=title,
            description=f"Move the tip of the tool onto point {column + 1} of row {row + 1}, which "
            "has a ring in the picture, with the tool held as at every touch; or onto another one, "
            "and say which. The origin is point 1 of row 1, points count along ray A, "
            "rows along ray B.",
            inputs=(
                number_input(
                    "column", "Point of its row, counted along ray A", columns, column + 1
                ),
                number_input("row", "Row, counted along ray B", rows, row + 1),
            ),
            **self.step_extras(self._corner_mark(column, row)),
        )
        return await self.ask_touch(
            step, lambda answer: self._corner_mark(answer["column"] - 1, answer["row"] - 1)
        )

    def _corner_mark(self, column: int, row: int) -> Mark:
        number = row * grid_size(self._target)[0] + column
        x, y, _ = self._target.points[number].tolist()
        return Mark(f"point {column + 1} of row {row + 1}", x, y, 0.0, number)

    def _choose_next_point(self) -> int:
        """Return the number of the point to touch next.

        First come the outermost visible points, then the points farthest from all touched points.
        """
        ids = self._view.ids
        places = self._target.points[ids, :2]
        for direction in DIAGONALS:
            outermost = int(ids[int(np.argmax(places @ direction))])
            if outermost not in self._touched_numbers():
                return outermost
        offsets = places[:, None] - self._target.points[self._touched_numbers(), :2]
        nearest_squared = (offsets**2).sum(axis=2).min(axis=1).round(12)
        return int(ids[int(np.argmax(nearest_squared))])

    def _touched_numbers(self) -> list[int]:
        return [touch.mark.number or 0 for touch in self.touches]

    def fit(self, *, robust: bool) -> PlaneCalibration:
        return fit_corners(
            self._target,
            self._touched_numbers(),
            self.tip_positions,
            touch_sigma=self.sigma,
            tool_z=self.tool_z,
            robust=robust,
            robot_frame=self.about["robot_frame"],
        )

    def sample_entries(self, touch: Touch) -> dict[str, Any]:
        mark = touch.mark
        touched = mark.feature if touch.label == "mark" else touch.label
        return {"touched": touched, "sheet": [mark.x, mark.y]}

    def calibration_outcome(self, plane: PlaneCalibration) -> CalibrationOutcome:
        frame = self.about["camera_frame"] or None
        calibration = calibrate_sheet(
            self._view,
            plane,
            camera=self._camera,
            lens_covariance=self._lens_covariance,
            camera_frame=frame,
        )
        middle = self._view.points.mean(axis=0)
        ends = calibration.transform(np.add(middle, [[0.0, 0.0], [1.0, 0.0]]))
        right = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        of_touches = plane_outcome(plane, "what is to the right in the picture", right)
        seen_count, predicted = len(self._view.ids), None
        notes = [
            *of_touches.notes,
            f"{seen_count} points seen, {calibration.rms:.2g} px rms from their fit",
        ]
        if plane.touch_sigma is not None:
            errors = calibration.predicted_error(self._view.points)
            predicted = 1e3 * math.sqrt(float((errors**2).mean()))
            caveat = "; the lens' distortion comes on top"
            if calibration.camera is not None:
                has_covariance = calibration.lens_covariance is not None
                caveat = (
                    ""
                    if has_covariance
                    else "; the lens' own error, which is not known, comes on top"
                )
            notes.append(
                f"predicted error from pixel to robot {predicted:.3f} mm rms where the target was "
                f"seen{caveat}"
            )
        notes += [f"{remark.code}: {remark.text}" for remark in calibration.remarks]
        remarks = [[warning.code.value, warning.text] for warning in calibration.warnings]
        judgement = calibration.judged()
        figures = {
            "predicted_mm": predicted,
            "seen": seen_count,
            "rms_px": calibration.rms,
            "remarks": remarks,
        }
        return CalibrationOutcome(
            calibration, of_touches.figures | figures | judgement.figures, tuple(notes), judgement
        )

    def example_point(self) -> tuple[float, float]:
        u, v = self._view.points[0].tolist()
        return u, v


def _find_sheet(image: Any, target: Target, lens: CameraModel | None) -> dict[str, Any]:
    """Find the sheet in a picture; return the view, the lens and a small SVG as JSON data."""
    view = find_target(image, target)
    preview = draw_sheet(image, view, fit_sheet_view(view, lens).plane)
    return {
        "view": view.to_data(),
        "camera": None if lens is None else lens.to_data(),
        "preview": preview if len(preview) <= MAX_PREVIEW_BYTES else "",
    }


def _corner_answers(column: int, row: int) -> Answers:
    return {"column": 1 + column, "row": 1 + row}


def grid_size(target: Target) -> tuple[int, int]:
    """Return the number of points in a target's row, and the number of rows."""
    if isinstance(target, Charuco):
        return target.columns - 1, target.rows - 1
    return target.columns, target.rows
