"""Command-line options for judging cameras and clients, and the findings about clients.

The module is light, since the pytest plugin imports it in every run of pytest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

FINDING_PROPERTY = "smartcam-client-finding"
"""Property of a test report that holds a finding; pytest-xdist passes it between processes."""

CAMERA_OPTIONS: Mapping[str, str] = {
    "--camera-url": (
        "the camera that smartcam.conformance.camera judges, such as bvs://192.168.0.10; "
        "the client that it serves now loses it"
    ),
    "--camera-application": (
        "id of the application that may be started and triggered (default: the active one)"
    ),
    "--camera-other-application": (
        "id of another application, which may be loaded for a moment (default: none is)"
    ),
    "--camera-allow": (
        "further changes of the camera that are allowed: clock, number, input, errors, reboot, "
        "all. run, trigger and switch are allowed and are undone; 'nothing' forbids them, too"
    ),
    "--camera-timeout": "seconds that an answer, a status or a result may take (default 5)",
    "--camera-silence": "seconds of silence that count as no answer (default 0.5)",
    "--camera-switch-timeout": "seconds that loading an application may take (default 30)",
    "--camera-reboot-timeout": "seconds that a restart may take (default 180)",
    "--camera-sequence-offset": (
        "offset of the sequence number (int32) in results, bytes after the application's id"
    ),
    "--camera-input": "input data that the application takes, as hex",
    "--camera-report": "file to write the report to, as JSON",
}
"""Help text of each option about a camera."""

CLIENT_OPTIONS: Mapping[str, str] = {
    "--client-command": (
        "The client to judge: a command with {task}, and {url} or {port}. It does the "
        "task and prints each result's bytes as hex or JSON, one line each; exit code 0: done, 77: "
        "it has no such task, anything else: failed."
    ),
    "--client-dialect": "What the client speaks, with commas between several; default handbook.",
    "--client-transport": "tcp, udp, or both with a comma between them; default tcp.",
    "--client-timeout": "Seconds that a task may take; default 30.",
}
"""Help text of each option about a client."""


def add_options(parser: Any) -> None:
    """Register the options with pytest's ``parser`` (``pytest_addoption``)."""
    for name, title, options in (
        ("smartcam", "smartcam: is it a BVS camera?", CAMERA_OPTIONS),
        ("smartcam-client", "smartcam: how good is a client?", CLIENT_OPTIONS),
    ):
        group = parser.getgroup(name, title)
        for option, text in options.items():
            metavar = option.rpartition("-")[2].upper()
            value_type = float if option == "--client-timeout" else str
            group.addoption(option, type=value_type, default=None, metavar=metavar, help=text)


def terminal_summary(reporter: Any) -> None:
    """Write the findings about clients into pytest's report, if there are any."""
    findings = [
        value
        for reports in reporter.stats.values()
        for report in reports
        if getattr(report, "when", None) == "call"
        for name, value in report.user_properties
        if name == FINDING_PROPERTY
    ]
    if findings:
        from smartcam.conformance.client._report import ClientFinding, write_findings

        write_findings(reporter, [ClientFinding.from_json(value) for value in findings])
