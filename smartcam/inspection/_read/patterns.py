"""Regular expressions that hold nobody up: a text is compared in one pass, without going back.

Python's ``re`` tries one way through a pattern after the other, and keeps all threads waiting
meanwhile. ``(a|a)+b`` has as many ways as two to the power of the text's length.
"""

from __future__ import annotations

import re
from re import _compiler as compiler  # type: ignore[attr-defined]
from re import _constants as codes  # type: ignore[attr-defined]
from re import _parser as parser  # type: ignore[attr-defined]
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_STATES: Final = 10_000
"""States of a pattern, of which each character has one, as often as it may be repeated."""

MAX_STEPS: Final = 1_000_000
"""States that are looked at for one text, all of its characters together: about a second."""

_CHARACTERS: Final = (codes.LITERAL, codes.NOT_LITERAL, codes.ANY, codes.IN)


class PatternError(ValueError):
    """A pattern cannot be used."""


class TooLongError(Exception):
    """Comparing a text takes too long."""


class _Look(NamedTuple):
    """A condition on the text after a place, or before it.

    Attributes:
        first: first state of the text in question.
        back: number of characters before the place at which it begins.
        ends: whether it has to end at the place.
        wanted: whether it has to be there, or must not.
    """

    first: int
    back: int
    ends: bool
    wanted: bool


class _State(NamedTuple):
    """A place in a pattern.

    Attributes:
        condition: what the text has to be here; None: anything.
        consumes: whether it takes a character of the text.
        follows: states behind it; none behind an end.
    """

    condition: Callable[[str, int], object] | _Look | None
    consumes: bool
    follows: list[int]


class TextPattern:
    """A regular expression as :mod:`re` has them, without references to what a group has matched.

    Args:
        pattern: the expression.

    Raises:
        PatternError: the text is no regular expression, or one that is not compared here.
    """

    def __init__(self, pattern: str) -> None:
        self._states: list[_State] = []
        try:
            parsed = parser.parse(pattern)
            end = self._add(None)
            self._start = self._sequence(parsed, parsed.state.flags, end)
        except (re.error, RecursionError, OverflowError) as exc:
            raise PatternError(f"expected a regular expression, or the word input: {exc}") from exc

    def fits(self, text: str) -> bool:
        """Return True if the whole text is what the pattern says.

        Raises:
            TooLongError: the comparison takes too many steps.
        """
        return _Comparison(self._states, text).reaches_end(self._start, 0, len(text))

    # ------------------------------------------------------------------ making states

    def _add(
        self,
        condition: Callable[[str, int], object] | _Look | None,
        *follows: int,
        consumes: bool = False,
    ) -> int:
        if len(self._states) >= MAX_STATES:
            raise PatternError(
                f"expected a pattern of about {MAX_STATES} characters at most, each counted as "
                "often as it may be repeated"
            )
        self._states.append(_State(condition, consumes, [*follows]))
        return len(self._states) - 1

    def _sequence(self, items: Any, flags: int, end: int) -> int:
        """Return the first state of parts that follow each other, and lead to ``end``."""
        for code, argument in reversed(list(items)):
            end = self._part(code, argument, flags, end)
        return end

    def _part(self, code: Any, argument: Any, flags: int, end: int) -> int:
        if code in (*_CHARACTERS, codes.AT):
            state = parser.State()
            state.flags = flags
            one = compiler.compile(parser.SubPattern(state, [(code, argument)]), flags)
            return self._add(one.match, end, consumes=code is not codes.AT)
        if code is codes.SUBPATTERN:
            _, added, removed, inner = argument
            return self._sequence(inner, (flags | added) & ~removed, end)
        if code is codes.BRANCH:
            ways = [self._sequence(way, flags, end) for way in argument[1]]
            return self._add(None, *ways)
        if code in (codes.MAX_REPEAT, codes.MIN_REPEAT):
            return self._repeat(argument, flags, end)
        if code in (codes.ASSERT, codes.ASSERT_NOT):
            return self._look(argument, flags, end, wanted=code is codes.ASSERT)
        if code is codes.FAILURE:
            return self._add(lambda _text, _at: None, end)
        raise PatternError(
            "expected a pattern without references to groups, atomic groups and possessive "
            f"repetitions, got {str(code).lower()}"
        )

    def _repeat(self, argument: Any, flags: int, end: int) -> int:
        least, most, inner = argument
        if most is codes.MAXREPEAT:
            loop = self._add(None, end)
            self._states[loop].follows.append(self._sequence(inner, flags, loop))
            end = loop
        else:
            behind = end
            for _ in range(most - least):
                end = self._add(None, self._sequence(inner, flags, end), behind)
        for _ in range(least):
            end = self._add(None, self._sequence(inner, flags, end))
        return end

    def _look(self, argument: Any, flags: int, end: int, *, wanted: bool) -> int:
        way, inner = argument
        first = self._sequence(inner, flags, self._add(None))
        back, most = inner.getwidth() if way < 0 else (0, 0)
        if back != most:
            raise PatternError("expected a regular expression: a look behind has no fixed width")
        return self._add(_Look(first, back, way < 0, wanted), end)


class _Comparison:
    """One text that is compared with a pattern.

    Args:
        states: states of the pattern.
        text: the text.
    """

    def __init__(self, states: list[_State], text: str) -> None:
        self._states, self._text, self._steps = states, text, 0

    def reaches_end(self, first: int, at: int, stop: int | None) -> bool:
        """Return True if an end follows a state.

        Args:
            first: the state.
            at: place in the text at which it is.
            stop: place at which the end has to be; None: anywhere.
        """
        waiting = {first}
        while waiting:
            todo, behind = [*waiting], set[int]()
            while todo:
                condition, consumes, follows = self._states[todo.pop()]
                self._steps += 1
                if self._steps > MAX_STEPS:
                    raise TooLongError
                if not follows and (stop is None or at == stop):
                    return True
                if (consumes and at == len(self._text)) or not self._holds(condition, at):
                    continue
                if consumes:
                    behind.update(follows)
                else:
                    new = set(follows) - waiting
                    waiting |= new
                    todo += new
            waiting, at = behind, at + 1
        return False

    def _holds(self, condition: Callable[[str, int], object] | _Look | None, at: int) -> bool:
        if not isinstance(condition, _Look):
            return condition is None or condition(self._text, at) is not None
        start = at - condition.back
        stop = at if condition.ends else None
        there = start >= 0 and self.reaches_end(condition.first, start, stop)
        return there is condition.wanted
