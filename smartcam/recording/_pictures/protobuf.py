"""Write and read messages of Protocol Buffers, and describe them for the schema of an MCAP file."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
"""Wire types."""

TYPES: Final = {
    "double": 1,
    "uint64": 4,
    "fixed32": 7,
    "string": 9,
    "message": 11,
    "bytes": 12,
    "enum": 14,
}
"""Numbers of the types of fields."""

TIMESTAMP: Final = ".google.protobuf.Timestamp"
"""Name of the message of a time."""


class WireField(NamedTuple):
    """A field of a message.

    Attributes:
        number: number of the field.
        type: type of the field, one of :data:`TYPES`.
        type_name: full name of the type of a message or an enumeration, with a dot in front.
        repeated: whether the message may have several of the field.
    """

    number: int
    type: str
    type_name: str = ""
    repeated: bool = False


Fields = dict[str, WireField]
"""The fields of a message, by their names."""


# ---------------------------------------------------------------------- writing


def encode_message(fields: Fields, values: Mapping[str, Any]) -> bytes:
    """Return a message; values that are None, 0 or "" are left out, as Protocol Buffers do."""
    return b"".join(
        encode_field(fields[name], value)
        for name, value in values.items()
        if value is not None and value not in (0, "")
    )


def encode_field(field: WireField, value: Any) -> bytes:
    """Return a field with its value; a repeated field once for each value in a list."""
    if field.repeated and isinstance(value, list):
        return b"".join(encode_field(field, item) for item in value)
    if field.type == "double":
        return tag(field.number, FIXED64) + struct.pack("<d", value)
    if field.type == "fixed32":
        return tag(field.number, FIXED32) + struct.pack("<I", value)
    if field.type in ("uint64", "enum"):
        return tag(field.number, VARINT) + varint(value)
    data: bytes = value.encode("utf-8", "replace") if field.type == "string" else value
    return length_delimited(field.number, data)


def encode_timestamp(utc: float) -> bytes:
    """Return a time, seconds since 1970, as google.protobuf.Timestamp."""
    seconds, nanoseconds = divmod(max(0, round(utc * 1e9)), 1_000_000_000)
    return tag(1, VARINT) + varint(seconds) + tag(2, VARINT) + varint(nanoseconds)


def length_delimited(number: int, data: bytes) -> bytes:
    """Return a field of bytes, preceded by the number of bytes."""
    return tag(number, BYTES) + varint(len(data)) + data


def tag(number: int, wire_type: int) -> bytes:
    """Return the start of a field."""
    return varint(number << 3 | wire_type)


def varint(value: int) -> bytes:
    """Return a whole number in groups of seven bits."""
    data = bytearray()
    while value > 0x7F:
        data.append(value & 0x7F | 0x80)
        value >>= 7
    data.append(value)
    return bytes(data)


# ---------------------------------------------------------------------- reading


def parse_message(fields: Fields, data: memoryview, max_fields: int) -> dict[str, Any]:
    """Return the values of a message's known fields; a repeated field has a list of them.

    Args:
        fields: the known fields; other fields are skipped.
        data: bytes of the message.
        max_fields: largest number of fields that the message may have.

    Raises:
        ValueError: the message is not valid, has too many fields, or a field of another type.
    """
    known = {field.number: (name, field) for name, field in fields.items()}
    values: dict[str, Any] = {}
    for count, (number, wire_type, value) in enumerate(_wire_fields(data)):
        if count >= max_fields:
            raise ValueError(f"a message of more than {max_fields} fields")
        name, field = known.get(number, ("", None))
        if field is None:
            continue
        expected, read = _READERS[field.type]
        if wire_type != expected:
            raise ValueError(f"{name}: wire type {wire_type} came, expected {expected}")
        if field.repeated:
            values.setdefault(name, []).append(read(value))
        else:
            values[name] = read(value)
    return values


def _unchanged(value: Any) -> Any:
    return value


_READERS: Final[dict[str, tuple[int, Callable[[Any], Any]]]] = {
    "double": (FIXED64, lambda value: struct.unpack("<d", value)[0]),
    "fixed32": (FIXED32, lambda value: struct.unpack("<I", value)[0]),
    "uint64": (VARINT, _unchanged),
    "enum": (VARINT, _unchanged),
    "string": (BYTES, _unchanged),
    "bytes": (BYTES, _unchanged),
    "message": (BYTES, _unchanged),
}


def _wire_fields(data: memoryview) -> Iterator[tuple[int, int, Any]]:
    """Yield the number, wire type and value of each field."""
    offset = 0
    while offset < len(data):
        field_tag, offset = _read_varint(data, offset)
        wire_type = field_tag & 7
        if wire_type == VARINT:
            value, offset = _read_varint(data, offset)
            yield field_tag >> 3, wire_type, value
            continue
        if wire_type == BYTES:
            size, offset = _read_varint(data, offset)
        elif wire_type in (FIXED32, FIXED64):
            size = 4 if wire_type == FIXED32 else 8
        else:
            raise ValueError(f"a field of wire type {wire_type}")
        if size > len(data) - offset:
            raise ValueError(f"a field of {size} bytes in the last {len(data) - offset}")
        yield field_tag >> 3, wire_type, data[offset : offset + size]
        offset += size


def _read_varint(data: memoryview, offset: int) -> tuple[int, int]:
    """Return the number at an offset, and the offset after it."""
    value = 0
    for shift in range(0, 64, 7):
        if offset >= len(data):
            raise ValueError("a number is cut off")
        byte = data[offset]
        offset += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value & 0xFFFF_FFFF_FFFF_FFFF, offset
    raise ValueError("a number of more than 64 bits")


# ---------------------------------------------------------------------- schemas


def file_descriptor_set(
    name: str, messages: dict[str, Fields], enums: dict[str, dict[str, tuple[str, ...]]]
) -> bytes:
    """Return a message's schema in MCAP's form: a FileDescriptorSet.

    Args:
        name: full name of the message, without a dot in front.
        messages: the message, and all messages of its package that it needs, by their short names.
        enums: enumerations that a message has within itself, and their names from 0 on.
    """
    package, _, short = name.partition(".")
    timestamp = length_delimited(1, b"Timestamp")
    for field_name, number, type_number in (("seconds", 1, 3), ("nanos", 2, 5)):
        timestamp += length_delimited(2, _descriptor(field_name, number, type_number))
    timestamp_path = "google/protobuf/timestamp.proto"
    timestamp_file = _file(timestamp_path, "google.protobuf", [timestamp])
    bodies = []
    for message_name, fields in messages.items():
        body = length_delimited(1, message_name.encode())
        for key, field in fields.items():
            descriptor = _descriptor(
                key, field.number, TYPES[field.type], field.type_name, repeated=field.repeated
            )
            body += length_delimited(2, descriptor)
        for enum, names in enums.get(message_name, {}).items():
            members = (
                length_delimited(
                    2, length_delimited(1, member.encode()) + tag(2, VARINT) + varint(number)
                )
                for number, member in enumerate(names)
            )
            body += length_delimited(4, length_delimited(1, enum.encode()) + b"".join(members))
        bodies.append(body)
    main = _file(f"{package}/{short}.proto", package, bodies, timestamp_path)
    return length_delimited(1, timestamp_file) + length_delimited(1, main)


def _descriptor(
    name: str, number: int, type_number: int, type_name: str = "", *, repeated: bool = False
) -> bytes:
    """Return a FieldDescriptorProto."""
    descriptor = length_delimited(1, name.encode()) + tag(3, VARINT) + varint(number)
    descriptor += tag(4, VARINT) + varint(3 if repeated else 1)
    descriptor += tag(5, VARINT) + varint(type_number)
    return descriptor + (length_delimited(6, type_name.encode()) if type_name else b"")


def _file(path: str, package: str, messages: list[bytes], imported_path: str = "") -> bytes:
    """Return a FileDescriptorProto."""
    head = length_delimited(1, path.encode()) + length_delimited(2, package.encode())
    imports = length_delimited(3, imported_path.encode()) if imported_path else b""
    message_types = b"".join(length_delimited(4, message) for message in messages)
    return head + imports + message_types + length_delimited(12, b"proto3")
