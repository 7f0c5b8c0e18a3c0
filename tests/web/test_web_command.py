"""``smartcam-emulator --web``."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from typing import TYPE_CHECKING, Any

import pytest
from click.testing import CliRunner

from smartcam.cli.emulate import command

if TYPE_CHECKING:
    from collections.abc import Iterator

PROGRAM = [sys.executable, "-c", "from smartcam.cli import emulator_main; emulator_main()"]
PATIENCE = 60
TOKEN = "a-token_of-24-characters"  # noqa: S105 - of the tests


class Command:
    """A running ``smartcam-emulator``."""

    def __init__(self, *options: str, **environment: str) -> None:
        self.process = subprocess.Popen(  # noqa: S603 - our own interpreter
            [*PROGRAM, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **environment},
        )

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def page(self) -> str:
        """Return the page's address."""
        assert self.process.stderr is not None
        match = re.fullmatch(r"page: (http://\S+)\n", self.process.stderr.readline())
        assert match is not None
        return match[1]

    def end(self) -> tuple[int, str, str]:
        self.process.send_signal(signal.SIGINT)
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err


@pytest.fixture
def start() -> Iterator[Any]:
    running: list[Command] = []

    def started(*options: str, **environment: str) -> Command:
        running.append(Command(*options, **environment))
        return running[-1]

    yield started
    for one in running:
        one.process.kill()
        one.process.communicate()


def get(url: str, token: str | None = None) -> Any:
    headers = {} if token is None else {"Authorization": f"Bearer {token}"}
    request = urllib.request.Request(url, headers=headers)  # noqa: S310 - http
    with urllib.request.urlopen(request, timeout=PATIENCE) as answer:  # noqa: S310 - http
        return json.load(answer)


def refused(*options: str) -> str:
    done = CliRunner().invoke(command, options)
    assert done.exit_code == 2
    return done.output.splitlines()[-1]


def test_web_shows_all_cameras_and_ends_with_a_stream_open(start: Any) -> None:
    emulator = start("--web", "--cameras", "2")
    page = emulator.page()
    urls = [emulator.line() for _ in range(2)]
    cameras = get(f"{page}api/cameras")["cameras"]
    assert [(one["name"], one["url"]) for one in cameras] == [
        ("camera1", urls[0]),
        ("camera2", urls[1]),
    ]
    with urllib.request.urlopen(f"{page}api/cameras/camera2/events") as stream:  # noqa: S310
        assert stream.readline() == b"event: camera\n"
        assert emulator.end() == (0, "", "")


def test_web_json_has_name_and_page_of_a_camera_and_the_token_is_that_of_the_environment(
    start: Any,
) -> None:
    emulator = start("--web", "--json", SMARTCAM_WEB_TOKEN=TOKEN)
    camera = json.loads(emulator.line())
    page, _, fragment = camera["web"].partition("#")
    assert (camera["name"], fragment) == ("camera", f"token={TOKEN}")
    assert emulator.page() == camera["web"]
    assert get(f"{page}api/cameras/camera", TOKEN)["url"] == camera["url"]
    with pytest.raises(urllib.error.HTTPError, match="401"):
        get(f"{page}api/cameras")
    assert emulator.end() == (0, "", "")


def test_web_that_cannot_be_is_refused_in_one_line() -> None:
    assert refused("--web-port", "8080") == "Error: --web-port needs --web"
    assert refused("--web", "--protocol", "insight") == "Error: --protocol insight takes no --web"
    assert refused("--web", "--web-token", "short").startswith(
        "smartcam-emulator: error: web: a token has 16 letters"
    )
    assert refused("--web", "--web-host", "no host").startswith(
        "smartcam-emulator: error: web: cannot listen on http://no host:0: "
    )
