"""Read the fields of messages and services from the texts of ``.msg`` and ``.srv``."""

from __future__ import annotations

import ast
import keyword
import re
import struct
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from smartcam.exceptions import ConfigurationError

INTEGERS: Final = {
    "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "byte": "B",
}  # fmt: skip
"""Codes that ``struct`` and numpy have for a type, by the name of the type."""

NUMBERS: Final = {**INTEGERS, "float32": "f", "float64": "d", "bool": "?"}
BASIC_TYPES: Final = frozenset({*NUMBERS, "string"})
TYPE_ALIASES: Final = {"char": "uint8", "octet": "byte"}

_PART = r"[a-z][a-z0-9]*(?:_[a-z0-9]+)*"  # matches in one way only, so no text is slow to match
TYPE_NAME: Final = re.compile(rf"({_PART})/(msg|srv)/([A-Z][A-Za-z0-9]*)")
_FIELD: Final = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=(?P<limit>\d+))?"
    r"(?:\[(?P<bound><=)?(?P<size>\d*)\])?\s+"
    r"(?P<name>[A-Za-z]\w*)\s*(?:=(?P<constant>.*)|\s(?P<default>.*))?"
)
_SHORT_NAMES: Final = {"Header": "std_msgs/msg/Header"}


class MessageField(NamedTuple):
    """A field; ``shape`` is "" for one value, "array" of ``size``, or "sequence" up to ``size``.

    Attributes:
        type: a basic type, or a message's full name.
        limit: largest number of bytes of a string; 0 for any.
        size: number of elements of an array, largest number for a sequence; 0 for any.
        default: value of the field in a new message; with None it is zero, false or empty.
    """

    name: str
    type: str
    shape: str = ""
    size: int = 0
    limit: int = 0
    default: Any = None

    @property
    def attribute(self) -> str:
        """Name of the field in Python."""
        return f"{self.name}_" if keyword.iskeyword(self.name) else self.name

    @property
    def nested(self) -> bool:
        """True if the field consists of messages."""
        return self.type not in BASIC_TYPES

    def __str__(self) -> str:
        """Return the type of the field as a ``.msg`` has it."""
        limit = f"<={self.limit}" if self.limit else ""
        bound = "<=" if self.shape == "sequence" and self.size else ""
        return (
            self.type.replace("/msg/", "/")
            + limit
            + (f"[{bound}{self.size or ''}]" if self.shape else "")
        )


EMPTY_MESSAGE_FIELD: Final = MessageField("structure_needs_at_least_one_member", "uint8")
"""Field that a message without fields has in its description and its bytes."""


@dataclass(frozen=True, slots=True)
class Definition:
    """A message's fields and constants.

    Attributes:
        constant_types: type of each constant, by the constant's name.
    """

    name: str
    fields: tuple[MessageField, ...]
    constants: dict[str, Any]
    constant_types: dict[str, str]

    def text(self, *, defaults: bool = False) -> str:
        """Return the fields and constants as a ``.msg`` has them.

        Args:
            defaults: True to add the fields' defaults.
        """
        constants = (
            f"{self.constant_types[name]} {name}={value}\n"
            for name, value in self.constants.items()
        )
        fields = (
            f"{field} {field.name}{_default_text(field.default) if defaults else ''}\n"
            for field in self.fields
        )
        return "".join((*constants, *fields))

    def nested_names(self) -> set[str]:
        """Return the names of the types of nested messages."""
        return {field.type for field in self.fields if field.nested}


def _default_text(value: Any) -> str:
    """Return a default as it follows a field's name, with a blank before it."""
    if value is None:
        return ""
    return f" {str(value).lower() if isinstance(value, bool) else repr(value)}"


def split_name(name: str, category: str = "") -> tuple[str, str, str]:
    """Return package, category (msg or srv) and short name of a type.

    Raises:
        ConfigurationError: the text is no name of a type, or the type has another category.
    """
    matched = TYPE_NAME.fullmatch(name) if isinstance(name, str) else None
    if matched is None or category not in ("", matched[2]):
        example = "std_srvs/srv/Trigger" if category == "srv" else "std_msgs/msg/String"
        raise ConfigurationError(
            f"not a name of a ROS type: expected a name such as {example}, got {name!r:.80}"
        )
    return matched[1], matched[2], matched[3]


def dds_name(name: str) -> str:
    """Return a type's name as zenoh keys contain it, such as ``std_msgs::msg::dds_::String_``."""
    package, category, short_name = name.split("/")
    return f"{package}::{category}::dds_::{short_name}_"


def parse_message(name: str, text: str) -> Definition:
    """Return the definition from the text of a ``.msg`` file.

    Raises:
        ConfigurationError: the text defines no message.
    """
    package = name.partition("/")[0]
    fields: dict[str, MessageField] = {}
    constants: dict[str, Any] = {}
    constant_types: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        text_line = line.strip()
        if not text_line or text_line.startswith("#"):
            continue
        try:
            field, constant = _parse_line(package, text_line)
            if field.name in fields or field.name in constants:
                raise ValueError(f"there are two {field.name}")
            if constant:
                constants[field.name], constant_types[field.name] = field.default, field.type
            else:
                fields[field.name] = field
        except (ValueError, SyntaxError, MemoryError, RecursionError) as exc:
            raise ConfigurationError(f"{name}, line {number}: {text_line!r:.80}: {exc}") from exc
    return Definition(name, tuple(fields.values()), constants, constant_types)


def parse_service(name: str, text: str) -> tuple[Definition, Definition]:
    """Return request and response of a ``.srv``.

    Raises:
        ConfigurationError: the text defines no service.
    """
    parts = re.split(r"(?m)^---\s*$", text)
    if len(parts) != 2:
        raise ConfigurationError(f"{name}: expected one line --- between request and response")
    return parse_message(f"{name}_Request", parts[0]), parse_message(f"{name}_Response", parts[1])


def without_defaults(definition: Any) -> Any:
    """Return the fields of a message, or of a service's two messages, without defaults."""
    if isinstance(definition, tuple):
        return [without_defaults(part) for part in definition]
    return [field._replace(default=None) for field in definition.fields]


def _parse_line(package: str, line: str) -> tuple[MessageField, bool]:
    matched = _FIELD.fullmatch(line) or _FIELD.fullmatch(line.partition("#")[0].strip())
    if matched is None:
        raise ValueError("expected a type and a name")
    type_name = _full_name(package, matched["type"])
    limit = int(matched["limit"] or 0)
    if limit and type_name != "string":
        raise ValueError("only the type string may be followed by <=")
    size, is_bounded = matched["size"], matched["bound"] is not None
    if is_bounded and not size:
        raise ValueError("expected a number after <=")
    shape = "" if size is None else "array" if size and not is_bounded else "sequence"
    field = MessageField(matched["name"], type_name, shape, int(size or 0), limit)
    if shape == "array" and not field.size:
        raise ValueError("an array of 0 elements")
    value = matched["constant"] if matched["constant"] is not None else matched["default"]
    is_constant = matched["constant"] is not None
    if is_constant and (shape or type_name not in BASIC_TYPES):
        raise ValueError("a constant has one value of a basic type")
    return field._replace(default=_parse_value(field, value, is_constant=is_constant)), is_constant


def _full_name(package: str, name: str) -> str:
    name = TYPE_ALIASES.get(name, name)
    if name in ("wstring", "float128"):
        raise ValueError(f"{name} is not supported")
    if name in BASIC_TYPES:
        return name
    if "/" not in name:
        name = _SHORT_NAMES.get(name, f"{package}/msg/{name}")
    elif "/msg/" not in name:
        name = name.replace("/", "/msg/", 1)
    if TYPE_NAME.fullmatch(name) is None:
        raise ValueError(f"{name} is no type")
    return name


def _parse_value(field: MessageField, text: str | None, *, is_constant: bool) -> Any:
    """Return the value of a constant or a default; a constant's unquoted string may have ``#``."""
    if text is None or not (text := text.strip()) or (not is_constant and text.startswith("#")):
        return None
    if field.type == "string" and not field.shape:
        quoted = re.match(r"'(?:\\.|[^'\\])*'|\"(?:\\.|[^\"\\])*\"", text)
        if quoted is None:
            return text if is_constant else text.partition("#")[0].strip()
        return _checked_values(field, [ast.literal_eval(quoted[0])])[0]
    if field.type != "string":
        text = text.partition("#")[0].strip()
        text = re.sub(r"(?i)\btrue\b", "True", re.sub(r"(?i)\bfalse\b", "False", text))
    value = ast.literal_eval(text)
    value = value if field.shape else [value]
    convert = float if field.type.startswith("float") else bool if field.type == "bool" else None
    values = [convert(x) for x in value] if convert else list(value)
    return _checked_values(field, values) if field.shape else _checked_values(field, values)[0]


def _checked_values(field: MessageField, values: list[Any]) -> list[Any]:
    if field.nested:
        raise ValueError("a message has no default")
    max_count = field.size or len(values)
    if len(values) > max_count or (field.shape == "array" and len(values) != max_count):
        limit = "" if field.shape == "array" else "up to "
        raise ValueError(f"expected {limit}{field.size} values, got {len(values)}")
    for value in values:
        if field.type == "string":
            if not isinstance(value, str) or (field.limit and len(value.encode()) > field.limit):
                raise ValueError(f"{value!r:.40} is no {field.type}")
        else:
            try:
                struct.pack(f"<{NUMBERS[field.type]}", value)
            except (struct.error, OverflowError, TypeError) as exc:
                raise ValueError(f"{value!r:.40} is no {field.type}") from exc
    return values
