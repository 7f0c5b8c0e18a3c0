"""Conversations with the kernel's driver: recorded in a machine that has one, and replayed here.

A table has every answer once, and for each scenario which answers came, in their order. A replay
demands the same questions in the same order. How many pictures a reader has taken when it ends is
a matter of time: pictures that are left over are skipped, and where none is left there is none.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import threading
from pathlib import Path
from typing import Any, NamedTuple

from tests.frames.inside import Ioctl, abi, system

TABLE = Path(__file__).with_name("vivid.json")
WRAPPED = ("open", "close", "ioctl", "pages", "nodes", "now")
STREAM = ("DQBUF", "QBUF")


class Answer(NamedTuple):
    """A question to the kernel, and its answer."""

    asked: str
    """``open``, ``close``, or an ioctl's name."""
    given: str
    """The argument before, in hexadecimal digits without zeros at the end; a path."""
    error: int
    """errno, or 0."""
    got: str
    """The argument afterwards."""
    now: float
    """Of a picture that was taken: when, seconds of the monotonic clock."""


def digits(data: bytes | bytearray) -> str:
    return data.rstrip(b"\0").hex()


class Recorder:
    """Passes all on to the system, and writes down what came."""

    def __init__(self) -> None:
        self.real = {name: getattr(system, name) for name in WRAPPED}
        self.answers: dict[Answer, int] = {}
        self.scenarios: dict[str, list[int]] = {}
        self.told: list[int] = []

    def begin(self, scenario: str) -> None:
        self.told = self.scenarios[scenario] = []

    def table(self) -> str:
        """Return the table as JSON, an answer a line."""
        rows = ",\n".join(json.dumps(one) for one in self.answers)
        scenarios = json.dumps(self.scenarios, separators=(",", ":")).replace("],", "],\n")
        nodes = json.dumps(self.nodes())
        return f'{{"nodes": {nodes},\n"answers": [\n{rows}\n],\n"scenarios": {scenarios}\n}}\n'

    def _tell(self, *what: Any) -> None:
        self.told.append(self.answers.setdefault(Answer(*what), len(self.answers)))

    def open(self, path: str) -> int:
        try:
            device: int = self.real["open"](path)
        except OSError as exc:
            self._tell("open", path, exc.errno, "", 0)
            raise
        self._tell("open", path, 0, "", 0)
        return device

    def close(self, device: int) -> None:
        self._tell("close", "", 0, "", 0)
        self.real["close"](device)

    def ioctl(self, device: int, request: Ioctl, argument: bytearray) -> None:
        given = "" if request.name in STREAM else digits(argument)
        try:
            self.real["ioctl"](device, request, argument)
        except BlockingIOError:
            raise
        except OSError as exc:
            self._tell(request.name, given, exc.errno, "", 0)
            raise
        now = round(self.now(), 6) if request.name == "DQBUF" else 0
        self._tell(request.name, given, 0, "" if request.name == "QBUF" else digits(argument), now)

    def pages(self, device: int, length: int, offset: int) -> object:
        return self.real["pages"](device, length, offset)

    def nodes(self) -> dict[str, str]:
        found: dict[str, str] = self.real["nodes"]()
        return found

    def now(self) -> float:
        now: float = self.real["now"]()
        return now


class Pages:
    """A buffer; the driver writes other bytes into it when it has it back."""

    def __init__(self, length: int) -> None:
        self.data = bytearray(length)
        self.open = True

    def __getitem__(self, part: slice) -> bytes:
        assert self.open
        return bytes(self.data[part])

    def close(self) -> None:
        self.open = False


class Replay:
    """Answers as the kernel did, in the system's stead.

    Args:
        scenario: whose answers.
    """

    def __init__(self, scenario: str) -> None:
        table = json.loads(TABLE.read_text())
        answers: list[Answer] = [Answer(*one) for one in table["answers"]]
        self.left: list[Answer] = [answers[one] for one in reversed(table["scenarios"][scenario])]
        self.devices: set[int] = set()
        self.mapped: list[Pages] = []
        self.taken: list[bytes] = []
        self._nodes: dict[str, str] = table["nodes"]
        self._time = 0.0
        self._streaming: int | None = None
        self._given = False
        self._lock = threading.RLock()

    def open(self, path: str) -> int:
        answer = self._next("open")
        assert answer.given == path, (answer, path)
        self._refuse(answer)
        device = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.devices.add(device)
        return device

    def close(self, device: int) -> None:
        self._next("close")
        self.devices.remove(device)
        os.close(device)

    def ioctl(self, device: int, request: Ioctl, argument: bytearray) -> None:
        with self._lock:
            assert device in self.devices
            if request.name == "DQBUF" and (self._given or not self._picture_is_next()):
                raise BlockingIOError
            answer = self._next(request.name)
            if request.name not in STREAM:
                assert answer.given == digits(argument), (answer, digits(argument))
            self._refuse(answer)
            if request.name == "QBUF":
                self._write_again(argument)
                return
            argument[:] = bytes.fromhex(answer.got).ljust(len(argument), b"\0")
            if request.name == "DQBUF":
                self._time = answer.now
                self._write(argument)
                self._given = True  # the next one is there when the loop looks again
                asyncio.get_running_loop().call_soon(self._let)
            if request.name == "STREAMON":
                self._streaming = device
                self._show_whether_ready()
            if request.name == "STREAMOFF":
                self._streaming = None

    def pages(self, device: int, length: int, offset: int) -> Pages:
        assert device in self.devices
        self.mapped.append(Pages(length))
        return self.mapped[-1]

    def nodes(self) -> dict[str, str]:
        return self._nodes

    def now(self) -> float:
        if self._streaming is None:  # the stream begins a frame before its first picture
            coming = (one.now for one in reversed(self.left) if one.now)
            self._time = next(coming, self._time + 0.04) - 0.04
        return self._time

    def _let(self) -> None:
        self._given = False

    def _picture_is_next(self) -> bool:
        return bool(self.left) and self.left[-1].asked == "DQBUF"

    def _next(self, asked: str) -> Answer:
        with self._lock:
            while self.left and self.left[-1].asked != asked and self.left[-1].asked in STREAM:
                self.left.pop()  # a picture that nobody waited for
            assert self.left, f"{asked} is one question too many"
            answer = self.left.pop()
            assert answer.asked == asked, (answer, asked)
            self._show_whether_ready()
            return answer

    def _refuse(self, answer: Answer) -> None:
        if answer.error:
            raise OSError(answer.error, os.strerror(answer.error))

    def _show_whether_ready(self) -> None:
        """Make the descriptor readable while a picture, or an error, is there."""
        if self._streaming not in self.devices:
            return
        if self._picture_is_next() or (self.left and self.left[-1].asked == "QBUF"):
            os.eventfd_write(self._streaming, 1)
        else:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._streaming)

    def _write(self, argument: bytearray) -> None:
        """Fill the buffer with the frame's number."""
        self.taken.append(bytes(argument))
        place, *_, sequence = abi.FULL_BUFFER.unpack_from(argument)
        live = [one for one in self.mapped if one.open]
        live[place].data[:] = bytes([sequence % 251 + 1]) * len(live[place].data)

    def _write_again(self, argument: bytearray) -> None:
        live = [one for one in self.mapped if one.open]
        place = int.from_bytes(argument[:4], "little")
        if place < len(live):
            live[place].data[:] = bytes(len(live[place].data))
