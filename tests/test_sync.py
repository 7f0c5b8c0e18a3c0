"""Cameras without asyncio."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import inspect
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, assert_type

import pytest

import smartcam.sync
from scripts import write_sync
from smartcam import (
    Camera,
    CameraEvent,
    CommandRejectedError,
    ConfigurationError,
    Connected,
    ConnectionClosedError,
    ConnectionLostError,
    InterpretationError,
    Localization,
    LocalProtocolError,
    ResponseTimeoutError,
    Result,
    Status,
    TriggerTimeoutError,
)
from smartcam.connecting import connect
from smartcam.emulator.faults import Drop
from smartcam.sync import SyncCamera, SyncSubscription
from smartcam.testing import ThreadedCamera

pytestmark = pytest.mark.real_time

QUERY = 0x30
PATIENCE = 60.0
"""Seconds; only what has gone wrong takes as long."""


@pytest.fixture
def emulator() -> Iterator[ThreadedCamera]:
    with ThreadedCamera(active=21, running=True) as emulator:
        yield emulator


@pytest.fixture
def camera(emulator: ThreadedCamera) -> Iterator[SyncCamera[Any]]:
    with smartcam.sync.connect(emulator.url, interpret_as="text: string[20]") as camera:
        yield camera


# ---------------------------------------------------------------------- the same face


def faces(kind: type) -> dict[str, Any]:
    """Return what a class and those that it extends have for their users, by name."""
    return {
        name: value
        for one in reversed(kind.mro())
        for name, value in vars(one).items()
        if not name.startswith("_")
    }


def test_module_is_what_the_script_writes() -> None:
    found = write_sync.WRITTEN.read_text(encoding="utf-8")
    assert found == write_sync.written(), "python -m scripts.write_sync writes it anew"


def test_camera_has_everything_that_the_async_one_has() -> None:
    assert faces(SyncCamera).keys() == faces(Camera).keys() | {"settings"}


@pytest.mark.parametrize("name", [*faces(Camera)])
def test_method_takes_what_the_async_one_takes(name: str) -> None:
    theirs, ours = faces(Camera)[name], faces(SyncCamera)[name]
    assert isinstance(ours, property) == isinstance(theirs, property)
    if isinstance(theirs, property):
        theirs, ours = theirs.fget, ours.fget
    assert not inspect.iscoroutinefunction(ours)
    wanted, found = inspect.signature(theirs), inspect.signature(ours)
    assert [*found.parameters] == [*wanted.parameters]
    for parameter, other in zip(found.parameters.values(), wanted.parameters.values(), strict=True):
        assert (parameter.kind, parameter.default) == (other.kind, other.default)
        assert parameter.annotation == other.annotation
    assert ours.__doc__


def test_connect_takes_what_the_async_one_takes() -> None:
    wanted, found = inspect.signature(connect), inspect.signature(smartcam.sync.connect)
    assert [*found.parameters.values()] == [*wanted.parameters.values()]


def test_values_have_their_types(emulator: ThreadedCamera) -> None:
    with smartcam.sync.connect(emulator.url, interpret_as="localizations") as camera:
        assert_type(camera, SyncCamera[list[Localization]])
        assert_type(camera.results(), SyncSubscription[Result[list[Localization]]])
        assert_type(camera.results(batch=True), SyncSubscription[list[Result[list[Localization]]]])
        result = camera.trigger(7)
        assert_type(result, Result[list[Localization]])
        assert len(result.value) == 7


# ---------------------------------------------------------------------- what it does


def test_camera_does_what_it_is_told(emulator: ThreadedCamera, camera: SyncCamera[Any]) -> None:
    assert camera.trigger().value.text == "Hello World"
    assert [one.value.text for one in camera.trigger(results_per_trigger=1)] == ["Hello World"]
    assert (camera.connected, camera.url, camera.name) == (
        True,
        emulator.url,
        f"{emulator.host}:{emulator.port}",
    )
    assert camera.query_application() == camera.active_application == 21
    with camera.application(1) as same:
        assert same is camera
        assert camera.active_application == 1
    assert camera.query_application() == 21
    camera.stop()
    assert Status.RUNNING not in camera.status
    camera.start()
    assert Status.RUNNING in camera.wait_ready()
    assert Status.RUNNING in camera.wait_status(lambda status: bool(status))
    camera.switch_application(7)
    assert camera.active_application == 7
    camera.set_input(b"1234")
    camera.set_sequence_number(7)
    assert camera.get_clock().year > 1900
    camera.set_clock(camera.get_clock())
    assert camera.request(QUERY) is not None
    assert camera.statistics().triggered == 2
    assert repr(camera) == f"<SyncCamera {camera.name} {camera.url}>"
    assert camera.capabilities.dialect == emulator.dialect
    assert camera.protocol_version is not None
    assert camera.settings.name == camera.name


def test_outcomes_are_the_same(emulator: ThreadedCamera, camera: SyncCamera[Any]) -> None:
    emulator.inject(Drop(on="ResultContainer"))
    with pytest.raises(TriggerTimeoutError, match="no result within"):
        camera.trigger(timeout=0.3)
    with pytest.raises(InterpretationError):
        camera.trigger(interpret_as="n: int64, m: int64, o: int64")
    with pytest.raises(CommandRejectedError), camera.application(5):
        pass
    with pytest.raises(ConfigurationError, match="when_busy"):
        camera.trigger(when_busy="no")  # type: ignore[call-overload]
    with pytest.raises(ZeroDivisionError), camera.application(1):
        _ = 1 / 0
    assert camera.trigger().application == 21  # it waits until the one before is back
    assert camera.statistics().received == 2


def test_streams_come_in_order_and_balance(camera: SyncCamera[Any]) -> None:
    with camera.results() as stream, camera.results(batch=True) as batches:
        numbers = [camera.trigger().number for _ in range(4)]
        assert stream.get(PATIENCE).number == numbers[0]
        for wanted, result in zip(numbers[1:], stream, strict=False):
            assert result.number == wanted
        assert [one.number for one in next(batches)] == numbers
        account = stream.statistics()
        assert (account.offered, account.taken, account.queued) == (4, 4, 0)
        with pytest.raises(ResponseTimeoutError, match=r"nothing came within 0.01 s"):
            stream.get(0.01)
        assert not stream.ended
    assert stream.ended
    assert [*stream] == []
    with pytest.raises(ConnectionClosedError, match="nothing more will come"):
        stream.get(0.01)


def test_events_and_statuses_are_seen(emulator: ThreadedCamera) -> None:
    camera = smartcam.sync.connect(emulator.url)
    events = camera.events()
    with camera:
        first: CameraEvent = events.get(PATIENCE)
        assert isinstance(first, Connected)
        statuses = camera.statuses()
        camera.stop()
        assert Status.RUNNING not in statuses.get(PATIENCE)
    assert events.ended
    camera.close()


def test_next_result_is_somebody_elses(emulator: ThreadedCamera, camera: SyncCamera[Any]) -> None:
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(camera.next_result, timeout=PATIENCE)
        while not waiting.done():  # nobody tells when it has begun to wait
            emulator.run(lambda one: one.device.trigger())
            time.sleep(0.05)
        assert waiting.result().triggered_at is None


def test_subscription_that_nobody_holds_is_gone(camera: SyncCamera[Any]) -> None:
    camera.results()
    gc.collect()
    assert camera.statistics().subscribers == []


@pytest.mark.long
def test_many_threads_share_a_camera(camera: SyncCamera[Any]) -> None:
    with ThreadPoolExecutor(8) as pool:
        results = [*pool.map(lambda _: camera.trigger(timeout=PATIENCE), range(40))]
    assert sorted(one.number for one in results) == [*range(1, 41)]
    names = [one.name for one in threading.enumerate()]
    assert names.count("smartcam.sync") == 1


def test_camera_closed_by_another_thread_ends_the_waits(emulator: ThreadedCamera) -> None:
    camera = smartcam.sync.connect(emulator.url).open()
    stream = camera.results()
    with ThreadPoolExecutor(2) as pool:
        waiting = pool.submit(camera.wait_status, lambda _: False, PATIENCE)
        listening = pool.submit(lambda: [*stream])
        camera.close()
        assert listening.result(PATIENCE) == []
        with contextlib.suppress(ConnectionClosedError, ConnectionLostError):
            waiting.result(PATIENCE)
    with pytest.raises(ConnectionClosedError):
        camera.trigger()


def test_camera_that_is_not_closed_warns_and_is_closed(emulator: ThreadedCamera) -> None:
    cameras = [smartcam.sync.connect(emulator.url).open()]
    with pytest.warns(ResourceWarning, match="was not closed"):
        cameras.clear()
    emulator.log.expect("Disconnect", timeout=PATIENCE)


# ---------------------------------------------------------------------- wrong doors


async def test_call_in_an_event_loop_names_the_async_form(emulator: ThreadedCamera) -> None:
    camera = smartcam.sync.connect(emulator.url)
    with pytest.raises(LocalProtocolError, match=r"async with smartcam.connect\(\"bvs://"):
        camera.open()
    with pytest.raises(LocalProtocolError, match="hold up the event loop"):
        next(camera.events())
    with pytest.raises(TypeError, match=r"async with smartcam\.connect"):
        async with camera:
            pass


def test_call_in_a_notebook_is_done(
    emulator: ThreadedCamera, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Kernel:
        @staticmethod
        def get_ipython() -> object:
            return "the shell"

    monkeypatch.setitem(sys.modules, "IPython", Kernel)

    async def cell() -> int:
        with smartcam.sync.connect(emulator.url) as camera:
            return camera.query_application()

    assert asyncio.run(cell()) == 21


def test_call_in_its_own_thread_is_refused(camera: SyncCamera[Any]) -> None:
    def predicate(_: Status) -> bool:
        return bool(camera.trigger())

    with pytest.raises(LocalProtocolError, match="called in its own thread"):
        camera.wait_status(predicate, PATIENCE)
    assert camera.trigger().value.text == "Hello World"


async def test_async_camera_in_a_plain_with_says_which_is_meant() -> None:
    wanted = r"async with .*smartcam\.sync\.connect"
    with pytest.raises(TypeError, match=wanted), smartcam.connect("bvs://127.0.0.1"):
        pass
    stream = smartcam.connect("bvs://127.0.0.1").results()
    with pytest.raises(TypeError, match=r"`async for`; without asyncio: smartcam\.sync"):
        iter(stream)


# ---------------------------------------------------------------------- processes


def python(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-W", "error", "-c", program, *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


INTERRUPTED = """
import os, signal, sys
import smartcam.sync
camera = smartcam.sync.connect(sys.argv[1]).open()
def predicate(status):
    os.kill(os.getpid(), signal.SIGINT)
    return False
try:
    camera.wait_status(predicate, 3600)
except KeyboardInterrupt:
    print("interrupted", camera.query_application())
camera.close()
"""


def test_ctrl_c_ends_a_wait_and_leaves_a_camera_that_works(emulator: ThreadedCamera) -> None:
    ended = python(INTERRUPTED, emulator.url)
    assert (ended.stdout, ended.stderr, ended.returncode) == ("interrupted 21\n", "", 0)


LEFT_OPEN = """
import sys
import smartcam.sync
camera = smartcam.sync.connect(sys.argv[1]).open()
print(camera.query_application())
"""


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost"], ids=["address", "name"])
def test_program_that_ends_closes_its_cameras(emulator: ThreadedCamera, host: str) -> None:
    # a name is looked up in a thread, which the loop has to end while no thread can be started
    ended = python(LEFT_OPEN, emulator.url.replace("127.0.0.1", host))
    assert (ended.stdout, ended.stderr, ended.returncode) == ("21\n", "", 0)
    emulator.log.expect("Disconnect", timeout=PATIENCE)


FORKED = """
import os, sys
import smartcam.sync
with smartcam.sync.connect(sys.argv[1]) as camera:
    child = os.fork()
    if child == 0:
        try:
            camera.trigger()
        except smartcam.LocalProtocolError as error:
            print(error, flush=True)
        with smartcam.sync.connect(sys.argv[2]) as own:
            print(own.query_application(), flush=True)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    print(camera.query_application())
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs a system with fork")
def test_fork_says_that_it_cannot_and_has_cameras_of_its_own(emulator: ThreadedCamera) -> None:
    with ThreadedCamera(active=7, running=True) as other:
        ended = python(FORKED.replace("-W error", ""), emulator.url, other.url)
    assert "a fork has no threads; make it in this process" in ended.stdout
    assert ended.stdout.splitlines()[1:] == ["7", "21"]


def test_signal_that_kills_leaves_nothing_waiting(emulator: ThreadedCamera) -> None:
    program = "import sys, smartcam.sync\nprint(smartcam.sync.connect(sys.argv[1]).open().name)\n"
    running = subprocess.Popen(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", program + "input()", emulator.url],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert running.stdout is not None
    assert running.stdin is not None
    running.stdout.readline()
    running.send_signal(signal.SIGTERM)
    assert running.wait(PATIENCE) == -signal.SIGTERM
    running.stdout.close()
    running.stdin.close()
