"""The life cycle of a camera's node: what its states mean, and its services.

Services and topic are as in rcl_lifecycle (``com_interface.c``).
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

CAMERA_TIMEOUT = 60.0
"""Seconds of one wait for a camera's session; after them the wait is repeated."""

RETRY = Backoff(initial=0.5, maximum=10.0)
"""Delays between attempts to configure a connected camera."""


class CameraLifecycle(Lifecycle):
    """The life cycle of a camera's node.

    A camera may be shared by many programs, of which the node is one: no state of the node affects
    the camera's session, its run mode or the other programs. The states and transitions:

    ================ ===============================================================
    Unconfigured     status and diagnostics are published, services answer; the node
                     does nothing else with the camera
    configure        waits for a session with the camera, and loads and runs its
                     application if one is set; this is the only transition that
                     may change something at the camera
    Inactive         the camera is connected; results are not published
    activate         starts to publish results, pictures and frames of reference
    Active           all is published; if the camera is lost, the node stays Active
                     until the reconnect: status and diagnostics show the loss
    deactivate       ends publishing
    cleanup          the node no longer needs the camera, whose session its owner
                     keeps
    shutdown         the node does nothing more, for good; it stays in the graph
                     until its program closes it
    ================ ===============================================================

    With ``autostart`` the node goes to Active by itself as soon as the camera is connected, unless
    a program requests a transition first, or the camera refuses the application.

    Args:
        camera: camera of the node.
        node: node of ROS 2, or of ROS 1, which has no services of a life cycle.
        application: id of the application to load and run; None: the settings' application.
        autostart: whether the node goes to Active by itself.
    """

    def __init__(
        self, camera: Camera[Any], node: Any, *, application: int | None, autostart: bool
    ) -> None:
        settings = camera.settings
        self._camera, self._node = camera, node
        self._application = settings.application if application is None else application
        self._autostart = autostart
        self._autostart_task: asyncio.Task[None] | None = None
        self._closables: list[Any] = []
        limit = settings.connect_timeout + 2 * settings.switch_timeout + settings.request_timeout
        super().__init__(node.full_name, {"configure": self._ensure_camera}, limit)

    async def start(self) -> None:
        """Start the services; with ``autostart``, also start the way to Active."""
        manage = getattr(self._node, "manage", None)
        if manage is not None:  # rclpy has its own life cycle, which follows this one
            self._closables.append(manage(self, self._on_change_state))
        elif is_managed(self._node):
            await self._declare()
        if self._autostart:
            self._autostart_task = asyncio.get_running_loop().create_task(
                self._activate_when_connected()
            )

    async def _declare(self) -> None:
        event = self._node.publisher("~/transition_event", "lifecycle_msgs/msg/TransitionEvent")
        self._closables.append(event)
        self._event = event
        self.listen(self._publish_transition)
        for name, (kind, handler) in self._services().items():
            self._closables.append(
                self._node.serve(f"~/{name}", f"lifecycle_msgs/srv/{kind}", handler)
            )
            await asyncio.sleep(0)  # let other tasks run: declaring takes Zenoh a while

    def _services(self) -> dict[str, tuple[str, Callable[[Any], Awaitable[Any]]]]:
        def handler_returning(
            fields: Callable[[], dict[str, Any]],
        ) -> Callable[[Any], Awaitable[Any]]:
            async def answer(_request: object) -> dict[str, Any]:
                return fields()

            return answer

        states = {"available_states": [state._asdict() for state in STATES]}
        transitions_type = "GetAvailableTransitions"
        return {
            "change_state": ("ChangeState", self._on_change_state),
            "get_state": (
                "GetState",
                handler_returning(lambda: {"current_state": self.state._asdict()}),
            ),
            "get_available_states": ("GetAvailableStates", handler_returning(lambda: states)),
            "get_available_transitions": (
                transitions_type,
                handler_returning(lambda: _transition_fields(self.available)),
            ),
            "get_transition_graph": (
                transitions_type,
                handler_returning(lambda: _transition_fields(TRANSITIONS)),
            ),
        }

    async def _on_change_state(self, request: Any) -> dict[str, Any]:
        transition = request.transition
        try:
            await self.change(transition.label, transition.id)
        except SmartCamError as exc:
            logger.warning("%s ! change_state: %s", self.name, exc)
            return {"success": False}
        return {"success": True}

    def _publish_transition(self, transition: LifecycleTransition) -> None:
        self._event.publish({"timestamp": time.time_ns(), **transition.fields})

    def _on_transition_requested(self) -> None:
        """End the automatic start, unless it requested the transition itself."""
        autostart_task = self._autostart_task
        if autostart_task is not None and autostart_task is not asyncio.current_task():
            autostart_task.cancel()

    # ------------------------------------------------------------------ work

    async def _ensure_camera(self) -> None:
        camera, application = self._camera, self._application
        await camera.wait_connected(camera.settings.connect_timeout)
        if application is None:
            return
        limit = camera.settings.switch_timeout
        await camera.wait_status(lambda status: not status.loading, limit)
        await run_application(camera, application, limit)

    async def _activate_when_connected(self) -> None:
        """Go to Active as soon as the camera is connected, without a time limit."""
        logged, delays = "", RETRY.delays()
        while True:
            try:
                await self._camera.wait_connected(CAMERA_TIMEOUT)
                await self.configure()
                await self.activate()
            except (LinkError, ResponseTimeoutError) as exc:
                reason = str(exc)
            except SmartCamError as exc:
                # a further attempt would stop the shared camera each time
                text = "%s ! it stays %s until a program configures it: %s"
                logger.error(text, self.name, self.state.label, exc)  # noqa: TRY400 - it is said
                return
            else:
                return
            level = logging.DEBUG if reason == logged else logging.WARNING
            logger.log(level, "%s ! it is not active yet: %s", self.name, reason)
            logged = reason
            await asyncio.sleep(next(delays))

    async def close(self) -> None:
        """Go to Finalized, and then stop the services. Idempotent."""
        self.closed = True
        autostart_task, self._autostart_task = self._autostart_task, None
        try:
            if autostart_task is not None:
                autostart_task.cancel()
                await asyncio.wait((autostart_task,))
            await super().close()
        finally:
            closables, self._closables = self._closables, []
            for closable in closables:
                closable.close()


async def run_application(camera: Camera[Any], application: int, timeout: float) -> None:
    """Load and run an application; each step has ``timeout`` seconds.

    Raises:
        SmartCamError: a step failed.
    """
    if await camera.query_application() != application:
        await camera.switch_application(application, timeout=timeout)
    if camera.capabilities.start_stop and Status.RUNNING not in camera.status:
        await camera.start(timeout=timeout)
    await camera.wait_ready(timeout)


def is_managed(node: Any) -> bool:
    """Return True if a node is of ROS 2, which has managed nodes."""
    return getattr(node, "graph", None) is not None


def _transition_fields(transitions: Any) -> dict[str, Any]:
    return {"available_transitions": [transition.fields for transition in transitions]}
