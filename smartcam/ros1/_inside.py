"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.ros1._fleet import RosbridgeFleet, run_bridged_nodes
    from smartcam.ros1._link import checked_url

__all__ = [
    "RosbridgeFleet",
    "checked_url",
    "run_bridged_nodes",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_fleet": "RosbridgeFleet run_bridged_nodes",
            "_link": "checked_url",
        },
    )
