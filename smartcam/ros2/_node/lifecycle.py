"""The states of a managed node, and its transitions.

Ids and labels are those of lifecycle_msgs and rcl_lifecycle (``default_state_machine.c``).
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import ResponseTimeoutError, RosError, SmartCamError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

logger: logging.Logger = logging.getLogger("smartcam.ros2")


class LifecycleState(NamedTuple):
    """A state, as in ``lifecycle_msgs/msg/State``."""

    id: int
    label: str


class LifecycleTransition(NamedTuple):
    """A transition, as in ``lifecycle_msgs/msg/TransitionDescription``."""

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
"""States of a node, in rcl's order."""

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
"""Transitions, in rcl's order. Those from number 10 on cannot be requested."""

FIRST_INTERNAL_ID = 10
"""First id of the transitions, and states, that follow by themselves and cannot be requested."""


class Lifecycle:
    """The states of a managed node, and its transitions, of which one runs at a time.

    A transition that has begun continues when its caller is cancelled. If its work raises a
    :exc:`~smartcam.SmartCamError` or takes too long, the node returns to the previous state; after
    any other error it goes through error processing to Unconfigured.

    Args:
        name: name of the node, for texts.
        work: functions that do the work of transitions, by their labels.
        timeout: seconds of a transition's timeout.

    Attributes:
        state: the current state; during a transition the state of the transition.
        closed: True once transitions can no longer be requested.
    """

    def __init__(
        self, name: str, work: Mapping[str, Callable[[], Awaitable[None]]], timeout: float
    ) -> None:
        self.name: str = name
        self.state: LifecycleState = UNCONFIGURED
        self._work, self._timeout = work, timeout
        self._listeners: list[Callable[[LifecycleTransition], None]] = []
        self._task: asyncio.Task[None] | None = None
        self.closed: bool = False

    @property
    def active(self) -> bool:
        """True if results should be published."""
        return self.state is ACTIVE

    @property
    def available(self) -> list[LifecycleTransition]:
        """The transitions that begin at the current state."""
        return [transition for transition in TRANSITIONS if transition.start is self.state]

    def listen(self, on_step: Callable[[LifecycleTransition], None]) -> Callable[[], None]:
        """Call ``on_step`` after each change of the state; return a function that ends this."""
        self._listeners.append(on_step)
        return lambda: self._listeners.remove(on_step) if on_step in self._listeners else None

    async def wait_for_transition(self) -> None:
        """Wait for the end of a running transition.

        Raises:
            RosError: a transition takes longer than its timeout.
        """
        try:
            async with asyncio.timeout(self._timeout):
                while self._task is not None and not self._task.done():
                    await asyncio.wait((self._task,))
        except TimeoutError as exc:
            text = f"{self.name}: other transitions took {self._timeout:g} s"
            raise RosError(text) from exc

    async def change(self, label: str = "", number: int = 0) -> None:
        """Make a transition, after the end of a running one.

        Args:
            label: name of the transition; with a label ``number`` is ignored, as in
                rclcpp_lifecycle.
            number: id of the transition.

        Raises:
            RosError: the transition does not begin at the current state.
            SmartCamError: the transition failed; the error has the reason.

        Cancellation: a transition that has begun continues.
        """
        await self.wait_for_transition()
        transition = self._find_transition(label, number)
        self._on_transition_requested()
        self._enter(transition)
        self._task = asyncio.get_running_loop().create_task(self._run_transition(transition))
        self._task.add_done_callback(self._on_task_done)
        await asyncio.shield(self._task)

    def _on_transition_requested(self) -> None:
        """Do what a subclass needs before a requested transition begins."""

    async def configure(self) -> None:
        """Go from Unconfigured to Inactive like :meth:`change`, unless Inactive or Active."""
        await self._change_unless_in("configure", INACTIVE, ACTIVE)

    async def activate(self) -> None:
        """Go from Inactive to Active like :meth:`change`, unless Active already."""
        await self._change_unless_in("activate", ACTIVE)

    async def deactivate(self) -> None:
        """Go from Active to Inactive like :meth:`change`, unless Inactive or Unconfigured."""
        await self._change_unless_in("deactivate", INACTIVE, UNCONFIGURED)

    async def cleanup(self) -> None:
        """Go from Inactive to Unconfigured like :meth:`change`, unless Unconfigured already."""
        await self._change_unless_in("cleanup", UNCONFIGURED)

    async def shutdown(self) -> None:
        """Go to Finalized, for good, like :meth:`change`."""
        await self._change_unless_in("shutdown", FINALIZED)

    async def _change_unless_in(self, label: str, *states: LifecycleState) -> None:
        await self.wait_for_transition()
        if self.closed or self.state not in states:
            await self.change(label)

    async def close(self) -> None:
        """Cancel a running transition, and go to Finalized. Idempotent."""
        self.closed = True
        task = self._task
        if task is not None and not task.done():
            task.cancel()
            await asyncio.wait((task,))
        for label in ("shutdown", SUCCESS):
            step = next((step for step in self.available if step.label == label), None)
            if step is not None and self.state is not FINALIZED:
                self._enter(step)

    def _find_transition(self, label: str, number: int) -> LifecycleTransition:
        possible = [step for step in self.available if step.id < FIRST_INTERNAL_ID]
        for step in possible:
            if not self.closed and (step.label == label if label else step.id == number):
                return step
        transition_text = repr(label[:40]) if label else f"transition {number}"
        possible_text = ", ".join(f"{step.label} ({step.id})" for step in possible) or "nothing"
        state = "closed" if self.closed else self.state.label
        raise RosError(
            f"{self.name}: {transition_text}: it is {state}, where {possible_text} can be asked for"
        )

    async def _run_transition(self, transition: LifecycleTransition) -> None:
        try:
            async with asyncio.timeout(self._timeout):
                work = self._work.get(transition.label)
                if work is not None:
                    await work()
        except SmartCamError:
            self._enter_by_label(FAILURE)
            raise
        except TimeoutError as exc:
            self._enter_by_label(FAILURE)
            text = f"{self.name}: {transition.label}: it took more than {self._timeout:g} s"
            raise ResponseTimeoutError(text, waited=self._timeout) from exc
        except asyncio.CancelledError:
            raise
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            logger.exception("%s ! %s failed", self.name, transition.label)
            self._enter_by_label(ERROR)
            self._enter_by_label(SUCCESS)  # nothing has to be undone
            text = f"{self.name}: {transition.label}: {type(exc).__name__}: {exc}"
            raise RosError(text) from exc
        self._enter_by_label(SUCCESS)

    def _on_task_done(self, task: asyncio.Task[None]) -> None:
        """Handle the end of a transition; a cancelled one has failed."""
        if task.cancelled():
            self._enter_by_label(FAILURE)
        else:
            task.exception()

    def _enter_by_label(self, label: str) -> None:
        self._enter(next(step for step in self.available if step.label == label))

    def _enter(self, transition: LifecycleTransition) -> None:
        self.state = transition.goal
        if self.state.id < FIRST_INTERNAL_ID:
            logger.info("%s = %s", self.name, self.state.label)
        for on_step in tuple(self._listeners):
            try:
                on_step(transition)
            except ENDS_PROGRAM:
                raise
            except BaseException:
                logger.exception(
                    "%s ! a listener failed at the state %s", self.name, self.state.label
                )
