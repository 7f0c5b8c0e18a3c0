"""A session that cannot be made takes the whole of ``connect_timeout``; on a time that is moved."""

from __future__ import annotations

import asyncio
import contextlib
import select
import socket
from typing import TYPE_CHECKING, Any

import pytest
from handmade import CONNECT_ANSWER, HOST, Peer, scripted

from smartcam._client.handshake import DETECTION_SHARE, establish
from smartcam.exceptions import ConnectFailedError
from smartcam.settings import CameraSettings

if TYPE_CHECKING:
    from collections.abc import Iterator

TIMEOUT = 4.8

each_dialect = pytest.mark.parametrize("query", ["", "?dialect=handbook", "?dialect=b16"])
each_count = pytest.mark.parametrize("attempts", [1, 2, 3])


@contextlib.contextmanager
def swallowing() -> Iterator[int]:
    """Give a port whose host answers no attempt to connect: its queue of connections is full."""
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.socket())
        listener.bind((HOST, 0))
        listener.listen(0)
        waiting = [stack.enter_context(socket.socket()) for _ in range(4)]
        for one in waiting:
            one.setblocking(False)
            one.connect_ex(listener.getsockname())
        if select.select([], waiting[-1:], [], 0)[1]:
            pytest.skip("this system accepts more connections than it was told to")
        yield listener.getsockname()[1]


@contextlib.contextmanager
def mute() -> Iterator[int]:
    """Give a port where datagrams are taken and never answered."""
    with socket.socket(type=socket.SOCK_DGRAM) as listener:
        listener.bind((HOST, 0))
        yield listener.getsockname()[1]


async def fail(port: int, query: str, scheme: str = "bvs", **options: Any) -> tuple[str, ...]:
    """Return what was tried; the time must be used up."""
    loop = asyncio.get_running_loop()
    options = {"name": "cell 1", "connect_timeout": TIMEOUT, **options}
    made = CameraSettings.make(f"{scheme}://{HOST}:{port}{query}", None, options)
    begin = loop.time()
    with pytest.raises(ConnectFailedError) as caught:
        await establish(made)
    assert loop.time() - begin == pytest.approx(TIMEOUT, abs=0.01)
    return tuple(one.partition(": ")[2] for one in caught.value.attempts)


@each_dialect
@each_count
async def test_host_that_swallows_attempts_to_connect_is_tried_for_the_whole_time(
    query: str, attempts: int
) -> None:
    with swallowing() as port:
        tried = await fail(port, query, connect_attempts=attempts)
    assert len(tried) == attempts
    text = f"over TCP: opening the link: silence for {TIMEOUT / attempts:.1f} s"
    assert all(one.endswith(text) for one in tried)


@each_dialect
@each_count
async def test_datagrams_that_nobody_answers_are_tried_for_the_whole_time(
    query: str, attempts: int
) -> None:
    with mute() as port:
        tried = await fail(port, query, "bvs+udp", connect_attempts=attempts)
    dialects = 1 if query else 3
    assert len(tried) == attempts * dialects
    if dialects > 1 and attempts > 1:
        hurried = (f"silence for {DETECTION_SHARE:.1f} s",) * dialects
        assert tuple(one.rpartition(": ")[2] for one in tried[:dialects]) == hurried


@each_dialect
@each_count
async def test_camera_that_is_silent_is_tried_for_the_whole_time(query: str, attempts: int) -> None:
    async def silent(peer: Peer, _number: int) -> None:
        await peer.rest()
        peer.close()

    async with scripted(silent) as listener:
        tried = await fail(listener.port, query, connect_attempts=attempts)
    assert len(tried) == attempts * (1 if query else 3)


@pytest.mark.parametrize("query", ["", "?dialect=handbook"])
@each_count
async def test_camera_that_says_no_more_than_its_name_is_tried_for_the_whole_time(
    query: str, attempts: int
) -> None:
    async def talk(peer: Peer, _number: int) -> None:
        if (await peer.read(4)).startswith(b"PSVB"):
            peer.write(CONNECT_ANSWER)
        await peer.rest()
        peer.close()

    async with scripted(talk) as listener:
        tried = await fail(listener.port, query, connect_attempts=attempts)
    assert all(
        "waiting for the first status: 16 bytes" in one for one in tried[0 if query else 1 :]
    )
    assert len(tried) == attempts + (0 if query else 1)
