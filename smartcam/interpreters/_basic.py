"""Interpret results as raw bytes, texts of 50 bytes, a record or a table."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from smartcam.interpreters._base import PlainInterpreter, Reader

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from smartcam.interpreters._base import Context
    from smartcam.layout import Layout

TEXT_BYTES = 50
_TEXT = struct.Struct(f"{TEXT_BYTES}s")


class RawInterpreter(PlainInterpreter):
    """Returns the container's bytes unchanged (as hexadecimal digits in JSON); takes no layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "none"

    def read(self, data: bytes, context: Context) -> bytes:
        """Return the container's bytes, which follow the application id on the wire."""
        return data


class Strings50Interpreter(PlainInterpreter):
    """Reads texts of 50 bytes each; takes no layout.

    A thesis about the BVS camera names this format ``50ByteStrings``.
    """

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "none"

    def read(self, data: bytes, context: Context) -> list[str]:
        """Return the texts in order; an empty text is returned as "".

        Raises:
            InterpretationError: bytes are left after the last whole text, or a text is not UTF-8.
        """
        try:
            return [raw.partition(b"\0")[0].decode() for (raw,) in _TEXT.iter_unpack(data)]
        except (struct.error, UnicodeDecodeError):
            pass
        reader = Reader(data)  # for an error that names the offset
        return [reader.get_string(offset, TEXT_BYTES) for offset in reader.records(TEXT_BYTES)]


class RecordInterpreter(PlainInterpreter):
    """Reads one record of named fields, or a list of records; needs a layout.

    See :meth:`smartcam.Layout.parse`.
    """

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "required"
    layout: Layout  # pyright: ignore[reportIncompatibleVariableOverride]  never None here

    def read(self, data: bytes, context: Context) -> Any:
        """Return the record, or the list of records.

        Raises:
            InterpretationError: the bytes do not fit the layout.
        """
        return self.layout.parse(data, context.byte_order)

    def read_all(self, containers: Sequence[bytes], context: Context) -> list[Any]:
        """Return the value of each container."""
        return self.layout.parse_all(containers, context.byte_order)


class TableInterpreter(PlainInterpreter):
    """Reads records into a numpy array; needs a layout.

    See :meth:`smartcam.Layout.parse_table`.
    """

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "required"
    layout: Layout  # pyright: ignore[reportIncompatibleVariableOverride]  never None here

    def read(self, data: bytes, context: Context) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        """Return the records as a structured array of one dimension, read-only.

        Raises:
            InterpretationError: the bytes do not fit the layout.
        """
        return self.layout.parse_table(data, context.byte_order)

    def read_all(
        self, containers: Sequence[bytes], context: Context
    ) -> list[np.ndarray[tuple[int], np.dtype[np.void]]]:
        """Return a table for each container."""
        return self.layout.parse_tables(containers, context.byte_order)
