"""The users whom a site lets in, and the headers that every answer carries."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys

import aiohttp
import pytest

from smartcam._accepting import is_loopback
from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ConfigurationError
from smartcam.web import EmulatorSite
from tests.web.sitekit import TOKEN, Raw, served

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Server": "smartcam",
}


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost", 200),
        ("LOCALHOST:1234", 200),
        ("127.0.0.1:8080", 200),
        ("[::1]:80", 200),
        ("evil.example", 403),
        ("127.0.0.1.evil.example:80", 403),
        ("localhost.evil.example", 403),
        ("192.168.0.10", 403),
        ("[", 403),
        ("", 403),
    ],
)
@pytest.mark.parametrize("path", ["/api/cameras", "/"])
async def test_host_other_than_loopback_is_refused(path: str, host: str, status: int) -> None:
    async with served() as world, Raw.connected(world.site) as raw:
        answered, body = await raw.call(f"GET {path} HTTP/1.1", f"Host: {host}")
    assert answered == status
    assert status == 200 or b"expected localhost or another name of loopback" in body


@pytest.mark.parametrize(
    ("header", "value", "status"),
    [
        ("Origin", "http://localhost:8080", 200),
        ("Origin", "http://localhost", 403),
        ("Origin", "http://evil.example", 403),
        ("Origin", "null", 403),
        ("Sec-Fetch-Site", "same-origin", 200),
        ("Sec-Fetch-Site", "none", 200),
        ("Sec-Fetch-Site", "same-site", 403),
        ("Sec-Fetch-Site", "cross-site", 403),
    ],
)
@pytest.mark.parametrize("method", ["GET /api/cameras", "POST /api/cameras/camera/start"])
async def test_call_of_another_site_is_refused(
    method: str, header: str, value: str, status: int
) -> None:
    async with served() as world, Raw.connected(world.site) as raw:
        answered, body = await raw.call(
            f"{method} HTTP/1.1", "Host: localhost:8080", f"{header}: {value}"
        )
        started = world.emulator.device.running
    assert answered == status
    assert started is (status == 200 and method.startswith("POST"))
    assert status == 200 or b"expected the page's own" in body


async def test_page_may_be_linked_to_from_elsewhere() -> None:
    async with served() as world:
        headers = {"Sec-Fetch-Site": "cross-site"}
        async with world.caller.session.get(world.site.url, headers=headers) as response:
            assert response.status == 200


async def test_token_is_needed_for_calls_alone() -> None:
    async with served(token=TOKEN) as world:
        assert world.site.token == TOKEN
        assert world.site.url == f"{world.site.origin}/#token={TOKEN}"
        assert len((await world.caller.get("/api/cameras"))["cameras"]) == 1
        async with aiohttp.ClientSession() as stranger:
            async with stranger.get(f"{world.site.origin}/") as page:
                assert page.status == 200
            async with stranger.get(f"{world.site.origin}/api/cameras") as refused:
                answer = await refused.json()
        assert refused.status == 401
        assert refused.headers["WWW-Authenticate"] == 'Bearer realm="smartcam"'
        assert answer["received"] == "no Authorization"


@pytest.mark.parametrize(
    "given", ["Bearer", "Bearer x", f"Basic {TOKEN}", f"Bearer {TOKEN}x", TOKEN, "Bearer \xff"]
)
async def test_wrong_token_is_refused(given: str) -> None:
    async with served(token=TOKEN) as world, Raw.connected(world.site) as raw:
        status, body = await raw.call(
            "POST /api/cameras/camera/start HTTP/1.1", "Host: x", f"Authorization: {given}"
        )
        assert world.emulator.device.running is False
    assert status == 401
    assert b"an Authorization with another token" in body


async def test_token_makes_every_host_name_good() -> None:
    async with served(token=TOKEN) as world, Raw.connected(world.site) as raw:
        status, _ = await raw.call(
            "GET /api/cameras HTTP/1.1", "Host: cell-7.factory:80", f"Authorization: Bearer {TOKEN}"
        )
    assert status == 200


@pytest.mark.parametrize("token", ["", "short", "15-characters-x", "sixteen letters!", "ü" * 16])
def test_token_that_is_too_short_or_odd_is_refused(token: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        EmulatorSite({}, token=token)
    assert str(caught.value).startswith("web: a token has 16 letters, digits, '-' and '_' at least")


def test_address_that_others_reach_gets_a_token() -> None:
    sites = [EmulatorSite({}, host="0.0.0.0") for _ in range(2)]  # noqa: S104
    tokens = {site.token for site in sites}
    assert len(tokens) == 2
    assert all(token is not None and len(token) == 32 for token in tokens)
    assert EmulatorSite({}, host="127.0.0.1").token is None
    assert EmulatorSite({}, host="localhost").token is None


async def test_site_on_all_addresses_is_reached_by_any_with_the_token() -> None:
    async with EmulatorSite({}, host="0.0.0.0") as site, Raw.connected(site) as raw:  # noqa: S104
        name, _, token = site.url.partition("/#token=")
        assert name == f"http://{socket.gethostname()}:{site.port}" == site.origin
        status, body = await raw.call(
            "GET /api/cameras HTTP/1.1", "Host: any", f"Authorization: Bearer {token}"
        )
    assert (status, body) == (200, b'{"cameras": []}\n')


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.9.9.9", True),
        ("::1", True),
        ("LocalHost", True),
        ("0.0.0.0", False),  # noqa: S104
        ("::", False),
        ("", False),
        ("localhost.example", False),
        ("2130706433", False),
    ],
)
def test_loopback_is_recognized_by_address_or_its_one_name(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


async def test_every_answer_has_the_headers() -> None:
    async with served() as world, world.events() as events:
        answers = [events.response.headers]
        for path in ("/", "/emulator.js", "/emulator.css", "/api", "/nothing", "/api/nothing"):
            async with world.caller.session.get(world.site.origin + path) as response:
                answers.append(response.headers)
    for headers in answers:
        assert {key: headers.get(key) for key in HEADERS} == HEADERS


async def test_page_names_nothing_from_elsewhere() -> None:
    async with served() as world:
        texts: list[str] = []
        for name in ("", "emulator.js", "emulator.css"):
            async with world.caller.session.get(f"{world.site.origin}/{name}") as response:
                assert response.status == 200
                texts.append((await response.text()).replace("http://www.w3.org/2000/svg", ""))
    assert [text for text in texts if "http:" in text or "https:" in text or "url(" in text] == []
    assert "style=" not in texts[0]


# ---------------------------------------------------------------------- the site's life


async def test_site_starts_and_stops_as_often_as_wanted() -> None:
    async with EmulatedCamera() as emulator, aiohttp.ClientSession() as session:
        site = EmulatorSite({"camera": emulator})
        assert site.port == 0
        await site.stop()
        for _ in range(2):
            await site.start()
            await site.start()
            async with session.get(f"{site.origin}/api/cameras") as response:
                assert response.status == 200
            port = site.port
            await site.stop()
        assert site.port == port


async def test_stop_that_is_cancelled_closes_everything() -> None:
    async with served() as world, world.events() as events:
        stopping = asyncio.create_task(world.site.stop())
        await asyncio.sleep(0)
        stopping.cancel()
        with pytest.raises(asyncio.CancelledError):
            await stopping
        await events.end()
        with pytest.raises(ConnectionRefusedError):
            await asyncio.open_connection("127.0.0.1", world.site.port)


async def test_port_that_is_taken_is_a_configuration_error() -> None:
    async with EmulatorSite({}) as one:
        with pytest.raises(ConfigurationError) as caught:
            await EmulatorSite({}, port=one.port).start()
    assert str(caught.value).startswith(
        f"web: cannot listen on http://127.0.0.1:{one.port}: [Errno 98] Address already in use"
    )


async def test_unknown_host_is_a_configuration_error() -> None:
    with pytest.raises(ConfigurationError, match="web: cannot listen on http://no host:0: "):
        await EmulatorSite({}, host="no host").start()


def test_missing_aiohttp_is_reported_in_one_line() -> None:
    code = (
        "import sys; sys.modules['aiohttp'] = None\n"
        "import smartcam.web\n"
        "try: smartcam.web.EmulatorSite\n"
        "except smartcam.exceptions.MissingExtraError as error: print(error, error.extra)"
    )
    done = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout == 'the web page needs aiohttp: pip install "smartcam[web]" web\n'
