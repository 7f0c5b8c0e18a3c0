"""Helpers of the doctor's tests: run an examination, and pick findings."""

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
"""Timeout of a step that is not expected to time out, in seconds."""

SHORT = 0.2
"""Timeout of a step that is expected to time out; all ways to speak to an address share it."""

WATCH = 0.05
"""Seconds for which a camera is watched."""


def be_patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Allow a slow machine all requests, and no hint about slow requests."""
    monkeypatch.setattr(_state_checks, "MAX_QUERYING_SECONDS", PATIENCE)
    monkeypatch.setattr(_state_checks, "SLOW_ROUND_TRIP_TIME", PATIENCE)


async def examined(url: str, **options: Any) -> list[Finding]:
    """Return the findings of an examination."""
    options = {"timeout": STEP, "seconds": WATCH, **options}
    async with aclosing(examine(url, **options)) as findings:
        return [finding async for finding in findings]


def finding_of(findings: list[Finding], check: str) -> Finding:
    """Return the one finding of a check."""
    (found,) = [finding for finding in findings if finding.check == check]
    return found


def errors(findings: list[Finding]) -> list[tuple[str, Exit]]:
    """Return the checks that found an error, with their exit codes."""
    return [(one.check, one.exit_code) for one in findings if one.severity == "error"]


def severities(findings: list[Finding], check: str) -> list[Severity]:
    """Return the severities of a check's findings."""
    return [one.severity for one in findings if one.check == check]
