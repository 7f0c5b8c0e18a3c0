"""Serve, at a camera's node, the six services of the thesis with which smartcam began.

In the thesis one node had many cameras, and ``camera_name`` chose one. Here each camera has its own
node, so the field may be empty; another camera's name is an error, since the request is meant for
another camera. Publishing is started and ended through the node's life cycle.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any, Protocol

from smartcam._thesis import THESIS, ThesisCall
from smartcam.exceptions import ConfigurationError
from smartcam.ros2._cameras.lifecycle import run_application
from smartcam.ros2._cameras.messages import utf8
from smartcam.ros2._cameras.reading import address_of, interpretation_of, is_calibrated
from smartcam.ros2._cameras.status_topic import CameraStatusTopic
from smartcam.settings import validated

if TYPE_CHECKING:
    from smartcam._client._inside import Interpretation
    from smartcam._thesis import ThesisService
    from smartcam.camera import Camera
    from smartcam.ros2._cameras.results import CameraResults
    from smartcam.settings import Address


class ThesisLifecycle(Protocol):
    """The life cycle that the thesis' services use."""

    @property
    def state(self) -> Any:
        """The current state, with its ``label``."""

    async def configure(self) -> None:
        """Go from Unconfigured to Inactive."""

    async def activate(self) -> None:
        """Go from Inactive to Active."""

    async def deactivate(self) -> None:
        """Go from Active to Inactive."""

    async def cleanup(self) -> None:
        """Go from Inactive to Unconfigured."""


class RosThesisCamera:
    """The operations of the thesis' services on a camera's node.

    Args:
        camera: the camera.
        node: the camera's node.
        results: the results that the node publishes.
        lifecycle: the node's life cycle.
    """

    def __init__(
        self, camera: Camera[Any], node: Any, results: CameraResults, lifecycle: ThesisLifecycle
    ) -> None:
        self._camera, self._results, self._lifecycle = camera, results, lifecycle
        self._status = CameraStatusTopic(camera, node, results.messages)
        self.name: str = camera.name
        self._stopped = False

    @property
    def stopped(self) -> bool:
        """True if SmartcameraStop has closed the camera, and it was not configured since."""
        return self._stopped and self._state not in {"inactive", "active"}

    @stopped.setter
    def stopped(self, stopped: bool) -> None:
        self._stopped = stopped

    @property
    def address(self) -> Address:
        """Address of the camera itself."""
        return address_of(self._camera)

    @property
    def application(self) -> int | None:
        """The id of the active application; None if that is not known."""
        return self._camera.active_application

    @property
    def interpretation(self) -> Interpretation:
        """Interpretation of the results."""
        return interpretation_of(self._camera)

    def check_interpretation(self, spec: str) -> None:
        """Raise ConfigurationError if results cannot be interpreted by ``spec``."""
        self._camera._interpretation(spec)  # noqa: SLF001 - smartcam's own

    def interpret_as(self, spec: str | None) -> None:
        """Interpret results by ``spec`` from now on; None: by the settings."""
        self._camera._set_interpreter(spec)  # noqa: SLF001 - smartcam's own

    def is_calibrated(self, application: int) -> bool:
        """Return True if an application has a calibration to a robot's frame."""
        return is_calibrated(self._camera, application)

    def check_status_topic(self, topic: str) -> None:
        """Raise ConfigurationError if a topic is not valid."""
        self._status.resolve(topic)

    def publish_status(self, topic: str) -> dict[str, Any]:
        """Publish the status on this topic, instead of the previous one."""
        self._status.publish_on(topic)
        return {}

    async def publish_results(self, topic: str, min_delay: float, queue: int) -> dict[str, Any]:
        """Publish results on this topic, and activate the node."""
        self._results.publish_on(topic, min_delay, queue)
        if self._state == "active":
            return {}
        try:
            await self._lifecycle.activate()
        except BaseException:
            self._results.publish_on("")
            raise
        return {}

    async def end_publishing(self) -> None:
        """Stop publishing results, and the status on the topic of a request."""
        self._results.publish_on("")
        self._status.publish_on("")
        if self._state == "active":
            await self._lifecycle.deactivate()
        if self._state == "inactive":
            await self._lifecycle.cleanup()

    async def require_session(self) -> None:
        """Configure the node if it is not."""
        if self._state not in {"inactive", "active"}:
            await self._lifecycle.configure()

    async def ensure(self, application: int, timeout: float) -> None:
        """Load and run an application."""
        await run_application(self._camera, application, timeout)

    async def switch(self, application: int, timeout: float) -> None:
        """Load an application."""
        await self._camera.switch_application(application, timeout=timeout)

    async def trigger(self, application: int | None, spec: Any, timeout: float) -> tuple[int, Any]:
        """Trigger; return the result's application, and its value by ``spec``."""
        result = await self._camera.trigger(application, interpret_as=spec, timeout=timeout)
        return result.application, result.value

    async def close(self) -> None:
        """Stop publishing the status, and interpret results by the settings. Idempotent."""
        self.interpret_as(None)
        await self._status.close()

    @property
    def _state(self) -> str:
        return str(self._lifecycle.state.label)


class ThesisServices:
    """Answers requests of the six services with messages' fields.

    Args:
        camera: the part of the node for these services.
        node: node of the camera.
        results: results of the camera, which make messages of localizations.
    """

    def __init__(self, camera: RosThesisCamera, node: Any, results: CameraResults) -> None:
        self._camera, self._node, self._messages = camera, node, results.messages
        self._topic_lock = asyncio.Lock()  # requests change topics one after the other

    async def close(self) -> None:
        """Stop publishing on topics of requests. Idempotent."""
        await self._camera.close()

    async def answer(self, name: str, message: Any) -> dict[str, Any]:
        """Carry out a request; return the fields of its answer without ``error``.

        Raises:
            SmartCamError: the service failed.
        """
        self._check_name(message.camera_name)
        service = THESIS[name]
        request = self._request(name, service, message)
        call = ThesisCall(self._camera, request, request.timeout or service.timeout)
        async with self._topic_lock if service.changes_publishing else contextlib.nullcontext():
            return self._encodable(await service.answer(call))

    def _request(self, name: str, service: ThesisService, message: Any) -> Any:
        known = [field for field in service.request.model_fields if hasattr(message, field)]
        fields = {field: getattr(message, field) for field in known}
        return validated(service.request, fields, f"{self._camera.name}: {name}")

    def _encodable(self, reply: dict[str, Any]) -> dict[str, Any]:
        if "strings" in reply:
            reply["strings"] = [utf8(text) for text in reply["strings"]]
        if "localizations" in reply:
            reply["localizations"] = self._messages.localizations(reply["localizations"])
        return reply

    def _check_name(self, name: str) -> None:
        """Check that a request is meant for this camera.

        Raises:
            ConfigurationError: the request names another camera.
        """
        camera, node = self._camera.name, self._node
        known = {camera, node.full_name, node.name}
        if name and name.strip("/") not in {other.strip("/") for other in known}:
            raise ConfigurationError(
                f"camera_name {name!r:.80}: this is the node of {camera!r}: expected "
                "that, or an empty text"
            )
