"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.recording._bags.conversion import BagConversion
    from smartcam.recording._bags.items import BagCounts
    from smartcam.recording._pictures.folder import name_in_recording
    from smartcam.recording._pictures.result_pictures import ResultPictures

__all__ = [
    "BagConversion",
    "BagCounts",
    "ResultPictures",
    "name_in_recording",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_bags.items": "BagCounts",
            "_bags.conversion": "BagConversion",
            "_pictures.folder": "name_in_recording",
            "_pictures.result_pictures": "ResultPictures",
        },
    )
