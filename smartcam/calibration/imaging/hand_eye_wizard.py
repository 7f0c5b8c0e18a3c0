"""The wizard that finds where a camera is on a robot, or beside it.

It suggests from where to look, takes a picture, finds the target in it and reads the robot, as many
times as one likes; it shows the error of poses that were left out, and names the worst pose.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from functools import partial
from typing import TYPE_CHECKING, Any

from smartcam.calibration.frames import Transform
from smartcam.calibration.imaging.detection import find_target
from smartcam.calibration.imaging.hand_eye import calibrate_hand_eye
from smartcam.calibration.imaging.hand_eye_linear import LEAST_POSES
from smartcam.calibration.imaging.hand_eye_result import KIND, HandEyeCalibration
from smartcam.calibration.imaging.hand_eye_stored import (
    motion_from_data,
    motion_to_data,
    view_from_data,
    view_to_data,
)
from smartcam.calibration.sequence import Wizard, ask
from smartcam.calibration.steps import Number, Option, Step
from smartcam.calibration.store import write
from smartcam.exceptions import CalibrationError
from smartcam.models import Pose

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from smartcam.calibration.imaging.cameras import CameraModel
    from smartcam.calibration.imaging.hand_eye_fit import Setup
    from smartcam.calibration.imaging.targets import Target
    from smartcam.calibration.steps import Answers

__all__ = ["MOST_VIEWS", "SUGGESTIONS", "ReadFlange", "TakePicture", "hand_eye_wizard"]

TakePicture = Callable[[], Awaitable[Any]]
"""Takes a picture and returns it: uint8, (H, W) or (H, W, 3)."""

ReadFlange = Callable[[], Awaitable[Transform | Pose]]
"""Returns ``T_base_flange``, the flange's pose in the robot's base."""

MOST_VIEWS = 40
"""Of one run: far more than it takes."""

ADVISED_VIEWS = 10
"""From which on the wizard offers to calculate first."""

CALCULATION = 120.0
"""Seconds that it may take; of 15 views it takes a few."""

_MOVES: Mapping[str, str] = {
    "eye-in-hand": "Bring the camera to where it looks at the sheet",
    "eye-to-hand": "Bring the sheet before the camera, and hold it",
}

SUGGESTIONS = (
    "straight from the front, the sheet in the middle of the image",
    "tilted by 30 degrees about one side of the sheet",
    "tilted by 30 degrees to the opposite side",
    "tilted by 30 degrees about the other side of the sheet",
    "tilted by 30 degrees to the opposite side of that",
    "turned by 90 degrees about the line of sight",
    "turned by 90 degrees the other way, and tilted by 20 degrees",
    "nearer, so that the sheet fills the image, tilted by 20 degrees",
    "farther away, tilted by 30 degrees towards a corner of the sheet",
    "with the sheet in a corner of the image, tilted towards another corner",
)
"""From where to look, one view after the other; then from the beginning, a bit beside it."""


def hand_eye_wizard(
    *,
    target: Target,
    take_picture: TakePicture,
    read_robot: ReadFlange,
    save_to: Callable[[str], Path],
    camera: CameraModel | None = None,
) -> Wizard:
    """Return the wizard.

    Its parameters: ``name`` (of the calibration; what ``save_to`` gets), ``setup`` (default of the
    first step).

    Its result: ``name, file, method, views, held_out_mm, mean_mm, translation_error_mm,
    rotation_error_deg, remarks``.

    Args:
        target: what is on the sheet.
        take_picture: takes a picture; the robot stands still.
        read_robot: reads the pose of the flange.
        save_to: returns the file for a name.
        camera: its lens; None: calibrated from the same views.

    Cancellation: a picture or a pose under way is given up; a calculation ends in its thread, and
    what it finds is dropped.
    """

    async def script(parameters: Mapping[str, Any]) -> Any:
        setup = await _ask_setup(parameters)
        work = _Work(target, setup, take_picture, read_robot, camera)
        calibration = await work.views()
        name = str(parameters.get("name", "hand-eye"))
        file = save_to(name)
        step = Step(
            id="save",
            title=f"Save {name}",
            description="A calibration of that name is kept beside it as a backup.",
            button="Save",
            notes=tuple(_summary(calibration)),
        )
        await ask(step, partial(_save, file, calibration))
        return {"name": name, "file": file.name, **_figures(calibration)}

    return Wizard(name=KIND, version=1, script=script)


async def _ask_setup(parameters: Mapping[str, Any]) -> Setup:
    setup = Option(
        name="setup",
        label="Where the camera is",
        options={
            "eye-in-hand": "on the robot's hand; the sheet lies still",
            "eye-to-hand": "beside the robot; the sheet is on the hand",
        },
        default="eye-to-hand" if parameters.get("setup") == "eye-to-hand" else "eye-in-hand",
    )
    step = Step(
        id="about",
        title="Camera and robot",
        description="The sheet must not slip on what carries it until all pictures are taken.",
        inputs=(setup,),
    )
    return "eye-to-hand" if (await ask(step))["setup"] == "eye-to-hand" else "eye-in-hand"


async def _save(file: Path, calibration: HandEyeCalibration, _answers: Answers) -> dict[str, Any]:
    write(file, KIND, calibration.to_data())
    return {"file": file.name}


class _Work:
    """One run of the wizard; holds nothing but what the answers gave."""

    def __init__(
        self,
        target: Target,
        setup: Setup,
        take_picture: TakePicture,
        read_robot: ReadFlange,
        camera: CameraModel | None,
    ) -> None:
        self._target = target
        self._setup: Setup = setup
        self._take_picture = take_picture
        self._read_robot = read_robot
        self._camera = camera
        self._samples: list[dict[str, Any]] = []

    async def views(self) -> HandEyeCalibration:
        """Return what the samples gave that were taken in the end."""
        while True:
            while await self._take_view():
                pass
            calibration, notes = await self._calculate()
            answers = await ask(self._review(calibration, notes))
            while answers["next"] == "remove":
                del self._samples[answers["view"] - 1]
                if len(self._samples) < LEAST_POSES:
                    break
                calibration, notes = await self._calculate()
                answers = await ask(self._review(calibration, notes))
            if answers["next"] == "accept" and calibration is not None:
                return calibration

    async def _take_view(self) -> bool:
        """Take one more view; return false where it is to be calculated instead."""
        count = len(self._samples)
        if count >= MOST_VIEWS:
            return False
        inputs: tuple[Option, ...] = ()
        if count >= LEAST_POSES:
            options = {
                "view": "take this view",
                "calculate": f"calculate with the {count} views; {ADVISED_VIEWS} or more are good",
            }
            default = "view" if count < ADVISED_VIEWS else "calculate"
            inputs = (Option(name="next", label="What next", options=options, default=default),)
        look = SUGGESTIONS[count % len(SUGGESTIONS)]
        step = Step(
            id=f"view-{count + 1}",
            title=f"View {count + 1}",
            description=f"{_MOVES[self._setup]}: {look}. The whole sheet must be in the image, and "
            "the robot must stand still.",
            button="Take a picture" if not inputs else "Go on",
            inputs=inputs,
            notes=(f"{count} views so far",) if count else (),
        )
        sample = (await ask(step, self._sample)).outcome
        if sample:
            self._samples.append(sample)
        return bool(sample)

    async def _sample(self, answers: Answers) -> dict[str, Any]:
        """Take a picture and read the robot, if that is wanted."""
        if answers.get("next") == "calculate":
            return {}
        image = await self._take_picture()
        pose = await self._read_robot()
        flange = Transform.from_pose(pose, "flange") if isinstance(pose, Pose) else pose
        name = f"view {len(self._samples) + 1}"
        view = await asyncio.to_thread(find_target, image, self._target, name=name)
        frames = [flange.target, flange.source]
        return {"frames": frames, "pose": motion_to_data(flange), "view": view_to_data(view)}

    async def _calculate(self) -> tuple[HandEyeCalibration | None, list[str]]:
        step = Step(
            id="calculate",
            title="Calculate",
            description="Several ways are compared by the poses that each has not seen.",
            button="Calculate",
            notes=(f"{len(self._samples)} views",),
            timeout=CALCULATION,
        )
        found = (await ask(step, self._solve)).outcome
        if "code" in found:
            return None, [f"{found['code']}: {found['text']}"]
        views = [one["view"] for one in self._samples]
        calibration = HandEyeCalibration.from_data({**found, "views": views})
        return calibration, _summary(calibration)

    async def _solve(self, _answers: Answers) -> dict[str, Any]:
        """Return the calibration without the samples' views, or why there is none."""
        poses = [motion_from_data(one["pose"], *one["frames"]) for one in self._samples]
        views = [view_from_data(one["view"], self._target) for one in self._samples]
        work = partial(calibrate_hand_eye, poses, views, setup=self._setup, camera=self._camera)
        try:
            calibration = await asyncio.to_thread(work)
        except CalibrationError as exc:
            return {"code": str(exc.code), "text": str(exc)}
        return {**calibration.to_data(), "views": []}

    def _review(self, calibration: HandEyeCalibration | None, notes: Sequence[str]) -> Step:
        options = {
            "accept": "accept it",
            "more": "take another view",
            "remove": "remove a view",
        }
        worst = len(self._samples)
        if calibration is None:
            del options["accept"]
        else:
            worst = 1 + calibration.worst
        return Step(
            id="review",
            title="What came out",
            notes=tuple(notes),
            inputs=(
                Option(name="next", label="What next", options=options),
                Number(
                    name="view",
                    label="View to remove; the worst one stands there",
                    integer=True,
                    minimum=1,
                    maximum=len(self._samples),
                    default=worst,
                ),
            ),
        )


def _figures(calibration: HandEyeCalibration) -> dict[str, Any]:
    held_out = calibration.held_out_error
    return {
        "method": calibration.method,
        "views": len(calibration.views),
        "held_out_mm": None if held_out is None else 1e3 * held_out,
        "mean_mm": 1e3 * calibration.mean_error,
        "translation_error_mm": _known(1e3, calibration.translation_error),
        "rotation_error_deg": _known(math.degrees(1.0), calibration.rotation_error),
        "remarks": [f"{one.code}: {one.text}" for one in calibration.warnings],
    }


def _known(factor: float, value: float) -> float | None:
    return factor * value if math.isfinite(value) else None


def _summary(calibration: HandEyeCalibration) -> list[str]:
    """Return what people should know of a calibration, a line each."""
    figures = _figures(calibration)
    lines = [f"{figures['views']} views, {figures['method']}"]
    if figures["held_out_mm"] is not None:
        lines.append(
            f"{figures['held_out_mm']:.3g} mm rms on the sheet, at views that were left out"
        )
        worst = calibration.worst
        off = 1e3 * float(calibration.leave_one_out[worst])
        lines.append(f"the worst is view {worst + 1}: {off:.3g} mm")
    if figures["translation_error_mm"] is not None:
        lines.append(
            f"the camera's place is known to {figures['translation_error_mm']:.2g} mm, its "
            f"orientation to {figures['rotation_error_deg']:.2g} deg"
        )
    return [*lines, *figures["remarks"]]
