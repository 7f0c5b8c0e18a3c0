"""A faulty link on demand: a proxy between a client and a camera that changes their bytes.

::

    async with LinkProxy("127.0.0.1", emulator.port, rules=[Cut(at=20)]) as proxy:
        async with smartcam.connect(proxy.url(emulator.url)) as camera:
            ...
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.testing.proxy._proxy import LinkProxy
    from smartcam.testing.proxy._rules import (
        CoalesceBytes,
        Cut,
        DelayBytes,
        DelayDatagrams,
        Drip,
        DropBytes,
        DropDatagrams,
        DuplicateBytes,
        DuplicateDatagrams,
        Flip,
        InsertBytes,
        Rate,
        Reorder,
        ResetConnection,
        Rule,
        SplitBytes,
        Stall,
    )

__all__ = [
    "CoalesceBytes",
    "Cut",
    "DelayBytes",
    "DelayDatagrams",
    "Drip",
    "DropBytes",
    "DropDatagrams",
    "DuplicateBytes",
    "DuplicateDatagrams",
    "Flip",
    "InsertBytes",
    "LinkProxy",
    "Rate",
    "Reorder",
    "ResetConnection",
    "Rule",
    "SplitBytes",
    "Stall",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_proxy": "LinkProxy",
            "_rules": "CoalesceBytes Cut DelayBytes DelayDatagrams Drip DropBytes DropDatagrams "
            "DuplicateBytes DuplicateDatagrams Flip InsertBytes Rate Reorder ResetConnection "
            "Rule SplitBytes Stall",
        },
    )
