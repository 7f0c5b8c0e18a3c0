"""Delivery of results to brokers, databases and PLCs, without loss while these cannot be reached.

:class:`Outlets` runs the outlets that a section ``outlets:`` of a file describes. Each outlet keeps
undelivered results in a spool (a file), and counts every result. A new kind of outlet derives from
:class:`Outlet`, and is named in the entry-point group ``smartcam.outlets``. The commands are
``smartcam serve``, ``smartcam outlet`` and ``smartcam results``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.outlets._entry import OutletEntry
    from smartcam.outlets._outlet import Outlet, OutletContext
    from smartcam.outlets._outlets import Outlets
    from smartcam.outlets._settings import OutletSettings

__all__ = [
    "Outlet",
    "OutletContext",
    "OutletEntry",
    "OutletSettings",
    "Outlets",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_entry": "OutletEntry",
            "_outlet": "OutletContext Outlet",
            "_outlets": "Outlets",
            "_settings": "OutletSettings",
        },
    )
