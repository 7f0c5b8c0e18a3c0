"""A recorder of bags: like :class:`~smartcam.recording.Recorder`, but it writes a rosbag2."""

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
    from smartcam.recording._recorder import RecorderInput


DISTRIBUTION = "jazzy"
"""ROS distribution of a bag's message definitions, which are the same in later ones."""


def open_bag(folder: Path, *, overwrite: bool) -> BagWriter:
    """Create a bag's folder, and return its writer.

    Raises:
        ConfigurationError: the folder cannot be created.
        MissingExtraError: a library is not installed.
    """
    types = RosTypes(DISTRIBUTION)
    load_compress()
    load_extra("yaml")
    return BagWriter(folder, make_folder(folder, overwrite=overwrite), types)


class BagRecorder(Recorder):
    """Writes results, states and errors of clients to a rosbag2, like :class:`Recorder` to MCAP.

    ::

        with BagRecorder("run") as recorder:
            async with smartcam.connect(url, interpret_as="localizations", observers=[recorder]):
                ...

    Each camera has its topics, ``/CAMERA/results``, ``localizations``, ``detections`` and
    ``status``; ``/diagnostics`` has the errors. A bag has no protocol messages and no pictures.

    Args:
        path: the bag's folder.
        overwrite: replace an existing bag.

    Attributes:
        path: path that was given.
    """

    def on_frame(self, entry: TraceEntry) -> None:
        """Pass on a result container: it is recorded if it cannot be interpreted."""
        if entry.message == "ResultContainer":
            self._put(entry, len(entry.hex))

    def on_picture(self, result: Result, frame: Frame) -> None:
        """Ignore the picture: a bag has none."""

    @property
    def bag_counts(self) -> BagCounts:
        """Counts of the bag so far."""
        return self._file.items.counts if isinstance(self._file, _BagFile) else BagCounts()

    def remove(self) -> None:
        """Remove the bag; call this after closing."""
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

    def add(self, item: RecorderInput, /) -> None:
        """Write one item; raise ValueError if no message can be made from it."""
        if isinstance(item, Description):
            self.items.describe(item.metadata)
            return
        try:
            for message in self.items.messages(item):
                self._writer.add(*message)
        except RosMessageError as exc:
            raise ValueError(str(exc)) from exc
