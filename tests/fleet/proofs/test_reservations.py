"""A reservation is kept or told lost, and a call done once, in every interleaving of a model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import pytest

from tests.fleet.proofs.reservations import TAKES_OVER, VARIANTS, Variant, Wrong, visit

SHORT_DEPTH = 8


def long(*values: Any) -> Any:
    return pytest.param(*values, marks=pytest.mark.long)


def widest(*values: Any) -> Any:
    return pytest.param(*values, marks=[pytest.mark.long, pytest.mark.widest])


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_block_that_ends_without_an_error_had_the_camera_for_itself(variant: Variant) -> None:
    found = visit(replace(variant, depth=SHORT_DEPTH))
    assert not found.ways
    assert found.kept
    assert found.told


@pytest.mark.long
@pytest.mark.widest
@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_the_same_as_deep_as_fits(variant: Variant) -> None:
    found = visit(variant)
    assert not found.ways
    assert found.whole or found.depth == variant.depth


@pytest.mark.parametrize(
    ("without", "wrong", "depth", "options"),
    [
        ("confirmed", "between", 9, {"forgotten": 1}),
        long("confirmed", "between", 12, {"starts": 2, "deaths": 1}),
        widest("fenced", "behind", 12, {"forgotten": 1, "cuts": 1}),
        long("asks", "between", 12, {**TAKES_OVER, "cuts": 1, "commands": 0}),
        widest(
            "only_with_a_session",
            "between",
            14,
            {**TAKES_OVER, "cuts": 1, "again": 1, "commands": 0},
        ),
        ("once", "twice", 8, {"doubles": 1}),
    ],
)
def test_each_rule_is_needed(
    without: str, wrong: Wrong, depth: int, options: dict[str, Any]
) -> None:
    """Else the visit would find nothing anywhere."""
    variant, other = Variant(name="", depth=depth, **options), cast("Any", {without: False})
    assert not visit(variant).ways
    assert wrong in visit(replace(variant, **other)).ways
