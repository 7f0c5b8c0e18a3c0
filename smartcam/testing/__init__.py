"""Tools for tests of a client, a camera or a plug-in; only tests import them.

::

    with ThreadedCamera() as emulator, smartcam.sync.connect(emulator.url) as camera:
        ...

:mod:`smartcam.testing.proxy` has a link whose bytes get lost, late or changed.

Names are resolved when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.testing._suites.interpreters import ContainerSample, InterpreterSuite
    from smartcam.testing._suites.protocols.cameras_under_test import (
        CameraKind,
        LiveCamera,
    )
    from smartcam.testing._suites.protocols.conversations import Conversation, Received, Sent
    from smartcam.testing._suites.protocols.suite import CameraSuite, ProtocolSuite, WireSuite
    from smartcam.testing._threads import ThreadedCamera, ThreadedFleet

__all__ = [
    "CameraKind",
    "CameraSuite",
    "ContainerSample",
    "Conversation",
    "InterpreterSuite",
    "LiveCamera",
    "ProtocolSuite",
    "Received",
    "Sent",
    "ThreadedCamera",
    "ThreadedFleet",
    "WireSuite",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_suites.interpreters": "ContainerSample InterpreterSuite",
            "_suites.protocols.cameras_under_test": "CameraKind LiveCamera",
            "_suites.protocols.conversations": "Received Conversation Sent",
            "_suites.protocols.suite": "CameraSuite ProtocolSuite WireSuite",
            "_threads": "ThreadedCamera ThreadedFleet",
        },
    )
