"""``strings50``: texts of 50 bytes each (the thesis' ``50ByteStrings``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from smartcam.interpreters.base import Interpreter

if TYPE_CHECKING:
    from smartcam.interpreters.base import Reader

__all__ = ["Strings50"]

WIDTH = 50


class Strings50(Interpreter):
    """Gives the texts of a container of 50-byte strings; takes no layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "none"

    def interpret(self, reader: Reader) -> list[str]:
        """Return the texts in order; empty ones are kept, so places stay what they are.

        Raises:
            InterpretationError: bytes are left behind the last whole string, or one is not UTF-8.
        """
        return [reader.get_string(offset, WIDTH) for offset in reader.records(WIDTH)]
