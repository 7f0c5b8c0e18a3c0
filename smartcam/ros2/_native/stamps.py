"""Convert the stamps of messages to ROS' time, for a node with ``use_sim_time``.

All stamps come from the system's clock. When messages leave the node they are converted to ROS'
time: a stamp is moved by the seconds by which ROS' time is ahead when its first message leaves.
Later messages with the same stamp, such as a picture's lens, get the same new stamp.
"""

from __future__ import annotations

import collections
import threading
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.ros2._types.types import MessageType

HEADER = "std_msgs/msg/Header"

MAX_STAMPS = 256
"""Number of remembered stamps with their new values."""

BILLION = 1_000_000_000


class RosStamps:
    """Moves the stamps of messages to ROS' time.

    Args:
        shift: function that returns the seconds by which ROS' time is ahead of the system's.
    """

    def __init__(self, shift: Callable[[], float]) -> None:
        self._shift = shift
        self._moved_stamps: collections.OrderedDict[int, int] = collections.OrderedDict()
        self._lock = threading.Lock()

    def moved(self, kind: MessageType, data: bytes) -> bytes:
        """Return a message with the stamps of its headers in ROS' time."""
        message = kind.decode(data)
        for header in headers(kind, message):
            stamp = header.stamp
            moved = self._moved(stamp.sec * BILLION + stamp.nanosec)
            stamp.sec, stamp.nanosec = divmod(moved, BILLION)
        return kind.encode(message)

    def _moved(self, stamp: int) -> int:
        with self._lock:
            known = self._moved_stamps.get(stamp)
            if known is None:
                known = max(0, stamp + round(self._shift() * BILLION))
                self._moved_stamps[stamp] = known
                if len(self._moved_stamps) > MAX_STAMPS:
                    self._moved_stamps.popitem(last=False)
            return known


def headers(kind: MessageType, message: Any) -> Iterator[Any]:
    """Yield the headers in a message."""
    for field in kind.fields:
        if not field.nested:
            continue
        value = getattr(message, field.attribute)
        for part in value if field.shape else (value,):
            if field.type == HEADER:
                yield part
            else:
                yield from headers(kind.nested[field.type], part)
