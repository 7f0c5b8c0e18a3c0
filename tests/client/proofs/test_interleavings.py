"""A trigger returns its own result, or none, in every interleaving of a plain model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.client.inside import PendingTrigger, Results
from tests.client.proofs.interleavings import FRAMED, ROWS, Variant, table, visit

PROMISES = Path(__file__).parents[3] / "results" / "promises.md"

SHORT = (
    Variant(name="two calls", sensors=1, depth=14),
    Variant(name="sensor", sensors=1, results=(0, 1, 2), depth=60, triggers=1),
    Variant(name="sensor, preset", sensors=2, preset=True, depth=60, triggers=1),
    Variant(name="two wanted", sensors=1, triggers=1, results=(1, 2, 3), wanted=2, depth=60),
    Variant(name="number", sensors=1, number="own", bits=8, depth=14),
    Variant(name="number of the user's", sensors=1, number="given", depth=14),
    Variant(name="operator", sensors=1, stops=1, triggers=1, depth=60),
    Variant(name="bid", family="answer", depth=24),
    Variant(name="bid, refused", family="answer", refuses=True, depth=24),
)


class KeepsUnproven(Results):
    """With a fault that there was: a container that waits for a proof outlives its trigger."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.kept: list[Any] = []

    def end_trigger(self) -> None:
        if self._pending is not None:
            self.kept, self._pending.unproven = self._pending.unproven, []
        super().end_trigger()

    def begin_trigger(self, pending: PendingTrigger, deadline: float) -> None:
        super().begin_trigger(pending, deadline)
        pending.unproven, self.kept = self.kept, []
        pending.received = sum(fate == "triggered" for _, fate, *_ in pending.unproven)


class LosesUnproven(Results):
    """A container that waits for a proof is forgotten with its trigger."""

    def end_trigger(self) -> None:
        if self._pending is not None:
            self._pending.unproven = []
        super().end_trigger()


@pytest.mark.sampled(every=6)
@pytest.mark.parametrize("variant", SHORT, ids=lambda variant: variant.name)
def test_trigger_returns_its_own_result_or_none(variant: Variant) -> None:
    found = visit(variant)
    assert set(found.returned) == {"own"}, found.ways
    assert not found.unbalanced


@pytest.mark.parametrize(
    "variant",
    [
        Variant(name="status", sensors=0, depth=60),
        Variant(name="bid", family="answer", sensors=0, refuses=True, depth=60),
    ],
    ids=lambda variant: variant.name,
)
def test_visit_finds_a_wrong_result_where_results_have_a_fault(variant: Variant) -> None:
    """The library's own are visited, nothing that plays them."""
    assert visit(variant, KeepsUnproven).worst == "older"
    assert visit(variant).worst == "own"


def test_visit_finds_a_container_without_a_fate() -> None:
    variant = Variant(name="", sensors=0, triggers=1, depth=60)
    assert visit(variant, LosesUnproven).unbalanced
    assert not visit(variant).unbalanced


@pytest.mark.long
def test_visit_finds_what_goes_wrong_where_an_assumption_does() -> None:
    """Else it would find nothing anywhere."""
    shown = Variant(name="", in_order=False, exact=True, triggers=1, sensors=1, depth=13)
    hidden = replace(shown, family="round trip", in_order=True, shows=False, depth=9)
    assert visit(shown).worst == visit(hidden).worst == "older"


@pytest.mark.long
def test_order_that_nobody_can_see_changes_nothing() -> None:
    """The states that are left out unless ``exact`` is asked for change no outcome."""
    some = Variant(name="", sensors=1, triggers=1, results=(0, 1), depth=60)
    few, all_of_it = visit(some), visit(replace(some, exact=True))
    assert few.whole
    assert all_of_it.whole
    assert set(few.returned) == set(all_of_it.returned) == {"own"}
    assert few.states < all_of_it.states


@pytest.mark.long
@pytest.mark.widest
def test_table_of_the_promises_is_that_of_the_model() -> None:
    assert table(short=True) in PROMISES.read_text(encoding="utf-8")


def test_table_promises_the_triggers_own_result_over_tcp() -> None:
    text = PROMISES.read_text(encoding="utf-8")
    promised = [row for row in ROWS if row.where == FRAMED and " wrong" not in row.what][:4]
    for row in promised:
        assert f"| {row.where} | {row.what} | its own | its own | its own |" in text
