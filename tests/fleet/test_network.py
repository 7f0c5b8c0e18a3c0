"""A fleet over a bad network: agent and program in two network namespaces, a cable between them."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import json
import os
import random
import selectors
import shutil
import struct
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING

import pytest

from tests.processes import Process

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

fcntl = pytest.importorskip("fcntl")
pytest.importorskip("zenoh")

pytestmark = pytest.mark.long

AGENT, PROGRAM = "10.77.0.1", "10.77.0.2"
PORT = 7447  # of a namespace of its own
TUN = (0x400454CA, 0x1001)  # TUNSETIFF; IFF_TUN and IFF_NO_PI
MAX_PACKETS = 10_000

FLEET = f"""\
listen: tcp/{AGENT}:{PORT}
access: anyone-may-command
history: {{{{results: {{results}}}}}}
cameras:
  fast: {{{{emulated: {{{{}}}}, application: 7}}}}
  slow: {{{{emulated: {{{{scenario: slow.yaml}}}}}}}}
"""
SLOW = """\
active: 1
running: true
applications: [{id: 1, layout: "n: int32", constant: {n: 1}, processing_time: 3000}]
"""

HEAD = f"""\
import asyncio, contextlib, smartcam
URL = "fleet://{AGENT}:{PORT}"

def say(*what):
    print(*what, flush=True)
"""

BUSY = """\
async def main():
    async with smartcam.connect(f"{URL}/fast", connect_timeout=60) as fast:
        async with fast.results() as results:
            for number in range(1, 21):
                assert (await fast.trigger(timeout=60)).number == number
            numbers = [(await anext(results)).number for _ in range(20)]
            say(numbers, results.statistics().missed)

asyncio.run(main())
"""

CUT_OFF = """\
async def main():
    async with contextlib.AsyncExitStack() as stack:
        fast, slow = [
            await stack.enter_async_context(smartcam.connect(f"{URL}/{name}", connect_timeout=60))
            for name in ("fast", "slow")
        ]
        results = fast.results()
        try:
            async with fast.reserve(timeout=60):
                await fast.trigger(timeout=60)
                say("reserved")
                await slow.trigger(timeout=600)
        except smartcam.ConnectionLostError as error:
            say("lost:", error)
        await fast.wait_connected(timeout=60)
        last = await fast.trigger(timeout=60)
        numbers = []
        while last.number not in numbers:
            numbers.append((await anext(results)).number)
        say(numbers, results.statistics().missed)

asyncio.run(main())
"""

OTHER = """\
async def main():
    async with smartcam.connect(f"{URL}/fast") as fast, fast.reserve(timeout=60):
        say("mine", [(await fast.trigger()).number for _ in range(3)])

asyncio.run(main())
"""


class Network:
    """Two namespaces with a cable between them.

    Attributes:
        delay: seconds that a packet takes.
        loss: share of the packets that do not arrive.
    """

    def __init__(self, spaces: dict[str, str], ends: tuple[int, int]) -> None:
        self.delay = self.loss = 0.0
        self._spaces, self._ends = spaces, ends
        self._over, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def close(self) -> None:
        os.close(self._wake)
        self._thread.join()
        os.close(self._over)

    def run(self, host: str, *arguments: str, cwd: Path) -> Process:
        """Start Python on one of the two."""
        within = ("netns", "exec", self._spaces[host], sys.executable)
        return Process("ip", *within, *arguments, cwd=cwd, fresh=True)

    def link(self, state: str) -> None:
        """Set the program's end ``up`` or ``down``."""
        ip("-n", self._spaces[PROGRAM], "link", "set", "cable", state)

    def _carry(self) -> None:
        """Bring packets from each end to the other."""
        chance, count = random.Random(7), itertools.count()  # noqa: S311 - a test
        waiting: list[tuple[float, int, int, bytes]] = []
        with selectors.DefaultSelector() as selector:
            for one, other in (self._ends, self._ends[::-1]):
                selector.register(one, selectors.EVENT_READ, other)
            selector.register(self._over, selectors.EVENT_READ)
            while True:
                due = waiting[0][0] - time.monotonic() if waiting else None
                for key, _ in selector.select(due if due is None else max(0.0, due)):
                    if key.data is None:
                        return
                    with contextlib.suppress(OSError):  # this end is down
                        packet = os.read(key.fd, 1 << 16)
                        if chance.random() >= self.loss and len(waiting) < MAX_PACKETS:
                            at = time.monotonic() + self.delay
                            heapq.heappush(waiting, (at, next(count), key.data, packet))
                while waiting and waiting[0][0] <= time.monotonic():
                    _, _, end, packet = heapq.heappop(waiting)
                    with contextlib.suppress(OSError):  # it is down, or full
                        os.write(end, packet)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, timeout=60)  # noqa: S603, S607


@pytest.fixture
def network() -> Iterator[Network]:
    if shutil.which("ip") is None:
        pytest.skip("there is no ip, which makes namespaces")
    with contextlib.ExitStack() as stack:
        spaces: dict[str, str] = {}
        ends: list[int] = []
        try:
            for number, host in enumerate((AGENT, PROGRAM)):
                space = spaces[host] = f"smartcam{os.getpid()}-{number}"
                ip("netns", "add", space)
                stack.callback(ip, "netns", "delete", space)
                end = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
                ends.append(end)
                stack.callback(os.close, end)
                name = f"sc{os.getpid()}-{number}"
                fcntl.ioctl(end, TUN[0], struct.pack("16sH22x", name.encode(), TUN[1]))
                ip("link", "set", name, "netns", space, "name", "cable")
                ip("-n", space, "address", "add", f"{host}/24", "dev", "cable")
                for device in ("lo", "cable"):
                    ip("-n", space, "link", "set", device, "up")
        except (OSError, subprocess.CalledProcessError) as exc:
            pytest.skip(f"no namespaces can be made here: {getattr(exc, 'stderr', exc)}")
        made = Network(spaces, (ends[0], ends[1]))
        stack.callback(made.close)
        yield made


@contextlib.contextmanager
def agent(network: Network, folder: Path, results: int = 100) -> Iterator[Process]:
    (folder / "fleet.yaml").write_text(FLEET.format(results=results), encoding="utf-8")
    (folder / "slow.yaml").write_text(SLOW, encoding="utf-8")
    with network.run(AGENT, "-m", "smartcam", "serve", "fleet.yaml", cwd=folder) as process:
        process.read_until(b"\n", count=2)
        yield process


def test_slow_network_that_loses_packets_loses_no_result(network: Network, tmp_path: Path) -> None:
    network.delay, network.loss = 0.05, 0.05
    with agent(network, tmp_path), network.run(PROGRAM, "-c", HEAD + BUSY, cwd=tmp_path) as busy:
        assert busy.wait() == (0, f"{[*range(1, 21)]} 0\n", "")


@pytest.mark.parametrize("kept", [pytest.param(100, marks=pytest.mark.widest), 2])
def test_cable_that_is_pulled_for_longer_than_the_lease(
    kept: int, network: Network, tmp_path: Path
) -> None:
    with (
        agent(network, tmp_path, kept),
        network.run(PROGRAM, "-c", HEAD + CUT_OFF, cwd=tmp_path) as cut_off,
    ):
        cut_off.read_until(b"reserved\n")
        network.link("down")
        cut_off.read_until(b"lost: ")
        with network.run(AGENT, "-c", HEAD + OTHER, cwd=tmp_path) as other:
            assert other.wait() == (0, "mine [2, 3, 4]\n", "")
        network.link("up")
        ended = cut_off.wait()
        assert (ended.code, ended.err) == (0, "")
        _, lost, last = ended.out.splitlines()
        assert lost.startswith("lost: slow: the agent ")
        numbers, missed = json.loads(last.replace("] ", "], ").join("[]"))
        if kept == 100:
            assert (numbers, missed) == ([1, 2, 3, 4, 5], 0)
        else:  # the last two are kept, whichever these are when it asks
            assert numbers in ([1, 3, 4, 5], [1, 4, 5])
            assert missed == 5 - len(numbers)
