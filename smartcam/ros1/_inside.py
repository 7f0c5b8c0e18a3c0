"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.ros1._fleet import RosbridgeFleet, bridged
    from smartcam.ros1._link import checked_url

__all__ = [
    "RosbridgeFleet",
    "bridged",
    "checked_url",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_fleet": "RosbridgeFleet bridged",
            "_link": "checked_url",
        },
    )
