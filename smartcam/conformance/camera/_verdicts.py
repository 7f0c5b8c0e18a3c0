"""The exceptions that end checks and questions: verdicts on the camera or the experiment."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(eq=False)
class Differs(Exception):  # noqa: N818 - it is a verdict on the camera
    """The camera behaves differently than documented."""

    expected: str  # documented behaviour
    observed: str  # observed behaviour

    def __str__(self) -> str:
        """Return both behaviours as text."""
        return f"expected: {self.expected}; observed: {self.observed}"


class Undescribed(Differs):
    """The camera behaves as no value of the quirk describes that the question is about."""


class NotObserved(Exception):  # noqa: N818 - it is a verdict on the experiment
    """The behaviour could not be observed; the text is the reason, as a clause after "because"."""
