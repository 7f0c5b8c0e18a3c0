"""The life cycle of a managed node: its states, its services, and what they mean for a camera.

States, transitions, their ids and labels are lifecycle_msgs' and rcl_lifecycle's
(``default_state_machine.c``), services and topic those of its ``com_interface.c``.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.backoff import Backoff
from smartcam.exceptions import ResponseTimeoutError, RosError, SmartCamError
from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from smartcam.camera import Camera

logger: logging.Logger = logging.getLogger("smartcam.ros2")

PATIENCE = 60.0
"""Seconds that one wait for a camera takes before the next one begins."""

RETRY = Backoff(initial=0.5, maximum=10.0)
"""When a camera that is there, but could not be had as wanted, is tried again."""


class LifecycleState(NamedTuple):
    """A state, as ``lifecycle_msgs/msg/State`` has it."""

    id: int
    label: str


class LifecycleTransition(NamedTuple):
    """A way from a state to another, as ``lifecycle_msgs/msg/TransitionDescription`` has it."""

    id: int
    label: str
    start: LifecycleState
    goal: LifecycleState

    @property
    def fields(self) -> dict[str, Any]:
        """The message's fields."""
        return {
            "transition": {"id": self.id, "label": self.label},
            "start_state": self.start._asdict(),
            "goal_state": self.goal._asdict(),
        }


STATES = tuple(
    LifecycleState(number, label)
    for number, label in (
        (0, "unknown"),
        (1, "unconfigured"),
        (2, "inactive"),
        (3, "active"),
        (4, "finalized"),
        (10, "configuring"),
        (11, "cleaningup"),
        (12, "shuttingdown"),
        (13, "activating"),
        (14, "deactivating"),
        (15, "errorprocessing"),
    )
)
"""In the order in which rcl names them."""

_STATE = {state.label: state for state in STATES}
UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = (
    _STATE[label] for label in ("unconfigured", "inactive", "active", "finalized")
)

SUCCESS, FAILURE, ERROR = "transition_success", "transition_failure", "transition_error"

TRANSITIONS = tuple(
    LifecycleTransition(number, label, _STATE[start], _STATE[goal])
    for number, label, start, goal in (
        (1, "configure", "unconfigured", "configuring"),
        (10, SUCCESS, "configuring", "inactive"),
        (11, FAILURE, "configuring", "unconfigured"),
        (12, ERROR, "configuring", "errorprocessing"),
        (2, "cleanup", "inactive", "cleaningup"),
        (20, SUCCESS, "cleaningup", "unconfigured"),
        (21, FAILURE, "cleaningup", "inactive"),
        (22, ERROR, "cleaningup", "errorprocessing"),
        (3, "activate", "inactive", "activating"),
        (30, SUCCESS, "activating", "active"),
        (31, FAILURE, "activating", "inactive"),
        (32, ERROR, "activating", "errorprocessing"),
        (4, "deactivate", "active", "deactivating"),
        (40, SUCCESS, "deactivating", "inactive"),
        (41, FAILURE, "deactivating", "active"),
        (42, ERROR, "deactivating", "errorprocessing"),
        (5, "shutdown", "unconfigured", "shuttingdown"),
        (6, "shutdown", "inactive", "shuttingdown"),
        (7, "shutdown", "active", "shuttingdown"),
        (50, SUCCESS, "shuttingdown", "finalized"),
        (51, FAILURE, "shuttingdown", "finalized"),
        (52, ERROR, "shuttingdown", "errorprocessing"),
        (60, SUCCESS, "errorprocessing", "unconfigured"),
        (61, FAILURE, "errorprocessing", "finalized"),
        (62, ERROR, "errorprocessing", "finalized"),
    )
)
"""In the order in which rcl names them; those from 10 on nobody can ask for."""

PRIVATE = 10
"""Ids from here on are of transitions that follow by themselves."""


class Lifecycle:
    """The states of a managed node, and the ways between them; one at a time.

    A transition that has begun goes on when who asked for it gives up. What it has to do may fail
    with a :exc:`~smartcam.SmartCamError`, which leads back; any other error leads over error
    processing to Unconfigured.

    Args:
        name: the node's, for texts.
        work: what there is to do for a transition, by its label.
        timeout: seconds that a transition may take.

    Attributes:
        state: the present one; a transition's own while it is under way.
    """

    def __init__(
        self, name: str, work: Mapping[str, Callable[[], Awaitable[None]]], timeout: float
    ) -> None:
        self.name, self.state = name, UNCONFIGURED
        self._work, self._timeout = work, timeout
        self._heard: list[Callable[[LifecycleTransition], None]] = []
        self._task: asyncio.Task[None] | None = None
        self._closed = False

    @property
    def active(self) -> bool:
        """Whether results are to be published."""
        return self.state is ACTIVE

    @property
    def available(self) -> list[LifecycleTransition]:
        """The transitions that begin at the present state."""
        return [one for one in TRANSITIONS if one.start is self.state]

    def listen(self, heard: Callable[[LifecycleTransition], None]) -> Callable[[], None]:
        """Have ``heard`` called after each step; return what ends that."""
        self._heard.append(heard)
        return lambda: self._heard.remove(heard) if heard in self._heard else None

    async def change(self, label: str = "", number: int = 0) -> None:
        """Make a transition; its label counts where both are given, as in rclcpp_lifecycle.

        Raises:
            RosError: it does not begin at the present state, or one is under way.
            SmartCamError: it failed, which is how.

        Cancellation: it goes on.
        """
        transition = self._find(label, number)
        self._enter(transition)
        self._task = asyncio.get_running_loop().create_task(self._finish(transition))
        self._task.add_done_callback(_seen)
        await asyncio.shield(self._task)

    async def configure(self) -> None:
        """From Unconfigured to Inactive; as :meth:`change`."""
        await self.change("configure")

    async def activate(self) -> None:
        """From Inactive to Active; as :meth:`change`."""
        await self.change("activate")

    async def deactivate(self) -> None:
        """From Active to Inactive; as :meth:`change`."""
        await self.change("deactivate")

    async def cleanup(self) -> None:
        """From Inactive to Unconfigured; as :meth:`change`."""
        await self.change("cleanup")

    async def shutdown(self) -> None:
        """To Finalized, for good; as :meth:`change`."""
        await self.change("shutdown")

    async def close(self) -> None:
        """Give up what is under way, and be Finalized. Idempotent."""
        self._closed = True
        task = self._task
        if task is not None and not task.done():
            task.cancel()
            await asyncio.wait((task,))
        for label in ("shutdown", SUCCESS):
            step = next((one for one in self.available if one.label == label), None)
            if step is not None and self.state is not FINALIZED:
                self._enter(step)

    def _find(self, label: str, number: int) -> LifecycleTransition:
        possible = [one for one in self.available if one.id < PRIVATE]
        for one in possible:
            if not self._closed and (one.label == label if label else one.id == number):
                return one
        wanted = label[:40] or f"transition {number}"
        ways = ", ".join(f"{one.label} ({one.id})" for one in possible) or "nothing"
        state = "closed" if self._closed else self.state.label
        raise RosError(f"{self.name}: {wanted}: it is {state}, where {ways} can be asked for")

    async def _finish(self, transition: LifecycleTransition) -> None:
        try:
            async with asyncio.timeout(self._timeout):
                work = self._work.get(transition.label)
                if work is not None:
                    await work()
        except asyncio.CancelledError:
            self._follow(FAILURE)
            raise
        except SmartCamError:
            self._follow(FAILURE)
            raise
        except TimeoutError as exc:
            self._follow(FAILURE)
            text = f"{self.name}: {transition.label}: it took more than {self._timeout:g} s"
            raise ResponseTimeoutError(text, waited=self._timeout) from exc
        except Exception as exc:
            logger.exception("%s ! %s failed", self.name, transition.label)
            self._follow(ERROR)
            self._follow(SUCCESS)  # there is nothing that would have to be put back
            text = f"{self.name}: {transition.label}: {type(exc).__name__}: {exc}"
            raise RosError(text) from exc
        self._follow(SUCCESS)

    def _follow(self, label: str) -> None:
        self._enter(next(one for one in self.available if one.label == label))

    def _enter(self, transition: LifecycleTransition) -> None:
        self.state = transition.goal
        for heard in tuple(self._heard):
            try:
                heard(transition)
            except Exception:
                logger.exception("%s ! who was told that it is %s", self.name, self.state.label)


def _seen(task: asyncio.Task[None]) -> None:
    """Look at how it ended, also where nobody waits for it any more."""
    if not task.cancelled():
        task.exception()


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
    somebody asks for a transition first.

    Args:
        camera: it.
        node: of ROS 2 or of ROS 1, where there are no services of a life cycle.
        application: to have running and ready; None for what the camera's settings say.
        autostart: go to Active by itself.
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

    def start(self) -> None:
        """Serve, and go to Active by itself where that is wanted."""
        if is_managed(self._node):
            self._declare()
        if self._autostart:
            self._starting = asyncio.get_running_loop().create_task(self._start_up())

    def _declare(self) -> None:
        self._event = self._node.publisher(
            "~/transition_event", "lifecycle_msgs/msg/TransitionEvent"
        )
        self._ends.append(self._event)
        self.listen(self._say)
        self._serve("ChangeState", "change_state", self._on_change_state)
        self._serve("GetState", "get_state", lambda: {"current_state": self.state._asdict()})
        self._serve(
            "GetAvailableStates",
            "get_available_states",
            lambda: {"available_states": [one._asdict() for one in STATES]},
        )
        ways = "GetAvailableTransitions"
        self._serve(ways, "get_available_transitions", lambda: _described(self.available))
        self._serve(ways, "get_transition_graph", lambda: _described(TRANSITIONS))

    def _serve(self, kind: str, name: str, what: Any) -> None:
        async def answer(_request: object) -> Any:
            return what()

        handler = what if asyncio.iscoroutinefunction(what) else answer
        self._ends.append(self._node.serve(f"~/{name}", f"lifecycle_msgs/srv/{kind}", handler))

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

    async def change(self, label: str = "", number: int = 0) -> None:
        """Make a transition; see :meth:`Lifecycle.change`. It no longer starts by itself then."""
        self._find(label, number)
        self._give_up_starting()
        await super().change(label, number)

    def _give_up_starting(self) -> None:
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
        if await camera.query_application() != application:
            await camera.switch_application(application)
        if camera.capabilities.start_stop and Status.RUNNING not in camera.status:
            await camera.start(timeout=limit)
        await camera.wait_ready(limit)

    async def _start_up(self) -> None:
        """Go to Active as soon as the camera is there, however long that takes."""
        told, delays = "", RETRY.delays()
        while True:
            try:
                await self._camera.wait_connected(PATIENCE)
                if self.state is UNCONFIGURED:
                    await self.configure()
                await self.activate()
                return
            except SmartCamError as exc:
                why = str(exc)
            level = logging.DEBUG if why == told else logging.WARNING
            logger.log(level, "%s ! it is not active yet: %s", self.name, why)
            told = why
            await asyncio.sleep(next(delays))

    async def close(self) -> None:
        """End it; others are told, and then it serves no more. Idempotent."""
        starting, self._starting = self._starting, None
        if starting is not None:
            starting.cancel()
            await asyncio.wait((starting,))
        try:
            await super().close()
        finally:
            ends, self._ends = self._ends, []
            for end in ends:
                end.close()


def is_managed(node: Any) -> bool:
    """Return whether a node is of ROS 2, which has managed nodes."""
    return getattr(node, "graph", None) is not None


def _described(transitions: Any) -> dict[str, Any]:
    return {"available_transitions": [one.fields for one in transitions]}
