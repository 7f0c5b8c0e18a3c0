"""Messages for a rosbridge: JSON with the fields of each type in ROS 1.

The types are ROS 2's. The tables of this module have ROS 1's other names; bytes are base64.
"""

from __future__ import annotations

import base64
import binascii
import json
import secrets
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from smartcam.exceptions import RosMessageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.ros2._inside import MessageField, MessageType

Part: TypeAlias = "str | Raw"

RENAMED: Final[Mapping[str, Mapping[str, str]]] = {
    "builtin_interfaces/msg/Time": {"sec": "secs", "nanosec": "nsecs"},
    "builtin_interfaces/msg/Duration": {"sec": "secs", "nanosec": "nsecs"},
    "sensor_msgs/msg/CameraInfo": {"d": "D", "k": "K", "r": "R", "p": "P"},
}
"""Fields that have another name in ROS 1, by type."""

ONLY_ROS1: Final[Mapping[str, Mapping[str, Any]]] = {"std_msgs/msg/Header": {"seq": 0}}
"""Fields that only ROS 1 has, and their values; rospy counts a header's ``seq`` itself."""

ONLY_ROS2: Final = frozenset(
    {"action_msgs", "composition_interfaces", "lifecycle_msgs", "rcl_interfaces", "rosgraph_msgs",
     "service_msgs", "statistics_msgs", "type_description_interfaces", "vision_msgs"}
)  # fmt: skip
"""Packages that ROS 1 does not have, or has with other fields."""

_ALLOWED: Final[Mapping[str, tuple[type, ...]]] = {
    "bool": (bool,),
    "string": (str,),
    "float32": (int, float),
    "float64": (int, float),
}
"""Python types of a JSON value, by the field's type; all others are integers."""

_BYTES: Final = ("uint8", "char")
_MARK: Final = secrets.token_hex(12)
_CHUNK: Final = 3 << 16  # a multiple of three, so that parts of base64 can be joined
_MAX_LEVELS = 32


class Raw:
    """Bytes that are encoded as base64 only when sent: not for a picture that is dropped."""

    __slots__ = ("data",)

    def __init__(self, data: Any) -> None:
        self.data: memoryview = memoryview(data).cast("B")

    def __len__(self) -> int:
        return (len(self.data) + 2) // 3 * 4

    def chunks(self) -> list[memoryview]:
        """Return the bytes in parts, each of which is encoded in a short time."""
        return [self.data[start : start + _CHUNK] for start in range(0, len(self.data), _CHUNK)]


def ros1_name(name: str) -> str | None:
    """Return a type's name in ROS 1 (``std_msgs/String``); None if ROS 1 has no such type."""
    package, _, short_name = name.partition("/")
    return None if package in ONLY_ROS2 else f"{package}/{short_name.rpartition('/')[2]}"


def to_json(kind: MessageType, message: Any) -> dict[str, Any]:
    """Return a message, or the mapping of its fields, as JSON values, with :class:`Raw` for bytes.

    Raises:
        RosMessageError: the value does not fit the type.
    """
    # the decoded copy is valid, and independent of the publisher's buffers
    return _fields(kind, kind.decode(kind.encode(message)))


def _fields(kind: MessageType, message: Any) -> dict[str, Any]:
    names = RENAMED.get(kind.name, {})
    made = dict(ONLY_ROS1.get(kind.name, {}))
    for field in kind.fields:
        value = getattr(message, field.attribute)
        made[names.get(field.name, field.name)] = _value(kind, field, value)
    if kind.name == "builtin_interfaces/msg/Time" and made["secs"] < 0:
        raise RosMessageError(f"{kind.name}: sec: ROS 1 has no time before 1970, got {message!r}")
    return made


def _value(kind: MessageType, field: MessageField, value: Any) -> Any:
    if field.nested:
        inner = kind.nested[field.type]
        return [_fields(inner, item) for item in value] if field.shape else _fields(inner, value)
    if not field.shape:
        return _signed(value) if field.type == "byte" else value
    if field.type in _BYTES:
        return Raw(value)
    items = value.tolist() if hasattr(value, "tolist") else list(value)
    return [_signed(item) for item in items] if field.type == "byte" else items


def _signed(value: int) -> int:
    """Return a byte for ROS 1, whose ``byte`` is an int8."""
    return value - 256 if value > 127 else int(value)


def from_json(kind: MessageType, data: Any) -> Any:
    """Return the message of a JSON value; missing fields are zero.

    Args:
        kind: type of the message.
        data: object of the fields, or array of the first fields' values in order.

    Raises:
        RosMessageError: the type does not have a field, or a value does not fit.
    """
    if isinstance(data, list):
        if len(data) > len(kind.fields):
            raise RosMessageError(
                f"{kind.name}: expected up to {len(kind.fields)} values, got {len(data)}"
            )
        names = RENAMED.get(kind.name, {})
        ordered = [names.get(field.name, field.name) for field in kind.fields]
        data = dict(zip(ordered, data, strict=False))
    message = kind.new(**_checked_fields(kind, data, "", _MAX_LEVELS))
    return kind.decode(kind.encode(message))  # makes numpy arrays and bytes, as in ROS 2


def _checked_fields(kind: MessageType, data: Any, where: str, depth: int) -> dict[str, Any]:
    """Return the fields of an object under their names in ROS 2; encoding checks the values."""
    if not isinstance(data, dict):
        raise RosMessageError(
            f"{kind.name}: {where or 'the whole'}: expected an object, got {data!r:.80}"
        )
    if not depth:
        raise RosMessageError(f"{kind.name}: {where}: nested too deep")
    names, only = RENAMED.get(kind.name, {}), ONLY_ROS1.get(kind.name, {})
    fields = {names.get(field.name, field.name): field for field in kind.fields}
    checked = dict[str, Any]()
    for name, value in data.items():
        if name in only:
            continue
        field = fields.get(name)
        if field is None:
            expected = ", ".join((*fields, *only)) or "none"
            raise RosMessageError(f"{kind.name}: {where}{name}: no such field, expected {expected}")
        checked[field.attribute] = _checked_value(kind, field, value, f"{where}{name}", depth)
    return checked


def _checked_value(
    kind: MessageType, field: MessageField, value: Any, where: str, depth: int
) -> Any:
    if field.shape and field.type in _BYTES and isinstance(value, str):
        try:
            return base64.b64decode(value, validate=True)
        except (binascii.Error, ValueError) as exc:
            raise RosMessageError(
                f"{kind.name}: {where}: expected base64, got {value!r:.80} ({exc})"
            ) from exc
    if field.shape and not isinstance(value, list):
        raise RosMessageError(f"{kind.name}: {where}: expected {field}, got {value!r:.80}")
    if not field.nested:
        allowed = _ALLOWED.get(field.type, (int,))
        values: list[Any] = value if field.shape else [value]
        for item in values:
            if type(item) not in allowed:
                raise RosMessageError(f"{kind.name}: {where}: expected {field}, got {item!r:.80}")
        if field.type == "byte":
            values = [item + 256 if -128 <= item < 0 else item for item in values]
        return values if field.shape else values[0]
    inner = kind.nested[field.type]
    if not field.shape:
        return _checked_fields(inner, value, f"{where}.", depth - 1)
    return [
        _checked_fields(inner, item, f"{where}[{n}].", depth - 1) for n, item in enumerate(value)
    ]


def encoded(operation: Mapping[str, Any]) -> tuple[Part, ...]:
    """Return the parts of an operation's text.

    Raises:
        RosMessageError: a number is not finite, which JSON cannot have.
    """
    raws: list[Raw] = []

    def place(value: Any) -> str:
        if not isinstance(value, Raw):
            raise TypeError(f"no JSON: {value!r:.80}")
        raws.append(value)
        return _MARK

    try:
        text = json.dumps(operation, default=place, allow_nan=False, separators=(",", ":"))
    except ValueError as exc:
        raise RosMessageError(
            f"{operation.get('topic') or operation.get('service')}: expected finite numbers, JSON "
            "has no others"
        ) from exc
    if not raws:
        return (text,)
    first, *others = text.split(_MARK)  # the quotation marks remain
    parts: list[Part] = [first]
    for raw, after in zip(raws, others, strict=True):
        parts += (raw, after)
    return tuple(parts)
