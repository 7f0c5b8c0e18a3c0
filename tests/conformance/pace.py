"""The pace of the judges' tests: on a machine that is too slow for them, slower.

A judge of cameras or clients measures real time, and so do those it judges: "nothing comes" is a
silence of so many seconds. All of these seconds are short first. Where a test fails then, they are
multiplied, and what it says of the slowest pace counts.
"""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

PACES = (1.0, 8.0, 50.0)

FAILURES = AssertionError, pytest.fail.Exception
"""Errors that a test fails with; the second one where something is not raised."""


class _Pace:
    times = PACES[0]


def slowed(seconds: float) -> float:
    """Return these seconds at the present pace."""
    return seconds * _Pace.times


def is_first() -> bool:
    """True if this is the fastest pace."""
    return _Pace.times == PACES[0]


def _paces() -> Iterator[float]:
    """Set one pace after the other, and the first one again at the end."""
    try:
        for _Pace.times in PACES:
            yield _Pace.times
    finally:
        _Pace.times = PACES[0]


def at_any_pace(test: Callable[..., Any]) -> Callable[..., Any]:
    """Run a test, and where it fails at a slower pace, too."""

    @functools.wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        for times in _paces():
            try:
                test(*args, **kwargs)
            except FAILURES:
                if times == PACES[-1]:
                    raise
            else:
                return

    @functools.wraps(test)
    async def run_async(*args: Any, **kwargs: Any) -> None:
        for times in _paces():
            try:
                await test(*args, **kwargs)
            except FAILURES:
                if times == PACES[-1]:
                    raise
            else:
                return

    return run_async if inspect.iscoroutinefunction(test) else run
