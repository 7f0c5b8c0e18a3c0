"""Judge clients: give them tasks with an emulated camera that misbehaves, and check their messages.

In a test file of the client's author::

    from smartcam.conformance.client import ClientConformance

    class TestMyDriver(ClientConformance):
        command = "./mydriver {host} {port} {task}"

or without one::

    pytest --pyargs smartcam.conformance.client --client-command "./mydriver {host} {port} {task}"

:data:`CHECKS` has all checks: each has a scene (a camera and a task), a rule and the rule's source.
Importing this is light, since names are resolved when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.conformance.client._checks import CHECKS
    from smartcam.conformance.client._suite import ClientConformance
    from smartcam.conformance.client._tasks import Task

__all__ = [
    "CHECKS",
    "ClientConformance",
    "Task",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_checks": "CHECKS",
            "_suite": "ClientConformance",
            "_tasks": "Task",
        },
    )
