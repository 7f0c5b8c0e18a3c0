"""``raw``: the bytes as they are; hex in JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from smartcam.interpreters.base import PlainInterpreter

if TYPE_CHECKING:
    from smartcam.models import ByteOrder

__all__ = ["Raw"]


class Raw(PlainInterpreter):
    """Gives the container's bytes; takes no layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "none"

    def read(self, data: bytes, byte_order: ByteOrder) -> bytes:
        """Return the bytes behind the application id."""
        return data
