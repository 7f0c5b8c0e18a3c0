"""Strangers at every server that accepts connections: they lock out no client, and cost little."""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import sys
import tracemalloc
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from smartcam import _accepting
from smartcam._accepting import HANDSHAKE_TIMEOUT, share_of
from tests.accepting.servers import PATIENCE, SERVERS, Row, Stage
from tests.testing.acme_page import acme_is_known

__all__ = ["acme_is_known"]

TLS_HELLO = bytes.fromhex("1603010200010001fc0303") + bytes(500)
"""The begin of a TLS handshake."""

GARBAGE = random.Random(1).randbytes(1 << 14)  # noqa: S311 - no secret
"""Bytes that a stranger says again and again; some look like ends of lines."""

FLOOD = b"a" * (1 << 18)
"""Bytes of a stranger whose request never ends."""

MAX_BYTES = 1 << 19
"""Bytes of memory that a connection without a session may take: what one read of asyncio takes, and
what is kept of it."""

MANY = 1000

KINDS = ("nothing", "half", "harmless", "garbage", "slow", "tls", "thousand")


class Stranger:
    """A connection that never has a session."""

    def __init__(self, kind: str, row: Row, host: str = "127.0.0.1") -> None:
        self.sock = socket.socket()
        self.sock.setblocking(False)
        self.sock.bind((host, 0))
        self.ended = False
        self._left = b""
        said = {
            "half": row.half,
            "harmless": row.harmless,
            "garbage": GARBAGE,
            "slow": row.half,
            "tls": TLS_HELLO,
            "flood": FLOOD,
        }
        self._words = said.get(kind, b"")
        self._slow = kind == "slow"
        self._repeats = kind in ("harmless", "garbage", "flood")
        self._said = 0

    async def connect(self, port: int) -> None:
        await asyncio.get_running_loop().sock_connect(self.sock, ("127.0.0.1", port))
        self.speak()

    def speak(self) -> None:
        """Send the next bytes, and check whether the server has ended the connection."""
        if self.ended:
            return
        words = self._words
        if self._slow:
            words = words[self._said : self._said + 1]
        elif self._said and not self._repeats:
            words = b""
        self._said += 1
        with contextlib.suppress(BlockingIOError, ConnectionError):
            if words:
                self.sock.send(words)
        self.look()

    def look(self) -> None:
        """Drop what came; see whether it was the end."""
        if self.ended:
            return
        try:
            while self.sock.recv(1 << 16):
                pass
            self.ended = True
        except BlockingIOError:
            pass
        except ConnectionError:
            self.ended = True
        if self.ended:
            self.sock.close()


@asynccontextmanager
async def strangers(
    kind: str, row: Row, stage: Stage, *, host: str = "127.0.0.1", count: int = 0
) -> AsyncIterator[list[Stranger]]:
    """Connect strangers to a server; refused ones give their sockets back."""
    there: list[Stranger] = []
    try:
        for _ in range(count or (MANY if kind == "thousand" else 2 * stage.places.max_places)):
            there.append(Stranger(kind, row, host))
            await there[-1].connect(stage.port)
            if len(there) % 32 == 0:
                await turns()
                for one in there:
                    one.look()
                assert len(stage.places) <= stage.places.max_places
        await turns()
        yield there
    finally:
        for one in there:
            one.sock.close()


async def turns(count: int = 20) -> None:
    """Let the loop make a turn."""
    for _ in range(count):
        await asyncio.sleep(0)


async def emptied(stage: Stage, left: int = 0) -> None:
    """Wait until a server has no more connections than that."""
    async with asyncio.timeout(PATIENCE):
        while len(stage.places) > left:  # noqa: ASYNC110 - nobody tells
            await asyncio.sleep(0)


def descriptors() -> int:
    """Return the number of open files and sockets of the process."""
    return len(list(Path("/proc/self/fd").iterdir())) if sys.platform == "linux" else 0


@pytest.mark.sampled(every=8)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", SERVERS)
async def test_strangers_lock_nobody_out_and_are_sent_away(name: str, kind: str) -> None:
    row = SERVERS[name]
    async with row.start() as stage:
        await stage.served()
        await emptied(stage)
        open_before = descriptors()
        async with stage.session() as alive:
            await alive()
            async with strangers(kind, row, stage) as there:
                await alive()
                assert len(stage.places) <= stage.places.max_places
                if not row.one_session:
                    await stage.served()
                    await alive()
                for _ in range(12):  # three handshake timeouts
                    await asyncio.sleep(HANDSHAKE_TIMEOUT / 4)
                    for one in there:
                        one.speak()
                    await turns()
                    await alive()
                for one in there:
                    one.look()
                if not (row.may_wait or (row.asks_again and kind == "harmless")):
                    assert all(one.ended for one in there)
                await stage.served()  # of one session: it takes that over
        await emptied(stage)
        await turns()
        assert descriptors() <= open_before


@pytest.mark.sampled(every=6)
@pytest.mark.parametrize("name", SERVERS)
async def test_what_strangers_say_takes_little_memory(name: str) -> None:
    row = SERVERS[name]
    async with row.start() as stage:
        await stage.served()
        tracemalloc.start()
        try:
            before, _ = tracemalloc.get_traced_memory()
            async with strangers("flood", row, stage) as there:
                for _ in range(8):
                    for one in there:
                        one.speak()
                    await turns(5)
                now, _ = tracemalloc.get_traced_memory()
            assert now - before < stage.places.max_places * MAX_BYTES
        finally:
            tracemalloc.stop()


@pytest.fixture
def everybody_is_remote(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make the addresses of loopback count as those of other machines."""
    with monkeypatch.context() as patch:
        patch.setattr(_accepting, "is_loopback", lambda _host: False)
        yield


@pytest.mark.skipif(sys.platform != "linux", reason="127.0.0.2 is this machine's on Linux alone")
@pytest.mark.usefixtures("everybody_is_remote")
@pytest.mark.parametrize("name", SERVERS)
async def test_one_address_takes_no_place_of_another(name: str) -> None:
    row = SERVERS[name]
    async with row.start() as stage:
        slow = Stranger("nothing", row, "127.0.0.1")  # a newcomer that has said nothing yet
        await slow.connect(stage.port)
        async with strangers("nothing", row, stage, host="127.0.0.2"):
            share = share_of(stage.places.max_places)
            assert len(stage.places) <= share + 1
            slow.look()
            assert not slow.ended or row.target_decides
            await stage.served()
        slow.sock.close()
        await emptied(stage)


@pytest.mark.parametrize("name", SERVERS)
async def test_the_last_descriptors_are_for_who_has_a_session(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = SERVERS[name]
    async with row.start() as stage, stage.session() as alive:
        await alive()
        async with strangers("nothing", row, stage, count=8) as there:
            before = len(stage.places)
            with monkeypatch.context() as patch:
                patch.setattr(
                    _accepting, "_uses_reserved_descriptor", lambda _connection, _reserve: True
                )
                async with strangers("nothing", row, stage, count=8):
                    assert len(stage.places) <= before
                    await alive()
                    if not row.one_session and not row.target_decides:
                        await stage.served()
            for one in there:
                one.look()
            assert sum(one.ended for one in there) == 8
        if not row.one_session:
            await alive()
