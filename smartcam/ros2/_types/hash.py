"""RIHS01: the hash of a type's description, by which nodes check that they use the same type.

It is SHA-256 of JSON of the fields' names, types and order, and those of all nested types
(REP-2016), without constants and defaults.
"""

from __future__ import annotations

import hashlib
import json
from typing import TYPE_CHECKING, Any, Final

from smartcam.ros2._types.definitions import EMPTY_MESSAGE_FIELD, Definition, MessageField

if TYPE_CHECKING:
    from collections.abc import Callable

NOT_SUPPORTED: Final = "TypeHashNotSupported"
"""Text instead of a hash if the distribution has none."""

_NESTED: Final = 1
_IDS: Final = {
    "int8": 2, "uint8": 3, "int16": 4, "uint16": 5, "int32": 6, "uint32": 7, "int64": 8,
    "uint64": 9, "float32": 10, "float64": 11, "bool": 15, "byte": 16, "string": 17,
}  # fmt: skip
_BOUNDED_STRING: Final = 21
_ARRAY, _BOUNDED, _SEQUENCE = 48, 96, 144


def _field_description(field: MessageField) -> dict[str, Any]:
    number = _NESTED if field.nested else _IDS[field.type]
    if field.limit:
        number = _BOUNDED_STRING
    if field.shape:
        number += _ARRAY if field.shape == "array" else _BOUNDED if field.size else _SEQUENCE
    return {
        "name": field.name,
        "type": {
            "type_id": number,
            "capacity": field.size,
            "string_capacity": field.limit,
            "nested_type_name": field.type if field.nested else "",
        },
    }


def _type_description(definition: Definition) -> dict[str, Any]:
    fields = [_field_description(field) for field in definition.fields or (EMPTY_MESSAGE_FIELD,)]
    return {"type_name": definition.name, "fields": fields}


def describe_with_nested(
    definition: Definition, find: Callable[[str], Definition]
) -> dict[str, Any]:
    """Return the description of a type and of all nested types."""
    nested: dict[str, Definition] = {}
    missing = definition.nested_names()
    while missing:
        name = missing.pop()
        nested[name] = find(name)
        missing |= nested[name].nested_names() - nested.keys()
    return {
        "type_description": _type_description(definition),
        "referenced_type_descriptions": [
            _type_description(nested[name]) for name in sorted(nested) if name != definition.name
        ],
    }


def hash_of_description(full_description: dict[str, Any]) -> str:
    """Return the hash of a message or service, ``RIHS01_`` and 64 digits."""
    text = json.dumps(full_description)
    return f"RIHS01_{hashlib.sha256(text.encode()).hexdigest()}"


def event_definition(name: str) -> Definition:
    """Return the message that introspection publishes for a service; it is part of the hash."""
    return Definition(
        f"{name}_Event",
        (
            MessageField("info", "service_msgs/msg/ServiceEventInfo"),
            MessageField("request", f"{name}_Request", "sequence", 1),
            MessageField("response", f"{name}_Response", "sequence", 1),
        ),
        {},
        {},
    )


def service_definition(name: str) -> Definition:
    """Return the definition of a service from which its hash is made."""
    parts = ("request", "response", "event")
    fields = tuple(MessageField(f"{part}_message", f"{name}_{part.title()}") for part in parts)
    return Definition(name, fields, {}, {})
