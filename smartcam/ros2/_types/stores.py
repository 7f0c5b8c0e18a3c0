"""The distributions of ROS 2 and their types, each loaded once in the process when needed."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, Final

from smartcam._extras import load
from smartcam.exceptions import ConfigurationError
from smartcam.ros2._types.definitions import (
    EMPTY_MESSAGE_FIELD,
    TYPE_ALIASES,
    Definition,
    MessageField,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

DISTRIBUTIONS: Final = {
    "humble": "humble",
    "jazzy": "jazzy",
    "kilted": "kilted",
    "lyrical": "lyrical",
    "rolling": "lyrical",
}
"""The store of rosbags for each distribution; rolling uses the newest store."""

WITHOUT_HASHES: Final = frozenset({"humble"})

MISSING_BUILT_INS: Final = {
    "humble": frozenset(
        {
            "rcl_interfaces/srv/GetLoggerLevels",
            "rcl_interfaces/srv/SetLoggerLevels",
            "type_description_interfaces/srv/GetTypeDescription",
        }
    )
}
"""Names of types that smartcam has built in, but a distribution does not have."""

_DEFAULTS: Final[dict[tuple[str, str], float | str]] = {
    ("geometry_msgs/msg/Quaternion", "w"): 1.0,
    ("sensor_msgs/msg/NavSatStatus", "status"): "STATUS_UNKNOWN",
}
"""Defaults that the stores leave out, by type and field. A text names a constant of the type; if
the type has no such constant, there is no default."""

_NAME, _ARRAY, _SEQUENCE = 2, 3, 4


@functools.cache
def stored_fields(distribution: str) -> Mapping[str, Any]:
    """Return the fields of a distribution's messages, from rosbags.

    Raises:
        ConfigurationError: there is no such distribution.
        MissingExtraError: the extra ``ros2`` is not installed.
    """
    if distribution not in DISTRIBUTIONS:
        raise ConfigurationError(
            f"no distribution of ROS 2: expected {', '.join(DISTRIBUTIONS)}, got "
            f"{distribution!r:.80}"
        )
    name = f"rosbags.typesys.stores.ros2_{DISTRIBUTIONS[distribution]}"
    definitions: Mapping[str, Any] = load(name).FIELDDEFS
    return definitions


def read_stored(name: str, store_entry: Any) -> Definition:
    """Return the definition of a message that a store holds."""
    constants = {constant: value for constant, _, value in store_entry[0]}
    fields = []
    for field, kind in store_entry[1]:
        if field != EMPTY_MESSAGE_FIELD.name:
            default = _DEFAULTS.get((name, field))
            if isinstance(default, str):
                default = constants.get(default)
            fields.append(_field(field, kind)._replace(default=default))
    constant_types = {
        constant: str(TYPE_ALIASES.get(kind, kind)) for constant, kind, _ in store_entry[0]
    }
    return Definition(name, tuple(fields), constants, constant_types)


def _field(name: str, stored_type: Any) -> MessageField:
    shape, size = "", 0
    if stored_type[0] in (_ARRAY, _SEQUENCE):
        shape = "array" if stored_type[0] == _ARRAY else "sequence"
        stored_type, size = stored_type[1]
    if stored_type[0] == _NAME:
        return MessageField(name, stored_type[1], shape, size)
    kind: str
    kind, limit = stored_type[1]
    return MessageField(name, TYPE_ALIASES.get(kind, kind), shape, size, limit)
