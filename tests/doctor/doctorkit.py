"""Helpers of the doctor's tests: a whole examination, and picking its findings."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING, Any

from smartcam.doctor import examine
from smartcam.doctor._inside import Finding
from tests.doctor.inside import _state_checks
from tests.processes import PATIENCE

if TYPE_CHECKING:
    import pytest

    from tests.doctor.inside import Exit, Severity

STEP = 1.0
"""Seconds of a step that is not meant to run out."""

SHORT = 0.2
"""Seconds of one that is; all ways to speak to an address share it."""

WATCH = 0.05
"""Seconds that a camera is watched."""


def be_patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ask as often on a slow machine, without a remark on it."""
    monkeypatch.setattr(_state_checks, "QUERIES_WITHIN", PATIENCE)
    monkeypatch.setattr(_state_checks, "SLOW_ROUND_TRIP_TIME", PATIENCE)


async def examined(url: str, **options: Any) -> list[Finding]:
    """Return everything that an examination finds."""
    options = {"timeout": STEP, "seconds": WATCH, **options}
    async with aclosing(examine(url, **options)) as findings:
        return [finding async for finding in findings]


def of(findings: list[Finding], check: str) -> Finding:
    """Return the one finding of a check."""
    (found,) = [finding for finding in findings if finding.check == check]
    return found


def errors(findings: list[Finding]) -> list[tuple[str, Exit]]:
    """Return the checks that found an error, with their exit codes."""
    return [(one.check, one.exit_code) for one in findings if one.severity == "error"]


def severities(findings: list[Finding], check: str) -> list[Severity]:
    """Return the severities of a check's findings."""
    return [one.severity for one in findings if one.check == check]
