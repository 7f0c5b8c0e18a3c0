"""Find the picture of each result."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam.models import Result
from smartcam.recording._mcap.form import RecordedPicture

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from smartcam.frames import Frame
    from smartcam.recording._mcap.form import Item

MAX_PICTURES: Final = 256
"""Largest number of pictures of a camera that are kept for its results."""

MAX_PICTURE_BYTES: Final = 1 << 28
"""Largest number of bytes that the kept pictures of a camera may have together; the last one is
kept in any case."""

MAX_RESULTS: Final = 1000
"""Largest number of results of a camera that wait for their pictures."""


class JudgedResult(NamedTuple):
    """A result and its picture.

    Attributes:
        result: result of the camera.
        picture: picture of the result; None if it is unknown.
        linked: True if the picture was recorded with the result's number, as after
            ``read_image()``; False if it was found by its time. That needs a trigger of this
            client: without one, the picture is None.
    """

    result: Result[Any]
    picture: Frame | None
    linked: bool


def judged(items: Iterable[Item]) -> Iterator[JudgedResult]:
    """Yield each result with its picture once no later picture can belong to the result."""
    matchers: dict[str, PictureMatcher] = {}
    for item in items:
        if isinstance(item, (RecordedPicture, Result)):
            if item.camera not in matchers:
                matchers[item.camera] = PictureMatcher()
            matcher = matchers[item.camera]
            if isinstance(item, RecordedPicture):
                matcher.add_picture(item)
            else:
                matcher.results.append(item)
            yield from matcher.settled()
    for matcher in matchers.values():
        yield from matcher.settled(over=True)


class PictureMatcher:
    """Matches pictures and results of one camera.

    Args:
        max_bytes: largest number of bytes of the pictures that are kept for results; the last one
            is kept in any case.

    Attributes:
        results: results whose picture is not known yet.
    """

    def __init__(self, max_bytes: int = MAX_PICTURE_BYTES) -> None:
        self.results: deque[Result[Any]] = deque()
        self._max_bytes = max_bytes
        self._pictures: deque[RecordedPicture] = deque()
        self._bytes = 0
        self._dropped = -math.inf  # exposure start of the last dropped picture
        self._latest = 0.0  # capture of the last picture without a result's number, seconds

    def add_picture(self, picture: RecordedPicture) -> None:
        self._pictures.append(picture)
        self._bytes += _size(picture)
        if picture.result_number is None:
            self._latest = max(self._latest, picture.frame.utc)
        too_many = len(self._pictures) > MAX_PICTURES
        while too_many or (self._bytes > self._max_bytes and len(self._pictures) > 1):
            dropped = self._pictures.popleft()
            self._bytes -= _size(dropped)
            if dropped.result_number is None:
                self._dropped = max(self._dropped, dropped.frame.utc - dropped.frame.duration)
            too_many = False

    def settled(self, *, over: bool = False) -> Iterator[JudgedResult]:
        """Yield the results whose picture is known, or can no longer arrive."""
        while self.results:
            result = self.results[0]
            recorded = self._reported_picture(result)
            reported = recorded is not None
            if not (reported or over or self._is_late(result)):
                return
            self.results.popleft()
            picture = self._by_time(result) if recorded is None else recorded.frame
            yield JudgedResult(result, picture, reported)

    def settled_by_time(self) -> Iterator[JudgedResult]:
        """Yield the results as soon as their picture is found by its time."""
        while self.results:
            result = self.results[0]
            picture = self._by_time(result)
            findable = result.triggered_at is not None
            if picture is None and findable and not self._is_late(result):
                return
            self.results.popleft()
            yield JudgedResult(result, picture, False)

    def _is_late(self, result: Result[Any]) -> bool:
        """Return True if a result should not wait for a picture any more."""
        return self._latest > result.received_at.timestamp() or len(self.results) > MAX_RESULTS

    def _reported_picture(self, result: Result[Any]) -> RecordedPicture | None:
        key = result.number, result.received_at
        pictures = reversed(self._pictures)
        return next(
            (seen for seen in pictures if (seen.result_number, seen.result_received_at) == key),
            None,
        )

    def _by_time(self, result: Result[Any]) -> Frame | None:
        if result.triggered_at is None:  # the duration of the inspection is unknown
            return None
        triggered, received = result.triggered_at.timestamp(), result.received_at.timestamp()
        if self._dropped >= triggered:
            return None
        for picture in self._pictures:
            frame = picture.frame
            began = frame.utc - frame.duration
            if picture.result_number is None and triggered <= began <= frame.utc <= received:
                missing = picture.left_out or frame.lost  # perhaps the result's picture
                return None if missing else frame
        return None


def _size(picture: RecordedPicture) -> int:
    return memoryview(picture.frame.data).nbytes
