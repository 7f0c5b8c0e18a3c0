"""Bags as other programs read them: rosbags, and the mcap library alone."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

if TYPE_CHECKING:
    from pathlib import Path


class Read(NamedTuple):
    """A message as rosbags decodes it."""

    topic: str
    at: int
    data: bytes
    message: Any


_STORE = get_typestore(Stores.EMPTY)


def decoded(topic: str, at: int, data: bytes, kind: str, definition: str, digest: str) -> Read:
    """Return a message, decoded by nothing but its definition, which has that hash."""
    if kind not in _STORE.types:
        made = get_types_from_msg(definition, kind)
        _STORE.register({name: what for name, what in made.items() if name not in _STORE.types})
    assert digest == _STORE.hash_rihs01(kind)
    return Read(topic, at, data, _STORE.deserialize_cdr(data, kind))


def read_by_rosbags(folder: Path) -> list[Read]:
    """Return what the reader of rosbags reads of a bag, in the order of time."""
    with Reader(folder) as reader:
        return [
            decoded(one.topic, at, bytes(data), one.msgtype, one.msgdef.data, one.digest)
            for one, at, data in reader.messages()
        ]


def read(folder: Path) -> list[Read]:
    """Return what is in a bag, in its order; in a tenth of the time."""
    return [
        decoded(
            one.topic, one.at, one.data, one.schema, one.definition, one.metadata["topic_type_hash"]
        )
        for one in read_raw(folder / f"{folder.name}_0.mcap")
    ]


def on(topic: str, messages: list[Read]) -> list[Read]:
    return [one for one in messages if one.topic == topic]


class Raw(NamedTuple):
    """A message that the mcap library read, with what its schema and channel say."""

    topic: str
    at: int
    data: bytes
    schema: str
    definition: str
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
                schema.data.decode(),
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
