"""Find the picture of each result."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam.models import Result
from smartcam.recording._mcap.form import RecordedPicture

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from datetime import datetime

    from smartcam.frames import Frame
    from smartcam.recording._mcap.form import Item

MAX_PICTURES: Final = 256
"""Largest number of pictures of a camera that are kept for its results."""

MAX_PICTURE_BYTES: Final = 1 << 28
"""Largest number of bytes that the kept pictures of a camera may have together; the last
picture is kept in any case."""

MAX_RESULTS: Final = 1000
"""Largest number of results of a camera that wait for their pictures."""


class ResultWithPicture(NamedTuple):
    """A result and its picture.

    Attributes:
        result: result of the camera.
        picture: picture of the result; None if it is unknown.
        linked: True if the picture was recorded with the result's number, as after
            ``read_image()``; False if the picture was found by its time. That works only if the
            recording client sent the trigger; otherwise ``picture`` is None.
    """

    result: Result[Any]
    picture: Frame | None
    linked: bool


def match_pictures(items: Iterable[Item]) -> Iterator[ResultWithPicture]:
    """Yield each result with its picture, as soon as no later picture can belong to the result."""
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
            yield from matcher.take_matched()
    for matcher in matchers.values():
        yield from matcher.take_matched(at_end=True)


class PictureMatcher:
    """Matches pictures and results of one camera.

    Args:
        max_bytes: largest number of bytes of the pictures that are kept for results; the last
            picture is kept in any case.

    Attributes:
        results: results whose picture is not known yet.
    """

    def __init__(self, max_bytes: int = MAX_PICTURE_BYTES) -> None:
        self.results: deque[Result[Any]] = deque()
        self._max_bytes = max_bytes
        self._pictures: deque[RecordedPicture] = deque()
        self._bytes = 0
        self._dropped_exposure_start = -math.inf  # exposure start of the last dropped picture
        self._latest_capture = 0.0  # capture of the last picture without a result's number, seconds

    def add_picture(self, picture: RecordedPicture) -> None:
        self._pictures.append(picture)
        self._bytes += _size(picture)
        if picture.result_number is None:
            self._latest_capture = max(self._latest_capture, picture.frame.utc)
        too_many = len(self._pictures) > MAX_PICTURES
        while too_many or (self._bytes > self._max_bytes and len(self._pictures) > 1):
            dropped = self._pictures.popleft()
            self._bytes -= _size(dropped)
            if dropped.result_number is None:
                self._dropped_exposure_start = max(
                    self._dropped_exposure_start, dropped.frame.utc - dropped.frame.duration
                )
            too_many = False

    def take_matched(self, *, at_end: bool = False) -> Iterator[ResultWithPicture]:
        """Remove and yield the results whose picture is known, or can no longer come.

        Args:
            at_end: whether no more pictures come.
        """
        while self.results:
            result = self.results[0]
            recorded = self._linked_picture(result)
            linked = recorded is not None
            if not (linked or at_end or self._need_not_wait(result)):
                return
            self.results.popleft()
            picture = self._picture_by_time(result) if recorded is None else recorded.frame
            yield ResultWithPicture(result, picture, linked)

    def take_matched_by_time(self) -> Iterator[ResultWithPicture]:
        """Remove and yield the results whose picture is found by its time or can no longer come."""
        while self.results:
            result = self.results[0]
            picture = self._picture_by_time(result)
            can_be_found = result.triggered_at is not None
            if picture is None and can_be_found and not self._need_not_wait(result):
                return
            self.results.popleft()
            yield ResultWithPicture(result, picture, False)

    def _need_not_wait(self, result: Result[Any]) -> bool:
        """Return True if a later picture has come, or too many results wait."""
        return (
            self._latest_capture > result.received_at.timestamp() or len(self.results) > MAX_RESULTS
        )

    def _linked_picture(self, result: Result[Any]) -> RecordedPicture | None:
        key = result.number, result.received_at
        pictures = reversed(self._pictures)
        return next((picture for picture in pictures if _result_key(picture) == key), None)

    def _picture_by_time(self, result: Result[Any]) -> Frame | None:
        if result.triggered_at is None:  # the duration of the inspection is unknown
            return None
        triggered, received = result.triggered_at.timestamp(), result.received_at.timestamp()
        if self._dropped_exposure_start >= triggered:
            return None
        for picture in self._pictures:
            frame = picture.frame
            exposure_start = frame.utc - frame.duration
            if (
                picture.result_number is None
                and triggered <= exposure_start <= frame.utc <= received
            ):
                missing = picture.left_out or frame.lost  # a missing picture may be the result's
                return None if missing else frame
        return None


def _result_key(picture: RecordedPicture) -> tuple[int | None, datetime | None]:
    return picture.result_number, picture.result_received_at


def _size(picture: RecordedPicture) -> int:
    return memoryview(picture.frame.data).nbytes
