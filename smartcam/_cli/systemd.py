"""Notify systemd: one datagram each to the socket that NOTIFY_SOCKET names; see sd_notify(3).

Without this variable, nothing is done. Nothing here blocks or raises, since a monitor must not be
able to stop the program.
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
STATUS_PERIOD = 5.0
"""Seconds between two checks of the status, unless a watchdog needs more."""


class Notifier:
    """Reports the state of a program to systemd.

    Args:
        environment: environment with NOTIFY_SOCKET, WATCHDOG_USEC and WATCHDOG_PID.

    Attributes:
        wanted: whether systemd wants reports.
        watchdog: seconds within which systemd expects a sign of life; None: it expects none.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        given = os.environ if environment is None else environment
        self._address = _address(given.get("NOTIFY_SOCKET", ""))
        self.wanted: bool = self._address is not None
        self.watchdog: float | None = _watchdog(given)
        self._socket: socket.socket | None = None
        self._unsent: list[bytes] = []  # messages kept while the socket is full
        self._failed = False
        self._status = ""

    def ready(self, status: str) -> None:
        """Report that the program is ready, or ready again after a reload."""
        self._send("READY=1", self._status_line(status), keep=True)

    def reloading(self, status: str) -> None:
        """Report that a reload has begun; :meth:`ready` reports its end."""
        now = time.monotonic_ns() // 1000
        self._send("RELOADING=1", f"MONOTONIC_USEC={now}", self._status_line(status), keep=True)

    def stopping(self) -> None:
        """Report that the program ends."""
        self._send("STOPPING=1", self._status_line("stopping"), keep=True)

    def status(self, status: str) -> None:
        """Report the state as text, if it has changed."""
        before = self._status
        line = self._status_line(status)
        if self._status != before:
            self._send(line)

    def alive(self) -> None:
        """Report that the event loop runs."""
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
            self._failed = False
        except OSError as exc:
            if not keep:
                del self._unsent[-1]
                self._status = ""  # to be sent again
            del self._unsent[:-MAX_UNSENT]
            if not self._failed:
                logger.warning("reports to systemd by NOTIFY_SOCKET fail: %s", exc)
            self._failed = True

    @contextlib.contextmanager
    def telling(self, status: Callable[[], str]) -> Iterator[None]:
        """Make the event loop report periodically, while the block runs.

        It reports at half of the watchdog's time. A loop that hangs does not, and is killed.
        """
        if not self.wanted:
            yield
            return
        loop = asyncio.get_running_loop()
        period = STATUS_PERIOD if self.watchdog is None else min(STATUS_PERIOD, self.watchdog / 2)
        timer: asyncio.TimerHandle | None = None

        def tick() -> None:
            nonlocal timer
            timer = loop.call_later(period, tick)
            if self.watchdog is not None:
                self.alive()
            self.status(status())

        tick()
        try:
            yield
        finally:
            if timer is not None:
                timer.cancel()


def _address(given: str) -> str | None:
    """Return the address of a socket; an abstract one begins with ``@``."""
    if given.startswith("@") and len(given) > 1:
        return "\0" + given[1:]
    if given.startswith("/"):
        return given
    if given:
        logger.warning("NOTIFY_SOCKET: expected /PATH or @NAME, got %r; nothing is reported", given)
    return None


def _watchdog(given: Mapping[str, str]) -> float | None:
    """Return the seconds of systemd's watchdog, None if it is not for this process."""
    text, process = given.get("WATCHDOG_USEC", ""), given.get("WATCHDOG_PID", "")
    if not text or (process and process != str(os.getpid())):
        return None
    if not text.isdecimal() or not int(text):
        logger.warning("WATCHDOG_USEC: expected microseconds, got %r; there is no watchdog", text)
        return None
    return int(text) / 1e6
