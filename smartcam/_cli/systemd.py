"""Notify systemd by datagrams to the socket that NOTIFY_SOCKET names; see sd_notify(3).

Without this variable, nothing is done. No function here blocks or raises because of the socket,
since the program must run on without it.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

logger: logging.Logger = logging.getLogger("smartcam.systemd")

MAX_STATUS_CHARACTERS = 500
"""Largest number of characters of a status: one line in ``systemctl status``."""

MAX_UNSENT = 32
"""Largest number of datagrams that wait while the socket is full."""

STATUS_PERIOD = 5.0
"""Largest number of seconds between two checks of the status; a watchdog may need more checks."""


class Notifier:
    """Reports the state of a program to systemd.

    Args:
        environment: environment with NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID.

    Attributes:
        is_wanted: whether systemd wants reports.
        watchdog: seconds within which systemd expects each watchdog report; None: it expects none.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        if environment is None:
            environment = os.environ
        self._address = _socket_address(environment.get("NOTIFY_SOCKET", ""))
        self.is_wanted: bool = self._address is not None
        self.watchdog: float | None = _watchdog_time(environment)
        self._socket: socket.socket | None = None
        self._unsent: list[bytes] = []  # messages kept while the socket is full
        self._failure_logged = False
        self._status = ""

    def report_ready(self, status: str) -> None:
        """Report that the program is ready, or ready again after a reload."""
        self._send("READY=1", self._status_line(status), keep=True)

    def report_reloading(self, status: str) -> None:
        """Report that a reload has begun; :meth:`report_ready` reports its end."""
        now = time.monotonic_ns() // 1000
        self._send("RELOADING=1", f"MONOTONIC_USEC={now}", self._status_line(status), keep=True)

    def report_stopping(self) -> None:
        """Report that the program ends."""
        self._send("STOPPING=1", self._status_line("stopping"), keep=True)

    def report_status(self, status: str) -> None:
        """Report the status, if it has changed."""
        old_status = self._status
        line = self._status_line(status)
        if self._status != old_status:
            self._send(line)

    def report_alive(self) -> None:
        """Report to the watchdog that the event loop runs."""
        self._send("WATCHDOG=1")

    def close(self) -> None:
        """Stop reporting."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _status_line(self, status: str) -> str:
        self._status = " ".join(status.split())[:MAX_STATUS_CHARACTERS]
        return f"STATUS={self._status}"

    def _send(self, *lines: str, keep: bool = False) -> None:
        """Send a datagram; with ``keep``, send it later if there is no room now."""
        if self._address is None:
            return
        self._unsent.append("\n".join(lines).encode(errors="replace"))
        try:
            if self._socket is None:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
                self._socket.setblocking(False)
            while self._unsent:
                self._socket.sendto(self._unsent[0], self._address)
                del self._unsent[0]
            self._failure_logged = False
        except OSError as exc:
            if not keep:
                del self._unsent[-1]
                self._status = ""  # so that it is sent again
            del self._unsent[:-MAX_UNSENT]
            if not self._failure_logged:
                logger.warning("reports to systemd by NOTIFY_SOCKET fail: %s", exc)
            self._failure_logged = True

    @contextlib.contextmanager
    def reporting(self, status: Callable[[], str]) -> Iterator[None]:
        """Report status and watchdog periodically from the event loop, while the block runs.

        A period is at most half of the watchdog's time. A loop that hangs does not report, so
        systemd kills the process.
        """
        if not self.is_wanted:
            yield
            return
        loop = asyncio.get_running_loop()
        period = STATUS_PERIOD if self.watchdog is None else min(STATUS_PERIOD, self.watchdog / 2)
        timer: asyncio.TimerHandle | None = None

        def tick() -> None:
            nonlocal timer
            timer = loop.call_later(period, tick)
            if self.watchdog is not None:
                self.report_alive()
            self.report_status(status())

        tick()
        try:
            yield
        finally:
            if timer is not None:
                timer.cancel()


def _socket_address(text: str) -> str | None:
    """Return the address of a socket; the text of an abstract address begins with ``@``."""
    if text.startswith("@") and len(text) > 1:
        return "\0" + text[1:]
    if text.startswith("/"):
        return text
    if text:
        logger.warning("NOTIFY_SOCKET: expected /PATH or @NAME, got %r; nothing is reported", text)
    return None


def _watchdog_time(environment: Mapping[str, str]) -> float | None:
    """Return the time of systemd's watchdog, seconds; None if this process has no watchdog."""
    text, process = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not text or (process and process != str(os.getpid())):
        return None
    if not text.isdecimal() or not int(text):
        logger.warning("WATCHDOG_USEC: expected microseconds, got %r; there is no watchdog", text)
        return None
    return int(text) / 1e6
