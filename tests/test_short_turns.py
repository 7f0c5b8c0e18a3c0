"""Turns of Python's threads: the shortest that is wanted, and the one from before in the end."""

from __future__ import annotations

import itertools
import sys

import pytest

from smartcam._short_turns import leave_turns, short_turns, shorten_turns


@pytest.mark.parametrize("order", [*itertools.permutations(("half", "one", "slow"))])
def test_shortest_wanted_turn_holds_and_the_first_comes_back(order: tuple[str, ...]) -> None:
    before = sys.getswitchinterval()
    wanted = {"half": 0.0005, "one": 0.001, "slow": 1.0}
    for name, seconds in wanted.items():
        shorten_turns(name, seconds)
    for name in order:
        shortest = min(*wanted.values(), before)
        assert sys.getswitchinterval() == pytest.approx(shortest, abs=2e-6)
        leave_turns(name)
        leave_turns(name)
        wanted[name] = before
    assert sys.getswitchinterval() == pytest.approx(before, abs=2e-6)


def test_many_blocks_do_not_add_up() -> None:
    before = sys.getswitchinterval()
    for _ in range(1000):
        with short_turns(0.0003):
            assert sys.getswitchinterval() == pytest.approx(0.0003, abs=2e-6)
    assert sys.getswitchinterval() == pytest.approx(before, abs=2e-6)
