"""Forks: a copy of a process that has one thread, and whose locks stay as they were.

Each test forks in a process of its own, which has no other threads than it wants.
"""

from __future__ import annotations

import functools
import importlib
import os
import pkgutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType

import pytest

import smartcam

if not hasattr(os, "fork"):
    pytest.skip("there are no forks", allow_module_level=True)

PATIENCE = 60.0
"""Seconds; only what hangs takes as long."""

PREFACE = f"""
import os, sys, threading, time
import smartcam, smartcam.sync, smartcam._sync_base

def in_a_fork(work):
    child = os.fork()
    if not child:
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    end = time.monotonic() + {PATIENCE}
    while time.monotonic() < end:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            assert status == 0, "the fork failed"
            return
        time.sleep(0.001)
    os.kill(child, 9)
    os.waitpid(child, 0)
    sys.exit("the fork hung")

def held(lock):
    "Have another thread hold a lock as long as this process lives."
    ready = threading.Event()
    def hold():
        with lock:
            ready.set()
            time.sleep(1e6)
    threading.Thread(target=hold, daemon=True).start()
    assert ready.wait({PATIENCE})
"""


def run(script: str) -> None:
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", PREFACE + script],
        capture_output=True,
        text=True,
        check=False,
        timeout=4 * PATIENCE,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_fork_while_other_threads_start_the_loops_thread_has_cameras() -> None:
    run(
        """
ended = False
def make():
    while not ended:
        thread = smartcam._sync_base._threads.pop("smartcam.sync", None)
        if thread is not None:
            thread.stop()  # so that it is started again and again
        smartcam.sync.connect("bvs://127.0.0.1:1")

smartcam.sync.connect("bvs://127.0.0.1:1")  # all that is imported is imported
makers = [threading.Thread(target=make, daemon=True) for _ in range(2)]
for one in makers:
    one.start()
for _ in range(50):
    in_a_fork(lambda: smartcam.sync.connect("bvs://127.0.0.1:1").statistics())
ended = True
"""
    )


def test_fork_has_cameras_of_its_own_and_leaves_those_of_its_parent() -> None:
    run(
        """
from smartcam.testing import ThreadedCamera

fresh = ThreadedCamera(active=21, running=True)
with ThreadedCamera(active=21, running=True) as emulator:
    with smartcam.sync.connect(emulator.url) as camera:
        results = camera.results()

        def child():
            for call in (camera.trigger, camera.close, results.close, emulator.stop):
                try:
                    call()
                except smartcam.LocalProtocolError as error:
                    assert "fork" in str(error)
                else:
                    raise AssertionError(call)
            with fresh, smartcam.sync.connect(fresh.url) as own:
                assert own.trigger().application == 21

        in_a_fork(child)
        assert camera.trigger().application == 21
        assert results.get(timeout=60).application == 21
with fresh, smartcam.sync.connect(fresh.url) as camera:
    assert camera.trigger().application == 21
"""
    )


def test_recorder_whose_lock_was_held_records_nothing_in_a_fork() -> None:
    run(
        """
import tempfile
from smartcam.recording import Recorder

with tempfile.TemporaryDirectory() as folder:
    recorder = Recorder(folder + "/a.mcap").open()
    held(recorder._condition)

    def child():
        recorder.on_error("camera", smartcam.ConnectionLostError("gone"), None)
        assert recorder.counts.errors == 0
        try:
            recorder.close()
        except smartcam.RecordingError as error:
            assert "fork" in str(error)
        else:
            raise AssertionError

    in_a_fork(child)
"""
    )


def test_types_of_ros_whose_lock_was_held_are_there_in_a_fork() -> None:
    run(
        """
from smartcam.ros2 import RosTypes

types = RosTypes()
held(types._shared._lock)

def child():
    types.message("std_msgs/msg/String")
    types.add("here/msg/Own", "int32 n")

in_a_fork(child)
"""
    )


def test_value_that_another_thread_makes_is_made_in_a_fork_too() -> None:
    run(
        """
from smartcam._forks import cached_property

inside = threading.Event()

class Thing:
    parent = os.getpid()

    @cached_property
    def value(self):
        if os.getpid() == self.parent:
            inside.set()
            time.sleep(1e6)
        return 7

threading.Thread(target=lambda: Thing().value, daemon=True).start()
assert inside.wait(60)

def child():
    assert Thing().value == 7

in_a_fork(child)
"""
    )


def test_engine_in_a_fork_of_a_process_that_had_it_is_refused() -> None:
    pytest.importorskip("zenoh")
    run(
        """
import asyncio
from smartcam._zenoh import BusLink, ZenohSession

async def session():
    end = await ZenohSession(BusLink(listen=("tcp/127.0.0.1:0",))).open(60.0)
    await end.close()

def child():
    try:
        asyncio.run(session())
    except smartcam.LocalProtocolError as error:
        assert "fork" in str(error)
    else:
        raise AssertionError

in_a_fork(lambda: None)
asyncio.run(session())
in_a_fork(child)
"""
    )


def modules() -> list[ModuleType]:
    found = []
    for info in pkgutil.walk_packages(smartcam.__path__, "smartcam."):
        if info.name.endswith("__main__"):
            continue
        try:
            found.append(importlib.import_module(info.name))
        except ImportError:  # an extra's
            continue
    return found


LOCKS = (
    type(threading.Lock()),
    type(threading.RLock()),
    threading.Condition,
    threading.Event,
    threading.Semaphore,
    threading.Thread,
    ThreadPoolExecutor,
)


def test_no_module_holds_a_lock_or_a_thread() -> None:
    seen = modules()
    assert len(seen) > 400
    assert [
        f"{module.__name__}.{name}"
        for module in seen
        for name, value in vars(module).items()
        if isinstance(value, LOCKS)
    ] == []


def test_no_class_has_a_cached_value_with_a_lock() -> None:
    """Python 3.11's ``functools.cached_property`` has one for all objects of the class."""
    assert [
        f"{module.__name__}.{kind.__name__}.{name}"
        for module in modules()
        for kind in vars(module).values()
        if isinstance(kind, type) and kind.__module__ == module.__name__
        for name, value in vars(kind).items()
        if type(value) is functools.cached_property and sys.version_info < (3, 12)
    ] == []
