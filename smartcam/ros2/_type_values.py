"""Messages as objects of Python: their classes, zero values, and what may stand in a field."""

from __future__ import annotations

import operator
import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import RosMessageError
from smartcam.ros2._type_codec import MisfitError, counted, packed, text_bytes
from smartcam.ros2._type_definitions import INTEGERS, NUMBERS, Definition, MessageField

if TYPE_CHECKING:
    from smartcam.ros2._types import MessageType


class RosMessage:
    """A message: one attribute for each field, constants on its class.

    Numbers in sequences and arrays are numpy arrays (or what was put there); bytes may stand for
    ``uint8[]``.
    """

    __slots__ = ()
    __msgtype__: ClassVar[str] = ""
    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RosMessage) or other.__msgtype__ != self.__msgtype__:
            return NotImplemented
        return all(_same(getattr(self, one), getattr(other, one)) for one in self.__slots__)

    def __repr__(self) -> str:
        parts = (f"{one}={_shown(getattr(self, one))}" for one in self.__slots__)
        return f"{type(self).__name__}({', '.join(parts)})"


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        if isinstance(one, bytes | bytearray | memoryview):
            one = np.frombuffer(one, np.uint8)
        if isinstance(other, bytes | bytearray | memoryview):
            other = np.frombuffer(other, np.uint8)
        return np.array_equal(one, other)
    return bool(one == other)


def _shown(value: Any) -> str:
    if isinstance(value, np.ndarray):
        text = ", ".join(map(str, value[:4].tolist()))
        return f"[{text}{f', ... {len(value)}' if len(value) > 4 else ''}]"
    if isinstance(value, bytes | bytearray | memoryview) and len(value) > 16:
        return f"<{len(value)} bytes>"
    return repr(value)


def message_class(definition: Definition) -> type[RosMessage]:
    """Return the class of a message; made with its fields in order."""
    names = tuple(field.attribute for field in definition.fields)
    body = "".join(f"\n    self.{name} = {name}" for name in names) or "\n    pass"
    scope: dict[str, Any] = {}
    exec(f"def __init__(self{''.join(f', {name}' for name in names)}):{body}", scope)  # noqa: S102
    return type(
        definition.name.rpartition("/")[2],
        (RosMessage,),
        {
            "__slots__": names,
            "__init__": scope["__init__"],
            "__msgtype__": definition.name,
            "__doc__": definition.name,
            "__module__": __name__,
            **{name: value for name, value in definition.constants.items() if name not in names},
        },
    )


def zero(kind: MessageType, field: MessageField) -> Any:
    """Return what a field is when nothing is said: its default, or zero."""
    default = field.default
    if field.shape:
        count = field.size if field.shape == "array" else 0
        if field.type in NUMBERS:
            dtype = np.dtype(f"={NUMBERS[field.type]}")
            return np.zeros(count, dtype) if default is None else np.array(default, dtype)
        if default is not None:
            return list(default)
        return [zero(kind, field._replace(shape="")) for _ in range(count)]
    if field.nested:
        return kind.nested[field.type].new()
    if default is not None:
        return default
    if field.type == "string":
        return ""
    return False if field.type == "bool" else 0 if field.type in INTEGERS else 0.0


def fitting(kind: MessageType, field: MessageField, value: Any, where: str) -> Any:
    """Return a field's value as it is kept: mappings become messages.

    Args:
        kind: the type that has the field.
        field: which.
        value: what it is to be.
        where: how the error text begins: type and place of the message, such as
            ``sensor_msgs/msg/Image: header.``.

    Raises:
        RosMessageError: it does not fit.
    """
    where = f"{where}{field.name}"
    try:
        if not field.shape:
            return _one(kind, field, value, where)
        least = field.size if field.shape == "array" else 0
        if field.type in NUMBERS:
            packed(value, NUMBERS[field.type], least, field.size)
            return value
        counted(value, least, field.size)
    except (MisfitError, struct.error, KeyError, TypeError, ValueError, OverflowError) as exc:
        raise RosMessageError(
            f"{where}: expected {field}, got {_shown(value):.80} ({exc})"
        ) from exc
    one = field._replace(shape="", size=0, name="")
    return [fitting(kind, one, item, f"{where}[{place}]") for place, item in enumerate(value)]


def _one(kind: MessageType, field: MessageField, value: Any, where: str) -> Any:
    if field.nested:
        nested = kind.nested[field.type]
        if isinstance(value, Mapping):
            return filled(nested, value, f"{where}.")
        if getattr(value, "__msgtype__", None) != nested.name:
            raise MisfitError(f"a {type(value).__name__}")
        return value
    if field.type == "string":
        text_bytes(value, field.limit)
    elif field.type == "bool":
        if value not in (True, False):
            raise MisfitError("neither True nor False")
        return bool(value)
    elif field.type in INTEGERS:
        value = operator.index(value)
        struct.pack(f"<{NUMBERS[field.type]}", value)
    else:
        struct.pack(f"<{NUMBERS[field.type]}", value)
        value = float(value)
    return value


def filled(kind: MessageType, fields: Mapping[str, Any], where: str = "") -> Any:
    """Return a message of these fields, zero elsewhere.

    Raises:
        RosMessageError: a field is not of the type, or does not fit.
    """
    where = where or f"{kind.name}: "
    known = {field.attribute: field for field in kind.fields}
    for name in fields:
        if name not in known:
            raise RosMessageError(
                f"{where}{name}: {kind.name} has no such field, expected "
                f"{', '.join(known) or 'none'}{did_you_mean(str(name), known)}"
            )
    return kind.cls(
        *(
            fitting(kind, field, fields[name], where) if name in fields else zero(kind, field)
            for name, field in known.items()
        )
    )


def check(kind: MessageType, message: Any, where: str = "") -> None:
    """Look at every field of a message, to say what is wrong with it.

    Raises:
        RosMessageError: a field is missing or does not fit.
    """
    where = where or f"{kind.name}: "
    for field in kind.fields:
        try:
            value = getattr(message, field.attribute)
        except AttributeError:
            raise RosMessageError(
                f"{where}{field.name}: expected {field}, got none: a {type(message).__name__} has "
                "no such field"
            ) from None
        fitting(kind, field, value, where)
        if field.nested:
            for place, one in enumerate(value if field.shape else [value]):
                index = f"[{place}]" if field.shape else ""
                check(kind.nested[field.type], one, f"{where}{field.name}{index}.")
