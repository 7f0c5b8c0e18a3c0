"""A small foreign client: blocking sockets, the dialect handbook, bytes by hand.

It uses nothing of smartcam. It does its tasks well, unless an option makes it sin::

    python plain_client.py HOST PORT SINS trigger [N] | switch ID | watch N
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from smartcam.conformance.client import Task

MAGIC = bytes.fromhex("50535642")
CONNECT, DISCONNECT, STATUS, RESULT, QUERY, SWITCH = 0x01, 0x02, 0x12, 0x20, 0x30, 0x31
TRIGGER, START, STOP = 0x40, 0x41, 0x42
BUSY, RUNNING, OVERTRIGGERED, WAITING = 0x010, 0x080, 0x100, 0x200
KNOWN = (CONNECT, STATUS, RESULT, QUERY, SWITCH)
SECONDS = 1.0
LARGEST = 1 << 16


class TaskError(Exception):
    """The task is not done."""


class PlainClient:
    """One session."""

    def __init__(self, task: Task, sins: frozenset[str], seconds: float = SECONDS) -> None:
        self.task = task  # what to do
        self.seconds = seconds  # for each wait; three times as many for all
        self.sins = sins  # what to do wrong
        self.status = 0
        self.active = 0
        self.results: list[tuple[int, bytes]] = []
        self._buffer = b""
        self._began = time.monotonic()
        self._socket = socket.create_connection((task.host, task.port), seconds)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def run(self) -> list[bytes]:
        """Do the task."""
        with self._socket:
            self.connect()
            found = self.watch() if self.task.verb == "watch" else self.inspect()
            if "no disconnect" not in self.sins:
                self.send(DISCONNECT)
                self._socket.shutdown(socket.SHUT_WR)
                self.drain()
            return found

    def connect(self) -> None:
        if "query first" in self.sins:
            self.send(QUERY)
        self.send(CONNECT)
        self.wait(CONNECT)
        if "does not wait" not in self.sins:
            self.wait(STATUS)
        self.send(QUERY, times=2 if "two queries" in self.sins else 1)
        self.active = struct.unpack("<I", self.wait(QUERY))[0]
        if "unknown request" in self.sins:
            self.send(0x99)

    def inspect(self) -> list[bytes]:
        if self.task.verb == "switch":
            self.switch(self.task.number or 0)
            return [self.trigger()]
        count = self.task.number or 1
        if "one for all" in self.sins:
            return [self.trigger()] * count
        return [self.trigger() for _ in range(count)]

    def watch(self) -> list[bytes]:
        if "triggers" in self.sins:
            self.send(TRIGGER)
        if "watches too little" in self.sins:
            return []
        self.until(lambda: len(self.results) >= (self.task.number or 1))
        return [data for _, data in self.results[: self.task.number]]

    def switch(self, number: int) -> None:
        if "does not switch" in self.sins:
            return
        if "switches in run mode" not in self.sins:
            self.send(STOP)
            self.until(lambda: not self.status & RUNNING)
        self.send(SWITCH, struct.pack("<I", number))
        if "starts at once" not in self.sins:
            code, self.active = struct.unpack("<II", self.wait(SWITCH))
            if code and "believes" not in self.sins:
                raise TaskError(f"code {code}")
        if "ignores busy" not in self.sins:
            self.until(lambda: not self.status & BUSY)
        self.send(START)

    def trigger(self) -> bytes:
        if not self.sins & {"does not wait", "ignores busy"}:
            self.until(lambda: self.status & WAITING)
        if "does not wait" not in self.sins:
            self.results.clear()
        for _ in range(2 if "triggers twice" in self.sins else 1):
            self.send(TRIGGER)

        def done() -> bool:
            if self.status & OVERTRIGGERED and not self.sins & {"waits for ever", "looks away"}:
                raise TaskError("overtriggered")
            if "any application" in self.sins:
                return bool(self.results)
            return any(number == self.active for number, _ in self.results)

        self.until(done)
        number, data = next(
            one for one in self.results if one[0] == self.active or "any application" in self.sins
        )
        self.results.remove((number, data))
        return struct.pack("<I", number) + data if "id too" in self.sins else data

    # ------------------------------------------------------------------ messages

    def send(self, number: int, body: bytes = b"", *, times: int = 1) -> None:
        self._socket.sendall((MAGIC + struct.pack("<II", len(body), number) + body) * times)

    def wait(self, wanted: int) -> bytes:
        """Return the body of the next message of a kind."""
        while True:
            number, body = self.take()
            if number == wanted:
                return body
            if "next is the answer" in self.sins and wanted in {QUERY, SWITCH}:
                raise TaskError(f"{number:#x} came, {wanted:#x} was expected")

    def until(self, condition: Callable[[], object]) -> None:
        while not condition():
            self.take()

    def take(self) -> tuple[int, bytes]:
        number, body = self.read()
        if number == STATUS:
            self.status = struct.unpack_from("<I", body)[0]
            if self.status & ~0x397 and "knows all" in self.sins:
                raise TaskError(f"status {self.status:#x}")
        elif number == RESULT:
            self.results.append((struct.unpack_from("<I", body)[0], body[4:]))
        elif number not in KNOWN and "knows all" in self.sins:
            raise TaskError(f"message {number:#x}")
        return number, body

    def read(self) -> tuple[int, bytes]:
        if "a message is what comes" in self.sins:
            data = self.more()
            return data[8], data[12:]
        while len(self._buffer) < 12:
            self._buffer += self.more()
        length, number = struct.unpack_from("<II", self._buffer, 4)
        wrong = not self._buffer.startswith(MAGIC) or length > LARGEST
        if wrong and "waits for ever" not in self.sins:
            raise TaskError(f"no frame: {self._buffer[:12].hex()}")
        while len(self._buffer) < 12 + length:
            self._buffer += self.more()
        body, self._buffer = self._buffer[12 : 12 + length], self._buffer[12 + length :]
        return number, body

    def more(self) -> bytes:
        patient = "waits for ever" in self.sins
        left = self._began + 3 * self.seconds - time.monotonic()
        self._socket.settimeout(None if patient else max(0.001, min(self.seconds, left)))
        data = self._socket.recv(4096)
        if not data:
            raise TaskError("the camera closed the connection")
        return data

    def drain(self) -> None:
        """Read to the end, so that closing does not reset the connection."""
        self._socket.settimeout(self.seconds)
        with contextlib.suppress(OSError):
            while self._socket.recv(4096):
                pass


def plain_client(*sins: str, seconds: float = SECONDS) -> Callable[[Task], list[bytes]]:
    """Return a client that does its tasks, with these sins."""

    def perform(task: Task) -> list[bytes]:
        try:
            return PlainClient(task, frozenset(sins), seconds).run()
        except (OSError, TaskError):
            if "all is well" in sins:
                return []
            raise

    return perform


def main() -> None:
    """Do the task that the arguments say, and print its results."""
    host, port, sins, verb, *number = sys.argv[1:]
    if verb == "watch" and "cannot watch" in sins:
        sys.stderr.write("not written yet")
        sys.exit(77)
    count = int(number[0]) if number else None
    task: Any = SimpleNamespace(host=host, port=int(port), verb=verb, number=count)
    for data in plain_client(*sins.split(","), seconds=60)(task):
        sys.stdout.write(data.hex() + "\n")


if __name__ == "__main__":
    main()
