"""Convert layouts to numpy dtypes and tables; imported only when a table is needed.

Everything that depends only on the layout is computed when a :class:`TableCodec` is created; a
container then takes only a view, or one numpy operation per column.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.layout._text import UNITS

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.layout._codec import Payload, RecordCodec
    from smartcam.layout._text import Field
    from smartcam.models import ByteOrder

Rows = np.ndarray[tuple[int], np.dtype[np.void]]


class TableCodec:
    """Reads records into tables.

    Args:
        codec: codec of the same records.
        byte_order: byte order of numbers.

    Attributes:
        dtype: dtype of one record on the wire, packed.
        is_view: whether a table is a view of the payload.
    """

    def __init__(self, codec: RecordCodec, byte_order: ByteOrder) -> None:
        fields = codec.fields
        self._codec = codec
        self.dtype: np.dtype[np.void] = _dtype(fields, byte_order)
        self._table_dtype = _dtype(fields, sys.byteorder, converted=True)
        self._columns = [(field.name, _converter(field)) for field in fields]
        self._strict_bools = [
            field.name for field in fields if field.type == "bool" and not codec.lenient
        ]
        self._has_conversions = any(
            field.type == "bool" or field.unit is not None for field in fields
        )
        self.is_view: bool = self._table_dtype == self.dtype and not self._has_conversions

    def read(self, payload: Payload, offset: int, count: int, *, label: str) -> Rows:
        """Return ``count`` records, beginning at ``offset``, read-only and if possible as a view.

        The caller has checked that the ``payload`` has them. ``label`` names a record in errors.
        Raises InterpretationError if a byte is no bool.
        """
        dtype = self.dtype
        # numpy refuses an empty buffer
        rows: Rows = np.frombuffer(payload, dtype, count, offset) if count else np.empty(0, dtype)
        for name in self._strict_bools:
            if not _has_only_bools(rows[name]):
                raise self._codec.conversion_error(payload, offset, label)
        if self._has_conversions:
            rows = self._convert_rows(rows)
        elif not self.is_view:
            rows = rows.astype(self._table_dtype)
        rows.flags.writeable = False
        return rows

    def _convert_rows(self, wire: Rows) -> Rows:
        rows = np.empty(len(wire), self._table_dtype)
        with np.errstate(all="ignore"):  # NaN and infinity are accepted, as for single values
            for name, convert in self._columns:
                column = wire[name]
                rows[name] = column if convert is None else convert(column)
        return rows


def _dtype(
    fields: tuple[Field, ...], byte_order: ByteOrder, *, converted: bool = False
) -> np.dtype[np.void]:
    """Return the dtype of a record on the wire, or with ``converted``, in a table."""
    order = "<" if byte_order == "little" else ">"
    columns: list[tuple[str, str]] = []
    for field in fields:
        column = f"{order}{field.wire.numpy}{field.length or ''}"
        if converted and field.type == "bool":
            column = "?"
        elif converted and field.unit is not None:
            column = f"{order}f8"
        columns.append((field.name, column))
    return np.dtype(columns, align=False)


def _has_only_bools(column: np.ndarray[Any, Any]) -> bool:
    return not column.tobytes().translate(None, b"\x00\xff")


def _converter(field: Field) -> Callable[[Any], Any] | None:
    """Return the converter of a column of wire values; None if copying is enough."""
    if field.type == "bool":
        return lambda wire: wire != 0
    if field.unit is None:
        return None
    _, _, multiply, divide = UNITS[field.unit]
    if multiply == divide == 1.0:
        return None
    if multiply == 1.0:
        return lambda wire: wire.astype(np.float64) / divide
    return lambda wire: wire.astype(np.float64) * multiply / divide
