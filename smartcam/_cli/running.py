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

from smartcam._cli.terminal import tinted
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
"""The first match decides. 0 done; 1 a fault of smartcam; 2 wrong usage; 3 no session or a broken
one, or a source of frames that is missing, in use or gone; 4 a wait in a session, or for a frame,
timed out; 5 the camera refused, is not running, or has no such pixels or feature; 6 a result is not
interpretable; 7 ``calibrate --check``: stale, ``calibrate compare``: they differ; 130 and 143:
ended by Ctrl-C or SIGTERM."""


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
    interrupted: int = 130,
    terminated: int = 143,
) -> NoReturn:
    """Run a command's coroutine to its end and exit.

    Ctrl-C and SIGTERM cancel it, so every ``async with`` in it closes in order (a camera gets its
    Disconnect).

    Args:
        main: coroutine of the command.
        program: name of the program in the error line.
        debug: log to stderr and show tracebacks.
        as_json: print an error as a line of JSON.
        interrupted: exit code after Ctrl-C; 0 if that is the usual end.
        terminated: exit code after SIGTERM.
    """
    if debug:
        logging.basicConfig(level=logging.DEBUG, stream=sys.stderr)
    else:
        # without a handler Python would print warnings beside our one line
        logging.getLogger("smartcam").addHandler(logging.NullHandler())
    if isinstance(sys.stdout, io.TextIOWrapper):
        # a camera's texts may have letters that the terminal's encoding lacks
        sys.stdout.reconfigure(errors="backslashreplace")
    ended_by: list[signal.Signals] = []
    try:
        asyncio.run(_with_signals(main, ended_by))
    except (KeyboardInterrupt, asyncio.CancelledError):
        sys.exit(terminated if signal.SIGTERM in ended_by else interrupted)
    except BrokenPipeError:
        # the reader has gone, as after `head`; nothing may be written at exit either
        with contextlib.suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except click.ClickException:
        raise  # wrong usage, which click reports
    except Exception as exc:  # noqa: BLE001 - the last place: one line instead of a traceback
        if debug:
            traceback.print_exc()
        text = _one_line(exc)
        word = tinted("error", "error:")
        line = error_json(exc, text, exit_code(exc)) if as_json else f"{program}: {word} {text}"
        click.echo(line, err=True)
        sys.exit(exit_code(exc))
    sys.exit(0)


async def first(jobs: Iterable[Coroutine[Any, Any, None]], seconds: float | None) -> None:
    """Run jobs until the first ends, or for so many seconds; raise its error."""
    tasks = [asyncio.create_task(job) for job in jobs]
    try:
        done, _ = await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            if task in done:
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        # the error of a second job is the same loss, and must not be reported again
        await asyncio.gather(*tasks, return_exceptions=True)


def _one_line(error: Exception) -> str:
    if not isinstance(error, (SmartCamError, OSError)):
        return f"unexpected {error!r}; --debug shows where"
    lines = str(error).splitlines()
    if isinstance(error, LayoutError):
        del lines[1:]  # the layout with a mark; the first line has the position
    text = " ".join(line.strip() for line in lines)
    cause = error.__cause__
    hung_up = (
        isinstance(error, ConnectionLostError)
        and isinstance(cause, ConnectionError)
        and not isinstance(cause, LinkError)  # such as a lost agent
    )
    return f"{text}. {TAKEN_ADVICE}" if hung_up else text


async def _with_signals(main: Coroutine[Any, Any, None], ended_by: list[signal.Signals]) -> None:
    """Let the first SIGINT or SIGTERM cancel ``main``; a second one ends the program as usual.

    The handlers are set here and not left to asyncio, which sets none if SIGINT was ignored at
    the start, as it is for a job in a shell script's background.
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
