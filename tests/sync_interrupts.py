"""Ctrl-C at every line of a call of ``smartcam.sync``, in a process of its own.

``python -m tests.sync_interrupts CALL`` raises SIGINT in front of the first line that the call runs
in ``sync.py``, ``_sync_base.py`` and ``_loop_thread.py``, then of the second, and so on until the
call ends by itself. It prints how many lines there were, and what went wrong.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import smartcam.sync
from smartcam import _loop_thread, _sync_base
from smartcam.sync import SyncCamera
from smartcam.testing import ThreadedCamera

FILES = {smartcam.sync.__file__, _sync_base.__file__, _loop_thread.__file__}
MAX_LINES = 2000
"""Lines of one call, far more than any has."""

PATIENCE = 60.0
"""Seconds that one call may take; five times that, and the process ends with what hangs."""

CAMERA: dict[str, Any] = {
    "applications": [
        {"id": 1, "layout": "n: int32", "generator": "sequence", "load_time": 0.0},
        {
            "id": 21,
            "layout": "n: int32",
            "generator": "sequence",
            "load_time": 0.0,
            "processing_time": 0.001,
        },
    ],
    "active": 21,
    "running": True,
}
"""A camera that does everything at once."""

Call = Callable[[SyncCamera[Any]], object]


def _inside(camera: SyncCamera[Any]) -> None:
    with camera.application(1):
        assert camera.active_application == 1


def _stream(camera: SyncCamera[Any]) -> None:
    with camera.results() as results:
        camera.trigger()
        results.get(timeout=PATIENCE)


CALLS: dict[str, Call] = {
    "trigger": lambda camera: camera.trigger(timeout=PATIENCE),
    "query_application": lambda camera: camera.query_application(),
    "application": _inside,
    "results": _stream,
    "statistics": lambda camera: camera.statistics(),
}


def in_finalizer(frame: Any) -> bool:
    """True if the frame is part of a ``__del__``, from which Python lets no exception pass."""
    while frame is not None:
        if frame.f_code.co_name == "__del__":
            return True
        frame = frame.f_back
    return False


@contextlib.contextmanager
def interrupted_at(number: int) -> Iterator[list[str]]:
    """Have SIGINT come in front of one of the lines; give those that were run."""
    lines: list[str] = []

    def trace(frame: Any, event: str, _: object) -> Any:
        if frame.f_code.co_filename not in FILES:
            return trace
        if event == "line" and not in_finalizer(frame):
            lines.append(f"{frame.f_code.co_name}:{frame.f_lineno}")
            if len(lines) == number:
                sys.settrace(None)
                signal.raise_signal(signal.SIGINT)
        return trace

    sys.settrace(trace)
    try:
        yield lines
    finally:
        sys.settrace(None)


def interrupt(number: int, work: Callable[[], object]) -> str | None:
    """Do something, with Ctrl-C at one of its lines; return that line, None where it has ended."""
    with contextlib.suppress(KeyboardInterrupt), interrupted_at(number) as lines:
        work()
    return lines[number - 1] if len(lines) >= number else None


def until(condition: Callable[[], bool], what: str) -> None:
    """Wait until something is true that takes a moment in another thread."""
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(what)
        time.sleep(0.001)


def sweep_call(call: Call) -> int:
    """Interrupt a call of an open camera at each line; the camera then works as before."""
    with (
        ThreadedCamera(**CAMERA) as emulator,
        smartcam.sync.connect(emulator.url) as camera,
    ):
        for number in range(1, MAX_LINES):
            line = interrupt(number, lambda: call(camera))
            # in line behind going back, where that was cut off
            assert camera.trigger(timeout=PATIENCE).application == 21, line
            assert camera.query_application() == 21, line
            if line is None:
                return number - 1
    raise AssertionError("the call never ended by itself")


def sweep_open_and_close() -> int:
    """Interrupt opening and closing at each line; the camera can be closed, and another opened."""
    with ThreadedCamera(**CAMERA) as emulator:

        def whole(camera: SyncCamera[Any]) -> None:
            with camera:
                camera.query_application()

        for number in range(1, MAX_LINES):
            camera = smartcam.sync.connect(emulator.url)
            line = interrupt(number, lambda: whole(camera))  # noqa: B023 - called at once
            camera.close()
            until(lambda: not emulator.has_session, f"the session is still there: {line}")
            if line is None:
                return number - 1
    raise AssertionError("it never ended by itself")


def sweep_connect() -> int:
    """Interrupt what starts the loop's thread at each line; the next camera has one."""
    for number in range(1, MAX_LINES):
        _sync_base._close_all()
        line = interrupt(number, lambda: smartcam.sync.connect("bvs://127.0.0.1:1"))
        camera = smartcam.sync.connect("bvs://127.0.0.1:1")
        camera.statistics()  # the thread answers
        if line is None:
            return number - 1
    raise AssertionError("it never ended by itself")


def main(name: str) -> None:
    """Sweep over one call, and print what came of it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    faulthandler.dump_traceback_later(5 * PATIENCE, exit=True)
    _loop_thread.CALL_TIMEOUT = 10 * PATIENCE  # what is not ended by Ctrl-C hangs
    unheard: list[str] = []
    sys.unraisablehook = lambda what: unheard.append(f"{what.exc_value!r} in {what.object!r}")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        if name == "open_and_close":
            lines = sweep_open_and_close()
        elif name == "connect":
            lines = sweep_connect()
        else:
            lines = sweep_call(CALLS[name])
        gc.collect()
    for text in {*(str(one.message) for one in told), *unheard}:
        sys.stdout.write(f"WRONG {text}\n")
    sys.stdout.write(f"{lines} lines\n")


if __name__ == "__main__":
    main(sys.argv[1])
