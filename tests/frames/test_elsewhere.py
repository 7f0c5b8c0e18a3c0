"""A camera or a file must not make the program open another port or a local file.

All code that opens a URL is tested: FFmpeg over HTTP, RTSP and on files, a GigE camera's
description, and the WebSocket to a rosbridge. A listener counts connections. The file that must not
be read is a video, so that a wrong read gives pictures.
"""

from __future__ import annotations

import asyncio
import ssl
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from smartcam import frames
from smartcam.exceptions import FrameFormatError, FrameSourceError, SmartCamError
from smartcam.fleet._inside import make_certificates
from smartcam.frames import RtspServer
from tests.frames.gige.camera import camera as gige_camera
from tests.frames.pictures import served as listening
from tests.frames.pictures import write_video

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

MAX_REDIRECTS = 5


pytestmark = pytest.mark.real_time

PATIENCE = 60.0
"""Seconds after which a test fails."""

HLS = "#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{to}\n#EXT-X-ENDLIST\n"
HLS_MASTER = "#EXTM3U\n#EXT-X-STREAM-INF:BANDWIDTH=1\n{to}\n"
HLS_KEY = (
    '#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXT-X-KEY:METHOD=AES-128,URI="{to}"\n#EXTINF:10,\n'
    "{to}\n#EXT-X-ENDLIST\n"
)
CONCAT = "ffconcat version 1.0\nfile '{to}'\n"
SDP = (
    "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=-\r\nc=IN IP4 127.0.0.1\r\nt=0 0\r\na=control:{to}\r\n"
    "m=video 5004 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\na=control:{to}\r\n"
)
DASH = (
    '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static" '
    'mediaPresentationDuration="PT10S"><Period><AdaptationSet mimeType="video/mp4">'
    '<Representation id="1" bandwidth="1"><BaseURL>{to}</BaseURL><SegmentList duration="10">'
    '<SegmentURL media="{to}"/></SegmentList></Representation></AdaptationSet></Period></MPD>'
)
SMIL = '<smil><body><video src="{to}"/></body></smil>'
ASX = '<asx version="3.0"><entry><ref href="{to}"/></entry></asx>'

PLAYLISTS: dict[str, tuple[str, str, str]] = {
    "hls": ("m3u8", "application/vnd.apple.mpegurl", HLS),
    "hls of playlists": ("m3u8", "application/x-mpegurl", HLS_MASTER),
    "hls with a key": ("m3u8", "application/vnd.apple.mpegurl", HLS_KEY),
    "dash": ("mpd", "application/dash+xml", DASH),
    "concat": ("ffconcat", "text/plain", CONCAT),
    "sdp": ("sdp", "application/sdp", SDP),
    "smil": ("smil", "application/smil+xml", SMIL),
    "asx": ("asx", "video/x-ms-asf", ASX),
}
"""By a name: suffix of the file, media type, and contents."""

WAYS = (
    "http://127.0.0.1:{port}/x.ts",
    "tcp://127.0.0.1:{port}/x.ts",
    "rtsp://127.0.0.1:{port}/x.ts",
    "rtmp://127.0.0.1:{port}/x.ts",
    "concat:http://127.0.0.1:{port}/x.ts|http://127.0.0.1:{port}/x.ts",
    "subfile,,start,0,end,0,,:http://127.0.0.1:{port}/x.ts",
    "file://{secret}",
    "{secret}",
    "secret.ts",
    "async:file:{secret}",
    "crypto+file://{secret}",
)
"""Other places that a playlist may name."""


class Listener:
    """A port that no program may connect to."""

    def __init__(self) -> None:
        self.hits: list[bytes] = []
        self.port = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.hits.append(await reader.read(200))
        writer.close()


@asynccontextmanager
async def nobody_comes() -> AsyncIterator[Listener]:
    """Open a port; check at the end that no program has connected to it."""
    there = Listener()
    async with listening(there.serve) as there.port:
        yield there
        assert there.hits == []


def answering(answers: Callable[[str], bytes]) -> Any:
    """Return a server whose answer depends on the request's path."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
        writer.write(answers(request.split(" ")[1]))
        await writer.drain()
        writer.close()

    return serve


def body(data: bytes, kind: str) -> bytes:
    head = f"HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\nContent-Length: {len(data)}\r\n\r\n"
    return head.encode() + data


def redirect(to: str) -> bytes:
    return f"HTTP/1.1 302 Found\r\nLocation: {to}\r\nContent-Length: 0\r\n\r\n".encode()


async def opened(url: str) -> str:
    """Open a source and read a picture; return the format."""
    async with asyncio.timeout(PATIENCE), frames.open(url) as source:
        await source.newest()
        return str(source.format)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return Path(
        write_video(tmp_path_factory.mktemp("video") / "x.ts", "libx264", "yuv420p")
    ).read_bytes()


@pytest.fixture
def secret(tmp_path: Path, video: bytes) -> Path:
    """Return a local file: a video, so that a read of it gives pictures."""
    path = tmp_path / "secret.ts"
    path.write_bytes(video)
    return path


# ---------------------------------------------------------------------- playlists


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", PLAYLISTS)
async def test_a_playlist_of_a_camera_is_not_followed(name: str, way: str, secret: Path) -> None:
    end, kind, text = PLAYLISTS[name]
    async with nobody_comes() as there:
        playlist = text.format(to=way.format(port=there.port, secret=secret)).encode()
        async with listening(answering(lambda _: body(playlist, kind))) as port:
            with pytest.raises(FrameSourceError):
                await opened(f"http://127.0.0.1:{port}/video.{end}#timeout=2")


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", PLAYLISTS)
async def test_a_file_that_names_others_is_not_followed(name: str, way: str, secret: Path) -> None:
    end, _, text = PLAYLISTS[name]
    async with nobody_comes() as there:
        path = secret.parent / f"recording.{end}"
        path.write_text(text.format(to=way.format(port=there.port, secret=secret)))
        with pytest.raises(FrameSourceError):
            await opened(str(path))


async def test_playlist_is_followed_on_request(video: bytes) -> None:
    there = Listener()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there.hits.append(await reader.readuntil(b"\r\n\r\n"))
        writer.write(body(video, "video/mp2t"))
        await writer.drain()
        writer.close()

    async with listening(serve) as elsewhere:
        playlist = HLS.format(to=f"http://127.0.0.1:{elsewhere}/x.ts").encode()
        async with listening(answering(lambda _: body(playlist, PLAYLISTS["hls"][1]))) as port:
            url = f"http://127.0.0.1:{port}/video.m3u8"
            with pytest.raises(FrameFormatError, match="#elsewhere=yes follows a playlist"):
                await opened(url)
            assert there.hits == []
            assert "I420" in await opened(f"{url}#elsewhere=yes")
    assert there.hits


@pytest.mark.parametrize("to", ["file://{secret}", "{secret}", "concat:{secret}"])
async def test_playlist_on_request_reads_no_local_file(to: str, secret: Path) -> None:
    playlist = HLS.format(to=to.format(secret=secret)).encode()
    async with listening(answering(lambda _: body(playlist, PLAYLISTS["hls"][1]))) as port:
        with pytest.raises(FrameSourceError):
            await opened(f"http://127.0.0.1:{port}/video.m3u8#elsewhere=yes&timeout=2")


# ---------------------------------------------------------------------- redirects over HTTP


@pytest.mark.parametrize(
    "to",
    [
        "http://127.0.0.1:{port}/x.ts",
        "http://localhost:{port}/x.ts",
        "//127.0.0.1:{port}/x.ts",
        "https://127.0.0.1:{port}/x.ts",
        "http://user:password@127.0.0.1:{port}/x.ts",
        "file://{secret}",
        "tcp://127.0.0.1:{port}/x.ts",
        "rtsp://127.0.0.1:{port}/x.ts",
        "http://[::1",
    ],
)
async def test_a_redirect_elsewhere_is_not_followed(to: str, secret: Path) -> None:
    async with nobody_comes() as there:
        place = to.format(port=there.port, secret=secret)
        async with listening(answering(lambda _: redirect(place))) as port:
            with pytest.raises(FrameSourceError, match="expected pictures, or a redirect on"):
                await opened(f"http://127.0.0.1:{port}/video.ts#timeout=2")


@pytest.mark.parametrize("to", ["/video.ts", "video.ts", "http://127.0.0.1:{port}/video.ts"])
async def test_a_redirect_on_the_same_host_and_port_is_followed(to: str, video: bytes) -> None:
    ports: list[int] = []

    def answer(path: str) -> bytes:
        if path == "/video.ts":
            return body(video, "video/mp2t")
        return redirect(to.format(port=ports[0]))

    async with listening(answering(answer)) as port:
        ports.append(port)
        assert "I420" in await opened(f"http://127.0.0.1:{port}/index")


async def test_redirect_elsewhere_is_followed_on_request(video: bytes) -> None:
    async with listening(answering(lambda _: body(video, "video/mp2t"))) as elsewhere:
        to = f"http://127.0.0.1:{elsewhere}/x.ts"
        async with listening(answering(lambda _: redirect(to))) as port:
            assert "I420" in await opened(f"http://127.0.0.1:{port}/#elsewhere=yes")


async def test_redirects_have_an_end() -> None:
    asked: list[str] = []

    def answer(path: str) -> bytes:
        asked.append(path)
        return redirect(f"/{len(asked)}")

    async with listening(answering(answer)) as port:
        with pytest.raises(FrameSourceError, match=f"more than {MAX_REDIRECTS} redirects"):
            await opened(f"http://127.0.0.1:{port}/")
    assert len(asked) <= MAX_REDIRECTS + 1


# ---------------------------------------------------------------------- the same by TLS


@pytest.mark.parametrize("scheme", ["https", "rtsps"])
@pytest.mark.parametrize("trusted", [True, False])
async def test_a_redirect_by_tls_is_not_followed(
    scheme: str, trusted: bool, tmp_path: Path
) -> None:
    pytest.importorskip("cryptography")
    (made,) = make_certificates(tmp_path, {"agent": ["camera"]}, hosts=["127.0.0.1"])
    folder = tmp_path / made.folder
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(folder / "cert.pem", folder / "key.pem")
    async with nobody_comes() as there:
        to = f"{scheme}://127.0.0.1:{there.port}/x"
        serve = answering(lambda _: redirect(to)) if scheme == "https" else rtsp_camera(to, "x")
        server = await asyncio.start_server(serve, "127.0.0.1", 0, ssl=context)
        port = server.sockets[0].getsockname()[1]
        how = f"ca={folder / 'ca.pem'}" if trusted else "verify=no"
        try:
            with pytest.raises(FrameSourceError, match="expected pictures, or a redirect on"):
                await opened(f"{scheme}://127.0.0.1:{port}/video#timeout=5&{how}")
            with pytest.raises(FrameSourceError, match="cannot be read"):
                await opened(f"{scheme}://127.0.0.1:{port}/video#timeout=5")
        finally:
            server.close()


# ---------------------------------------------------------------------- redirects over RTSP


def rtsp_camera(to: str, at: str) -> Any:
    """Return a camera that redirects a client after a request of a method."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            try:
                request = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
            except asyncio.IncompleteReadError:
                writer.close()
                return
            cseq = next(line for line in request.split("\r\n") if line.startswith("CSeq"))
            login = at == "after a login" and "Authorization" not in request
            if request.startswith("OPTIONS") and at != "OPTIONS":
                answer = "200 OK\r\nPublic: OPTIONS, DESCRIBE, SETUP, PLAY"
            elif login:
                answer = '401 Unauthorized\r\nWWW-Authenticate: Digest realm="x", nonce="1"'
            else:
                answer = f"302 Moved\r\nLocation: {to}"
            writer.write(f"RTSP/1.0 {answer}\r\n{cseq}\r\n\r\n".encode())

    return serve


@pytest.mark.parametrize(
    "challenge",
    [
        "Digest",
        "Digest realm=",
        'Digest realm="x", nonce=',
        'Digest realm="x", nonce="1", qop=',
        'Digest realm="x", nonce="1", algorithm=none',
        'Digest realm="x", nonce="1", qop="auth-int"',
        'Digest ="",,=, "',
        "Digest " + "=," * 10_000,
        "Basic",
    ],
    ids=lambda one: one[:40],
)
@pytest.mark.parametrize("scheme", ["rtsp", "http"])
async def test_unknown_challenge_is_a_typed_error(scheme: str, challenge: str) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            await reader.readuntil(b"\r\n\r\n")
            answer = f"401 No\r\nCSeq: 1\r\nWWW-Authenticate: {challenge}\r\nContent-Length: 0"
            version = "RTSP/1.0" if scheme == "rtsp" else "HTTP/1.1"
            writer.write(f"{version} {answer}\r\n\r\n".encode())

    async with listening(serve) as port:
        with pytest.raises(FrameSourceError, match=r"cannot be read|Unauthorized"):
            await opened(f"{scheme}://me:s3cret@127.0.0.1:{port}/x#timeout=2")


@pytest.mark.parametrize("to", ["rtsp://127.0.0.1:{port}/x", "rtsps://127.0.0.1:{port}/x", "http:"])
@pytest.mark.parametrize("at", ["OPTIONS", "DESCRIBE", "after a login"])
@pytest.mark.parametrize("transport", ["tcp", "udp"])
async def test_an_rtsp_redirect_elsewhere_is_not_followed(to: str, at: str, transport: str) -> None:
    async with (
        nobody_comes() as there,
        listening(rtsp_camera(to.format(port=there.port), at)) as port,
    ):
        with pytest.raises(FrameSourceError, match="expected pictures, or a redirect on") as got:
            await opened(f"rtsp://me:s3cret@127.0.0.1:{port}/x#timeout=2&transport={transport}")
        assert "s3cret" not in str(got.value)


@pytest.mark.parametrize(
    "text",
    [
        "RTSP/1.0 302 Moved\nCSeq: 1\nLocation: rtsp://127.0.0.1:{port}/x\n\n",
        "RTSP/1.0 399 Odd\r\nCSeq: 1\r\nlocation:rtsp://127.0.0.1:{port}/x\r\n\r\n",
        "RTSP/1.0 300 Choose\r\nCSeq: 1\r\nLocation:\trtsp://127.0.0.1:{port}/x\r\n\r\n",
        "RTSP/1.0 302 Moved\r\nX: {long}\r\nLocation: rtsp://127.0.0.1:{port}/x\r\n\r\n",
        "nothing at all\r\nLocation: rtsp://127.0.0.1:{port}/x\r\n\r\n",
        "RTSP/1.0 302",
        "",
    ],
)
async def test_odd_answer_is_not_followed_either(text: str) -> None:
    async with nobody_comes() as there:
        answer = text.format(port=there.port, long="x" * (1 << 17)).encode()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readuntil(b"\r\n\r\n")
            writer.write(answer)
            await reader.read()

        async with listening(serve) as port:
            with pytest.raises(FrameSourceError):
                await opened(f"rtsp://127.0.0.1:{port}/x#timeout=0.5")


async def test_an_rtsp_redirect_on_the_same_host_and_port_is_followed() -> None:
    async with (
        frames.open("synthetic://?fps=20") as source,
        RtspServer({"left": source}, port=0, user="me", password="secret") as server,  # noqa: S106
    ):
        asked: list[bytes] = []

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            first = await reader.readuntil(b"\r\n\r\n")
            asked.append(first)
            if b"/left" not in first:
                writer.write(b"RTSP/1.0 302 Moved\r\nCSeq: 1\r\nLocation: /left\r\n\r\n")
                writer.close()
                return
            inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", server.port)
            inner_writer.write(first)
            try:
                await asyncio.gather(pass_on(reader, inner_writer), pass_on(inner_reader, writer))
            finally:
                inner_writer.close()
                writer.close()

        async with listening(serve) as port:
            assert "I420" in await opened(f"rtsp://me:secret@127.0.0.1:{port}/old")
        assert b"/old" in asked[0]


async def pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(1 << 16):
            writer.write(data)
            await writer.drain()
    except ConnectionError:
        pass
    finally:
        writer.close()


# ---------------------------------------------------------------------- descriptions, WebSockets


@pytest.mark.parametrize(
    "url",
    [
        "http://127.0.0.1:{port}/camera.xml",
        "File:{secret}",
        "file:///etc/hostname?SchemaVersion=1.0.0",
        "ftp://127.0.0.1:{port}/camera.zip",
        "Local:../../secret.ts",
    ],
)
async def test_a_gige_description_elsewhere_is_not_read(url: str, secret: Path) -> None:
    async with nobody_comes() as there:
        place = url.format(port=there.port, secret=secret).encode()
        async with gige_camera(url=place) as camera:
            with pytest.raises(SmartCamError):
                await opened(f"gige://127.0.0.1:{camera.port}")
