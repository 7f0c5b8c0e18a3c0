"""The base class of servers: emulated cameras, web pages and proxies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing import Self


class Server(ABC):
    """A server that can be started and stopped; ``async with`` does both."""

    @abstractmethod
    async def start(self) -> None:
        """Start the server; do nothing if it is started already."""

    @abstractmethod
    async def stop(self) -> None:
        """Stop the server; do nothing if it is stopped."""

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()
