"""Regular expressions that would take years to match."""

from __future__ import annotations

import re
from re import _constants as codes  # type: ignore[attr-defined]
from re import _parser as parser  # type: ignore[attr-defined]
from typing import Any


def nested_repetition(pattern: str) -> str | None:
    """Return the part of a pattern that repeats a repetition, both without an end; None: no part.

    A text that such a part nearly matches can be divided among the two in as many ways as two to
    the power of its length, and all of them are tried.
    """
    if not _is_nested(pattern):
        return None
    ends = (n for n, last in enumerate(pattern, 1) if last in "+*}")
    end = next((n for n in ends if _is_nested(pattern[:n])), len(pattern))
    starts = (n for n in reversed(range(end)) if pattern[n] == "(")  # what is repeated is a group
    start = next((n for n in starts if _is_nested(pattern[n:end])), 0)
    return pattern[start:end]


def _is_nested(pattern: str) -> bool:
    try:
        return _has(parser.parse(pattern), inside=False)
    except (re.error, RecursionError, OverflowError):
        return False


def _has(parsed: Any, *, inside: bool) -> bool:
    for code, argument in parsed:
        endless = code in (codes.MAX_REPEAT, codes.MIN_REPEAT) and argument[1] is codes.MAXREPEAT
        if (endless and inside) or any(_has(p, inside=inside or endless) for p in _parts(argument)):
            return True
    return False


def _parts(argument: Any) -> list[Any]:
    if isinstance(argument, parser.SubPattern):
        return [argument]
    if isinstance(argument, (tuple, list)):
        return [part for one in argument for part in _parts(one)]
    return []
