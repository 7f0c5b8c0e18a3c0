"""Read and write the rows of numbers in PLY and PCD files, as bytes and as text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NoReturn

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

MAX_HEADER_BYTES: Final = 1 << 16
"""Largest number of bytes of a file's header."""

MAX_FIELDS: Final = 256

MAX_ROW_BYTES: Final = 1 << 12
"""Largest number of bytes of a row that is stored as bytes."""

MAX_LINE_BYTES: Final = 1 << 20
"""Largest number of bytes of a line of text, which leaves room for digits and spaces."""

NUMBERS_AT_A_TIME: Final = 1 << 18
"""Number of text items that are parsed at a time, which bounds the memory."""


class BadFileError(Exception):
    """Error in a file's content; the caller adds the file's name."""

    def __init__(self, expected: str, actual: str) -> None:
        super().__init__(f"expected {expected}, got {actual}")


def shown(data: bytes | str) -> str:
    """Return the beginning of wrong data in quotes, for an error text of one line."""
    text = data.decode("ascii", "backslashreplace") if isinstance(data, bytes) else data
    return repr(text if len(text) <= 60 else f"{text[:60]}...")


def read_header_line(data: bytes, start: int) -> tuple[str, int]:
    """Return a line of the header, without LF or CR LF, and the offset of the next line."""
    end = data.find(b"\n", start, MAX_HEADER_BYTES)
    if end < 0:
        raise BadFileError(
            f"a header of up to {MAX_HEADER_BYTES} bytes",
            shown(data[start : start + MAX_HEADER_BYTES]),
        )
    line = data[start:end].removesuffix(b"\r")
    try:
        return line.decode(
            "ascii", "strict" if not line.startswith((b"comment", b"#")) else "replace"
        ), end + 1
    except UnicodeDecodeError:
        _fail("a header in ASCII", line)


def parse_count(text: str, label: str) -> int:
    """Return a count from text; raise BadFileError if the text is not a count."""
    if not (text.isascii() and text.isdigit() and len(text) <= 15):
        _fail(f"a number of {label}", text)
    return int(text)


def _fail(expected: str, actual: bytes | str) -> NoReturn:
    raise BadFileError(expected, shown(actual)) from None


def check_row(row_type: np.dtype[Any]) -> None:
    """Raise BadFileError if rows are too long."""
    if row_type.itemsize > MAX_ROW_BYTES:
        raise BadFileError(f"rows of up to {MAX_ROW_BYTES} bytes", f"{row_type.itemsize}")


def from_bytes(data: bytes, start: int, count: int, row_type: np.dtype[Any]) -> NDArray[Any]:
    """Return ``count`` rows from the offset ``start``; bytes after them are ignored."""
    available = len(data) - start
    if count * row_type.itemsize > available:
        raise BadFileError(
            f"{count} rows of {row_type.itemsize} bytes, {count * row_type.itemsize} in all",
            f"{available}",
        )
    return np.frombuffer(data, row_type, count, start)


def from_text(
    data: bytes, start: int, skip: int, count: int, types: Sequence[np.dtype[Any]]
) -> tuple[NDArray[Any], ...]:
    """Return the columns of ``count`` lines of numbers, after ``skip`` other lines.

    Numbers for integer types must be whole and in range.
    """
    check_row(np.dtype([(str(index), column_type) for index, column_type in enumerate(types)]))
    if 2 * len(types) * count > len(data) - start + 1:
        raise BadFileError(f"{count} lines of {len(types)} numbers", f"{len(data) - start} bytes")
    columns = tuple(np.empty(count, column_type) for column_type in types)
    row_count, offset, to_skip = 0, start, skip
    while row_count < count:
        lines: list[list[bytes]] = []
        while len(lines) < min(NUMBERS_AT_A_TIME // len(types), count - row_count):
            if offset >= len(data):
                raise BadFileError(f"{count} lines of numbers", f"{row_count + len(lines)}")
            end = data.find(b"\n", offset)
            end = len(data) if end < 0 else end
            if end - offset > MAX_LINE_BYTES:
                raise BadFileError(f"lines of up to {MAX_LINE_BYTES} bytes", f"{end - offset}")
            words, offset = data[offset:end].split(), end + 1
            if to_skip:
                to_skip -= 1
            elif len(words) == len(types):
                lines.append(words)
            elif words:
                _fail(
                    f"{len(types)} numbers in row {row_count + len(lines) + 1} of the data",
                    b" ".join(words),
                )
        for column, texts in zip(columns, zip(*lines, strict=True), strict=True):
            column[row_count : row_count + len(lines)] = _parse_numbers(texts, column.dtype)
        row_count += len(lines)
    return columns


def _parse_numbers(texts: Sequence[bytes], number_type: np.dtype[Any]) -> NDArray[Any]:
    """Return the numbers of a column; raise BadFileError if a text is no number of the type."""
    try:
        if number_type.kind == "f":
            values = np.array([float(text) for text in texts], np.float64)
            with np.errstate(over="ignore"):
                return values.astype(number_type)
        numbers = [int(text) for text in texts if len(text) <= 20]
    except ValueError as exc:
        raise BadFileError("numbers", shown(str(exc))) from None
    limits = np.iinfo(number_type)
    if len(numbers) < len(texts) or not limits.min <= min(numbers) <= max(numbers) <= limits.max:
        raise BadFileError(
            f"numbers from {limits.min} to {limits.max}", "a number out of this range"
        )
    return np.array(numbers, number_type)


def to_text(columns: Iterable[NDArray[Any]]) -> bytes:
    """Return columns as lines of text, with digits that restore float32 values exactly."""
    words = [
        [f"{value:.9g}" for value in column.tolist()]
        if column.dtype.kind == "f"
        else [str(value) for value in column.tolist()]
        for column in columns
    ]
    return "".join(f"{' '.join(row)}\n" for row in zip(*words, strict=True)).encode("ascii")


def to_bytes(columns: Mapping[str, NDArray[Any]], row_type: np.dtype[Any]) -> bytes:
    """Return columns as rows of bytes."""
    count = len(next(iter(columns.values())))
    rows = np.empty(count, row_type)
    for name, column in columns.items():
        rows[name] = column
    return rows.tobytes()
