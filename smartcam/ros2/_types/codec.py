"""CDR: generate the functions that encode and decode messages of a type, when they are needed.

Consecutive fields of fixed size (a run) are packed with one Struct. A run may begin at any
position, so it has eight Structs, one for each position modulo 8. For alignment, positions count
from the first byte after the encapsulation, which has four bytes.
"""

from __future__ import annotations

import functools
import struct
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np

from smartcam.ros2._types.definitions import NUMBERS, MessageField

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.ros2._types.types import MessageType

Numbers: TypeAlias = "np.ndarray[Any, np.dtype[Any]]"

ENCAPSULATION: Final = b"\0\1\0\0"
_BYTE_OF_FLAG: Final = {True: 1, False: 0}
_SIZES: Final = {code: struct.calcsize(f"<{code}") for code in "bBhHiIqQfd?"}


class MisfitError(ValueError):
    """Bytes or a value do not fit the type; it does not leave this package."""


@functools.lru_cache(4096)
def _structs_by_position(
    parts: tuple[tuple[str, int], ...], order: str
) -> tuple[struct.Struct, ...]:
    """Return the eight Structs of a run, whose fields are given as (code of struct, alignment)."""
    return tuple(_struct_at(parts, order, start - len(ENCAPSULATION)) for start in range(8))


def _struct_at(parts: tuple[tuple[str, int], ...], order: str, position: int) -> struct.Struct:
    text = [order]
    for code, alignment in parts:
        pad = -position % alignment
        text.append("x" * pad + code)
        position += pad + (int(code[:-1]) if code.endswith("s") else _SIZES[code])
    return struct.Struct("".join(text))


class _Writer:
    """Collects the lines of a generated function: the common part of encoder and decoder.

    Fields of fixed size are collected in ``pending_parts`` until :meth:`flush` writes them as one
    run.
    """

    def __init__(self, order: str) -> None:
        self.order = order
        self.lines: list[str] = []
        self.names: dict[str, Any] = {}
        self.indent = 1
        self.count = 0
        self.pending_parts: list[tuple[str, int]] = []
        self.pending_values: list[str] = []

    def new_name(self, value: Any = None, prefix: str = "v") -> str:
        self.count += 1
        name = f"{prefix}{self.count}"
        if value is not None:
            self.names[name] = value
        return name

    def add_line(self, text: str) -> None:
        self.lines.append("    " * self.indent + text)

    def add_fixed(self, code: str, alignment: int, value: str) -> None:
        self.pending_parts.append((code, alignment))
        self.pending_values.append(value)

    def flush(self) -> None:
        if self.pending_parts:
            structs = self.new_name(
                _structs_by_position(tuple(self.pending_parts), self.order), "R"
            )
            self.add_line(f"s = {structs}[pos & 7]")
            self.transfer(", ".join(self.pending_values))
            self.add_line("pos += s.size")
            self.pending_parts, self.pending_values = [], []

    def transfer(self, values: str) -> None:
        raise NotImplementedError

    def compile_function(self, signature: str, title: str) -> Callable[..., Any]:
        source = "\n".join([signature, *self.lines])
        scope: dict[str, Any] = dict(self.names)
        exec(compile(source, f"<{title}>", "exec"), scope)  # noqa: S102
        function: Callable[..., Any] = scope["function"]
        return function


# -- encoding -----------------------------------------------------------------------------------


def pack_numbers(value: Any, code: str, min_count: int, max_count: int) -> Any:
    """Return the bytes of numbers; ``min_count`` is 0 unless their count is fixed."""
    if isinstance(value, bytes | bytearray | memoryview):
        if code not in "bB":
            raise MisfitError(f"bytes are no numbers of {code}")
        data: Any = bytes(value) if min_count or not value else memoryview(value).cast("B")
        count = len(data)
    elif isinstance(value, np.ndarray):
        if value.ndim != 1:
            raise MisfitError(f"expected numbers in one row, got {value.shape}")
        count = len(value)
        array = _as_array(value, np.dtype(f"<{code}"))
        data = array.tobytes() if min_count else array.view(np.uint8)
    else:
        if isinstance(value, str | dict):
            raise MisfitError(f"expected numbers, got {type(value).__name__}")
        if code == "?":
            value = [_BYTE_OF_FLAG[flag] for flag in value]
        data = struct.pack(f"<{len(value)}{code}", *value)
        count = len(value)
    if count < min_count or (max_count and count > max_count):
        raise MisfitError(f"expected {min_count or f'up to {max_count}'} numbers, got {count}")
    return data


def _as_array(value: Numbers, dtype: np.dtype[Any]) -> Numbers:
    if value.dtype != dtype:
        if dtype.kind == "f" and value.dtype.kind in "fiu":
            with np.errstate(over="ignore"):
                cast = value.astype(dtype)
            if bool(np.any(np.isinf(cast) & np.isfinite(value))):
                raise MisfitError(f"numbers out of the range of {dtype}")
        elif dtype.kind in "iu" and value.dtype.kind in "iu":
            limits = np.iinfo(dtype)
            if value.size and not (limits.min <= value.min() and value.max() <= limits.max):
                raise MisfitError(f"numbers out of the range of {dtype}")
            cast = value.astype(dtype)
        else:
            raise MisfitError(f"expected an array of {dtype}, got {value.dtype}")
        value = cast
    return np.ascontiguousarray(value)


def text_bytes(text: str, limit: int) -> bytes:
    """Return a string's bytes with NUL at the end."""
    if not isinstance(text, str):
        raise MisfitError(f"expected a string, got {type(text).__name__}")
    if "\0" in text:
        raise MisfitError("a string with NUL in it")
    data = text.encode()
    if limit and len(data) > limit:
        raise MisfitError(f"expected up to {limit} bytes of text, got {len(data)}")
    return data + b"\0"


def checked_length(value: Any, min_count: int, max_count: int) -> int:
    """Return the length of a list of messages or strings, after checking its bounds."""
    if not isinstance(value, list | tuple):
        raise MisfitError(f"expected a list, got {type(value).__name__}")
    count = len(value)
    if count < min_count or (max_count and count > max_count):
        raise MisfitError(f"expected {min_count or f'up to {max_count}'}, got {count}")
    return count


class _Encoder(_Writer):
    def __init__(self) -> None:
        super().__init__("<")
        self.names |= {
            "F": _BYTE_OF_FLAG,
            "pack_numbers": pack_numbers,
            "text_bytes": text_bytes,
            "checked_length": checked_length,
        }

    def transfer(self, values: str) -> None:
        self.add_line(f"put(s.pack({values}))")

    def add_message(self, message_type: MessageType, value: str) -> None:
        if not message_type.fields:
            self.add_fixed("B", 1, "0")
        for field in message_type.fields:
            self.add_field(message_type, field, f"{value}.{field.attribute}")

    def add_field(self, message_type: MessageType, field: MessageField, value: str) -> None:
        if field.shape:
            self.add_array(message_type, field, value)
        elif field.nested:
            name = self.new_name()
            self.add_line(f"{name} = {value}")
            self.add_message(message_type.nested[field.type], name)
        elif field.type == "string":
            name = self.new_name()
            self.add_line(f"{name} = text_bytes({value}, {field.limit})")
            self.add_fixed("I", 4, f"len({name})")
            self.flush()
            self.add_line(f"put({name})")
            self.add_line(f"pos += len({name})")
        else:
            code = NUMBERS[field.type]
            flag = code == "?"
            self.add_fixed("B" if flag else code, _SIZES[code], f"F[{value}]" if flag else value)

    def add_array(self, message_type: MessageType, field: MessageField, value: str) -> None:
        is_fixed = field.shape == "array"
        min_count = field.size if is_fixed else 0
        name = self.new_name()
        if field.type in NUMBERS:
            code = NUMBERS[field.type]
            size = _SIZES[code]
            self.add_line(f"{name} = pack_numbers({value}, {code!r}, {min_count}, {field.size})")
            if is_fixed:
                self.add_fixed(f"{field.size * size}s", size, name)
                return
            self.add_fixed("I", 4, f"len({name}) // {size}")
            self.flush()
            if size == 8:
                self.add_line(f"if len({name}):")
                self.indent += 1
                self.add_fixed("0s", size, "b''")
                self.flush()
                self.indent -= 1
            self.add_line(f"put({name})")
            self.add_line(f"pos += len({name})")
            return
        item = self.new_name()
        self.add_line(f"{name} = {value}")
        count = self.new_name()
        self.add_line(f"{count} = checked_length({name}, {min_count}, {field.size})")
        if not is_fixed:
            self.add_fixed("I", 4, count)
        self.flush()
        self.add_line(f"for {item} in {name}:")
        self.indent += 1
        self.add_field(message_type, field._replace(shape="", size=0), item)
        self.flush()
        self.indent -= 1


def encoder(message_type: MessageType) -> Callable[[Any], bytes]:
    """Return the function that encodes a message; it raises MisfitError and other errors."""
    writer = _Encoder()
    writer.names["ENCAPSULATION"] = ENCAPSULATION
    writer.add_line("parts = [ENCAPSULATION]")
    writer.add_line("put = parts.append")
    writer.add_line(f"pos = {len(ENCAPSULATION)}")
    writer.add_message(message_type, "m")
    writer.flush()
    writer.add_line("return b''.join(parts)")
    return writer.compile_function("def function(m):", f"encode {message_type.name}")


# -- decoding -----------------------------------------------------------------------------------

_FLAG_OF_BYTE: Final = (False, True)


def read_text(data: Any, start: int, size: int, limit: int) -> str:
    """Return a string of ``size`` bytes, whose last byte is NUL."""
    if not size:
        return ""
    end = start + size
    if end > len(data):
        raise MisfitError(
            f"a string of {size} bytes at {start}, where {len(data) - start} are left"
        )
    text = str(data[start : end - 1], "utf-8")
    if data[end - 1] or "\0" in text:
        raise MisfitError(f"a string of {size} bytes at {start} not with one NUL, at its end")
    if limit and size - 1 > limit:
        raise MisfitError(f"expected up to {limit} bytes of text, got {size - 1}")
    return text


def read_numbers(data: Any, start: int, count: int, dtype: np.dtype[Any], max_count: int) -> Any:
    """Return ``count`` numbers as a view of the bytes, or for another byte order as a copy."""
    if max_count and count > max_count:
        raise MisfitError(f"expected up to {max_count} numbers, got {count}")
    if count * dtype.itemsize > len(data) - start:
        raise MisfitError(
            f"{count} numbers of {dtype} at {start}, where {len(data) - start} bytes are left"
        )
    if not count:
        return np.zeros(0, dtype.newbyteorder("="))
    return native_numbers(np.frombuffer(data, dtype, count, start))


def native_numbers(array: Numbers) -> Numbers:
    """Return numbers in this machine's byte order, after checking flags."""
    if array.dtype.kind == "b" and array.view(np.uint8).max() > 1:
        raise MisfitError("a flag is neither 0 nor 1")
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def checked_count(count: int, max_count: int, bytes_left: int) -> int:
    """Return the count of items that follow, after checking that each has at least a byte."""
    if max_count and count > max_count:
        raise MisfitError(f"expected up to {max_count} items, got {count}")
    if count > bytes_left:
        raise MisfitError(f"{count} items where {bytes_left} bytes are left")
    return count


class _Decoder(_Writer):
    def __init__(self, order: str) -> None:
        super().__init__(order)
        self.names |= {
            "F": _FLAG_OF_BYTE,
            "read_text": read_text,
            "read_numbers": read_numbers,
            "native_numbers": native_numbers,
            "frombuffer": np.frombuffer,
            "checked_count": checked_count,
        }

    def transfer(self, values: str) -> None:
        self.add_line(f"{values}, = s.unpack_from(data, pos)")

    def add_message(self, message_type: MessageType) -> str:
        """Write the lines that read a message; return the expression that creates it."""
        if not message_type.fields:
            self.add_fixed("B", 1, self.new_name())
        parts = [self.add_field(message_type, field) for field in message_type.fields]
        return f"{self.new_name(message_type.cls, 'C')}({', '.join(parts)})"

    def add_field(self, message_type: MessageType, field: MessageField) -> str:
        if field.shape:
            return self.add_array(message_type, field)
        if field.nested:
            return self.add_message(message_type.nested[field.type])
        name = self.new_name()
        if field.type == "string":
            size = self.new_name()
            self.add_fixed("I", 4, size)
            self.flush()
            self.add_line(f"{name} = read_text(data, pos, {size}, {field.limit})")
            self.add_line(f"pos += {size}")
            return name
        code = NUMBERS[field.type]
        flag = code == "?"
        self.add_fixed("B" if flag else code, _SIZES[code], name)
        return f"F[{name}]" if flag else name

    def add_array(self, message_type: MessageType, field: MessageField) -> str:
        is_fixed = field.shape == "array"
        name, count = self.new_name(), self.new_name()
        if field.type in NUMBERS:
            size = _SIZES[NUMBERS[field.type]]
            dtype = self.new_name(np.dtype(self.order + NUMBERS[field.type]), "D")
            if is_fixed:
                self.add_fixed(f"{field.size * size}s", size, name)
                return f"native_numbers(frombuffer({name}, {dtype}))"
            self.add_fixed("I", 4, count)
            self.flush()
            if size == 8:
                self.add_line(f"if {count}: pos += (4 - pos) & 7")
            self.add_line(f"{name} = read_numbers(data, pos, {count}, {dtype}, {field.size})")
            self.add_line(f"pos += {count} * {size}")
            return name
        if is_fixed:
            self.flush()
            self.add_line(f"{count} = {field.size}")
        else:
            self.add_fixed("I", 4, count)
            self.flush()
            self.add_line(f"checked_count({count}, {field.size}, len(data) - pos)")
        self.add_line(f"{name} = []")
        self.add_line(f"for _ in range({count}):")
        self.indent += 1
        expression = self.add_field(message_type, field._replace(shape="", size=0))
        self.flush()
        self.add_line(f"{name}.append({expression})")
        self.indent -= 1
        return name


def decoder(message_type: MessageType, order: str) -> Callable[[Any], tuple[Any, int]]:
    """Return the function that decodes a message, and returns it with the position of its end."""
    writer = _Decoder(order)
    writer.add_line(f"pos = {len(ENCAPSULATION)}")
    expression = writer.add_message(message_type)
    writer.flush()
    writer.add_line(f"return {expression}, pos")
    return writer.compile_function("def function(data):", f"decode {message_type.name}")
