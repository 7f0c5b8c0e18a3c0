"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.web._clouds import UpAxis
    from smartcam.web._guard import new_token
    from smartcam.web._jpeg import encode_pixels, is_whole_jpeg, pixels_to_show
    from smartcam.web._teach import TeachSite

__all__ = [
    "TeachSite",
    "UpAxis",
    "encode_pixels",
    "is_whole_jpeg",
    "new_token",
    "pixels_to_show",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_teach": "TeachSite",
            "_clouds": "UpAxis",
            "_guard": "new_token",
            "_jpeg": "encode_pixels is_whole_jpeg pixels_to_show",
        },
    )
