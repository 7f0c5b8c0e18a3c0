"""``docs/control.md`` and ``docs/calibrating.md``: tables of calls, numbers, ``curl`` lines."""

from __future__ import annotations

import asyncio
import json
import re
import shlex
import shutil
import subprocess
from typing import TYPE_CHECKING, get_args

import pytest

from smartcam._meanings import FAIL_WORDS, NOT_WORDS, PASS_WORDS
from smartcam.emulator import EmulatedCamera
from smartcam.web import EmulatorSite
from tests import ROOT
from tests.web.inside import (
    ALIVE_INTERVAL,
    BAR_DURATION,
    BAR_SECONDS,
    ERROR_MARK_SECONDS,
    LINGER,
    MAX_BARS,
    MAX_CAMERAS,
    MAX_NEWS,
    MAX_PICTURES,
    MAX_QUEUE,
    MAX_RESULTS,
    MAX_ROWS,
    PERIOD,
    SERIES_DURATION,
    SORTS,
    Filter,
)
from tests.web.inside import FLEET_MAX_VIEWERS as MAX_FLEET_VIEWERS
from tests.web.inside import PICTURES_MAX_VIEWERS as MAX_VIEWERS
from tests.web.inside import _emulator as emulator
from tests.web.inside import _routes as routes
from tests.web.inside import _serialize as serialize
from tests.web.inside import _streams as streams
from tests.web.sitekit import TOKEN

if TYPE_CHECKING:
    from collections.abc import Sequence

PAGE = (ROOT / "docs" / "control.md").read_text(encoding="utf-8")
FLEET_PAGE = (ROOT / "docs" / "fleet-page.md").read_text(encoding="utf-8")
LIVE_PAGE = (ROOT / "docs" / "live.md").read_text(encoding="utf-8")
FRAMES_PAGE = (ROOT / "docs" / "frames.md").read_text(encoding="utf-8")
CURL = [
    line
    for block in re.findall(r"^```sh\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
    if line.startswith("curl ")
]


def test_live_page_has_its_numbers() -> None:
    assert f"The last {MAX_RESULTS}." in LIVE_PAGE
    assert MAX_BARS * BAR_SECONDS == 10 * 3600  # "Last ten hours"
    assert f"pictures of the last {MAX_PICTURES} failures" in LIVE_PAGE
    assert f"more than {MAX_NEWS / streams.PERIOD:g} come per second" in LIVE_PAGE
    words = PASS_WORDS | FAIL_WORDS
    named = set(
        re.findall(r"`(\w+)`", LIVE_PAGE.partition("## Pass and fail")[2].partition("##")[0])
    )
    assert {one.removesuffix("ed") for one in words} | NOT_WORDS == named


def test_fleet_page_has_its_numbers() -> None:
    assert (PERIOD, SERIES_DURATION, BAR_DURATION, ALIVE_INTERVAL) == (
        0.2,
        600,
        5,
        5.0,
    )  # which it has as words
    said = {
        f"in the last {ERROR_MARK_SECONDS:g} s lost",
        f"at most {MAX_ROWS} rows",
        f"accepts no update for {streams.READER_TIMEOUT:g} s",
        f"At most {MAX_FLEET_VIEWERS} browsers",
        f"at most {MAX_CAMERAS} cameras",
        f"and {LINGER:g} s longer",
        f"two updates, at most {MAX_QUEUE} are shown",
        "`filter` is " + _listed(get_args(Filter)),
        "`sort` is " + _listed(["name", *SORTS]),
    }
    assert [text for text in said if text not in FLEET_PAGE] == []


def _listed(words: Sequence[str]) -> str:
    *first, last = [f"`{word}`" for word in words]
    return f"{', '.join(first)} or {last}"


def test_frames_page_has_its_numbers() -> None:
    assert f"At most {MAX_VIEWERS} WebSockets are open" in FRAMES_PAGE
    assert f"takes no picture for {streams.READER_TIMEOUT:g} s" in FRAMES_PAGE


def test_bounds_are_those_of_the_code() -> None:
    said = {
        f"did not come within {routes.READ_TIMEOUT:g} s",
        f"more than {routes.MAX_BODY_BYTES >> 10} KiB",
        f"{streams.MAX_STREAMS} event streams",
        f"nothing for {streams.READER_TIMEOUT:g} s",
        f"at most {serialize.MAX_HEX_BYTES} bytes of a payload, "
        f"and results longer than {serialize.MAX_VALUES_BYTES} bytes undecoded",
    }
    assert [text for text in said if text not in PAGE] == []
    assert emulator.MAX_ENTRIES >= 100  # the example's limit


def curl_lacks() -> str:
    """Return why the examples cannot run here, nothing where they can."""
    curl = shutil.which("curl")
    if curl is None:
        return "no curl on the path"
    done = subprocess.run([curl, "--help", "all"], capture_output=True, check=False)  # noqa: S603
    return "" if b" --json " in done.stdout else "this curl is older than 7.82: it has no --json"


@pytest.mark.long
@pytest.mark.skipif(bool(curl_lacks()), reason=curl_lacks())
@pytest.mark.real_time
async def test_curl_lines_are_answered() -> None:
    assert len(CURL) > 20
    lacking: list[str] = []
    async with (
        EmulatedCamera() as camera,
        EmulatorSite({"camera": camera}) as site,
        EmulatorSite({"camera": camera}, token=TOKEN) as closed,
    ):
        for line in CURL:
            token = "Authorization" in line
            words = shlex.split(line.replace("just-for-this-test-bench", TOKEN))
            api = (closed if token else site).origin
            words = [word.replace("http://localhost:8080", api) for word in words]
            stream = "-N" in words
            words[1:1] = ["-sS", "--fail-with-body", "--max-time", "60"]
            done = await asyncio.create_subprocess_exec(
                *words, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
            )
            if stream:
                assert done.stdout is not None
                assert await done.stdout.readline() == b"event: camera\n"
                done.terminate()
            out, err = await done.communicate()
            told = stream or not done.returncode
            if not told:
                lacking.append(f"{line}: {out.decode()} {err.decode()}")
            if not stream:
                json.loads(out)
    assert lacking == []
