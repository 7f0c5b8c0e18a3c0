"""Commands of ours in processes of their own, started in a moment.

Most of what a short command takes is Python's start and the imports. So a process of this file has
imported all of it, and each command is a fork of that: it has its own number, standard streams,
signals and end. What is about the start itself asks for a ``fresh`` one.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import importlib
import json
import os
import selectors
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import pytest

from smartcam._zenoh import with_ports

PATIENCE = 60.0
"""Seconds; only what has gone wrong takes as long."""

MAINS = {"smartcam": "main", "smartcam-emulator": "emulator_main"}
"""Our console scripts, and what of ``smartcam._cli`` they call."""

LOADED = (
    *(
        "smartcam._cli.running",
        "smartcam._cli.smartcam",
        "smartcam._cli.smartcam_emulator",
        "smartcam.connecting",
        "smartcam.emulator._camera",
        "smartcam.emulator._insight.camera",
        "smartcam.emulator._scenario.file",
    ),
    *("smartcam.calibration.wizards._plane", "smartcam.recording", "smartcam.web", "mcap.writer"),
    "scipy.special",
)
"""Modules that commands import, mostly when they are used."""

LARGEST = 1 << 16


def wait_until(true: Callable[[], object]) -> None:
    """Wait until it is so; a test that waits in vain fails."""
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end, "what was waited for has not come"
        time.sleep(0.02)


def free_place(host: str = "127.0.0.1") -> str:
    """Return an endpoint of Zenoh's that nobody listens on, as an agent finds one itself."""
    (place,) = with_ports([f"tcp/{host}:0"])
    return place


def free_port() -> int:
    """Return a port where nothing listens, and which no other test gets meanwhile."""
    return int(free_place().rpartition(":")[2])


def printed_by(python: str) -> str:
    """Return what lines of Python print, run by themselves; no lines are counted there."""
    plain = {name: value for name, value in os.environ.items() if not name.startswith("COV")}
    return subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", python],
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE,
        env=plain,
    ).stdout


@contextlib.contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Have files of this process refused to grow beyond ``size`` bytes."""
    resource = pytest.importorskip("resource", reason="a limit of POSIX")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def network_namespace(program: str, package: str) -> list[str]:
    """Return the command that runs another one in a network namespace of its own; skip without it.

    Args:
        program: one that the test needs beside.
        package: package of Debian's that brings it.
    """
    for needed, brought in ((program, package), ("ip", "iproute2"), ("unshare", "util-linux")):
        if shutil.which(needed) is None:
            pytest.skip(f"needs {needed}: apt-get install {brought}")
    for command in (["unshare", "-n"], ["unshare", "-r", "-n"]):
        if subprocess.run([*command, "true"], capture_output=True, check=False).returncode == 0:  # noqa: S603
            return command
    pytest.skip("needs network namespaces: unshare -n is not allowed here")


class Outcome(NamedTuple):
    """The end of a command."""

    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[Any]:
        """The lines of stdout, each read as JSON."""
        return [json.loads(line) for line in self.out.splitlines()]

    def done(self) -> Self:
        """See that it ended well and said nothing on stderr."""
        assert (self.code, self.err) == (0, "")
        return self

    def failed(self, code: int, *texts: str) -> Self:
        """See that it ended with ``code`` and one line that holds ``texts``."""
        if self.err.startswith("{"):  # told as JSON
            assert json.loads(self.err)["exit_code"] == code
        else:
            assert self.err.startswith(("smartcam: error: ", "smartcam-emulator: error: "))
        assert self.err.count("\n") == 1
        assert self.err.endswith("\n")
        assert "Traceback" not in self.err
        for text in texts:
            assert text in self.err
        assert self.code == code
        return self


def script(name: str) -> str:
    """Return the path of a console script of this environment."""
    found = shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)
    assert found is not None
    return found


class Process:
    """A console script in a process of its own; a context manager that ends with it."""

    def __init__(
        self,
        *command: str,
        env: Mapping[str, str] | None = None,  # variables beside the present ones
        cwd: Path | None = None,  # where it runs, else here
        merged: bool = False,  # whether stderr goes where stdout goes
        fresh: bool = False,  # whether Python starts for it
    ) -> None:
        given, self._stdin = os.pipe()
        self._pipes: dict[str, int] = {}
        theirs = [given]
        for name in ("stdout",) if merged else ("stdout", "stderr"):
            self._pipes[name], end = os.pipe()
            theirs.append(end)
        streams = (theirs[0], theirs[1], theirs[-1])
        start = _Fresh if fresh else _Fork
        self._life = start(command, dict(env or {}), str(cwd or Path.cwd()), streams)
        for one in theirs:
            os.close(one)
        self._seen = {"stdout": b"", "stderr": b""}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.send_signal(signal.SIGKILL)
        self._life.ended(PATIENCE)
        self._life.forget()
        self.close_stdin()
        for name in tuple(self._pipes):
            self._close(name)

    def read_until(self, text: bytes, *, count: int = 1, stream: str = "stdout") -> str:
        """Return what was said until ``text`` had come ``count`` times."""
        while self._seen[stream].count(text) < count:
            assert self._read(stream), f"{text!r} did not come: {self._seen}"
        return self._seen[stream].decode(errors="replace")

    def says(self, seconds: float) -> bool:
        """Tell whether stdout has something more, as soon as it has."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._pipes["stdout"], selectors.EVENT_READ)
            return bool(selector.select(seconds))

    def write(self, data: bytes) -> None:
        """Type this."""
        os.write(self._stdin, data)

    def close_stdin(self) -> None:
        """Type no more."""
        if self._stdin >= 0:
            os.close(self._stdin)
        self._stdin = -1

    def close_stdout(self) -> None:
        """Read no more."""
        self._close("stdout")

    @property
    def running(self) -> bool:
        """True as long as the process has not ended."""
        return self._life.ended(0) is None

    def send_signal(self, number: int) -> None:
        """Send a signal; its number is its own as long as it has not ended."""
        if self.running:
            os.kill(self._life.number, number)

    def wait(self) -> Outcome:
        """Return how it ended, with everything it said."""
        while self._pipes:
            self._read(*self._pipes)
        code = self._life.ended(PATIENCE)
        assert code is not None, f"it does not end: {self._seen}"
        self.close_stdin()
        return Outcome(code, self._seen["stdout"].decode(), self._seen["stderr"].decode())

    def _read(self, *streams: str) -> bool:
        """Read some of what one of the streams has; tells whether more came."""
        with selectors.DefaultSelector() as selector:
            for name in streams:
                if name in self._pipes:
                    selector.register(self._pipes[name], selectors.EVENT_READ, name)
            ready = selector.select(PATIENCE) if selector.get_map() else []
        assert ready or not self._pipes, f"it says nothing and does not end: {self._seen}"
        data = b""
        for key, _ in ready:
            data = os.read(key.fd, LARGEST)
            self._seen[key.data] += data
            if not data:
                self._close(key.data)
        return bool(data)

    def _close(self, stream: str) -> None:
        if stream in self._pipes:
            os.close(self._pipes.pop(stream))


class _Fresh:
    """A process that is started as anybody starts it."""

    def __init__(
        self, command: tuple[str, ...], env: dict[str, str], cwd: str, streams: tuple[int, ...]
    ) -> None:
        stdin, stdout, stderr = streams
        self._popen = subprocess.Popen(  # noqa: S603 - commands of the tests
            [script(command[0]), *command[1:]],
            stdin=stdin,
            stdout=stdout,
            stderr=stderr,
            cwd=cwd,
            env={**os.environ, "PYTHONUNBUFFERED": "", **env},
        )
        self.number = self._popen.pid

    def ended(self, seconds: float) -> int | None:
        """Return its exit code as soon as it has one; None where that takes too long."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._popen.wait(seconds)
        return None

    def forget(self) -> None:
        """Nothing is left of it."""


class _Fork:
    """A fork of the process that has imported everything."""

    def __init__(
        self, command: tuple[str, ...], env: dict[str, str], cwd: str, streams: tuple[int, ...]
    ) -> None:
        self._report, told = os.pipe()
        self._code: int | None = None
        order = json.dumps([command, env, cwd]).encode()
        socket.send_fds(_forks(), [order], [*streams, told])
        os.close(told)
        self.number = self._next(PATIENCE) or 0
        assert self.number, f"{command} did not start"

    def ended(self, seconds: float) -> int | None:
        """Return its exit code as soon as it has one; None where that takes too long."""
        if self._code is None:
            self._code = self._next(seconds)
        return self._code

    def forget(self) -> None:
        """Nothing is left of it."""
        os.close(self._report)

    def _next(self, seconds: float) -> int | None:
        """Return the next number that is reported."""
        with selectors.DefaultSelector() as selector:
            selector.register(self._report, selectors.EVENT_READ)
            if not selector.select(seconds):
                return None
        data = os.read(self._report, 8)
        assert len(data) == 8, "who watches it is gone"
        return int.from_bytes(data, "little", signed=True)


@functools.cache
def _forks() -> socket.socket:
    """Start the process that forks; it ends with this one."""
    ours, theirs = socket.socketpair()
    with theirs:
        popen = subprocess.Popen(  # noqa: S603 - our own interpreter
            [sys.executable, __file__, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            # as a command's are, for a stream finds out at its beginning what it is
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "PYTHONUNBUFFERED": ""},
        )

    def end() -> None:
        ours.close()
        _, told = popen.communicate(timeout=PATIENCE)
        sys.stderr.write(told.decode())

    atexit.register(end)
    return ours


# ---------------------------------------------------------------------- in the process that forks


def serve(calls: socket.socket) -> None:
    """Fork for each call; returns in a fork, which is the command then, and at the end."""
    for name in LOADED:
        importlib.import_module(name)
    list(sys.modules["smartcam._cli.smartcam"].command.commands.values())  # imports them
    gc.freeze()  # what no fork looks at need not be copied for it
    while True:
        order, streams, _, _ = socket.recv_fds(calls, LARGEST, 4)
        if not order:
            return
        watcher = os.fork()
        if not watcher:
            calls.close()
            command, env, cwd = json.loads(order)
            if _is_the_command(*streams):
                os.environ.update(env)
                os.chdir(cwd)
                _run(*command)
            return
        for one in streams:
            os.close(one)
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:  # watchers that have done their work
                pass


def _is_the_command(stdin: int, stdout: int, stderr: int, report: int) -> bool:
    """Fork once more, for somebody has to report how the command ends."""
    number = os.fork()
    if not number:
        os.close(report)
        for place, one in enumerate((stdin, stdout, stderr)):
            os.dup2(one, place)
        for one in {stdin, stdout, stderr}:
            os.close(one)
        return True
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for one in {stdin, stdout, stderr}:
        os.close(one)
    with contextlib.suppress(BrokenPipeError):
        os.write(report, number.to_bytes(8, "little", signed=True))
        code = os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])
        os.write(report, code.to_bytes(8, "little", signed=True))
    os._exit(0)


def _run(program: str, *arguments: str) -> None:
    sys.argv = [program, *arguments]
    try:
        getattr(importlib.import_module("smartcam._cli"), MAINS[program])()
    except SystemExit as exc:
        # Python would take everything apart that was imported, which takes longer than the command
        atexit._run_exitfuncs()
        try:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
        except OSError:
            raise exc from None  # it is for Python to say so
        if exc.code is None or isinstance(exc.code, int):
            os._exit(exc.code or 0)
        raise


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
