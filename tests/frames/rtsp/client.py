"""A client of RTSP over a bare socket, which checks each answer."""

from __future__ import annotations

import asyncio
import hashlib
import re
import socket
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from smartcam.frames import find_format
from smartcam.frames._inside import read_stamp
from tests.frames.inside import Depacketizer, RtpPacket
from tests.frames.pictures import HEIGHT, WIDTH, frame_of, stamped

if TYPE_CHECKING:
    from typing import Self

    from smartcam.frames import Codecs, RtspServer
    from tests.frames.inside import H264Decoder

LIMIT = 20.0
"""Seconds for an answer: the server waits for a frame."""

TCP = "RTP/AVP/TCP;unicast;interleaved=0-1"


class Reply(NamedTuple):
    """An answer; the names of its headers are in small letters."""

    status: int
    headers: dict[str, str]
    body: bytes


class Client:
    """A connection that keeps the packets between the answers, by channel."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, base: str
    ) -> None:
        self.reader, self.writer, self.base = reader, writer, base
        self.packets: dict[int, list[bytes]] = {0: [], 1: [], 2: [], 3: []}
        self.session = self.transport = ""
        self._cseq = 0

    @classmethod
    async def connect(cls, server: RtspServer, name: str = "left", room: int = 0) -> Client:
        sock = socket.socket()
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if room:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)
        sock.setblocking(False)
        await asyncio.get_running_loop().sock_connect(sock, ("127.0.0.1", server.port))
        reader, writer = await asyncio.open_connection(sock=sock, limit=1 << 16)
        return cls(reader, writer, server.url(name))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.writer.transport.abort()

    async def ask(self, method: str, url: str = "", **headers: str) -> Reply:
        """Send a request, and return its answer."""
        self._cseq += 1
        lines = [f"{method} {url or self.base} RTSP/1.0", f"CSeq: {self._cseq}"]
        if self.session and "Session" not in headers:
            headers["Session"] = self.session
        body = headers.pop("body", "").encode()
        if body:
            headers["Content-Length"] = str(len(body))
        lines += (f"{name.replace('_', '-')}: {value}" for name, value in headers.items() if value)
        self.writer.write("\r\n".join((*lines, "", "")).encode() + body)
        reply = await self.reply()
        assert reply.headers["cseq"] == str(self._cseq)
        return reply

    async def set_up(self, transport: str = TCP) -> Reply:
        reply = await self.ask("SETUP", f"{self.base}/track1", Transport=transport)
        assert reply.status == 200, reply
        self.session = reply.headers["session"].partition(";")[0]
        self.transport = reply.headers["transport"]
        return reply

    async def play(self, transport: str = TCP) -> Reply:
        await self.set_up(transport)
        reply = await self.ask("PLAY")
        assert reply.status == 200, reply
        return reply

    async def reply(self) -> Reply:
        """Return the next answer; packets before it are kept."""
        while (start := await self.start()) == b"":
            pass
        head = start + await self._until(b"\r\n\r\n")
        first, *lines = head.decode().removesuffix("\r\n\r\n").split("\r\n")
        found = re.fullmatch(r"RTSP/1\.0 (\d{3}) [A-Za-z -]+", first)
        assert found is not None, first
        headers = dict(line.split(": ", 1) for line in lines)
        headers = {name.lower(): value for name, value in headers.items()}
        body = await self._read(int(headers.get("content-length", "0")))
        return Reply(int(found[1]), headers, body)

    async def start(self) -> bytes:
        """Read a packet and return b"", or return the first byte of an answer."""
        first = await self._read(1)
        if first != b"$":
            assert first == b"R", f"neither a packet nor an answer begins with {first!r}"
            return first
        channel, high, low = await self._read(3)
        self.packets[channel].append(await self._read(high << 8 | low))
        return b""

    async def packet(self, channel: int = 0) -> bytes:
        """Return the next packet of a channel."""
        while not self.packets[channel]:
            assert await self.start() == b""
        return self.packets[channel].pop(0)

    async def ended(self) -> bool:
        """Return whether the server ends the connection; earlier packets are kept."""
        try:
            while await self.start() == b"":
                pass
        except (asyncio.IncompleteReadError, ConnectionError):
            return True
        return False

    async def everything(self) -> bytes:
        """Return the bytes that come until the connection ends."""
        found = bytearray()
        try:
            while data := await self._some():
                found += data
        except ConnectionError:
            pass
        return bytes(found)

    async def _some(self) -> bytes:
        async with asyncio.timeout(LIMIT):
            return await self.reader.read(1 << 16)

    async def _read(self, count: int) -> bytes:
        async with asyncio.timeout(LIMIT):
            return await self.reader.readexactly(count)

    async def _until(self, end: bytes) -> bytes:
        async with asyncio.timeout(LIMIT):
            return await self.reader.readuntil(end)


def digest(reply: Reply, method: str, url: str, user: str, password: str) -> str:
    """Return the answer to a challenge (RFC 2617, section 3.2.2, without qop)."""
    found = re.search(r'Digest realm="([^"]+)", nonce="([^"]+)"', reply.headers["www-authenticate"])
    assert found is not None
    realm, nonce = found.groups()
    one, two = (
        hashlib.md5(text.encode()).hexdigest()  # noqa: S324 - as the RFC has it
        for text in (f"{user}:{realm}:{password}", f"{method}:{url}")
    )
    response = hashlib.md5(f"{one}:{nonce}:{two}".encode()).hexdigest()  # noqa: S324
    return (
        f'Digest username="{user}", realm="{realm}", nonce="{nonce}", uri="{url}", '
        f'response="{response}"'
    )


class Watcher:
    """Decodes packets to pictures, and reads their numbers."""

    def __init__(self, codecs: Codecs, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
        self.depacketizer = Depacketizer(window=0)  # the loopback keeps the order
        self.decoder: H264Decoder = codecs.h264_decoder()
        self.size = size
        self.sequences: list[int] = []
        self.timestamps: list[int] = []
        self.numbers: list[int] = []

    async def see(self, packet: bytes) -> int | None:
        """Add a packet; return the number of the picture that it completes."""
        read = RtpPacket.parse(packet)
        self.sequences.append(read.sequence)
        number = None
        for unit in self.depacketizer.add_packet(read):
            self.timestamps.append(unit.timestamp)
            form = frame_of(stamped(0, *self.size), "Mono8")
            coded = replace(form, data=unit.data, format=find_format("H264"), stride=0)
            picture = await self.decoder.decode(coded)
            assert picture is not None, "a picture that cannot be decoded was sent"
            stamp = read_stamp(picture.grey())
            assert stamp is not None, "a picture that is none"
            number = stamp[0]
            self.numbers.append(number)
        return number
