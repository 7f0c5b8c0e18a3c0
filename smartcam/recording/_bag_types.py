"""The message types of a bag: their bytes and hashes, and their definitions as texts."""

from __future__ import annotations

import functools
import importlib
import importlib.util
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import MissingExtraError
from smartcam.ros2._definitions import MESSAGES
from smartcam.ros2._types import RosTypes

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
        encode: makes the bytes of a message's fields: CDR, little endian; raises RosMessageError.
    """

    name: str
    hash: str
    definition: str
    encode: Callable[[Mapping[str, Any]], bytes]


@dataclass(eq=False)
class BagTypes:
    """The types by name, made when they are asked for first, which takes a tenth of a second.

    Raises:
        MissingExtraError: rosbags is not installed.
    """

    distribution: str = DISTRIBUTION
    _known: dict[str, BagType] = field(init=False, default_factory=dict[str, BagType])

    def __post_init__(self) -> None:
        if importlib.util.find_spec("rosbags") is None:
            raise MissingExtraError(
                'bags need rosbags: pip install "smartcam[ros2,record]"', extra="ros2"
            )

    @functools.cached_property
    def _types(self) -> RosTypes:
        return RosTypes(self.distribution)

    def __getitem__(self, name: str) -> BagType:
        known = self._known.get(name)
        if known is None:
            kind = self._types.message(name)
            text = _definition(self.distribution, name)
            known = self._known[name] = BagType(name, kind.hash, text, kind.encode)
        return known


@functools.cache
def _definition(distribution: str, name: str) -> str:
    """Return a definition as rosbags writes it."""
    text: str = _store(distribution).generate_msgdef(name, ros_version=2)[0]
    return text


@functools.cache
def _store(distribution: str) -> Any:
    typesys = importlib.import_module("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores(f"ros2_{distribution}"))
    for name, text in MESSAGES.items():
        if name not in store.types:
            store.register(typesys.get_types_from_msg(text, name))
    return store
