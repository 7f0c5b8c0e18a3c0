"""``smartcam frames serve``: a page, RTSP and RTP of some sources, until it is ended."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import re
import signal
import socket
import urllib.request
from pathlib import Path
from typing import Any, ClassVar

import click
import pytest

from smartcam._cli import frames_serve
from smartcam._cli.frame_players import parse_address_option, rtsp_server, rtsp_urls, unique_names
from smartcam._cli.frames_serve import viewers_text
from smartcam.exceptions import FrameFormatError, FrameSourceError
from smartcam.frames import FrameAddress, FrameSource, StreamFormat, find_format
from smartcam.registry import FRAMES
from smartcam.web import FramesSite
from tests.cli.commandline import run
from tests.frames.drivers import ScriptedDriver, scripted
from tests.processes import PATIENCE, Process
from tests.web.sitekit import TOKEN

pytest.importorskip("simplejpeg", reason="needs the extra frames")
pytest.importorskip("av", reason="needs the extra video")

LEFT, RIGHT = "synthetic://?name=left&size=256x16", "synthetic://?name=right&size=256x16"


class Shelf(ScriptedDriver):
    """``shelf://``: cannot be opened, for a reason that its class has."""

    reasons: ClassVar[dict[str, BaseException]] = {}

    def __init__(self, given: FrameAddress) -> None:
        super().__init__()
        self._host = given.url.partition("://")[2]

    @property
    def name(self) -> str:
        return "shelf"

    async def open(self) -> StreamFormat:
        if self._host in self.reasons:
            raise self.reasons[self._host]
        return StreamFormat(find_format("Mono8"), 4, 2, self.rates)


@pytest.fixture
def shelf(monkeypatch: pytest.MonkeyPatch) -> dict[str, BaseException]:
    """Register ``shelf://NAME``; yield the reasons, by name, why sources cannot be opened."""
    reasons: dict[str, BaseException] = {}
    monkeypatch.setattr(FRAMES, "_registered", {"shelf": Shelf})
    monkeypatch.setattr(FRAMES, "_loaded", {})
    monkeypatch.setattr(Shelf, "reasons", reasons)
    return reasons


def get(url: str) -> Any:
    with urllib.request.urlopen(url, timeout=PATIENCE) as answer:  # noqa: S310 - http
        return json.load(answer)


def described(url: str) -> str:
    """Return an RTSP server's answer to DESCRIBE, without a password."""
    match = re.fullmatch(r"rtsp://(?:[^@]+@)?([^:/]+):(\d+)/.+", url)
    assert match is not None, url
    with socket.create_connection((match[1], int(match[2])), PATIENCE) as peer:
        peer.sendall(f"DESCRIBE {url} RTSP/1.0\r\nCSeq: 1\r\n\r\n".encode())
        answer = b""
        while b"\r\n\r\n" not in answer:
            answer += peer.recv(65536)
        return answer.decode()


# ---------------------------------------------------------------------- what is served


@pytest.mark.real_time
def test_page_rtsp_and_rtp_are_served_until_sigterm(tmp_path: Path) -> None:
    file = tmp_path / "left.sdp"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(PATIENCE)
        port = receiver.getsockname()[1]
        beside = ("--rtsp", "127.0.0.1:0", "--rtp", f"127.0.0.1:{port}", "--sdp", str(file))
        with Process("smartcam", "frames", "serve", LEFT, *beside, "--json") as process:
            served, sent = map(json.loads, process.read_until(b"\n", count=2).splitlines())
            packet = receiver.recv(65536)
            (told,) = get(f"{served['page']}api/sources")["sources"]
            assert described(served["rtsp"]["left"]).startswith("RTSP/1.0 200 OK")
            process.send_signal(signal.SIGTERM)
            ended = process.wait()
    assert (ended.code, ended.err) == (0, "")
    assert (told["name"], told["started"], told["readers"]) == ("left", 1, 1)
    assert (sent["rtp"], sent["sdp"].splitlines()) == (
        f"127.0.0.1:{port}",
        file.read_text("utf-8").splitlines(),
    )
    assert f"m=video {port} RTP/AVP 96" in sent["sdp"]
    assert "sprop-parameter-sets=" in sent["sdp"]
    assert (packet[0] >> 6, packet[1] & 0x7F) == (2, 96)


def test_text_has_a_line_for_each() -> None:
    out = (
        run(
            *("frames", "serve", LEFT, RIGHT, "--rtsp", "127.0.0.1:0", "--seconds", "0.01"),
            *("--web-token", TOKEN),
        )
        .done()
        .out
    )
    assert re.fullmatch(
        rf"page: http://127.0.0.1:\d+/#token={TOKEN}\n"
        rf"rtsp: rtsp://smartcam:{TOKEN}@127.0.0.1:(\d+)/left\n"
        rf"rtsp: rtsp://smartcam:{TOKEN}@127.0.0.1:\1/right\n",
        out,
    )


# ---------------------------------------------------------------------- what goes wrong


def test_one_that_is_not_there_does_not_end_the_others(shelf: dict[str, BaseException]) -> None:
    shelf |= {
        "gone": FrameSourceError("shelf: no such device"),
        "wrong": FrameFormatError("shelf: it has no YUYV"),
    }
    done = run(
        *("frames", "serve", "shelf://gone", LEFT, "shelf://wrong"),
        *("--rtsp", "127.0.0.1:0", "--seconds", "0.01"),
    )
    assert done.code == 0
    assert done.out.count("\n") == 4
    assert sorted(done.err.splitlines()) == [
        "note: shelf: it has no YUYV; waiting for it",
        "note: shelf: no such device; waiting for it",
    ]


def test_nothing_but_wrong_ones_ends(shelf: dict[str, BaseException]) -> None:
    shelf |= {
        "a": FrameFormatError("shelf: it has no YUYV"),
        "b": FrameFormatError("shelf: it has no RGB8"),
    }
    done = run("frames", "serve", "shelf://a", "shelf://b")
    assert done.code == 5
    assert done.out == ""
    assert "error: shelf: it has no YUYV" in done.err


def test_one_that_takes_long_holds_up_the_page_for_a_while_only(
    shelf: dict[str, BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def open_(self: Shelf) -> StreamFormat:
        if self._host == "wrong":
            raise FrameFormatError("shelf: it has no YUYV")
        await asyncio.Event().wait()
        raise AssertionError

    monkeypatch.setattr(Shelf, "open", open_)
    monkeypatch.setattr(frames_serve, "FIRST_TRY_TIMEOUT", 0.01)
    done = run("frames", "serve", "shelf://slow", "shelf://wrong", "--seconds", "0.01")
    assert done.code == 0
    assert done.out.startswith("page: ")
    assert done.err == "note: shelf: it has no YUYV; waiting for it\n"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), "Missing argument 'URL...'"),
        ((LEFT,) * 5, "expected 4 URLs at most, got 5"),
        ((LEFT, "nothing://"), "unknown scheme 'nothing'"),
        ((LEFT, "--rtsp", "8554"), "'8554': expected HOST:PORT"),
        ((LEFT, "--rtp", "127.0.0.1:0"), "expected the receiver's port"),
        ((LEFT, RIGHT, "--rtp", "127.0.0.1:5004"), "--rtp sends one source"),
        ((LEFT, "--sdp", "x.sdp"), "--sdp needs --rtp"),
        ((LEFT, "--rtp", "127.0.0.1:9", "--sdp", "nowhere/x.sdp"), "--sdp nowhere/x.sdp: No such"),
        ((LEFT, "--web-token", "short"), "16 letters"),
        ((LEFT, "--rtsp", "192.0.2.1:0"), "RTSP: cannot listen on 192.0.2.1"),
    ],
)
def test_wrong_use_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], text: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = run("frames", "serve", *arguments)
    assert done.code == 2
    assert text in done.err


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("127.0.0.1:8554", ("127.0.0.1", 8554)),
        ("[::1]:0", ("::1", 0)),
        ("camera.example:65535", ("camera.example", 65535)),
        *((wrong, None) for wrong in ("", ":1", "a:", "a:65536", "a:-1", "::1:80", "a:²", "[::1]")),
    ],
)
def test_address_is_read_or_refused(text: str, value: tuple[str, int] | None) -> None:
    parameter = click.Option(["--rtsp"])
    if value is None:
        with pytest.raises(click.BadParameter, match="expected HOST:PORT"):
            parse_address_option(None, parameter, text)
    else:
        assert parse_address_option(None, parameter, text) == value


# ---------------------------------------------------------------------- names and passwords


def named(name: str) -> FrameSource:
    """Return a source of a name, whatever is in it."""

    class Named(ScriptedDriver):
        @property
        def name(self) -> str:
            return name

    return FrameSource(Named())


def test_names_are_such_as_a_url_has_and_each_its_own() -> None:
    given = ["left", "line1/cam 1", "left", "/ü/", "x" * 200, "left"]
    sources = [named(name) for name in given]
    names = unique_names(sources)
    assert [*names] == ["left", "line1-cam-1", "left-2", "camera", "x" * 60, "left-3"]
    assert [*names.values()] == sources
    server, _ = rtsp_server(sources, ("127.0.0.1", 0), None)  # which refuses others
    assert [*rtsp_urls(server, sources, None)] == [*names]


@pytest.mark.parametrize("token", [None, TOKEN])
def test_password_is_the_pages_token_or_made_where_others_can_come(token: str | None) -> None:
    sources = [named("left")]
    server, password = rtsp_server(sources, ("127.0.0.1", 8554), token)
    who = "" if token is None else f"smartcam:{token}@"
    assert rtsp_urls(server, sources, password) == {"left": f"rtsp://{who}127.0.0.1:8554/left"}
    _, made = rtsp_server(sources, ("0.0.0.0", 8554), token)  # noqa: S104
    assert made == token or (token is None and len(str(made)) >= 32)


# ---------------------------------------------------------------------- who looks


async def test_terminal_is_told_who_looks_once_a_second_at_most(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import aiohttp

    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    sources = [named("left"), named("right")]
    async with FramesSite(sources) as site, aiohttp.ClientSession() as session:
        assert viewers_text(site) == "nobody looks"
        telling = asyncio.create_task(frames_serve._show_viewers(site, None))
        url = f"{site.origin}/api/sources/1/pictures"
        for _ in range(3):  # who comes and goes within a second is not told
            async with session.ws_connect(url, protocols=["smartcam.frames"]):
                pass
        await asyncio.sleep(1.5)
        assert capsys.readouterr().err == ""
        async with (
            session.ws_connect(url, protocols=["smartcam.frames"]),
            session.ws_connect(url, protocols=["smartcam.frames"]),
        ):
            await asyncio.sleep(5)
            (line,) = capsys.readouterr().err.splitlines()
            assert line.endswith(" right: 127.0.0.1, 127.0.0.1")
        await asyncio.sleep(2)
        (line,) = capsys.readouterr().err.splitlines()
        assert line.endswith(" nobody looks")
        telling.cancel()
        await asyncio.wait([telling])


async def test_who_looks_by_rtsp_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    _, source = scripted()
    async with source, FramesSite([source]) as site:
        server, _ = rtsp_server([source], ("127.0.0.1", 0), None)
        async with server:
            assert viewers_text(site, server) == "nobody looks"
            counted = dataclasses.replace(server.statistics()["scripted"], viewers=2)
            monkeypatch.setattr(server, "statistics", lambda: {"scripted": counted})
            assert viewers_text(site, server) == "scripted: 2 by RTSP"
