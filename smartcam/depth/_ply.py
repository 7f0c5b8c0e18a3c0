"""Read and write the vertices of PLY files.

Source: Greg Turk, The PLY Polygon File Format (1994).
"""

from __future__ import annotations

from dataclasses import dataclass, field
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
    from numpy.typing import NDArray

    from smartcam.depth._cloud import Cloud

TYPES: Final = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
"""Types by their names in the format's document, and by names that other programs write."""

MAX_LIST_ROWS: Final = 1 << 20
"""Largest number of rows of lists before the vertices; faces come after them."""

ORDERS: Final = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(slots=True)
class _PlyElement:
    """An element of the header: rows of one kind."""

    name: str
    count: int
    properties: dict[str, str] = field(default_factory=dict)  # numpy's types by name
    # numpy's types in the order of a row: one for a number, two for a list (size and items)
    parts: list[tuple[str, ...]] = field(default_factory=list)

    @property
    def has_lists(self) -> bool:
        """True if the rows have lists, and so no fixed length."""
        return any(len(part) > 1 for part in self.parts)

    def row_type(self, byte_order: str) -> np.dtype[Any]:
        """Return NumPy's type of a row."""
        if self.has_lists or not self.properties:
            raise BadFileError(
                f"rows of numbers for {self.name}", "lists" if self.has_lists else "none"
            )
        row = np.dtype(
            [(name, (byte_order or "<") + kind) for name, kind in self.properties.items()]
        )
        check_row(row)
        return row

    def end_of_rows(self, data: bytes, start: int, byte_order: str) -> int:
        """Return the offset after the rows that begin at ``start``."""
        if not self.has_lists:
            return start + (self.count * self.row_type(byte_order).itemsize if self.count else 0)
        if self.count > MAX_LIST_ROWS:
            raise BadFileError(
                f"up to {MAX_LIST_ROWS} rows of lists before the vertices", f"{self.count}"
            )
        kinds = [[np.dtype(byte_order + kind) for kind in part] for part in self.parts]
        for _ in range(self.count):
            for size, *items in kinds:
                end = start + size.itemsize
                if items:
                    item_count = int(np.frombuffer(data[start:end].ljust(8, b"\0"), size, 1)[0])
                    end += max(0, item_count) * items[0].itemsize
                start = end
            if start > len(data):
                raise BadFileError(f"{self.count} rows for {self.name}", "fewer")
        return start


def read(data: bytes) -> dict[str, NDArray[Any]]:
    """Return the columns of a file's vertices; raise BadFileError if the file is not valid."""
    byte_order, elements, start = _read_header(data)
    before, vertex = _split_at_vertices(elements)
    row = vertex.row_type(byte_order)
    if byte_order:
        for element in before:
            start = element.end_of_rows(data, start, byte_order)
        rows = from_bytes(data, start, vertex.count, row)
        return {name: rows[name].astype(kind) for name, kind in vertex.properties.items()}
    types = [np.dtype(kind) for kind in vertex.properties.values()]
    columns = from_text(data, start, sum(element.count for element in before), vertex.count, types)
    return dict(zip(row.names or (), columns, strict=True))


def _read_header(data: bytes) -> tuple[str, list[_PlyElement], int]:
    """Return the byte order ("" for text), the elements, and the offset of the first row."""
    line, offset = read_header_line(data, 0) if data.startswith(b"ply") else ("", 0)
    if line.rstrip() != "ply":
        raise BadFileError("a PLY file, which begins with ply", shown(data[:60]))
    byte_order: str | None = None
    elements: list[_PlyElement] = []
    while True:
        line, offset = read_header_line(data, offset)
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["end_header"]:
                break
            case ["format", name, "1.0"] if name in ORDERS and byte_order is None:
                byte_order = ORDERS[name]
            case ["element", name, count] if len(elements) < MAX_FIELDS:
                elements.append(_PlyElement(name, parse_count(count, "rows")))
            case ["property", "list", size, kind, _] if elements and {size, kind} <= TYPES.keys():
                _add_part(elements[-1], TYPES[size], TYPES[kind])
            case ["property", kind, name] if elements and kind in TYPES:
                _add_property(elements[-1], name, TYPES[kind])
            case _:
                raise BadFileError("a line of a PLY header", shown(line))
    if byte_order is None:
        raise BadFileError(f"a format of {', '.join(ORDERS)}", "none")
    return byte_order, elements, offset


def _add_property(element: _PlyElement, name: str, kind: str) -> None:
    if name in element.properties or len(element.properties) >= MAX_FIELDS:
        raise BadFileError(f"up to {MAX_FIELDS} properties, each once", f"{shown(name)} again")
    element.properties[name] = kind
    _add_part(element, kind)


def _add_part(element: _PlyElement, *part: str) -> None:
    if len(element.parts) >= MAX_FIELDS or (len(part) > 1 and part[0].startswith("f")):
        raise BadFileError(
            f"up to {MAX_FIELDS} properties, lists with a whole number as their size",
            f"{len(element.parts) + 1}, the last one of {' and '.join(part)}",
        )
    element.parts.append(part)


def _split_at_vertices(elements: list[_PlyElement]) -> tuple[list[_PlyElement], _PlyElement]:
    """Return the elements before the vertices, and the vertices' element."""
    for index, element in enumerate(elements):
        if element.name == "vertex":
            return elements[:index], element
    names = ", ".join(shown(element.name) for element in elements) or "none"
    raise BadFileError("an element vertex", names)


def write(cloud: Cloud, text: bool) -> bytes:
    """Return a cloud as a PLY file."""
    columns: dict[str, NDArray[Any]] = dict(zip("xyz", cloud.points.T, strict=True))
    names = dict.fromkeys("xyz", "float")
    if cloud.colours is not None:
        columns |= dict(zip(("red", "green", "blue"), cloud.colours.T, strict=True))
        names |= dict.fromkeys(("red", "green", "blue"), "uchar")
    if cloud.sigma is not None:
        columns["sigma"] = cloud.sigma
        names["sigma"] = "float"
    head = "\n".join(
        [
            "ply",
            f"format {'ascii' if text else 'binary_little_endian'} 1.0",
            "comment unit m",
            f"element vertex {len(cloud)}",
            *(f"property {kind} {name}" for name, kind in names.items()),
            "end_header\n",
        ]
    ).encode("ascii")
    if text:
        return head + to_text(columns.values())
    row = np.dtype([(name, "<" + TYPES[kind]) for name, kind in names.items()])
    return head + to_bytes(columns, row)
