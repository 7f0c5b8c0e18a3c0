"""``smartcam doctor``: what is wrong with a camera, in plain words and with the cure."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING

from smartcam.cli.options import camera_url
from smartcam.cli.probe import frame_text
from smartcam.cli.texts import table_text
from smartcam.doctor import Finding, examine, summary

if TYPE_CHECKING:
    from smartcam.cli.options import Options

__all__ = ["doctor"]

MAX_BROKEN = 4
"""Lines of broken bytes below a finding."""


async def doctor(url: str, options: Options, *, trigger: bool) -> int:
    """Print what an examination finds, as it finds it, and return the exit code.

    Args:
        url: the camera's.
        options: the shared ones.
        trigger: triggers may be sent.

    Raises:
        ConfigurationError: an option cannot work.
    """
    findings: list[Finding] = []
    with options.tracing() as trace:
        examination = examine(
            camera_url(url),
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
                options.show(finding, _text)
    end = summary(findings)
    options.show(end, f"{end.text[0].upper()}{end.text[1:]}.")
    return int(end.exit_code)


def _text(finding: Finding) -> str:
    lines = [f"{finding.severity:<8} {finding.check}: {finding.text}"]
    lines += [f"         {line}" for line in _broken(finding)]
    if finding.cure:
        lines.append(f"         -> {finding.cure}")
    rows = finding.details.get("dump")
    if rows:
        table = table_text(("offset", "field", "bytes", "value"), rows)
        lines += [f"       {line}" for line in table.splitlines()]
    return "\n".join(lines)


def _broken(finding: Finding) -> list[str]:
    """Return the broken bytes that came, which tell an owner more than words."""
    frames = [entry for trial in finding.details.get("frames", ()) for entry in trial]
    broken = {entry.hex: frame_text(entry) for entry in reversed(frames) if entry.direction == "!"}
    return list(broken.values())[:MAX_BROKEN]
