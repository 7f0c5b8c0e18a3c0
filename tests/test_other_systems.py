"""Features that Windows lacks: loops that watch sockets and take signals, and eventfd.

The loop here refuses what asyncio's Proactor loop does not have; its own transports go on.
"""

from __future__ import annotations

import asyncio
import signal
import sys
import types
from collections.abc import Callable
from typing import Any, NoReturn

import pytest

import smartcam
import smartcam.sync
from smartcam import _loop_thread
from smartcam._client._inside import Attempt
from smartcam.emulator import EmulatedCamera, EmulatedInSight
from tests.processes import PATIENCE, Process

SYS = types.SimpleNamespace(platform="win32", version_info=sys.version_info)


class ProactorLike(asyncio.SelectorEventLoop):
    """A selector loop with the methods of a Proactor loop."""

    def _has_not(self, *_: object, **__: object) -> NoReturn:
        raise NotImplementedError

    def _sock_read_done(self, fd: int, _: object, handle: asyncio.Handle | None = None) -> None:
        """Its own way to have accepted, which calls what the other loop has not."""
        if handle is None or not handle.cancelled():  # by who accepts the next one already
            self._remove_reader(fd)  # type: ignore[attr-defined]

    add_reader = remove_reader = add_writer = remove_writer = _has_not  # pyright: ignore[reportAssignmentType]
    add_signal_handler = remove_signal_handler = _has_not  # pyright: ignore[reportAssignmentType]
    create_unix_server = create_unix_connection = _has_not  # pyright: ignore[reportAssignmentType]


def bvs(**options: Any) -> EmulatedCamera:
    return EmulatedCamera(active=21, running=True, **options)


@pytest.mark.parametrize(
    ("emulated", "asked"),
    [
        (lambda: bvs(), ""),
        (lambda: bvs(transport="udp"), ""),
        (lambda: EmulatedInSight(online=True), "cells=A1"),
    ],
    ids=["tcp", "udp", "insight"],
)
def test_trigger_in_a_loop_that_watches_no_sockets(
    emulated: Callable[[], EmulatedCamera | EmulatedInSight], asked: str
) -> None:
    async def main() -> None:
        async with emulated() as emulator:
            url = emulator.url + ("?&"["?" in emulator.url] + asked if asked else "")
            async with smartcam.connect(url) as camera:
                assert (await camera.trigger(timeout=PATIENCE)).raw
                assert camera.statistics().received == 1

    with asyncio.Runner(loop_factory=ProactorLike) as runner:
        runner.run(main())


def test_sync_without_eventfd(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_loop_thread, "sys", SYS)
    thread = _loop_thread.LoopThread("as on Windows")
    thread.start()
    try:
        assert thread.run_coroutine(lambda: asyncio.sleep(0, "done")) == "done"
    finally:
        thread.stop()


SCRIPT = """
import asyncio, sys
from tests.test_other_systems import ProactorLike

class Policy(asyncio.DefaultEventLoopPolicy):
    def new_event_loop(self):
        return ProactorLike()

asyncio.set_event_loop_policy(Policy())
from smartcam._cli import emulator_main
sys.argv = ["smartcam-emulator", "--web"]
emulator_main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="a signal as POSIX has it")
@pytest.mark.skipif(sys.version_info >= (3, 14), reason="needs a policy for event loops")
@pytest.mark.long
def test_command_ends_by_ctrl_c_where_loops_take_no_signals() -> None:
    with Process(sys.executable, "-c", SCRIPT, fresh=True) as emulator:
        url = emulator.read_until(b"\n").strip()
        emulator.read_until(b"http://", stream="stderr")
        with smartcam.sync.connect(url, application=21) as camera:
            assert camera.trigger(timeout=PATIENCE).application == 21
        emulator.send_signal(signal.SIGINT)
        assert emulator.wait().code in {0, 130}


def test_error_of_winsock_keeps_its_own_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.strerror", lambda number: "Unknown error")
    one = Attempt("handbook", "tcp")
    one.end(OSError(10061, "Connect call failed ('127.0.0.1', 9)"), 0.0)
    assert "Connect call failed" in one.outcome
