"""Values of ROS parameters: their types, ranges and encoding in messages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam.exceptions import ConfigurationError, RosMessageError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

TYPES: Final = (
    "not set",
    "bool",
    "integer",
    "double",
    "string",
    "byte_array",
    "bool_array",
    "integer_array",
    "double_array",
    "string_array",
)
"""The names of types by their numbers in messages (``rcl_interfaces/msg/ParameterType``)."""

NOT_SET, BOOL, INTEGER, DOUBLE, STRING, BYTES = range(6)
_ARRAY_OFFSET: Final = 5
"""Number of an array's type minus the number of its elements' type."""

_NUMBER_TYPES: Final = (INTEGER, DOUBLE)
_INT64: Final = (-(1 << 63), (1 << 63) - 1)

_MAX_DEVIATION: Final = 1e-9
"""Largest deviation of a double from a bound, or from a step, relative to it."""


@dataclass(frozen=True, slots=True)
class ParameterDescription:
    """The description of a parameter, without its value.

    Attributes:
        name: name of the parameter.
        type: name of the type, such as ``integer`` or ``double_array``.
        description: explanation for people.
        read_only: whether it cannot be set.
        minimum, maximum: bounds of a number; None for no bound.
        step: step of a number from the minimum on; None for any value.
        constraints: further constraints, for people.
        dynamic: whether the type may change.
    """

    name: str
    type: str
    description: str = ""
    read_only: bool = False
    minimum: float | None = None
    maximum: float | None = None
    step: float | None = None
    constraints: str = ""
    dynamic: bool = False

    def check_range(self, value: Any) -> None:
        """Check that a number is in the range.

        Raises:
            ConfigurationError: the number is out of range.
        """
        if not isinstance(value, int | float) or self.minimum is None or self.maximum is None:
            return
        if self.type == TYPES[DOUBLE]:
            is_in_range = _is_double_in_range(
                float(value), self.minimum, self.maximum, self.step or 0.0
            )
        else:
            first, step = int(self.minimum), int(self.step or 0)
            is_in_range = first <= value <= self.maximum and not (
                step and value != self.maximum and (int(value) - first) % step
            )
        if not is_in_range:
            step_text = f" in steps of {self.step}" if self.step else ""
            raise ConfigurationError(
                f"parameter {self.name!r}: {value} is out of its range: expected {self.minimum} "
                f"to {self.maximum}{step_text}"
            )

    def encode(self) -> dict[str, Any]:
        """Return the fields of a ``rcl_interfaces/msg/ParameterDescriptor``."""
        fields: dict[str, Any] = {
            "name": self.name,
            "type": TYPES.index(self.type),
            "description": self.description,
            "additional_constraints": self.constraints,
            "read_only": self.read_only,
            "dynamic_typing": self.dynamic,
        }
        if self.minimum is not None and self.maximum is not None:
            field = "integer_range" if self.type == TYPES[INTEGER] else "floating_point_range"
            fields[field] = [
                {"from_value": self.minimum, "to_value": self.maximum, "step": self.step or 0}
            ]
        return fields

    @classmethod
    def decode(cls, message: Any) -> ParameterDescription:
        """Read a description from a ``rcl_interfaces/msg/ParameterDescriptor``.

        Raises:
            RosMessageError: there is no such type.
        """
        ranges = message.integer_range or message.floating_point_range
        return cls(
            message.name,
            type_name(message.type),
            message.description,
            message.read_only,
            ranges[0].from_value if ranges else None,
            ranges[0].to_value if ranges else None,
            (ranges[0].step or None) if ranges else None,
            message.additional_constraints,
            message.dynamic_typing,
        )


def _is_double_in_range(value: float, first: float, last: float, step: float) -> bool:
    if math.isclose(value, first, rel_tol=_MAX_DEVIATION) or math.isclose(
        value, last, rel_tol=_MAX_DEVIATION
    ):
        return True
    if not first <= value <= last:
        return False
    if not step:
        return True
    if not math.isfinite(value):
        return False
    nearest = first + round((value - first) / step) * step
    return math.isclose(value, nearest, rel_tol=_MAX_DEVIATION, abs_tol=_MAX_DEVIATION * step)


def checked_range(
    name: str, type_number: int, minimum: float | None, maximum: float | None, step: float | None
) -> tuple[float | None, float | None, float | None]:
    """Return minimum, maximum and step of a declared range; without a range all are None.

    Raises:
        ConfigurationError: a bound is not valid, or the range is empty.
    """
    if minimum is None and maximum is None and step is None:
        return None, None, None
    if type_number not in _NUMBER_TYPES:
        raise ConfigurationError(
            f"parameter {name!r}: {TYPES[type_number]} has no range: expected integer or double"
        )
    lowest, highest = _INT64 if type_number == INTEGER else (-math.inf, math.inf)
    first, last = lowest if minimum is None else minimum, highest if maximum is None else maximum
    if step is not None and (minimum is None or not math.isfinite(minimum) or not step > 0):
        raise ConfigurationError(
            f"parameter {name!r}: step {step}: expected a number above 0, and a minimum"
        )
    if type_number == INTEGER:
        bounds = [bound for bound in (first, last, step) if bound is not None]
        too_large = [bound for bound in bounds if not _is_int64(bound)]
        if too_large:
            raise ConfigurationError(
                f"parameter {name!r}: a range of {too_large[0]}: expected whole numbers of 64 bits"
            )
    else:
        first, last, step = float(first), float(last), None if step is None else float(step)
    if not first <= last:
        raise ConfigurationError(f"parameter {name!r}: nothing is in {first} to {last}")
    return first, last, step


def _is_int64(value: float) -> bool:
    return (
        isinstance(value, int) and not isinstance(value, bool) and _INT64[0] <= value <= _INT64[1]
    )


def type_name(type_number: int) -> str:
    """Return a type's name.

    Raises:
        RosMessageError: there is no type of this number.
    """
    if not 0 <= type_number < len(TYPES):
        raise RosMessageError(
            f"parameter type {type_number}: expected 0 to {len(TYPES) - 1}, as ParameterType has"
        )
    return TYPES[type_number]


class Typed(NamedTuple):
    """A value with the number of its type. Arrays are tuples; a value that is not set is None."""

    type_number: int
    value: Any

    @property
    def type(self) -> str:
        """The name of the value's type."""
        return TYPES[self.type_number]

    def __str__(self) -> str:
        return f"{self.type} {self.value!r:.80}"


def typed_value(name: str, value: object, declared: int = NOT_SET) -> Typed:
    """Return a value with its type.

    Args:
        name: name of the parameter, for texts.
        value: a value of Python or numpy, or a :class:`Typed` value.
        declared: number of the type of a list without elements.

    Raises:
        ConfigurationError: the value cannot be a parameter.
    """
    if isinstance(value, Typed):
        return value
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return _typed_array(name, value, declared)
    type_number = _type_number(type(value))
    if type_number == NOT_SET:
        raise ConfigurationError(
            f"parameter {name!r}: got {type(value).__name__}, expected bool, int, float, str, "
            "bytes, or a list of bool, int, float or str"
        )
    _check_elements(name, type_number, (value,))
    return Typed(type_number, _PYTHON_TYPES[type_number](value))


def _typed_array(name: str, value: Sequence[Any], declared: int) -> Typed:
    if not value:
        if declared < BYTES:
            raise ConfigurationError(
                f"parameter {name!r}: a list without elements: expected its type, too"
            )
        return Typed(declared, b"" if declared == BYTES else ())
    type_numbers = {_type_number(kind) for kind in set(map(type, value))}
    type_number = type_numbers.pop()
    if type_numbers or not BOOL <= type_number <= STRING:
        names = sorted({type(value).__name__ for value in value})
        raise ConfigurationError(
            f"parameter {name!r}: expected a list of bool, of int, of float or of str, got "
            f"{', '.join(names)}"
        )
    _check_elements(name, type_number, value)
    return Typed(type_number + _ARRAY_OFFSET, tuple(map(_PYTHON_TYPES[type_number], value)))


_PYTHON_TYPES: Final[dict[int, Callable[[Any], Any]]] = {
    BOOL: bool, INTEGER: int, DOUBLE: float, STRING: str, BYTES: bytes,
}  # fmt: skip


def _type_number(python_type: type) -> int:
    for number, type_ in ((BOOL, bool), (INTEGER, int), (DOUBLE, float), (STRING, str)):
        if issubclass(python_type, type_):
            return number
    return BYTES if issubclass(python_type, bytes | bytearray) else NOT_SET


def _check_elements(name: str, type_number: int, value: Sequence[Any]) -> None:
    if type_number == INTEGER and not (_is_int64(min(value)) and _is_int64(max(value))):
        raise ConfigurationError(f"parameter {name!r}: expected integers of 64 bits")
    if type_number == STRING:
        text = "".join(value)
        try:
            text.encode()
        except UnicodeEncodeError as exc:
            raise ConfigurationError(f"parameter {name!r}: {text!r:.80}: {exc.reason}") from exc
        if "\0" in text:
            raise ConfigurationError(f"parameter {name!r}: {text!r:.80}: expected text without NUL")


def encode_value(value: Typed) -> dict[str, Any]:
    """Return the fields of a ``rcl_interfaces/msg/ParameterValue``."""
    plain = value.value
    field = f"{value.type}_value"
    return {"type": value.type_number, field: list(plain) if isinstance(plain, tuple) else plain}


def decode_value(message: Any) -> Typed:
    """Read a ``rcl_interfaces/msg/ParameterValue``.

    Raises:
        RosMessageError: there is no such type.
    """
    type_number = int(message.type)
    name = type_name(type_number)
    if type_number == NOT_SET:
        return Typed(type_number, None)
    value = getattr(message, f"{name}_value")
    if type_number == BYTES:
        return Typed(type_number, bytes(value))
    if type_number > BYTES:
        value = tuple(value.tolist() if isinstance(value, np.ndarray) else value)
    return Typed(type_number, value)
