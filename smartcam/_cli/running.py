"""Run a command: signals, exit codes, errors in one line."""

from __future__ import annotations

import asyncio
import contextlib
import io
import logging
import os
import signal
import sys
import traceback
from typing import TYPE_CHECKING, Any, NoReturn

import click

from smartcam._cli.terminal import coloured
from smartcam._cli.usage import error_json
from smartcam.exceptions import (
    CalibrationError,
    CameraFaultError,
    CommandRejectedError,
    ConfigurationError,
    ConnectionLostError,
    FrameFeatureError,
    FrameFormatError,
    FrameSourceError,
    InterpretationError,
    LayoutError,
    LinkError,
    NotAllowedError,
    ProtocolError,
    SmartCamError,
    TriggerError,
    UnsupportedError,
)

if TYPE_CHECKING:
    from collections.abc import Coroutine, Iterable

EXIT_CODES: tuple[tuple[type[BaseException], int], ...] = (
    (ConfigurationError, 2),
    (LinkError, 3),
    (ProtocolError, 3),
    (CalibrationError, 2),
    (InterpretationError, 6),
    (TimeoutError, 4),
    (FrameFormatError, 5),
    (FrameFeatureError, 5),
    (FrameSourceError, 3),
    (CommandRejectedError, 5),
    (UnsupportedError, 5),
    (NotAllowedError, 5),
    (CameraFaultError, 5),
    (TriggerError, 5),
)
"""Exit codes of errors; the first matching class counts.

0: done. 1: an error of the system, as of a file, or a fault of smartcam. 2: wrong usage. 3: no
session or a broken session, or a source of frames that is missing, in use or lost. 4: a time-out in
a session, or while waiting for a frame. 5: the camera refused, is not running, or lacks the pixel
format or feature. 6: a result cannot be interpreted. 7: ``calibrate --check`` found a stale
calibration, or ``calibrate compare`` found different ones. 130 and 143: ended by Ctrl-C or SIGTERM.
"""


TAKEN_ADVICE = (
    "Has another client taken it? Most cameras serve one, and the newcomer wins. smartcam doctor "
    "tells more."
)
"""The advice after a connection that the camera ended."""


def exit_code(error: BaseException) -> int:
    """Return the exit code for an error."""
    return next((code for kind, code in EXIT_CODES if isinstance(error, kind)), 1)


def run(
    main: Coroutine[Any, Any, None],
    *,
    program: str,
    debug: bool,
    as_json: bool = False,
    interrupt_code: int = 130,
    terminate_code: int = 143,
) -> NoReturn:
    """Run a command's coroutine until it ends, then exit the process.

    Ctrl-C and SIGTERM cancel the coroutine, so every ``async with`` in it still cleans up (a
    camera gets its Disconnect).

    Args:
        main: coroutine of the command.
        program: name of the program in the error line.
        debug: log to stderr and show tracebacks.
        as_json: print an error as a line of JSON.
        interrupt_code: exit code after Ctrl-C; 0 if that is the usual end.
        terminate_code: exit code after SIGTERM.
    """
    if debug:
        logging.basicConfig(level=logging.DEBUG, stream=sys.stderr)
    else:
        # without a handler Python would print warnings in addition to our line
        logging.getLogger("smartcam").addHandler(logging.NullHandler())
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a camera's texts may have letters that the terminal's encoding lacks
        sys.stdout.reconfigure(errors="backslashreplace")
    ended_by: list[signal.Signals] = []
    try:
        asyncio.run(_with_signals(main, ended_by))
    except (KeyboardInterrupt, asyncio.CancelledError):
        sys.exit(terminate_code if signal.SIGTERM in ended_by else interrupt_code)
    except BrokenPipeError:
        # nobody reads stdout any more, as after `head`; nothing may be written at exit either
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except click.ClickException:
        raise  # wrong usage, which click reports
    except Exception as exc:  # noqa: BLE001 - the last place: one line instead of a traceback
        if debug:
            traceback.print_exc()
        text = _one_line(exc)
        word = coloured("error", "error:")
        line = error_json(exc, text, exit_code(exc)) if as_json else f"{program}: {word} {text}"
        click.echo(line, err=True)
        sys.exit(exit_code(exc))
    sys.exit(0)


async def run_until_first(jobs: Iterable[Coroutine[Any, Any, None]], seconds: float | None) -> None:
    """Run jobs until one of them ends, at most ``seconds``, then cancel the others.

    Raises the error of the job that ended first.
    """
    tasks = [asyncio.create_task(job) for job in jobs]
    try:
        done, _ = await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            if task in done:
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        # a second job fails by the same loss of the connection, which is reported already
        await asyncio.gather(*tasks, return_exceptions=True)


def _one_line(error: Exception) -> str:
    if not isinstance(error, (SmartCamError, OSError)):
        return f"unexpected {error!r}; --debug shows where"
    lines = str(error).splitlines()
    if isinstance(error, LayoutError):
        del lines[1:]  # these show the layout with a mark; the first line names the position
    text = " ".join(line.strip() for line in lines)
    cause = error.__cause__
    is_hang_up = (
        isinstance(error, ConnectionLostError)
        and isinstance(cause, ConnectionError)
        and not isinstance(cause, LinkError)  # such as the loss of a fleet's agent
    )
    return f"{text}. {TAKEN_ADVICE}" if is_hang_up else text


async def _with_signals(main: Coroutine[Any, Any, None], ended_by: list[signal.Signals]) -> None:
    """Run ``main``; the first SIGINT or SIGTERM cancels it, a second one ends the program as usual.

    ``ended_by`` gets the signal. asyncio's own handler is not enough: it is not set if SIGINT was
    ignored at the start, as in a background job of a shell script.
    """
    loop = asyncio.get_running_loop()
    task = asyncio.current_task()

    def on_signal(number: signal.Signals) -> None:
        ended_by.append(number)
        for signal_number in (signal.SIGINT, signal.SIGTERM):
            loop.remove_signal_handler(signal_number)
        if task is not None:
            task.cancel()

    with contextlib.suppress(NotImplementedError):  # Windows: asyncio's own handling of Ctrl-C
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, on_signal, number)
    await main
