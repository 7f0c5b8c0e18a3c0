"""Delivery of results to brokers, databases and PLCs, without loss while these cannot be reached.

:class:`Outlets` runs the outlets of a section ``outlets:``. Each one has a spool on the disk, and
an account that balances. :class:`Outlet` is the base of a new kind: a class in the entry-point
group ``smartcam.outlets``. The commands are ``smartcam serve``, ``smartcam outlet`` and
``smartcam results``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.outlets._entry import OutletAccount, OutletEntry
    from smartcam.outlets._outlet import Column, Outlet, OutletDesk
    from smartcam.outlets._outlets import Outlets, OutletState
    from smartcam.outlets._settings import OutletSettings, OutletsFile, Secret
    from smartcam.outlets._stored import StoredResults, StoreQuestion

__all__ = [
    "Column",
    "Outlet",
    "OutletAccount",
    "OutletDesk",
    "OutletEntry",
    "OutletSettings",
    "OutletState",
    "Outlets",
    "OutletsFile",
    "Secret",
    "StoreQuestion",
    "StoredResults",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_entry": "OutletAccount OutletEntry",
            "_outlet": "Column OutletDesk Outlet",
            "_outlets": "OutletState Outlets",
            "_settings": "OutletSettings OutletsFile Secret",
            "_stored": "StoredResults StoreQuestion",
        },
    )
