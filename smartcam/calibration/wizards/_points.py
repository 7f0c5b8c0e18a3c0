"""The common part of wizards that calibrate a plane by touches of points.

A :class:`PointSource` provides the points: marks that a camera localizes, or points of a sheet that
is found in a picture. The robot touches any number of these points; or it touches three: the origin
and one point on each of the printed rays A and B.

Source: the thesis with which smartcam began, 3.2.2 to 3.2.4 (published), for the rays.
"""

from __future__ import annotations

import contextlib
import copy
import math
from abc import ABC, abstractmethod
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from smartcam.calibration._files.store import write
from smartcam.calibration._plane.diagnostics import MAX_SIGMA
from smartcam.calibration._plane.order import Reordered, find_better_order
from smartcam.calibration._plane.robust import MIN_POINTS
from smartcam.calibration._plane.touches import fit_touches
from smartcam.calibration._plane.validation import extent
from smartcam.calibration._verdict import CURES, AdvisedVerdict, poor_judgement
from smartcam.calibration.wizards._sequence import ask
from smartcam.calibration.wizards._steps import Option, Step, Text, number_input
from smartcam.calibration.wizards._touch_previews import compare_touches, touch_points
from smartcam.calibration.wizards._touches import ALLOWED, SIDE, SIDES, SIGMA, UNIT, Touches
from smartcam.calibration.wizards._usage import usage
from smartcam.exceptions import CalibrationError
from smartcam.geometry._inside import Code
from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from smartcam.calibration._files.load import AnyCalibration
    from smartcam.calibration._hand_eye.result import HandEyeCalibration
    from smartcam.calibration._plane.calibration import PlaneCalibration
    from smartcam.calibration.wizards._marks import Mark, Touch
    from smartcam.calibration.wizards._steps import Answers, Input
    from smartcam.geometry._inside import Array

MAX_POINTS = 200
"""Largest number of touches of a calibration."""

MIN_TOUCHES = 3
"""Least number of touches of a plane."""

_SIGNS_OF_OUTLIERS = frozenset({Code.OUTLIER, Code.POOR_FIT, Code.NOT_PLANAR})
"""Codes of warnings after which the user may leave out points that do not agree with the others."""


class CalibrationOutcome(NamedTuple):
    """A calibration with its figures and notes."""

    calibration: AnyCalibration | HandEyeCalibration
    figures: dict[str, Any]  # facts for the wizard's result, as JSON takes them
    notes: tuple[str, ...]  # notes for people, a line each
    judgement: AdvisedVerdict


class PointSource(Touches, ABC):
    """One run of a wizard: a source of a plane's points, and the touches of these points.

    The arguments are those of :class:`~smartcam.calibration.wizards._touches.Touches`; ``about``
    are the answers to :func:`about_step`.

    Attributes:
        connect: arguments of :func:`smartcam.connect` for the camera; None: it is not known.
        camera_frame: name of the only frame that localizations may come in; None: any.
        y_down: whether the camera's own y axis points down, so that y was reversed; None: not
            known.
    """

    KIND: ClassVar[str]
    """Kind of the calibration in the store."""
    MIN_TOUCHES_FOR_RESULT: ClassVar[int] = MIN_TOUCHES
    """Number of points that are touched before the result is shown."""
    POINTS: ClassVar[str]
    """Name of the points, for people."""
    ORIGIN: ClassVar[str]
    """Name of the origin of the rays, for people."""
    MORE: ClassVar[str]
    """Text of the option to touch more points."""
    PREVIEW_EXTRAS: ClassVar[Mapping[str, str]] = {}
    """Further entries of a calibration's preview."""

    connect: Mapping[str, Any] | None = None
    camera_frame: str | None = None
    y_down: bool | None = None

    @abstractmethod
    async def add_points(self) -> None:
        """Ask for touches of one or more further points."""

    @abstractmethod
    async def ask_again(self, index: int) -> None:
        """Ask for a touch that replaces the touch with an index."""

    @abstractmethod
    async def find_ray_origin(self) -> tuple[Mark, float]:
        """Return the origin of the rays, and the metres per unit of the camera."""

    @abstractmethod
    def fit(self, *, robust: bool) -> PlaneCalibration:
        """Fit a plane to the touches; raise CalibrationError if no plane fits."""

    @abstractmethod
    def sample_entries(self, touch: Touch) -> dict[str, Any]:
        """Return the entries of a touch in a file's samples, as JSON takes them."""

    @abstractmethod
    def example_point(self) -> tuple[float, float]:
        """Return a point that the camera saw, in its unit."""

    @abstractmethod
    def calibration_outcome(self, plane: PlaneCalibration) -> CalibrationOutcome:
        """Return the calibration of a plane, with its figures and notes."""

    async def run(self, name: str, save_to: Callable[[str], Path]) -> dict[str, Any]:
        """Ask for touches and whether to save the calibration; return the wizard's result."""
        rays = self.about["method"] == "rays"
        plane = self._with_allowed_error(
            await (self._touch_rays() if rays else self._touch_points())
        )
        about, outcome = self.about, self.calibration_outcome(plane)
        context = {
            "frames": {"camera": about["camera_frame"] or None, "robot": about["robot_frame"]},
            "camera_unit": self.camera_unit,
            "tool": about["tool"],
            "method": about["method"],
            "samples": [
                {
                    **self.sample_entries(touch),
                    "robot": list(touch.robot),
                    "tool_z": None if touch.tool_z is None else list(touch.tool_z),
                }
                for touch in self.touches
            ],
        }
        preview = self._preview(plane)
        result = await ask_to_save(name, save_to, self.KIND, outcome, preview, context)
        frame = {} if self.camera_frame is None else {"name": self.camera_frame}
        connect = None if self.connect is None else {**self.connect, **frame}
        use = usage(self.KIND, save_to(name), connect, self.example_point())
        return {**result, "use": use}

    async def _touch_rays(self) -> PlaneCalibration:
        origin, scale = await self.find_ray_origin()
        for letter, place, mark in (
            ("O", self.ORIGIN, origin),
            ("A", "a point of ray A, as far out as it goes", replace(origin, number=None)),
            ("B", "a point of ray B, as far out as it goes", replace(origin, number=None)),
        ):
            touch = await self.ask_mark_touch(
                f"touch-{letter}", f"Touch {letter}", place, mark, letter
            )
            self.touches.append(touch)
        header = Header(0, datetime.fromtimestamp(0, UTC), self.camera_frame or "")
        pose = Pose(header, Position(origin.x, origin.y), Quaternion.from_theta(origin.theta))
        plane = fit_touches(
            Localization(origin.feature, 1.0, 0, pose),
            *self.tip_positions,
            nominal_scale=scale,
            touch_sigma=self.sigma,
            tool_z=self.tool_z,
            robot_frame=self.about["robot_frame"],
            camera_frame=self.camera_frame,
            y_down=self.y_down,
        )
        outcome = self.calibration_outcome(self._with_allowed_error(plane))
        await ask(
            Step(
                id="review",
                title="What came out",
                description="Three touches fit any plane: no test shows their quality. To "
                f"know, touch {self.POINTS} instead.",
                button="Accept",
                notes=outcome.notes,
                verdict=outcome.judgement.verdict,
                preview=self._preview(plane),
            )
        )
        return plane

    async def _touch_points(self) -> PlaneCalibration:
        min_count, robust = self.MIN_TOUCHES_FOR_RESULT, False
        retouched: set[int] = set()  # numbers of the points that were touched again
        while True:
            while len(self.touches) < min_count:
                await self.add_points()
            min_count = MIN_TOUCHES
            plane, notes, judgement = self._try_fit(robust=robust)
            judgement = _avoid_repeated_advice(judgement, retouched, len(self.touches))
            order = self._better_order() if judgement.verdict.level == "poor" else None
            choice = await ask(self._review(plane, notes, judgement, order, robust=robust))
            index = choice["point"] - 1
            match choice["next"]:
                case "accept" if plane is not None:
                    return plane
                case "more":
                    await self.add_points()
                case "redo":
                    await self.ask_again(index)
                    retouched.add(index + 1)
                case "remove":
                    del self.touches[index]
                    retouched.clear()  # the numbers of points have changed
                case "reorder" if order is not None:
                    self.touches = [
                        replace(touch, robot=self.touches[i].robot, tool_z=self.touches[i].tool_z)
                        for touch, i in zip(self.touches, order.order, strict=True)
                    ]
                case "side":
                    await self._ask_side()
                case _:
                    robust = choice["next"] == "robust"

    async def _ask_side(self) -> None:
        """Ask where the tool pointed at all touches."""
        step = Step(id="side", title="Where the tool points", inputs=(SIDE,))
        self.side = (await ask(step))["side"]
        self.touches = [replace(touch, tool_z=SIDES[self.side]) for touch in self.touches]

    def _try_fit(
        self, *, robust: bool
    ) -> tuple[PlaneCalibration | None, tuple[str, ...], AdvisedVerdict]:
        try:
            fitted = self.fit(robust=robust and len(self.touches) >= MIN_POINTS)
            plane = self._with_allowed_error(fitted)
        except CalibrationError as exc:
            return None, (f"{exc.code}: {exc}",), self._judge_error(exc)
        _, _, notes, judgement = self.calibration_outcome(plane)
        return plane, notes, judgement

    def _with_allowed_error(self, plane: PlaneCalibration) -> PlaneCalibration:
        """Set the user's allowed error in a calibration, and return it."""
        allowed = self.about["allowed"]
        return replace(plane, allowed_error=None if allowed is None else 1e-3 * allowed)

    def _better_order(self) -> Reordered | None:
        """Return the one order of the touches that fits far better; None for none or several."""
        touched = np.array(self.tip_positions)
        sigma = self.sigma or MAX_SIGMA.of(extent(touched))
        marks = np.array([(touch.mark.x, touch.mark.y) for touch in self.touches])
        return find_better_order(marks, touched, sigma)

    def _judge_error(self, error: CalibrationError) -> AdvisedVerdict:
        """Return the judgement of a failed fit; it names a wrong or exchanged touch if possible."""
        if (order := self._better_order()) is not None:
            numbers = np.arange(1, 1 + len(self.touches))
            return poor_judgement(Code.WRONG_ORDER, order.remark(numbers).text)
        if len(self.touches) >= MIN_POINTS:
            with contextlib.suppress(CalibrationError):
                for index in self.fit(robust=True).outliers:
                    return poor_judgement(Code.OUTLIER, f"point {1 + index}")
        elif (
            len(fitting_without := [i for i in range(len(self.touches)) if self._fits_without(i)])
            == 1
        ):
            return poor_judgement(Code.OUTLIER, f"point {1 + fitting_without[0]}")
        return poor_judgement(error.code or "", str(error))

    def _fits_without(self, index: int) -> bool:
        """Return True if the other touches fit without a touch, and are enough to test the fit."""
        others = copy.copy(self)
        others.touches = [*self.touches[:index], *self.touches[index + 1 :]]
        try:
            codes = {warning.code for warning in others.fit(robust=False).warnings}
        except CalibrationError:
            return False
        return len(others.touches) > MIN_TOUCHES and codes.isdisjoint(CURES)

    def _review(
        self,
        plane: PlaneCalibration | None,
        notes: tuple[str, ...],
        judgement: AdvisedVerdict,
        order: Reordered | None,
        *,
        robust: bool,
    ) -> Step:
        options = {
            "accept": accept_option_text(judgement),
            "more": self.MORE,
            "redo": "touch a point again",
            "remove": "remove a point",
        }
        worst = 1
        if plane is None:
            del options["accept"]
        else:
            worst = 1 + min(plane.outliers, default=plane.worst)
        if order is not None and order.sure:
            moved_points = ", ".join(str(1 + index) for index in order.moved)
            options["reorder"] = f"exchange the touches of the points {moved_points}, as fits best"
        if judgement.option == "side" and self._read_robot is None:
            options["side"] = "say where the tool points"
        doubtful = plane is None or any(
            warning.code in _SIGNS_OF_OUTLIERS for warning in plane.warnings
        )
        if robust:
            options["all"] = "count all points, also those that do not agree with the others"
        elif len(self.touches) >= MIN_POINTS and doubtful:
            options["robust"] = "leave out the points that do not agree with the others"
        label = "Point, to touch again or to remove; the worst one is filled in"
        advised = judgement.number or worst
        count = len(self.touches)
        point = number_input("point", label, count, advised if advised <= count else worst)
        return review_step(options, point, notes, judgement, self._preview(plane))

    def _preview(self, plane: PlaneCalibration | None) -> dict[str, Any]:
        """Return the data for a picture of the touches."""
        if plane is None:
            return {**touch_points(self.touches), "choices": self._choices()}
        comparison = compare_touches(
            plane,
            self.touches,
            plane.camera_points,
            plane.residuals,
            plane.leave_one_out,
            worst=plane.worst,
            excluded=plane.outliers,
        )
        return {**comparison, **self.PREVIEW_EXTRAS, "choices": self._choices(comparison["points"])}

    def _choices(self, points: Sequence[Mapping[str, Any]] = ()) -> list[dict[str, Any]]:
        """Return clickable choices for the touches, at the places where the touches are drawn."""
        places = [point["at"][:2] for point in points] or [
            [t.mark.x, t.mark.y] for t in self.touches
        ]
        return [
            {"at": place, "label": str(number), "answers": {"point": number}}
            for number, place in enumerate(places, 1)
        ]


def _avoid_repeated_advice(
    judgement: AdvisedVerdict, retouched: Collection[int], count: int
) -> AdvisedVerdict:
    """Return other advice if a judgement asks for a touch that was repeated already.

    ``retouched``: numbers of the points that were touched again. ``count``: number of all points.
    """
    number = judgement.number
    if judgement.option != "redo" or number not in retouched:
        return judgement
    advice = (
        "remove it, and touch another one" if count > MIN_TOUCHES else "touch more points first"
    )
    text = (
        f"Not good enough: point {number} was touched again, and still does not agree with the "
        f"others. Look whether its mark has moved, whether another mark was touched, and whether "
        f"the tool is held as at the others; or {advice}"
    )
    verdict = replace(judgement.verdict, text=text)
    return judgement._replace(verdict=verdict, option="remove" if count > MIN_TOUCHES else "more")


def about_step(
    description: str,
    methods: Mapping[str, str],
    parameters: Mapping[str, Any],
    *more: Input,
    typed: bool,
) -> Step:
    """Return the first step of a wizard with a source of points.

    ``methods``: texts for the things that can be touched; ``rays`` is one key. ``parameters``:
    defaults of the inputs; raises WRONG_ANSWERS if a default is not valid. ``more``: further
    inputs, after the method. ``typed``: whether the robot's pose is typed.
    """
    step = Step(
        id="about",
        title="Camera, robot and tool",
        description=description,
        inputs=(
            Option(name="method", label="What is touched", options=methods),
            *more,
            Text(
                name="camera_frame",
                label="Name of the only frame that localizations may come in; empty: any",
                default="",
            ),
            Text(name="robot_frame", label="Name of the robot's frame", default="robot"),
            Text(name="tool", label="Which tool touches", default=""),
            UNIT,
            *((SIDE,) if typed else ()),
            SIGMA,
            ALLOWED,
        ),
    )
    return step.with_defaults(parameters)


def accept_option_text(judgement: AdvisedVerdict) -> str:
    """Return the text of the option that accepts the calibration."""
    if judgement.verdict.level == "good":
        return "accept it"
    return "accept it all the same; each program that loads it is warned"


def review_step(
    options: Mapping[str, str],
    number: Input,
    notes: tuple[str, ...],
    judgement: AdvisedVerdict,
    preview: Mapping[str, Any] | None = None,
) -> Step:
    """Return the step that shows the result and asks what to do ``next``.

    ``number``: input for the number of a point or view.
    """
    default = judgement.choose_option(options)
    return Step(
        id="review",
        title="What came out",
        notes=notes,
        verdict=judgement.verdict,
        inputs=(Option(name="next", label="What next", options=options, default=default), number),
        preview=preview,
    )


async def ask_to_save(
    name: str,
    save_to: Callable[[str], Path],
    kind: str,
    outcome: CalibrationOutcome,
    preview: Mapping[str, Any] | None = None,
    context: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Ask whether to save a calibration with its context; return the wizard's result."""
    file = save_to(name)

    async def save(_answers: Answers) -> dict[str, Any]:
        write(file, kind, outcome.calibration.to_data(), context=context)
        return {"file": file.name}

    step = Step(
        id="save",
        title=f"Save {name}",
        description="A calibration of that name is kept beside it as a backup.",
        button="Save",
        notes=outcome.notes,
        verdict=outcome.judgement.verdict,
        preview=preview,
    )
    await ask(step, save)
    return {"name": name, "file": file.name, "path": str(file), **outcome.figures}


def plane_outcome(
    calibration: PlaneCalibration,
    label: str = "the camera's x axis",
    direction: Array | None = None,
) -> CalibrationOutcome:
    """Return a plane's calibration with its figures, in mm, and its notes.

    ``label``: name of ``direction`` (3,), a direction in the robot's frame; None: the camera's x
    axis.
    """
    counted = calibration.weights > 0.0
    residual = 1e3 * math.sqrt(float((calibration.residuals[counted] ** 2).sum(axis=1).mean()))
    held_out, predicted = calibration.held_out_error, None
    if calibration.touch_sigma is not None:
        at_points = calibration.predicted_error(calibration.camera_points[counted])
        predicted = 1e3 * math.sqrt(float((at_points**2).mean()))
    points, left_out = int(counted.sum()), [1 + index for index in calibration.outliers]
    total_text = f" of {points + len(left_out)}" if left_out else ""
    notes = [
        f"model {calibration.model} from {points}{total_text} points",
        f"residual {residual:.3f} mm rms: how well the points fit",
    ]
    if held_out is not None:
        notes.append(
            f"held-out error {1e3 * held_out:.3f} mm rms: each point against a calibration from "
            f"the others; the worst is point {calibration.worst + 1}"
        )
    if predicted is not None:
        notes.append(f"predicted error {predicted:.3f} mm rms at the points")
    x, y, z = calibration.rotation[:, 0] if direction is None else direction
    notes.append(
        f"{label} lies along ({x:.2f}, {y:.2f}, {z:.2f}) of the robot: check this; a regular grid "
        "fits just as well if the touches began at the wrong corner"
    )
    notes += [f"{warning.code}: {warning.text}" for warning in calibration.warnings]
    judgement = calibration.judged()
    figures = {
        **judgement.figures,
        "model": calibration.model,
        "points": points,
        "left_out": left_out,
        "residual_mm": residual,
        "held_out_mm": None if held_out is None else 1e3 * held_out,
        "predicted_mm": predicted,
        "remarks": [[warning.code.value, warning.text] for warning in calibration.warnings],
    }
    return CalibrationOutcome(calibration, figures, tuple(notes), judgement)
