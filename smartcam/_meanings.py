"""Decide from the name of a truth value which of its values is good."""

from __future__ import annotations

import re

PASS_WORDS = frozenset({"ok", "pass", "passed", "good", "valid", "accept", "accepted", "io"})
FAIL_WORDS = frozenset(
    {"nok", "fail", "failed", "bad", "defect", "reject", "rejected", "error", "nio"}
)
NOT_WORDS = frozenset({"not", "no"})


def good_value_of(name: str) -> bool | None:
    """Return the good value of a truth field, judged by its name; None if the name is unclear.

    ``ok`` is good when true, ``defect`` and ``not_ok`` when false. ``present`` may be either.
    """
    words = set(re.findall(r"[a-z]+", name.lower()))
    groups_found = bool(words & PASS_WORDS) + bool(words & FAIL_WORDS)
    return None if groups_found != 1 else bool(words & PASS_WORDS) is not bool(words & NOT_WORDS)
