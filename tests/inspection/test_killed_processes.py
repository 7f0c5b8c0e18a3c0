"""Kill the process of a software camera, its agent or its source during use."""

from __future__ import annotations

import asyncio
import contextlib
import math
import signal
import sys
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam import Status
from smartcam.backoff import Backoff
from smartcam.exceptions import (
    CameraFaultError,
    ConnectionLostError,
    FrameSourceError,
    TriggerTimeoutError,
)
from smartcam.inspection import SoftwareCamera
from smartcam.models import Disconnected, Reconnected
from tests.processes import PATIENCE, Process, free_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine
    from pathlib import Path

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX"),
]

CELL = """
cameras:
  line1/cam1:
    software:
      frames: "{frames}"
      applications:
        5: {{name: there, present: {{grey: [0, 255]}}}}
        30: {{name: free, rate: 20, sequence: true, present: {{grey: [0, 255]}}}}
"""
LAYOUT = (
    "ok: bool, reason: string[80], count: uint16, x: real32, y: real32, angle: real32, area: uint32"
)
SLOW = "synthetic://?size=320x240&fps=1"
QUICK = "synthetic://?size=320x240&fps=50"
SOON = Backoff(initial=0.05, maximum=0.2)


def cell_of(folder: Path, frames: str, more: str = "") -> Path:
    path = folder / "cell.yaml"
    path.write_text(more + CELL.format(frames=frames), encoding="utf-8")
    return path


@contextlib.asynccontextmanager
async def running(*command: str) -> AsyncIterator[Process]:
    """Start a command, and wait for a line of its output."""
    with await asyncio.to_thread(Process, *command) as process:
        await asyncio.to_thread(process.read_until, b"\n")
        yield process


async def killed(process: Process) -> None:
    process.send_signal(signal.SIGKILL)
    outcome = await asyncio.to_thread(process.wait)
    assert outcome.code in {-signal.SIGKILL, 128 + signal.SIGKILL}


async def under_way(camera: smartcam.Camera[Any]) -> asyncio.Task[Any]:
    """Return a trigger that waits for its picture."""
    trigger = asyncio.create_task(camera.trigger(timeout=PATIENCE))
    await camera.wait_status(
        lambda status: not status & Status.WAITING_FOR_TRIGGER, timeout=PATIENCE
    )
    return trigger


async def refused(error: type[Exception], *calls: Callable[[], Coroutine[Any, Any, Any]]) -> None:
    """Check that each call ends at once with an error."""
    for call in calls:
        async with asyncio.timeout(PATIENCE):
            with pytest.raises(error):
                await call()


@pytest.mark.parametrize("transport", ["tcp", pytest.param("udp", marks=pytest.mark.long)])
async def test_a_killed_camera_ends_its_trigger_and_is_found_again(
    tmp_path: Path, transport: str
) -> None:
    path, port = cell_of(tmp_path, SLOW), str(free_port())
    options = ("--program", str(path), "--port", port, "--transport", transport)
    command = ("smartcam-emulator", *options)
    async with contextlib.AsyncExitStack() as stack:
        process = await stack.enter_async_context(running(*command))
        url = process.read_until(b"\n").split()[0]
        camera = await stack.enter_async_context(
            smartcam.connect(url, interpret_as=LAYOUT, reconnect=SOON, connect_timeout=PATIENCE)
        )
        events = camera.events()
        assert (await camera.trigger(timeout=PATIENCE)).value.ok
        trigger = await under_way(camera)
        await killed(process)
        with pytest.raises(ConnectionLostError):
            await trigger
        await refused(
            ConnectionLostError,
            camera.trigger,
            lambda: camera.switch_application(30),
            lambda: camera.wait_status(lambda _: False, timeout=PATIENCE),
        )
        await stack.enter_async_context(running(*command))
        await camera.wait_connected(timeout=PATIENCE)
        result = await camera.trigger(timeout=PATIENCE)
        assert result.value.ok
        assert (result.number, camera.statistics().sessions) == (2, 2)
        kinds = [type(await anext(events)) for _ in range(events.statistics().queued)]
        links = [one for one in kinds if one in (Disconnected, Reconnected)]
        assert links == [Disconnected, Reconnected]


async def test_a_killed_agent_ends_triggers_and_frames_and_is_found_again(tmp_path: Path) -> None:
    place = f"listen: tcp/127.0.0.1:{free_port()}\n"
    path = cell_of(tmp_path, SLOW, place)
    command = ("smartcam", "serve", str(path))
    async with contextlib.AsyncExitStack() as stack:
        process = await stack.enter_async_context(running(*command))
        url = process.read_until(b"\n").split()[0]
        camera = await stack.enter_async_context(smartcam.connect(url, connect_timeout=PATIENCE))
        assert (await camera.trigger(timeout=PATIENCE)).value.ok
        reader = await stack.enter_async_context(camera.frames())
        await anext(reader)  # the picture of that result
        trigger = await under_way(camera)
        await killed(process)
        with pytest.raises(ConnectionLostError, match="is gone, or the way to it"):
            await trigger
        await refused(FrameSourceError, lambda: anext(reader))
        await refused(ConnectionLostError, camera.trigger, camera.newest_frame)
        again = await stack.enter_async_context(running(*command))
        await camera.wait_connected(timeout=PATIENCE)
        result = await camera.trigger(timeout=PATIENCE)
        assert (result.value.ok, result.number) == (True, 1)
        frame = await camera.newest_frame(max_age=math.inf, timeout=PATIENCE)
        assert (frame.width, frame.height) == (320, 240)
        again.send_signal(signal.SIGSTOP)
        with pytest.raises(TriggerTimeoutError, match=r"the agent .* did not answer within"):
            await camera.trigger(timeout=0.5)
        again.send_signal(signal.SIGCONT)
        async with asyncio.timeout(PATIENCE):
            while True:
                with contextlib.suppress(ConnectionLostError, TriggerTimeoutError):
                    if (await camera.trigger(timeout=5)).value.ok:
                        break
                await camera.wait_connected()


async def test_a_killed_source_is_a_system_error_until_it_is_back(tmp_path: Path) -> None:
    pytest.importorskip("av")
    place = f"127.0.0.1:{free_port()}"
    command = ("smartcam", "frames", "serve", QUICK, "--rtsp", place)
    path = cell_of(tmp_path, f"rtsp://{place}/synthetic#delay=0.05&timeout=3")
    async with contextlib.AsyncExitStack() as stack:
        source = await stack.enter_async_context(running(*command))
        camera: SoftwareCamera[Any] = SoftwareCamera(
            f"software:{path}", {"connect_timeout": PATIENCE}
        )
        await stack.enter_async_context(camera)
        await camera.wait_status(lambda status: not status & Status.SYSTEM_ERROR, timeout=PATIENCE)
        assert (await camera.trigger(timeout=PATIENCE)).value.ok
        await killed(source)
        await camera.wait_status(
            lambda status: bool(status & Status.SYSTEM_ERROR), timeout=PATIENCE
        )
        assert camera.frame_trouble
        await refused(CameraFaultError, camera.trigger)
        assert (await camera.read_image()).startswith(b"\x89PNG")  # the last one that was judged
        await stack.enter_async_context(running(*command))
        await camera.wait_status(lambda status: not status & Status.SYSTEM_ERROR, timeout=PATIENCE)
        assert camera.frame_trouble == ""
        assert (await camera.trigger(timeout=PATIENCE)).value.ok
