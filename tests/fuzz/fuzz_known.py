"""Findings that are known and not yet mended: fuzzing goes on past them.

A row is deleted with the mistake that it describes. Its input stands in the corpus under the row's
name and stays there; a test fails where a row is left though its input passes.
"""

from __future__ import annotations

import re
import traceback
from pathlib import Path
from typing import NamedTuple

__all__ = ["KNOWN", "Known", "describe", "known"]


class Known(NamedTuple):
    """One finding.

    Attributes:
        name: of its input, which begins the file's name in the corpus.
        target: where it was found.
        pattern: regular expression for what :func:`describe` says of it.
        about: what is wrong.
    """

    name: str
    target: str
    pattern: str
    about: str


KNOWN = (
    Known(
        "unknown-key-is-a-surrogate",
        "scenario",
        r"UnicodeEncodeError: .*surrogates not allowed in main\.py:model_validate",
        "an error's text has a lone surrogate in it, which pydantic cannot take",
    ),
    Known(
        "memory-for-slots",
        "scenario",
        r"AssertionError: too much memory",
        "slots are filled with zeros before the container's size is looked at",
    ),
    Known(
        "memory-for-an-errors-text",
        "scenario",
        r"AssertionError: too much memory",
        "a wrong value is written out in full before 64 characters of it are taken",
    ),
    Known(
        "canonical-text-too-long",
        "layout",
        r"LayoutError: layout: expected at most 20000 characters",
        "a text that is accepted prints as one that is not: no copy, no pickle, no file",
    ),
)


def describe(error: BaseException) -> str:
    """Return what was raised and where, in one line."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    text = str(error).replace("\n", " ")
    return f"{type(error).__name__}: {text} in {Path(last.filename).name}:{last.name}"


def known(target: str, error: BaseException) -> Known | None:
    """Return the row that a finding belongs to, None for a new one."""
    said = describe(error)
    rows = (one for one in KNOWN if one.target == target)
    return next((one for one in rows if re.match(one.pattern, said)), None)
