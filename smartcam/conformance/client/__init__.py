"""Judging clients: an emulated camera has them do tasks, makes trouble, and looks at what they say.

In a test file of whoever wrote the client::

    from smartcam.conformance.client import ClientConformance

    class TestMyDriver(ClientConformance):
        command = "./mydriver {host} {port} {task}"

or without one::

    pytest --pyargs smartcam.conformance.client --client-command "./mydriver {host} {port} {task}"

What is judged stands in :data:`CHECKS`: a scene (a camera and a task), a rule, and the source of
what the camera expects. Names are resolved when they are first used: importing this is light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from smartcam.conformance.client.checks import CHECKS, Check, Grade
    from smartcam.conformance.client.pytest_options import add_options, terminal_summary
    from smartcam.conformance.client.report import ClientFinding, judge
    from smartcam.conformance.client.runs import Run, perform
    from smartcam.conformance.client.scenes import SCENES, Scene
    from smartcam.conformance.client.suite import ClientConformance
    from smartcam.conformance.client.tasks import (
        Client,
        CommandClient,
        FunctionClient,
        Outcome,
        Task,
    )

__all__ = [
    "CHECKS",
    "SCENES",
    "Check",
    "Client",
    "ClientConformance",
    "ClientFinding",
    "CommandClient",
    "FunctionClient",
    "Grade",
    "Outcome",
    "Run",
    "Scene",
    "Task",
    "add_options",
    "judge",
    "perform",
    "terminal_summary",
]

_HOMES = {
    "CHECKS": "checks",
    "SCENES": "scenes",
    "Check": "checks",
    "Client": "tasks",
    "ClientConformance": "suite",
    "ClientFinding": "report",
    "CommandClient": "tasks",
    "FunctionClient": "tasks",
    "Grade": "checks",
    "Outcome": "tasks",
    "Run": "runs",
    "Scene": "scenes",
    "Task": "tasks",
    "add_options": "pytest_options",
    "judge": "report",
    "perform": "runs",
    "terminal_summary": "pytest_options",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: Any = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
