"""The findings of an examination, their severities, and the exit code of the worst."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

Severity = Literal["ok", "hint", "warning", "error"]

SEVERITIES: tuple[Severity, ...] = ("ok", "hint", "warning", "error")
"""Severities from the best to the worst."""


class Exit(enum.IntEnum):
    """The exit codes that findings can have."""

    DONE = 0
    """No error: at most hints and warnings."""
    NO_SESSION = 3
    """There is no session, or it was lost."""
    TIMED_OUT = 4
    """A wait in a session timed out."""
    REFUSED = 5
    """The camera refused, is stopped, or has a System Error."""
    UNREADABLE = 6
    """A result is not interpretable."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One result of a check.

    Attributes:
        check: name of the check that made the finding.
        severity: ``ok``: as expected, or only information; ``hint``: something to know or to
            try; ``warning``: it works, but something is wrong; ``error``: it does not work.
        text: the finding, in plain words.
        cure: what to do about it; empty if nothing needs to be done.
        details: the finding as values for programs; times in seconds.
        exit_code: exit code of a command that ends with this finding; 0 for all but errors.
    """

    check: str
    severity: Severity
    text: str
    cure: str = ""
    details: Mapping[str, Any] = field(default_factory=dict[str, Any])
    exit_code: Exit = Exit.DONE


def summary(findings: Iterable[Finding]) -> Finding:
    """Return a summary of findings, a finding of ``check="summary"``.

    It has the severity and the exit code of the worst finding; of several equally bad findings the
    first counts, since checks begin with the basics, and later findings may follow from earlier
    ones.
    """
    all_found = list(findings)
    counts: dict[str, int] = {
        name: sum(finding.severity == name for finding in all_found) for name in SEVERITIES
    }
    ranks = [SEVERITIES.index(finding.severity) for finding in all_found]
    worst = all_found[ranks.index(max(ranks))] if all_found else None
    count_texts = [
        f"{count} {name}{'s' if count > 1 else ''}"
        for name, count in reversed(counts.items())
        if count and name != "ok"
    ]
    return Finding(
        check="summary",
        severity=worst.severity if worst is not None else "ok",
        text=", ".join(count_texts) or "nothing is wrong",
        details=counts,
        exit_code=worst.exit_code if worst is not None else Exit.DONE,
    )
