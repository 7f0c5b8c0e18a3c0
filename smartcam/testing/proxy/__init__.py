"""A link that breaks as told: it stands between a client and a camera and works on the bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.testing.proxy._log import Entry
    from smartcam.testing.proxy._proxy import LinkProxy
    from smartcam.testing.proxy._rules import (
        CoalesceBytes,
        Cut,
        DelayBytes,
        Drip,
        DropBytes,
        DuplicateBytes,
        Flip,
        InsertBytes,
        Late,
        Lose,
        Pace,
        Rate,
        Reorder,
        Repeat,
        ResetConnection,
        Rule,
        SplitBytes,
        Stall,
    )

__all__ = [
    "CoalesceBytes",
    "Cut",
    "DelayBytes",
    "Drip",
    "DropBytes",
    "DuplicateBytes",
    "Entry",
    "Flip",
    "InsertBytes",
    "Late",
    "LinkProxy",
    "Lose",
    "Pace",
    "Rate",
    "Reorder",
    "Repeat",
    "ResetConnection",
    "Rule",
    "SplitBytes",
    "Stall",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_log": "Entry",
            "_proxy": "LinkProxy",
            "_rules": "CoalesceBytes Cut DelayBytes Drip DropBytes DuplicateBytes Flip "
            "InsertBytes Late Lose Pace Rate Reorder Repeat ResetConnection Rule "
            "SplitBytes Stall",
        },
    )
