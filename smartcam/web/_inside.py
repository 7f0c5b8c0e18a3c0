"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.web._clouds import Up
    from smartcam.web._guard import new_token
    from smartcam.web._jpeg import encoded, is_whole_jpeg, picture
    from smartcam.web._teach import TeachSite

__all__ = [
    "TeachSite",
    "Up",
    "encoded",
    "is_whole_jpeg",
    "new_token",
    "picture",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_teach": "TeachSite",
            "_clouds": "Up",
            "_guard": "new_token",
            "_jpeg": "encoded is_whole_jpeg picture",
        },
    )
