"""A camera's parameters by RTSP are features; a camera may have none."""

from __future__ import annotations

import asyncio
import contextlib
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

import pytest

from smartcam import frames
from smartcam.exceptions import (
    FrameFeatureError,
    FrameSourceError,
    FrameTimeoutError,
    UnsupportedError,
)
from smartcam.frames import RtspServer
from tests.frames.rtsp_client.camera import Camera, Request, camera_on, digest, pictures

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.frames import FrameSource

pytestmark = [pytest.mark.real_time, pytest.mark.usefixtures("no_leaks")]

LIMIT = 30.0
"""Seconds after which a test fails."""


@pytest.fixture(scope="module")
def encoded() -> list[bytes]:
    return asyncio.run(pictures())


class Parameters:
    """Answers by RFC 2326, sections 10.8, 10.9 and 11.3.

    Args:
        known: values by names.
        read_only: names that cannot be set.
        in_session: whether requests need a session.
    """

    def __init__(self, known: dict[str, str], *read_only: str, in_session: bool = False) -> None:
        self.known, self.read_only, self.in_session = known, read_only, in_session

    def __call__(self, request: Request) -> bytes:
        status, body = self.answer(request)
        head = f"RTSP/1.0 {status}\r\nCSeq: {request.cseq}\r\nContent-Type: text/parameters\r\n"
        return f"{head}Content-Length: {len(body)}\r\n\r\n{body}".encode()

    def answer(self, request: Request) -> tuple[str, str]:
        if self.in_session and "session" not in request.headers:
            return "454 Session Not Found", ""
        assert request.headers["content-type"] == "text/parameters"
        name, _, value = (part.strip() for part in request.body.partition(":"))
        if name not in self.known:
            return "451 Parameter Not Understood", f"{name}\r\n"
        if request.method == "GET_PARAMETER":
            return "200 OK", f"{name}: {self.known[name]}\r\n"
        if name in self.read_only:
            return "458 Parameter Is Read-Only", ""
        if name == "zoom" and not 1 <= int(value) <= 10:
            return "457 Invalid Range", ""
        self.known[name] = f"{int(value) // 2 * 2}" if name == "focus" else value
        return "200 OK", ""


@asynccontextmanager
async def opened(camera: Camera, user: str = "") -> AsyncIterator[FrameSource]:
    async with (
        asyncio.timeout(LIMIT),
        camera_on(camera) as where,
        frames.open(f"rtsp://{user}{where}#timeout=1") as source,
    ):
        yield source


def with_parameters(encoded: list[bytes], **how: Any) -> Camera:
    known = {"zoom": "2", "focus": "10", "serial": "A17 b"}
    asked = Parameters(known, "serial", **how)
    return Camera(encoded, answers={"GET_PARAMETER": asked, "SET_PARAMETER": asked})


@pytest.mark.parametrize("in_session", [False, True])
@pytest.mark.parametrize("playing", [False, True])
async def test_a_parameter_is_read_and_set(
    encoded: list[bytes], in_session: bool, playing: bool
) -> None:
    camera = with_parameters(encoded, in_session=in_session)
    async with opened(camera) as source:
        reader = source.reader()
        if playing:
            await anext(reader)
            connections = camera.connections
        features = source.features
        assert await features["zoom"].get() == "2"
        assert await features["zoom"].set(7) == "7"
        assert await features["focus"].set(33) == "32"  # as the camera rounded it
        described = await features["serial"].describe()
        assert (described.value, described.kind, described.access) == ("A17 b", "string", "rw")
        if playing:
            assert camera.connections == connections  # the playing session
            assert (await anext(reader)).lost == 0
        reader.close()
    asked = [one for one in camera.asked if one.method.endswith("_PARAMETER")]
    assert all(one.body.endswith("\r\n") for one in asked)


async def test_refusals_of_a_camera_are_errors(encoded: list[bytes]) -> None:
    camera = with_parameters(encoded)
    async with opened(camera) as source:
        features = source.features
        with pytest.raises(FrameFeatureError, match=r"'hue': there is no such parameter.*451"):
            await features["hue"].get()
        with pytest.raises(FrameFeatureError, match=r"'serial': it can only be read.*458"):
            await features["serial"].set("B")
        with pytest.raises(
            FrameFeatureError, match=r"'zoom': the camera does not accept the value.*457"
        ):
            await features["zoom"].set(11)
        asked = len(camera.asked)
        for name in ("a b", "a:b", "a\r\nzoom", "\xe9"):
            with pytest.raises(FrameFeatureError, match="name of printable ASCII"):
                await features[name].get()
        with pytest.raises(FrameFeatureError, match=r"expected a value of one line, got '1.*2'"):
            await features["zoom"].set("1\r\nfocus: 2")
        for call in (features.names(), features.describe(), features.load_at_power_on("UserSet1")):
            with pytest.raises(UnsupportedError, match="cannot list its parameters"):
                await call
        with pytest.raises(UnsupportedError, match="cannot execute a command such as Reboot"):
            await features["Reboot"].execute()
        assert len(camera.asked) == asked
        assert not source.has_features  # the list of values is not shown


@pytest.mark.parametrize(
    ("answer", "kind", "text"),
    [
        ("405 Method Not Allowed", UnsupportedError, "no such request: GET_PARAMETER: 405"),
        ("501 Not Implemented", UnsupportedError, "no such request: GET_PARAMETER: 501"),
        ("", FrameFeatureError, "got none: the camera uses the request only"),
        ("403 Forbidden", FrameFeatureError, "it refuses that: GET_PARAMETER: 403 Forbidden"),
        (None, FrameTimeoutError, "an answer to GET_PARAMETER, got none within 1 s"),
    ],
)
async def test_camera_without_parameters_reports_it(
    encoded: list[bytes], answer: Any, kind: type[Exception], text: str
) -> None:
    camera = Camera(encoded, answers={"GET_PARAMETER": answer})
    async with opened(camera) as source:
        with pytest.raises(kind, match=text):
            await source.features["zoom"].get()
        async with source.reader() as reader:
            await anext(reader)
            with pytest.raises(kind, match=text):
                await source.features["zoom"].get()
            await anext(reader)


async def test_an_answer_with_other_lines_gives_no_wrong_value(encoded: list[bytes]) -> None:
    body = "Zoom: 3\r\nzoomed: 9\r\n"
    text = f"RTSP/1.0 200 OK\r\nCSeq: %s\r\nContent-Length: {len(body)}\r\n\r\n{body}"
    camera = Camera(
        encoded, answers={"GET_PARAMETER": lambda request: (text % request.cseq).encode()}
    )
    async with opened(camera) as source:
        assert await source.features["zoom"].get() == "3"
        with pytest.raises(FrameFeatureError, match=r"'focus': expected its value.*got 'Zoom: 3"):
            await source.features["focus"].get()


async def test_value_that_cannot_be_read_back_is_returned_as_given(encoded: list[bytes]) -> None:
    asked = Parameters({"zoom": "1"})
    camera = Camera(
        encoded, answers={"SET_PARAMETER": asked, "GET_PARAMETER": "501 Not Implemented"}
    )
    async with opened(camera) as source:
        assert await source.features["zoom"].set(4) == 4
    assert asked.known == {"zoom": "4"}


async def test_password_is_sent_for_a_parameter_too(encoded: list[bytes]) -> None:
    camera = with_parameters(encoded)
    asked, secret = camera.answers["GET_PARAMETER"], []

    def guarded(request: Request) -> Any:
        if not digest(request, "me", "s3cret", "md5"):
            return '401 No\r\nWWW-Authenticate: Digest realm="x", nonce="n", qop="auth"'
        secret.append(request.headers["authorization"])
        return asked(request)

    camera.answers["GET_PARAMETER"] = guarded
    async with opened(camera, "me:s3cret@") as source:
        assert await source.features["zoom"].get() == "2"
    assert len(secret) == 1


async def test_a_redirect_is_followed_within_the_host_alone(encoded: list[bytes]) -> None:
    camera, other = with_parameters(encoded), with_parameters(encoded)
    asked = camera.answers["GET_PARAMETER"]
    async with camera_on(other) as there, opened(camera) as source:
        here = f"127.0.0.1:{camera.port}/moved"

        def moved(request: Request) -> Any:
            if request.url.endswith("/moved"):
                return asked(request)
            return f"302 Moved\r\nLocation: rtsp://{here}"

        camera.answers["GET_PARAMETER"] = moved
        assert await source.features["zoom"].get() == "2"
        camera.answers["GET_PARAMETER"] = f"302 Moved\r\nLocation: rtsp://{there}"
        with pytest.raises(FrameSourceError, match=f"redirect.*{other.port}"):
            await source.features["zoom"].get()
    assert not other.asked


async def test_our_own_server_has_no_parameters() -> None:
    async with (
        asyncio.timeout(LIMIT),
        frames.open("synthetic://?size=256x64&fps=60") as left,
        RtspServer({"left": left}, port=0) as server,
        frames.open(server.url("left")) as source,
        source.reader() as reader,
    ):
        for _ in range(2):  # with an own session, and in the playing one
            with pytest.raises(FrameFeatureError, match=r"'gain': there is no such parameter.*451"):
                await source.features["gain"].get()
            with pytest.raises(FrameFeatureError, match=r"'gain': there is no such parameter.*451"):
                await source.features["gain"].set(1.5)
            await anext(reader)


GST = """
import sys, gi
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer
Gst.init(None)
server, factory = GstRtspServer.RTSPServer(), GstRtspServer.RTSPMediaFactory()
server.set_service("0")
factory.set_shared(True)
factory.set_launch("( videotestsrc is-live=true ! video/x-raw,width=320,height=240 ! "
    "x264enc tune=zerolatency speed-preset=ultrafast key-int-max=10 ! rtph264pay name=pay0 pt=96 )")
server.get_mount_points().add_factory("/cam", factory)
server.attach(None)
print(server.get_bound_port(), flush=True)
GLib.MainLoop().run()
"""


async def test_the_server_of_gstreamer_refuses_by_the_standard() -> None:
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        "/usr/bin/python3", "-c", GST, stdout=pipe, stderr=pipe
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(LIMIT):
            if not (port := (await process.stdout.readline()).decode().strip()):
                pytest.skip("needs GStreamer's server: apt-get install gir1.2-gst-rtsp-server-1.0")
            url = f"rtsp://127.0.0.1:{port}/cam"
            async with frames.open(url) as source, source.reader() as reader:
                for _ in range(2):
                    for call in (
                        source.features["brightness"].get(),
                        source.features["brightness"].set(50),
                    ):
                        with pytest.raises(FrameFeatureError, match=r"no such parameter.*451"):
                            await call
                    assert (await anext(reader)).width == 320
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.communicate()
