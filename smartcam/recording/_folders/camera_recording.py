"""Keep the counts, file and gaps of the recording of one of an agent's cameras."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.models import CameraEvent, Connected, Reconnected
from smartcam.recording._mcap.form import GAP, RecordedError
from smartcam.recording._recorder import Description, address_metadata
from smartcam.recording._state import RecordedState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.recording._mcap.form import Item
    from smartcam.recording._recorder import RecordingFile


class RecordingCounts(NamedTuple):
    """Counts of a camera's records: frames, results, events, errors and pictures together.

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
        since: time of the first record that was not written.
        until: time of the last record that was not written.
        count: number of records that were not written.
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


class CameraRecording:
    """The recording of one camera.

    Args:
        camera: name of the camera.
        make_items: function that makes the items of an entry, an object that waits for the disk;
            called in the writer's thread.

    Attributes:
        endian: byte order of the last status.
        offered: entries so far; an entry gives one record, or several.
        left_out: entries that were left out: too much waited for the disk, or they were too large.
        written: records on the disk.
        lost: records that waited and could not be written.
        overflow: gap that grows while entries are left out; None if none are left out now.
    """

    def __init__(self, camera: str, make_items: Callable[[Any], Iterator[Item]]) -> None:
        self.camera = camera
        self.make_items = make_items
        self.offered = self.left_out = 0  # counted in the threads that offer records
        # counted in the writer's thread; `extra_records`: records in addition to one for each entry
        self.written = self.lost = self.extra_records = 0
        self.overflow: Gap | None = None
        self.state = RecordedState(camera)
        self.endian = 0
        self.metadata: dict[str, str] = {"camera": camera}
        self.gap: Gap | None = None  # gap that is not on the disk yet
        self.gap_written = False  # whether the gap is in the file's next chunk
        self.file: RecordingFile | None = None
        self.begun_at = 0.0  # time of the file's beginning, on the monotonic clock
        self.synced_bytes = 0  # bytes of the file that are on the disk

    @property
    def counts(self) -> RecordingCounts:
        """Counts of the camera's records."""
        written, lost = self.written, self.lost + self.left_out
        return RecordingCounts(written, self.offered + self.extra_records - written - lost, lost)

    def count_lost(self, entries: list[Any], reason: str) -> None:
        """Count entries that are not written; update the camera's state from them."""
        for entry in entries:
            if isinstance(entry, Description):
                self.metadata |= entry.metadata
            elif isinstance(entry, Gap):
                self._extend_gap(entry)  # the gap's records are already counted
                self.update_state_from_gap(entry)
            else:
                self.update_state(entry)
                self.count_one_lost(reason)

    def count_one_lost(self, reason: str) -> None:
        """Count a record that is not written."""
        at = datetime.now(UTC)
        self.lost += 1
        self._extend_gap(Gap(at, at, 1, reason))

    def update_state(self, entry: object) -> None:
        """Update the camera's state and address from an entry, if the entry is an event."""
        if isinstance(entry, CameraEvent):
            self.state = self.state.after(entry)
        if isinstance(entry, (Connected, Reconnected)):
            self.metadata |= address_metadata(entry.url)

    def update_state_from_gap(self, gap: Gap) -> None:
        """Update the camera's state from the events of a gap."""
        for event in gap.events.values():
            self.update_state(event)

    def _extend_gap(self, later: Gap) -> None:
        if self.gap is None:
            self.gap = replace(later)
        else:
            self.gap.until, self.gap.count = later.until, self.gap.count + later.count
