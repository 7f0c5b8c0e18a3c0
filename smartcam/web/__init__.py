"""Pages and HTTP calls: the emulator's, to see and control it while it runs, and the wizard's.

::

    async with EmulatedCamera() as emulator, EmulatorSite({"camera": emulator}) as site:
        site.url    # http://127.0.0.1:PORT/

It needs the extra ``web``; without it the first use of a name is a
:class:`~smartcam.exceptions.MissingExtraError`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import MissingExtraError

if TYPE_CHECKING:
    from smartcam.web.emulator import EmulatorSite
    from smartcam.web.wizard import WizardSite

__all__ = ["EmulatorSite", "WizardSite"]

_HOMES = {"EmulatorSite": "emulator", "WizardSite": "wizard"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'smartcam.web' has no attribute {name!r}")
    try:
        return getattr(importlib.import_module(f"smartcam.web.{_HOMES[name]}"), name)
    except ModuleNotFoundError as exc:
        if exc.name != "aiohttp":
            raise
        raise MissingExtraError(
            'the web page needs aiohttp: pip install "smartcam[web]"', extra="web"
        ) from exc
