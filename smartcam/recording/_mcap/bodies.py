"""The data of the frames that came last: a result's bytes are in one of them, and written once."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

MAX_FRAMES = 4096
"""Largest number of frames that are kept: a delivery has been traced whole before its first result
is told."""

MAX_CHARACTERS = 1 << 23
"""Largest number of characters of hex that they may have together; the last one is kept whatever it
has."""

Key = TypeVar("Key")
Value = TypeVar("Value")


class LastBodies(Generic[Key, Value]):
    """The values that a file said of its last frames with data.

    A writer asks for the number of a frame by its data, a reader for the data by the number.
    Both forget alike, so what one finds is there for the other.
    """

    def __init__(self) -> None:
        self._order: deque[tuple[Key, Value, int]] = deque()
        self._known: dict[Key, Value] = {}
        self._characters = 0

    def add(self, key: Key, value: Value, characters: int) -> None:
        """Keep a frame's, whose data has so many characters; forget what is beyond the bounds."""
        self._order.append((key, value, characters))
        self._known[key] = value
        self._characters += characters
        while self._characters > MAX_CHARACTERS or len(self._order) > MAX_FRAMES:
            if len(self._order) == 1:
                break
            key, value, characters = self._order.popleft()
            self._characters -= characters
            if self._known.get(key) is value:  # else a later frame has the same key
                del self._known[key]

    def get(self, key: Key) -> Value | None:
        """Return the value added for a key; None if it is not kept."""
        return self._known.get(key)
