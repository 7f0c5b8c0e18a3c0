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
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import click

from smartcam._cli.texts import table_text
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from smartcam._cli.options import Options
    from smartcam.calibration.wizards._sequence import WizardSession
    from smartcam.calibration.wizards._steps import Input, Step

WIDTH: Final = 88
"""Columns of a text."""

COMMANDS: Final = ("undo", "repeat", "abort")
"""What may stand where an answer is asked for."""


async def drive(session: WizardSession, options: Options) -> dict[str, Any]:
    """Ask until the wizard's end; return the last view.

    Raises ConfigurationError: a line of input is none, or there is no more.
    """
    lines = Lines()
    view = session.current
    while view["type"] not in {"result", "abort"}:
        options.show(view, _step_text)
        if options.as_json:
            view = await _from_json(session, await lines.next())
        elif session.step is not None:
            view = await _from_prompts(session, session.step, view, lines)
    options.show(view, _end_text)
    return view


async def _do(session: WizardSession, command: str, token: str) -> dict[str, Any]:
    view: dict[str, Any] = await getattr(session, command)(token)
    return view


async def _from_json(session: WizardSession, line: str) -> dict[str, Any]:
    try:
        asked = json.loads(line)
        token = asked.get("token", session.token)
        answers, command = asked.get("answers"), asked.get("do")
    except (ValueError, RecursionError, AttributeError) as exc:
        raise ConfigurationError(
            f'a line of input: expected {{"answers": {{...}}}}, got {line[:64]!r}'
        ) from exc
    if command is None:
        return await session.submit(token, answers)
    if command not in COMMANDS:
        raise ConfigurationError(f"do: expected one of {', '.join(COMMANDS)}, got {command!r}")
    return await _do(session, command, token)


class _Instead(NamedTuple):
    """What was typed instead of an answer."""

    name: str


async def _from_prompts(
    session: WizardSession, step: Step, view: dict[str, Any], lines: Lines
) -> dict[str, Any]:
    """Ask for a step's answers, one by one, until it is left; what was answered is a default."""
    token, can = view["token"], view["can"]
    answers = dict(view["defaults"])
    wanted = [one.name for one in step.inputs]
    while view["token"] == token:
        for one in step.inputs:
            if one.name in wanted:
                value = await _answer(one, answers, can, lines)
                if isinstance(value, _Instead):
                    return await _do(session, value.name, token)
                answers[one.name] = value
        if not step.inputs:
            typed = await _typed(f"{step.button}: press Enter", can, lines)
            if isinstance(typed, _Instead):
                return await _do(session, typed.name, token)
        if step.waiting:
            text = f"{step.waiting}; Ctrl-C ends it, and the same command goes on"
            click.echo("\n".join(textwrap.wrap(text, WIDTH)))
        view = await session.submit(token, answers)
        wanted = [name for name in view["errors"] if name in answers] or list(answers)
        if view["token"] == token:
            click.echo(_errors_text(view))
    return view


async def _answer(
    one: Input, answers: Mapping[str, Any], can: Collection[str], lines: Lines
) -> Any | _Instead:
    """Return an answer that the step takes, or a command; a wrong one is asked for again."""
    schema = one.schema()
    prompt = _prompt(schema, answers.get(one.name))
    while True:
        text = await _typed(prompt, can, lines)
        if isinstance(text, _Instead):
            return text
        if not text and one.name in answers:
            return answers[one.name]
        try:
            return one.checked(_value(schema, text))
        except ValueError as exc:
            wrong = f"{text!r}: expected yes or no" if schema["type"] == "boolean" else exc
            click.echo(f"! {one.label}: {wrong}")


async def _typed(prompt: str, can: Collection[str], lines: Lines) -> str | _Instead:
    """Return what is typed; a command that cannot be done now is refused, and it is asked again."""
    while True:
        click.echo(f"{prompt}: ", nl=False)
        text = await lines.next()
        command = text[1:].strip()
        if not text.startswith(":"):
            return text
        if command in can:
            return _Instead(command)
        click.echo(f"! :{command}: expected one of {', '.join(f':{one}' for one in can)}")


# ---------------------------------------------------------------------- texts


def _prompt(schema: Mapping[str, Any], default: Any) -> str:
    unit = f", {schema['x-unit']}" if "x-unit" in schema else ""
    shown = "" if default in {None, ""} else f" [{_default_text(default)}]"
    rows = [f"    {one['const']}: {one['title']}\n" for one in schema.get("oneOf", ())]
    head = f"{schema['title']}{unit}"
    return f"{head}\n{''.join(rows)}  answer{shown}" if rows else f"{head}{shown}"


def _default_text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


_BOOLEANS = {"y": True, "yes": True, "n": False, "no": False}


def _value(schema: Mapping[str, Any], text: str) -> Any:
    """Return the value of a text; one that stands for nothing is the input's to refuse."""
    kind = schema.get("type")
    if kind == "boolean":
        return _BOOLEANS.get(text.lower(), text)
    if kind == "string":
        return text
    with contextlib.suppress(ValueError):
        return float(text.replace(",", "."))
    return text


def _step_text(view: Mapping[str, Any]) -> str:
    commands = ", ".join(f":{one}" for one in view["can"])
    lines = ["", f"{view['number']}. {view['title']}  ({commands})", *_verdict_lines(view)]
    lines += textwrap.wrap(view["description"], WIDTH)
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
    """Return the lines of what came out; a warning begins with its code."""
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
        return "\naborted; what was measured stands in the journal"
    result = dict(view["result"])
    use, remarks = result.pop("use", {}), result.pop("remarks", [])
    rows = [f"  {name}: {_result_text(value)}" for name, value in result.items()]
    for one in remarks:
        rows += _note_lines(one if isinstance(one, str) else ": ".join(one))
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
    return table_text(head, [_listed(row) for row in rows])


def _listed(row: Mapping[str, Any]) -> tuple[str, ...]:
    if row["problem"] is not None:
        return row["name"], "-", "-", "-", f"cannot be read: {row['problem']}"
    error = "not known" if row["held_out_mm"] is None else f"{row['held_out_mm']:.2f} mm rms"
    said = "stale" if row["stale"] else "still true"
    check = "none" if row["checked_at"] is None else f"{_minute(row['checked_at'])}: {said}"
    return row["name"], row["kind"], _minute(row["written_at"]), error, check


def _minute(at: str) -> str:
    return at[:16].replace("T", " ")


# ---------------------------------------------------------------------- standard input


class Lines:
    """Lines of standard input, one when it is asked for; the event loop goes on meanwhile.

    A thread waits for each. It reads the descriptor itself: one that is left waiting in Python's
    own buffer at the end would stop the interpreter from ending.
    """

    def __init__(self) -> None:
        self._buffer = b""

    async def next(self) -> str:
        """Return the next line without its end; ConfigurationError: there is none.

        Cancellation: the thread goes on waiting, and ends with the process.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[str] = loop.create_future()

        def tell(line: str) -> None:
            if not future.done():
                future.set_result(line)

        def wait() -> None:
            line = self._read()
            with contextlib.suppress(RuntimeError):  # the loop was closed meanwhile
                loop.call_soon_threadsafe(tell, line)

        threading.Thread(target=wait, name="stdin", daemon=True).start()
        line = await future
        if not line:
            raise ConfigurationError(
                "the input has ended before the calibration has; what was done is kept: "
                "the same command goes on with it"
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
