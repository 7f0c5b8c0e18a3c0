"""Test that cameras of the makes are found, probed and examined like every camera."""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any

import pytest

import smartcam
from smartcam.doctor import examine
from smartcam.emulator import LineCamera
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr
from tests.cli.commandline import run
from tests.processes import Process

MAKES: dict[str, tuple[Callable[[], LineCamera], str]] = {
    "pcic": (EmulatedIfm, "v3"),
    "iv3": (EmulatedIv3, "lines"),
    "sr": (EmulatedSr, "lines"),
}


@pytest.mark.parametrize("name", MAKES)
@pytest.mark.asyncio
async def test_search_finds_a_silent_device_and_asks_it_harmlessly(name: str) -> None:
    make, dialect = MAKES[name]
    async with make() as emulator:
        options: dict[str, Any] = {"ports": [emulator.port], "protocols": [name]}
        (silent,) = await smartcam.find("127.0.0.1", **options)
        assert (silent.evidence, silent.urls) == ("silent", (emulator.url,))
        (asked,) = await smartcam.find("127.0.0.1", ask=True, **options)
        assert asked.urls == (f"{emulator.url}?dialect={dialect}",)
        assert not any("Trigger" in str(one.message) for one in emulator.log)


@pytest.mark.parametrize("name", MAKES)
@pytest.mark.asyncio
async def test_doctor_finds_nothing_wrong(name: str) -> None:
    async with MAKES[name][0]() as emulator:
        found = [one async for one in examine(emulator.url, trigger=True, count=3, seconds=0.1)]
    assert not [one for one in found if one.severity in {"error", "warning"}], found
    assert any("trigger" in one.check for one in found)
    assert "serves several clients" in found[0].text


@pytest.mark.parametrize("name", MAKES)
@pytest.mark.real_time
def test_emulated_camera_has_a_page_without_a_word_more(name: str) -> None:
    with Process("smartcam-emulator", "--protocol", name, "--web") as emulator:
        assert emulator.read_until(b"\n").startswith(f"{name}://127.0.0.1:")
        emulator.send_signal(signal.SIGTERM)
        code, _, said = emulator.wait()
    assert (code, said.partition("//")[0]) == (0, "page: http:")


@pytest.mark.parametrize(("version", "dialect"), [(1, "v1"), (2, "v2"), (3, "v3"), (4, "v4")])
@pytest.mark.asyncio
async def test_version_of_the_device_is_found_out(version: int, dialect: str) -> None:
    async with EmulatedIfm(version=version) as emulator, smartcam.connect(emulator.url) as camera:
        assert camera.url.endswith(f"?dialect={dialect}")
        assert (await camera.trigger()).value == b"star;12.5000;-3.0000;0.9700;stop"


def test_commands_know_the_makes() -> None:
    out = run("protocols").done().out
    assert all(f"{name}://" in out for name in MAKES)
