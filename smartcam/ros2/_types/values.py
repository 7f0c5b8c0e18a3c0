"""Messages as Python objects: their classes, zero values, and the checks of fields."""

from __future__ import annotations

import dataclasses
import functools
import operator
import struct
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np

from smartcam._suggestions import did_you_mean
from smartcam.ros2._types.codec import MisfitError, checked_length, pack_numbers, text_bytes
from smartcam.ros2._types.definitions import INTEGERS, NUMBERS, Definition, MessageField

if TYPE_CHECKING:
    from smartcam.ros2._types.types import MessageType


class RosMessage:
    """A message: one attribute for each field, constants on its class.

    Sequences and arrays of numbers are numpy arrays (or the values that were assigned); ``uint8[]``
    may be bytes.
    """

    __slots__: tuple[str, ...] = ()
    __msgtype__: ClassVar[str] = ""
    __hash__: ClassVar[None]  # type: ignore[assignment]  # equal messages may change

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RosMessage) or other.__msgtype__ != self.__msgtype__:
            return NotImplemented
        return all(_are_equal(getattr(self, slot), getattr(other, slot)) for slot in self.__slots__)

    def __repr__(self) -> str:
        parts = (f"{slot}={_value_text(getattr(self, slot))}" for slot in self.__slots__)
        return f"{type(self).__name__}({', '.join(parts)})"


_MAX_SHOWN_ELEMENTS = 16
"""Number of elements or bytes above which a value is shown shortened."""


def _are_equal(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        if isinstance(one, bytes | bytearray | memoryview):
            one = np.frombuffer(one, np.uint8)
        if isinstance(other, bytes | bytearray | memoryview):
            other = np.frombuffer(other, np.uint8)
        return np.array_equal(one, other)
    return bool(one == other)


def _value_text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        text = ", ".join(map(str, value[:_MAX_SHOWN_ELEMENTS].tolist()))
        return f"[{text}{f', ... of {len(value)}' if len(value) > _MAX_SHOWN_ELEMENTS else ''}]"
    if (
        isinstance(value, bytes | bytearray | memoryview | list | tuple)
        and len(value) > _MAX_SHOWN_ELEMENTS
    ):
        return f"<{type(value).__name__} of {len(value)}>"
    return repr(value)


def message_class(definition: Definition) -> type[RosMessage]:
    """Return the class of a message; the constructor takes the fields in their order."""
    names = tuple(field.attribute for field in definition.fields)
    class_: type[RosMessage] = dataclasses.make_dataclass(
        definition.name.rpartition("/")[2],
        names,
        bases=(RosMessage,),
        namespace={
            "__msgtype__": definition.name,
            "__doc__": definition.name,
            "__module__": __name__,
            **{name: value for name, value in definition.constants.items() if name not in names},
        },
        eq=False,
        repr=False,
        slots=True,
    )
    return class_


class LocatedError(MisfitError):
    """A field's value does not fit; ``path`` has names and indices to it, the innermost first."""

    def __init__(self, text: str, path_step: str) -> None:
        super().__init__(text)
        self.path = [path_step]

    def __str__(self) -> str:
        return f"{''.join(reversed(self.path)).lstrip('.')}: {self.args[0]}"


def _with_place(
    exc: Exception, field: MessageField, value: Any, path_step: str = ""
) -> LocatedError:
    """Return an error with the path to its field, to which ``path_step`` is added."""
    if not isinstance(exc, LocatedError):
        return LocatedError(f"expected {field}, got {_value_text(value):.80} ({exc})", path_step)
    exc.path.append(path_step)
    return exc


_MISFIT_ERRORS: Final = (MisfitError, struct.error, KeyError, TypeError, ValueError, OverflowError)


# -- zero values --------------------------------------------------------------------------------


def zero_maker(message_type: MessageType) -> Callable[[], RosMessage]:
    """Return the function that creates a message of defaults and zeros."""
    create = message_type.cls
    makers = [_zero_value_maker(message_type, field) for field in message_type.fields]
    return lambda: create(*[make() for make in makers])


def _zero_value_maker(message_type: MessageType, field: MessageField) -> Callable[[], Any]:
    """Return the function that creates a field's default value."""
    if field.shape:
        return _zero_array_maker(message_type, field)
    if field.nested:
        return zero_maker(message_type.nested[field.type])
    default = _ZERO.get(field.type, 0) if field.default is None else field.default
    return lambda: default


def _zero_array_maker(message_type: MessageType, field: MessageField) -> Callable[[], Any]:
    """Return the function that creates the default value of an array or a sequence."""
    count = field.size if field.shape == "array" else 0
    if field.type in NUMBERS:
        dtype = np.dtype(f"={NUMBERS[field.type]}")
        default = field.default
        return (np.zeros(count, dtype) if default is None else np.array(default, dtype)).copy
    if field.default is not None:
        return functools.partial(list, field.default)
    make = _zero_value_maker(message_type, field._replace(shape=""))
    return lambda: [make() for _ in range(count)]


_ZERO: Final[dict[str, Any]] = {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}


# -- values of users ----------------------------------------------------------------------------


def fill_message(message_type: MessageType, fields: Mapping[str, Any]) -> Any:
    """Return a message with these fields; all others are defaults or zeros.

    Raises:
        LocatedError: the type has no such field, or a value does not fit.
    """
    message = message_type.zero()
    rules = message_type.rules
    for name, value in fields.items():
        if name not in rules:
            known = ", ".join(rules) or "none"
            close = did_you_mean(str(name), rules)
            text = f"{message_type.name} has no such field, expected {known}{close}"
            raise LocatedError(text, f".{name}")
        field, rule = rules[name]
        try:
            setattr(message, name, rule(value))
        except _MISFIT_ERRORS as exc:
            raise _with_place(exc, field, value, f".{field.name}") from exc
    return message


def value_rule(message_type: MessageType, field: MessageField) -> Callable[[Any], Any]:
    """Return the function that checks and converts a field's value: mappings become messages.

    It raises one of ``_MISFIT_ERRORS`` for a value that does not fit.
    """
    if not field.shape:
        return _single_value_rule(message_type, field)
    min_count = field.size if field.shape == "array" else 0
    if field.type in NUMBERS:
        code = NUMBERS[field.type]

        def numbers(value: Any) -> Any:
            pack_numbers(value, code, min_count, field.size)
            return value

        return numbers
    element = field._replace(shape="", size=0)
    rule = _single_value_rule(message_type, element)

    def check_elements(values: Any) -> list[Any]:
        checked_length(values, min_count, field.size)
        checked: list[Any] = []
        for index, value in enumerate(values):
            try:
                checked.append(rule(value))
            except _MISFIT_ERRORS as exc:
                raise _with_place(exc, element, value, f"[{index}]") from exc
        return checked

    return check_elements


def _single_value_rule(message_type: MessageType, field: MessageField) -> Callable[[Any], Any]:
    if field.type in _RULES:
        return _RULES[field.type]
    if field.type == "string":

        def text(value: Any) -> Any:
            text_bytes(value, field.limit)
            return value

        return text
    nested = message_type.nested[field.type]

    def message(value: Any) -> Any:
        if type(value) is dict or isinstance(value, Mapping):
            return fill_message(nested, value)
        if getattr(value, "__msgtype__", None) != nested.name:
            raise MisfitError(f"a {type(value).__name__}")
        return value

    return message


def _check_bool(value: Any) -> bool:
    if value not in (True, False):
        raise MisfitError("neither True nor False")
    return bool(value)


def _integer_rule(code: str) -> Callable[[Any], int]:
    def rule(value: Any) -> int:
        number = operator.index(value)
        pack(number)
        return number

    pack = struct.Struct(f"<{code}").pack
    return rule


def _check_float32(value: Any) -> float:
    struct.pack("<f", value)
    return float(value)


def _check_float64(value: Any) -> float:
    if type(value) is not float:
        struct.pack("<d", value)
    return float(value)


_RULES: Final[dict[str, Callable[[Any], Any]]] = {
    **{name: _integer_rule(code) for name, code in INTEGERS.items()},
    "bool": _check_bool,
    "float32": _check_float32,
    "float64": _check_float64,
}


def check_message(message_type: MessageType, message: Any) -> None:
    """Check every field of a message.

    Raises:
        LocatedError: a field is missing or does not fit.
    """
    for field, rule in message_type.rules.values():
        path_step = f".{field.name}"
        try:
            value = getattr(message, field.attribute)
        except AttributeError:
            text = f"expected {field}, got none: a {type(message).__name__} has no such field"
            raise LocatedError(text, path_step) from None
        try:
            rule(value)
        except _MISFIT_ERRORS as exc:
            raise _with_place(exc, field, value, path_step) from exc
        if field.nested:
            for number, item in enumerate(value if field.shape else [value]):
                try:
                    check_message(message_type.nested[field.type], item)
                except LocatedError as exc:
                    exc.path.append(f"{path_step}[{number}]" if field.shape else path_step)
                    raise
