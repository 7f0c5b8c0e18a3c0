"""A camera with prepared answers on asyncio: the least that answers a trigger there.

A bare protocol cuts frames and writes what stands in a table. One port, any number of clients.
``python -m benchmarks.peers.canned CLIENTS PROCESSING_TIME``: the time in seconds; with 0 the whole
answer is one write, otherwise result and last status come later, by a timer.
"""

from __future__ import annotations

import asyncio
import functools
import sys

from benchmarks.peers import wire
from benchmarks.peers.control import allow_files, resident, serve_control
from benchmarks.yardsticks import Bare

__all__ = ["CONTAINER", "HELLO", "RUN", "SPARE_FILES"]

CONTAINER = b"".join(wire.localization(number) for number in range(5))
"""What the application finds."""

HELLO = wire.CONNECT_ANSWER + wire.status(waiting=True)
"""What Connect is answered with."""

BEGIN = wire.status(waiting=False)
END = wire.result(CONTAINER) + wire.status(waiting=True)

RUN = BEGIN + END
"""What a trigger is answered with."""

SPARE_FILES = 50
"""Files that a process opens beside those of its cameras."""

ANSWERS = {wire.CONNECT: HELLO, wire.QUERY: wire.query_answer(), wire.TRIGGER: RUN}


class Canned(Bare):
    """Answers one client.

    Args:
        processing_time: seconds.
    """

    def __init__(self, processing_time: float) -> None:
        super().__init__()
        self._processing_time = processing_time
        self._answers = ANSWERS | ({wire.TRIGGER: BEGIN} if processing_time else {})
        self._call_later = asyncio.get_running_loop().call_later

    def buffer_updated(self, size: int) -> None:
        """asyncio: bytes."""
        buffer, available = self.unread(size)
        header, unpack = wire.HEADER.size, wire.HEADER.unpack_from
        start = 0
        while available - start >= header:
            _, length, message_id = unpack(buffer, start)
            end = start + header + length
            if end > available:
                break
            start = end
            answer = self._answers.get(message_id)
            if answer is not None:
                self.transport.write(answer)
            if message_id == wire.TRIGGER and self._processing_time:
                self._call_later(self._processing_time, self.transport.write, END)
        self.keep(buffer, start, available)


async def main() -> None:
    """Serve, print the control port."""
    clients, processing_time = int(sys.argv[1]), float(sys.argv[2])
    allow_files(clients + SPARE_FILES)
    before = resident()
    loop = asyncio.get_running_loop()
    server = await loop.create_server(functools.partial(Canned, processing_time), "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    await serve_control([port] * clients, before)


if __name__ == "__main__":
    asyncio.run(main())
