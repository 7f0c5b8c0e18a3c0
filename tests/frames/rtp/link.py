"""Two network namespaces with a thin, lossy cable between them."""

from __future__ import annotations

import contextlib
import os
import random
import selectors
import shutil
import struct
import subprocess
import threading
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

HERE, THERE = "10.78.0.1", "10.78.0.2"
TUN = (0x400454CA, 0x1001)  # TUNSETIFF; IFF_TUN and IFF_NO_PI


class Link:
    """Two namespaces, and the process that carries packets between them.

    Attributes:
        loss: share of the packets that do not arrive, either way.
    """

    def __init__(self, spaces: tuple[str, str], ends: tuple[int, int]) -> None:
        self.loss = 0.0
        self.spaces = spaces
        self._ends = ends
        self._over, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def within(self, number: int) -> tuple[str, ...]:
        """Return the begin of a command that runs at one of the two ends."""
        return ("ip", "netns", "exec", self.spaces[number])

    def close(self) -> None:
        os.close(self._wake)
        self._thread.join()
        os.close(self._over)

    def _carry(self) -> None:
        chance = random.Random(23)  # noqa: S311 - a test
        with selectors.DefaultSelector() as selector:
            for one, other in (self._ends, self._ends[::-1]):
                selector.register(one, selectors.EVENT_READ, other)
            selector.register(self._over, selectors.EVENT_READ)
            while True:
                for key, _ in selector.select():
                    if key.data is None:
                        return
                    with contextlib.suppress(OSError):
                        packet = os.read(key.fd, 1 << 16)
                        if chance.random() >= self.loss:
                            os.write(key.data, packet)


def run(*arguments: str) -> None:
    subprocess.run(arguments, check=True, capture_output=True, timeout=60)  # noqa: S603


@contextlib.contextmanager
def thin_link(rate: str) -> Iterator[Link]:
    """Give a link with a rate, such as ``20mbit``; skip the test if links are impossible."""
    fcntl = pytest.importorskip("fcntl", reason="there are no namespaces here")
    for tool in ("ip", "tc"):
        if shutil.which(tool) is None:
            pytest.skip(f"there is no {tool}, which namespaces are made with")
    with contextlib.ExitStack() as stack:
        spaces: list[str] = []
        ends: list[int] = []
        try:
            for number, host in enumerate((HERE, THERE)):
                space = f"smartcamrtp{os.getpid()}-{number}"
                run("ip", "netns", "add", space)
                stack.callback(run, "ip", "netns", "delete", space)
                spaces.append(space)
                end = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
                stack.callback(os.close, end)
                ends.append(end)
                name = f"rtp{os.getpid()}-{number}"
                fcntl.ioctl(end, TUN[0], struct.pack("16sH22x", name.encode(), TUN[1]))
                run("ip", "link", "set", name, "netns", space, "name", "cable")
                run("ip", "-n", space, "address", "add", f"{host}/24", "dev", "cable")
                for device in ("lo", "cable"):
                    run("ip", "-n", space, "link", "set", device, "up")
                shape = ("tbf", "rate", rate, "burst", "16kb", "latency", "100ms")
                run("tc", "-n", space, "qdisc", "add", "dev", "cable", "root", *shape)
        except (OSError, subprocess.CalledProcessError) as exc:
            pytest.skip(f"no namespaces can be made here: {getattr(exc, 'stderr', exc)}")
        made = Link((spaces[0], spaces[1]), (ends[0], ends[1]))
        stack.callback(made.close)
        yield made
