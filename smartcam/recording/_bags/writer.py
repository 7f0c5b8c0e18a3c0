"""Write a rosbag2: a folder with an MCAP file of ROS 2 messages, described by ``metadata.yaml``.

The contents of both files are as in rosbag2: ``mcap_storage.cpp`` of rosbag2_storage_mcap
(profile ``ros2``, schemas ``ros2msg``, ``offered_qos_profiles`` and ``topic_type_hash`` with each
channel, a metadata record ``rosbag2``), ``yaml.hpp`` and ``qos.cpp`` of rosbag2_storage (the rest).
The format is version 8, with the QoS policies as numbers in a text. Version 9 has the policies'
names in a list, which ROS 2 Humble does not read.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
from dataclasses import dataclass, field
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import smartcam
from smartcam.exceptions import ConfigurationError
from smartcam.recording._exclusive_files import open_exclusively
from smartcam.recording._mcap.form import load_compress, load_extra
from smartcam.recording._mcap.writer import McapWriter
from smartcam.recording._recorder import CHUNK

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.ros2 import QoS, RosTypes

VERSION = 8
"""Version of the format of ``metadata.yaml``."""

METADATA = "metadata.yaml"

_TEMPORARY_METADATA = f"{METADATA}.tmp"

_FOREVER = {"sec": 9_223_372_036, "nsec": 854_775_807}
_RELIABLE, _BEST_EFFORT, _KEEP_LAST, _TRANSIENT_LOCAL, _VOLATILE, _AUTOMATIC = 1, 2, 1, 1, 2, 1
"""``rmw/types.h``"""


class Topic(NamedTuple):
    """A topic of a bag.

    Attributes:
        name: absolute name of the topic, with a slash in front.
        type: type of the messages.
        qos: quality of service that the publishing node offers.
    """

    name: str
    type: str
    qos: QoS


@dataclass(slots=True)
class _BagChannel:
    """A topic in the file, and the number of its messages."""

    id: int
    metadata: dict[str, str]  # metadata of its topic, for ``metadata.yaml``
    count: int = 0


def make_folder(folder: Path, *, overwrite: bool) -> IO[bytes]:
    """Create a bag's folder and return its MCAP file, open and locked.

    Args:
        folder: folder of the bag, whose parent must exist.
        overwrite: replace an existing bag.

    Raises:
        ConfigurationError: the folder exists already, contains something else than a bag, another
            recorder writes it, or it cannot be created.
    """
    label = f"bag {folder}"
    try:
        created = _create_folder(folder, label, overwrite=overwrite)
        try:
            stream = open_exclusively(mcap_of(folder), overwrite=overwrite)
            for old in folder.iterdir():
                if old.name != mcap_of(folder).name:
                    old.unlink()
        except BaseException:
            if created:
                folder.rmdir()
            raise
    except (OSError, ValueError) as exc:
        if isinstance(exc, ConfigurationError):
            raise
        reason = exc.strerror if isinstance(exc, OSError) else exc
        raise ConfigurationError(f"{label}: {reason}") from exc
    return stream


def _create_folder(folder: Path, label: str, *, overwrite: bool) -> bool:
    """Create the folder if it does not exist; return whether it was created."""
    try:
        folder.mkdir()
    except FileExistsError as exc:
        if not overwrite:
            raise ConfigurationError(
                f"{label}: it exists already; overwrite (--force) replaces a bag"
            ) from exc
        if not folder.is_dir():
            raise ConfigurationError(f"{label}: this is no folder") from exc
        other = [path.name for path in folder.iterdir() if not _is_of_bag(folder, path)]
        if other:
            raise ConfigurationError(
                f"{label}: the folder holds {other[0]!r:.80}, which is no part of a bag: the "
                "folder is left unchanged"
            ) from exc
        return False
    return True


def mcap_of(folder: Path) -> Path:
    """Return the path of a bag's MCAP file, which rosbag2 names after the folder."""
    return folder / f"{folder.resolve().name}_0.mcap"


def _is_of_bag(folder: Path, path: Path) -> bool:
    """Return True if a file may be the bag's own; other recordings are not."""
    match = re.fullmatch(re.escape(folder.resolve().name) + r"_\d+\.mcap", path.name)
    return (match is not None or path.name in {METADATA, _TEMPORARY_METADATA}) and not path.is_dir()


def remove_folder(folder: Path) -> None:
    """Remove a bag of smartcam that is no longer being written."""
    for path in (folder / METADATA, folder / _TEMPORARY_METADATA, mcap_of(folder)):
        path.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # another program has put a file there
        folder.rmdir()


@dataclass(eq=False)
class BagWriter:
    """Writes a bag, in one thread.

    Args:
        folder: folder of the bag.
        stream: MCAP file of the bag, from :func:`make_folder`; closed at the end.
        types: types of the messages.

    Raises:
        MissingExtraError: zstandard, or PyYAML, is not installed.
    """

    folder: Path
    stream: IO[bytes]
    types: RosTypes
    _schemas: dict[str, int] = field(init=False, default_factory=dict[str, int])
    _channels: dict[Topic, _BagChannel] = field(
        init=False, default_factory=dict[Topic, _BagChannel]
    )
    _first: int = field(init=False, default=(1 << 63) - 1)
    _last: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self._yaml = load_extra("yaml")
        self._writer = McapWriter(self.stream, load_compress(), CHUNK)
        self._on_disk = stat.S_ISREG(os.fstat(self.stream.fileno()).st_mode)

    @property
    def count(self) -> int:
        """Number of messages so far."""
        return sum(channel.count for channel in self._channels.values())

    def start(self) -> None:
        """Write the beginning of the file, after which it can be read even if it is cut off."""
        self._writer.start("ros2", f"smartcam {smartcam.__version__}")
        # a file that is cut off has no later one; readers need it for the format of QoS policies
        self._write_metadata_record()
        self.flush()

    def add(self, topic: Topic, at: int, message: Any) -> None:
        """Write a message; it is on the disk after the next :meth:`flush`.

        Args:
            topic: topic to write the message to.
            at: time of arrival, nanoseconds since 1970, UTC.
            message: message of the type, or a mapping of the fields.

        Raises:
            RosMessageError: the fields do not fit the topic's type.
            OSError: the disk fails.
        """
        data = self.types.message(topic.type).encode(message)
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._new_channel(topic)
        channel.count += 1
        self._first, self._last = min(self._first, at), max(self._last, at)
        self._writer.add_message(channel.id, at, data, channel.count & 0xFFFFFFFF)

    def flush(self) -> None:
        """End the chunk and sync it to the disk."""
        self._writer.flush()
        if self._on_disk:
            os.fsync(self.stream.fileno())

    def finish(self) -> None:
        """Write the index, the end of the file, and ``metadata.yaml``."""
        self._write_metadata_record()
        self._writer.finish()
        self.stream.flush()
        if self._on_disk:
            os.fsync(self.stream.fileno())
        text = self._text({"rosbag2_bagfile_information": self._metadata()})
        temporary = self.folder / _TEMPORARY_METADATA
        with temporary.open("w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(self.folder / METADATA)

    def close(self) -> None:
        """Close the file, and drop bytes that cannot be written."""
        with contextlib.suppress(OSError):
            self.stream.close()

    def _new_channel(self, topic: Topic) -> _BagChannel:
        message_type = self.types.message(topic.type)
        if message_type.name not in self._schemas:
            self._schemas[message_type.name] = self._writer.register_schema(
                message_type.name, "ros2msg", message_type.text.encode()
            )
        qos = self._text([_policies(topic.qos)]).strip()
        channel_id = self._writer.register_channel(
            topic.name,
            "cdr",
            self._schemas[message_type.name],
            {"offered_qos_profiles": qos, "topic_type_hash": message_type.hash},
        )
        metadata = {
            "name": topic.name,
            "type": message_type.name,
            "serialization_format": "cdr",
            "offered_qos_profiles": qos,
            "type_description_hash": message_type.hash,
        }
        return _BagChannel(channel_id, metadata)

    def _write_metadata_record(self) -> None:
        self._writer.add_metadata("rosbag2", {"serialized_metadata": self._text(self._metadata())})

    def _text(self, value: object) -> str:
        """Return a value as YAML; by libyaml if PyYAML has it."""
        dumper = getattr(self._yaml, "CSafeDumper", self._yaml.SafeDumper)
        text: str = self._yaml.dump(value, Dumper=dumper, sort_keys=False, allow_unicode=True)
        return text

    def _metadata(self) -> dict[str, Any]:
        count, name = self.count, mcap_of(self.folder).name
        starting_time = {"nanoseconds_since_epoch": self._first if count else 0}
        duration = {"nanoseconds": self._last - self._first if count else 0}
        return {
            "version": VERSION,
            "storage_identifier": "mcap",
            "duration": dict(duration),
            "starting_time": dict(starting_time),
            "message_count": count,
            "topics_with_message_count": [
                {"topic_metadata": channel.metadata, "message_count": channel.count}
                for channel in self._channels.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [name],
            "files": [
                {
                    "path": name,
                    "starting_time": dict(starting_time),
                    "duration": dict(duration),
                    "message_count": count,
                }
            ],
            "custom_data": None,
            "ros_distro": self.types.distribution,
        }


def _policies(qos: QoS) -> dict[str, Any]:
    """Return a topic's offered policies."""
    return {
        "history": _KEEP_LAST,
        "depth": qos.kept,
        "reliability": _RELIABLE if qos.reliable else _BEST_EFFORT,
        "durability": _TRANSIENT_LOCAL if qos.latched else _VOLATILE,
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": _AUTOMATIC,
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }
