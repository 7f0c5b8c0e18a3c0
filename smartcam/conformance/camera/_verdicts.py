"""The exceptions by which checks and questions end: verdicts on the camera or the experiment."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(eq=False)
class Differs(Exception):  # noqa: N818 - it is a verdict on the camera
    """The camera does something else than the documents say."""

    expected: str  # what the documents say
    came: str  # what was seen instead

    def __str__(self) -> str:
        """Return both."""
        return f"expected: {self.expected}; came: {self.came}"


class Undescribed(Differs):
    """A question was answered by something that no setting of its quirk describes."""


class NotObserved(Exception):  # noqa: N818 - it is a verdict on the experiment
    """The camera could not be seen doing it; the text says why, as what follows "because"."""
