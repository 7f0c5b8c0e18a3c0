"""The life cycle of a camera's node: what its states mean, and its services.

Services and topic are those of rcl_lifecycle (``com_interface.c``).
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any

from smartcam.backoff import Backoff
from smartcam.exceptions import LinkError, ResponseTimeoutError, SmartCamError
from smartcam.models import Status
from smartcam.ros2._node.lifecycle import STATES, TRANSITIONS, Lifecycle, LifecycleTransition

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.camera import Camera

logger: logging.Logger = logging.getLogger("smartcam.ros2")

PATIENCE_TIMEOUT = 60.0
"""Seconds that one wait for a camera takes before the next one begins."""

RETRY = Backoff(initial=0.5, maximum=10.0)
"""Delays after which a camera that is there, but could not be had as wanted, is tried again."""


class CameraLifecycle(Lifecycle):
    """The life cycle of a camera's node.

    A camera may be shared by many programs, and the node is one of them: whatever its state, the
    camera's session, its run mode and the other programs stay as they are. What each means:

    ================ ===============================================================
    Unconfigured     status and diagnostics are published, services answer; nothing
                     else is asked of the camera
    configure        waits for a session with the camera, and for its application to
                     be loaded, run and ready where one is wanted; this is the only
                     transition that may change something at the camera
    Inactive         the camera is there; results are not published
    activate         results, pictures and frames of reference are published
    Active           they are; a camera that is lost leaves it Active, since it is
                     connected again by itself: status and diagnostics tell
    deactivate       nothing more is published
    cleanup          the same, and the node no longer needs the camera, whose
                     session stays with its owner
    shutdown         the node does nothing more, for good; it stays in the graph
                     until its program closes it
    ================ ===============================================================

    Where ``autostart`` is set it goes to Active by itself as soon as the camera is there, unless
    somebody asks for a transition first, or the camera refuses the application.

    Args:
        camera: camera that the node stands for.
        node: node of ROS 2 or of ROS 1, where there are no services of a life cycle.
        application: id of the application to have running and ready; None: that of the settings.
        autostart: whether the node goes to Active by itself.
    """

    def __init__(
        self, camera: Camera[Any], node: Any, *, application: int | None, autostart: bool
    ) -> None:
        settings = camera.settings
        self._camera, self._node = camera, node
        self._application = settings.application if application is None else application
        self._autostart = autostart
        self._starting: asyncio.Task[None] | None = None
        self._ends: list[Any] = []
        limit = settings.connect_timeout + 2 * settings.switch_timeout + settings.request_timeout
        super().__init__(node.full_name, {"configure": self._have_camera}, limit)

    async def start(self) -> None:
        """Serve, and go to Active by itself where that is wanted."""
        manage = getattr(self._node, "manage", None)
        if manage is not None:  # rclpy has a life cycle of its own, which follows this one
            self._ends.append(manage(self, self._on_change_state))
        elif is_managed(self._node):
            await self._declare()
        if self._autostart:
            self._starting = asyncio.get_running_loop().create_task(self._start_up())

    async def _declare(self) -> None:
        event = self._node.publisher("~/transition_event", "lifecycle_msgs/msg/TransitionEvent")
        self._ends.append(event)
        self._event = event
        self.listen(self._say)
        for name, (kind, handler) in self._services().items():
            self._ends.append(self._node.serve(f"~/{name}", f"lifecycle_msgs/srv/{kind}", handler))
            await asyncio.sleep(0)  # to declare takes the engine a while

    def _services(self) -> dict[str, tuple[str, Callable[[Any], Awaitable[Any]]]]:
        def told(fields: Callable[[], dict[str, Any]]) -> Callable[[Any], Awaitable[Any]]:
            async def answer(_request: object) -> dict[str, Any]:
                return fields()

            return answer

        states = {"available_states": [one._asdict() for one in STATES]}
        ways = "GetAvailableTransitions"
        return {
            "change_state": ("ChangeState", self._on_change_state),
            "get_state": ("GetState", told(lambda: {"current_state": self.state._asdict()})),
            "get_available_states": ("GetAvailableStates", told(lambda: states)),
            "get_available_transitions": (ways, told(lambda: _described(self.available))),
            "get_transition_graph": (ways, told(lambda: _described(TRANSITIONS))),
        }

    async def _on_change_state(self, request: Any) -> dict[str, Any]:
        wanted = request.transition
        try:
            await self.change(wanted.label, wanted.id)
        except SmartCamError as exc:
            logger.warning("%s ! change_state: %s", self.name, exc)
            return {"success": False}
        return {"success": True}

    def _say(self, transition: LifecycleTransition) -> None:
        self._event.publish({"timestamp": time.time_ns(), **transition.fields})

    def _begins(self) -> None:
        """Stop starting by itself, since others have taken over."""
        starting = self._starting
        if starting is not None and starting is not asyncio.current_task():
            starting.cancel()

    # ------------------------------------------------------------------ work

    async def _have_camera(self) -> None:
        camera, application = self._camera, self._application
        await camera.wait_connected(camera.settings.connect_timeout)
        if application is None:
            return
        limit = camera.settings.switch_timeout
        await camera.wait_status(lambda status: not status.loading, limit)
        await have_application(camera, application, limit)

    async def _start_up(self) -> None:
        """Go to Active as soon as the camera is there, however long that takes."""
        told, delays = "", RETRY.delays()
        while True:
            try:
                await self._camera.wait_connected(PATIENCE_TIMEOUT)
                await self.configure()
                await self.activate()
            except (LinkError, ResponseTimeoutError) as exc:
                why = str(exc)
            except SmartCamError as exc:
                # trying again would stop the camera each time, which others use
                text = "%s ! it stays %s until somebody configures it: %s"
                logger.error(text, self.name, self.state.label, exc)  # noqa: TRY400 - it is said
                return
            else:
                return
            level = logging.DEBUG if why == told else logging.WARNING
            logger.log(level, "%s ! it is not active yet: %s", self.name, why)
            told = why
            await asyncio.sleep(next(delays))

    async def close(self) -> None:
        """End the node: tell others, and then stop its services. Idempotent."""
        self.closed = True
        starting, self._starting = self._starting, None
        try:
            if starting is not None:
                starting.cancel()
                await asyncio.wait((starting,))
            await super().close()
        finally:
            ends, self._ends = self._ends, []
            for end in ends:
                end.close()


async def have_application(camera: Camera[Any], application: int, timeout: float) -> None:
    """Have an application running and ready; each step has ``timeout`` seconds.

    Raises:
        SmartCamError: a step has failed.
    """
    if await camera.query_application() != application:
        await camera.switch_application(application, timeout=timeout)
    if camera.capabilities.start_stop and Status.RUNNING not in camera.status:
        await camera.start(timeout=timeout)
    await camera.wait_ready(timeout)


def is_managed(node: Any) -> bool:
    """Return True if a node is of ROS 2, which has managed nodes."""
    return getattr(node, "graph", None) is not None


def _described(transitions: Any) -> dict[str, Any]:
    return {"available_transitions": [one.fields for one in transitions]}
