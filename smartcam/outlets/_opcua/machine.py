"""Keep the states of a vision system, and allow only the transitions that the nodeset defines."""

from __future__ import annotations

from smartcam.exceptions import OutletError
from smartcam.outlets._opcua.nodeset import AUTOMATIC, VISION, Transition, transitions


class WrongStateError(OutletError):
    """A method was called in a state in which the nodeset has no transition for it."""


class VisionStates:
    """The states of a vision system's two state machines: the whole system's, and that for jobs.

    Attributes:
        vision: name of the state of the whole system.
        automatic: name of the state of the state machine for jobs; "" if the system is not
            operational.
    """

    def __init__(self) -> None:
        self.vision = "Preoperational"
        self.job_state = ""

    @property
    def text(self) -> str:
        """Both states as a text."""
        return f"{self.vision} {self.job_state}".rstrip()

    def allows(self, cause: str) -> bool:
        """Return True if a method causes a transition from the present state."""
        return self._find_transition("", cause) is not None

    def move(self, target: str, cause: str = "") -> Transition:
        """Move to a state and return the transition.

        Args:
            target: name of the state.
            cause: name of the method that causes the transition; "" without a method.

        Raises:
            WrongStateError: there is no such transition.
        """
        transition = self._find_transition(target, cause)
        if transition is None:
            cause = cause or "no transition without a method"
            raise WrongStateError(f"{cause} does not lead from {self.text} to {target}")
        if transition.machine == AUTOMATIC:
            self.job_state = target
        else:
            self.vision = target
            self.job_state = "Initialized" if target == "Operational" else ""
        return transition

    def _find_transition(self, target: str, cause: str) -> Transition | None:
        """Return a transition from the present state; ``target`` "": to any state."""
        states = {VISION: self.vision, AUTOMATIC: self.job_state}
        sources = {(transition.machine, transition.source) for transition in transitions()}
        for transition in transitions():
            if states[transition.machine] != transition.source or transition.cause != cause:
                continue
            if (transition.machine, transition.target) not in sources:
                continue  # Preoperational to Initialized belongs to the other state machine
            if target in ("", transition.target):
                return transition
        return None
