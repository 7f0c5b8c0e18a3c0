"""Faulty RTSP servers: each ends with an error that names the cause, in time."""

from __future__ import annotations

import asyncio
import re
import socket
import struct
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from smartcam import frames
from smartcam.exceptions import FrameFormatError, FrameSourceError
from tests.frames.pictures import frame_of, stamped
from tests.frames.rtsp_client.camera import (
    COUNT,
    GOODBYE,
    SDP,
    Camera,
    Request,
    Session,
    camera_on,
    pictures,
    sender_report,
    units,
    without_sets,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

pytestmark = [pytest.mark.real_time, pytest.mark.usefixtures("no_leaks")]

LIMIT = 20.0
"""Seconds after which a test fails."""

SHORT, LONG = 0.8, 10.0
"""Timeouts, in seconds: of silent servers, and of servers whose answer ends the test sooner."""

WHO = "me:s3cret@"


@pytest.fixture(scope="module")
def encoded() -> list[bytes]:
    return asyncio.run(pictures())


class Bad(NamedTuple):
    """A faulty server.

    Attributes:
        message: part of the error's text.
        do: function that makes a camera this server.
        timeout: seconds in the URL.
        user: user and password of the URL.
        how: further parameters of the URL.
        error: type of the error.
        scheme: scheme of the URL.
    """

    message: str
    do: Callable[[Camera], None]
    timeout: float = LONG
    user: str = ""
    how: str = ""
    error: type[FrameSourceError] = FrameSourceError
    scheme: str = "rtsp"


def answers(**given: Any) -> Callable[[Camera], None]:
    """Answer methods by a status, by bytes, or not at all (None)."""
    return lambda camera: camera.answers.update(given)


def describes(text: str) -> Callable[[Camera], None]:
    """Describe the streams by a text."""
    return lambda camera: setattr(camera, "sdp", text)


def first(method: str, do: Callable[[Session], Any]) -> Callable[[Camera], None]:
    """Run an action before the answer to a method; without ``end`` no answer follows."""

    async def before(session: Session) -> None:
        made = do(session)
        if asyncio.iscoroutine(made):
            await made

    return lambda camera: camera.before.update({method: before})


def sends(change: Callable[[int, list[bytes]], list[bytes]]) -> Callable[[Camera], None]:
    """Send other packets instead of a picture's."""
    return lambda camera: setattr(camera, "change", change)


def while_playing(do: Callable[[Session], bool]) -> Callable[[Camera], None]:
    """Run an action after 20 pictures of the second connection, the reader's."""

    async def ends(session: Session, number: int) -> bool:
        return number == 20 and session.camera.connections == 2 and do(session)

    return lambda camera: setattr(camera, "ends", ends)


def answered(request: Request, status: str, *headers: str) -> bytes:
    lines = (f"RTSP/1.0 {status}", f"CSeq: {request.cseq}", *headers, "", "")
    return "\r\n".join(lines).encode()


def hang_up(session: Session) -> bool:
    session.writer.close()
    return True


def reset(session: Session) -> None:
    connection = session.writer.get_extra_info("socket")
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    session.writer.transport.abort()


def say(data: bytes, *, then_end: bool = True) -> Callable[[Session], bool]:
    def write(session: Session) -> bool:
        session.writer.write(data)
        return then_end

    return write


def tell_goodbye(session: Session) -> bool:
    session.send(sender_report(1, 1) + GOODBYE, 1)
    return True


def forget(session: Session) -> bool:
    session.camera.answers["GET_PARAMETER"] = "454 Session Not Found"
    return False


def drip(begin: bytes, again: bytes, every: float = 0.02) -> Callable[[Session], Any]:
    """Send a beginning and then a few bytes repeatedly."""

    async def go_on(session: Session) -> None:
        with suppress(ConnectionError):
            session.writer.write(begin)
            while True:
                session.writer.write(again)
                await session.writer.drain()
                await asyncio.sleep(every)

    return go_on


def challenges(shown: str) -> Callable[[Camera], None]:
    """Refuse each request with a challenge, a new one each time."""

    def refuse(request: Request) -> bytes:
        challenge = shown.replace("NUMBER", request.cseq)
        return answered(request, "401 Unauthorized", f"WWW-Authenticate: {challenge}")

    return answers(OPTIONS=refuse, DESCRIBE=refuse)


def to(place: str) -> Callable[[Camera], None]:
    """Redirect each request."""
    return answers(OPTIONS=lambda one: answered(one, "302 Moved", f"Location: {place}"))


def set_up_as(transport: str) -> Callable[[Camera], None]:
    """Answer SETUP with another transport than the requested one."""
    return answers(
        SETUP=lambda one: answered(one, "200 OK", "Session: 1", f"Transport: {transport}")
    )


def no_session(camera: Camera) -> None:
    camera.session = "1;timeout=1"
    while_playing(forget)(camera)


def other_type(_: int, packets: list[bytes]) -> list[bytes]:
    return [one[:1] + bytes([one[1] & 0x80 | 33]) + one[2:] for one in packets]


def no_marker(_: int, packets: list[bytes]) -> list[bytes]:
    """Return packets of a picture without an end: no marker, and one time for all."""
    return [one[:1] + bytes([one[1] & 0x7F]) + one[2:4] + bytes(4) + one[8:] for one in packets]


def one_number(_: int, packets: list[bytes]) -> list[bytes]:
    return [one[:2] + b"\0\1" + one[4:] for one in packets]


def garbage(number: int, packets: list[bytes]) -> list[bytes]:
    return [one[:12] + bytes(number * 7 + place & 0xFF for place in range(99)) for one in packets]


def rootless(camera: Camera) -> None:
    """Send only pictures that depend on earlier ones."""
    camera.frames = [one for one in camera.frames if len(units(one)) == 1]
    camera.frames = (camera.frames * COUNT)[:COUNT]


def without_parameters(camera: Camera) -> None:
    camera.frames = [without_sets(one) for one in camera.frames]


def reports_only(camera: Camera) -> None:
    async def report(session: Session, number: int) -> bool:
        session.send(sender_report(1_000_000 + number, number * 3000), 1)
        return False

    camera.ends, camera.change = report, lambda *_: []


HEAD = b"RTSP/1.0 200 OK\r\nCSeq: 2\r\n"
PACKET = b"$\0\0\x0c" + struct.pack("!BBHII", 0x80, 96, 1, 2, 7)
ALERT = b"\x15\x03\x01\x00\x02\x02\x46"
"""The answer of a TLS server to a client that does not speak TLS."""

HTML = answers(
    DESCRIBE=lambda one: (
        answered(one, "200 OK", "Content-Type: text/html", "Content-Length: 13") + b"<html></html>"
    )
)
NO_PICTURE = "expected a whole picture, got none within"
MANY_TRACKS = "v=0\r\n" + "m=audio 0 RTP/AVP 8\r\n" * 2000

BAD: dict[str, Bad] = {
    # servers that do not answer
    "silent": Bad("an answer to OPTIONS, got none within", answers(OPTIONS=None), SHORT),
    "hangs up at once": Bad("server closed the connection", first("OPTIONS", hang_up)),
    "resets the connection": Bad("the connection is lost", first("DESCRIBE", reset)),
    "hangs up within an answer": Bad(
        "server closed the connection",
        first("DESCRIBE", lambda one: say(HEAD + b"Conte")(one) and hang_up(one)),
    ),
    "speaks HTTP": Bad(
        "an answer to OPTIONS, got none within",
        answers(OPTIONS=b"HTTP/1.1 400 Bad Request\r\n\r\n"),
        SHORT,
    ),
    "speaks TLS": Bad("an answer to OPTIONS, got none within", answers(OPTIONS=ALERT), SHORT),
    "speaks no TLS where it should": Bad(
        "an answer to the connection, got none within", lambda _: None, SHORT, scheme="rtsps"
    ),
    "sends bytes of nothing": Bad("belong to no message", answers(OPTIONS=b"\xde\xad" * 200_000)),
    "sends packets instead of an answer": Bad(
        "an answer to DESCRIBE, got none within", first("DESCRIBE", drip(b"", PACKET)), SHORT
    ),
    "asks instead of answering": Bad(
        "an answer to DESCRIBE, got none within",
        first("DESCRIBE", drip(b"", b"OPTIONS * RTSP/1.0\r\nCSeq: 1\r\n\r\n")),
        SHORT,
    ),
    "has us wait for ever": Bad(
        "an answer to DESCRIBE, got none within",
        first("DESCRIBE", drip(b"", b"RTSP/1.0 100 Continue\r\nCSeq: 2\r\n\r\n")),
        SHORT,
    ),
    "drips its answer": Bad(
        "an answer to DESCRIBE, got none within", first("DESCRIBE", drip(HEAD, b"X")), SHORT
    ),
    "sends half of an answer": Bad(
        "an answer to DESCRIBE, got none within", answers(DESCRIBE=HEAD + b"Conte"), SHORT
    ),
    "sends a head without an end": Bad(
        "a header of 65536 bytes at most", answers(DESCRIBE=HEAD + b"X: " + b"a" * 200_000)
    ),
    "sends a body without an end": Bad(
        "a body of 65536 bytes at most",
        answers(DESCRIBE=HEAD + b"Content-Length: 2000000000\r\n\r\n" + b"a=x\r\n" * 99),
    ),
    # servers that refuse or redirect
    "does not know the stream": Bad("DESCRIBE: 404 Not Found", answers(DESCRIBE="404 Not Found")),
    "speaks a later version only": Bad(
        "DESCRIBE: 505 RTSP Version Not Supported",
        answers(DESCRIBE="505 RTSP Version Not Supported"),
    ),
    "has no room": Bad(
        "SETUP: 453 Not Enough Bandwidth", answers(SETUP="453 Not Enough Bandwidth")
    ),
    "fails at PLAY": Bad(
        "PLAY: 500 Internal Server Error", answers(PLAY="500 Internal Server Error")
    ),
    "wants a password that is not given": Bad(
        "401 Unauthorized: put USER:PASSWORD@", challenges('Basic realm="x"')
    ),
    "refuses the password": Bad(
        "401 Unauthorized: wrong user or password", challenges('Basic realm="x"'), user=WHO
    ),
    "asks for the password for ever": Bad(
        "401 Unauthorized: wrong user or password",
        challenges('Digest realm="x", nonce="NUMBER", stale=true'),
        user=WHO,
    ),
    "wants a password in an unknown way": Bad(
        "expected Basic, or Digest with MD5 or SHA-256, got 'NTLM'", challenges("NTLM"), user=WHO
    ),
    "redirects to itself for ever": Bad("more than 5 redirects", to("/again")),
    "redirects to another host": Bad(
        "a redirect on the same host and port", to("rtsp://192.0.2.1/cam"), user=WHO
    ),
    "redirects to no server": Bad(
        "expected a redirect to rtsp://HOST", to("http://[::"), how="&elsewhere=yes"
    ),
    # servers with an unsupported description or transport
    "describes nothing": Bad("got 0 bytes without", answers(DESCRIBE=HEAD + b"\r\n")),
    "describes by a page": Bad("got 13 bytes without a stream", HTML),
    "describes by bytes of nothing": Bad("bytes without a stream", describes("\0\xff" * 3000)),
    "describes half of a stream": Bad("bytes without a stream", describes(SDP[:60])),
    "describes streams without a word": Bad(
        "expected video in H264, H265 or JPEG, got -1", describes("m=\r\nm=video\r\n")
    ),
    "has only sound": Bad(
        "got audio", describes("v=0\r\nm=audio 0 RTP/AVP 8\r\n"), error=FrameFormatError
    ),
    "has thousands of sounds": Bad("got audio", describes(MANY_TRACKS), error=FrameFormatError),
    "encrypts": Bad(
        "got encrypted H264",
        describes("v=0\r\nm=video 0 RTP/SAVP 96\r\na=rtpmap:96 H264/90000\r\n"),
        error=FrameFormatError,
    ),
    "takes no transport": Bad(
        "SETUP: 461 Unsupported Transport", answers(SETUP="461 Unsupported Transport")
    ),
    "sends to everybody": Bad(
        "got 'RTP/AVP/TCP;multicast'", set_up_as("RTP/AVP/TCP;multicast;interleaved=0-1")
    ),
    "sends by UDP where it was asked for TCP": Bad(
        "expected RTP/AVP/TCP;unicast, as it was asked for, got 'RTP/AVP'",
        set_up_as("RTP/AVP/UDP;unicast;client_port=5000-5001"),
    ),
    # servers that become silent
    "is silent after the description": Bad(
        "an answer to SETUP, got none within", answers(SETUP=None), SHORT
    ),
    "is silent after PLAY": Bad("an answer to PLAY, got none within", answers(PLAY=None), SHORT),
    # servers that play without a picture
    "sends nothing": Bad(NO_PICTURE, sends(lambda *_: []), SHORT),
    "sends nothing by UDP": Bad(NO_PICTURE, sends(lambda *_: []), SHORT, how="&transport=udp"),
    "sends reports only": Bad(NO_PICTURE, reports_only, SHORT),
    "sends packets of another type": Bad(NO_PICTURE, sends(other_type), SHORT),
    "sends packets of one number": Bad(NO_PICTURE, sends(one_number), SHORT),
    "sends garbage": Bad(NO_PICTURE, sends(garbage), SHORT),
    "ends no picture": Bad(NO_PICTURE, sends(no_marker), SHORT),
    "sends no key frame": Bad(NO_PICTURE, rootless, SHORT),
    "sends no parameters": Bad(NO_PICTURE, without_parameters, SHORT),
    "ends it right after PLAY": Bad(
        r"the server ended the session (TEARDOWN)",
        first("PLAY", say(b"TEARDOWN * RTSP/1.0\r\nCSeq: 1\r\n\r\n")),
    ),
    # servers that fail after pictures
    "hangs up": Bad("the server closed the connection", while_playing(hang_up)),
    "says goodbye": Bad("the server ended the stream (over", while_playing(tell_goodbye)),
    "ends the session": Bad(
        "the server ended the session (TEARDOWN)",
        while_playing(say(b"TEARDOWN * RTSP/1.0\r\nCSeq: 1\r\n\r\n")),
    ),
    "sends us to another server": Bad(
        "the server ended the session (REDIRECT)",
        while_playing(say(b"REDIRECT * RTSP/1.0\r\nCSeq: 1\r\nLocation: rtsp://h\r\n\r\n")),
    ),
    "forgets the session": Bad("454 Session Not Found", no_session),
    "sends no more": Bad("no packet came for 2 s", while_playing(lambda _: True), 2.0),
    "goes on with bytes of nothing": Bad(
        "belong to no message", while_playing(say(b"\xde\xad" * 200_000))
    ),
}


async def read_all(url: str) -> None:
    """Read all pictures of a source."""
    async with frames.open(url) as source:
        async for _ in source:
            pass


@pytest.mark.parametrize("name", BAD)
async def test_bad_server_is_reported_in_time(encoded: list[bytes], name: str) -> None:
    bad, camera = BAD[name], Camera(encoded)
    bad.do(camera)
    loop = asyncio.get_running_loop()
    began = loop.time()
    async with asyncio.timeout(LIMIT), camera_on(camera) as where:
        url = f"{bad.scheme}://{bad.user}{where}#timeout={bad.timeout}{bad.how}"
        with pytest.raises(bad.error, match=re.escape(bad.message)) as got:
            await read_all(url)
    assert "s3cret" not in str(got.value)
    assert loop.time() - began < LIMIT
    assert len(camera.asked) < 20


async def test_server_of_another_size_is_reported(encoded: list[bytes]) -> None:
    camera = Camera(encoded)
    async with frames.Codecs(threads=1) as codecs:
        small = await codecs.h264_encoder().encode(frame_of(stamped(0, 256, 64), "Mono8"))

    def change(session: Session) -> bool:
        session.camera.frames = [bytes(small.data)] * COUNT
        return False

    while_playing(change)(camera)
    async with asyncio.timeout(LIMIT), camera_on(camera) as where:
        with pytest.raises(FrameFormatError, match="got 256x64: open it again"):
            await read_all(f"rtsp://{where}")


@asynccontextmanager
async def socket_that(listens: bool) -> AsyncIterator[str]:
    """Give the address of a socket that does not answer, or accepts no connection."""
    with socket.socket() as held:
        held.bind(("127.0.0.1", 0))
        if listens:
            held.listen(1)
        yield f"127.0.0.1:{held.getsockname()[1]}"


@pytest.mark.parametrize(
    ("listens", "message"),
    [(False, "cannot be read: Connection refused"), (True, "an answer to OPTIONS, got none")],
)
async def test_missing_or_full_server_is_reported(listens: bool, message: str) -> None:
    async with asyncio.timeout(LIMIT), socket_that(listens) as where:
        with pytest.raises(FrameSourceError, match=message):
            await read_all(f"rtsp://{where}/cam#timeout={SHORT}")
