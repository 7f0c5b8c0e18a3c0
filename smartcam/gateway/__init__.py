"""Serve robots and PLCs over TCP: a controller asks for a part and gets its pose, or an error.

A :class:`Gateway` serves one camera on a port. A controller sends ``TRIGGER`` or ``NEXT``; the
gateway answers each request once, within a deadline. :class:`GatewaySettings` set the form of the
answers, which differs between makes of robots. The command is ``smartcam gateway``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.gateway._gateway import Gateway
    from smartcam.gateway._settings import GatewaySettings

__all__ = ["Gateway", "GatewaySettings"]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_gateway": "Gateway",
            "_settings": "GatewaySettings",
        },
    )
