"""An emulated RTSP camera whose answers a test chooses; it shares no code with the client."""

from __future__ import annotations

import asyncio
import base64
import fractions
import hashlib
import re
import socket
import struct
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from smartcam._extras import load
from smartcam.frames import Codecs
from tests.frames.pictures import HEIGHT, WIDTH, frame_of, rtp_packets, served, stamped

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

GOP, COUNT = 5, 20


async def pictures() -> list[bytes]:
    """Return encoded frames, each fifth one a key frame with its parameters."""
    async with Codecs(threads=1) as codecs:
        encoder, made = codecs.h264_encoder(keyint=250, crf=18), []
        for number in range(COUNT):
            if number % GOP == 0:
                encoder.request_key_frame()
            frame = await encoder.encode(frame_of(stamped(number), "Mono8", number))
            made.append(bytes(frame.data))
    return made


def units(data: bytes) -> list[bytes]:
    return [one for one in re.split(b"\0\0\0\1|\0\0\1", data) if one]


def without_sets(data: bytes) -> bytes:
    return b"".join(b"\0\0\0\1" + one for one in units(data) if one[0] & 0x1F not in (7, 8))


def sprop(data: bytes) -> str:
    sets = [one for one in units(data) if one[0] & 0x1F in (7, 8)]
    return ",".join(base64.b64encode(one).decode() for one in sets)


SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=camera\r\nc=IN IP4 0.0.0.0\r\nt=0 0\r\na=control:*\r\n"
    "m=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\na=fmtp:96 packetization-mode=1\r\n"
    "a=control:track1\r\n"
)


@dataclass
class Request:
    method: str
    url: str
    headers: dict[str, str]
    body: str = ""

    @property
    def cseq(self) -> str:
        return self.headers["cseq"]


@dataclass
class Camera:
    """Behaviour of the camera; each hook may be replaced.

    Attributes:
        answers: bytes instead of the usual answer, by method; None: silence.
        packets: function that returns the packets of a frame, without the head of a channel.
        before: actions before the answer to a method.
    """

    frames: list[bytes]
    sdp: str = SDP
    headers: dict[str, str] = field(default_factory=dict)
    answers: dict[str, Any] = field(default_factory=dict)
    before: dict[str, Callable[[Session], Awaitable[None]]] = field(default_factory=dict)
    change: Callable[[int, list[bytes]], list[bytes]] = lambda _, packets: packets
    cut: Callable[[bytes, int, int], list[bytes]] = field(
        default=lambda data, sequence, stamp: numbered(data, sequence, stamp)
    )
    channel: int = 0
    sender: str = "127.0.0.1"
    source: str = ""
    session: str = "17;timeout=60"
    base: bool = True
    every: float = 0.01
    ends: Callable[[Session, int], Awaitable[bool]] | None = None
    asked: list[Request] = field(default_factory=list)
    connections: int = 0
    sequence: int = 65_500
    port: int = 0

    @property
    def methods(self) -> list[str]:
        return [one.method for one in self.asked]

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        session = Session(self, reader, writer)
        try:
            await session.run()
        finally:
            session.stop()


class Session:
    def __init__(
        self, camera: Camera, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        self.camera, self.reader, self.writer = camera, reader, writer
        self.playing: asyncio.Task[None] | None = None
        self.udp: tuple[socket.socket, int] | None = None

    def stop(self) -> None:
        if self.playing is not None:
            self.playing.cancel()
        if self.udp is not None:
            self.udp[0].close()

    async def run(self) -> None:
        while True:
            request = await self.request()
            self.camera.asked.append(request)
            if request.method.startswith("RTSP/"):
                continue
            before = self.camera.before.get(request.method)
            if before is not None:
                await before(self)
            said = self.camera.answers.get(request.method, "")
            if callable(said):
                said = said(request)
            if isinstance(said, bytes):
                self.writer.write(said)
            elif said is not None:
                self.answer(request, *([said] if said else []))
                if request.method == "PLAY" and not said:
                    self.playing = asyncio.create_task(self.play())

    async def request(self) -> Request:
        while True:
            first = await self.reader.readexactly(1)
            if first != b"$":
                break
            head = await self.reader.readexactly(3)
            await self.reader.readexactly(int.from_bytes(head[1:], "big"))
        text = (first + await self.reader.readuntil(b"\r\n\r\n")).decode()
        start, *lines = text.strip().split("\r\n")
        headers = dict(line.split(": ", 1) for line in lines)
        method, url, *_ = start.split()
        headers = {key.lower(): value for key, value in headers.items()}
        body = await self.reader.readexactly(int(headers.get("content-length", "0")))
        return Request(method, url, headers, body.decode())

    def answer(self, request: Request, status: str = "200 OK", body: str = "") -> None:
        camera, method = self.camera, request.method
        headers = {"CSeq": request.cseq} | camera.headers
        if method == "OPTIONS":
            headers.setdefault("Public", "DESCRIBE, SETUP, PLAY, GET_PARAMETER, TEARDOWN")
        if method == "DESCRIBE" and status == "200 OK":
            body = camera.sdp
            if camera.base:
                headers["Content-Base"] = f"rtsp://127.0.0.1:{camera.port}/cam/"
        if method == "SETUP":
            headers |= {"Session": camera.session, "Transport": self.transport(request)}
        if body:
            headers["Content-Length"] = str(len(body))
        lines = [f"RTSP/1.0 {status}", *(f"{key}: {value}" for key, value in headers.items())]
        self.writer.write(("\r\n".join((*lines, "", "")) + body).encode())

    def transport(self, request: Request) -> str:
        said = request.headers["transport"]
        found = re.search(r"client_port=(\d+)-(\d+)", said)
        if found is None:
            channels = f"{self.camera.channel}-{self.camera.channel + 1}"
            return f"RTP/AVP/TCP;unicast;interleaved={channels}"
        made = socket.socket(type=socket.SOCK_DGRAM)
        made.bind((self.camera.sender, 0))
        self.udp = (made, int(found[1]))
        port = made.getsockname()[1]
        source = f";source={self.camera.source}" if self.camera.source else ""
        return f"{said}{source};server_port={port}-{port + 1};ssrc=00000007"

    async def play(self) -> None:
        camera = self.camera
        sequence = camera.sequence
        with suppress(ConnectionError):
            for number in range(100_000):
                stamp = number * 3000 + (1 << 32) - 30_000 & 0xFFFFFFFF
                packets = camera.cut(camera.frames[number % COUNT], sequence, stamp)
                sequence = sequence + len(packets) & 0xFFFF
                for packet in camera.change(number, packets):
                    self.send(packet)
                if camera.ends is not None and await camera.ends(self, number):
                    return
                await self.writer.drain()
                await asyncio.sleep(camera.every)

    def send(self, packet: bytes, channel: int | None = None) -> None:
        if channel is None and self.udp is not None:
            self.udp[0].sendto(packet, ("127.0.0.1", self.udp[1]))
            return
        where = self.camera.channel if channel is None else channel
        self.writer.write(bytes((0x24, where)) + len(packet).to_bytes(2, "big") + packet)


def numbered(data: bytes, sequence: int, stamp: int) -> list[bytes]:
    """Return a frame's packets, whose numbers wrap."""
    made = []
    for place, packet in enumerate(rtp_packets(data, 0, stamp)):
        number = (sequence + place & 0xFFFF).to_bytes(2, "big")
        made.append(packet[:2] + number + packet[4:])
    return made


def numbered_payloads(payloads: list[bytes], kind: int, sequence: int, stamp: int) -> list[bytes]:
    """Return packets of payloads, the last one with the marker."""
    last = len(payloads) - 1
    return [
        struct.pack(
            "!BBHII", 0x80, (place == last) << 7 | kind, sequence + place & 0xFFFF, stamp, 7
        )
        + payload
        for place, payload in enumerate(payloads)
    ]


def h265_pictures() -> list[bytes]:
    """Return encoded frames of H.265, each fifth one a key frame with its parameters."""
    codec = load("av").CodecContext.create("libx265", "w")
    codec.width, codec.height, codec.pix_fmt = WIDTH, HEIGHT, "yuv420p"
    codec.time_base = fractions.Fraction(1, 30)
    codec.options = {
        "preset": "ultrafast",
        "tune": "zerolatency",
        "crf": "12",
        "x265-params": f"keyint={GOP}:min-keyint={GOP}:repeat-headers=1:log-level=none:slices=2",
    }
    made = []
    for number in range(COUNT):
        picture = load("av").VideoFrame.from_ndarray(stamped(number), "gray")
        made += [bytes(one) for one in codec.encode(picture.reformat(format="yuv420p"))]
    return made + [bytes(one) for one in codec.encode(None)]


def h265_packets(data: bytes, sequence: int, stamp: int) -> list[bytes]:
    """Return packets: parameters together (AP), large units in parts (FU) (RFC 7798, 4.4)."""
    found = units(data)
    small = [one for one in found if one[0] >> 1 >= 32]
    together = b"".join(len(one).to_bytes(2, "big") + one for one in small)
    payloads = [b"\x60\x01" + together] if len(small) > 1 else small
    for unit in found[len(small) :]:
        if len(unit) <= 500:
            payloads.append(unit)
            continue
        kind, body = unit[0] >> 1 & 0x3F, unit[2:]
        pieces = [body[at : at + 500] for at in range(0, len(body), 500)]
        for place, piece in enumerate(pieces):
            ends = (place == 0) << 7 | (place == len(pieces) - 1) << 6
            payloads.append(bytes((unit[0] & 0x81 | 49 << 1, unit[1], ends | kind)) + piece)
    return numbered_payloads(payloads, 96, sequence, stamp)


def jpeg_packets(data: bytes, sequence: int, stamp: int) -> list[bytes]:
    """Return packets of a JPEG in 4:2:0 with its tables in the first one (RFC 2435, 3.1.8)."""
    tables, place = b"", 2
    while data[place + 1] != 0xDA:
        size = int.from_bytes(data[place + 2 : place + 4], "big")
        segment = data[place + 4 : place + 2 + size]
        if data[place + 1] == 0xDB:
            tables += b"".join(segment[at + 1 : at + 65] for at in range(0, len(segment), 65))
        place += 2 + size
    scan = data[place + 2 + int.from_bytes(data[place + 2 : place + 4], "big") :]
    payloads = []
    for at in range(0, len(scan), 700):
        head = struct.pack("!IBBBB", at, 1, 255, WIDTH // 8, HEIGHT // 8)
        inside = struct.pack("!BBH", 0, 0, len(tables)) + tables if not at else b""
        payloads.append(head + inside + scan[at : at + 700])
    return numbered_payloads(payloads, 26, sequence, stamp)


def sender_report(utc: int, stamp: int) -> bytes:
    """Return RTCP with the time, seconds since 1970, of a timestamp (RFC 3550, 6.4.1)."""
    return struct.pack("!BBHIIIIII", 0x80, 200, 6, 7, 2_208_988_800 + utc, 0, stamp, 1, 1)


GOODBYE = b"\x81\xcb\0\x03" + (7).to_bytes(4, "big") + b"\x04over\0\0\0"


def with_ssrc(packet: bytes, ssrc: int) -> bytes:
    return packet[:8] + struct.pack("!I", ssrc) + packet[12:]


@asynccontextmanager
async def camera_on(camera: Camera) -> AsyncIterator[str]:
    """Give the URL of a camera, without its scheme."""
    async with served(camera.serve) as port:
        camera.port = port
        yield f"127.0.0.1:{port}/cam"


def digest(request: Request, user: str, password: str, hashed: str) -> bool:
    """Return whether a request answers a challenge of qop=auth (RFC 7616, section 3.4.1)."""
    said = dict(re.findall(r'(\w+)="?([^",]*)"?', request.headers.get("authorization", "")))
    if not said:
        return False

    def h(text: str) -> str:
        return hashlib.new(hashed, text.encode()).hexdigest()

    secret = h(f"{user}:{said['realm']}:{password}")
    asked = h(f"{request.method}:{said['uri']}")
    middle = (
        f"{said['nonce']}:{said['nc']}:{said['cnonce']}:auth" if "qop" in said else said["nonce"]
    )
    response = h(f"{secret}:{middle}:{asked}")
    return (said["uri"], said["response"]) == (request.url, response)
