"""Question and answer over a bus of others, between two event loops in processes of their own.

``python -m benchmarks.peers.answering query`` listens, and answers the queries of a Zenoh session;
``query PORT`` asks it. ``mqtt PORT`` answers what a broker on that port brings, ``mqtt PORT ask``
asks. Question and answer are as long as those of :mod:`benchmarks.peers.echo`. CPU time as
:mod:`benchmarks.peers.control` tells it.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.peers.control import resident, serve_control
from benchmarks.peers.echo import REPLY, asking, zenoh_session
from smartcam._zenoh import with_ports

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

__all__ = ["Broker", "broker"]

QUERY, MQTT_ASK, MQTT_ANSWER = "bench/query", "bench/mqtt/ask", "bench/mqtt/answer"
MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
LIMIT = 30.0
"""Seconds until an answer that does not come is an error."""


class Broker:
    """A mosquitto of its own.

    Args:
        port: port that it listens to.
        pid: its process.
    """

    def __init__(self, port: int, pid: int) -> None:
        self.port = port
        self._times = Path(f"/proc/{pid}/schedstat")

    def cpu(self) -> float:
        """Return the seconds of CPU time that it has used; it has one thread."""
        return int(self._times.read_text(encoding="ascii").split()[0]) / 1e9


@contextlib.contextmanager
def broker() -> Iterator[Broker | None]:
    """Run a broker; give None where there is none, no client for one, or no way to measure it."""
    try:
        import aiomqtt  # noqa: F401
    except ImportError:
        yield None
        return
    if MOSQUITTO is None or sys.platform != "linux":
        yield None
        return
    (endpoint,) = with_ports(["tcp/127.0.0.1:0"])
    port = int(endpoint.rpartition(":")[2])
    with tempfile.TemporaryDirectory() as folder:
        settings = Path(folder, "mosquitto.conf")
        settings.write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n", encoding="ascii")
        process = subprocess.Popen([MOSQUITTO, "-c", str(settings)], stderr=subprocess.DEVNULL)
        try:
            yield Broker(port, process.pid)
        finally:
            process.kill()
            process.communicate()


@contextlib.asynccontextmanager
async def _client(port: int, topic: str) -> AsyncIterator[Any]:
    """Give a client of the broker that has subscribed to a topic, as soon as the broker is up."""
    import aiomqtt

    end = time.monotonic() + LIMIT
    while True:
        client = aiomqtt.Client("127.0.0.1", port)
        try:
            await client.__aenter__()
        except aiomqtt.MqttError:
            if time.monotonic() > end:
                raise
            await asyncio.sleep(0.1)
        else:
            break
    try:
        await client.subscribe(topic)
        yield client
    finally:
        await client.__aexit__(None, None, None)


async def _ask_by_messages(port: int, before: float) -> None:
    async with _client(port, MQTT_ANSWER) as client:
        answers = aiter(client.messages)

        async def ask(count: int) -> None:
            async with asyncio.timeout(LIMIT):
                for _ in range(count):
                    await client.publish(MQTT_ASK, asking(0))
                    answer = await anext(answers)
                    assert len(answer.payload) == len(REPLY)

        await serve_control([port], before, ask)


async def _ask_by_queries(port: int, before: float) -> None:
    import zenoh

    session = zenoh_session(connect=f"tcp/127.0.0.1:{port}")
    loop = asyncio.get_running_loop()

    async def ask_once() -> None:
        answered: asyncio.Future[None] = loop.create_future()
        answers: list[bytes] = []

        def hear(reply: Any) -> None:
            answers.append(reply.ok.payload.to_bytes())

        def end() -> None:
            loop.call_soon_threadsafe(answered.set_result, None)

        hearing: Any = zenoh.handlers.Callback(hear, end, indirect=False)
        session.get(QUERY, hearing, payload=asking(0), timeout=LIMIT)
        await answered
        assert [len(one) for one in answers] == [len(REPLY)]

    async def ask(count: int) -> None:
        for _ in range(count):
            await ask_once()

    await serve_control([port], before, ask)
    session.close()


async def _answer_queries(before: float) -> None:
    import zenoh

    (endpoint,) = with_ports(["tcp/127.0.0.1:0"])
    session, loop = zenoh_session(listen=endpoint), asyncio.get_running_loop()

    def answer(query: Any, question: bytes) -> None:
        assert len(question) == len(asking(0))
        query.reply(QUERY, REPLY, express=True)
        query.drop()

    def hear(query: Any) -> None:
        loop.call_soon_threadsafe(answer, query, query.payload.to_bytes())

    hearing: Any = zenoh.handlers.Callback(hear, indirect=False)
    queryable = session.declare_queryable(QUERY, hearing)
    await serve_control([int(endpoint.rpartition(":")[2])], before)
    queryable.undeclare()


async def _answer_messages(port: int, before: float) -> None:
    async with _client(port, MQTT_ASK) as client:

        async def answer() -> None:
            async for _ in client.messages:
                await client.publish(MQTT_ANSWER, REPLY)

        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(answer())
            await serve_control([port], before)


async def main() -> None:
    """Answer."""
    before = resident()
    kind, *rest = sys.argv[1:]
    if kind == "query":
        await (_ask_by_queries(int(rest[0]), before) if rest else _answer_queries(before))
    else:
        each = _ask_by_messages if rest[1:] else _answer_messages
        await each(int(rest[0]), before)


if __name__ == "__main__":
    asyncio.run(main())
