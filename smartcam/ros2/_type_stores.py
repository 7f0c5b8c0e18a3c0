"""The distributions of ROS 2, and what each has: once in the process, made when it is asked for."""

from __future__ import annotations

import functools
import importlib
import threading
from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import ConfigurationError, MissingExtraError
from smartcam.ros2._type_definitions import NUMBERS, Definition, Field

if TYPE_CHECKING:
    from collections.abc import Mapping

DISTRIBUTIONS: Final = {
    "humble": "humble",
    "jazzy": "jazzy",
    "kilted": "kilted",
    "lyrical": "lyrical",
    "rolling": "lyrical",
}
"""The store of rosbags for each; rolling is as the newest."""

WITHOUT_HASHES: Final = frozenset({"humble"})

_DEFAULTS: Final = {("geometry_msgs/msg/Quaternion", "w"): 1.0}
"""What the stores leave out."""

_OTHER_NAMES: Final = {"char": "uint8", "octet": "byte"}
_NAME, _ARRAY, _SEQUENCE = 2, 3, 4
_EMPTY: Final = "structure_needs_at_least_one_member"


@functools.cache
def stored(distribution: str) -> Mapping[str, Any]:
    """Return the fields of a distribution's messages, as rosbags has them.

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
    try:
        found: Mapping[str, Any] = importlib.import_module(name).FIELDDEFS
    except ImportError as exc:
        raise MissingExtraError(
            'messages of ROS need rosbags: pip install "smartcam[ros2]"', extra="ros2"
        ) from exc
    return found


def read_stored(name: str, said: Any) -> Definition:
    """Return what a store says of a message."""
    constants, fields = said
    return Definition(
        name,
        tuple(_field(name, one, kind) for one, kind in fields if one != _EMPTY),
        {one: value for one, _, value in constants},
    )


def _field(message: str, name: str, said: Any) -> Field:
    shape, size = "", 0
    if said[0] in (_ARRAY, _SEQUENCE):
        shape = "array" if said[0] == _ARRAY else "sequence"
        said, size = said[1]
    default = _DEFAULTS.get((message, name))
    if said[0] == _NAME:
        return Field(name, said[1], shape, size, 0, default)
    kind, limit = said[1]
    return Field(name, _OTHER_NAMES.get(kind, kind), shape, size, limit, default)
