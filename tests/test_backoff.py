"""Delays between tries to reach a camera again, and which errors are worth another try."""

from __future__ import annotations

import dataclasses
import itertools
import math
import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam import (
    Backoff,
    CommandRejectedError,
    ConfigurationError,
    ConnectFailedError,
    ConnectionLostError,
    FrameError,
    LayoutError,
    PluginError,
    ResponseTimeoutError,
)
from smartcam.backoff import is_transient

EXACT = Backoff(initial=1.0, factor=2.0, maximum=10.0, jitter=0.0)


def first(count: int, backoff: Backoff, **options: Any) -> list[float]:
    return list(itertools.islice(backoff.delays(**options), count))


def test_delays_grow_to_the_maximum_and_stay_there() -> None:
    assert first(6, EXACT) == [1.0, 2.0, 4.0, 8.0, 10.0, 10.0]


def test_delays_by_default_begin_at_a_tenth_of_a_second_and_never_end() -> None:
    delays = first(1000, dataclasses.replace(Backoff(), jitter=0.0))
    assert delays[:3] == [0.1, 0.2, 0.4]
    assert delays[-1] == 10.0


@pytest.mark.parametrize("attempts", [1, 2, 7])
def test_delays_end_after_the_attempts(attempts: int) -> None:
    backoff = dataclasses.replace(EXACT, attempts=attempts)
    assert len(list(backoff.delays())) == attempts


def test_delays_with_factor_one_are_all_the_same() -> None:
    assert first(4, Backoff(initial=0.5, factor=1, jitter=0)) == [0.5] * 4


def test_delays_of_nothing_are_nothing() -> None:
    assert first(4, Backoff(initial=0.0)) == [0.0] * 4


def test_delays_with_a_factor_without_bounds_stay_finite() -> None:
    assert first(3, Backoff(initial=1.0, factor=1e308, jitter=0)) == [1.0, 10.0, 10.0]


def test_delays_after_short_lived_sessions_begin_later() -> None:
    assert first(3, EXACT, short_lived=2) == [4.0, 8.0, 10.0]
    assert first(2, EXACT, short_lived=100) == [10.0, 10.0]


def test_short_lived_sessions_do_not_cost_attempts() -> None:
    backoff = dataclasses.replace(EXACT, attempts=3)
    assert list(backoff.delays(short_lived=5)) == [10.0] * 3


def test_delays_of_the_same_seed_are_the_same_and_others_differ() -> None:
    backoff = Backoff()
    delays = [first(5, backoff, chance=random.Random(seed)) for seed in (1, 1, 2)]  # noqa: S311
    assert delays[0] == delays[1]
    assert delays[0] != delays[2]


def test_delays_without_a_seed_differ_between_clients() -> None:
    backoff = Backoff()
    assert len({tuple(first(3, backoff)) for _ in range(5)}) == 5


def test_delays_may_be_asked_for_again() -> None:
    backoff = dataclasses.replace(EXACT, attempts=2)
    assert list(backoff.delays()) == list(backoff.delays()) == [1.0, 2.0]


@given(
    initial=st.floats(0, 100),
    above=st.floats(0, 1e6),
    factor=st.floats(1, 1e300),
    jitter=st.floats(0, 1),
    short_lived=st.integers(0, 50),
    seed=st.integers(0, 1000),
)
def test_delays_lie_between_their_share_without_chance_and_the_whole(
    initial: float, above: float, factor: float, jitter: float, short_lived: int, seed: int
) -> None:
    backoff = Backoff(
        initial=initial, factor=factor, maximum=initial + above, jitter=jitter, attempts=20
    )
    whole = dataclasses.replace(backoff, jitter=0.0)
    chance = random.Random(seed)  # noqa: S311
    pairs = zip(
        backoff.delays(short_lived=short_lived, chance=chance),
        whole.delays(short_lived=short_lived),
        strict=True,
    )
    before = 0.0
    for delay, longest in pairs:
        assert longest * (1 - jitter) <= delay <= longest
        assert before <= longest <= initial + above
        before = longest


WRONG: dict[str, dict[str, Any]] = {
    "initial": {"initial": -0.1},
    "factor": {"factor": 0.5},
    "maximum": {"initial": 2.0, "maximum": 1.0},
    "jitter": {"jitter": 1.1},
    "attempts": {"attempts": 0},
}


@pytest.mark.parametrize(("name", "options"), WRONG.items())
def test_value_that_cannot_work_is_named_and_shown(name: str, options: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError, match=rf"Backoff: {name}: expected ") as caught:
        Backoff(**options)
    assert str(caught.value).count("expected") == 1


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["initial", "factor", "maximum", "jitter"])
def test_value_that_is_no_number_is_refused(name: str, value: float) -> None:
    with pytest.raises(ConfigurationError, match=f"{name}: "):
        Backoff(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("error", "transient"),
    [
        (ConnectFailedError("nobody", host="h", port=1), True),
        (ConnectionLostError("lost", host="h", port=1), True),
        (ResponseTimeoutError("silence"), True),
        (FrameError("garbage"), True),
        (ConnectionRefusedError(), True),
        (TimeoutError(), True),
        (ConfigurationError("wrong"), False),
        (LayoutError("wrong"), False),
        (PluginError("broken"), False),
        (KeyError("bug"), False),
    ],
    ids=lambda value: type(value).__name__,
)
def test_error_is_transient_if_another_try_may_help(error: BaseException, transient: bool) -> None:
    assert is_transient(error) is transient
    assert Backoff().transient(error) is transient


def test_backoff_is_a_value() -> None:
    assert Backoff() == Backoff()
    assert hash(Backoff()) == hash(Backoff())
    with pytest.raises(dataclasses.FrozenInstanceError):
        Backoff().initial = 1.0  # type: ignore[misc]


def test_session_that_was_refused_is_not_transient() -> None:
    error = ConnectFailedError("no session", host="h", port=1)
    error.__cause__ = CommandRejectedError("the password is wrong", code=-6)
    assert not is_transient(error)
