"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from smartcam.outlets._commands import do_command
from smartcam.outlets._outlets import OutletState, columns_of, stored_counts
from smartcam.outlets._settings import OutletsFile, mistakes_of
from smartcam.outlets._stored import StoreQuery, read_store

__all__ = [
    "OutletState",
    "OutletsFile",
    "StoreQuery",
    "columns_of",
    "do_command",
    "mistakes_of",
    "read_store",
    "stored_counts",
]
