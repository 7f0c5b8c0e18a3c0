"""The thesis' interface: its services under their names, with its fields' names.

A field that is 0 or an empty text counts as not said, since messages of ROS have no other way.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from smartcam._client.interpretation import Interpretation, without_poses
from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import ConfigurationError, InterpretationError
from smartcam.fleet._calls import ACTIONS, ProgramCall
from smartcam.fleet._reading import interpreted
from smartcam.fleet._services import (
    MOST_TIMEOUT,
    Id,
    Interpret,
    Number,
    PlainRequest,
    Service,
    Text,
    Work,
    triggered,
)
from smartcam.interpreters._base import resolve
from smartcam.models import Localization, jsonable
from smartcam.settings import CameraSettings, parse_address

if TYPE_CHECKING:
    from smartcam.settings import Address

DEFAULT_QUEUE = 100
_TOPIC = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+){0,7}")
_KEYWORDS = {"localizations": "localizations", "50bytestrings": "strings50"}


def _topic(text: str) -> str:
    name = text.strip("/")
    if name and not _TOPIC.fullmatch(name):
        raise ValueError(
            "expected a topic such as line1/outputs: up to 8 parts of letters, digits, _ . and -"
        )
    return name


def _said(value: object) -> object:
    return value or None


Topic = Annotated[Text, AfterValidator(_topic)]


class ThesisRequest(PlainRequest):
    """What every request of the thesis' may say."""

    camera_name: Annotated[str, Field(min_length=1, max_length=200)]
    timeout: Annotated[float, Field(ge=0, le=MOST_TIMEOUT, allow_inf_nan=False)] | None = None
    id: Annotated[Id | None, BeforeValidator(_said)] = None
    epoch: Annotated[Text | None, BeforeValidator(_said)] = None


class ThesisSetup(ThesisRequest):
    """A camera's address, and what is to be had of it."""

    camera_model_name: Text = ""
    port: int | Text = 0
    con_address: Text = ""
    application_id: Number = 0
    interpret_as: Interpret = ""
    topic_status: Topic = ""

    def settings(self) -> CameraSettings:
        """Return what the session with a new camera is told.

        Raises:
            ConfigurationError: it cannot work.
        """
        if not self.con_address:
            raise ConfigurationError(
                f"Setup: the fleet has no camera {self.camera_name!r}: expected con_address, where "
                "it is, to add it"
            )
        options: dict[str, Any] = {"name": self.camera_name}
        if self.timeout:
            options["connect_timeout"] = self.timeout
        return CameraSettings.of(self.address(), options)

    def address(self) -> Address:
        """Return where it is.

        Raises:
            ConfigurationError: there can be no camera.
        """
        place = self.con_address
        if "://" not in place:
            place = f"[{place}]" if place.count(":") > 1 and "[" not in place else place
            port = str(self.port or "")
            if port and not place.rpartition("]")[2].count(":"):
                place = f"{place}:{port}"
        return parse_address(place, model=self.camera_model_name or None)

    def spec(self) -> str | None:
        """Return how the containers are to be read, None where nothing is said."""
        said = self.interpret_as.strip()
        return _KEYWORDS.get(said.lower(), said) or None


class _ThesisPublishing(ThesisRequest):
    topic_for_outputs: Topic = ""
    min_delay: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] = 0.0
    queue_size: Annotated[int, Field(ge=0, le=10_000)] = 0


class _ThesisApplication(ThesisRequest):
    application_id: Annotated[int, Field(ge=1, le=0xFFFFFFFF)]


class _ThesisTrigger(ThesisRequest):
    application_id: Number = 0


async def _setup(work: Work) -> dict[str, Any]:
    """Set up a camera that is there already."""
    request: ThesisSetup = work.request
    host, topics = work.host, work.topics
    has = host.settings.address
    model = request.camera_model_name
    if model and (protocol := parse_address(has.host, model=model).protocol) != has.protocol:
        raise ConfigurationError(
            f"{host.name}: Setup says it is a {model}, which speaks {protocol}, but it speaks "
            f"{has.protocol}; Stop it first, or choose another camera_name"
        )
    if request.con_address:
        wanted = request.address()
        if (wanted.host, wanted.port, wanted.protocol) != (has.host, has.port, has.protocol):
            raise ConfigurationError(
                f"{host.name}: Setup says it is at {wanted.url}, but it is at {has.url}; Stop it "
                "first, or choose another camera_name"
            )
    spec = request.spec()
    if spec is not None:
        topics.reading(spec)  # before anything is done
    camera = host.require()
    if request.application_id:
        await camera.ensure(request.application_id, work.timeout)
    if spec is not None:
        topics.interpret(spec)
    return {"topic": topics.publish_status(request.topic_status)}


async def _enable_publishing(work: Work) -> dict[str, Any]:
    request: _ThesisPublishing = work.request
    return {
        "topic": work.topics.publish_results(
            request.topic_for_outputs, request.min_delay, request.queue_size or DEFAULT_QUEUE
        )
    }


async def _stop(work: Work) -> dict[str, Any]:
    work.topics.end_publishing()
    work.topics.interpret(work.host.settings.interpret_as)
    return {}


async def _change_application(work: Work) -> dict[str, Any]:
    arguments = {"application": work.request.application_id}
    await ACTIONS["switch_application"](
        ProgramCall(work.host, "", work.owner, arguments, [], work.timeout, {})
    )
    return {}


async def _trigger_strings(work: Work) -> dict[str, Any]:
    (run,) = await triggered(work, None, work.request.application_id or None)
    reading = Interpretation("strings50", lenient=True, y_down=False)
    return {"strings": interpreted(run, reading, work.host.name).value}


async def _trigger_localizations(work: Work) -> dict[str, Any]:
    topics = work.topics
    application = work.request.application_id or None
    (run,) = await triggered(work, topics.interpretation, application)
    reading = topics.reading(_with_poses(topics.interpret_as, run.application))
    found: Any = interpreted(run, reading, work.host.name).value
    if not isinstance(found, list) or not all(isinstance(one, Localization) for one in found):
        raise InterpretationError(
            f"{work.host.name}: expected localizations, got {found!r:.80}", expected="localizations"
        )
    return {"localizations": jsonable(found)}


def _with_poses(spec: Any, application: int) -> Any:
    """Return how containers are read that hold localizations: as is known, or as is usual."""
    own = spec.get(application) if isinstance(spec, dict) else spec
    return "localizations" if own is None or without_poses(resolve(own)) is not None else own


SETUP = Service(ThesisSetup, _setup)
STOP = Service(ThesisRequest, _stop)

THESIS: dict[str, Service] = {
    "SmartcameraSetup": SETUP,
    "Setup": SETUP,
    "SmartcameraStop": STOP,
    "Stop": STOP,
    "EnablePublishing": Service(_ThesisPublishing, _enable_publishing, command=False),
    "ChangeApplication": Service(_ThesisApplication, _change_application),
    "Trigger50ByteString": Service(
        _ThesisTrigger, _trigger_strings, timeout=DEFAULT_TRIGGER_TIMEOUT, nothing={"strings": []}
    ),
    "TriggerLocalization": Service(
        _ThesisTrigger,
        _trigger_localizations,
        timeout=DEFAULT_TRIGGER_TIMEOUT,
        nothing={"localizations": []},
    ),
}
"""The services of the thesis' interface by name."""
