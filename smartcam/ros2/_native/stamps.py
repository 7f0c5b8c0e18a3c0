"""Convert the stamps of messages to ROS' time, for a node with ``use_sim_time``.

All stamps come from the system's clock, and are converted when a message leaves the node. To the
stamp of a first message the present difference of ROS' time and the system's is added. Later
messages with the same stamp, such as a picture's CameraInfo, get the same new stamp.
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
    """Converts the stamps of messages to ROS' time.

    Args:
        shift: function that returns the seconds by which ROS' time is ahead of the system's.
    """

    def __init__(self, shift: Callable[[], float]) -> None:
        self._time_shift = shift
        self._shifted_stamps: collections.OrderedDict[int, int] = collections.OrderedDict()
        self._lock = threading.Lock()

    def to_ros_time(self, message_type: MessageType, data: bytes) -> bytes:
        """Return a message with the stamps of its headers in ROS' time."""
        message = message_type.decode(data)
        for header in iter_headers(message_type, message):
            stamp = header.stamp
            shifted = self._shift_stamp(stamp.sec * BILLION + stamp.nanosec)
            stamp.sec, stamp.nanosec = divmod(shifted, BILLION)
        return message_type.encode(message)

    def _shift_stamp(self, stamp: int) -> int:
        with self._lock:
            shifted = self._shifted_stamps.get(stamp)
            if shifted is None:
                shifted = max(0, stamp + round(self._time_shift() * BILLION))
                self._shifted_stamps[stamp] = shifted
                if len(self._shifted_stamps) > MAX_STAMPS:
                    self._shifted_stamps.popitem(last=False)
            return shifted


def iter_headers(message_type: MessageType, message: Any) -> Iterator[Any]:
    """Yield the headers in a message."""
    for field in message_type.fields:
        if not field.nested:
            continue
        value = getattr(message, field.attribute)
        for part in value if field.shape else (value,):
            if field.type == HEADER:
                yield part
            else:
                yield from iter_headers(message_type.nested[field.type], part)
