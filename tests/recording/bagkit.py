"""Bags as other programs read them: rosbags, and the mcap library alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

if TYPE_CHECKING:
    from pathlib import Path


class Read(NamedTuple):
    """A message that rosbags read."""

    topic: str
    at: int
    data: bytes
    message: Any


_STORE = get_typestore(Stores.EMPTY)


def read(path: Path) -> list[Read]:
    """Return what rosbags reads of a bag, or of its MCAP file, by what these say of the types."""
    found: list[Read] = []
    with Reader(path) as reader:
        for one, at, data in reader.messages():
            if one.msgtype not in _STORE.types:
                made = get_types_from_msg(one.msgdef.data, one.msgtype)
                _STORE.register({name: what for name, what in made.items() if not _known(name)})
            assert one.digest in {"", _STORE.hash_rihs01(one.msgtype)}
            message = _STORE.deserialize_cdr(data, one.msgtype)
            found.append(Read(one.topic, at, bytes(data), message))
    return found


def _known(name: str) -> bool:
    return name in _STORE.types


def on(topic: str, messages: list[Read]) -> list[Read]:
    return [one for one in messages if one.topic == topic]


class Raw(NamedTuple):
    """A message that the mcap library read, with what its schema and channel say."""

    topic: str
    at: int
    data: bytes
    schema: str
    encodings: tuple[str, str]  # of the schema, of the message
    metadata: dict[str, str]


def read_raw(path: Path) -> list[Raw]:
    """Return what the mcap library reads of a file, its checksums looked at."""
    with path.open("rb") as stream:
        return [
            Raw(
                channel.topic,
                message.log_time,
                message.data,
                schema.name,
                (schema.encoding, channel.message_encoding),
                channel.metadata,
            )
            for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages(
                log_time_order=False
            )
            if schema is not None
        ]


def nanoseconds(stamp: Any) -> int:
    """Return a ``builtin_interfaces/msg/Time`` as the mcap library has times."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
