"""What a server that is measured itself says about itself, on request.

Its process listens to one control port on 127.0.0.1, which it prints. Each line that comes there is
answered with one line of JSON: :class:`Usage`. Where the server has work to do on request, ``do``
with a number in front of it has it done first.
"""

from __future__ import annotations

import asyncio
import json
import os
import resource
import socket
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Sequence

__all__ = ["Control", "Usage", "allow_files", "resident", "serve_control"]


DO = b"do "


class Usage(NamedTuple):
    """What a process has used.

    Attributes:
        cpu: seconds of CPU time since it began.
        before: KiB of memory before it served anything.
        resident: KiB of memory now.
        ports: where it serves.
    """

    cpu: float
    before: float
    resident: float
    ports: list[int]


def resident() -> float:
    """Return the memory of this process, KiB: the resident part; not on Linux the peak of it."""
    if sys.platform == "linux":
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def allow_files(wanted: int) -> int:
    """Let this process open so many files if it may; return how many it may open."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return wanted
    limit = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
    return limit


async def serve_control(
    ports: Sequence[int],
    before: float,
    work: Callable[[int], Awaitable[None]] | None = None,
) -> None:
    """Print the control port and answer for ever; ``work`` does what ``do`` asks for."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            if work is not None and line.startswith(DO):
                await work(int(line.removeprefix(DO)))
            usage = Usage(time.process_time(), before, resident(), list(ports))
            writer.write(json.dumps(usage).encode() + b"\n")

    server = await asyncio.start_server(answer, "127.0.0.1")
    print(server.sockets[0].getsockname()[1], flush=True)
    await server.serve_forever()


class Control:
    """Asks such a process.

    Args:
        port: its control port.
    """

    def __init__(self, port: int) -> None:
        self._lines = socket.create_connection(("127.0.0.1", port)).makefile("rwb", buffering=0)

    def usage(self) -> Usage:
        """Return what it has used up to now."""
        return self._ask(b"usage\n")

    def do(self, count: int) -> Usage:
        """Have so much work done; return what was used up to its end."""
        return self._ask(b"%s%d\n" % (DO, count))

    def _ask(self, line: bytes) -> Usage:
        self._lines.write(line)
        return Usage(*json.loads(self._lines.readline()))
