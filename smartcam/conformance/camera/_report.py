"""Report a judgement: for people, as YAML for a scenario, and as JSON."""

from __future__ import annotations

import json
import textwrap
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import smartcam
from smartcam.conformance.camera._results import CameraFinding, Check, CheckOutcome, Question
from smartcam.emulator import Quirks
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from smartcam.conformance.camera._session_under_test import CameraUnderTest

EQUAL_TIME_SHARE = 0.2
"""Relative difference up to which a measured time counts as equal to a quirk's default."""

EQUAL_TIME_SECONDS = 0.02
"""Difference in seconds up to which a measured time counts as equal to a quirk's default."""


class CameraReport:
    """All findings about one camera.

    Args:
        camera: the camera.

    Attributes:
        camera: the camera.
        findings: findings of each check and question, in order.
    """

    def __init__(self, camera: CameraUnderTest) -> None:
        self.findings: list[CameraFinding] = []
        self.camera: CameraUnderTest = camera

    def add(self, finding: CameraFinding) -> None:
        """Add a finding; it replaces an earlier finding of the same check or question."""
        self.findings = [older for older in self.findings if older.item.name != finding.item.name]
        self.findings.append(finding)

    # ------------------------------------------------------------------ contents

    @property
    def url(self) -> str:
        """The camera's address, with the dialect and quirks that were found."""
        return self.camera.address.url

    @property
    def differing(self) -> list[CameraFinding]:
        """The findings in which the camera differs from the documents."""
        return [finding for finding in self.findings if finding.failed]

    @property
    def quirks(self) -> dict[str, Any]:
        """The settings of the emulator that describe the camera, as far as they were observed."""
        return {
            finding.item.quirk: finding.value
            for finding in self.findings
            if isinstance(finding.item, Question)
            and finding.item.quirk is not None
            and finding.outcome is CheckOutcome.OBSERVED
        }

    def __getitem__(self, name: str) -> CameraFinding:
        """Return the finding of one check or question.

        Raises:
            KeyError: the check was not done.
        """
        for finding in self.findings:
            if finding.item.name == name:
                return finding
        raise KeyError(name)

    # ------------------------------------------------------------------ as text

    def text(self) -> str:
        """Return the report as text for people."""
        lines = [
            *self._summary_lines(),
            *self._difference_lines(),
            *self._answer_lines(),
            *self._unobserved_lines(),
        ]
        return "\n".join([*lines, "", *self.yaml().splitlines(), ""])

    def _summary_lines(self) -> list[str]:
        camera, state_before = self.camera, self.camera.state_before
        lines = [f"camera: {self.url}"]
        if state_before is not None:
            run = "in run mode" if state_before.running else "stopped"
            lines.append(f"at first: application {state_before.application}, {run}; restored")
        if camera.not_restored:
            lines[-1] = f"NOT RESTORED: {camera.not_restored}"
        if camera.gone_reason:
            lines.append(f"THE CAMERA IS GONE: {camera.gone_reason}")
        count = Counter(
            finding.outcome for finding in self.findings if isinstance(finding.item, Check)
        )
        lines.append(
            f"checks: {count[CheckOutcome.AS_DOCUMENTED]} as documented, "
            f"{count[CheckOutcome.DIFFERS]} not, {count[CheckOutcome.NOT_OBSERVED]} not observed"
        )
        if camera.measured_times:
            times = ", ".join(
                f"{name} {1000 * s:.1f} ms" for name, s in camera.measured_times.items()
            )
            lines.append(f"times: {times}")
        return lines

    def _difference_lines(self) -> list[str]:
        lines: list[str] = []
        for difference in self.differing:
            lines += [
                f"  {difference.item.name}: {difference.item.about}",
                f"    source:   {difference.source}, {difference.grade}",
                f"    expected: {difference.expected}",
                f"    observed: {difference.observed}",
                *(f"      {row}" for row in difference.wire),
            ]
        return ["", "differs from the documented device:", *lines] if lines else []

    def _answer_lines(self) -> list[str]:
        lines = [
            f"  {finding.item.name}: {_yaml_text(finding.value)}  "
            f"({finding.item.about}{_contradictions_text(finding)})"
            for finding in self.findings
            if finding.outcome is CheckOutcome.OBSERVED
        ]
        return ["", "open questions, answered:", *lines] if lines else []

    def _unobserved_lines(self) -> list[str]:
        reasons: dict[str, list[str]] = {}
        for finding in self.findings:
            if finding.outcome is CheckOutcome.NOT_OBSERVED:
                reasons.setdefault(finding.text, []).append(finding.item.name)
        lines: list[str] = []
        for reason, names in reasons.items():
            lines.append(f"  because {reason}:")
            lines += textwrap.wrap(
                ", ".join(names),
                96,
                initial_indent="    ",
                subsequent_indent="    ",
                break_on_hyphens=False,
            )
        return ["", "not observed:", *lines] if lines else []

    def yaml(self) -> str:
        """Return the quirks as a part of a scenario file; quirks without a value are comments."""
        lines: list[str] = []
        for finding in self.findings:
            item = finding.item
            if not isinstance(item, Question) or item.quirk is None:
                continue
            if finding.outcome is CheckOutcome.OBSERVED:
                note = "  # as in the emulator" if _is_default(item.quirk, finding.value) else ""
                lines.append(f"  {item.quirk}: {_yaml_text(finding.value)}{note}")
            elif finding.outcome is not CheckOutcome.NOT_APPLICABLE:
                comment = "no setting fits" if finding.failed else "not observed"
                lines.append(f"  # {item.quirk}: {comment}")
        if all(line.startswith("  #") for line in lines):
            return "\n".join(["quirks: {}", *lines])
        return "\n".join(["quirks:", *lines])

    # ------------------------------------------------------------------ as JSON

    def as_json(self) -> dict[str, Any]:
        """Return the report as values for JSON."""
        camera, state_before = self.camera, self.camera.state_before
        return {
            "smartcam": smartcam.__version__,
            "url": self.url,
            "transport": camera.transport,
            "dialect": camera.known_dialect or None,
            "before": None if state_before is None else state_before._asdict(),
            "not_restored": camera.not_restored or None,
            "gone": camera.gone_reason or None,
            "allowed": camera.options.allow.names,
            "measured_seconds": {name: round(s, 6) for name, s in camera.measured_times.items()},
            "quirks": self.quirks,
            "checks": [
                finding.as_json() for finding in self.findings if isinstance(finding.item, Check)
            ],
            "questions": [
                finding.as_json() for finding in self.findings if isinstance(finding.item, Question)
            ],
        }

    def write(self, path: str) -> None:
        """Write the report to a file as JSON.

        Raises:
            ConfigurationError: the file cannot be written.
        """
        try:
            Path(path).write_text(json.dumps(self.as_json(), indent=2) + "\n", encoding="utf-8")
        except OSError as exc:
            raise ConfigurationError(f"--camera-report {path}: {exc}") from exc


def _yaml_text(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _contradictions_text(finding: CameraFinding) -> str:
    contradictions = finding.item.contradictions
    return f"; {', '.join(contradictions)}" if contradictions else ""


def _is_default(quirk: str, value: object) -> bool:
    default = Quirks.model_fields[quirk].default
    if isinstance(default, float) and isinstance(value, float):
        return abs(value - default) <= max(EQUAL_TIME_SECONDS, EQUAL_TIME_SHARE * default)
    return bool(value == default)
