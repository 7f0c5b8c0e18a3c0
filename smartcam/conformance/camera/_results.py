"""The checks and questions about a camera, and their outcomes.

A *check* compares the camera with a documented fact, and fails if the camera differs. A *question*
is open in the documents; its answer is a value, mostly of a field of
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
    UNDESCRIBED = "undescribed"  # a question failed: no value of its quirk describes the camera
    NOT_OBSERVED = "not observed"
    NOT_APPLICABLE = "not applicable"


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """A check or a question."""

    name: str  # in reports and for ``-k``
    about: str  # documented fact or question, one sentence
    # key in docs/sources.md and grade, "SC-A28, published", by dialect; "": all other dialects
    sources: Mapping[str, str]
    # function to call: for a check it returns None or a remark, for a question the value
    run: Callable[[CameraUnderTest], Any]
    needs: Allow = Allow.NOTHING  # actions on the camera that the item needs
    dialects: tuple[str, ...] = EVERY_DIALECT  # dialects that the item applies to
    transports: tuple[str, ...] = ("tcp", "udp")  # transports that the item applies to
    contradictions: tuple[str, ...] = ()  # ids in ``docs/unknowns.md`` that the outcome decides

    def source(self, dialect: str) -> tuple[str, str]:
        """Return the source for a dialect, and the source's grade."""
        text = self.sources.get(dialect) or self.sources[""]
        source, _, grade = text.rpartition(", ")
        return source, grade


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


CAPITALIZED_WORDS = (
    *("BUSY", "Connect", "Get", "Overtriggered", "Query", "Reset", "Set", "Start", "Stop"),
    "Waiting",
)
"""Words of the protocol, which keep their capital letter in a sentence."""


def check(
    sources: str | Mapping[str, str], *, about: str = "", **fields: Any
) -> Callable[[Callable[[CameraUnderTest], Any]], Check]:
    """Turn the decorated function into a check, with the function's name and docstring.

    ``_items.py`` collects the checks of the modules in its ``_MODULES``, in the order of the files.
    The arguments are fields of :class:`Item`. ``sources`` may be one text for every dialect;
    ``about`` replaces the docstring where one line is too short for the fact.
    """
    return lambda run: Check(
        name=run.__name__.replace("_", "-"), **_item_fields(run, sources, about), **fields
    )


def question(
    sources: str | Mapping[str, str], **fields: Any
) -> Callable[[Callable[[CameraUnderTest], Any]], Question]:
    """Turn the decorated function into a question, as :func:`check` does."""
    return lambda run: Question(name=run.__name__, **_item_fields(run, sources), **fields)


def _item_fields(
    run: Callable[[CameraUnderTest], Any], sources: str | Mapping[str, str], about: str = ""
) -> dict[str, Any]:
    text = (inspect.getdoc(run) or "").removesuffix(".")
    if not text.startswith(CAPITALIZED_WORDS):
        text = text[:1].lower() + text[1:]
    by_dialect = sources if isinstance(sources, Mapping) else {"": sources}
    return {"run": run, "about": about or text, "sources": by_dialect}


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraFinding:
    """The outcome of a check or a question."""

    item: Item
    outcome: CheckOutcome
    source: str  # source of the fact
    grade: str  # grade of the source
    value: Any = None  # the answer to a question; None for a check
    text: str = ""  # a remark, or the reason why nothing was observed
    expected: str = ""  # expected behaviour, if the item failed
    observed: str = ""  # observed behaviour, if the item failed
    wire: tuple[str, ...] = ()  # messages on the wire, if the item failed
    seconds: float = 0.0  # duration of the check or question

    @property
    def failed(self) -> bool:
        """True if the camera differs from the documents, or no value of the quirk describes it."""
        return self.outcome in {CheckOutcome.DIFFERS, CheckOutcome.UNDESCRIBED}

    def as_json(self) -> dict[str, Any]:
        """Return the finding as values for JSON."""
        row: dict[str, Any] = {
            "name": self.item.name,
            "about": self.item.about,
            "source": self.source,
            "grade": self.grade,
            "outcome": self.outcome.value,
            "decides": list(self.item.contradictions),
            "seconds": round(self.seconds, 3),
        }
        if isinstance(self.item, Question):
            row |= {"quirk": self.item.quirk, "value": self.value}
        if self.text:
            row["text"] = self.text
        if self.failed:
            row |= {"expected": self.expected, "observed": self.observed, "wire": list(self.wire)}
        return row
