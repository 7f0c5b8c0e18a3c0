"""CDR: generate the functions that encode and decode messages of a type, when they are needed.

Consecutive fields of fixed size are packed at once. The position of such a run depends on the
message, so each run has eight forms, one for each position modulo 8; the four bytes of the
encapsulation do not count for alignment.
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

HEAD: Final = b"\0\1\0\0"
_FLAGS: Final = {True: 1, False: 0}
_SIZES: Final = {code: struct.calcsize(f"<{code}") for code in "bBhHiIqQfd?"}


class MisfitError(ValueError):
    """Bytes or a value do not fit; only within this package."""


@functools.lru_cache(4096)
def _forms(parts: tuple[tuple[str, int], ...], order: str) -> tuple[struct.Struct, ...]:
    """Return the eight forms of a run of ``(code of struct, alignment)``."""
    return tuple(_form(parts, order, start - len(HEAD)) for start in range(8))


def _form(parts: tuple[tuple[str, int], ...], order: str, place: int) -> struct.Struct:
    text = [order]
    for code, alignment in parts:
        pad = -place % alignment
        text.append("x" * pad + code)
        place += pad + (int(code[:-1]) if code.endswith("s") else _SIZES[code])
    return struct.Struct("".join(text))


class _Writer:
    """Lines of a function: the common part of encoder and decoder."""

    def __init__(self, order: str) -> None:
        self.order = order
        self.lines: list[str] = []
        self.names: dict[str, Any] = {}
        self.indent = 1
        self.count = 0
        self.run: list[tuple[str, int]] = []
        self.values: list[str] = []

    def name(self, value: Any = None, prefix: str = "v") -> str:
        self.count += 1
        name = f"{prefix}{self.count}"
        if value is not None:
            self.names[name] = value
        return name

    def line(self, text: str) -> None:
        self.lines.append("    " * self.indent + text)

    def fixed(self, code: str, alignment: int, value: str) -> None:
        self.run.append((code, alignment))
        self.values.append(value)

    def flush(self) -> None:
        if self.run:
            forms = self.name(_forms(tuple(self.run), self.order), "R")
            self.line(f"s = {forms}[pos & 7]")
            self.move(", ".join(self.values))
            self.line("pos += s.size")
            self.run, self.values = [], []

    def move(self, values: str) -> None:
        raise NotImplementedError

    def compiled(self, head: str, title: str) -> Callable[..., Any]:
        source = "\n".join([head, *self.lines])
        scope: dict[str, Any] = dict(self.names)
        exec(compile(source, f"<{title}>", "exec"), scope)  # noqa: S102
        function: Callable[..., Any] = scope["function"]
        return function


# -- encoding -----------------------------------------------------------------------------------


def packed(value: Any, code: str, least: int, most: int) -> Any:
    """Return the bytes of ``least`` to ``most`` numbers (0 for any number of them)."""
    if isinstance(value, bytes | bytearray | memoryview):
        if code not in "bB":
            raise MisfitError(f"bytes are no numbers of {code}")
        data: Any = bytes(value) if least or not value else memoryview(value).cast("B")
        count = len(data)
    elif isinstance(value, np.ndarray):
        if value.ndim != 1:
            raise MisfitError(f"expected numbers in one row, got {value.shape}")
        count = len(value)
        array = _array(value, np.dtype(f"<{code}"))
        data = array.tobytes() if least else array.view(np.uint8)
    else:
        if isinstance(value, str | dict):
            raise MisfitError(f"expected numbers, got {type(value).__name__}")
        if code == "?":
            value = [_FLAGS[flag] for flag in value]
        data = struct.pack(f"<{len(value)}{code}", *value)
        count = len(value)
    if count < least or (most and count > most):
        raise MisfitError(f"expected {least or f'up to {most}'} numbers, got {count}")
    return data


def _array(value: Numbers, kind: np.dtype[Any]) -> Numbers:
    if value.dtype != kind:
        if kind.kind == "f" and value.dtype.kind in "fiu":
            with np.errstate(over="ignore"):
                cast = value.astype(kind)
            if bool(np.any(np.isinf(cast) & np.isfinite(value))):
                raise MisfitError(f"numbers out of the range of {kind}")
        elif kind.kind in "iu" and value.dtype.kind in "iu":
            limits = np.iinfo(kind)
            if value.size and not (limits.min <= value.min() and value.max() <= limits.max):
                raise MisfitError(f"numbers out of the range of {kind}")
            cast = value.astype(kind)
        else:
            raise MisfitError(f"expected an array of {kind}, got {value.dtype}")
        value = cast
    return np.ascontiguousarray(value)


def text_bytes(text: str, limit: int) -> bytes:
    """Return a string's bytes with its end."""
    if not isinstance(text, str):
        raise MisfitError(f"expected a string, got {type(text).__name__}")
    if "\0" in text:
        raise MisfitError("a string with NUL in it")
    data = text.encode()
    if limit and len(data) > limit:
        raise MisfitError(f"expected up to {limit} bytes of text, got {len(data)}")
    return data + b"\0"


def counted(value: Any, least: int, most: int) -> int:
    """Return the number of messages or strings in a list, after checking it against its bounds."""
    if not isinstance(value, list | tuple):
        raise MisfitError(f"expected a list, got {type(value).__name__}")
    count = len(value)
    if count < least or (most and count > most):
        raise MisfitError(f"expected {least or f'up to {most}'}, got {count}")
    return count


class _Encoder(_Writer):
    def __init__(self) -> None:
        super().__init__("<")
        self.names |= {"F": _FLAGS, "packed": packed, "text_bytes": text_bytes, "counted": counted}

    def move(self, values: str) -> None:
        self.line(f"put(s.pack({values}))")

    def message(self, kind: MessageType, value: str) -> None:
        if not kind.fields:
            self.fixed("B", 1, "0")
        for field in kind.fields:
            self.field(kind, field, f"{value}.{field.attribute}")

    def field(self, kind: MessageType, field: MessageField, value: str) -> None:
        if field.shape:
            self.many(kind, field, value)
        elif field.nested:
            name = self.name()
            self.line(f"{name} = {value}")
            self.message(kind.nested[field.type], name)
        elif field.type == "string":
            name = self.name()
            self.line(f"{name} = text_bytes({value}, {field.limit})")
            self.fixed("I", 4, f"len({name})")
            self.flush()
            self.line(f"put({name})")
            self.line(f"pos += len({name})")
        else:
            code = NUMBERS[field.type]
            flag = code == "?"
            self.fixed("B" if flag else code, _SIZES[code], f"F[{value}]" if flag else value)

    def many(self, kind: MessageType, field: MessageField, value: str) -> None:
        array = field.shape == "array"
        least = field.size if array else 0
        name = self.name()
        if field.type in NUMBERS:
            code = NUMBERS[field.type]
            size = _SIZES[code]
            self.line(f"{name} = packed({value}, {code!r}, {least}, {field.size})")
            if array:
                self.fixed(f"{field.size * size}s", size, name)
                return
            self.fixed("I", 4, f"len({name}) // {size}")
            self.flush()
            if size == 8:
                self.line(f"if len({name}):")
                self.indent += 1
                self.fixed("0s", size, "b''")
                self.flush()
                self.indent -= 1
            self.line(f"put({name})")
            self.line(f"pos += len({name})")
            return
        item = self.name()
        self.line(f"{name} = {value}")
        count = self.name()
        self.line(f"{count} = counted({name}, {least}, {field.size})")
        if not array:
            self.fixed("I", 4, count)
        self.flush()
        self.line(f"for {item} in {name}:")
        self.indent += 1
        self.field(kind, field._replace(shape="", size=0), item)
        self.flush()
        self.indent -= 1


def encoder(kind: MessageType) -> Callable[[Any], bytes]:
    """Return the function that encodes a message; it raises MisfitError and other errors."""
    writer = _Encoder()
    writer.names["HEAD"] = HEAD
    writer.line("parts = [HEAD]")
    writer.line("put = parts.append")
    writer.line(f"pos = {len(HEAD)}")
    writer.message(kind, "m")
    writer.flush()
    writer.line("return b''.join(parts)")
    return writer.compiled("def function(m):", f"encode {kind.name}")


# -- decoding -----------------------------------------------------------------------------------

_FLAG_OF: Final = (False, True)


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
        raise MisfitError(f"a string of {size} bytes at {start} without NUL at its end, or within")
    if limit and size - 1 > limit:
        raise MisfitError(f"expected up to {limit} bytes of text, got {size - 1}")
    return text


def read_numbers(data: Any, start: int, count: int, kind: np.dtype[Any], most: int) -> Any:
    """Return ``count`` numbers as a view of the bytes, or for another byte order as a copy."""
    if most and count > most:
        raise MisfitError(f"expected up to {most} numbers, got {count}")
    if count * kind.itemsize > len(data) - start:
        raise MisfitError(
            f"{count} numbers of {kind} at {start}, where {len(data) - start} bytes are left"
        )
    if not count:
        return np.zeros(0, kind.newbyteorder("="))
    return own_numbers(np.frombuffer(data, kind, count, start))


def own_numbers(array: Numbers) -> Numbers:
    """Return numbers in this machine's byte order, after checking flags."""
    if array.dtype.kind == "b" and array.view(np.uint8).max() > 1:
        raise MisfitError("a flag is neither 0 nor 1")
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def checked_count(count: int, most: int, left: int) -> int:
    """Return the number of following items, after checking that a byte is left for each."""
    if most and count > most:
        raise MisfitError(f"expected up to {most} items, got {count}")
    if count > left:
        raise MisfitError(f"{count} items where {left} bytes are left")
    return count


class _Decoder(_Writer):
    def __init__(self, order: str) -> None:
        super().__init__(order)
        self.names |= {
            "F": _FLAG_OF,
            "read_text": read_text,
            "read_numbers": read_numbers,
            "own_numbers": own_numbers,
            "frombuffer": np.frombuffer,
            "checked_count": checked_count,
        }

    def move(self, values: str) -> None:
        self.line(f"{values}, = s.unpack_from(data, pos)")

    def message(self, kind: MessageType) -> str:
        """Write the lines that read a message; return the expression that creates it."""
        if not kind.fields:
            self.fixed("B", 1, self.name())
        parts = [self.field(kind, field) for field in kind.fields]
        return f"{self.name(kind.cls, 'C')}({', '.join(parts)})"

    def field(self, kind: MessageType, field: MessageField) -> str:
        if field.shape:
            return self.many(kind, field)
        if field.nested:
            return self.message(kind.nested[field.type])
        name = self.name()
        if field.type == "string":
            size = self.name()
            self.fixed("I", 4, size)
            self.flush()
            self.line(f"{name} = read_text(data, pos, {size}, {field.limit})")
            self.line(f"pos += {size}")
            return name
        code = NUMBERS[field.type]
        flag = code == "?"
        self.fixed("B" if flag else code, _SIZES[code], name)
        return f"F[{name}]" if flag else name

    def many(self, kind: MessageType, field: MessageField) -> str:
        array = field.shape == "array"
        name, count = self.name(), self.name()
        if field.type in NUMBERS:
            size = _SIZES[NUMBERS[field.type]]
            dtype = self.name(np.dtype(self.order + NUMBERS[field.type]), "D")
            if array:
                self.fixed(f"{field.size * size}s", size, name)
                return f"own_numbers(frombuffer({name}, {dtype}))"
            self.fixed("I", 4, count)
            self.flush()
            if size == 8:
                self.line(f"if {count}: pos += (4 - pos) & 7")
            self.line(f"{name} = read_numbers(data, pos, {count}, {dtype}, {field.size})")
            self.line(f"pos += {count} * {size}")
            return name
        if array:
            self.flush()
            self.line(f"{count} = {field.size}")
        else:
            self.fixed("I", 4, count)
            self.flush()
            self.line(f"checked_count({count}, {field.size}, len(data) - pos)")
        self.line(f"{name} = []")
        self.line(f"for _ in range({count}):")
        self.indent += 1
        made = self.field(kind, field._replace(shape="", size=0))
        self.flush()
        self.line(f"{name}.append({made})")
        self.indent -= 1
        return name


def decoder(kind: MessageType, order: str) -> Callable[[Any], tuple[Any, int]]:
    """Return the function that decodes a message, and returns also the position of its end."""
    writer = _Decoder(order)
    writer.line(f"pos = {len(HEAD)}")
    made = writer.message(kind)
    writer.flush()
    writer.line(f"return {made}, pos")
    return writer.compiled("def function(data):", f"decode {kind.name}")
