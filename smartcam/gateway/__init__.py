"""Lines to robots and PLCs: a controller asks for a part over TCP, and gets its pose or the reason.

:class:`Gateway` has a camera and listens; a controller sends ``TRIGGER`` and ``NEXT``, and each
request has one answer, within a deadline. :class:`GatewaySettings` say how an answer is written:
each make of robot has its own form. ``smartcam gateway`` is the command.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.gateway._gateway import Gateway
    from smartcam.gateway._settings import GatewayFile, GatewaySettings

__all__ = ["Gateway", "GatewayFile", "GatewaySettings"]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_gateway": "Gateway",
            "_settings": "GatewayFile GatewaySettings",
        },
    )
