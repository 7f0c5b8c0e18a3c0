"""``raw``: the bytes as they are; hex in JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from smartcam.interpreters.base import PlainInterpreter

if TYPE_CHECKING:
    from smartcam.interpreters.base import Context

__all__ = ["Raw"]


class Raw(PlainInterpreter):
    """Gives the container's bytes; takes no layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "none"

    def read(self, data: bytes, context: Context) -> bytes:
        """Return the bytes behind the application id."""
        return data
