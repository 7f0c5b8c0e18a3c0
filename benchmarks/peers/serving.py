"""What the canned cameras have in common: blocking sockets, a thread for each client."""

from __future__ import annotations

import contextlib
import socket
import threading
from typing import TYPE_CHECKING

from benchmarks.peers import wire

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from typing import NoReturn

__all__ = ["frames", "listen", "listen_to_datagrams", "reads"]


def listen(serve: Callable[[socket.socket], None]) -> None:
    """Print the port; give each client to ``serve`` in a thread of its own, until it goes."""

    def one(client: socket.socket) -> None:
        with contextlib.suppress(ConnectionError):  # it went while an answer was on its way
            serve(client)

    server = socket.create_server(("127.0.0.1", 0), backlog=64)
    print(server.getsockname()[1], flush=True)
    while True:
        client, _ = server.accept()
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        threading.Thread(target=one, args=(client,), daemon=True).start()


def listen_to_datagrams(answers: Mapping[int, Sequence[bytes]]) -> NoReturn:
    """Print the port; answer a frame a datagram with datagrams, whoever sent it."""
    server = socket.socket(type=socket.SOCK_DGRAM)
    server.bind(("127.0.0.1", 0))
    print(server.getsockname()[1], flush=True)
    while True:
        data, client = server.recvfrom(4096)
        _, _, message_id = wire.HEADER.unpack_from(data)
        for answer in answers.get(message_id, ()):
            server.sendto(answer, client)


def frames(client: socket.socket) -> Iterator[tuple[int, bytes]]:
    """Give message id and body of each frame until the client goes."""
    for found in reads(client):
        yield from found


def reads(client: socket.socket) -> Iterator[list[tuple[int, bytes]]]:
    """Give message ids and bodies of the frames that each read completes."""
    buffer = b""
    while data := client.recv(4096):
        buffer += data
        found: list[tuple[int, bytes]] = []
        while len(buffer) >= wire.HEADER.size:
            _, length, message_id = wire.HEADER.unpack_from(buffer)
            end = wire.HEADER.size + length
            if len(buffer) < end:
                break
            body, buffer = buffer[wire.HEADER.size : end], buffer[end:]
            found.append((message_id, body))
        yield found
    client.close()
