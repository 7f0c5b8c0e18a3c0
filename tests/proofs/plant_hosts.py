"""Hosts of a plant as network namespaces, and the switch between them, which can do its worst."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
import random
import selectors
import shutil
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

SITES = range(1, 4)
"""Hosts with cameras, an agent and a program."""

HUB = 4
"""The router's host."""

LINE = 5
"""The host of the cameras that two agents can reach; it is the last one."""

TUN = (0x400454CA, 0x1001)  # TUNSETIFF; IFF_TUN and IFF_NO_PI
NETWORK = "10.79.0."
MAX_PACKETS = 10_000
LARGEST = 1 << 16
SOURCE, TARGET = 15, 19
"""Offsets of the last bytes of a packet's addresses: that of its source, that of its target."""


class NoNamespacesError(Exception):
    """None can be made here, and why."""


@dataclass
class Cable:
    """Between a host and the switch.

    Attributes:
        delay: seconds that a packet takes, in each direction.
        loss: share of the packets that do not arrive.
        cut: nothing arrives.
    """

    delay: float = 0.0
    loss: float = 0.0
    cut: bool = False


class Switch:
    """Namespaces with a cable from each to a switch.

    Attributes:
        spaces: their names, by the number of the host, from 1 on.
        cables: of the hosts.
        apart: pairs of hosts of which nothing of the one arrives at the other.
    """

    def __init__(self, spaces: dict[int, str], ends: dict[int, int], seed: int) -> None:
        self.spaces = spaces
        self.cables = {number: Cable() for number in spaces}
        self.apart: set[frozenset[int]] = set()
        self.carried = self.lost = 0
        self._ends, self._seed = ends, seed
        self._over, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def within(self, number: int) -> tuple[str, ...]:
        """Return what a command begins with that runs on a host."""
        return ("ip", "netns", "exec", self.spaces[number])

    def close(self) -> None:
        """Carry nothing more."""
        os.close(self._wake)
        self._thread.join()
        os.close(self._over)

    def _carry(self) -> None:
        """Bring packets from each host to the one that they are for."""
        chance, count = random.Random(self._seed), itertools.count()  # noqa: S311
        waiting: list[tuple[float, int, int, bytes]] = []
        with selectors.DefaultSelector() as selector:
            for end in self._ends.values():
                selector.register(end, selectors.EVENT_READ, end)
            selector.register(self._over, selectors.EVENT_READ)
            while True:
                due = waiting[0][0] - time.monotonic() if waiting else None
                for key, _ in selector.select(due if due is None else max(0.0, due)):
                    if key.data is None:
                        return
                    packet = os.read(key.fd, LARGEST)
                    if len(packet) <= TARGET or packet[0] >> 4 != 4:
                        continue  # of IPv6, which says hello
                    way = [self.cables.get(packet[place]) for place in (SOURCE, TARGET)]
                    if None in way:
                        continue
                    cables = [one for one in way if one is not None]
                    lost = any(one.cut or chance.random() < one.loss for one in cables)
                    lost = lost or frozenset((packet[SOURCE], packet[TARGET])) in self.apart
                    if lost or len(waiting) >= MAX_PACKETS:
                        self.lost += 1
                        continue
                    at = time.monotonic() + sum(one.delay for one in cables)
                    heapq.heappush(waiting, (at, next(count), packet[TARGET], packet))
                while waiting and waiting[0][0] <= time.monotonic():
                    _, _, target, packet = heapq.heappop(waiting)
                    self.carried += 1
                    with contextlib.suppress(OSError):  # it is full
                        os.write(self._ends[target], packet)


def address(number: int) -> str:
    """Return the address of a host."""
    return f"{NETWORK}{number}"


def run(*arguments: str) -> None:
    """Run a command."""
    subprocess.run(arguments, check=True, capture_output=True, timeout=60)  # noqa: S603


@contextlib.contextmanager
def hosts(count: int, seed: int = 1) -> Iterator[Switch]:
    """Give so many hosts.

    Raises:
        NoNamespacesError: there are none here.
    """
    if shutil.which("ip") is None:
        raise NoNamespacesError("there is no ip, which makes namespaces")
    import fcntl

    with contextlib.ExitStack() as stack:
        spaces: dict[int, str] = {}
        ends: dict[int, int] = {}
        try:
            for number in range(1, count + 1):
                space = f"plant{os.getpid()}-{number}"
                run("ip", "netns", "add", space)
                stack.callback(run, "ip", "netns", "delete", space)
                spaces[number] = space
                ends[number] = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
                stack.callback(os.close, ends[number])
                name = f"pl{os.getpid()}-{number}"
                fcntl.ioctl(ends[number], TUN[0], struct.pack("16sH22x", name.encode(), TUN[1]))
                run("ip", "link", "set", name, "netns", space, "name", "cable")
                run("ip", "-n", space, "address", "add", f"{address(number)}/24", "dev", "cable")
                for device in ("lo", "cable"):
                    run("ip", "-n", space, "link", "set", device, "up")
        except (OSError, subprocess.CalledProcessError) as exc:
            why = getattr(exc, "stderr", exc)
            raise NoNamespacesError(f"no namespaces can be made here: {why}") from exc
        made = Switch(spaces, ends, seed)
        stack.callback(made.close)
        yield made
