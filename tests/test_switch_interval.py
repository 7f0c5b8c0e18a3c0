"""Turns of Python's threads: the shortest that is wanted, and the one from before in the end."""

from __future__ import annotations

import itertools
import sys

import pytest

from smartcam._switch_interval import (
    restore_switch_interval,
    short_switch_interval,
    shorten_switch_interval,
)


@pytest.mark.parametrize("order", [*itertools.permutations(("half", "one", "slow"))])
def test_shortest_wanted_turn_holds_and_the_first_comes_back(order: tuple[str, ...]) -> None:
    before = sys.getswitchinterval()
    wanted = {"half": 0.0005, "one": 0.001, "slow": 1.0}
    for name, seconds in wanted.items():
        shorten_switch_interval(name, seconds)
    for name in order:
        shortest = min(*wanted.values(), before)
        assert sys.getswitchinterval() == pytest.approx(shortest, abs=2e-6)
        restore_switch_interval(name)
        restore_switch_interval(name)
        wanted[name] = before
    assert sys.getswitchinterval() == pytest.approx(before, abs=2e-6)


def test_many_blocks_do_not_add_up() -> None:
    before = sys.getswitchinterval()
    for _ in range(1000):
        with short_switch_interval(0.0003):
            assert sys.getswitchinterval() == pytest.approx(0.0003, abs=2e-6)
    assert sys.getswitchinterval() == pytest.approx(before, abs=2e-6)
