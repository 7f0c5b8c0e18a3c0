"""``smartcam probe``: find out the transport and dialect of a camera."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import CONNECT_WARNING, OUTPUT_OPTIONS, Options, async_command, option

if TYPE_CHECKING:
    from smartcam.doctor._inside import CameraAnswer, Trial
    from smartcam.observers import TraceEntry

MAX_HEX_DIGITS = 128
"""Largest number of hex digits of a frame on a line; ``--json`` and ``--trace`` have all."""


@click.command(
    help="Find out how a camera speaks; HOST or URL. Tries the URL's options, then every protocol, "
    f"transport and dialect, the most probable first, until one is answered. {CONNECT_WARNING}"
)
@click.argument("host_or_url")
@click.option("--all", "try_all", is_flag=True, help="Try the rest, too, after one is answered.")
@option(
    "--timeout",
    help="Longest time of all tries together (default 10); each gets an equal share of the rest.",
)
@async_command("--trace", *OUTPUT_OPTIONS)
async def probe(host_or_url: str, try_all: bool, options: Options) -> None:
    """Try protocols, transports and dialects, one after the other on fresh links.

    Raises ConnectFailedError: no try was answered; the error names each try.
    """
    from smartcam.doctor._inside import no_session, trials
    from smartcam.settings import parse_address

    address = parse_address(host_or_url)
    answers: list[CameraAnswer] = []
    failed_trials: list[Trial] = []
    with options.open_trace(host_or_url) as trace:
        timeout = options.step_timeout(10.0)
        tries = trials(
            address,
            timeout=timeout,
            trace=trace,
            continue_after_answer=try_all,
            every_protocol=True,
        )
        async with aclosing(tries):
            async for trial in tries:
                _show_trial(trial, options)
                if trial.answer is not None:
                    answers.append(trial.answer)
                else:
                    failed_trials.append(trial)
    if not answers:
        raise no_session(host_or_url, address, failed_trials)
    _show_answers(answers, options)


def frame_text(entry: TraceEntry) -> str:
    """Return an entry as a line: message, fields, bytes; broken bytes also as characters."""
    data = entry.hex[:MAX_HEX_DIGITS] + ("..." if len(entry.hex) > MAX_HEX_DIGITS else "")
    if entry.direction != "!":
        fields = ", ".join(f"{name}={value}" for name, value in (entry.fields or {}).items())
        return f"{entry.direction} {entry.message}({fields})  {data}"
    raw = bytes.fromhex(entry.hex)[: MAX_HEX_DIGITS // 2]
    text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in raw)
    return f"! {entry.message}" + (f"  {data}  '{text}'" if raw else "")


def _show_trial(trial: Trial, options: Options) -> None:
    names = ("transport", "dialect", "step", "outcome", "frames", "omitted")
    address = {"protocol": trial.address.protocol, "port": trial.address.port}
    value = {**address, **{name: getattr(trial, name) for name in names}}
    outcome = f"{trial.step}: {trial.outcome}" if trial.answer is None else "a camera answers"
    of = (
        f"{trial.address.protocol} at port {trial.address.port}: "
        if trial.is_other_protocol
        else ""
    )
    lines = [f"{of}{trial.transport} {trial.dialect}: {outcome}"]
    lines += [f"  {frame_text(entry)}" for entry in trial.frames]
    if trial.omitted:
        lines.append(f"  ... and {trial.omitted} more")
    options.show(value, "\n".join(lines))


def _show_answers(answers: list[CameraAnswer], options: Options) -> None:
    first, *others = answers
    lines = [
        f"status: {first.status}",
        *(f"also: {answer.url}" for answer in others),
        f"use: {first.url}",
    ]
    value = {
        "url": first.url,
        "status": first.status,
        "protocol_version": first.protocol_version,
        "application": first.application,
        "also": [answer.url for answer in others],
    }
    options.show(value, "\n".join(lines))
