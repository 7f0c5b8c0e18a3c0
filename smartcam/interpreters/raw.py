"""``raw``: the bytes as they are; hex in JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from smartcam.interpreters.base import Interpreter

if TYPE_CHECKING:
    from smartcam.interpreters.base import Reader

__all__ = ["Raw"]


class Raw(Interpreter):
    """Gives the container's bytes; takes no layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "none"

    def interpret(self, reader: Reader) -> bytes:
        """Return the bytes behind the application id."""
        return reader.data
