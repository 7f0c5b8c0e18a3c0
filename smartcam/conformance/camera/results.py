"""What a check or a question is, and what comes of one.

A *check* holds the camera against something that is documented, and fails where it differs. A
*question* is open in the documents; its answer is a value, mostly one of
:class:`~smartcam.emulator.bvs.quirks.Quirks`.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from smartcam.conformance.camera.options import Allow

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from smartcam.conformance.camera.session_under_test import Bench

__all__ = [
    "EVERY_DIALECT",
    "SMART",
    "Allow",
    "Check",
    "Differs",
    "Finding",
    "Item",
    "NotObserved",
    "Outcome",
    "Question",
    "Undescribed",
]

SMART: tuple[str, ...] = ("handbook", "thesis", "b16")
"""The dialects of smart cameras: with a run mode, statuses by themselves, and no result codes."""

EVERY_DIALECT: tuple[str, ...] = (*SMART, "bid")
"""All dialects."""


class Differs(Exception):  # noqa: N818 - it is a verdict on the camera
    """The camera does something else than the documents say.

    Args:
        expected: what the documents say.
        came: what was seen instead.
    """

    def __init__(self, expected: str, came: str) -> None:
        super().__init__(expected, came)
        self.expected: str = expected
        self.came: str = came

    def __str__(self) -> str:
        """Return both."""
        return f"expected: {self.expected}; came: {self.came}"


class Undescribed(Differs):
    """A question was answered by something that no setting of its quirk describes."""


class NotObserved(Exception):  # noqa: N818 - it is a verdict on the experiment
    """The camera could not be seen doing it; the text says why, as what follows "because"."""


class Outcome(enum.Enum):
    """What comes of a check or a question."""

    AS_DOCUMENTED = "as documented"
    DIFFERS = "differs"
    OBSERVED = "observed"
    UNDESCRIBED = "undescribed"
    NOT_OBSERVED = "not observed"
    NOT_APPLICABLE = "not applicable"


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """A check or a question.

    Attributes:
        name: in reports and for ``-k``.
        about: what is looked at, one sentence.
        sources: where it stands and its grade, ``"SC-A28, published"``, by dialect; ``""`` is for
            the others.
        run: does it. A check returns nothing or a remark, a question the value.
        needs: what it does to the camera.
        dialects: those in which it makes sense.
        transports: those over which it makes sense.
        documents: which contradictions of ``docs/unknowns.md`` it decides.
    """

    name: str
    about: str
    sources: Mapping[str, str]
    run: Callable[[Bench], Any]
    needs: Allow = Allow.NOTHING
    dialects: tuple[str, ...] = EVERY_DIALECT
    transports: tuple[str, ...] = ("tcp", "udp")
    documents: tuple[str, ...] = ()

    def source(self, dialect: str) -> tuple[str, str]:
        """Return where it stands for a dialect, and the grade."""
        text = self.sources.get(dialect) or self.sources[""]
        place, _, grade = text.rpartition(", ")
        return place, grade


@dataclass(frozen=True, slots=True, kw_only=True)
class Check(Item):
    """Something documented, which the camera is held against."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Question(Item):
    """Something that the documents leave open, or contradict each other about.

    Attributes:
        quirk: the field of :class:`~smartcam.emulator.bvs.quirks.Quirks` that the answer is a value
            of, None where it is a fact for people.
    """

    quirk: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What came of a check or a question.

    Attributes:
        item: which one.
        outcome: what came of it.
        source: where it stands.
        grade: of the source.
        value: the answer to a question; None for a check.
        text: a remark, or why nothing was observed.
        expected: where it differs, what was expected.
        came: where it differs, what came.
        wire: what went over the wire, where it differs.
        seconds: how long it took.
    """

    item: Item
    outcome: Outcome
    source: str
    grade: str
    value: Any = None
    text: str = ""
    expected: str = ""
    came: str = ""
    wire: tuple[str, ...] = field(default=())
    seconds: float = 0.0

    @property
    def failed(self) -> bool:
        """Whether the camera is not the documented one here."""
        return self.outcome in {Outcome.DIFFERS, Outcome.UNDESCRIBED}

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        row: dict[str, Any] = {
            "name": self.item.name,
            "about": self.item.about,
            "source": self.source,
            "grade": self.grade,
            "outcome": self.outcome.value,
            "decides": list(self.item.documents),
            "seconds": round(self.seconds, 3),
        }
        if isinstance(self.item, Question):
            row |= {"quirk": self.item.quirk, "value": self.value}
        if self.text:
            row["text"] = self.text
        if self.failed:
            row |= {"expected": self.expected, "came": self.came, "wire": list(self.wire)}
        return row
