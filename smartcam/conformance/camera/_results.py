"""The checks and questions about a camera, and their outcomes.

A *check* holds the camera against something that is documented, and fails where it differs. A
*question* is open in the documents; its answer is a value, mostly one of
:class:`~smartcam.emulator.Quirks`.
"""

from __future__ import annotations

import enum
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from smartcam.conformance._dialects import EVERY_DIALECT
from smartcam.conformance.camera._options import Allow
from smartcam.emulator import Quirks

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.conformance.camera._session_under_test import CameraUnderTest


class CheckOutcome(enum.Enum):
    """The outcome of a check or a question."""

    AS_DOCUMENTED = "as documented"
    DIFFERS = "differs"
    OBSERVED = "observed"
    UNDESCRIBED = "undescribed"
    NOT_OBSERVED = "not observed"
    NOT_APPLICABLE = "not applicable"


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """A check or a question."""

    name: str  # in reports and for ``-k``
    about: str  # what is looked at, one sentence
    # where it stands and its grade, ``"SC-A28, published"``, by dialect; ``""`` is for the others
    sources: Mapping[str, str]
    # does it. A check returns nothing or a remark, a question the value.
    run: Callable[[CameraUnderTest], Any]
    needs: Allow = Allow.NOTHING  # what it does to the camera
    dialects: tuple[str, ...] = EVERY_DIALECT  # those in which it makes sense
    transports: tuple[str, ...] = ("tcp", "udp")  # those over which it makes sense
    documents: tuple[str, ...] = ()  # which contradictions of ``docs/unknowns.md`` it decides

    def source(self, dialect: str) -> tuple[str, str]:
        """Return the source for a dialect, and the grade."""
        text = self.sources.get(dialect) or self.sources[""]
        place, _, grade = text.rpartition(", ")
        return place, grade


@dataclass(frozen=True, slots=True, kw_only=True)
class Check(Item):
    """Something documented, which the camera is held against."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Question(Item):
    """Something that the documents leave open, or contradict each other about."""

    @property
    def quirk(self) -> str | None:
        """The field of :class:`~smartcam.emulator.Quirks` that the answer is a value of.

        None if it is a fact for people.
        """
        return self.name if self.name in Quirks.model_fields else None


NAMES = (
    *("BUSY", "Connect", "Get", "Overtriggered", "Query", "Reset", "Set", "Start", "Stop"),
    "Waiting",
)
"""Words of the protocol, which keep their capital letter in a sentence."""


def check(
    sources: str | Mapping[str, str], *, about: str = "", **more: Any
) -> Callable[[Callable[[CameraUnderTest], Any]], Check]:
    """Make a check of the function below: its name and docstring are those of the check.

    ``_items.py`` finds it where its module is one of ``_MODULES`` there, in the file's order.
    The rest is what an :class:`Item` has: ``sources`` as a text hold for every dialect, ``about``
    stands where the docstring's line has no room for it.
    """
    return lambda run: Check(
        name=run.__name__.replace("_", "-"), **_described(run, sources, about), **more
    )


def question(
    sources: str | Mapping[str, str], **more: Any
) -> Callable[[Callable[[CameraUnderTest], Any]], Question]:
    """Make a question of the function below, as :func:`check`."""
    return lambda run: Question(name=run.__name__, **_described(run, sources), **more)


def _described(
    run: Callable[[CameraUnderTest], Any], sources: str | Mapping[str, str], about: str = ""
) -> dict[str, Any]:
    text = (inspect.getdoc(run) or "").removesuffix(".")
    if not text.startswith(NAMES):
        text = text[:1].lower() + text[1:]
    by_dialect = sources if isinstance(sources, Mapping) else {"": sources}
    return {"run": run, "about": about or text, "sources": by_dialect}


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFinding:
    """A check or a question with its outcome."""

    item: Item
    outcome: CheckOutcome
    source: str  # where it stands
    grade: str  # of the source
    value: Any = None  # the answer to a question; None for a check
    text: str = ""  # a remark, or why nothing was observed
    expected: str = ""  # where it differs, what was expected
    came: str = ""  # where it differs, what came
    wire: tuple[str, ...] = ()  # what went over the wire, where it differs
    seconds: float = 0.0  # how long it took

    @property
    def failed(self) -> bool:
        """True if the camera is not the documented one here."""
        return self.outcome in {CheckOutcome.DIFFERS, CheckOutcome.UNDESCRIBED}

    def as_json(self) -> dict[str, Any]:
        """Return the finding as JSON has it."""
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
