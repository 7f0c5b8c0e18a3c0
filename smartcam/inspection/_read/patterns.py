"""Match texts with regular expressions of users, within a time limit."""

from __future__ import annotations

from typing import Final

from smartcam._extras import load

MAX_MATCH_SECONDS: Final = 0.5
"""Longest time to match a text, seconds. A pattern such as ``(a|a)+b`` may need a time that grows
exponentially with the text's length."""

MAX_PATTERN_CHARACTERS: Final = 4000
"""Largest length of a pattern, in characters, which bounds the time of compiling."""


class PatternError(ValueError):
    """Error in a pattern."""


class MatchTimeoutError(Exception):
    """Error for a match that takes too long."""


class TextPattern:
    """A regular expression of the package ``regex``, which extends :mod:`re`.

    Unlike ``re``, matching lets other threads run, and has a time limit.

    Args:
        pattern: the expression.

    Raises:
        PatternError: the text is no regular expression.
        MissingExtraError: ``regex`` is not installed.
    """

    def __init__(self, pattern: str) -> None:
        regex = load("regex")
        if len(pattern) > MAX_PATTERN_CHARACTERS:
            raise PatternError(
                f"expected a pattern of {MAX_PATTERN_CHARACTERS} characters at most, "
                f"got {len(pattern)}"
            )
        try:
            self._compiled = regex.compile(pattern)
        except (regex.error, RecursionError, OverflowError, MemoryError) as exc:
            raise PatternError(f"expected a regular expression, or 'input': {exc}") from exc

    def fits(self, text: str) -> bool:
        """Return True if the whole text matches the pattern.

        Raises:
            MatchTimeoutError: matching takes longer than :data:`MAX_MATCH_SECONDS`.
        """
        try:
            match = self._compiled.fullmatch(text, timeout=MAX_MATCH_SECONDS, concurrent=True)
        except (TimeoutError, MemoryError, RecursionError) as exc:
            raise MatchTimeoutError from exc
        return match is not None
