"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.recording._bags.conversion import BagConversion
    from smartcam.recording._bags.items import BagCounts
    from smartcam.recording._pictures.folder import file_name
    from smartcam.recording._pictures.judged import JudgedPictures

__all__ = [
    "BagConversion",
    "BagCounts",
    "JudgedPictures",
    "file_name",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_bags.items": "BagCounts",
            "_bags.conversion": "BagConversion",
            "_pictures.folder": "file_name",
            "_pictures.judged": "JudgedPictures",
        },
    )
