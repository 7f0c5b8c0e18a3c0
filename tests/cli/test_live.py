"""``smartcam live``, and ``smartcam watch --web``."""

from __future__ import annotations

import json
import re
import signal
import time
import urllib.error
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest

from tests.cli.commandline import emulators, run
from tests.processes import PATIENCE, Process, free_port, wait_until

if TYPE_CHECKING:
    from collections.abc import Iterator

TOKEN = "a-token_of-24-characters"  # noqa: S105 - of the tests


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with emulators(tmp_path_factory.mktemp("live"), ()) as (url,):
        yield url


def page_of(live: Process) -> str:
    """Return the page's address."""
    match = re.fullmatch(r"page: (http://\S+/)\n", live.read_until(b"\n"))
    assert match is not None
    return match[1]


def ask(url: str, body: object = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    headers = {"Content-Type": "application/json"} if data else {}
    request = urllib.request.Request(url, data, headers)  # noqa: S310 - http
    with urllib.request.urlopen(request, timeout=PATIENCE) as answer:  # noqa: S310 - http
        return json.load(answer)


def wait_for(page: str, connection: str) -> Any:
    """Return the camera's state once its connection is so."""
    end = time.monotonic() + PATIENCE
    while (state := ask(f"{page}api/camera"))["connection"] != connection:
        assert time.monotonic() < end, state
        time.sleep(0.05)
    return state


def test_live_looks_only_and_ends_with_ctrl_c(url: str) -> None:
    with Process("smartcam", "live", url, "--name", "cell") as live:
        page = page_of(live)
        state = wait_for(page, "connected")
        assert (state["name"], state["control"]) == ("cell", False)
        with pytest.raises(urllib.error.HTTPError, match="403"):
            ask(f"{page}api/trigger", {})
        live.send_signal(signal.SIGINT)
        ended = live.wait()
    assert (ended.code, ended.err) == (0, "")


def test_live_with_control_triggers(url: str) -> None:
    told = ("--application", "8", "--interpret-as", "table: (name: string[8], x: real32 mm)*")
    with Process("smartcam", "live", url, "--control", "--json", *told) as live:
        page = json.loads(live.read_until(b"\n"))["page"]
        assert wait_for(page, "connected")["control"] is True
        wait_until(lambda: ask(f"{page}api/camera")["application"] == 8)
        assert ask(f"{page}api/trigger", {"timeout": PATIENCE})["number"] == 1
        (result,) = ask(f"{page}api/results")["results"]
        live.send_signal(signal.SIGTERM)
        assert live.wait().code == 143
    assert [one["name"] for one in result["value"]] == ["bolt", "nut"]


def test_live_awaits_a_camera_that_is_not_there() -> None:
    port = free_port()
    with Process("smartcam", "live", f"bvs://127.0.0.1:{port}") as live:
        page = page_of(live)
        assert wait_for(page, "awaited")["status"] == []
        with Process("smartcam-emulator", "--port", str(port)):
            wait_for(page, "connected")
        wait_for(page, "lost")


def test_watch_web_shows_the_page(url: str) -> None:
    with Process("smartcam", "watch", url, "--web", "--seconds", "600", "--web-port", "0") as live:
        assert wait_for(page_of(live), "connected")["control"] is False
        live.send_signal(signal.SIGINT)
        assert live.wait().code == 0


def test_live_seconds_end_it(url: str) -> None:
    for seconds in ("0.1", "3", "60"):  # a slow machine gets more
        ended = run("live", url, "--seconds", seconds).done()
        if ended.out:
            break
    assert ended.out.startswith("page: http://127.0.0.1:")


@pytest.mark.parametrize(
    ("args", "text"),
    [
        (("watch", "--web", "--count", "2"), "--count and --web do not go together"),
        (("watch", "--web-port", "1"), "--web-port needs --web"),
        (("live", "--count", "2"), "No such option"),
        (("live", "--web-token", "short"), "16 letters"),
        (("live", "--calibration", "missing.yaml"), "No such file"),
    ],
)
def test_wrong_use_is_reported(args: tuple[str, ...], text: str) -> None:
    name, *options = args
    ended = run(name, "bvs://127.0.0.1", *options)
    assert ended.code == 2
    assert text in ended.err


def test_camera_that_refuses_the_login_ends_it() -> None:
    with Process("smartcam-emulator", "--protocol", "insight") as emulator:
        address = emulator.read_until(b"\n").strip().replace("//", "//admin:wrong@")
        ended = run("live", address)
    assert ended.code == 3
    assert "password is wrong" in ended.err
