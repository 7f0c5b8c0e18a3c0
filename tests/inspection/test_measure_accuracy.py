"""Errors against the Cramer-Rao bound: the short form of `tests.inspection.proofs.calipers`."""

from __future__ import annotations

import pytest

from tests.inspection.proofs.calipers import (
    Case,
    CircleCase,
    EdgeCase,
    Light,
    LineCase,
    WidthCase,
    judged,
)

SHORT = [
    EdgeCase(name="edge"),
    EdgeCase(name="edge along the pixels, sharp", angle=0.0, light=Light(blur=0.4)),
    EdgeCase(name="edge, tilted, 16 bits", tilt=10.0, light=Light(bits=16)),
    WidthCase(name="bar of 4 px", wide=4.0),
]

SLOW = [
    LineCase(name="line, 2 of 10 strips dirty", dirty=2),
    CircleCase(name="small circle", radius=8.0, strips=10),
    CircleCase(name="arc", radius=30.0, arc=(10.0, 100.0), strips=10),
]


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize(
    "case",
    [*SHORT, *(pytest.param(one, marks=[pytest.mark.long, pytest.mark.widest]) for one in SLOW)],
    ids=lambda case: case.name,
)
def test_errors_are_near_the_bound_and_sigmas_true(case: Case) -> None:
    rows = judged(case, seed=2, drawings=3, pictures=20)
    assert rows
    # chance does a quarter to sixty trials, which the rows allow for
    assert [str(row) for row in rows if not row.good] == []
