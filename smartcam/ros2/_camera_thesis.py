"""The thesis' six services at a camera's node, with its fields' names.

There one node had many cameras, and ``camera_name`` said which. Here each camera has a node of its
own, so the field may be empty; a name that is not this camera's is an error, since who says it
talks to another camera than they think. A field that is 0 or empty counts as not said.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final, Protocol

from smartcam._client.interpretation import without_poses
from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import ConfigurationError, InterpretationError
from smartcam.interpreters._base import resolve
from smartcam.models import Status
from smartcam.ros2._camera_reading import localizations_in_metres, own_interpreter
from smartcam.ros2._camera_results import DEFAULT_QUEUE
from smartcam.ros2._camera_status_topic import CameraStatusTopic
from smartcam.ros2._messages import utf8
from smartcam.settings import FLEET_SCHEMES, parse_address

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.camera import Camera
    from smartcam.ros2._camera_results import CameraResults
    from smartcam.settings import Address

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MOST_TIMEOUT: Final = 300.0
"""Seconds of a request; a handler may take longer, for switches there and back."""

_KEYWORDS: Final = {"localizations": "localizations", "50bytestrings": "strings50"}


class ManagedCamera(Protocol):
    """The life cycle that the thesis' services go through."""

    @property
    def state(self) -> Any:
        """The present state, with its ``label``."""

    async def configure(self) -> None:
        """From Unconfigured to Inactive."""

    async def activate(self) -> None:
        """From Inactive to Active."""

    async def deactivate(self) -> None:
        """From Active to Inactive."""

    async def cleanup(self) -> None:
        """From Inactive to Unconfigured."""


def seconds(camera: Camera[Any], timeout: float, usual: float) -> float:
    """Return a request's timeout.

    Raises:
        ConfigurationError: it cannot be.
    """
    if timeout == 0:
        return usual
    if not 0 < timeout <= MOST_TIMEOUT:
        raise ConfigurationError(
            f"{camera.name}: timeout {timeout}: expected seconds up to {MOST_TIMEOUT:g}, or 0 for "
            f"{usual:g}"
        )
    return timeout


def said_spec(text: str) -> str | None:
    """Return how containers are to be read, None where nothing is said."""
    said = text.strip()
    return _KEYWORDS.get(said.lower(), said) or None


class ThesisServices:
    """What the thesis' services do; each takes a request, and returns its answer beside ``error``.

    Args:
        camera: whose.
        node: of the camera.
        results: which are published.
        life: the node's life cycle.
        address: where the camera itself is, for a fleet's, whose own address is the fleet's.
    """

    def __init__(
        self,
        camera: Camera[Any],
        node: Any,
        results: CameraResults,
        life: ManagedCamera,
        *,
        address: Address | None = None,
    ) -> None:
        self._camera, self._node, self._results, self._life = camera, node, results, life
        self._address = address or camera.settings.address
        self._status = CameraStatusTopic(camera, node, results.messages)
        self._lock = asyncio.Lock()  # of the life cycle: one after the other
        self.table: dict[str, Callable[[Any], Awaitable[dict[str, Any]]]] = {
            "SmartcameraSetup": self._setup,
            "EnablePublishing": self._enable_publishing,
            "SmartcameraStop": self._stop,
            "ChangeApplication": self._change_application,
            "Trigger50ByteString": self._trigger_strings,
            "TriggerLocalization": self._trigger_localizations,
        }

    async def close(self) -> None:
        """Publish no status any more. Idempotent."""
        await self._status.close()

    def check_name(self, name: str) -> None:
        """See that a request is meant for this camera.

        Raises:
            ConfigurationError: it names another one.
        """
        known = {self._camera.name, self._node.full_name, self._node.name}
        if name and name.strip("/") not in {one.strip("/") for one in known}:
            raise ConfigurationError(
                f"camera_name {name!r:.80}: this is the node of {self._camera.name!r}: expected "
                "that, or an empty text"
            )

    # ------------------------------------------------------------------ the life cycle

    @property
    def _state(self) -> str:
        return str(self._life.state.label)

    async def _setup(self, request: Any) -> dict[str, Any]:
        self._check_place(request)
        self._check_reading(request)
        self._status.resolve(request.topic_status)  # before anything is done
        async with self._lock:
            if self._state not in {"inactive", "active"}:
                await self._life.configure()
            if request.application_id:
                await self._ensure(request.application_id)
            self._status.publish_on(request.topic_status)
        return {}

    def _check_place(self, request: Any) -> None:
        """See that it is the camera that is meant."""
        name, model = self._camera.name, request.camera_model_name
        if not (model or request.con_address):
            return
        has = self._address
        if has.scheme in FLEET_SCHEMES:
            raise ConfigurationError(
                f"{name}: it is a fleet's, which knows where it is: expected con_address and "
                "camera_model_name to be empty"
            )
        if model and (protocol := parse_address(has.host, model=model).protocol) != has.protocol:
            raise ConfigurationError(
                f"{name}: Setup says it is a {model}, which speaks {protocol}, but it speaks "
                f"{has.protocol}"
            )
        if request.con_address:
            wanted = _place(request.con_address, request.port, model)
            if (wanted.host, wanted.port, wanted.protocol) != (has.host, has.port, has.protocol):
                raise ConfigurationError(
                    f"{name}: Setup says it is at {wanted.url}, but it is at {has.url}"
                )

    def _check_reading(self, request: Any) -> None:
        """See that results are read as is wanted: how they are, the whole node has in common."""
        spec = said_spec(request.interpret_as)
        if spec is None:
            return
        wanted = resolve(spec)
        application = request.application_id or self._camera.active_application
        own = own_interpreter(self._camera, application)
        kinds = [(type(one), str(one.layout)) for one in (wanted, own) if one is not None]
        if kinds != [kinds[0]] * 2:
            reads = "not known" if own is None else f"{type(own).__name__}, {own.layout}"
            raise ConfigurationError(
                f"{self._camera.name}: interpret_as {request.interpret_as!r:.80}: how its results "
                f"are read ({reads}) is said where the camera is shared: expected that, or an "
                "empty text; TriggerLocalization and Trigger50ByteString read as they say"
            )

    async def _ensure(self, application: int) -> None:
        camera = self._camera
        if await camera.query_application() != application:
            await camera.switch_application(application)
        if camera.capabilities.start_stop and Status.RUNNING not in camera.status:
            await camera.start()
        await camera.wait_ready()

    async def _enable_publishing(self, request: Any) -> dict[str, Any]:
        size = request.queue_size or DEFAULT_QUEUE
        async with self._lock:
            self._results.publish_on(request.topic_for_outputs, request.min_delay, size)
            if self._state == "active":
                return {}
            try:
                await self._life.activate()
            except BaseException:
                self._results.publish_on("")
                raise
        return {}

    async def _stop(self, request: Any) -> dict[str, Any]:
        async with self._lock:
            self._results.publish_on("")
            self._status.publish_on("")
            if self._state == "active":
                await self._life.deactivate()
            if self._state == "inactive":
                await self._life.cleanup()
        return {}

    # ------------------------------------------------------------------ the camera

    async def _change_application(self, request: Any) -> dict[str, Any]:
        if not request.application_id:
            raise ConfigurationError(f"{self._camera.name}: application_id 0: expected 1 or more")
        await self._camera.switch_application(request.application_id)
        return {}

    async def _trigger_strings(self, request: Any) -> dict[str, Any]:
        result = await self._camera.trigger(
            request.application_id or None,
            interpret_as="strings50",
            timeout=seconds(self._camera, request.timeout, DEFAULT_TRIGGER_TIMEOUT),
        )
        return {"strings": [utf8(one) for one in result.value]}

    async def _trigger_localizations(self, request: Any) -> dict[str, Any]:
        camera = self._camera
        application = request.application_id or camera.active_application
        own = own_interpreter(camera, application)
        spec = "localizations" if own is None or without_poses(own) is not None else None
        result = await camera.trigger(
            request.application_id or None,
            interpret_as=spec,
            timeout=seconds(camera, request.timeout, DEFAULT_TRIGGER_TIMEOUT),
        )
        parts = localizations_in_metres(camera, result, spec)
        if parts is None:
            raise InterpretationError(
                f"{camera.name}: expected localizations in metres, got {result.value!r:.80}",
                expected="localizations",
            )
        return {"localizations": self._results.messages.localizations(parts)}


def _place(where: str, port: str, model: str) -> Address:
    """Return the address that Setup says.

    Raises:
        ConfigurationError: there can be no camera.
    """
    if "://" not in where:
        where = f"[{where}]" if where.count(":") > 1 and "[" not in where else where
        if port not in {"", "0"} and ":" not in where.rpartition("]")[2]:
            where = f"{where}:{port}"
    return parse_address(where, model=model or None)
