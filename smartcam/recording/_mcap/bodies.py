"""Remember the data of the last frames, so that a result can refer to a frame with its bytes."""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

MAX_FRAMES = 4096
"""Largest number of kept frames: many frames may come together before their first result."""

MAX_CHARACTERS = 1 << 23
"""Largest number of hex characters of all kept frames; the last frame is kept in any case."""

Key = TypeVar("Key")
Value = TypeVar("Value")


class LastBodies(Generic[Key, Value]):
    """Values of a file's last frames that have data, by keys.

    A writer looks up the number of a frame by its data, a reader the data by the number. Both keep
    the same frames, so the reader finds each frame that the writer found.
    """

    def __init__(self) -> None:
        self._order: deque[tuple[Key, Value, int]] = deque()
        self._values: dict[Key, Value] = {}
        self._characters = 0

    def add(self, key: Key, value: Value, characters: int) -> None:
        """Keep a frame's value, and drop the oldest values beyond the bounds.

        Args:
            key: key of the frame.
            value: value of the frame.
            characters: number of hex characters of the frame's data.
        """
        self._order.append((key, value, characters))
        self._values[key] = value
        self._characters += characters
        while self._characters > MAX_CHARACTERS or len(self._order) > MAX_FRAMES:
            if len(self._order) == 1:
                break
            key, value, characters = self._order.popleft()
            self._characters -= characters
            if self._values.get(key) is value:  # otherwise a later frame has the same key
                del self._values[key]

    def get(self, key: Key) -> Value | None:
        """Return the value of a key; None if it is not kept."""
        return self._values.get(key)
