"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from smartcam.gateway._settings import GatewayFile

__all__ = ["GatewayFile"]
