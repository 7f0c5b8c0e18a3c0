"""Recordings of cameras of lines, replayed for real clients."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

import smartcam
from smartcam.emulator import EmulatedInSight, Scenario
from smartcam.exceptions import ConfigurationError, ConnectionLostError, TriggerTimeoutError
from smartcam.recording import Recorder, load_recording, replay

if TYPE_CHECKING:
    from pathlib import Path

    from smartcam.recording import Recording

PLAN = Scenario(protocol="insight", active=7, running=True)
CELLS = "?cells=A1"
ONE, TWO, THREE = (b'{"A001": "%d.000"}' % number for number in (1, 2, 3))
USERS = {"admin": "geheim17"}


async def recorded(path: Path, triggers: int = 3, users: dict[str, str] | None = None) -> Recording:
    """Record triggers of a counting job."""
    plan = PLAN.model_copy(update={"options": {"users": users} if users else {}})
    async with EmulatedInSight.from_scenario(plan) as emulator:
        url = emulator.url.replace("://", "://admin:geheim17@") if users else emulator.url
        with Recorder(path) as made:
            camera = smartcam.connect(url + CELLS, name="left", observers=[made])
            async with camera:
                for _ in range(triggers):
                    await camera.trigger()
    return load_recording(path)


async def test_replayed_in_sight_gives_the_recorded_bytes_in_their_order(tmp_path: Path) -> None:
    run = await recorded(tmp_path / "run.mcap")
    over = asyncio.Event()
    async with (
        replay(run, on_over=over.set) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        values = [(await camera.trigger()).raw for _ in range(3)]
        assert values == [ONE, TWO, THREE]
        await over.wait()
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=0.2)


async def test_replayed_in_sight_with_loop_begins_again(tmp_path: Path) -> None:
    run = await recorded(tmp_path / "run.mcap", triggers=2)
    async with (
        replay(run, loop=True) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        values = [(await camera.trigger()).raw for _ in range(4)]
    assert values == [ONE, TWO, ONE, TWO]


async def test_replayed_in_sight_takes_any_password_as_none_was_recorded(tmp_path: Path) -> None:
    run = await recorded(tmp_path / "run.mcap", triggers=1, users=USERS)
    async with replay(run) as emulator:
        url = emulator.url.replace("://", "://admin:other@")
        async with smartcam.connect(url) as camera:
            assert (await camera.trigger()).raw == ONE


async def test_line_that_was_never_said_ends_the_connection(tmp_path: Path) -> None:
    run = await recorded(tmp_path / "run.mcap", triggers=1)
    async with (
        replay(run) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        with pytest.raises(ConnectionLostError):
            await camera.read_image()


async def test_option_that_a_replayed_camera_has_not_is_refused(tmp_path: Path) -> None:
    run = await recorded(tmp_path / "run.mcap", triggers=1)
    with pytest.raises(ConfigurationError, match="transport"):
        replay(run, transport="udp")
