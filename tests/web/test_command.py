"""``smartcam-emulator --web``."""

from __future__ import annotations

import json
import re
import signal
import urllib.error
import urllib.request
from typing import Any

import pytest

from tests.cli.commandline import run_emulator
from tests.processes import PATIENCE, Process

TOKEN = "a-token_of-24-characters"  # noqa: S105 - of the tests


def page_of(emulator: Process) -> str:
    """Return the page's address."""
    match = re.fullmatch(r"page: (http://\S+)\n", emulator.read_until(b"\n", stream="stderr"))
    assert match is not None
    return match[1]


def get(url: str, token: str | None = None) -> Any:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    request = urllib.request.Request(url, headers=headers)  # noqa: S310 - http
    with urllib.request.urlopen(request, timeout=PATIENCE) as answer:  # noqa: S310 - http
        return json.load(answer)


def refused(*options: str) -> str:
    done = run_emulator(*options)
    assert done.code == 2
    return done.err.splitlines()[-1]


@pytest.mark.long
def test_web_shows_all_cameras_and_ends_with_a_stream_open() -> None:
    with Process("smartcam-emulator", "--web", "--cameras", "2", fresh=True) as emulator:
        page = page_of(emulator)
        urls = emulator.read_until(b"\n", count=2).splitlines()
        cameras = get(f"{page}api/cameras")["cameras"]
        assert [(one["name"], one["url"]) for one in cameras] == [
            ("camera1", urls[0]),
            ("camera2", urls[1]),
        ]
        with urllib.request.urlopen(f"{page}api/cameras/camera2/events") as stream:  # noqa: S310
            assert stream.readline() == b"event: camera\n"
            emulator.send_signal(signal.SIGINT)
            ended = emulator.wait()
    assert (ended.code, ended.err) == (0, f"page: {page}\n")


def test_web_json_has_name_and_page_of_a_camera_and_the_token_is_that_of_the_environment() -> None:
    env = {"SMARTCAM_WEB_TOKEN": TOKEN}
    with Process("smartcam-emulator", "--web", "--json", env=env, fresh=True) as emulator:
        camera = json.loads(emulator.read_until(b"\n"))
        page, _, fragment = camera["web"].partition("#")
        assert (camera["name"], fragment) == ("camera", f"token={TOKEN}")
        assert page_of(emulator) == camera["web"]
        assert get(f"{page}api/cameras/camera", TOKEN)["url"] == camera["url"]
        with pytest.raises(urllib.error.HTTPError, match="401") as refused:
            get(f"{page}api/cameras")
        refused.value.close()
        emulator.send_signal(signal.SIGINT)
        assert emulator.wait().code == 0


def test_web_shows_a_camera_of_another_make() -> None:
    options = ("--web", "--protocol", "insight")
    with Process("smartcam-emulator", *options, fresh=True) as emulator:
        page, url = page_of(emulator), emulator.read_until(b"\n").strip()
        (camera,) = get(f"{page}api/cameras")["cameras"]
        assert (camera["url"], camera["mode"]) == (url, "running")


def test_web_that_cannot_be_is_refused_in_one_line() -> None:
    assert refused("--web-port", "8080") == "Error: --web-port needs --web"
    assert refused("--web", "--web-token", "short").startswith(
        "smartcam-emulator: error: web: a token has 16 letters"
    )
    assert refused("--web", "--web-host", "no host").startswith(
        "smartcam-emulator: error: web: cannot listen on http://no host:0: "
    )
