"""Offer a camera's calibrations as five services, which the thesis behind smartcam defines.

The steps are the same as on the web page and in the terminal, after a first step that asks for
facts that have no field in the request: the name, the camera's place, the source of pictures. A
request does not name its step, so only one call is answered at a time, and a second calibration
cannot start until the running one ends, is aborted or is abandoned.

Source: the thesis with which smartcam began, 2.2.2, Figures 2.8 to 2.12 (published) for the
services and their fields.
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
"""Text in place of a topic: pictures come from the smart camera itself."""

ABANDONED_AFTER: Final = 1800.0
"""Seconds without a call after which a running calibration is abandoned; its journal is kept."""

CAMERA_PLACES: Final[Mapping[str, str]] = {
    "True": "fixed in the cell, beside the robot",
    "False": "on the flange of the robot",
}
"""Texts for the places of a camera, by the words of the request's ``fixed_camera``."""


_ABORTED: Final = Step(
    id="aborted",
    title="Aborted",
    description="There is no calibration. What was measured stays in the journal.",
    button="",
)
"""Step that reports that a calibration was aborted."""

T = TypeVar("T")


class CalibrationCamera(Protocol):
    """The smart camera that is calibrated, as a front-end reaches it.

    Attributes:
        name: name of the camera.
        y_down: whether the camera's own y axis points down, so that y was reversed.
        unit: unit of the camera's positions, ``m`` or ``px``.
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


class RosAccess(Protocol):
    """Access to the rest of ROS: pictures on topics, lenses, and the frames of TF."""

    def check_topic(self, topic: str) -> None:
        """Raise ConfigurationError if a topic cannot have this name."""

    def listen(self) -> None:
        """Receive transforms from now on."""

    async def picture(self, topic: str) -> tuple[Any, float | None]:
        """Return the grey levels of a picture that is taken after the call, and its time, UTC."""
        ...

    async def lens(self, topic: str) -> CameraModel | None:
        """Return the lens calibration of the camera with pictures on a topic; None if unknown."""
        ...

    async def pose(self, frame: str, base: str, utc: float | None) -> Transform:
        """Return the pose of a frame in the frame ``base`` at a time; None for now."""
        ...

    async def root(self, frame: str) -> str:
        """Return the root of the frame's tree."""
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
        names = (self.topic_image2, self.topic_image1)
        return [topic for topic in names if topic not in {"", SMARTCAMERA}]

    @property
    def source(self) -> str:
        """Source of pictures: a topic or SMARTCAMERA; "" if the request names neither."""
        if self.topic_image2 == SMARTCAMERA and self.fixed_camera == "True":
            return SMARTCAMERA
        smart_camera = SMARTCAMERA if SMARTCAMERA in {self.topic_image1, self.topic_image2} else ""
        return next(iter(self.topics), smart_camera)


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
        frame: frame in which the pose was seen; empty for the calibration's frame.
        reference: frame in which the result must be; empty for the calibration's frame.
        seq: sequence number of the call.
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
class _RunningCalibration:
    """A running calibration: the first step, then the wizard.

    Attributes:
        start_request: request that started the wizard; the robot's base is filled in.
        first_step: step before the wizard.
        service: service that runs the wizard; None: no wizard was chosen yet.
        was_returned: whether a step was returned to a client.
        is_aborted: whether a call has aborted the calibration.
        picture_time: time of the last picture, UTC; None: not known.
    """

    start_request: CalibrationStart
    first_step: Step
    service: CalibrationService | None = None
    was_returned: bool = False
    is_aborted: bool = False
    picture_time: float | None = field(default=None)

    @property
    def session(self) -> WizardSession | None:
        """The session of the running wizard; None: no wizard was chosen yet."""
        return None if self.service is None else self.service.session

    @property
    def step(self) -> Step | None:
        """Current step; answers that the user took back are its defaults. None at the end."""
        session = self.session
        if session is None:
            return self.first_step
        step = session.step
        return None if step is None else step.with_defaults(session.current["defaults"])

    def close(self) -> None:
        """Free the wizard; its journal is kept."""
        if self.service is not None:
            self.service.close()
        self.service = None


class ThesisCalibration:
    """The calibrations of one camera, and the running calibration, for all front-ends together.

    Args:
        folder: folder of calibrations and journals; nothing is written outside of it.
        name: name of the camera.
        abandon_timeout: seconds without a call after which a running calibration is abandoned.

    Attributes:
        graph: topics and frames of ROS; None: the camera is not in ROS.

    Raises:
        OSError: the folder cannot be created.
    """

    def __init__(
        self, folder: str | os.PathLike[str], name: str, *, abandon_timeout: float = ABANDONED_AFTER
    ) -> None:
        self._files = CalibrationService(Folder(folder))
        self._name, self._abandon_timeout = name, abandon_timeout
        self.graph: RosAccess | None = None
        self._running: _RunningCalibration | None = None
        self._loaded: AnyCalibration | None = None
        self._camera: CalibrationCamera | None = None
        self._busy = False
        self._last_end = "none was started"
        self._last_call_at = 0.0
        self._timer: asyncio.TimerHandle | None = None

    # ------------------------------------------------------------------ StartCalibration

    async def start(self, request: CalibrationStart) -> None:
        """Begin a calibration; :meth:`perform` returns its first step.

        Raises:
            CalibrationError: ``IN_USE``: a calibration is running; ``NOT_POSSIBLE``: topics or
                frames are named, but there is no ROS; ``WRONG_FRAME``: TF does not know the frame.
            ConfigurationError: a topic cannot have this name.
        """
        self._check_free()
        graph = self.graph
        self._check_graph(request.topics, request.tf_frame_robot_tcp)
        base = request.tf_frame_robot_base
        if graph is not None and request.tf_frame_robot_tcp and not base:
            with self._refuse_concurrent("StartCalibration"):
                base = await graph.root(request.tf_frame_robot_tcp)
            self._check_free()
        request = request._replace(tf_frame_robot_base=base)
        self._running = _RunningCalibration(request, _first_step(request, self._name))
        self._restart_timer()

    def _check_free(self) -> None:
        if self._running is not None:
            since = asyncio.get_running_loop().time() - self._last_call_at
            raise Code.IN_USE.error(
                f"{self._name}: a calibration is under way, whose last call came {since:.0f} s ago;"
                " expected PerformCurrentAndGetNextStep to go on with it or, with abort, to end "
                f"it. It is given up after {self._abandon_timeout:g} s without a call"
            )

    def _check_graph(self, topics: Sequence[str], frame: str) -> None:
        """Refuse topics and frames if there is no ROS, and names that no topic can have."""
        named = [*topics, *((frame,) if frame else ())]
        if named and self.graph is None:
            raise Code.NOT_POSSIBLE.error(
                f"{self._name}: {', '.join(named)}: this camera is not seen in ROS; use "
                f"{SMARTCAMERA} or no topic and name no frames, or add ros2: to the fleet file",
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
        running = self._running
        if running is None:
            raise Code.NO_SEQUENCE.error(
                f"{self._name}: no calibration is under way ({self._last_end}); expected "
                "StartCalibration first"
            )
        if request.abort:
            return await self._abort(running)
        with self._refuse_concurrent("PerformCurrentAndGetNextStep"):
            self._camera = camera
            errors = await self._carry_out(running, request)
        if running.is_aborted:
            return _reply_fields(
                _ABORTED, f"{self._name}: another call has aborted the calibration"
            )
        return self._reply(running, errors)

    @contextlib.contextmanager
    def _refuse_concurrent(self, label: str) -> Iterator[None]:
        """Refuse a call while another call is running."""
        if self._busy:
            raise Code.NOT_POSSIBLE.error(
                f"{self._name}: another call is under way; {label} was not done. Expected its "
                "answer to come first, or abort"
            )
        self._busy = True
        self._restart_timer()
        try:
            yield
        finally:
            self._busy = False
            self._restart_timer()

    async def _carry_out(
        self, running: _RunningCalibration, request: StepRequest
    ) -> Mapping[str, str]:
        """Carry out a request; return errors by the names of inputs."""
        is_first_call, running.was_returned = not running.was_returned, True
        try:
            if self.graph is not None and running.start_request.tf_frame_robot_tcp:
                self.graph.listen()  # so the robot's pose at a picture will be known
            if request.repeat_last_step:
                return await self._go_back(running)
            if is_first_call:
                return _check_no_inputs(request)
            return await self._submit_answers(running, request)
        except SmartCamError as exc:
            return {"base": str(exc)}
        except OSError as exc:
            return {"base": f"the journal: {exc.strerror or exc}"}

    async def _submit_answers(
        self, running: _RunningCalibration, request: StepRequest
    ) -> Mapping[str, str]:
        step, session = running.step, running.session
        if step is None:
            return {}
        answers = from_lists(step, request.value_inputs, request.text_inputs, request.option_inputs)
        if session is None:
            await self._start_wizard(running, step.checked(answers))
            return {}
        view = await session.submit(session.token, answers)
        errors: Mapping[str, str] = view["errors"]
        return errors

    async def _go_back(self, running: _RunningCalibration) -> Mapping[str, str]:
        """Go back to the previous step."""
        session = running.session
        if session is None:
            return {"base": "repeat_last_step: there is no step before this one"}
        if "undo" in session.current["can"]:
            await session.undo(session.token)
        else:
            running.close()
        return {}

    async def _abort(self, running: _RunningCalibration) -> dict[str, Any]:
        running.is_aborted = True
        session = running.session
        if session is not None and session.state == "asking":
            await session.abort(session.token)
        self._end_running(running, "the last one was aborted")
        return _reply_fields(_ABORTED, "")

    # ------------------------------------------------------------------ the wizard

    async def _start_wizard(self, running: _RunningCalibration, answers: Answers) -> None:
        """Start the wizard that the answers of the first step choose.

        Raises:
            CalibrationError: as :meth:`CalibrationService.start`.
        """
        request, name = running.start_request, answers["name"]
        self._files.folder.calibration(name)  # a wrong name is refused before anything is measured
        fixed = request.fixed_camera or answers["fixed_camera"]
        source = request._replace(fixed_camera=fixed).source or answers["pictures"]
        if source != SMARTCAMERA:
            self._check_graph([source], "")
        lens = None
        if self.graph is not None and source != SMARTCAMERA:
            lens = await self.graph.lens(source)
            if running.is_aborted:
                return
        wizard = self._make_wizard(running, fixed == "True", source, lens)
        parameters = {**_parameters(request, self._camera), "asked": [fixed, source, *request]}
        service = CalibrationService(self._files.folder, [wizard])
        _start_or_resume(service, name, wizard.name, parameters)
        running.service = service
        running.first_step = running.first_step.with_defaults(answers)

    def _make_wizard(
        self, running: _RunningCalibration, fixed: bool, source: str, lens: CameraModel | None
    ) -> Wizard:
        """Return the wizard for the camera's place and the source of pictures.

        ``fixed``: whether the camera is fixed in the cell. ``lens``: None: not known.
        """
        save_to = self._files.folder.calibration
        can_read_robot = bool(running.start_request.tf_frame_robot_tcp)

        async def take_picture() -> Any:
            return await self._take_picture(running, source)

        async def read_tip_pose() -> Pose:
            tip = await self._read_robot_pose(running, None)
            return replace(tip, at=tip.at or datetime.now(UTC)).pose()

        async def read_flange_pose() -> Transform:
            return await self._read_robot_pose(running, running.picture_time)

        if not fixed:
            return hand_eye_wizard(
                take_picture=take_picture,
                save_to=save_to,
                read_robot=read_flange_pose if can_read_robot else None,
                camera=lens,
            )
        if source != SMARTCAMERA:
            return sheet_wizard(
                take_picture=take_picture,
                save_to=save_to,
                read_robot=read_tip_pose if can_read_robot else None,
                camera=lens,
            )
        return plane_wizard(
            localize=self._localize,
            save_to=save_to,
            read_robot=read_tip_pose if can_read_robot else None,
            y_down=None if self._camera is None else self._camera.y_down,
        )

    async def _localize(self) -> list[Localization]:
        return await _require(self._camera).localize()

    async def _take_picture(self, running: _RunningCalibration, source: str) -> Any:
        running.picture_time = None
        if source == SMARTCAMERA:
            return await _require(self._camera).take_picture()
        image, running.picture_time = await _require(self.graph).picture(source)
        return image

    async def _read_robot_pose(self, running: _RunningCalibration, utc: float | None) -> Transform:
        request = running.start_request
        return await _require(self.graph).pose(
            request.tf_frame_robot_tcp, request.tf_frame_robot_base, utc
        )

    # ------------------------------------------------------------------ the end

    def _reply(self, running: _RunningCalibration, errors: Mapping[str, str]) -> dict[str, Any]:
        """Return the fields of a reply with the current step, or with the end."""
        error = "; ".join(
            text if name == "base" else f"{name}: {text}" for name, text in errors.items()
        )
        step, session = running.step, running.session
        if step is None and session is not None:
            view, name = session.current, str(session.parameters["name"])
            step = _done_step(name, view)
            if session.state == "ended":
                self._end_running(running, f"{name!r} was finished")
                # a calibration that maps no pixels, such as a hand-eye one, cannot be loaded
                with contextlib.suppress(CalibrationError, OSError):
                    self.load(name)
        return _reply_fields(step or running.first_step, error)

    def _end_running(self, running: _RunningCalibration, reason: str) -> None:
        running.close()
        self._running, self._last_end = None, reason
        self._restart_timer()

    def _restart_timer(self) -> None:
        """Restart the timer that abandons a running calibration."""
        loop = asyncio.get_running_loop()
        self._last_call_at = loop.time()
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None
        if self._running is not None and not self._busy:
            self._timer = loop.call_later(self._abandon_timeout, self._abandon)

    def _abandon(self) -> None:
        if self._running is not None:
            text = f"the last one was abandoned after {self._abandon_timeout:g} s without a call; "
            self._end_running(
                self._running, text + "start it again under the same name to resume it"
            )

    def close(self) -> None:
        """End the running calibration, which can be resumed. Idempotent."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None
        running, self._running = self._running, None
        if running is not None:
            running.close()

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

    async def transform(self, request: PixelPoseRequest) -> Pose:
        """Return a pose that the camera saw, in the robot's or the request's reference frame.

        Raises:
            CalibrationError: ``NO_CALIBRATION``, ``WRONG_FRAME``, ``OUT_OF_FIELD``, ``BAD_TIME``.
        """
        calibration = self._loaded
        if calibration is None:
            raise Code.NO_CALIBRATION.error(
                f"{self._name}: no calibration is loaded; expected LoadCalibration first"
            )
        pose = self._files.transform(request.x, request.y, request.theta)
        if request.frame and calibration.camera_frame not in {None, request.frame}:
            raise Code.WRONG_FRAME.error_with_value(
                f"frame_id: expected {calibration.camera_frame!r}, the camera's frame",
                calibration.camera_frame,
                request.frame,
            )
        robot, reference = calibration.robot_frame, request.reference or calibration.robot_frame
        time = (
            datetime.now(UTC) if request.utc is None else datetime.fromtimestamp(request.utc, UTC)
        )
        if reference != robot:
            robot_pose = await self._frame_pose(robot, reference, request.utc)
            part_pose = robot_pose.undated() @ Transform.from_pose(pose, "part").undated()
            pose = replace(part_pose, at=time).pose()
        return pose._replace(header=Header(request.seq, time, reference))

    async def _frame_pose(self, robot: str, reference: str, utc: float | None) -> Transform:
        """Return the pose of the robot's frame in the reference frame."""
        if self.graph is None:
            raise Code.WRONG_FRAME.error_with_value(
                f"tf_frame_reference: expected {robot!r}, since other frames need ROS' TF, and "
                "this camera is not seen in ROS",
                robot,
                reference,
            )
        return await self.graph.pose(robot, reference, utc)


class CalibrationsByCamera:
    """The calibrations of an agent's cameras, in one folder.

    Args:
        folder: folder of calibrations and journals, which is created if needed.

    Raises:
        OSError: the folder cannot be created.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._folder = Folder(folder).path
        self._calibrations: dict[str, ThesisCalibration] = {}

    def of(self, camera: str) -> ThesisCalibration:
        """Return the calibrations of a camera."""
        calibration = self._calibrations.get(camera)
        if calibration is None:
            calibration = self._calibrations[camera] = ThesisCalibration(self._folder, camera)
        return calibration

    def close(self) -> None:
        """End running calibrations, which can be resumed."""
        for calibration in self._calibrations.values():
            calibration.close()


def _require(value: T | None) -> T:
    """Return a value; raise NOT_POSSIBLE if it became None since it was checked."""
    if value is None:
        raise Code.NOT_POSSIBLE.error(
            "the camera is not seen in ROS any more; expected it to come back, or abort"
        )
    return value


def _first_step(request: CalibrationStart, camera: str) -> Step:
    """Return the step that asks for the facts that the request does not have."""
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
        inputs.append(
            Option(name="fixed_camera", label="Where the camera is", options=CAMERA_PLACES)
        )
    text = "A calibration of this name that was broken off goes on where it was."
    return Step(id="first", title="Calibration", description=text, inputs=tuple(inputs))


def _parameters(request: CalibrationStart, camera: CalibrationCamera | None) -> dict[str, Any]:
    """Return defaults for a wizard's steps from a request and the camera."""
    defaults: dict[str, Any] = {"setup": "eye-in-hand"}
    if camera is not None:
        defaults["camera_unit"] = camera.unit
    if request.tf_frame_robot_base:
        defaults["robot_frame"] = request.tf_frame_robot_base
    if request.checkerboard_squaresize_m:
        defaults["square"] = 1e3 * request.checkerboard_squaresize_m
    return defaults


def _start_or_resume(
    service: CalibrationService, name: str, wizard: str, parameters: Mapping[str, Any]
) -> None:
    """Start a wizard, or resume an interrupted wizard that was started by the same request."""
    try:
        service.start(name, wizard, parameters)
        has_same_request = service.session.parameters["asked"] == parameters["asked"]
    except CalibrationError as exc:
        if exc.code not in {Code.WRONG_JOURNAL, Code.BROKEN_FILE}:
            raise
        has_same_request = False
    if not has_same_request:
        service.start(name, wizard, parameters, fresh=True)


def _check_no_inputs(request: StepRequest) -> Mapping[str, str]:
    """Return an error if a request answers a step that was not returned to a client yet."""
    if request.value_inputs or request.text_inputs or request.option_inputs:
        return {"base": "this step was not shown before; expected no inputs in the first call"}
    return {}


def _done_step(name: str, view: Mapping[str, Any]) -> Step:
    """Return a step that reports the result."""
    verdict, file = view["verdict"], view["result"]["file"]
    verdict_text = "" if verdict is None else f"{verdict['text']} "
    text = f"{verdict_text}It is in the file {file}. It was also loaded, if it maps pixels."
    return Step(id="done", title=f"The calibration {name} is done", description=text, button="")


def _reply_fields(step: Step, error: str) -> dict[str, Any]:
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
