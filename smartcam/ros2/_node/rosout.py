"""Publish the log on the topic ``/rosout``."""

from __future__ import annotations

import asyncio
import collections
import contextlib
import logging
import threading
from typing import TYPE_CHECKING, Any, Final

from smartcam.exceptions import RosError
from smartcam.ros2._node.qos import QoS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.ros2._node.node import Node
    from smartcam.ros2._node.topics import RosPublisher

ROSOUT: Final = QoS(latched=True, depth=1000, lifespan=10.0)
"""Quality of ``/rosout``, as ``rcl_qos_profile_rosout_default`` (``logging_rosout.h`` of rcl)."""

MAX_WAITING_RECORDS = 1000
"""Largest number of records that wait for the event loop; beyond it the oldest is dropped."""

MAX_TEXT_CHARACTERS = 8000
"""Largest number of characters of a record's text."""

CLOSE_TIMEOUT = 1.0
CLOSE_CHECK_INTERVAL = 0.005

RECORDS_PER_TURN = 64
"""Number of records that are published in one turn of the event loop."""

DEBUG, WARN, FATAL = 10, 30, 50


class RosOut:
    """Publishes log records as ``rcl_interfaces/msg/Log``; threads that log never wait for it.

    Args:
        node: node that publishes; the messages have its name.
        logger: logger of the records; records of child loggers are published too.
        level: lowest published level of :mod:`logging`.
        is_wanted: function that returns True for a record to publish; None: publish all.

    Attributes:
        dropped: number of records dropped for want of room.
    """

    def __init__(
        self,
        node: Node,
        logger: logging.Logger,
        *,
        level: int = logging.WARNING,
        is_wanted: Callable[[logging.LogRecord], bool] | None = None,
    ) -> None:
        self.dropped: int = 0
        self._node, self._logger = node, logger
        self._waiting: collections.deque[dict[str, Any]] = collections.deque(
            maxlen=MAX_WAITING_RECORDS
        )
        self._passed_count = 0  # records passed to the publisher
        self._lock = threading.Lock()
        self._publish_scheduled = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._publisher: RosPublisher | None = None
        self._handler = _Handler(self._queue_record, level)
        self._name = node.full_name.strip("/").replace("/", ".")
        if is_wanted is not None:
            self._handler.addFilter(is_wanted)

    def start(self) -> None:
        """Publish from now on. Idempotent.

        Raises:
            RosError: the node is not open.
        """
        if self._publisher is None:
            self._loop = asyncio.get_running_loop()
            self._passed_count = 0
            self._publisher = self._node.publisher("/rosout", "rcl_interfaces/msg/Log", qos=ROSOUT)
            self._logger.addHandler(self._handler)

    async def close(self) -> None:
        """Publish waiting records within a second, and stop. Idempotent."""
        self._logger.removeHandler(self._handler)
        publisher = self._publisher
        if publisher is None:
            return
        while self._waiting:
            self._publish()
        self._publisher = None
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                while publisher.published + publisher.dropped < self._passed_count:  # noqa: ASYNC110
                    await asyncio.sleep(CLOSE_CHECK_INTERVAL)  # a thread publishes them
        except TimeoutError:
            pass  # the network does not accept them
        finally:
            publisher.close()

    def _queue_record(self, record: logging.LogRecord) -> None:
        """Queue a record; called in the thread that logs."""
        fields = self._fields(record)
        with self._lock:  # held only for a moment
            self.dropped += len(self._waiting) == MAX_WAITING_RECORDS
            self._waiting.append(fields)
        if not self._publish_scheduled and self._loop is not None:
            self._publish_scheduled = True
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._publish)

    def _fields(self, record: logging.LogRecord) -> dict[str, Any]:
        seconds, nanoseconds = divmod(round(record.created * 1e9), 1_000_000_000)
        child_name = record.name.removeprefix(self._logger.name)
        return {
            "stamp": {"sec": seconds, "nanosec": nanoseconds},
            "level": min(max(record.levelno // 10 * 10, DEBUG), FATAL),
            "name": _valid_text(
                self._name + child_name if child_name.startswith(".") else self._name
            ),
            "msg": _valid_text(_record_text(record)),
            "file": _valid_text(record.pathname),
            "function": _valid_text(record.funcName or ""),
            "line": min(max(record.lineno, 0), 0xFFFFFFFF),
        }

    def _publish(self) -> None:
        self._publish_scheduled = False  # first, so that a new record wakes the loop again
        publisher = self._publisher
        if publisher is None:
            self._waiting.clear()
            return
        with _ignoring_own_records():
            for _ in range(min(RECORDS_PER_TURN, len(self._waiting))):
                with contextlib.suppress(RosError):  # logging the error would call this again
                    publisher.publish(self._waiting.popleft())
                    self._passed_count += 1
        if self._waiting and not self._publish_scheduled and self._loop is not None:
            self._publish_scheduled = True
            self._loop.call_soon(self._publish)


class _Handler(logging.Handler):
    """Passes records on, except those that are logged while it passes one on in the same thread."""

    def __init__(self, handle_record: Callable[[logging.LogRecord], None], level: int) -> None:
        super().__init__(level)
        self._queue_record = handle_record

    def handle(self, record: logging.LogRecord) -> bool:
        """Handle a record without a lock, for which threads would wait."""
        if getattr(_thread_state, "inside", False) or not self.filter(record):
            return False
        self.emit(record)
        return True

    def emit(self, record: logging.LogRecord) -> None:
        """Pass the log record on."""
        with _ignoring_own_records():
            try:
                self._queue_record(record)
            except Exception:  # noqa: BLE001 - like the handlers of logging
                self.handleError(record)


_thread_state = threading.local()


@contextlib.contextmanager
def _ignoring_own_records() -> Iterator[None]:
    was_inside = getattr(_thread_state, "inside", False)
    _thread_state.inside = True
    try:
        yield
    finally:
        _thread_state.inside = was_inside


_formatter: Final = logging.Formatter()


def _record_text(record: logging.LogRecord) -> str:
    try:
        return _formatter.format(record)
    except Exception as exc:  # noqa: BLE001 - arguments of other programs may raise any error
        return f"{record.msg!s} ({type(exc).__name__}: {exc})"


def _valid_text(text: str) -> str:
    """Return a text without characters that a message cannot have."""
    cut = text if len(text) <= MAX_TEXT_CHARACTERS else f"{text[:MAX_TEXT_CHARACTERS]} ..."
    return cut.replace("\0", "\\0").encode(errors="backslashreplace").decode()
