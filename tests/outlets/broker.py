"""Debian's broker of MQTT, mosquitto, as a process of a test."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")

needs_mosquitto = pytest.mark.skipif(
    MOSQUITTO is None, reason="mosquitto is not installed: apt-get install mosquitto"
)


class Broker:
    """A broker that can be killed and started again on the same port.

    Args:
        folder: where its configuration is.
        lines: further lines of it.
    """

    def __init__(self, folder: Path, lines: str = "allow_anonymous true\n") -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port: int = free.getsockname()[1]
        self.url = f"mqtt://127.0.0.1:{self.port}"
        self._path = folder / "mosquitto.conf"
        self._path.write_text(f"listener {self.port} 127.0.0.1\nuser root\n{lines}")
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Start it, and wait until it listens."""
        self._process = await asyncio.create_subprocess_exec(
            str(MOSQUITTO), "-c", str(self._path), stderr=asyncio.subprocess.DEVNULL
        )
        async with asyncio.timeout(30):
            while True:
                with contextlib.suppress(OSError):
                    _, writer = await asyncio.open_connection("127.0.0.1", self.port)
                    writer.close()
                    return
                await asyncio.sleep(0.02)

    async def kill(self) -> None:
        """End it at once."""
        if self._process is not None:
            self._process.kill()
            await self._process.wait()
            self._process = None


@contextlib.asynccontextmanager
async def broker(folder: Path, lines: str = "allow_anonymous true\n") -> AsyncIterator[Broker]:
    """Have a broker in here."""
    found = Broker(folder, lines)
    await found.start()
    try:
        yield found
    finally:
        await found.kill()


@contextlib.asynccontextmanager
async def listener(port: int, topic: str) -> AsyncIterator[list[Any]]:
    """Give the messages of a topic, as they come."""
    import aiomqtt

    found: list[Any] = []
    async with aiomqtt.Client("127.0.0.1", port, protocol=aiomqtt.ProtocolVersion.V5) as client:
        await client.subscribe(topic, qos=1)

        async def listen() -> None:
            with contextlib.suppress(aiomqtt.MqttError):
                async for message in client.messages:
                    found.append(message)  # noqa: PERF401 - as they come

        task = asyncio.create_task(listen())
        try:
            yield found
        finally:
            task.cancel()
            await asyncio.wait({task})
