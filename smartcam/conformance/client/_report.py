"""Report on a client: in a failed test, and at the end of a run."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.conformance.client._checks import Grade

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Self

    from smartcam.conformance.client._checks import ClientCheck
    from smartcam.conformance.client._runs import ClientRun


class ClientFinding(NamedTuple):
    """A breach of a rule by a client."""

    check: str
    grade: str  # ``must`` or ``should``
    camera: str  # dialect and transport
    scene: str  # special condition of the camera
    task: str  # task of the client
    wrong: str  # mistake of the client
    reason: str  # reason of the rule
    source: str  # source in the documents
    wire: tuple[str, ...]  # messages on the wire, one line each
    output: str  # output of the client

    def __str__(self) -> str:
        """Return the finding as lines."""
        lines = [
            f"{self.check} ({self.grade}; {self.camera}): {self.wrong}",
            f"  task: {self.task}; camera: {self.scene}",
            f"  because: {self.reason}",
            f"  source: {self.source} (docs/sources.md)",
            "  on the wire (> from the client):",
            *(f"    {line}" for line in self.wire or ("nothing",)),
        ]
        if self.output:
            lines += ["  the client said:", *(f"    {line}" for line in self.output.splitlines())]
        return "\n".join(lines)

    def as_json(self) -> str:
        """Return the finding as one line of JSON."""
        return json.dumps(self._asdict())

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Read a finding from the line of :meth:`as_json`."""
        fields: dict[str, Any] = json.loads(text)
        return cls(**{**fields, "wire": tuple(fields["wire"])})


def judge(check: ClientCheck, run: ClientRun) -> ClientFinding | None:
    """Judge a run of a check's scene; return the finding, None if the rule was followed."""
    wrong = check.rule(run)
    if wrong is None:
        return None
    output = "; ".join(filter(None, (run.outcome.error, run.outcome.output)))
    return ClientFinding(
        check=check.name,
        grade=check.grade.value,
        camera=f"{run.dialect.label}, {run.task.transport}",
        scene=run.scene.about,
        task=str(run.task),
        wrong=wrong,
        reason=check.reason,
        source=check.source,
        wire=tuple(run.lines),
        output=output,
    )


def write_findings(reporter: Any, findings: Sequence[ClientFinding]) -> None:
    """Write findings into pytest's report.

    A breach of ``must`` is shown in full by its failed test, so it is one line here; a breach of
    ``should`` is shown in full.
    """
    reporter.section("smartcam: the client")
    for grade in Grade:
        findings_of_grade = [finding for finding in findings if finding.grade == grade.value]
        if not findings_of_grade:
            continue
        reporter.write_line(f"{grade.value}: {len(findings_of_grade)}")
        for finding in findings_of_grade:
            summary = f"{finding.check} ({finding.camera}): {finding.wrong}"
            reporter.write_line(str(finding) if grade is Grade.SHOULD else summary)
