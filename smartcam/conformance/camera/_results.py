"""The checks and questions about a camera, and their outcomes.

A *check* compares the camera with a documented fact, and fails if it differs. A *question* is open
in the documents; its answer is a value, mostly of a field of
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
    about: str  # documented fact or question, one sentence
    # source and grade, ``"SC-A28, published"``, by dialect; ``""`` is for the others
    sources: Mapping[str, str]
    # runs it: a check returns nothing or a remark, a question returns the value
    run: Callable[[CameraUnderTest], Any]
    needs: Allow = Allow.NOTHING  # actions on the camera that it needs
    dialects: tuple[str, ...] = EVERY_DIALECT  # dialects that it applies to
    transports: tuple[str, ...] = ("tcp", "udp")  # transports that it applies to
    documents: tuple[str, ...] = ()  # contradictions in ``docs/unknowns.md`` that it decides

    def source(self, dialect: str) -> tuple[str, str]:
        """Return the source for a dialect, and the grade."""
        text = self.sources.get(dialect) or self.sources[""]
        place, _, grade = text.rpartition(", ")
        return place, grade


@dataclass(frozen=True, slots=True, kw_only=True)
class Check(Item):
    """A documented fact that the camera is compared with."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Question(Item):
    """A fact that the documents leave open, or contradict each other about."""

    @property
    def quirk(self) -> str | None:
        """The field of :class:`~smartcam.emulator.Quirks` whose value is the answer.

        None for a fact without a field.
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
    """Make the decorated function a check, with the function's name and docstring.

    ``_items.py`` finds it if its module is in ``_MODULES`` there, in the file's order.
    The arguments are fields of :class:`Item`: ``sources`` as a text is for every dialect, ``about``
    replaces a docstring's line that is too short.
    """
    return lambda run: Check(
        name=run.__name__.replace("_", "-"), **_described(run, sources, about), **more
    )


def question(
    sources: str | Mapping[str, str], **more: Any
) -> Callable[[Callable[[CameraUnderTest], Any]], Question]:
    """Make the decorated function a question, as :func:`check`."""
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
    source: str  # source of the fact
    grade: str  # grade of the source
    value: Any = None  # the answer to a question; None for a check
    text: str = ""  # a remark, or the reason why nothing was observed
    expected: str = ""  # expected behaviour, if it differs
    observed: str = ""  # observed behaviour, if it differs
    wire: tuple[str, ...] = ()  # messages on the wire, if it differs
    seconds: float = 0.0  # duration

    @property
    def failed(self) -> bool:
        """True if the camera differs from the documents here."""
        return self.outcome in {CheckOutcome.DIFFERS, CheckOutcome.UNDESCRIBED}

    def as_json(self) -> dict[str, Any]:
        """Return the finding as values for JSON."""
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
            row |= {"expected": self.expected, "came": self.observed, "wire": list(self.wire)}
        return row
