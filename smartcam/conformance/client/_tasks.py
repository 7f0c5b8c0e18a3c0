"""The tasks for a client, and the ways to run one: a command, or a Python function.

A command gets the task as arguments and prints one line for each result: the bytes of the result
container after the application id as hex, or a JSON object that has them as ``data`` or ``raw``.
Its exit code is 0 if it has done the task, 77 if it does not support the task, and any other
number if it failed.
"""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import json
import os
import shlex
import signal
import threading
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias, cast

from smartcam._arguments import check_callable, check_iterable, check_path, check_text
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Iterable, Sequence

    Perform: TypeAlias = "Callable[[Task], Iterable[bytes] | Awaitable[Iterable[bytes]]]"

UNSUPPORTED = 77
"""Exit code of a command that does not support a task; automake's tests use it for "skipped"."""

MAX_OUTPUT_BYTES = 1 << 20
"""Largest number of bytes of a command's output that are read; a client that prints more has
failed."""

MAX_SHOWN_LENGTH = 2000
"""Largest number of characters of a command's output that a report shows."""

END_TIMEOUT = 2.0
"""Seconds that a client has to end after it was cancelled or killed."""

Verb = Literal["trigger", "switch", "watch"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A task for a client, to be done in a session of its own.

    - ``trigger [N]``: connect, trigger the active application once, or N times one after the other,
      print each result, disconnect.
    - ``switch ID``: connect, have application ID loaded and running, trigger once, print the
      result, disconnect.
    - ``watch N``: connect, print the next N unasked results, disconnect.

    Attributes:
        verb: the first word of the task.
        number: N or ID; None for one trigger.
        url: the camera's address in smartcam's form, which names the dialect.
        host: name or address of the camera's host.
        port: number of the camera's port.
        transport: ``tcp`` or ``udp``.
        dialect: name of the dialect that the camera speaks.
    """

    verb: Verb
    number: int | None = None
    url: str
    host: str
    port: int
    transport: str
    dialect: str

    @property
    def words(self) -> list[str]:
        """The task as arguments of a command."""
        return [self.verb, *([] if self.number is None else [str(self.number)])]

    def __str__(self) -> str:
        """Return the task as a command gets it."""
        return " ".join(self.words)


class Outcome(NamedTuple):
    """The outcome of a client's task.

    Attributes:
        results: data of the results that the client gave, in order.
        error: the client's text about its failure; None if the client reports success.
        ended_in_time: True if the client ended in time.
        supported: True if the client supports the task.
        seconds: duration of the task.
        output: further output of the client, shortened.
    """

    results: tuple[bytes, ...] = ()
    error: str | None = None
    ended_in_time: bool = True
    supported: bool = True
    seconds: float = 0.0
    output: str = ""


class Client(ABC):
    """A client to be judged, which does tasks."""

    @abstractmethod
    async def perform(self, task: Task, timeout: float) -> Outcome:
        """Do a task.

        Args:
            task: the task.
            timeout: seconds until the client is stopped.

        Returns:
            The outcome, also for a client that fails or does not end.

        Raises:
            ConfigurationError: the client cannot be started.
        """


class FunctionClient(Client):
    """A client called by a Python function, in a thread of its own.

    Args:
        function: function that gets a task and returns the results' bytes; plain or asynchronous.
            It raises NotImplementedError for a task that it cannot do, any other exception for a
            failure. Returning means success.
    """

    def __init__(self, function: Perform) -> None:
        self._function = check_callable(function, "function", "client")

    async def perform(self, task: Task, timeout: float) -> Outcome:
        """Do a task, see :meth:`Client.perform`.

        A plain function that does not end is left in its thread, which does not keep the
        process alive; an asynchronous one is cancelled.
        """
        worker = _Worker(self._function, task)
        started_at = time.monotonic()
        worker.start()
        try:
            async with asyncio.timeout(timeout):
                await asyncio.shield(worker.finished)
        except TimeoutError:
            worker.cancel()
            await asyncio.wait({worker.finished}, timeout=END_TIMEOUT if worker.cancellable else 0)
            return Outcome(ended_in_time=False, seconds=time.monotonic() - started_at)
        return worker.outcome._replace(seconds=time.monotonic() - started_at)


class _Worker:
    """Runs a function in a daemon thread; an asynchronous function gets an event loop there."""

    def __init__(self, function: Perform, task: Task) -> None:
        self.finished: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self.outcome = Outcome()
        self.cancellable = inspect.iscoroutinefunction(function)
        self._function = function
        self._task = task
        self._loop_and_task: tuple[asyncio.AbstractEventLoop, asyncio.Task[Any]] | None = None
        self._waiting_loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._run, name=f"client: {task}", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def cancel(self) -> None:
        loop_and_task = self._loop_and_task
        if loop_and_task is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed already
                loop_and_task[0].call_soon_threadsafe(loop_and_task[1].cancel)

    def _run(self) -> None:
        try:
            self.outcome = Outcome(results=self._run_function())
        except NotImplementedError as exc:
            self.outcome = Outcome(supported=False, output=str(exc))
        except BaseException as exc:  # noqa: BLE001 - whatever a client raises is its failure
            self.outcome = Outcome(error=f"{type(exc).__name__}: {exc}"[:MAX_SHOWN_LENGTH])
        with contextlib.suppress(RuntimeError):  # the waiting loop is closed
            self._waiting_loop.call_soon_threadsafe(self._set_finished)

    def _set_finished(self) -> None:
        if not self.finished.done():
            self.finished.set_result(None)

    def _run_function(self) -> tuple[bytes, ...]:
        if self.cancellable:
            values = asyncio.run(self._await_function())
        else:
            values = cast("Iterable[bytes]", self._function(self._task))
        return tuple(bytes(result) for result in values)

    async def _await_function(self) -> Iterable[bytes]:
        current = asyncio.current_task()
        if current is not None:
            self._loop_and_task = (asyncio.get_running_loop(), current)
        return await cast("Awaitable[Iterable[bytes]]", self._function(self._task))


class CommandClient(Client):
    """A client run by a command, in any language.

    Args:
        command: the program and its arguments. ``{host}``, ``{port}``, ``{url}``, ``{transport}``,
            ``{dialect}`` and ``{task}`` are replaced; an argument that is ``{task}`` alone becomes
            the task's words: ``trigger``, or ``switch`` and ``3``. A text is split as a shell does.
        cwd: folder to run it in; default the current one.

    Raises:
        ConfigurationError: the command has no field for the task or for the camera's address.
    """

    def __init__(self, command: str | Sequence[str], cwd: str | None = None) -> None:
        if isinstance(command, str):
            text = check_text(command, "client command")
            try:
                words = shlex.split(text)
            except ValueError as exc:
                raise ConfigurationError(f"client command {text!r}: {exc}") from exc
        else:
            expected = "a text, or the program and its arguments"
            values = check_iterable(command, "client command", expected)
            words = [check_text(text, "client command") for text in values]
        self._template = words
        self._cwd = None if cwd is None else str(check_path(cwd, "cwd", "client command"))
        text = " ".join(self._template)
        if "{task}" not in text or not ("{url}" in text or "{port}" in text):
            raise ConfigurationError(
                f"client command {text!r}: it needs {{task}}, and {{url}} or {{port}}"
            )

    def arguments(self, task: Task) -> list[str]:
        """Return program and arguments for a task."""
        values = {
            **{name: str(getattr(task, name)) for name in ("url", "host", "port")},
            **{name: str(getattr(task, name)) for name in ("transport", "dialect")},
            "task": str(task),
        }
        result: list[str] = []
        for argument in self._template:
            if argument == "{task}":
                result += task.words
                continue
            for name, value in values.items():
                argument = argument.replace("{" + name + "}", value)
            result.append(argument)
        return result

    async def perform(self, task: Task, timeout: float) -> Outcome:
        """Do a task, see :meth:`Client.perform`.

        A command that does not end is killed, and so are its child processes if the system can.
        """
        arguments, started_at = self.arguments(task), time.monotonic()
        try:
            process = await asyncio.create_subprocess_exec(
                *arguments,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
                cwd=self._cwd,
                start_new_session=True,
            )
        except OSError as exc:
            raise ConfigurationError(f"client command {arguments[0]!r}: {exc.strerror}") from exc
        try:
            async with asyncio.timeout(timeout):
                out, err = await _read_output(process)
        except TimeoutError:
            return Outcome(ended_in_time=False, seconds=time.monotonic() - started_at)
        finally:
            await _kill_process(process)
        seconds, errors = time.monotonic() - started_at, _shorten(err)
        if process.returncode == UNSUPPORTED:
            return Outcome(supported=False, seconds=seconds, output=errors)
        try:
            results, error = read_results(out), None
        except ValueError as exc:
            results, error = (), str(exc)
        if process.returncode:
            error = f"exit code {process.returncode}"
        return Outcome(results, error, seconds=seconds, output=errors)


async def _read_output(process: asyncio.subprocess.Process) -> tuple[bytes, bytes]:
    async def read_stream(stream: asyncio.StreamReader | None) -> bytes:
        data = b""
        while stream is not None and (chunk := await stream.read(1 << 16)):
            data += chunk[: MAX_OUTPUT_BYTES - len(data)]
        return data

    out, err = await asyncio.gather(read_stream(process.stdout), read_stream(process.stderr))
    await process.wait()
    return out, err


async def _kill_process(process: asyncio.subprocess.Process) -> None:
    """Kill the process if it still runs, and close the pipes."""
    if process.returncode is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(END_TIMEOUT):
            await process.wait()
    transport = getattr(process, "_transport", None)
    if transport is not None:  # also closes pipes that child processes hold open
        transport.close()


def _shorten(data: bytes) -> str:
    text = data.decode(errors="replace").strip()
    return text if len(text) <= MAX_SHOWN_LENGTH else text[:MAX_SHOWN_LENGTH] + "..."


def read_results(output: bytes) -> tuple[bytes, ...]:
    """Read a command's output: one result a line, without empty lines.

    Raises:
        ValueError: a line is not valid.
    """
    results: list[bytes] = []
    for number, line in enumerate(output.decode(errors="replace").splitlines(), 1):
        if not line.strip():
            continue
        try:
            results.append(_read_line(line.strip()))
        except (ValueError, TypeError) as exc:
            raise ValueError(
                f"line {number} of its output is no result: {line[:80]!r}; expected hex, or a JSON "
                'object with "data" or "raw"'
            ) from exc
    return tuple(results)


def _read_line(line: str) -> bytes:
    if line[0] not in '{"':
        return bytes.fromhex(line)
    value: Any = json.loads(line)
    if isinstance(value, dict):
        fields = cast("dict[str, Any]", value)
        value = fields.get("data", fields.get("raw"))
    return bytes.fromhex(value)
