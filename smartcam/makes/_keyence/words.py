"""Read the answers that Keyence's devices have in common: ``ER,<command>,nn``, ``OK,<command>``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import Mapping

LINE_END = b"\r"
ENCODING = "latin-1"
"""Encoding of lines: one byte for each character, since a barcode's content is not always text."""

MAX_LINE_BYTES = 8192
"""Largest number of bytes of a line: the longest two-dimensional codes have some 7,000
characters."""

READY = Status.RUNNING | Status.WAITING_FOR_TRIGGER


def error_code(line: str) -> int | None:
    """Return the number of ``ER,<command>,nn``; None for another line.

    Raises:
        ValueError: the line has no number.
    """
    word, _, code_text = line.partition(",")
    return int(code_text.rpartition(",")[2]) if word == "ER" else None


def result_code(line: str) -> int:
    """Return the result code of an answer: 0 unless it is an error."""
    return error_code(line) or 0


def answer_key(line: str, answer_words: Mapping[str, str]) -> str:
    """Return the key of an answer: the command that the line names, else the line's first word.

    Args:
        line: the answer.
        answer_words: words of answers, by command, that differ from the command.
    """
    first, _, argument = line.partition(",")
    word = argument.partition(",")[0] if first in {"OK", "ER"} and argument else first
    return answer_words.get(word, word)
