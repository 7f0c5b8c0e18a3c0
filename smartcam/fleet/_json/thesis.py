"""Serve the six camera services of the thesis with which smartcam began, in JSON on the bus."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator, Field, create_model

from smartcam._thesis import THESIS as THESIS_SERVICES
from smartcam._thesis import SetupRequest, ThesisCall
from smartcam.exceptions import ConfigurationError
from smartcam.fleet._agent.calls import ACTIONS, ProgramCall
from smartcam.fleet._json.services import (
    Deadline,
    Id,
    JsonRequest,
    Service,
    Text,
    Work,
    trigger_camera,
)
from smartcam.fleet._program.reading import interpret_single
from smartcam.settings import CameraSettings

if TYPE_CHECKING:
    from smartcam._client._inside import Interpretation
    from smartcam._thesis import ThesisService
    from smartcam.settings import Address

_TOPIC = re.compile(r"[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+){0,7}")


def _none_if_empty(value: object) -> object:
    is_empty = value == "" or (type(value) in {int, float} and value == 0)
    return None if is_empty else value


class BusFields(JsonRequest):
    """The fields that a request may have only on the bus, not over ROS."""

    camera_name: Annotated[str, Field(min_length=1, max_length=200)]
    id: Annotated[Id | None, BeforeValidator(_none_if_empty)] = None
    epoch: Annotated[Text | None, BeforeValidator(_none_if_empty)] = None
    deadline: Annotated[Deadline | None, BeforeValidator(_none_if_empty)] = None


def new_camera(request: SetupRequest) -> CameraSettings:
    """Return the settings of a camera that Setup adds.

    Raises:
        ConfigurationError: the request is not valid.
    """
    if not request.con_address:
        raise ConfigurationError(
            f"Setup: the fleet has no camera {request.camera_name!r}: expected con_address, where "
            "it is, to add it"
        )
    options: dict[str, Any] = {"name": request.camera_name}
    if request.timeout:
        options["connect_timeout"] = request.timeout
    return CameraSettings.of(request.address(), options)


class JsonThesisCamera:
    """An agent's camera as the thesis' services use it.

    Args:
        work: the running service.
    """

    def __init__(self, work: Work) -> None:
        self._work, self._camera, self._topics = work, work.camera, work.topics
        self.name: str = work.camera.name
        self.address: Address = work.camera.settings.address

    @property
    def stopped(self) -> bool:
        """True if SmartcameraStop has closed the camera for these services."""
        return self._topics.stopped

    @stopped.setter
    def stopped(self, stopped: bool) -> None:
        self._topics.stopped = stopped

    @property
    def application(self) -> int | None:
        """The id of the active application; None if that is not known."""
        return self._camera.client.active_application

    @property
    def interpretation(self) -> Interpretation | None:
        """Interpretation of results for JSON."""
        return self._topics.interpretation

    def check_interpretation(self, spec: str) -> None:
        """Raise ConfigurationError if results cannot be interpreted by ``spec``."""
        self._topics.make_interpretation(spec)

    def interpret_as(self, spec: str | None) -> None:
        """Interpret results by ``spec`` from now on; None: by the settings."""
        own_spec = self._camera.settings.interpret_as
        self._topics.set_interpretation(own_spec if spec is None else spec)

    def is_calibrated(self, application: int) -> bool:
        """Return False: JSON has poses in the camera's frame."""
        return False

    def check_status_topic(self, topic: str) -> None:
        """Raise ConfigurationError if a topic is not valid."""
        _check_topic(topic)

    def publish_status(self, topic: str) -> dict[str, Any]:
        """Publish the status on this topic; return its key."""
        return {"topic": self._topics.publish_status(_check_topic(topic))}

    async def publish_results(self, topic: str, min_delay: float, queue: int) -> dict[str, Any]:
        """Publish results on this topic; return its key."""
        return {"topic": self._topics.publish_results(_check_topic(topic), min_delay, queue)}

    async def end_publishing(self) -> None:
        """End publishing on the topics that requests have named."""
        self._topics.end_publishing()

    async def require_session(self) -> None:
        """Raise an error with the reason if there is no session."""
        self._camera.require_client()

    async def ensure(self, application: int, timeout: float) -> None:
        """Load and run an application."""
        await self._camera.require_client().ensure_application(application, timeout)

    async def switch(self, application: int, timeout: float) -> None:
        """Load an application."""
        arguments = {"application": application}
        await ACTIONS["switch_application"](
            ProgramCall(self._camera, "", self._work.owner, arguments, [], timeout, {})
        )

    async def trigger(self, application: int | None, spec: Any, timeout: float) -> tuple[int, Any]:
        """Trigger; return the result's application, and its value by ``spec``."""
        interpretation = self._topics.make_interpretation(spec)
        (group,) = await trigger_camera(self._work, interpretation, application)
        return group.application, interpret_single(group, interpretation, self.name)[0]


def _check_topic(text: str) -> str:
    """Return a topic without slashes at its ends.

    Raises:
        ConfigurationError: the topic is not valid.
    """
    name = text.strip("/")
    if name and not _TOPIC.fullmatch(name):
        raise ConfigurationError(
            f"{text!r:.80}: expected a topic such as line1/outputs: up to 8 parts of letters, "
            "digits, _ . and -"
        )
    return name


def _bus_service(name: str) -> Service:
    """Return one of the six services as a service of the bus."""
    thesis_service: ThesisService = THESIS_SERVICES[name]
    request: Any = create_model(
        thesis_service.request.__name__, __base__=(thesis_service.request, BusFields)
    )

    async def carry_out(work: Work) -> dict[str, Any]:
        return await thesis_service.answer(
            ThesisCall(JsonThesisCamera(work), work.request, work.timeout)
        )

    empty_fields: dict[str, Any] = (
        {} if thesis_service.empty_field is None else {thesis_service.empty_field: []}
    )
    is_command = name != "EnablePublishing"
    return Service(
        request,
        carry_out,
        is_command=is_command,
        timeout=thesis_service.timeout,
        empty_fields=empty_fields,
    )


_BUS_SERVICES = {name: _bus_service(name) for name in THESIS_SERVICES}
SETUP, STOP = _BUS_SERVICES["SmartcameraSetup"], _BUS_SERVICES["SmartcameraStop"]

THESIS: dict[str, Service] = {**_BUS_SERVICES, "Setup": SETUP, "Stop": STOP}
"""The six camera services by name; two of them also have a short name."""
