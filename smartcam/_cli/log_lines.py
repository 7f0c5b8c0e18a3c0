"""A log as lines of JSON, for programs that collect logs; ``docs/operations.md`` has the fields.

Any thread may log. A line is put into a bounded queue, and a thread writes it: if the pipe is not
read, only that thread waits. Lines without room are dropped and counted, and their number is logged
as soon as there is room.
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

MAX_WAITING = 10_000
"""Largest number of lines that may wait to be written."""

MAX_TEXT_CHARACTERS = 1 << 16
"""Largest number of characters of a message, or of an exception's text; the rest is cut."""

FAREWELL_TIMEOUT = 1.0
"""Seconds that the last lines may take at the end."""

FIELDS = ("time", "level", "logger", "message", "agent", "camera", "exception", "dropped")
"""The fields of a line, in this order; the last two are left out without a value."""


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
        except Exception as exc:  # noqa: BLE001 - arguments that do not fit are somebody's mistake
            message = f"{record.msg!r} {record.args!r} ({exc})"
        fields: dict[str, Any] = {
            "time": _time(record.created),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": message[:MAX_TEXT_CHARACTERS],
            "agent": self._agent() or None,
            "camera": self._camera(record),
        }
        if record.exc_info and record.exc_info[0] is not None:
            fields["exception"] = self.formatException(record.exc_info)[-MAX_TEXT_CHARACTERS:]
        elif record.exc_text:
            fields["exception"] = record.exc_text[-MAX_TEXT_CHARACTERS:]
        return json.dumps(fields)

    def _camera(self, record: logging.LogRecord) -> str | None:
        """Return the camera whose name a record has as an argument, None without one."""
        camera = getattr(record, "camera", None)
        if isinstance(camera, str):
            return camera
        cameras = self._cameras()
        given = record.args if isinstance(record.args, tuple) else ()
        for argument in given[:2]:
            name = str(argument) if isinstance(argument, str | Exception) else ""
            for part in (name, name.partition(": ")[0]):
                if part and part in cameras:
                    return part
        return None


def _time(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")


class LineHandler(logging.Handler):
    """Writes lines to a file in a thread, and never waits for it.

    Args:
        descriptor: descriptor of the file.
        most: largest number of lines that wait.

    Attributes:
        dropped: number of lines that found no room.
    """

    def __init__(self, descriptor: int, most: int = MAX_WAITING) -> None:
        super().__init__()
        self.dropped: int = 0
        self._reported = 0
        self._descriptor = descriptor
        self._lines: queue.Queue[str | None] = queue.Queue(most)
        self._ending = threading.Event()
        self._over = threading.Event()
        # a daemon, since it may hang in a pipe at the end of the process
        self._thread = threading.Thread(target=self._write_all, name="smartcam.log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Add a record."""
        try:
            self._lines.put_nowait(self.format(record))
        except queue.Full:
            self.dropped += 1  # the handler's lock is held
        except Exception:  # noqa: BLE001 - the last place
            self.handleError(record)

    def close(self) -> None:
        """Write the waiting lines, in bounded time. Idempotent."""
        if not self._ending.is_set():
            self._ending.set()
            with contextlib.suppress(queue.Full):
                self._lines.put_nowait(None)  # wakes the thread, if it waits
            self._over.wait(FAREWELL_TIMEOUT)
        super().close()

    def _write_all(self) -> None:
        try:
            while not (self._ending.is_set() and self._lines.empty()):
                line = self._lines.get()
                if line is not None:
                    self._write(line)
                if (dropped := self.dropped) > self._reported:
                    self._write(self._lost(dropped - self._reported))
                    self._reported = dropped
        except OSError:
            pass  # the reader is gone
        finally:
            self._over.set()

    def _lost(self, count: int) -> str:
        made = {"name": "smartcam.log", "levelno": logging.WARNING, "levelname": "WARNING"}
        text = f"{count} lines of this log were dropped: they were not read fast enough"
        fields = json.loads(self.format(logging.makeLogRecord({**made, "msg": text})))
        return json.dumps({**fields, "dropped": count})

    def _write(self, line: str) -> None:
        left = memoryview(f"{line}\n".encode())
        while left:
            try:
                left = left[os.write(self._descriptor, left) :]
            except BlockingIOError:  # another program has made the pipe non-blocking
                select.select([], [self._descriptor], [], 1.0)


@contextlib.contextmanager
def json_log(
    level: int,
    agent: Callable[[], str],
    cameras: Callable[[], Container[str]],
    *,
    descriptor: int = 2,
    most: int = MAX_WAITING,
) -> Iterator[LineHandler]:
    """Write all logs of this process as lines of JSON, while the block runs."""
    root = logging.getLogger()
    handlers, before = root.handlers[:], root.level
    handler = LineHandler(descriptor, most)
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
        root.setLevel(before)
        for old_handler in handlers:
            root.addHandler(old_handler)
        handler.close()
