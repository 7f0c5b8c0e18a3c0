"""What was found of a client, for people: in a failed test, and at the end of a run."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.conformance.client.checks import Grade

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Self

    from smartcam.conformance.client.checks import Check
    from smartcam.conformance.client.runs import Run

__all__ = ["ClientFinding", "judge", "write_findings"]


class ClientFinding(NamedTuple):
    """What a client did against a rule.

    Attributes:
        check: name of the check.
        grade: ``must`` or ``should``.
        camera: dialect and transport.
        scene: what was special about the camera.
        task: what the client had to do.
        wrong: what was wrong.
        expects: what the documents make a client do.
        source: where that stands.
        wire: what went over the wire, one line each.
        said: what the client printed.
    """

    check: str
    grade: str
    camera: str
    scene: str
    task: str
    wrong: str
    expects: str
    source: str
    wire: tuple[str, ...]
    said: str

    def __str__(self) -> str:
        """Return it as lines."""
        lines = [
            f"{self.check} ({self.grade}; {self.camera}): {self.wrong}",
            f"  task: {self.task}; camera: {self.scene}",
            f"  expected: {self.expects}",
            f"  source: {self.source} (docs/sources.md)",
            "  on the wire (> from the client):",
            *(f"    {line}" for line in self.wire or ("nothing",)),
        ]
        if self.said:
            lines += ["  the client said:", *(f"    {line}" for line in self.said.splitlines())]
        return "\n".join(lines)

    def as_json(self) -> str:
        """Return it as one line of JSON."""
        return json.dumps(self._asdict())

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return what :meth:`as_json` wrote."""
        fields: dict[str, Any] = json.loads(text)
        return cls(**{**fields, "wire": tuple(fields["wire"])})


def judge(check: Check, run: Run) -> ClientFinding | None:
    """Return what a check finds in a run of its scene, None where all is well."""
    wrong = check.rule(run)
    if wrong is None:
        return None
    said = "; ".join(filter(None, (run.outcome.error, run.outcome.said)))
    return ClientFinding(
        check=check.name,
        grade=check.grade.value,
        camera=f"{run.dialect.label}, {run.task.transport}",
        scene=run.scene.about,
        task=str(run.task),
        wrong=wrong,
        expects=check.expects,
        source=check.source,
        wire=tuple(run.lines),
        said=said,
    )


def write_findings(reporter: Any, findings: Sequence[ClientFinding]) -> None:
    """Write findings into pytest's report.

    What must be is shown in full by its failed test, so here it is a line; what should be is shown
    in full.

    Args:
        reporter: pytest's ``terminalreporter``.
        findings: at least one.
    """
    reporter.section("smartcam: the client")
    for grade in Grade:
        some = [one for one in findings if one.grade == grade.value]
        if not some:
            continue
        reporter.write_line(f"{grade.value}: {len(some)}")
        for one in some:
            full = grade is Grade.SHOULD
            reporter.write_line(str(one) if full else f"{one.check} ({one.camera}): {one.wrong}")
