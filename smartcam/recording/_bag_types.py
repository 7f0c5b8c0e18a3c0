"""The message types of a bag: their definitions, hashes and bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

DISTRIBUTION = "jazzy"
"""Whose message definitions a bag has; those that it uses are the same in the ones after it."""


class BagType(NamedTuple):
    """A message type.

    Attributes:
        name: such as ``geometry_msgs/msg/PoseArray``.
        hash: of its description, ``RIHS01_...``.
        definition: its text and that of every type in it, as ``ros2msg`` has it.
        encode: makes the bytes of a message's fields: CDR, little endian.
    """

    name: str
    hash: str
    definition: str
    encode: Callable[[Mapping[str, Any]], bytes]


class BagTypes:
    """The types by name, made when they are asked for first.

    Args:
        texts: definitions of types that the distribution does not bring, by name.

    Raises:
        MissingExtraError: rosbags is not installed.
    """

    def __init__(self, texts: Mapping[str, str]) -> None:
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as exc:
            raise MissingExtraError(
                'bags need rosbags: pip install "smartcam[ros2,record]"', extra="ros2"
            ) from exc
        self.distribution: str = DISTRIBUTION
        self._store: Any = get_typestore(Stores.ROS2_JAZZY)
        for name, text in texts.items():
            self._store.register(get_types_from_msg(text, name))
        self._known: dict[str, BagType] = {}

    def __getitem__(self, name: str) -> BagType:
        known = self._known.get(name)
        if known is None:
            store = self._store
            text, _ = store.generate_msgdef(name, ros_version=2)

            def encode(fields: Mapping[str, Any]) -> bytes:
                return bytes(store.serialize_cdr(self._made(name, fields), name))

            known = BagType(name, store.hash_rihs01(name), text, encode)
            self._known[name] = known
        return known

    def _made(self, name: str, fields: Mapping[str, Any]) -> Any:
        """Return a message of rosbags; fields that are messages are made, too."""
        made: dict[str, Any] = {}
        for field, (_, told) in self._store.fielddefs[name][1]:
            value = fields[field]
            if isinstance(told, str):
                made[field] = self._made(told, value)
            elif isinstance(told[0], tuple) and isinstance(told[0][1], str):
                made[field] = [self._made(told[0][1], one) for one in value]
            else:
                made[field] = value
        return self._store.types[name](**made)
