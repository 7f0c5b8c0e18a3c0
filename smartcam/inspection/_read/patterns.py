"""Regular expressions that hold nobody up, whatever the pattern and the text."""

from __future__ import annotations

from typing import Final

from smartcam._extras import load

MAX_MATCH_SECONDS: Final = 0.5
"""Longest time in which a text is compared, in seconds. A pattern such as ``(a|a)+b`` has as many
ways through a text as two to the power of its length."""

MAX_PATTERN_CHARACTERS: Final = 4000
"""Largest length of a pattern, in characters: compiling takes longer for a longer one."""


class PatternError(ValueError):
    """A pattern cannot be used."""


class TooLongError(Exception):
    """Comparing a text with a pattern takes too long."""


class TextPattern:
    """A regular expression of the package ``regex``: those of :mod:`re`, and some more.

    Unlike ``re``, it lets other threads run while it compares, and gives up in time.

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
            raise PatternError(f"expected a regular expression, or the word input: {exc}") from exc

    def fits(self, text: str) -> bool:
        """Return True if the whole text matches the pattern.

        Raises:
            TooLongError: comparing takes longer than :data:`MAX_MATCH_SECONDS`.
        """
        try:
            found = self._compiled.fullmatch(text, timeout=MAX_MATCH_SECONDS, concurrent=True)
        except (TimeoutError, MemoryError, RecursionError) as exc:
            raise TooLongError from exc
        return found is not None
