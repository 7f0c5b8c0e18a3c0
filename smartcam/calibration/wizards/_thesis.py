"""Offer a camera's calibrations as the thesis' five services: one wizard, without tokens.

The steps are those of the page and of the terminal, after a first step that asks for facts without
a field in the request: the name, the camera's place, the source of pictures. A request does not
name its step, so only one call is answered at a time, and a sequence belongs to the client that
started it until it ends, is aborted or is abandoned.

Source: thesis 2.2.2, Figures 2.8 to 2.12 (published) for the services and their fields.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, TypeVar

from smartcam.calibration._files.directory import MAX_NAME_LENGTH, NAME, Folder
from smartcam.calibration.wizards._hand_eye import hand_eye_wizard
from smartcam.calibration.wizards._plane import plane_wizard
from smartcam.calibration.wizards._services import CalibrationService
from smartcam.calibration.wizards._sheet import sheet_wizard
from smartcam.calibration.wizards._steps import Number, Option, Step, Text, as_lists, from_lists
from smartcam.exceptions import CalibrationError, SmartCamError
from smartcam.geometry import Transform
from smartcam.geometry._inside import Code
from smartcam.models import Header, Pose

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator, Mapping, Sequence

    from smartcam.calibration._files.load import AnyCalibration
    from smartcam.calibration.wizards._sequence import Wizard, WizardSession
    from smartcam.calibration.wizards._steps import Answers, Input
    from smartcam.geometry import CameraModel
    from smartcam.models import Localization

SMARTCAMERA: Final = "SMARTCAMERA"
"""Text, instead of a topic, for the smart camera itself."""

ABANDONED_AFTER: Final = 1800.0
"""Seconds without a call after which a running calibration is given up; its journal stays."""

FIXED: Final[Mapping[str, str]] = {
    "True": "fixed in the cell, beside the robot",
    "False": "on the flange of the robot",
}
"""Places of a camera, for people, by their words in a request."""


_ABORTED: Final = Step(
    id="aborted",
    title="Aborted",
    description="There is no calibration. What was measured stays in the journal.",
    button="",
)
"""Step that reports that a calibration was aborted."""

T = TypeVar("T")


class CalibrationCamera(Protocol):
    """The smart camera that is calibrated, as the front-end of a call reaches it.

    Attributes:
        name: name of the camera.
        y_down: whether its localizations have a y axis that was turned up.
        unit: unit of its positions, ``m`` or ``px``.
    """

    @property
    def name(self) -> str: ...

    @property
    def y_down(self) -> bool: ...

    @property
    def unit(self) -> str: ...

    async def localize(self) -> list[Localization]:
        """Trigger, and return the localizations in the camera's own frame."""
        ...

    async def take_picture(self) -> Any:
        """Take a picture, and return its grey levels."""
        ...


class RobotGraph(Protocol):
    """The part of ROS other than the camera: pictures on topics, and the frames of TF."""

    def check_topic(self, topic: str) -> None:
        """Raise ConfigurationError if a topic cannot have this name."""

    def listen(self) -> None:
        """Receive transforms from now on."""

    async def picture(self, topic: str) -> tuple[Any, float | None]:
        """Return the grey levels of a picture that is taken after the call, and its time, UTC."""
        ...

    async def lens(self, topic: str) -> CameraModel | None:
        """Return the lens of the camera whose pictures are on a topic; None if unknown."""
        ...

    async def pose(self, frame: str, base: str, utc: float | None) -> Transform:
        """Return the pose of a frame in another one, at a time, or now for None."""
        ...

    async def root(self, frame: str) -> str:
        """Return the root of the tree that a frame is in."""
        ...


class CalibrationStart(NamedTuple):
    """A request of StartCalibration, with the thesis' names."""

    topic_image1: str = ""
    topic_image2: str = ""
    checkerboard_squaresize_m: float = 0.0
    tf_frame_robot_tcp: str = ""
    tf_frame_robot_base: str = ""
    fixed_camera: str = ""

    @property
    def topics(self) -> list[str]:
        """Topics with pictures that the request names, the preferred one first."""
        named = (self.topic_image2, self.topic_image1)
        return [topic for topic in named if topic not in {"", SMARTCAMERA}]

    @property
    def source(self) -> str:
        """Source of pictures: a topic, SMARTCAMERA, or an empty text for neither."""
        if self.topic_image2 == SMARTCAMERA and self.fixed_camera == "True":
            return SMARTCAMERA
        smart = SMARTCAMERA if SMARTCAMERA in {self.topic_image1, self.topic_image2} else ""
        return next(iter(self.topics), smart)


class StepRequest(NamedTuple):
    """A request of PerformCurrentAndGetNextStep, with the thesis' names."""

    repeat_last_step: bool = False
    abort: bool = False
    value_inputs: Sequence[float] = ()
    text_inputs: Sequence[str] = ()
    option_inputs: Sequence[str] = ()


class PixelPoseRequest(NamedTuple):
    """A request of TransformPixelPose.

    Attributes:
        x: coordinate to the right, in the unit of the calibration.
        y: coordinate upwards, in the same unit.
        theta: angle, counter-clockwise, radians.
        frame: frame that the pose was seen in; empty for the calibration's.
        reference: frame that the result must be in; empty for the calibration's.
        seq: number of the call.
        utc: time at which the pose was seen; None for now.
    """

    x: float
    y: float
    theta: float = 0.0
    frame: str = ""
    reference: str = ""
    seq: int = 0
    utc: float | None = None


@dataclass(eq=False)
class _Sequence:
    """A running calibration: the first step, then the wizard.

    Attributes:
        asked: request that began the sequence, with the robot's base that was found.
        first: step before the wizard.
        service: service that runs the wizard; None before it was chosen.
        shown: whether the current step was returned to a client.
        aborted: whether a call has ended it.
        pictured: time of the last picture, UTC; None if it is not known.
    """

    start_request: CalibrationStart
    first: Step
    service: CalibrationService | None = None
    shown: bool = False
    aborted: bool = False
    pictured: float | None = field(default=None)

    @property
    def session(self) -> WizardSession | None:
        """The wizard's sequence; None before it was chosen."""
        return None if self.service is None else self.service.session

    @property
    def step(self) -> Step | None:
        """Current step, with the answers that were undone; None at the end."""
        session = self.session
        if session is None:
            return self.first
        step = session.step
        return None if step is None else step.with_defaults(session.current["defaults"])

    def close(self) -> None:
        """Free the wizard; its journal stays."""
        if self.service is not None:
            self.service.close()
        self.service = None


class ThesisCalibration:
    """The calibrations of one camera, and the running one, for all front-ends together.

    Args:
        folder: folder of calibrations and journals; nothing is written outside of it.
        name: name of the camera.
        abandoned: seconds without a call after which a running calibration is given up.

    Attributes:
        graph: topics and frames of ROS; None if the camera is not in ROS.

    Raises:
        OSError: the folder cannot be created.
    """

    def __init__(
        self, folder: str | os.PathLike[str], name: str, *, abandoned: float = ABANDONED_AFTER
    ) -> None:
        self._files = CalibrationService(Folder(folder))
        self._name, self._abandoned = name, abandoned
        self.graph: RobotGraph | None = None
        self._sequence: _Sequence | None = None
        self._loaded: AnyCalibration | None = None
        self._camera: CalibrationCamera | None = None
        self._busy = False
        self._last = "none was started"
        self._called = 0.0
        self._timer: asyncio.TimerHandle | None = None

    # ------------------------------------------------------------------ StartCalibration

    async def start(self, request: CalibrationStart) -> None:
        """Begin a calibration; :meth:`perform` returns its first step.

        Raises:
            CalibrationError: ``IN_USE``: one is running; ``NOT_POSSIBLE``: topics or frames are
                named, but there is no ROS; ``WRONG_FRAME``: TF does not know the frame.
            ConfigurationError: a topic cannot have this name.
        """
        self._check_free()
        graph = self.graph
        self._check_graph(request.topics, request.tf_frame_robot_tcp)
        base = request.tf_frame_robot_base
        if graph is not None and request.tf_frame_robot_tcp and not base:
            with self._alone("StartCalibration"):
                base = await graph.root(request.tf_frame_robot_tcp)
            self._check_free()
        request = request._replace(tf_frame_robot_base=base)
        self._sequence = _Sequence(request, _first_step(request, self._name))
        self._touch()

    def _check_free(self) -> None:
        if self._sequence is not None:
            since = asyncio.get_running_loop().time() - self._called
            raise Code.IN_USE.refusal(
                f"{self._name}: a calibration is under way, whose last call came {since:.0f} s ago;"
                " expected PerformCurrentAndGetNextStep to go on with it or, with abort, to end "
                f"it. It is given up after {self._abandoned:g} s without a call"
            )

    def _check_graph(self, topics: Sequence[str], frame: str) -> None:
        """Refuse topics and frames without ROS, and names that no topic can have."""
        named = [*topics, *((frame,) if frame else ())]
        if named and self.graph is None:
            raise Code.NOT_POSSIBLE.refusal(
                f"{self._name}: {', '.join(named)}: this camera is not seen in ROS; expected "
                f"{SMARTCAMERA} or no topic, and no frames, or ros2: in the fleet file",
                got=named,
            )
        for topic in topics:
            if self.graph is not None:
                self.graph.check_topic(topic)

    # ------------------------------------------------------- PerformCurrentAndGetNextStep

    async def perform(self, request: StepRequest, camera: CalibrationCamera) -> dict[str, Any]:
        """Answer the step that was returned last; return the fields of the next step.

        Args:
            request: request with the answers.
            camera: the camera that this call uses.

        Raises:
            CalibrationError: ``NO_SEQUENCE``; ``NOT_POSSIBLE``: another call is running.

        Cancellation: a running action is cancelled, and the step stays.
        """
        sequence = self._sequence
        if sequence is None:
            raise Code.NO_SEQUENCE.refusal(
                f"{self._name}: no calibration is under way ({self._last}); expected "
                "StartCalibration first"
            )
        if request.abort:
            return await self._abort(sequence)
        with self._alone("PerformCurrentAndGetNextStep"):
            self._camera = camera
            errors = await self._performed(sequence, request)
        if sequence.aborted:
            return _fields(_ABORTED, f"{self._name}: another call has aborted the calibration")
        return self._reply(sequence, errors)

    @contextlib.contextmanager
    def _alone(self, label: str) -> Iterator[None]:
        """Refuse a call while another call is running."""
        if self._busy:
            raise Code.NOT_POSSIBLE.refusal(
                f"{self._name}: another call is under way; {label} was not done. Expected its "
                "answer to come first, or abort"
            )
        self._busy = True
        self._touch()
        try:
            yield
        finally:
            self._busy = False
            self._touch()

    async def _performed(self, sequence: _Sequence, request: StepRequest) -> Mapping[str, str]:
        """Carry out a request; return its errors by the inputs' names."""
        first, sequence.shown = not sequence.shown, True
        try:
            if self.graph is not None and sequence.start_request.tf_frame_robot_tcp:
                self.graph.listen()  # so that the robot's pose at the picture is known
            if request.repeat_last_step:
                return await self._back(sequence)
            if first:
                return _early_inputs(request)
            return await self._answered(sequence, request)
        except SmartCamError as exc:
            return {"base": str(exc)}
        except OSError as exc:
            return {"base": f"the journal: {exc.strerror or exc}"}

    async def _answered(self, sequence: _Sequence, request: StepRequest) -> Mapping[str, str]:
        step, session = sequence.step, sequence.session
        if step is None:
            return {}
        given = from_lists(step, request.value_inputs, request.text_inputs, request.option_inputs)
        if session is None:
            await self._begin(sequence, step.checked(given))
            return {}
        view = await session.submit(session.token, given)
        errors: Mapping[str, str] = view["errors"]
        return errors

    async def _back(self, sequence: _Sequence) -> Mapping[str, str]:
        """Go back to the step before."""
        session = sequence.session
        if session is None:
            return {"base": "repeat_last_step: there is no step before this one"}
        if "undo" in session.current["can"]:
            await session.undo(session.token)
        else:
            sequence.close()
        return {}

    async def _abort(self, sequence: _Sequence) -> dict[str, Any]:
        sequence.aborted = True
        session = sequence.session
        if session is not None and session.state == "asking":
            await session.abort(session.token)
        self._end(sequence, "the last one was aborted")
        return _fields(_ABORTED, "")

    # ------------------------------------------------------------------ the wizard

    async def _begin(self, sequence: _Sequence, answers: Answers) -> None:
        """Start the wizard that the answers of the first step choose.

        Raises:
            CalibrationError: as :meth:`CalibrationService.start`.
        """
        request, name = sequence.start_request, answers["name"]
        self._files.folder.calibration(name)  # refused before anything is measured
        fixed = request.fixed_camera or answers["fixed_camera"]
        source = request._replace(fixed_camera=fixed).source or answers["pictures"]
        if source != SMARTCAMERA:
            self._check_graph([source], "")
        lens = None
        if self.graph is not None and source != SMARTCAMERA:
            lens = await self.graph.lens(source)
            if sequence.aborted:
                return
        wizard = self._wizard(sequence, fixed == "True", source, lens)
        parameters = {**_parameters(request, self._camera), "asked": [fixed, source, *request]}
        service = CalibrationService(self._files.folder, [wizard])
        _start(service, name, wizard.name, parameters)
        sequence.service = service
        sequence.first = sequence.first.with_defaults(answers)

    def _wizard(
        self, sequence: _Sequence, fixed: bool, source: str, lens: CameraModel | None
    ) -> Wizard:
        """Return the wizard for a camera in this place with this source of pictures."""
        save_to = self._files.folder.calibration
        read = bool(sequence.start_request.tf_frame_robot_tcp)

        async def take() -> Any:
            return await self._picture(sequence, source)

        async def tip() -> Pose:
            tip = await self._tool(sequence, None)
            return replace(tip, at=tip.at or datetime.now(UTC)).pose()

        async def flange() -> Transform:
            return await self._tool(sequence, sequence.pictured)

        if not fixed:
            return hand_eye_wizard(
                take_picture=take,
                save_to=save_to,
                read_robot=flange if read else None,
                camera=lens,
            )
        if source != SMARTCAMERA:
            return sheet_wizard(
                take_picture=take, save_to=save_to, read_robot=tip if read else None, camera=lens
            )
        return plane_wizard(
            localize=self._localize,
            save_to=save_to,
            read_robot=tip if read else None,
            y_down=None if self._camera is None else self._camera.y_down,
        )

    async def _localize(self) -> list[Localization]:
        return await _checked(self._camera).localize()

    async def _picture(self, sequence: _Sequence, source: str) -> Any:
        sequence.pictured = None
        if source == SMARTCAMERA:
            return await _checked(self._camera).take_picture()
        image, sequence.pictured = await _checked(self.graph).picture(source)
        return image

    async def _tool(self, sequence: _Sequence, utc: float | None) -> Transform:
        request = sequence.start_request
        return await _checked(self.graph).pose(
            request.tf_frame_robot_tcp, request.tf_frame_robot_base, utc
        )

    # ------------------------------------------------------------------ the end

    def _reply(self, sequence: _Sequence, errors: Mapping[str, str]) -> dict[str, Any]:
        """Return the fields of a reply with the current step, or with the end."""
        error = "; ".join(
            text if name == "base" else f"{name}: {text}" for name, text in errors.items()
        )
        step, session = sequence.step, sequence.session
        if step is None and session is not None:
            view, name = session.current, str(session.parameters["name"])
            step = _last_step(name, view)
            if session.state == "ended":
                self._end(sequence, f"{name!r} was finished")
                # a calibration that maps no pixels
                with contextlib.suppress(CalibrationError, OSError):
                    self.load(name)
        return _fields(step or sequence.first, error)

    def _end(self, sequence: _Sequence, how: str) -> None:
        sequence.close()
        self._sequence, self._last = None, how
        self._touch()

    def _touch(self) -> None:
        """Restart the time after which a running calibration is given up."""
        loop = asyncio.get_running_loop()
        self._called = loop.time()
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None
        if self._sequence is not None and not self._busy:
            self._timer = loop.call_later(self._abandoned, self._give_up)

    def _give_up(self) -> None:
        if self._sequence is not None:
            text = f"the last one was left for {self._abandoned:g} s; it goes on where it was when "
            self._end(self._sequence, text + "the same is started under the same name")

    def close(self) -> None:
        """End the running calibration, which can be resumed. Idempotent."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None
        sequence, self._sequence = self._sequence, None
        if sequence is not None:
            sequence.close()

    # ------------------------------------------------------------------ other services

    def export(self, name: str, target: str) -> None:
        """Copy a calibration into the folder's ``exports``.

        Raises:
            CalibrationError: as :meth:`CalibrationService.export`.
        """
        self._files.export(name, target)

    def load(self, name_or_path: str) -> None:
        """Load a calibration for :meth:`transform` to use from now on.

        Raises:
            CalibrationError, OSError: as :meth:`CalibrationService.load`.
        """
        self._loaded = self._files.load(name_or_path)

    async def transform(self, seen: PixelPoseRequest) -> Pose:
        """Return the robot's pose for a pose that a camera saw, in the wanted frame.

        Raises:
            CalibrationError: ``NO_CALIBRATION``, ``WRONG_FRAME``, ``OUT_OF_FIELD``, ``BAD_TIME``.
        """
        calibration = self._loaded
        if calibration is None:
            raise Code.NO_CALIBRATION.refusal(
                f"{self._name}: no calibration is loaded; expected LoadCalibration first"
            )
        pose = self._files.transform(seen.x, seen.y, seen.theta)
        if seen.frame and calibration.camera_frame not in {None, seen.frame}:
            raise Code.WRONG_FRAME.unexpected(
                f"frame_id: expected {calibration.camera_frame!r}, the camera's frame",
                calibration.camera_frame,
                seen.frame,
            )
        robot, wanted = calibration.robot_frame, seen.reference or calibration.robot_frame
        at = datetime.now(UTC) if seen.utc is None else datetime.fromtimestamp(seen.utc, UTC)
        if wanted != robot:
            lead = await self._lead(robot, wanted, seen.utc)
            part = lead.undated() @ Transform.from_pose(pose, "part").undated()
            pose = replace(part, at=at).pose()
        return pose._replace(header=Header(seen.seq, at, wanted))

    async def _lead(self, robot: str, wanted: str, utc: float | None) -> Transform:
        """Return the pose of the robot's frame in the wanted frame."""
        if self.graph is None:
            raise Code.WRONG_FRAME.unexpected(
                f"tf_frame_reference: expected {robot!r}, since this camera is not seen in ROS, "
                "whose TF would lead elsewhere",
                robot,
                wanted,
            )
        return await self.graph.pose(robot, wanted, utc)


class CalibrationDesks:
    """The calibrations of an agent's cameras, in one folder.

    Args:
        folder: folder of calibrations and journals, which is created if needed.

    Raises:
        OSError: the folder cannot be created.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._folder = Folder(folder).path
        self._desks: dict[str, ThesisCalibration] = {}

    def of(self, camera: str) -> ThesisCalibration:
        """Return the calibrations of a camera."""
        desk = self._desks.get(camera)
        if desk is None:
            desk = self._desks[camera] = ThesisCalibration(self._folder, camera)
        return desk

    def close(self) -> None:
        """End running calibrations, which can be resumed."""
        for desk in self._desks.values():
            desk.close()


def _checked(value: T | None) -> T:
    """Return a value that earlier checks found not to be None."""
    if value is None:
        raise Code.NOT_POSSIBLE.refusal(
            "the camera is not seen in ROS any more; expected it to come back, or abort"
        )
    return value


def _first_step(request: CalibrationStart, camera: str) -> Step:
    """Return the step that asks for the facts that a request lacks."""
    inputs: list[Input] = [
        Text(
            name="name",
            label="Name of the calibration",
            default=re.sub("[^A-Za-z0-9]+", "-", camera)[:MAX_NAME_LENGTH].strip("-") or "camera",
            pattern=NAME,
            expected="letters, digits, '-' and '_'",
            max_length=MAX_NAME_LENGTH,
        )
    ]
    if not request.source:
        label = f"Topic with pictures of the camera, or {SMARTCAMERA} for this camera itself"
        inputs.append(Text(name="pictures", label=label, default=SMARTCAMERA))
    if not request.fixed_camera:
        inputs.append(Option(name="fixed_camera", label="Where the camera is", options=FIXED))
    text = "A calibration of this name that was broken off goes on where it was."
    return Step(id="first", title="Calibration", description=text, inputs=tuple(inputs))


def _parameters(request: CalibrationStart, camera: CalibrationCamera | None) -> dict[str, Any]:
    """Return the defaults of a wizard's steps that a request gives."""
    defaults: dict[str, Any] = {"setup": "eye-in-hand"}
    if camera is not None:
        defaults["camera_unit"] = camera.unit
    if request.tf_frame_robot_base:
        defaults["robot_frame"] = request.tf_frame_robot_base
    if request.checkerboard_squaresize_m:
        defaults["square"] = 1e3 * request.checkerboard_squaresize_m
    return defaults


def _start(
    service: CalibrationService, name: str, wizard: str, parameters: Mapping[str, Any]
) -> None:
    """Start a wizard, or resume an interrupted one that was started in the same way."""
    try:
        service.start(name, wizard, parameters)
        same = service.session.parameters["asked"] == parameters["asked"]
    except CalibrationError as exc:
        if exc.code not in {Code.WRONG_JOURNAL, Code.BROKEN_FILE}:
            raise
        same = False
    if not same:
        service.start(name, wizard, parameters, fresh=True)


def _early_inputs(request: StepRequest) -> Mapping[str, str]:
    """Return the error for answers to a step that was never returned to a client."""
    if request.value_inputs or request.text_inputs or request.option_inputs:
        return {"base": "this step was not shown before; expected no inputs in the first call"}
    return {}


def _last_step(name: str, view: Mapping[str, Any]) -> Step:
    """Return a step that reports the result."""
    verdict, file = view["verdict"], view["result"]["file"]
    verdict_text = "" if verdict is None else f"{verdict['text']} "
    text = f"{verdict_text}It is in the file {file}, and loaded where it maps pixels."
    return Step(id="done", title=f"The calibration {name} is done", description=text, button="")


def _fields(step: Step, error: str) -> dict[str, Any]:
    """Return the fields of a reply with a step."""
    texts = [step.description]
    for input_field in step.inputs:
        if isinstance(input_field, Option):
            texts.append(f"{input_field.label}:")
            texts += [f"  {key}: {text}" for key, text in input_field.options.items()]
    if any(
        input_field.optional and input_field.minimum > 0
        for input_field in step.inputs
        if isinstance(input_field, Number)
    ):
        texts.append("Where a number may be missing, 0 stands for no answer.")
    if step.verdict is not None:
        texts.append(step.verdict.text)
    return {
        "error": error,
        "header_text": step.title,
        "description_text": "\n".join(text for text in (*texts, *step.notes) if text),
        "button_text": step.button,
        **as_lists(step),
    }
