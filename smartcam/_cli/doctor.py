"""``smartcam doctor``: find out what is wrong with a camera, and name the cure."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import CAMERA_OPTIONS, CONNECT_WARNING, Options, async_command, option
from smartcam._cli.probe import frame_text
from smartcam._cli.terminal import coloured
from smartcam._cli.texts import table_text

if TYPE_CHECKING:
    from smartcam.doctor._inside import Finding

MAX_INVALID_FRAMES = 4
"""Largest number of invalid frames below a finding."""


@click.command(
    help="Report each problem with its cure, in plain words: name, session, status, application, "
    "round trip, run state, results, clock. Changes nothing on the camera and triggers nothing, "
    f"unless --trigger is given. Exit code: that of the worst finding. {CONNECT_WARNING}"
)
@click.argument("url")
@click.option(
    "--trigger",
    is_flag=True,
    help="Send triggers; load and start --application for them, and go back afterwards.",
)
@option(
    "--application",
    help="The application that should be active; only compared, unless --trigger is given.",
)
@option("--interpret-as", help="Compare results with this layout or interpreter.")
@option("--y-down")
@option("--count", type=click.IntRange(1, 10_000), help="How many triggers; 10 by default.")
@option("--seconds", help="Seconds to watch for unasked results; 3 by default.")
@async_command(*CAMERA_OPTIONS)
async def doctor(url: str, trigger: bool, options: Options) -> None:
    """Print each finding as soon as it is known; end with the exit code of the worst."""
    from smartcam.doctor import examine
    from smartcam.doctor._inside import summary

    findings: list[Finding] = []
    with options.open_trace(url) as trace:
        examination = examine(
            url,
            application=options.application,
            interpret_as=options.interpret_as,
            y_down=options.y_down,
            trigger=trigger,
            timeout=options.timeout,
            seconds=options.seconds or 3.0,
            count=options.count or 10,
            trace=trace,
        )
        async with aclosing(examination):
            async for finding in examination:
                findings.append(finding)
                options.show(finding, _finding_text)
    verdict = summary(findings)
    options.show(verdict, f"{verdict.text[0].upper()}{verdict.text[1:]}.")
    if verdict.exit_code:
        raise SystemExit(int(verdict.exit_code))


def _finding_text(finding: Finding) -> str:
    severity = coloured(finding.severity, f"{finding.severity:<8}")
    lines = [f"{severity} {finding.check}: {finding.text}"]
    lines += [f"         {line}" for line in _invalid_frames(finding)]
    if finding.cure:
        lines.append(f"         -> {finding.cure}")
    rows = finding.details.get("dump")
    if rows:
        table = table_text(("offset", "field", "bytes", "value"), rows)
        lines += [f"       {line}" for line in table.splitlines()]
    return "\n".join(lines)


def _invalid_frames(finding: Finding) -> list[str]:
    """Return the last invalid frames as text; their bytes help the camera's owner most."""
    frames = [entry for trial in finding.details.get("frames", ()) for entry in trial]
    invalid = {entry.hex: frame_text(entry) for entry in reversed(frames) if entry.direction == "!"}
    return list(invalid.values())[:MAX_INVALID_FRAMES]
