"""The wizard that calibrates the pose of a camera on a robot, or of a camera next to a robot.

The wizard suggests a view, takes a picture, finds the target in it and reads the robot, any number
of times. It shows the error at poses that were left out of the calibration, and names the worst
pose.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.calibration._detection.find import find_target
from smartcam.calibration._drawing.draw import draw_scene, draw_views
from smartcam.calibration._hand_eye.calibration import calibrate_hand_eye
from smartcam.calibration._hand_eye.closed_forms import MIN_POSES
from smartcam.calibration._hand_eye.result import KIND, HandEyeCalibration
from smartcam.calibration._lens.poses import CAMERA, TARGET, locate
from smartcam.calibration._verdict import VIEW_CURES, AdvisedVerdict, poor_judgement
from smartcam.calibration._views import TargetView
from smartcam.calibration.formats._robots import ROBOTS, pose_from
from smartcam.calibration.wizards._pictures import (
    MAX_PREVIEW_BYTES,
    PICTURE_TIMEOUT,
    picture_instruction,
    picture_taker,
)
from smartcam.calibration.wizards._points import (
    CalibrationOutcome,
    accept_option_text,
    ask_to_save,
    review_step,
)
from smartcam.calibration.wizards._sequence import Wizard, ask
from smartcam.calibration.wizards._sheet import DIAGONALS, grid_size
from smartcam.calibration.wizards._steps import Number, Option, Step, number_input
from smartcam.calibration.wizards._target_drawing import draw_preview
from smartcam.calibration.wizards._target_steps import ask_target
from smartcam.calibration.wizards._touches import ALLOWED
from smartcam.calibration.wizards._usage import usage
from smartcam.calibration.wizards._view_suggestions import STANDARD_VIEWS, suggest_view
from smartcam.exceptions import CalibrationError
from smartcam.geometry import Transform
from smartcam.geometry._inside import Code, motion_from_data, motion_to_data
from smartcam.models import Pose

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from smartcam.calibration._hand_eye.equations import Setup
    from smartcam.calibration._targets import Target
    from smartcam.calibration.wizards._pictures import Pictures, TakePicture
    from smartcam.calibration.wizards._steps import Answers
    from smartcam.calibration.wizards._view_suggestions import Suggestion
    from smartcam.geometry import CameraModel

ReadFlange = Callable[[], Awaitable[Transform | Pose]]
"""Function that returns ``T_base_flange``, the flange's pose in the robot's base."""

MAX_VIEWS = 40
"""Largest number of views of a run, far more than a calibration needs."""

ADVISED_VIEWS = 10
"""From this number of views on, the wizard preselects the calculation."""

CALCULATION_TIMEOUT = 120.0
"""Timeout of the calculation, seconds; with 15 views it takes a few seconds."""

_MOVES: Mapping[str, str] = {
    "eye-in-hand": "Bring the camera to where it looks at the sheet",
    "eye-to-hand": "Bring the sheet in front of the camera, and hold it",
}

TOUCHES = 3
"""Number of touches that verify a calibration; the touched points of the sheet are far apart."""

SUGGESTIONS = tuple(look.text for look in STANDARD_VIEWS)
"""Texts of the suggested views, in order; after the last one, the first one follows."""


def hand_eye_wizard(
    *,
    take_picture: TakePicture | Pictures,
    save_to: Callable[[str], Path],
    target: Target | None = None,
    suggested: Target | None = None,
    read_robot: ReadFlange | None = None,
    camera: CameraModel | None = None,
    awaited: str = "",
) -> Wizard:
    """Return the wizard of a hand-eye calibration.

    Its parameters: ``name`` (of the calibration, passed to ``save_to``), and as defaults of the
    first step ``setup`` and ``robot`` (the convention of typed poses, such as ``kuka``);
    ``target``: a description of the target on the sheet; the wizard then does not ask for the
    target.

    Its result has the entries ``name``, ``file``, ``path``, ``good_for_mm``, ``method``, ``views``,
    ``held_out_mm``, ``mean_mm``, ``translation_error_mm``, ``rotation_error_deg``, ``remarks``, and
    ``use`` (lines that use the result).

    Args:
        take_picture: function that takes a picture while the robot stands still; or an open source
            of frames, of which the first frame that was exposed after the button was pressed is
            used.
        save_to: function that returns the file for a name.
        target: target on the sheet, with the lengths on paper; None: the wizard asks for it.
        suggested: default of the question for the target.
        read_robot: function that reads the pose of the flange; None: the user types poses.
        camera: the camera's lens; None: calibrated from the same views.
        awaited: description, for people, of the picture that ``take_picture`` waits for, as from
            :attr:`PictureFolder.awaited`; empty if ``take_picture`` takes one.

    Cancellation: a picture or a pose under way is given up; a calculation ends in its thread, and
    its result is dropped.
    """

    async def script(parameters: Mapping[str, Any]) -> Any:
        setup, robot, allowed = await _ask_setup(parameters, pose_is_typed=read_robot is None)
        sheet_target = target
        if sheet_target is None:
            sheet_target = await ask_target(
                suggested, known=parameters.get("target"), square=parameters.get("square")
            )
        run = _HandEyeRun(
            sheet_target, setup, picture_taker(take_picture), read_robot or robot, camera, awaited
        )
        run.allowed = allowed
        calibration = await run.run()
        name = str(parameters.get("name", KIND))
        preview = {"svg": draw_scene(calibration, title="Where camera and sheet were")}
        result = await ask_to_save(name, save_to, KIND, _calibration_outcome(calibration), preview)
        return {**result, "use": usage(KIND, save_to(name))}

    return Wizard(name=KIND, version=1, script=script, steps=14)


async def _ask_setup(
    parameters: Mapping[str, Any], *, pose_is_typed: bool
) -> tuple[Setup, str, float | None]:
    """Ask for the camera's place, the convention of typed poses, and the allowed error."""
    setup = Option(
        name="setup",
        label="Where the camera is",
        options={
            "eye-in-hand": "on the robot's hand; the sheet lies still",
            "eye-to-hand": "beside the robot; the sheet is on the hand",
        },
    )
    robot = Option(
        name="robot",
        label="How the robot shows the pose of its flange",
        options={name: f"{', '.join(form.numbers)}; {form.title}" for name, form in ROBOTS.items()},
    )
    label = "Largest error that is good enough; empty: a hundredth of the sheet's distance"
    allowed = replace(ALLOWED, label=label)
    inputs = (setup, robot, allowed) if pose_is_typed else (setup, allowed)
    step = Step(
        id="about",
        title="Camera and robot",
        description="The sheet must not slip on what carries it until all pictures are taken.",
        inputs=inputs,
    )
    answer = await ask(step.with_defaults(parameters))
    camera_place: Setup = "eye-to-hand" if answer["setup"] == "eye-to-hand" else "eye-in-hand"
    error = answer["allowed"]
    return camera_place, str(answer.get("robot", "")), None if error is None else 1e-3 * error


@dataclass(eq=False)
class _HandEyeRun:
    """One run of the wizard; answers and outcomes of steps determine its whole state."""

    _target: Target
    _setup: Setup
    _take_picture: TakePicture
    _robot: ReadFlange | str
    _camera: CameraModel | None
    _awaited: str
    _samples: list[dict[str, Any]] = field(default_factory=list)
    allowed: float | None = None  # largest allowed error, metres; None if the user gave none

    async def run(self) -> HandEyeCalibration:
        """Ask for views until a calibration is accepted; return it."""
        take_more = True
        while True:
            while take_more and await self._take_view():
                pass
            calibration, notes, judgement = await self._calculate()
            answers = await ask(self._review(calibration, notes, judgement))
            while answers["next"] == "verify" and calibration is not None:
                calibration, note = await self._verify(calibration)
                notes = (*_calibration_outcome(calibration).notes, note)
                answers = await ask(self._review(calibration, notes, calibration.judged()))
            if answers["next"] == "accept" and calibration is not None:
                return calibration
            take_more = answers["next"] == "more"
            if answers["next"] == "remove":
                del self._samples[answers["view"] - 1]
                take_more = len(self._samples) < MIN_POSES

    async def _verify(self, calibration: HandEyeCalibration) -> tuple[HandEyeCalibration, str]:
        """Ask for touches of the sheet; return the calibration with their result, and a note."""
        points = (calibration.target or self._target).points
        if self._setup == "eye-in-hand":
            sheet_points = calibration.target_pose.apply(points)
        else:
            step = Step(
                id="verify-picture",
                title="A sheet that the robot can touch",
                description="Lay a print of the same sheet into the camera's field where the robot "
                f"can touch it, and fix it.{picture_instruction(self._awaited)}",
                button="Take a picture",
                waiting=f"Waiting: {self._awaited}" if self._awaited else "",
                timeout=PICTURE_TIMEOUT,
            )
            lying_sheet = (
                await ask(step, partial(self._locate_lying_sheet, calibration.camera))
            ).outcome
            seen = motion_from_data(lying_sheet, CAMERA, TARGET)
            sheet_points = (calibration.camera_pose @ seen).apply(points)
        columns = grid_size(self._target)[0]
        errors: list[float] = []
        for direction in DIAGONALS[:TOUCHES]:
            number = int(np.argmax(points[:, :2] @ direction))
            row, column = divmod(number, columns)
            step = Step(
                id=f"verify-{len(errors) + 1}",
                title=f"Touch {len(errors) + 1} of {TOUCHES}",
                description=f"Move the tip of the tool onto point {column + 1} of row {row + 1} of "
                "the sheet, counted from its origin, and take the tip's position from the robot, "
                "in its base.",
                inputs=tuple(Number(name=axis, label=axis, unit="mm") for axis in "xyz"),
            )
            answer = await ask(step)
            touched = np.array([1e-3 * answer[axis] for axis in "xyz"])
            errors.append(1e3 * float(np.linalg.norm(touched - sheet_points[number])))
        note = f"the tip touched the sheet {', '.join(f'{error:.2f}' for error in errors)} mm off"
        warnings = tuple(
            warning for warning in calibration.warnings if warning.code != Code.REFUTED
        )
        allowed = calibration.allowed
        if max(errors) > allowed.error:
            warnings = (Code.REFUTED.remark(f"{note}, but {allowed.text}"), *warnings)
        return replace(calibration, warnings=warnings), note

    async def _locate_lying_sheet(
        self, lens: CameraModel | None, _answers: Answers
    ) -> dict[str, Any]:
        """Take a picture of a sheet that lies on the table, and return its pose."""
        image = await self._take_picture()
        view = await asyncio.to_thread(find_target, image, self._target)
        if lens is None:
            raise TypeError("the calibration has no lens")
        return motion_to_data(locate(view, lens).transform)

    async def _take_view(self) -> bool:
        """Take one more view; return False if there are enough, or the user wants to calculate."""
        count = len(self._samples)
        if count >= MAX_VIEWS:
            return False
        inputs: tuple[Option | Number, ...] = ()
        if count >= MIN_POSES:
            options = {
                "view": "take this view",
                "calculate": f"calculate with the {count} views; {ADVISED_VIEWS} or more are good",
            }
            default = "view" if count < ADVISED_VIEWS else "calculate"
            inputs = (Option(name="next", label="What next", options=options, default=default),)
        next_view = self._samples[-1].get("next", {}) if self._samples else {}
        look = next_view.get("text") or SUGGESTIONS[count % len(SUGGESTIONS)]
        instruction = ""
        if isinstance(self._robot, str):
            instruction = " Then take the pose of the flange from the robot, in its base."
            inputs = (*inputs, *_pose_inputs(self._robot, optional=count >= MIN_POSES))
        step = Step(
            id=f"view-{count + 1}",
            title=f"View {count + 1}",
            description=f"{_MOVES[self._setup]}: {look}. The whole sheet must be in the image, and "
            f"the robot must stand still.{instruction}{picture_instruction(self._awaited)}",
            button="Take a picture" if count < MIN_POSES else "Go on",
            inputs=inputs,
            notes=tuple(filter(None, (self._progress(count), next_view.get("gain")))),
            preview=self.preview(),
            waiting=f"Waiting: {self._awaited}" if self._awaited else "",
            timeout=PICTURE_TIMEOUT,
        )
        sample = (await ask(step, self._take_sample)).outcome
        if sample:
            self._samples.append(sample)
        return bool(sample)

    def _progress(self, count: int) -> str:
        """Return a text with the number of views so far, and the advised and the largest number."""
        ending = (
            "to end, choose to calculate"
            if count >= MIN_POSES
            else f"with {MIN_POSES} it can be calculated; to end before, abort"
        )
        return f"{count} of {ADVISED_VIEWS} views, {MAX_VIEWS} at most; {ending}"

    async def _take_sample(self, answers: Answers) -> dict[str, Any]:
        """Take a picture and read the robot, unless the user wants to calculate."""
        if answers.get("next") == "calculate":
            return {}
        typed_pose = None
        if isinstance(self._robot, str):  # refuse an invalid pose before a picture is taken
            typed_pose = _typed_pose(self._robot, answers)
        image = await self._take_picture()
        flange = typed_pose or await self._read_flange()
        name = f"view {len(self._samples) + 1}"
        view, preview, next_view = await asyncio.to_thread(self._find_view, image, name)
        frames = [flange.target, flange.source]
        return {
            "frames": frames,
            "pose": motion_to_data(flange),
            "view": view.to_data(),
            "preview": preview,
            "next": {"text": next_view.text, "gain": next_view.gain},
        }

    async def _read_flange(self) -> Transform:
        if isinstance(self._robot, str):
            raise TypeError("there is no function that reads the robot")
        pose = await self._robot()
        return Transform.from_pose(pose, "flange") if isinstance(pose, Pose) else pose

    def _find_view(self, image: Any, name: str) -> tuple[TargetView, str, Suggestion]:
        """Return the view found in a picture, an SVG of the picture, and the next suggestion.

        The SVG is "" if it is too large.
        """
        view, earlier = find_target(image, self._target, name=name), self._named_views()
        next_view = suggest_view([*earlier, view], lens_known=self._camera is not None)
        svg = draw_preview(
            image,
            view=view,
            earlier=earlier,
            suggested=next_view.outline,
            title=f"{name}; orange: the next one, about",
        )
        return view, svg if len(svg) <= MAX_PREVIEW_BYTES else "", next_view

    def _named_views(self) -> list[TargetView]:
        """Return the views, named by their numbers."""
        views = [
            TargetView.from_data(sample["view"], target=self._target) for sample in self._samples
        ]
        return [replace(view, name=f"view {number}") for number, view in enumerate(views, 1)]

    def preview(self) -> dict[str, Any] | None:
        """Return the picture of the last view; None if there is none."""
        svg = self._samples[-1].get("preview") if self._samples else None
        return {"svg": svg} if svg else None

    async def _calculate(self) -> tuple[HandEyeCalibration | None, tuple[str, ...], AdvisedVerdict]:
        step = Step(
            id="calculate",
            title="Calculate",
            description="Several methods are compared, each at poses that it did not use.",
            button="Calculate",
            notes=(f"{len(self._samples)} views",),
            timeout=CALCULATION_TIMEOUT,
        )
        solution = (await ask(step, self._solve)).outcome
        if "code" in solution:
            worst, code = len(self._samples), Code(solution["code"])
            judgement = poor_judgement(code, solution["text"], worst=worst, cures=VIEW_CURES)
            return None, (f"{code}: {solution['text']}",), judgement
        views = [view.to_data() for view in self._named_views()]
        calibration = HandEyeCalibration.from_data({**solution, "views": views})
        _, _, notes, judgement = _calibration_outcome(calibration)
        return calibration, notes, judgement

    async def _solve(self, _answers: Answers) -> dict[str, Any]:
        """Return the calibration as data without views, or ``code`` and ``text`` of the error."""
        poses = [motion_from_data(sample["pose"], *sample["frames"]) for sample in self._samples]
        calibrate = partial(
            calibrate_hand_eye,
            poses,
            self._named_views(),
            setup=self._setup,
            camera=self._camera,
            allowed_error=self.allowed,
        )
        try:
            calibration = await asyncio.to_thread(calibrate)
        except CalibrationError as exc:
            return {"code": str(exc.code), "text": str(exc)}
        return {**calibration.to_data(), "views": []}

    def _review(
        self,
        calibration: HandEyeCalibration | None,
        notes: tuple[str, ...],
        judgement: AdvisedVerdict,
    ) -> Step:
        options = {
            "accept": accept_option_text(judgement),
            "verify": "touch the sheet with the robot's tip, to see that it is right",
            "more": "take another view",
            "remove": "remove a view",
        }
        worst = len(self._samples)
        if calibration is None:
            del options["accept"], options["verify"]
        else:
            worst = 1 + calibration.worst
        label = "View to remove; the worst one is filled in"
        view = number_input("view", label, len(self._samples), worst)
        preview = self.preview()
        if calibration is not None:
            preview = {"svg": draw_views(calibration, title="Error of each view on the sheet")}
        return review_step(options, view, notes, judgement, preview)


def _pose_inputs(robot: str, *, optional: bool) -> tuple[Number, ...]:
    """Return the inputs of a pose; ``optional``: whether they may be empty."""
    convention = ROBOTS[robot]
    unit = "mm" if convention.units_per_metre > 1 else "m"
    return tuple(
        Number(
            name=name, label=name, unit=unit if name in {"x", "y", "z"} else "", optional=optional
        )
        for name in convention.numbers
    )


def _typed_pose(robot: str, answers: Answers) -> Transform:
    values = [answers[name] for name in ROBOTS[robot].numbers]
    missing = {
        name: "no answer"
        for name, value in zip(ROBOTS[robot].numbers, values, strict=True)
        if value is None
    }
    if missing:
        raise Code.WRONG_ANSWERS.error(f"pose: no answer for {', '.join(missing)}", got=missing)
    return pose_from(robot, values, source="flange")


def _calibration_outcome(calibration: HandEyeCalibration) -> CalibrationOutcome:
    held_out = calibration.held_out_error
    remarks = [f"{warning.code}: {warning.text}" for warning in calibration.warnings]
    judgement = calibration.judged()
    figures = {
        **judgement.figures,
        "method": calibration.method,
        "views": len(calibration.views),
        "held_out_mm": None if held_out is None else 1e3 * held_out,
        "mean_mm": 1e3 * calibration.mean_error,
        "translation_error_mm": _scaled_or_none(1e3, calibration.translation_error),
        "rotation_error_deg": _scaled_or_none(math.degrees(1.0), calibration.rotation_error),
        "remarks": remarks,
    }
    notes = [f"{figures['views']} views, {figures['method']}"]
    if held_out is not None:
        worst = calibration.worst
        error = 1e3 * float(calibration.leave_one_out[worst])
        notes += [
            f"{figures['held_out_mm']:.3g} mm rms on the sheet, at views that were left out",
            f"the worst is view {worst + 1}: {error:.3g} mm",
        ]
    if figures["translation_error_mm"] is not None:
        notes.append(
            f"the camera's place is known to {figures['translation_error_mm']:.2g} mm, its "
            f"orientation to {figures['rotation_error_deg']:.2g} deg"
        )
    return CalibrationOutcome(calibration, figures, (*notes, *remarks), judgement)


def _scaled_or_none(factor: float, value: float) -> float | None:
    return factor * value if math.isfinite(value) else None
