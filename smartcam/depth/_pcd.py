"""Read and write PCD files, version 0.7, as PCL and others write them.

Source: the Point Cloud Library's document of the PCD file format; for the compression, Marc
Lehmann's LibLZF 3.6.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from smartcam.depth._tables import (
    MAX_FIELDS,
    BadFileError,
    check_row,
    from_bytes,
    from_text,
    parse_count,
    read_header_line,
    shown,
    to_bytes,
    to_text,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from smartcam.depth._cloud import Cloud

TYPES: Final = {
    **{("I", size): f"<i{size}" for size in (1, 2, 4, 8)},
    **{("U", size): f"<u{size}" for size in (1, 2, 4, 8)},
    **{("F", size): f"<f{size}" for size in (4, 8)},
}
"""NumPy's type for each pair of TYPE and SIZE."""

MAX_UNPACKED_BYTES: Final = 1 << 30
"""Largest size of unpacked points, bytes: the limit of uncompressed files."""

COLOURS: Final = ("rgb", "rgba")
"""Fields of 4 bytes with a colour, blue in the lowest byte; a float holds the same 4 bytes."""

PADDING_NAME: Final = "_"
"""Name of padding fields, which are skipped and may occur more than once."""


@dataclass(frozen=True, slots=True)
class _PcdHeader:
    names: Sequence[str]
    types: Sequence[str]  # NumPy's types
    counts: Sequence[int]  # number of values of each field
    points: int
    data: str  # form of the data: ascii, binary, binary_compressed
    start: int  # offset of the first row


def read(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the columns of a file's points; raise BadFileError if the file is not valid."""
    head = _read_header(data)
    columns = READERS[head.data](data, head)
    for name in COLOURS:
        if name in columns and columns[name].dtype.itemsize == 4:
            packed = columns[name].view(np.uint32)
            for shift, colour in ((16, "red"), (8, "green"), (0, "blue")):
                columns[colour] = (packed >> shift & 0xFF).astype(np.uint8)
            break
    return columns


def _read_header(data: bytes) -> _PcdHeader:
    lines: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in lines:
        line, offset = read_header_line(data, offset)
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in HEADER_WORDS or words[0] in lines:
            raise BadFileError(f"a PCD file's {', '.join(HEADER_WORDS)}, each once", shown(line))
        lines[words[0]] = words[1:]
    if lines.get("VERSION") not in (["0.7"], [".7"]):
        raise BadFileError("VERSION 0.7", shown(" ".join(lines.get("VERSION", ["none"]))))
    names = lines.get("FIELDS", [])
    sizes, kinds, counts = (
        lines.get(name, default)
        for name, default in (("SIZE", []), ("TYPE", []), ("COUNT", ["1"] * len(names)))
    )
    if not 0 < len(names) <= MAX_FIELDS or {len(sizes), len(kinds), len(counts)} != {len(names)}:
        raise BadFileError(
            f"up to {MAX_FIELDS} FIELDS, with SIZE, TYPE and COUNT of each",
            f"{len(names)}, {len(sizes)}, {len(kinds)} and {len(counts)}",
        )
    unpadded = [name for name in names if name != PADDING_NAME]
    if len(set(unpadded)) < len(unpadded):
        raise BadFileError("each of the FIELDS once", shown(" ".join(names)))
    types = []
    for kind, size in zip(kinds, sizes, strict=True):
        number_type = TYPES.get((kind, parse_count(size, "bytes")))
        if number_type is None:
            raise BadFileError("I or U of 1, 2, 4 or 8, or F of 4 or 8 bytes", shown(kind + size))
        types.append(number_type)
    width, height, points = (_single_count(lines, name) for name in ("WIDTH", "HEIGHT", "POINTS"))
    if width * height != points:
        raise BadFileError("POINTS equal to WIDTH times HEIGHT", f"{points}, {width} and {height}")
    if lines["DATA"] not in [[reader] for reader in READERS]:
        raise BadFileError(f"DATA {', '.join(READERS)}", shown(" ".join(lines["DATA"])))
    value_counts = [parse_count(count, "numbers") for count in counts]
    if max(value_counts) > MAX_FIELDS or min(value_counts) < 1:
        raise BadFileError(
            f"COUNT from 1 to {MAX_FIELDS}", f"{min(value_counts)} to {max(value_counts)}"
        )
    return _PcdHeader(names, types, value_counts, points, lines["DATA"][0], offset)


def _single_count(lines: Mapping[str, list[str]], name: str) -> int:
    words = lines.get(name, [])
    if len(words) != 1:
        raise BadFileError(f"{name} and a number", shown(" ".join(words)))
    return parse_count(words[0], name.lower())


def _row_type(head: _PcdHeader) -> np.dtype[Any]:
    """Return NumPy's type of a row; fields are named by number, since names may occur twice."""
    fields = zip(head.types, head.counts, strict=True)
    row = np.dtype([(str(index), kind, (count,)) for index, (kind, count) in enumerate(fields)])
    check_row(row)
    return row


def _read_binary(data: bytes, head: _PcdHeader) -> dict[str, NDArray[Any]]:
    rows = from_bytes(data, head.start, head.points, _row_type(head))
    return {
        name: rows[str(index)][:, 0].copy()
        for index, (name, count) in enumerate(zip(head.names, head.counts, strict=True))
        if count == 1 and name != PADDING_NAME
    }


def _read_compressed(data: bytes, head: _PcdHeader) -> dict[str, NDArray[Any]]:
    """Return the columns of compressed data, which stores one column after the other."""
    size = head.points * _row_type(head).itemsize
    if size > MAX_UNPACKED_BYTES:  # 3 bytes of LZF can expand to 264
        raise BadFileError(f"points that unpack to {MAX_UNPACKED_BYTES} bytes at most", f"{size}")
    if len(data) < head.start + 8:
        raise BadFileError("two sizes of 4 bytes", f"{len(data) - head.start} bytes")
    packed, unpacked_size = struct.unpack_from("<II", data, head.start)
    if unpacked_size != size or packed > len(data) - head.start - 8:
        raise BadFileError(
            f"up to {len(data) - head.start - 8} bytes that unpack to {size}",
            f"{packed} that unpack to {unpacked_size}",
        )
    columns, offset = {}, 0
    body = unpack_lzf(data[head.start + 8 : head.start + 8 + packed], size)
    for name, kind, count in zip(head.names, head.types, head.counts, strict=True):
        value_count = count * head.points
        if count == 1 and name != PADDING_NAME:
            columns[name] = np.frombuffer(body, kind, value_count, offset).copy()
        offset += value_count * np.dtype(kind).itemsize
    return columns


def unpack_lzf(data: bytes, size: int) -> bytes:
    """Unpack LZF-packed data; raise BadFileError unless the result has the given size."""
    out, position, end = bytearray(), 0, len(data)
    while position < end and len(out) <= size:
        control, position = data[position], position + 1
        if control < 32:  # control + 1 uncompressed bytes follow
            out += data[position : position + control + 1]
            position += control + 1
            continue
        length = control >> 5
        if length == 7 and position < end:  # a longer copy
            length, position = length + data[position], position + 1
        if position >= end:
            break
        distance, position = ((control & 31) << 8 | data[position]) + 1, position + 1
        begin = len(out) - distance
        if begin < 0:
            raise BadFileError("an offset in the unpacked data", f"{-begin} bytes before it")
        length += 2
        copied = out[begin : begin + length]  # may overlap with its own output
        out += (copied * (length // len(copied) + 1))[:length]
    if len(out) != size or position != end:
        raise BadFileError(
            f"{end} bytes that unpack to {size}", f"{position} bytes that unpack to {len(out)}"
        )
    return bytes(out)


def _read_text(data: bytes, head: _PcdHeader) -> dict[str, NDArray[Any]]:
    types, names = [], []
    for name, kind, count in zip(head.names, head.types, head.counts, strict=True):
        types += [np.dtype(kind)] * count
        names += [name if count == 1 else PADDING_NAME] * count
    columns = from_text(data, head.start, 0, head.points, types)
    pairs = zip(names, columns, strict=True)
    return {name: column for name, column in pairs if name != PADDING_NAME}


READERS: Final = {
    "ascii": _read_text,
    "binary": _read_binary,
    "binary_compressed": _read_compressed,
}
"""Readers of points by the word after DATA."""

HEADER_WORDS: Final = (
    *("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT"),
    *("WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"),
)


def write(cloud: Cloud, text: bool) -> bytes:
    """Return a cloud as a PCD file: a colour is the 4 bytes of a float, or in text a number."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", cloud.points.T, strict=True))
    if cloud.colours is not None:
        red, green, blue = cloud.colours.T.astype(np.uint32)
        packed = red << 16 | green << 8 | blue
        columns["rgb"] = packed if text else packed.view(np.float32)
    if cloud.sigma is not None:
        columns["sigma"] = cloud.sigma
    row = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    kinds = ["F" if column.dtype.kind == "f" else "U" for column in columns.values()]
    head = "\n".join(
        [
            "# unit m",
            "VERSION 0.7",
            f"FIELDS {' '.join(columns)}",
            f"SIZE {' '.join(['4'] * len(columns))}",
            f"TYPE {' '.join(kinds)}",
            f"COUNT {' '.join(['1'] * len(columns))}",
            f"WIDTH {len(cloud)}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {len(cloud)}",
            f"DATA {'ascii' if text else 'binary'}\n",
        ]
    ).encode("ascii")
    return head + (to_text(columns.values()) if text else to_bytes(columns, row))
