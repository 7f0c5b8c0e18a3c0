"""``strings50``: texts of 50 bytes each (the thesis' ``50ByteStrings``)."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, ClassVar, Literal

from smartcam.interpreters.base import PlainInterpreter, Reader

if TYPE_CHECKING:
    from smartcam.interpreters.base import Context

__all__ = ["Strings50"]

WIDTH = 50
_TEXT = struct.Struct(f"{WIDTH}s")


class Strings50(PlainInterpreter):
    """Gives the texts of a container of 50-byte strings; takes no layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "none"

    def read(self, data: bytes, context: Context) -> list[str]:
        """Return the texts in order; empty ones are kept, so places stay what they are.

        Raises:
            InterpretationError: bytes are left behind the last whole string, or one is not UTF-8.
        """
        try:
            return [raw.partition(b"\0")[0].decode() for (raw,) in _TEXT.iter_unpack(data)]
        except (struct.error, UnicodeDecodeError):
            pass
        reader = Reader(data)  # it says where
        return [reader.get_string(offset, WIDTH) for offset in reader.records(WIDTH)]
