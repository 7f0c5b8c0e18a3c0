"""The recording of one camera of an agent: its account, its file, and its gaps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.models import CameraEvent, Connected, Reconnected
from smartcam.recording._mcap.form import GAP, RecordedError
from smartcam.recording._recorder import Description, address_facts
from smartcam.recording._state import RecordedState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.recording._mcap.form import Item
    from smartcam.recording._recorder import RecordingFile


class RecordingAccount(NamedTuple):
    """The account of a camera's records: frames, results, events and errors together.

    Attributes:
        written: records on the disk.
        waiting: records that wait for the disk.
        lost: records not written: the disk was full, missing or too slow, or a record was invalid.
    """

    written: int = 0
    waiting: int = 0
    lost: int = 0


@dataclass(eq=False)
class Gap:
    """Records that were not written.

    Attributes:
        since: time of the first record.
        until: time of the last record.
        count: number of records.
        reason: cause of the gap, as text.
        events: last event of each kind among the records, in order.
    """

    since: datetime
    until: datetime
    count: int
    reason: str
    events: dict[type, CameraEvent] = field(default_factory=dict[type, CameraEvent])

    def error(self, camera: str) -> RecordedError:
        """Return the record of the gap for the file."""
        text = (
            f"{self.count} records from {self.since.isoformat()} to {self.until.isoformat()} were "
            f"not written: {self.reason}"
        )
        return RecordedError(camera, self.until, GAP, text, None, self.since, self.count)


class CameraTrack:
    """The recording of one camera.

    Args:
        camera: name of the camera.
        read: function that makes items of an object; called in the writer's thread.

    Attributes:
        endian: byte order of the last status.
        offered: records so far.
        left_out: offered records for which there was no room to wait.
        written: records on the disk.
        lost: waiting records that could not be written.
        overflow: the growing gap of records that are left out; None if none are.
    """

    def __init__(self, camera: str, read: Callable[[Any], Iterator[Item]]) -> None:
        self.camera = camera
        self.read = read
        self.offered = self.left_out = 0  # counted in the threads that offer records
        self.written = self.lost = self.more = 0  # counted in the writer's thread
        self.overflow: Gap | None = None
        self.state = RecordedState(camera)
        self.endian = 0
        self.facts: dict[str, str] = {"camera": camera}
        self.gap: Gap | None = None  # gap that is not on the disk yet
        self.gap_written = False  # whether the gap is in the file's next chunk
        self.file: RecordingFile | None = None
        self.begun = 0.0  # time of the file's beginning, on the monotonic clock
        self.good = 0  # bytes of the file that are on the disk

    @property
    def account(self) -> RecordingAccount:
        """Account of the camera's records."""
        written, lost = self.written, self.lost + self.left_out
        return RecordingAccount(written, self.offered + self.more - written - lost, lost)

    def lose(self, given: list[Any], reason: str) -> None:
        """Count objects that are not written; keep the camera's state that they report."""
        for item in given:
            if isinstance(item, Description):
                self.facts |= item.facts
            elif isinstance(item, Gap):
                self._widen(item)  # a gap is already counted
                self.follow_all(item)
            else:
                self.follow(item)
                self.lose_one(reason)

    def lose_one(self, reason: str) -> None:
        """Count a record that is not written."""
        at = datetime.now(UTC)
        self.lost += 1
        self._widen(Gap(at, at, 1, reason))

    def follow(self, item: object) -> None:
        """Keep the camera's state that an item reports."""
        if isinstance(item, CameraEvent):
            self.state = self.state.after(item)
        if isinstance(item, (Connected, Reconnected)):
            self.facts |= address_facts(item.url)

    def follow_all(self, gap: Gap) -> None:
        """Keep the camera's state that the events of a gap report."""
        for event in gap.events.values():
            self.follow(event)

    def _widen(self, more: Gap) -> None:
        if self.gap is None:
            self.gap = replace(more)
        else:
            self.gap.until, self.gap.count = more.until, self.gap.count + more.count
