"""Show recorded pictures in a replay: each picture when its result is sent again.

The protocol of BVS cameras has no pictures. So the agent that shares a replayed camera offers them
as the camera's frames. A picture belongs to a result with the same application and bytes; several
results with the same bytes get their pictures in order, or none if their order is not certain.
"""

from __future__ import annotations

import collections
import logging
import time
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from smartcam.exceptions import FrameSourceError
from smartcam.frames import FrameAddress, FrameDriver, FrameSource, StreamFormat
from smartcam.frames._inside import copy_with
from smartcam.recording._replays.schedule import MAX_REPLAY_BYTES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.frames import Frame, FrameSink
    from smartcam.recording._reader import Recording
    from smartcam.recording._replays.schedule import ApplicationRuns

_log = logging.getLogger(__name__)


class _ShownPicture(NamedTuple):
    """A picture, and the seconds from its capture to its result."""

    frame: Frame
    seconds: float


class ReplayedPictures:
    """The pictures of a replayed camera's results.

    Args:
        recording: recording that is played.
        camera: name of the camera in it.
        applications: planned results, by application.
        speed: factor by which the replay is faster than the recording.

    Attributes:
        name: name of the camera.
        current_picture: picture of the last result that was sent; None before the first result, or
            if that result has no picture.
        first_picture: first picture of the recording; None without one.
    """

    def __init__(
        self,
        recording: Recording,
        camera: str,
        applications: Mapping[int, ApplicationRuns],
        speed: float,
    ) -> None:
        self.name = camera
        self.current_picture: Frame | None = None
        self.sinks: set[FrameSink] = set()
        self._speed, self._inspection_start = speed, 0.0
        self._send_counts: collections.Counter[tuple[int, bytes]] = collections.Counter()
        self._pictures = _pictures_by_result(recording, camera, applications)
        self.first_picture: Frame | None = next(
            (shown.frame for row in self._pictures.values() for shown in row if shown), None
        )

    def source(self) -> FrameSource:
        """Return a source of the pictures, not open."""
        return FrameSource(_ResultPictureDriver(self), timeout=None, stall=None, linger=2.0)

    def start_inspection(self) -> None:
        """Start an inspection now; its picture is not exposed earlier."""
        self._inspection_start = time.monotonic()

    def show_picture_of(self, application: int, data: bytes) -> None:
        """Show the picture of a result, which is being sent."""
        key = application, data
        pictures = self._pictures.get(key)
        chosen = None
        if pictures:
            chosen = pictures[self._send_counts[key] % len(pictures)]
            self._send_counts[key] += 1
        if chosen is None:
            self.current_picture = None
            return
        frame, seconds = chosen
        now = time.monotonic()
        captured = min(now, max(self._inspection_start, now - seconds / self._speed))
        duration = min(frame.duration / self._speed, captured - self._inspection_start)
        self.current_picture = copy_with(frame, captured=captured, duration=duration)
        for sink in tuple(self.sinks):
            sink.frame(self.current_picture)


def _pictures_by_result(
    recording: Recording, camera: str, applications: Mapping[int, ApplicationRuns]
) -> dict[tuple[int, bytes], list[_ShownPicture | None]]:
    """Return the pictures of each result, by its application and bytes.

    Several results with the same bytes have a list, in the order in which the replay sends them;
    they are left out if that order is not certain.
    """
    pictures: dict[tuple[int, bytes], list[_ShownPicture | None]] = {}
    size = 0
    for result, picture, _ in recording.results_with_pictures(camera):
        row = pictures.setdefault((result.application, result.raw), [])
        size += 0 if picture is None else memoryview(picture.data).nbytes
        if picture is None or size > MAX_REPLAY_BYTES:
            row.append(None)
        else:
            row.append(_ShownPicture(picture, result.received_at.timestamp() - picture.utc))
    if size > MAX_REPLAY_BYTES:
        _log.warning(
            "%s: pictures after the first %d bytes are not shown", camera, MAX_REPLAY_BYTES
        )
    counts = _counts_in_certain_order(applications)
    return {key: row for key, row in pictures.items() if counts.get(key) == len(row)}


def _counts_in_certain_order(
    applications: Mapping[int, ApplicationRuns],
) -> dict[tuple[int, bytes], int]:
    """Return the number of times that each container is sent, if their order is certain.

    Containers of triggers, and containers without a trigger, are replayed separately. So if a
    container is among both, it is not known which of the two comes first.
    """
    triggered: collections.Counter[tuple[int, bytes]] = collections.Counter()
    untriggered: collections.Counter[tuple[int, bytes]] = collections.Counter()
    for number, application in applications.items():
        for count, runs in (
            (triggered, application.triggered),
            (untriggered, application.untriggered),
        ):
            count.update((number, data) for run in runs for data in run.containers)
    both = triggered.keys() & untriggered.keys()
    return {
        key: n for count in (triggered, untriggered) for key, n in count.items() if key not in both
    }


class _ResultPictureDriver(FrameDriver):
    """Delivers the picture of each result that a replay sends; the last sent one's comes first."""

    sets_captured: ClassVar[bool] = True  # the frames already have their times of capture

    def __init__(self, pictures: ReplayedPictures) -> None:
        super().__init__(FrameAddress.parse("replayed://"))
        self._pictures = pictures
        self._sink: FrameSink | None = None

    @property
    def name(self) -> str:
        """The camera's name."""
        return self._pictures.name

    async def open(self) -> StreamFormat:
        """Return the format of the first picture.

        Raises:
            FrameSourceError: there is no picture.
        """
        first = self._pictures.first_picture
        if first is None:
            raise FrameSourceError(f"{self.name}: no result has a picture", source=self.name)
        return StreamFormat(first.format, first.width, first.height)

    async def start(self, sink: FrameSink) -> None:
        """Deliver the picture of the last result, and the pictures of the next results."""
        self._sink = sink
        self._pictures.sinks.add(sink)
        if self._pictures.current_picture is not None:
            sink.frame(self._pictures.current_picture)

    async def stop(self) -> None:
        """Stop delivering."""
        if self._sink is not None:
            self._pictures.sinks.discard(self._sink)
            self._sink = None

    async def close(self) -> None:
        """Release everything. Idempotent."""
        await self.stop()
