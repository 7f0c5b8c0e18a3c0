"""A log as lines of JSON, for programs that collect logs; ``docs/operations.md`` has the fields.

Any thread may log. A line is put into a bounded queue, and a thread of its own writes it: if nobody
reads the pipe, only that thread waits. Lines that find the queue full are dropped and counted, and
their number is logged as soon as the thread writes again.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import select
import threading
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Iterator

MAX_WAITING_LINES = 10_000
"""Largest number of lines that may wait to be written."""

MAX_TEXT_CHARACTERS = 1 << 16
"""Largest number of characters of a message, or of an exception's text; the rest is cut."""

CLOSE_TIMEOUT = 1.0
"""Longest time to write the waiting lines at the end, seconds."""

FIELDS = ("time", "level", "logger", "message", "agent", "camera", "exception", "dropped")
"""The fields of a line, in this order; the last two only if they have a value."""


class JsonLines(logging.Formatter):
    """Formats a record as a line.

    Args:
        agent: function that returns the agent's name.
        cameras: function that returns the names of its cameras.
    """

    def __init__(self, agent: Callable[[], str], cameras: Callable[[], Container[str]]) -> None:
        super().__init__()
        self._agent, self._cameras = agent, cameras

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        try:
            message = record.getMessage()
        except Exception as exc:  # noqa: BLE001 - any error of arguments that do not fit the format
            message = f"{record.msg!r} {record.args!r} ({exc})"
        fields: dict[str, Any] = {
            "time": _iso_time(record.created),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": message[:MAX_TEXT_CHARACTERS],
            "agent": self._agent() or None,
            "camera": self._find_camera(record),
        }
        if record.exc_info and record.exc_info[0] is not None:
            fields["exception"] = self.formatException(record.exc_info)[-MAX_TEXT_CHARACTERS:]
        elif record.exc_text:
            fields["exception"] = record.exc_text[-MAX_TEXT_CHARACTERS:]
        return json.dumps(fields)

    def _find_camera(self, record: logging.LogRecord) -> str | None:
        """Return the name of the camera that a record is about, None if it names none."""
        camera = getattr(record, "camera", None)
        if isinstance(camera, str):
            return camera
        cameras = self._cameras()
        arguments = record.args if isinstance(record.args, tuple) else ()
        for argument in arguments[:2]:
            name = str(argument) if isinstance(argument, str | Exception) else ""
            for part in (name, name.partition(": ")[0]):
                if part and part in cameras:
                    return part
        return None


def _iso_time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")


class LineHandler(logging.Handler):
    """Writes lines to a file in a thread; logging never waits for the file.

    Args:
        descriptor: descriptor of the file.
        max_lines: largest number of lines that wait.

    Attributes:
        dropped_count: number of lines that found the queue full.
    """

    def __init__(self, descriptor: int, max_lines: int = MAX_WAITING_LINES) -> None:
        super().__init__()
        self.dropped_count: int = 0
        self._reported_count = 0
        self._descriptor = descriptor
        self._lines: queue.Queue[str | None] = queue.Queue(max_lines)
        self._closing = threading.Event()
        self._finished = threading.Event()
        # a daemon thread, since a write to a full pipe may block it when the process ends
        self._thread = threading.Thread(target=self._write_all, name="smartcam.log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Add a record."""
        try:
            self._lines.put_nowait(self.format(record))
        except queue.Full:
            self.dropped_count += 1  # the handler's lock is held
        except Exception:  # noqa: BLE001 - as logging's own handlers do
            self.handleError(record)

    def close(self) -> None:
        """Write the waiting lines, in bounded time. Idempotent."""
        if not self._closing.is_set():
            self._closing.set()
            with contextlib.suppress(queue.Full):
                self._lines.put_nowait(None)  # wakes the thread, if it waits
            self._finished.wait(CLOSE_TIMEOUT)
        super().close()

    def _write_all(self) -> None:
        try:
            while not (self._closing.is_set() and self._lines.empty()):
                line = self._lines.get()
                if line is not None:
                    self._write(line)
                if (dropped_count := self.dropped_count) > self._reported_count:
                    self._write(self._dropped_line(dropped_count - self._reported_count))
                    self._reported_count = dropped_count
        except OSError:
            pass  # nobody reads the pipe any more
        finally:
            self._finished.set()

    def _dropped_line(self, count: int) -> str:
        """Return the line that reports dropped lines."""
        attributes = {"name": "smartcam.log", "levelno": logging.WARNING, "levelname": "WARNING"}
        text = f"{count} lines of this log were dropped: they were not read fast enough"
        fields = json.loads(self.format(logging.makeLogRecord({**attributes, "msg": text})))
        return json.dumps({**fields, "dropped": count})

    def _write(self, line: str) -> None:
        unwritten = memoryview(f"{line}\n".encode())
        while unwritten:
            try:
                unwritten = unwritten[os.write(self._descriptor, unwritten) :]
            except BlockingIOError:  # another program has made the pipe non-blocking
                select.select([], [self._descriptor], [], 1.0)


@contextlib.contextmanager
def json_log(
    level: int,
    agent: Callable[[], str],
    cameras: Callable[[], Container[str]],
    *,
    descriptor: int = 2,
    max_lines: int = MAX_WAITING_LINES,
) -> Iterator[LineHandler]:
    """Write all logs of this process as lines of JSON, while the block runs."""
    root = logging.getLogger()
    handlers, old_level = root.handlers[:], root.level
    handler = LineHandler(descriptor, max_lines)
    handler.setFormatter(JsonLines(agent, cameras))
    for old_handler in handlers:
        root.removeHandler(old_handler)
    root.addHandler(handler)
    root.setLevel(level)
    logging.captureWarnings(True)
    try:
        yield handler
    finally:
        logging.captureWarnings(False)
        root.removeHandler(handler)
        root.setLevel(old_level)
        for old_handler in handlers:
            root.addHandler(old_handler)
        handler.close()
