"""Suggest a known word in place of an unknown one."""

from __future__ import annotations

import difflib
import itertools
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from pydantic_core import ErrorDetails


MAX_WORD_CHARACTERS = 100
"""Largest number of characters of a word that is compared with others: comparing two words takes
as many steps as the product of their lengths."""

MAX_KNOWN_WORDS = 10_000
"""Largest number of known words that are compared; a file or a camera may name many more."""

MAX_PARTS = 8
"""Largest number of parts of a word that are compared separately; the rest of the word counts as
unexplained."""

MAX_CANDIDATES = 20
"""Largest number of known words with similar letters whose edits are counted."""

LETTERS_PER_EDIT = 3
"""Number of letters for each edit that is allowed: one edit in three letters, two in six."""

MIN_PREFIX_LETTERS = 3
"""Least number of letters of a part that may abbreviate a longer part, as ``int`` does."""

MIN_EXPLAINED_SHARE = 0.6
"""Share of a word's letters that the parts of a known word have to explain."""

WEIGHT_OF_PARTS = 0.9
"""Score of a known word that has all parts of a word; a known word one typo away scores higher."""

PREFIX_SCORE = 0.8
"""Score of a part that is the beginning of a known part; an equal part scores 1."""

MAX_NAMED_WORDS = 30
"""Largest number of known words that an error lists if none is close."""


def did_you_mean(word: str, known: Iterable[str], meant: Mapping[str, str] | None = None) -> str:
    """Return the end of an error text, with the known word that is closest; "" if none is close.

    ``meant``: known words by their other names, such as ``float`` for ``real32``.
    """
    meant_word = (meant or {}).get(word) or closest(word, known)
    return f"; did you mean {meant_word!r}?" if meant_word else ""


def closest(word: str, known: Iterable[str], *, least: float = 0.0) -> str | None:
    """Return the known word that was probably meant; None if none is close.

    ``least``: least score of a close word, up to 1.

    A known word is close if it is a few edits away, or if its parts explain the parts of the word:
    ``timeout`` is a part of ``connect_timeout``. Of several equally close words the first is
    returned. Words of more than :data:`MAX_WORD_CHARACTERS` are never close.
    """
    if len(word) > MAX_WORD_CHARACTERS:
        return None
    short_words = (candidate for candidate in known if len(candidate) <= MAX_WORD_CHARACTERS)
    words = dict.fromkeys(itertools.islice(short_words, MAX_KNOWN_WORDS))
    scores = _scores_by_parts(word, words)
    for candidate, score in _scores_by_edits(word, words).items():
        scores[candidate] = max(score, scores.get(candidate, 0.0))
    close = (likely for likely in words if scores.get(likely, -1.0) >= least)
    return max(close, key=scores.__getitem__, default=None)


def hint(item: ErrorDetails, known: Iterable[str]) -> str:
    """Return an end for pydantic's error text, with the field or word that was probably meant.

    It is "" if there is none. ``known``: names of the fields, for an error about an unknown field.
    """
    context = item.get("ctx", {})
    match item["type"]:
        case "extra_forbidden":
            names = list(dict.fromkeys(known))
            suggestion = did_you_mean(str(item["loc"][-1]), names)
            are_few = names and len(names) <= MAX_NAMED_WORDS
            return suggestion or (f"; known are {', '.join(sorted(names))}" if are_few else "")
        case "union_tag_invalid":
            return did_you_mean(str(context["tag"]), _quoted(str(context["expected_tags"])))
        case "literal_error" | "enum":
            return did_you_mean(str(item.get("input")), _quoted(str(context["expected"])))
    return ""


def _quoted(text: str) -> list[str]:
    """Return the words that stand between quotes."""
    return re.findall(r"'([^']*)'", text)


# ---------------------------------------------------------------------- scores


def _scores_by_edits(word: str, known: Iterable[str]) -> dict[str, float]:
    """Return the known words that are a few edits away, with their scores."""
    by_fold: dict[str, str] = {}
    for candidate in known:
        by_fold.setdefault(candidate.lower(), candidate)
    folded, scores = word.lower(), {}
    for match in difflib.get_close_matches(folded, by_fold, n=MAX_CANDIDATES):
        score = _likeness(folded, match)
        if score:
            scores[by_fold[match]] = score
    return scores


def _scores_by_parts(word: str, known: Iterable[str]) -> dict[str, float]:
    """Return the known words whose parts explain a word's parts, with their scores."""
    parts = _parts(word)
    known_parts = {candidate: _parts(candidate)[:MAX_PARTS] for candidate in known}
    all_parts = dict.fromkeys(itertools.chain.from_iterable(known_parts.values()))
    lengths_and_scores = [(len(part), _parts_near(part, all_parts)) for part in parts[:MAX_PARTS]]
    letters = sum(map(len, parts)) or 1
    scores = {}
    for candidate, candidate_parts in known_parts.items():
        explained = sum(
            n * max((like.get(p, 0.0) for p in candidate_parts), default=0.0)
            for n, like in lengths_and_scores
        )
        if explained >= MIN_EXPLAINED_SHARE * letters:
            scores[candidate] = WEIGHT_OF_PARTS * explained / letters
    return scores


def _parts(word: str) -> list[str]:
    """Return the parts of a word in lower case: ``maxQueue_bytes`` has three."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", word)
    return [part.lower() for part in re.split(r"[\W_]+", spaced) if part]


def _parts_near(part: str, all_parts: Iterable[str]) -> dict[str, float]:
    """Return the parts that equal a part, begin with it or are a few edits away, with scores."""
    scores = {
        match: _likeness(part, match) for match in difflib.get_close_matches(part, all_parts, n=10)
    }
    if len(part) >= MIN_PREFIX_LETTERS:
        longer_parts = (candidate for candidate in all_parts if candidate.startswith(part))
        scores |= {
            candidate: max(PREFIX_SCORE, scores.get(candidate, 0.0)) for candidate in longer_parts
        }
    return scores


def _likeness(one: str, other: str) -> float:
    """Return 1 for equal words, less for each edit between them, 0 for too many edits."""
    edits, longest = _edits(one, other), max(len(one), len(other))
    return 0.0 if edits * LETTERS_PER_EDIT > longest else 1.0 - edits / longest


def _edits(one: str, other: str) -> int:
    """Return the number of letters to insert, remove, change or swap to make two words equal."""
    last_row: list[int] = []
    row: list[int] = [*range(len(other) + 1)]
    for i, letter in enumerate(one, 1):
        second_last_row, last_row, row = last_row, row, [i]
        for j, other_letter in enumerate(other, 1):
            cost = min(row[-1] + 1, last_row[j] + 1, last_row[j - 1] + (letter != other_letter))
            if i > 1 < j and (letter, one[i - 2]) == (other[j - 2], other_letter):
                cost = min(cost, second_last_row[j - 2] + 1)
            row.append(cost)
    return row[-1]
