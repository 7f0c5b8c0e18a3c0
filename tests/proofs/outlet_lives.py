"""Lives of a process with outlets, and of a far end, for the proof of outlets: they die as planned.

Each life is a process that was forked. It dies at a line of smartcam's code, at a byte of a file
(the system ends whoever writes beyond a limit), or when it is killed.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import json
import os
import random
import resource
import signal
import socket
import sys
import threading
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import smartcam.outlets
from smartcam.backoff import Backoff
from smartcam.exceptions import OutletError
from smartcam.outlets import Outlet, OutletEntry, Outlets, OutletSettings
from smartcam.registry import OUTLETS
from tests.outlets.outletkit import result

LIFE_SECONDS = 240.0
"""Seconds within which a life ends or has delivered everything, also on a busy machine."""

pumps: Any = importlib.import_module("smartcam.outlets._pump")

PACKAGE = str(Path(smartcam.outlets.__file__).parent)

CAMERAS = ("line1/cam1", "line1/cam2", "cam3")


@dataclass(frozen=True)
class Life:
    """A plan of one life.

    Attributes:
        offers: results that are offered.
        line: line of smartcam's outlets at which the process dies; 0 for none.
        open_first: whether lines count only from the first offer on.
        byte: place in a file at which the process dies when it writes there; 0 for none.
        full: place in a file at which the disk is full for a while; 0 for none.
        clock: seconds by which the clock is off at the beginning, and at half of the offers.
        waiting: entries that wait in memory for the spool at most.
        room: bytes of the spool.
        policy: policy beyond that.
        drains: whether the life ends when everything is delivered, not before.
        gather: seconds in which entries gather before they are written.
        seed: seed of its pauses.
    """

    offers: int
    line: int = 0
    open_first: bool = False
    byte: int = 0
    full: int = 0
    clock: tuple[float, float] = (0.0, 0.0)
    waiting: int = 20_000
    room: int = 1 << 30
    policy: str = "drop_oldest"
    drains: bool = False
    gather: float = 0.0
    seed: int = 0


def value_of(life: int, number: int) -> dict[str, Any]:
    """Return the value of a result, which tells by itself whether it is whole."""
    text = "x" * (number * 37 % 400)
    return {"life": life, "n": number, "text": text, "sum": zlib.crc32(f"{life} {number}".encode())}


# ---------------------------------------------------------------------- the far end


class JournalSettings(OutletSettings):
    """The settings of an outlet to a journal."""

    port: int


class JournalOutlet(Outlet[JournalSettings]):
    """Sends lines, and waits until the journal has said that it has them."""

    settings_class = JournalSettings

    async def open(self) -> None:
        """Connect."""
        self._reader, self._writer = await asyncio.open_connection("127.0.0.1", self.settings.port)

    async def deliver(self, entries: Sequence[OutletEntry]) -> None:
        """Send entries and wait for the answer."""
        lines = [json.dumps([one.id, *one]) for one in entries]
        self._writer.write("".join(f"{one}\n" for one in [len(lines), *lines]).encode())
        await self._writer.drain()
        if await self._reader.readline() != b"taken\n":
            raise OutletError("the journal is gone")

    async def close(self) -> None:
        """Hang up."""
        with contextlib.suppress(AttributeError):
            self._writer.transport.abort()


def keep_journal(listener: socket.socket, path: Path, seed: int, faults: bool) -> None:
    """Take entries into a file, until killed; die, stall, or cut the line now and then.

    What comes with an id that is there already is not written again.
    """
    dice = random.Random(seed)  # noqa: S311
    journal = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND)
    whole = os.pread(journal, 1 << 30, 0).rpartition(b"\n")
    os.ftruncate(journal, len(whole[0]) + len(whole[1]))  # a line that was not finished
    while True:
        connection, _ = listener.accept()
        with connection, connection.makefile("rwb") as stream, contextlib.suppress(OSError):
            while count := stream.readline():
                lines = [stream.readline() for _ in range(int(count or b"0"))]
                if not lines[-1].endswith(b"\n"):
                    break
                _fault(dice, faults)
                if faults and dice.random() < 0.05:
                    break  # the line is cut before they are taken
                data = b"".join(lines)
                if faults and dice.random() < 0.05:  # die in the middle of a write
                    os.write(journal, data[: dice.randrange(len(data))])
                    os.kill(os.getpid(), signal.SIGKILL)
                os.write(journal, data)
                _fault(dice, faults)
                if faults and dice.random() < 0.05:
                    break  # the line is cut behind it: nobody knows whether they were taken
                stream.write(b"taken\n")
                stream.flush()


def _fault(dice: random.Random, faults: bool) -> None:
    if faults and dice.random() < 0.05:
        os.kill(os.getpid(), signal.SIGKILL)
    if faults and dice.random() < 0.03:
        time.sleep(0.15)  # longer than the outlet's timeout


# ---------------------------------------------------------------------- a life


def live(number: int, life: Life, section: dict[str, Any], folder: Path, say: int) -> int:
    """Live as planned, and say into a pipe what was done; return the exit code."""
    _step_clock(life.clock[0])
    pumps.DISK_RETRY_SECONDS = 0.005
    pumps.GATHER_SECONDS = life.gather
    pumps.MAX_WAITING = life.waiting
    pumps.LINGER = 0.05
    pumps.Backoff = lambda: Backoff(initial=0.002, maximum=0.02)
    OUTLETS.register("journal", JournalOutlet)
    if life.line:
        _die_at_line(life)
    if life.byte:
        signal.signal(signal.SIGXFSZ, signal.SIG_DFL)  # it ends the process as SIGKILL does
        _limit_files(life.byte)
    told = _Told(say)
    asyncio.run(_live(number, life, section, folder, told))
    return 0


class _Told:
    """Report of a life; the pipe keeps it also when the life ends at once."""

    def __init__(self, pipe: int) -> None:
        self._pipe = pipe
        self._last = ""

    def say(self, *words: object) -> None:
        text = " ".join(map(str, words))
        if text != self._last:
            self._last = text
            os.write(self._pipe, f"{text}\n".encode())


async def _live(
    number: int, life: Life, section: dict[str, Any], folder: Path, told: _Told
) -> None:
    dice, outlets = random.Random(life.seed), Outlets(section, folder)  # noqa: S311
    (pump,) = outlets._pumps.values()
    pump.spool._max_bytes, pump.spool._policy = life.room, life.policy  # type: ignore[assignment]
    async with outlets:
        told.say("epoch", pump.spool.epoch, pump._counts.results)
        _opened.append(True)

        def look() -> None:
            (state,) = outlets.states.values()
            assert state.counts.balanced, state.counts
            told.say("kept", pump._counts.results)

        for n in range(life.offers):
            if life.full and n == life.offers // 3:
                _limit_files(life.full)
            if n == life.offers // 2:
                _step_clock(life.clock[1])
            if life.full and n == 2 * life.offers // 3:
                _limit_files(resource.RLIM_INFINITY)
            camera = dice.choice(CAMERAS)
            told.say("offer", n, camera)
            outlets.offer_result(result(n, camera, value_of(number, n)))
            await asyncio.sleep(dice.choice([0, 0, 0, 0.0005, 0.002]))
            look()
        if life.drains:
            async with asyncio.timeout(LIFE_SECONDS):
                while await _wait(outlets):  # noqa: ASYNC110
                    await asyncio.sleep(0.002)
            look()
    _limit_files(resource.RLIM_INFINITY)
    (state,) = outlets.states.values()
    told.say("account", json.dumps(state.counts._asdict()))


async def _wait(outlets: Outlets) -> bool:
    """Return True while results or gaps wait for the far end."""
    (pump,) = outlets._pumps.values()
    query = "SELECT COUNT(*) FROM entries"
    left = await pump._run_in_thread(lambda: pump.spool._open_database.execute(query).fetchone()[0])
    return bool(left or pump.counts.spooled)


def _limit_files(size: int) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


_TRUE_TIMES = time.time, time.time_ns


def _step_clock(seconds: float) -> None:
    now, now_ns = _TRUE_TIMES
    time.time = lambda: now() + seconds
    time.time_ns = lambda: now_ns() + int(seconds * 1e9)


_opened: list[bool] = []


def _die_at_line(life: Life) -> None:
    """End the process at a line of smartcam's outlets, counted in all threads."""
    left = [life.line]

    def count(_frame: Any, event: str, _argument: Any) -> Any:
        if event == "line" and (_opened or not life.open_first):
            left[0] -= 1
            if left[0] <= 0:
                os.kill(os.getpid(), signal.SIGKILL)
        return count

    def call(frame: Any, _event: str, _argument: Any) -> Any:
        return count if frame.f_code.co_filename.startswith(PACKAGE) else None

    threading.settrace(call)
    sys.settrace(call)
