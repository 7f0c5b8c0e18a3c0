"""Messages for a rosbridge: JSON with the fields of each type in ROS 1.

Types are those of ROS 2. Tables of this module have the fields and packages in which ROS 1 differs.
Bytes are sent as base64.
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

TextPart: TypeAlias = "str | RawBytes"

RENAMED_FIELDS: Final[Mapping[str, Mapping[str, str]]] = {
    "builtin_interfaces/msg/Time": {"sec": "secs", "nanosec": "nsecs"},
    "builtin_interfaces/msg/Duration": {"sec": "secs", "nanosec": "nsecs"},
    "sensor_msgs/msg/CameraInfo": {"d": "D", "k": "K", "r": "R", "p": "P"},
}
"""Fields that have another name in ROS 1, by type."""

FIELDS_ONLY_IN_ROS1: Final[Mapping[str, Mapping[str, Any]]] = {"std_msgs/msg/Header": {"seq": 0}}
"""Fields that only ROS 1 has, with the values to send; rospy replaces a header's ``seq``."""

PACKAGES_ONLY_IN_ROS2: Final = frozenset(
    {"action_msgs", "composition_interfaces", "lifecycle_msgs", "rcl_interfaces", "rosgraph_msgs",
     "service_msgs", "statistics_msgs", "type_description_interfaces", "vision_msgs"}
)  # fmt: skip
"""Packages that ROS 1 does not have, or has with other fields."""

_JSON_TYPES: Final[Mapping[str, tuple[type, ...]]] = {
    "bool": (bool,),
    "string": (str,),
    "float32": (int, float),
    "float64": (int, float),
}
"""Python types that a JSON value may have, by the field's type; other fields are integers."""

_BYTE_TYPES: Final = ("uint8", "char")
_PLACEHOLDER: Final = secrets.token_hex(12)
_CHUNK_BYTES: Final = 3 << 16  # a multiple of three, so that parts of base64 can be joined
_MAX_NESTING = 32


class RawBytes:
    """Bytes that become base64 only when they are sent: a dropped picture is never encoded."""

    __slots__ = ("data",)

    def __init__(self, data: Any) -> None:
        self.data: memoryview = memoryview(data).cast("B")

    def __len__(self) -> int:
        return (len(self.data) + 2) // 3 * 4

    def chunks(self) -> list[memoryview]:
        """Return the bytes in parts that are short enough to be encoded in one turn of the loop."""
        return [
            self.data[start : start + _CHUNK_BYTES]
            for start in range(0, len(self.data), _CHUNK_BYTES)
        ]


def ros1_name(name: str) -> str | None:
    """Return a type's name in ROS 1 (``std_msgs/String``); None if ROS 1 has no such type."""
    package, _, short_name = name.partition("/")
    return (
        None if package in PACKAGES_ONLY_IN_ROS2 else f"{package}/{short_name.rpartition('/')[2]}"
    )


def to_json(message_type: MessageType, message: Any) -> dict[str, Any]:
    """Return the JSON values, and :class:`RawBytes`, of a message or of a mapping of its fields.

    Raises:
        RosMessageError: the value does not fit the type.
    """
    # the decoded copy is valid, and independent of the publisher's buffers
    return _to_json_fields(message_type, message_type.decode(message_type.encode(message)))


def _to_json_fields(message_type: MessageType, message: Any) -> dict[str, Any]:
    names = RENAMED_FIELDS.get(message_type.name, {})
    fields = dict(FIELDS_ONLY_IN_ROS1.get(message_type.name, {}))
    for field in message_type.fields:
        value = getattr(message, field.attribute)
        fields[names.get(field.name, field.name)] = _to_json_value(message_type, field, value)
    if message_type.name == "builtin_interfaces/msg/Time" and fields["secs"] < 0:
        raise RosMessageError(
            f"{message_type.name}: sec: ROS 1 has no time before 1970, got {message!r}"
        )
    return fields


def _to_json_value(message_type: MessageType, field: MessageField, value: Any) -> Any:
    if field.nested:
        nested_type = message_type.nested[field.type]
        return (
            [_to_json_fields(nested_type, item) for item in value]
            if field.shape
            else _to_json_fields(nested_type, value)
        )
    if not field.shape:
        return _signed(value) if field.type == "byte" else value
    if field.type in _BYTE_TYPES:
        return RawBytes(value)
    items = value.tolist() if hasattr(value, "tolist") else list(value)
    return [_signed(item) for item in items] if field.type == "byte" else items


def _signed(value: int) -> int:
    """Return a byte as ROS 1 writes it: its type ``byte`` is an int8."""
    return value - 256 if value > 127 else int(value)


def from_json(message_type: MessageType, data: Any) -> Any:
    """Return the message of a JSON value; missing fields are zero.

    Args:
        message_type: type of the message.
        data: object of the fields, or array of the first fields' values in order.

    Raises:
        RosMessageError: the type does not have a field, or a value does not fit.
    """
    if isinstance(data, list):
        if len(data) > len(message_type.fields):
            raise RosMessageError(
                f"{message_type.name}: expected up to {len(message_type.fields)} values, "
                f"got {len(data)}"
            )
        names = RENAMED_FIELDS.get(message_type.name, {})
        field_names = [names.get(field.name, field.name) for field in message_type.fields]
        data = dict(zip(field_names, data, strict=False))
    message = message_type.new(**_checked_fields(message_type, data, "", _MAX_NESTING))
    return message_type.decode(
        message_type.encode(message)
    )  # makes numpy arrays and bytes, as in ROS 2


def _checked_fields(message_type: MessageType, data: Any, path: str, depth: int) -> dict[str, Any]:
    """Return the fields of an object by their names in ROS 2; encoding checks the values."""
    if not isinstance(data, dict):
        raise RosMessageError(
            f"{message_type.name}: {path or 'the whole'}: expected an object, got {data!r:.80}"
        )
    if not depth:
        raise RosMessageError(f"{message_type.name}: {path}: nested too deep")
    names, ros1_fields = (
        RENAMED_FIELDS.get(message_type.name, {}),
        FIELDS_ONLY_IN_ROS1.get(message_type.name, {}),
    )
    fields = {names.get(field.name, field.name): field for field in message_type.fields}
    checked = dict[str, Any]()
    for name, value in data.items():
        if name in ros1_fields:
            continue
        field = fields.get(name)
        if field is None:
            expected = ", ".join((*fields, *ros1_fields)) or "none"
            raise RosMessageError(
                f"{message_type.name}: {path}{name}: no such field, expected {expected}"
            )
        checked[field.attribute] = _checked_value(
            message_type, field, value, f"{path}{name}", depth
        )
    return checked


def _checked_value(
    message_type: MessageType, field: MessageField, value: Any, path: str, depth: int
) -> Any:
    if field.shape and field.type in _BYTE_TYPES and isinstance(value, str):
        try:
            return base64.b64decode(value, validate=True)
        except (binascii.Error, ValueError) as exc:
            raise RosMessageError(
                f"{message_type.name}: {path}: expected base64, got {value!r:.80} ({exc})"
            ) from exc
    if field.shape and not isinstance(value, list):
        raise RosMessageError(f"{message_type.name}: {path}: expected {field}, got {value!r:.80}")
    if not field.nested:
        allowed = _JSON_TYPES.get(field.type, (int,))
        values: list[Any] = value if field.shape else [value]
        for item in values:
            if type(item) not in allowed:
                raise RosMessageError(
                    f"{message_type.name}: {path}: expected {field}, got {item!r:.80}"
                )
        if field.type == "byte":
            values = [item + 256 if -128 <= item < 0 else item for item in values]
        return values if field.shape else values[0]
    nested_type = message_type.nested[field.type]
    if not field.shape:
        return _checked_fields(nested_type, value, f"{path}.", depth - 1)
    return [
        _checked_fields(nested_type, item, f"{path}[{n}].", depth - 1)
        for n, item in enumerate(value)
    ]


def encode_operation(operation: Mapping[str, Any]) -> tuple[TextPart, ...]:
    """Return the text of an operation in parts: JSON, and bytes that become base64 later.

    Raises:
        RosMessageError: a number is not finite, which JSON cannot have.
    """
    raw_bytes: list[RawBytes] = []

    def put_placeholder(value: Any) -> str:
        if not isinstance(value, RawBytes):
            raise TypeError(f"no JSON: {value!r:.80}")
        raw_bytes.append(value)
        return _PLACEHOLDER

    try:
        text = json.dumps(
            operation, default=put_placeholder, allow_nan=False, separators=(",", ":")
        )
    except ValueError as exc:
        raise RosMessageError(
            f"{operation.get('topic') or operation.get('service')}: expected finite numbers, JSON "
            "has no others"
        ) from exc
    if not raw_bytes:
        return (text,)
    start, *rest = text.split(_PLACEHOLDER)  # the quotation marks remain
    parts: list[TextPart] = [start]
    for raw, after in zip(raw_bytes, rest, strict=True):
        parts += (raw, after)
    return tuple(parts)
