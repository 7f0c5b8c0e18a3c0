"""A process of a plant, which says lines of JSON."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tests import ROOT
from tests.fleet.fleetkit import PATIENCE

START = 30.0
"""Seconds that a process may take until it is ready."""


class Part:
    """A process on a host that says lines of JSON.

    Args:
        command: what runs.
        hear: takes what it says.
    """

    def __init__(
        self, name: str, command: Sequence[str], env: dict[str, str], hear: Callable[[Any], None]
    ) -> None:
        self.name = name
        self.ready = asyncio.Event()
        self.last: deque[str] = deque(maxlen=20)  # lines of stderr
        self._command, self._env, self._hear = command, env, hear
        self.process: asyncio.subprocess.Process
        self._reading: list[asyncio.Task[None]] = []

    async def start(self) -> None:
        """Start it; it is not ready yet."""
        self.ready.clear()
        pipe = asyncio.subprocess.PIPE
        self.process = await asyncio.create_subprocess_exec(
            *self._command,
            cwd=ROOT,
            env={**os.environ, **self._env},
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            limit=1 << 24,
        )
        self._reading = [asyncio.create_task(one) for one in (self._read(), self._read_errors())]

    async def _read(self) -> None:
        assert self.process.stdout is not None
        async for line in self.process.stdout:
            if line.endswith(b"\n"):
                self._hear(json.loads(line))
                self.ready.set()

    async def _read_errors(self) -> None:
        assert self.process.stderr is not None
        async for line in self.process.stderr:
            self.last.append(line.decode(errors="replace").rstrip())

    async def come(self) -> None:
        """Start it, and wait until it is ready; again where it ends, as a supervisor does."""
        async with asyncio.timeout(START + PATIENCE):
            while True:
                await self.start()
                ready = asyncio.create_task(self.ready.wait())
                await asyncio.wait({ready, self._reading[0]}, return_when=asyncio.FIRST_COMPLETED)
                if self.ready.is_set():
                    return
                ready.cancel()
                await self.ended()
                await asyncio.sleep(0.5)

    def signal(self, number: int) -> None:
        """Send it a signal."""
        if self.process.returncode is None:
            self.process.send_signal(number)

    def pause(self, on: bool) -> None:
        """Stop it, or have it go on."""
        self.signal(signal.SIGSTOP if on else signal.SIGCONT)

    async def ended(self) -> int:
        """Wait until it has ended."""
        await asyncio.gather(*self._reading)
        return await self.process.wait()

    async def kill(self) -> None:
        """End it without a word, if it was started."""
        if getattr(self, "process", None) is not None:
            self.signal(signal.SIGKILL)
            await self.ended()

    async def ask_to_end(self, seconds: float, *, number: int | None = None) -> int | None:
        """Have it end, by a line or a signal; return its code, None where it takes too long."""
        assert self.process.stdin is not None
        if number is not None:
            self.signal(number)
        else:
            with contextlib.suppress(OSError):
                self.process.stdin.write(b"\n")
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                return await self.ended()
        return None

    def resident(self) -> float | None:
        """Return its memory, MB."""
        with contextlib.suppress(OSError, StopIteration):
            status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii")
            return next(
                int(line.split()[1]) / 1024
                for line in status.splitlines()
                if line.startswith("VmRSS")
            )
        return None
