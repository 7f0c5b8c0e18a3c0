"""Log lines that a camera causes, at a bounded rate, so that no camera floods the log."""

from __future__ import annotations

import logging
from dataclasses import dataclass

logger: logging.Logger = logging.getLogger("smartcam.client")

MAX_LINES = 20
"""Largest number of lines of one kind that a camera may cause in each period."""

PERIOD = 60.0
"""Seconds in which the lines of a kind are counted together."""


@dataclass(slots=True, eq=False)
class _Logged:
    """Count of the lines of one kind in the period that began at ``begun_at``."""

    begun_at: float
    count: int = 0


class LimitedLog:
    """The log lines that one camera causes; each kind has its own count.

    Callers name a kind by a text of their own, never by one that the camera sent.

    Args:
        name: the camera's name, which begins each line.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._kinds: dict[str, _Logged] = {}

    def log(self, kind: str, level: int, text: str, *values: object, now: float) -> None:
        """Log a line, unless many of its kind were logged; log later how many were left out.

        Args:
            kind: name of the kind, for people.
            level: level of the line.
            text: format string of the line, with ``%``.
            values: values for the format string.
            now: seconds of any clock that does not jump.
        """
        logged = self._kinds.setdefault(kind, _Logged(now))
        if now - logged.begun_at >= PERIOD:
            self._log_left_out(kind, level, logged)
            logged.begun_at, logged.count = now, 0
        logged.count += 1
        if logged.count <= MAX_LINES:
            logger.log(level, "%s %s", self._name, text % values)
        elif logged.count == MAX_LINES + 1:
            more = "%s ! more than %d lines of the kind %r in %g s: the others are only counted"
            logger.log(level, more, self._name, MAX_LINES, kind, PERIOD)

    def end(self) -> None:
        """Log the number of left-out lines at the session's end."""
        for kind, logged in self._kinds.items():
            self._log_left_out(kind, logging.WARNING, logged)
        self._kinds.clear()

    def _log_left_out(self, kind: str, level: int, logged: _Logged) -> None:
        left_out = logged.count - MAX_LINES
        if left_out > 0:
            text = "%s ! %d of the kind %r were not logged"
            logger.log(level, text, self._name, left_out, kind)
