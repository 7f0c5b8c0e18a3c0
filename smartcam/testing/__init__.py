"""Tools for tests of a client, a camera or a plug-in; nothing but tests imports them.

::

    async with LinkProxy("127.0.0.1", emulator.port, rules=[Cut(at=20)]) as proxy:
        async with smartcam.connect(proxy.url(emulator.url)) as camera:
            ...

Names are resolved when they are first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from smartcam.testing.logs import CameraLog
    from smartcam.testing.proxy.proxy import LinkProxy
    from smartcam.testing.suites.interpreters import InterpreterSuite, Sample
    from smartcam.testing.suites.protocols import (
        Came,
        CameraSuite,
        Conversation,
        ProtocolSuite,
        Sent,
        Site,
        WireSuite,
        World,
    )
    from smartcam.testing.threads import ThreadedCamera, ThreadedFleet

__all__ = [
    "Came",
    "CameraLog",
    "CameraSuite",
    "Conversation",
    "InterpreterSuite",
    "LinkProxy",
    "ProtocolSuite",
    "Sample",
    "Sent",
    "Site",
    "ThreadedCamera",
    "ThreadedFleet",
    "WireSuite",
    "World",
]

_MODULES = {
    "CameraLog": "logs",
    "InterpreterSuite": "suites.interpreters",
    "LinkProxy": "proxy.proxy",
    "Sample": "suites.interpreters",
    "ThreadedCamera": "threads",
    "ThreadedFleet": "threads",
}
"""Where a name stands; what is not here stands in ``suites.protocols``."""


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{__name__}.{_MODULES.get(name, 'suites.protocols')}")
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
