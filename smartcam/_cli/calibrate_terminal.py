"""A wizard in the terminal: its steps as texts and prompts, or as lines of JSON."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import os
import re
import sys
import textwrap
import threading
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import click

from smartcam._cli.texts import table_text
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping, Sequence
    from pathlib import Path

    from smartcam._cli.options import Options
    from smartcam.calibration._inside import Input
    from smartcam.calibration.wizards import Step, WizardSession

WIDTH: Final = 88
"""Columns at which texts are wrapped."""

COMMANDS: Final = ("undo", "repeat", "abort")
"""Words that may be typed instead of an answer."""


async def run_wizard(
    session: WizardSession,
    options: Options,
    restart: Callable[[], WizardSession],
    picture: Path,
) -> dict[str, Any]:
    """Ask for answers until the wizard ends; return its last view.

    ``restart``: function that starts the wizard again and returns its session. ``picture``: file
    for the picture of a step. Raises ConfigurationError: a line of input is not valid, or the input
    has ended.
    """
    lines = InputLines()
    if session.resumed and not options.as_json:
        session = session if await _wants_to_continue(session.resumed, lines) else restart()
    view = {**session.current, "resumed": session.resumed}
    while view["type"] not in {"result", "abort"}:
        options.show(view, lambda shown: _step_text(shown, _write_picture(shown, picture)))
        if options.as_json:
            line = await lines.read_line()
            if session.resumed and _asks_for_restart(line):
                session = restart()
                view = session.current
            else:
                view = await _submit_json(session, line)
        elif session.step is not None:
            view = await _ask_step(session, session.step, view, lines)
    options.show(view, _end_text)
    return view


def _asks_for_restart(line: str) -> bool:
    with contextlib.suppress(ValueError, RecursionError):
        return bool(json.loads(line) == {"do": "anew"})
    return False


async def _wants_to_continue(resumed: Mapping[str, Any], lines: InputLines) -> bool:
    """Show the finished steps, and ask whether to continue with them."""
    click.echo(_resumed_text(resumed))
    while True:
        click.echo("Go on, or begin anew? [go on]: ", nl=False)
        text = (await lines.read_line()).lower()
        if text in {"", "go on", "g", "begin anew", "anew", "b"}:
            return text in {"", "go on", "g"}
        click.echo(f"! {text!r}: expected 'go on' or 'begin anew'; {len(resumed['done'])} are done")


def _resumed_text(resumed: Mapping[str, Any]) -> str:
    started, last_answer = _time_and_age(resumed["since"]), _time_and_age(resumed["last"])
    text = (
        f"Broken off: begun {started}, answered last {last_answer}. What was touched or seen then "
        "counts as it was: begin anew if camera, marks or sheet may have been moved since."
    )
    rows = [f"  {number}. {_done_text(step)}" for number, step in enumerate(resumed["done"], 1)]
    return "\n".join(["", *textwrap.wrap(text, WIDTH), *rows])


def _done_text(step: Mapping[str, Any]) -> str:
    answers = [
        f"{name} {_default_text(value)}"
        for name, value in step["answers"].items()
        if value not in {None, ""}
    ]
    return textwrap.shorten(f"{step['step']}: {', '.join(answers) or 'done'}", WIDTH - 5)


def _time_and_age(at: str | None) -> str:
    """Return the text of a time and of its age."""
    if at is None:
        return "at an unknown time"
    minutes = (datetime.now(UTC) - datetime.fromisoformat(at)).total_seconds() / 60
    for size, unit in ((1440, "day"), (60, "hour"), (1, "minute")):
        if minutes >= size:
            count = int(minutes // size)
            return f"{_minute_text(at)} UTC ({count} {unit}{'s' * (count > 1)} ago)"
    return f"{_minute_text(at)} UTC (just now)"


def _write_picture(view: Mapping[str, Any], path: Path) -> Path | None:
    """Write the picture of a step, if it has one; return its file."""
    svg = (view.get("preview") or {}).get("svg")
    if not svg:
        return None
    from smartcam._whole_files import replace_file

    try:
        replace_file(path, svg.encode())
    except OSError as exc:
        click.echo(f"! {path}: the picture cannot be written: {exc.strerror}")
        return None
    return path


async def _run_command(session: WizardSession, command: str, token: str) -> dict[str, Any]:
    view: dict[str, Any] = await getattr(session, command)(token)
    return view


async def _submit_json(session: WizardSession, line: str) -> dict[str, Any]:
    try:
        request = json.loads(line)
        token = request.get("token", session.token)
        answers, command = request.get("answers"), request.get("do")
    except (ValueError, RecursionError, AttributeError) as exc:
        raise ConfigurationError(
            f'a line of input: expected {{"answers": {{...}}}}, got {line[:64]!r}'
        ) from exc
    if command is None:
        return await session.submit(token, answers)
    if command not in COMMANDS:
        raise ConfigurationError(f"do: expected one of {', '.join(COMMANDS)}, got {command!r}")
    return await _run_command(session, command, token)


class _TypedCommand(NamedTuple):
    """A word that was typed instead of an answer."""

    name: str


async def _ask_step(
    session: WizardSession, step: Step, view: dict[str, Any], lines: InputLines
) -> dict[str, Any]:
    """Ask for a step's answers until the wizard leaves the step; earlier answers are defaults.

    Returns the view that follows.
    """
    token, commands = view["token"], view["can"]
    answers = dict(view["defaults"])
    field_names = [field.name for field in step.inputs]
    while view["token"] == token:
        for field in step.inputs:
            if field.name in field_names:
                value = await _ask_field(field, answers, commands, lines)
                if isinstance(value, _TypedCommand):
                    return await _run_command(session, value.name, token)
                answers[field.name] = value
        if not step.inputs:
            typed = await _read_text(f"{step.button}: press Enter", commands, lines)
            if isinstance(typed, _TypedCommand):
                return await _run_command(session, typed.name, token)
        if step.waiting:
            text = f"{step.waiting}; after Ctrl-C the same command continues here"
            click.echo("\n".join(textwrap.wrap(text, WIDTH)))
        view = await session.submit(token, answers)
        field_names = [name for name in view["errors"] if name in answers] or list(answers)
        if view["token"] == token:
            click.echo(_errors_text(view))
    return view


async def _ask_field(
    field: Input, answers: Mapping[str, Any], commands: Collection[str], lines: InputLines
) -> Any | _TypedCommand:
    """Return a valid answer, or a command; ask again after a wrong answer."""
    schema = field.schema()
    prompt = _prompt_text(schema, answers.get(field.name))
    while True:
        text = await _read_text(prompt, commands, lines)
        if isinstance(text, _TypedCommand):
            return text
        if not text and field.name in answers:
            return answers[field.name]
        try:
            return field.checked(_parse_value(schema, text))
        except ValueError as exc:
            message = f"{text!r}: expected yes or no" if schema["type"] == "boolean" else exc
            click.echo(f"! {field.label}: {message}")


async def _read_text(
    prompt: str, commands: Collection[str], lines: InputLines
) -> str | _TypedCommand:
    """Return the line typed, or a command; ask again after a command that is not possible now."""
    while True:
        click.echo(f"{prompt}: ", nl=False)
        text = await lines.read_line()
        command = text[1:].strip()
        if not text.startswith(":"):
            return text
        if command in commands:
            return _TypedCommand(command)
        click.echo(f"! :{command}: expected one of {', '.join(f':{known}' for known in commands)}")


# ---------------------------------------------------------------------- texts


def _prompt_text(schema: Mapping[str, Any], default: Any) -> str:
    unit = f", {schema['x-unit']}" if "x-unit" in schema else ""
    default_text = "" if default in {None, ""} else f" [{_default_text(default)}]"
    rows = [f"    {choice['const']}: {choice['title']}\n" for choice in schema.get("oneOf", ())]
    head = f"{schema['title']}{unit}"
    return f"{head}\n{''.join(rows)}  answer{default_text}" if rows else f"{head}{default_text}"


def _default_text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


_BOOLEANS = {"y": True, "yes": True, "n": False, "no": False}


def _parse_value(schema: Mapping[str, Any], text: str) -> Any:
    """Return the value that a text stands for, or the text itself, which the field then refuses."""
    kind = schema.get("type")
    if kind == "boolean":
        return _BOOLEANS.get(text.lower(), text)
    if kind == "string":
        return text
    with contextlib.suppress(ValueError):
        return float(text.replace(",", "."))
    return text


def _step_text(view: Mapping[str, Any], picture: Path | None = None) -> str:
    commands = ", ".join(f":{command}" for command in view["can"])
    about = f" of about {view['of']}" if view["of"] else ""
    head = f"Step {view['number']}{about}: {view['title']}  ({commands})"
    lines = ["", head, *_verdict_lines(view)]
    lines += textwrap.wrap(view["description"], WIDTH)
    if picture is not None:
        lines.append(f"  picture: {picture}")
    for note in view["notes"]:
        lines += _note_lines(note)
    errors = _errors_text(view)
    return "\n".join([*lines, errors] if errors else lines)


_COLOURS = {"good": "green", "poor": "red", "unknown": "yellow"}


def _verdict_lines(view: Mapping[str, Any]) -> list[str]:
    verdict = view.get("verdict")
    if not verdict:
        return []
    return [click.style(verdict["text"], fg=_COLOURS[verdict["level"]], bold=True)]


def _note_lines(note: str) -> list[str]:
    """Return the lines of a note; a warning begins with its code."""
    wrapped = textwrap.wrap(note, WIDTH, initial_indent="  - ", subsequent_indent="    ")
    if re.match(r"[A-Z][A-Z_]+: ", note):
        head = click.style("Warning:", fg="yellow", bold=True)
        wrapped = textwrap.wrap(note, WIDTH - 9, subsequent_indent="    ")
        wrapped[0] = f"  - {head} {wrapped[0]}"
    return wrapped


def _errors_text(view: Mapping[str, Any]) -> str:
    properties = view["schema"]["properties"]
    rows = [
        f"! {text}" if name == "base" else f"! {properties[name]['title']}: {text}"
        for name, text in view["errors"].items()
    ]
    return "\n".join(rows)


def _end_text(view: Mapping[str, Any]) -> str:
    if view["type"] == "abort":
        return "\naborted; the measurements stay in the journal"
    result = dict(view["result"])
    use, remarks = result.pop("use", {}), result.pop("remarks", [])
    rows = [f"  {name}: {_result_text(value)}" for name, value in result.items()]
    for remark in remarks:
        rows += _note_lines(remark if isinstance(remark, str) else ": ".join(remark))
    for name, text in use.items():
        rows += ["", _USES[name], "", text.rstrip("\n")]
    return "\n".join(["", "done", *_verdict_lines(view), *rows])


_USES = {"command": "On the command line:", "python": "In Python:"}


def _result_text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_result_text, value)) or "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)


def listing_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of a folder's calibrations."""
    head = ("name", "kind", "date (UTC)", "error", "last check")
    return table_text(head, [_listing_row(row) for row in rows])


def _listing_row(row: Mapping[str, Any]) -> tuple[str, ...]:
    if row["problem"] is not None:
        return row["name"], "-", "-", "-", f"cannot be read: {row['problem']}"
    error = "not known" if row["held_out_mm"] is None else f"{row['held_out_mm']:.2f} mm rms"
    verdict = "stale" if row["stale"] else "still true"
    check = "none" if row["checked_at"] is None else f"{_minute_text(row['checked_at'])}: {verdict}"
    return row["name"], row["kind"], _minute_text(row["written_at"]), error, check


def _minute_text(at: str) -> str:
    return at[:16].replace("T", " ")


# ---------------------------------------------------------------------- standard input


class InputLines:
    """Reads lines of standard input, one by one, without blocking the event loop.

    A thread waits for each line. It reads from the file descriptor, since a thread that waits in
    ``sys.stdin`` would keep the interpreter from ending.
    """

    def __init__(self) -> None:
        self._buffer = b""

    async def read_line(self) -> str:
        """Return the next line without its end; ConfigurationError: the input has ended.

        Cancellation: the thread still waits for the line, until the process ends.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[str] = loop.create_future()

        def deliver(line: str) -> None:
            if not future.done():
                future.set_result(line)

        def wait() -> None:
            line = self._read()
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                loop.call_soon_threadsafe(deliver, line)

        threading.Thread(target=wait, name="stdin", daemon=True).start()
        line = await future
        if not line:
            raise ConfigurationError(
                "the input ended before the calibration; the finished steps are kept: "
                "the same command continues with them"
            )
        return line.strip()

    def _read(self) -> str:
        try:
            descriptor = sys.stdin.fileno()
        except (io.UnsupportedOperation, AttributeError, ValueError):
            return sys.stdin.readline() if sys.stdin is not None else ""
        while b"\n" not in self._buffer:
            more = os.read(descriptor, 4096)
            if not more:
                break
            self._buffer += more
        line, end, self._buffer = self._buffer.partition(b"\n")
        return (line + end).decode(errors="replace")
