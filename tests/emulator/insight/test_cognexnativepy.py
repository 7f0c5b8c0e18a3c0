"""The published client CognexNativePy against the emulated In-Sight camera.

It uses blocking sockets, so the emulator runs in a thread of its own. Not called are the methods
for commands that the emulator does not have (file transfer, settings, RT, SM, SR, SL, GL, DF, DJ,
TF, TJ).

Two of the client's ways need a quirk: it awaits a length and a text in the answer to ``SE``, and it
loses lines of an image that come in the same read as the size. So the camera pauses behind the size
until the client has read it: the clock stands still until then.
"""

from __future__ import annotations

import asyncio
import struct
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from smartcam.emulator import EmulatedInSight, ManualClock

if sys.version_info < (3, 12):
    pytest.skip("needs Python 3.12 for CognexNativePy", allow_module_level=True)
CognexNativePy = pytest.importorskip(
    "CognexNativePy", reason="needs CognexNativePy, of the extra test"
)
utils = pytest.importorskip("CognexNativePy.utils")
CommandError: type[Exception] = pytest.importorskip(
    "CognexNativePy.CognexCommandError"
).CognexCommandError

TIMEOUT = 60.0
HEIGHT, WIDTH = 12, 16  # a bitmap so small that its digits come in one read of the client
IMAGE = np.arange(HEIGHT * WIDTH, dtype=np.uint8).reshape(HEIGHT, WIDTH)

JOBS: list[dict[str, Any]] = [
    {
        "file": "7bolts.job",
        "load_time": 0,
        "acquisition_time": 0,
        "processing_time": 0,
        "cells": {
            "A1": [1, 2.5],
            "B2": {"kind": "int", "value": 3, "high": 10},
            "C3": {"kind": "float", "value": 0.5},
            "D4": {"kind": "string", "value": "Before SS"},
            "Counter": {"kind": "int", "value": 1},
            "Scale": {"kind": "float", "value": 1},
        },
    },
    {"file": "nuts.job", "load_time": 0},
]


class Camera:
    """An emulated camera in a thread of its own."""

    def __init__(self) -> None:
        self.clock = ManualClock()
        self.emulator = EmulatedInSight(
            JOBS,
            users={"admin": "", "op": "secret"},
            image=IMAGE,
            quirks={"event_answer": "sized", "transfer_pause": 1.0},
            clock=self.clock,
        )
        self._started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()))
        self._thread.start()
        assert self._started.wait(TIMEOUT)

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._end = asyncio.Event()
        async with self.emulator:
            self._started.set()
            await self._end.wait()

    def do(self, action: Callable[[], object]) -> None:
        """Call an operator's method in the emulator's thread, and wait for its end."""
        done = threading.Event()
        self._loop.call_soon_threadsafe(lambda: (action(), done.set()))
        assert done.wait(TIMEOUT)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(TIMEOUT)


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> Iterator[Camera]:
    camera = Camera()
    monkeypatch.setattr(utils, "PORT", camera.emulator.port)
    monkeypatch.setattr(utils, "_RECEIVE_TIMEOUT_SECONDS", TIMEOUT)
    yield camera
    camera.close()


@pytest.fixture
def client(camera: Camera) -> Iterator[Any]:
    client = CognexNativePy.NativeInterface("127.0.0.1", "admin", "")
    yield client
    client.close()


def test_cognexnativepy_logs_in_with_a_password(camera: Camera) -> None:
    client = CognexNativePy.NativeInterface("127.0.0.1", "op", "secret")
    assert len(camera.emulator.sessions) == 1
    client.close()


def test_cognexnativepy_sees_a_refused_login(camera: Camera) -> None:
    with pytest.raises(CommandError, match='expected "User Logged In"'):
        CognexNativePy.NativeInterface("127.0.0.1", "op", "wrong")
    assert camera.emulator.sessions == []


def test_cognexnativepy_goes_online_and_offline(camera: Camera, client: Any) -> None:
    execution = client.execution_and_online
    assert execution.get_online() == 0
    execution.set_online(1)
    assert execution.get_online() == 1
    execution.set_online(0)
    camera.do(lambda: camera.emulator.set_online(False))
    with pytest.raises(CommandError, match="the sensor did not go Online"):
        execution.set_online(1)


def test_cognexnativepy_triggers_and_reads_values(client: Any) -> None:
    execution, cells = client.execution_and_online, client.settings_and_cells_values
    assert cells.get_value("A", 1) == "#ERR"
    execution.set_online(1)
    execution.set_event_and_wait(8)
    assert cells.get_value("A", 1) == "1.000"
    assert execution.set_event(8) == ("1", "")
    assert cells.get_value("A", 1) == "2.500"
    execution.set_event_and_wait(0)


def test_cognexnativepy_is_told_that_the_camera_is_offline(client: Any) -> None:
    with pytest.raises(CommandError, match="the sensor is Offline"):
        client.execution_and_online.set_event_and_wait(8)
    with pytest.raises(CommandError, match="The command could not be executed"):
        client.execution_and_online.set_event(8)


def test_cognexnativepy_loads_jobs(client: Any) -> None:
    jobs = client.file_and_job
    assert (jobs.get_file(), jobs.get_job()) == ("7bolts.job", 7)
    jobs.load_file("nuts.job")
    assert jobs.get_file() == "nuts.job"
    with pytest.raises(CommandError, match="does not have a numerical prefix"):
        jobs.get_job()
    jobs.set_job(7)
    assert jobs.get_job() == 7


def test_cognexnativepy_is_refused_a_job(client: Any) -> None:
    jobs = client.file_and_job
    with pytest.raises(CommandError, match="the file was not found"):
        jobs.set_job(8)
    client.execution_and_online.set_online(1)
    with pytest.raises(CommandError, match="the vision system is Online"):
        jobs.load_file("nuts.job")


def test_cognexnativepy_sets_cells_and_names(client: Any) -> None:
    cells = client.settings_and_cells_values
    cells.set_integer_value("B", 2, 8)
    cells.set_float_value("C", 3, 2.25)
    cells.set_string("D", 4, "After SS")
    cells.set_integer_value("Counter", 5)
    cells.set_float_value("Scale", 0.25)
    got = [cells.get_value(column, row) for column, row in [("B", 2), ("C", 3), ("D", 4)]]
    assert got == ["8.000", "2.250", "After SS"]
    assert [cells.get_value("Counter"), cells.get_value("Scale")] == ["5.000", "0.250"]


def test_cognexnativepy_is_refused_a_value(client: Any) -> None:
    cells = client.settings_and_cells_values
    with pytest.raises(CommandError, match="outside of the control's valid range"):
        cells.set_integer_value("B", 2, 11)
    with pytest.raises(CommandError, match="The cell ID or symbolic tag is invalid"):
        cells.get_value("Nobody")
    with pytest.raises(CommandError, match="The command could not be executed"):
        cells.get_value("Z", 399)


def test_cognexnativepy_gets_info(client: Any) -> None:
    info = client.settings_and_cells_values.get_info()
    assert info["Serial Number"] == "100000001"
    assert len(info) == 5


@pytest.mark.parametrize("method", ["read_image", "read_bmp"])
def test_cognexnativepy_reads_an_image_with_its_checksum(
    camera: Camera, client: Any, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = utils.receive_data

    def read_and_let_time_pass(connection: Any) -> Any:
        lines = read(connection)
        camera.do(lambda: camera.clock.advance(1.0))
        return lines

    monkeypatch.setattr(utils, "receive_data", read_and_let_time_pass)
    image = getattr(client.image, method)()
    data = image["data"]
    assert image["size"] == 2 * len(data)
    assert image["checksum"] == utils.calculate_checksum(data)
    (offset,) = struct.unpack_from("<I", data, 10)
    assert data[:2] == b"BM"
    assert struct.unpack_from("<ii", data, 18) == (WIDTH, HEIGHT)
    assert data[offset:] == IMAGE[::-1].tobytes()


def test_cognexnativepy_is_told_a_code_that_was_ordered(camera: Camera, client: Any) -> None:
    camera.do(lambda: camera.emulator.answer_next(-6, command="SO"))
    with pytest.raises(CommandError, match="User does not have Full Access"):
        client.execution_and_online.set_online(1)
