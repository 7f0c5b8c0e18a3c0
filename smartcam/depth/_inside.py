"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.depth._colours import ColourRegion, hsv
    from smartcam.depth._simulation import (
        AXES,
        BLOCK,
        FOCAL,
        TableSight,
        TowerTable,
        WoodenBlock,
        random_table,
        to_robot,
    )

__all__ = [
    "AXES",
    "BLOCK",
    "FOCAL",
    "ColourRegion",
    "TableSight",
    "TowerTable",
    "WoodenBlock",
    "hsv",
    "random_table",
    "to_robot",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_colours": "ColourRegion hsv",
            "_simulation": "AXES BLOCK FOCAL TableSight TowerTable WoodenBlock random_table "
            "to_robot",
        },
    )
