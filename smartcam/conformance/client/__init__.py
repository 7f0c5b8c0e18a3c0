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

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.conformance.client._checks import CHECKS
    from smartcam.conformance.client._runs import perform
    from smartcam.conformance.client._scenes import SCENES, Scene
    from smartcam.conformance.client._suite import ClientConformance
    from smartcam.conformance.client._tasks import CommandClient, FunctionClient, Outcome, Task

__all__ = [
    "CHECKS",
    "SCENES",
    "ClientConformance",
    "CommandClient",
    "FunctionClient",
    "Outcome",
    "Scene",
    "Task",
    "perform",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_checks": "CHECKS",
            "_runs": "perform",
            "_scenes": "SCENES Scene",
            "_suite": "ClientConformance",
            "_tasks": "CommandClient FunctionClient Outcome Task",
        },
    )
