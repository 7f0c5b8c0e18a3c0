"""Rules: what is refused when they are made, and which datagrams they pick."""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING, Any

import pytest

from smartcam import ConfigurationError
from smartcam.testing import LinkProxy
from smartcam.testing.proxy.rules import (
    MAX_COPY,
    MAX_HOLD,
    Coalesce,
    Cut,
    Delay,
    Drip,
    Duplicate,
    Flip,
    Insert,
    Late,
    Lose,
    Rate,
    Reorder,
    Repeat,
    Split,
)

if TYPE_CHECKING:
    from collections.abc import Callable

WRONG: list[tuple[Callable[[], object], str]] = [
    (lambda: Cut(at=-1), "at must be 0 or more bytes"),
    (lambda: Cut(connection=0), "connections count from 1"),
    (lambda: Cut(direction="left"), "direction must be 'up' or 'down'"),  # type: ignore[arg-type]
    (lambda: Flip(at=-1), "at must be 0 or more bytes"),
    (lambda: Flip(count=0), "count must be 1 or more bytes"),
    (lambda: Flip(mask=0), "mask must be 1 to 255"),
    (lambda: Split(pause=-1), "pause must be 0 or more seconds"),
    (lambda: Drip(pause=-1), "pause must be 0 or more seconds"),
    (lambda: Coalesce(size=MAX_HOLD + 1), "size must be 1 to 65536 bytes"),
    (lambda: Coalesce(size=1, seconds=0), "seconds must be more than 0"),
    (lambda: Insert(data=b""), "data must be 1 to 1048576 bytes"),
    (lambda: Duplicate(count=MAX_COPY + 1), "count must be at most 1048576 bytes"),
    (lambda: Duplicate(count=None), "count must be at most 1048576 bytes"),
    (lambda: Delay(seconds=-1), "times must be 0 or more seconds"),
    (lambda: Delay(seconds=1, jitter=-1), "times must be 0 or more seconds"),
    (lambda: Rate(bytes_per_second=0), "the rate must be more than 0"),
    (lambda: Lose(number=0), "datagrams count from 1"),
    (lambda: Lose(probability=1.5), "probability must be 0 to 1"),
    (lambda: Repeat(copies=0), "copies must be 1 to 100"),
    (lambda: Late(seconds=-1), "times must be 0 or more seconds"),
    (lambda: Reorder(behind=0), "behind must be 1 or more datagrams"),
    (lambda: Reorder(seconds=0), "seconds must be more than 0"),
    (lambda: LinkProxy("h", 1, rules=[Lose()]), "it means nothing on TCP"),
    (lambda: LinkProxy("h", 1, transport="udp", rules=[Cut()]), "it means nothing on UDP"),
]


@pytest.mark.parametrize(("make", "text"), WRONG)
def test_wrong_argument_is_refused(make: Callable[[], Any], text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        make()
    assert text in str(caught.value)


def test_wrong_transport_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="transport is 'tcp' or 'udp', not 'can'"):
        LinkProxy("h", 1, transport="can")  # type: ignore[arg-type]


def test_rule_concerns_its_direction_and_connection() -> None:
    assert [Cut().concerns(n, "down") for n in (1, 2)] == [True, True]
    assert [Cut(connection=2).concerns(n, "down") for n in (1, 2)] == [False, True]
    assert not Cut().concerns(1, "up")


def chance(seed: int) -> Random:
    return Random(seed)  # noqa: S311 - no secret


def test_number_picks_one_datagram() -> None:
    assert [n for n in range(1, 6) if Lose(number=3).picks(n, chance(0))] == [3]


def test_probability_picks_the_same_again_with_the_same_seed() -> None:
    rule = Lose(probability=0.3)
    first, second = ([rule.picks(n, one) for n in range(1000)] for one in (chance(5), chance(5)))
    assert first == second
    assert 200 < sum(first) < 400
