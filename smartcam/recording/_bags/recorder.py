"""A recorder of bags: as :class:`~smartcam.recording.Recorder`, but what it writes is a rosbag2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.exceptions import RosMessageError
from smartcam.recording._bags.items import BagCounts, BagItems
from smartcam.recording._bags.writer import BagWriter, make_folder, remove_folder
from smartcam.recording._mcap.form import load_compress, load_extra
from smartcam.recording._recorder import Description, Recorder
from smartcam.ros2 import RosTypes

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.frames import Frame
    from smartcam.models import Result
    from smartcam.observers import TraceEntry
    from smartcam.recording._recorder import Given


DISTRIBUTION = "jazzy"
"""ROS distribution whose message definitions a bag has; those used are the same in later ones."""


def open_bag(folder: Path, *, overwrite: bool) -> BagWriter:
    """Make a bag's folder, and what writes it.

    Raises:
        ConfigurationError: the folder cannot be created.
        MissingExtraError: a library is not installed.
    """
    types = RosTypes(DISTRIBUTION)
    load_compress()
    load_extra("yaml")
    return BagWriter(folder, make_folder(folder, overwrite=overwrite), types)


class BagRecorder(Recorder):
    """Writes what clients see to a rosbag2, as :class:`Recorder` does to a file of its own.

    ::

        with BagRecorder("run") as recorder:
            async with smartcam.connect(url, interpret_as="localizations", observers=[recorder]):
                ...

    Each camera has its topics, ``/CAMERA/results``, ``localizations``, ``detections`` and
    ``status``; ``/diagnostics`` has the errors. Of frames there is nothing in a bag.

    Args:
        path: the bag's folder.
        overwrite: take the place of a bag that is there.

    Attributes:
        path: path that was given.
    """

    def on_frame(self, entry: TraceEntry) -> None:
        """Keep a container for the case that it cannot be read."""
        if entry.message == "ResultContainer":
            self._put(entry, len(entry.hex))

    def on_picture(self, result: Result, frame: Frame) -> None:
        """Keep none: a bag has no pictures."""

    @property
    def bag_counts(self) -> BagCounts:
        """Counts of what was written so far."""
        return self._file.items.counts if isinstance(self._file, _BagFile) else BagCounts()

    def remove(self) -> None:
        """Remove what was written; call it when it is closed."""
        if self._file is not None:
            remove_folder(self.path)

    def _make_file(self) -> _BagFile:
        return _BagFile(open_bag(self.path, overwrite=self._overwrite))


@dataclass(eq=False)
class _BagFile:
    """A bag that is being written by a recorder's thread."""

    _writer: BagWriter

    def __post_init__(self) -> None:
        self.items = BagItems(self._writer.types)
        self.start, self.flush = self._writer.start, self._writer.flush
        self.finish, self.close = self._writer.finish, self._writer.close

    def add(self, item: Given, /) -> None:
        """Write one thing; raises ValueError: no message can be made of it."""
        if isinstance(item, Description):
            self.items.describe(item.facts)
            return
        try:
            for message in self.items.messages(item):
                self._writer.add(*message)
        except RosMessageError as exc:
            raise ValueError(str(exc)) from exc
