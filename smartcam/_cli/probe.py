"""``smartcam probe``: find out the transport and dialect of a camera."""

from __future__ import annotations

from contextlib import aclosing
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import CONNECT_WARNING, OUTPUT_OPTIONS, Options, async_command, option

if TYPE_CHECKING:
    from smartcam.doctor._inside import CameraAnswer, TracedAttempt
    from smartcam.observers import TraceEntry

MAX_HEX_DIGITS = 128
"""Largest number of hex digits of a frame on a line; ``--json`` and ``--trace`` have all."""


@click.command(
    help="Find out how the camera at HOST or URL speaks. Tries the URL's options, then every "
    "protocol, transport and dialect, the most probable first, until one is answered. "
    f"{CONNECT_WARNING}"
)
@click.argument("host_or_url")
@click.option("--all", "try_all", is_flag=True, help="Try the rest, too, after one is answered.")
@option(
    "--timeout",
    help="Longest time of all attempts together (default 10); each gets an equal share.",
)
@async_command("--trace", *OUTPUT_OPTIONS)
async def probe(host_or_url: str, try_all: bool, options: Options) -> None:
    """Try protocols, transports and dialects, one after the other on fresh links.

    Raises ConnectFailedError: no attempt was answered; the error names each attempt.
    """
    from smartcam.doctor._inside import no_session, try_ways
    from smartcam.settings import parse_address

    address = parse_address(host_or_url)
    answers: list[CameraAnswer] = []
    failed_attempts: list[TracedAttempt] = []
    with options.open_trace(host_or_url) as trace:
        timeout = options.step_timeout(10.0)
        attempts = try_ways(
            address,
            timeout=timeout,
            trace=trace,
            continue_after_answer=try_all,
            every_protocol=True,
        )
        async with aclosing(attempts):
            async for attempt in attempts:
                _show_attempt(attempt, options)
                if attempt.answer is not None:
                    answers.append(attempt.answer)
                else:
                    failed_attempts.append(attempt)
    if not answers:
        raise no_session(host_or_url, address, failed_attempts)
    _show_answers(answers, options)


def frame_text(entry: TraceEntry) -> str:
    """Return an entry as a line: message, fields, bytes; invalid bytes also as characters."""
    data = entry.hex[:MAX_HEX_DIGITS] + ("..." if len(entry.hex) > MAX_HEX_DIGITS else "")
    if entry.direction != "!":
        fields = ", ".join(f"{name}={value}" for name, value in (entry.fields or {}).items())
        return f"{entry.direction} {entry.message}({fields})  {data}"
    raw = bytes.fromhex(entry.hex)[: MAX_HEX_DIGITS // 2]
    text = "".join(chr(byte) if 0x20 <= byte < 0x7F else "." for byte in raw)
    return f"! {entry.message}" + (f"  {data}  '{text}'" if raw else "")


def _show_attempt(attempt: TracedAttempt, options: Options) -> None:
    names = ("transport", "dialect", "step", "outcome", "frames", "omitted")
    address = {"protocol": attempt.address.protocol, "port": attempt.address.port}
    value = {**address, **{name: getattr(attempt, name) for name in names}}
    outcome = f"{attempt.step}: {attempt.outcome}" if attempt.answer is None else "a camera answers"
    prefix = (
        f"{attempt.address.protocol} at port {attempt.address.port}: "
        if attempt.is_other_protocol
        else ""
    )
    lines = [f"{prefix}{attempt.transport} {attempt.dialect}: {outcome}"]
    lines += [f"  {frame_text(entry)}" for entry in attempt.frames]
    if attempt.omitted:
        lines.append(f"  ... and {attempt.omitted} more")
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
