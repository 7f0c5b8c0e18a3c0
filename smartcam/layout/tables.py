"""Layouts as numpy dtypes and tables. Imported where a table is first asked for."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.layout.text import UNITS

if TYPE_CHECKING:
    from smartcam.layout.codec import Payload, RecordCodec
    from smartcam.layout.text import Field

__all__ = ["table", "wire_dtype"]


def wire_dtype(fields: tuple[Field, ...]) -> np.dtype[np.void]:
    """Return the packed dtype of one record on the wire, little endian."""
    return np.dtype(
        [(field.name, f"<{field.wire.numpy}{field.length or ''}") for field in fields], align=False
    )


def table(
    payload: Payload,
    dtype: np.dtype[np.void],
    codec: RecordCodec,
    offset: int,
    count: int,
    *,
    what: str,
) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    """Return ``count`` records from ``offset`` on: a view where it can be, read-only.

    Args:
        payload: the container; the caller has checked that the records are there.
        dtype: one record on the wire.
        codec: of the same record.
        offset: where the first record begins.
        count: number of records.
        what: tells a record in an error.

    Raises:
        InterpretationError: a byte is no bool.
    """
    # numpy refuses an empty buffer
    wire: np.ndarray[Any, Any] = (
        np.frombuffer(payload, dtype, count, offset) if count else np.empty(0, dtype)
    )
    native = _table_dtype(codec.fields)
    converts = any(field.type == "bool" or field.unit is not None for field in codec.fields)
    if native == dtype and not converts:
        rows = wire
    else:
        rows = np.empty(count, native)
        for field in codec.fields:
            column = wire[field.name]
            if field.type == "bool" and not codec.lenient and not _all_bools(column):
                raise codec.locate(payload, offset, count, what)
            rows[field.name] = _converted(field, column)
    rows.flags.writeable = False
    return rows


def _table_dtype(fields: tuple[Field, ...]) -> np.dtype[np.void]:
    order = "<" if sys.byteorder == "little" else ">"
    columns: list[tuple[str, str]] = []
    for field in fields:
        if field.type == "bool":
            columns.append((field.name, "?"))
        elif field.unit is not None:
            columns.append((field.name, f"{order}f8"))
        else:
            columns.append((field.name, f"{order}{field.wire.numpy}{field.length or ''}"))
    return np.dtype(columns, align=False)


def _all_bools(column: np.ndarray[Any, Any]) -> bool:
    return bool(np.isin(column, (0x00, 0xFF)).all())


def _converted(field: Field, column: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    values: Any = column
    if field.type == "bool":
        values = column != 0
    elif field.unit is not None:
        unit = UNITS[field.unit]
        with np.errstate(all="ignore"):  # NaN and infinity pass, as they do one by one
            values = column.astype(np.float64) * unit.multiply / unit.divide
    return np.asarray(values)
