"""Pages and HTTP calls: emulators, cameras, fleets, wizards, frames, colours, clouds, programs.

::

    async with EmulatedCamera() as emulator, EmulatorSite({"camera": emulator}) as site:
        site.url    # http://127.0.0.1:PORT/

It needs the extra ``web``; without it the first use of a name is a
:class:`~smartcam.MissingExtraError`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._extras import missing_extra_error
from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.web._clouds import CloudSite
    from smartcam.web._colours import ColourSite
    from smartcam.web._emulator import EmulatorSite
    from smartcam.web._fleet import FleetSite
    from smartcam.web._frames import FramesSite
    from smartcam.web._live import LiveSite
    from smartcam.web._operations import OperationsSite
    from smartcam.web._wizard import WizardSite

__all__ = [
    "CloudSite",
    "ColourSite",
    "EmulatorSite",
    "FleetSite",
    "FramesSite",
    "LiveSite",
    "OperationsSite",
    "WizardSite",
]

_resolve = lazy(
    __name__,
    {
        "_clouds": "CloudSite",
        "_colours": "ColourSite",
        "_emulator": "EmulatorSite",
        "_fleet": "FleetSite",
        "_frames": "FramesSite",
        "_live": "LiveSite",
        "_operations": "OperationsSite",
        "_wizard": "WizardSite",
    },
)


def __getattr__(name: str) -> Any:
    try:
        return _resolve(name)
    except ModuleNotFoundError as exc:
        if exc.name != "aiohttp":
            raise
        raise missing_extra_error("aiohttp") from exc
