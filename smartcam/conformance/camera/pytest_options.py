"""The suite's options of the command line; the pytest plugin registers them, so this is light."""

from __future__ import annotations

from typing import Any

__all__ = ["OPTIONS", "add_options"]

OPTIONS: dict[str, str] = {
    "--camera-url": (
        "the camera that smartcam.conformance.camera judges, such as bvs://192.168.0.10; "
        "it is taken from whoever has it"
    ),
    "--camera-application": (
        "id of the application that may be started and triggered (default: the active one)"
    ),
    "--camera-other-application": (
        "id of another application, which may be loaded for a moment (default: none is)"
    ),
    "--camera-allow": (
        "what may be done to the camera beside run, trigger and switch, which are put back: "
        "clock, number, input, errors, reboot, all; 'nothing' takes the three away"
    ),
    "--camera-timeout": "seconds that an answer, a status or a result may take (default 5)",
    "--camera-quiet": "seconds of silence that count as no answer (default 0.5)",
    "--camera-switch-timeout": "seconds that loading an application may take (default 30)",
    "--camera-reboot-timeout": "seconds that a restart may take (default 180)",
    "--camera-sequence-offset": (
        "where in the application's results its sequence number (int32) stands, bytes "
        "behind the application's id"
    ),
    "--camera-input": "input data that the application takes, as hex",
    "--camera-report": "file to write the report to, as JSON",
}
"""Help text of each."""


def add_options(parser: Any) -> None:
    """Register :data:`OPTIONS` with pytest's ``parser`` (``pytest_addoption``)."""
    group = parser.getgroup("smartcam", "smartcam: is it a BVS camera?")
    for name, text in OPTIONS.items():
        metavar = name.rpartition("-")[2].upper()
        group.addoption(name, action="store", default=None, metavar=metavar, help=text)
