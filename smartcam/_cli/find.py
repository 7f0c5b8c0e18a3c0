"""``smartcam find``: find addresses of a network that listen on the ports of cameras."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import re
import sys
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command
from smartcam._cli.texts import table_text
from smartcam._extras import from_part

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterable, Mapping, Sequence

    from smartcam.doctor._inside import CameraSearch, FoundPort

DEFAULT_ADDRESSES, MAX_ADDRESSES = 65_536, 1 << 24
MAX_OPEN_CONNECTIONS, MAX_OPENINGS_PER_SECOND, MAX_SECONDS = 1_000, 10_000.0, 60.0
"""Limits of a search; the library has the same, but ``--help`` must not import it."""

PERIOD = 1.0
"""Seconds between two updates of the progress line."""

DISTURBANCE_WARNING = (
    "A camera of {} may drop its client when another one connects, as this search does: keep "
    "away from cameras at work with --exclude or --fleet."
)
"""The warning about open ports of cameras that serve one client."""

_EVIDENCE_TEXTS = {
    "greeted": "greets as {protocols}: {greeting}",
    "silent": "silent, as {protocols} is before a client speaks",
    "said": "may be {protocols}: {greeting}",
    "ended": "closes the connection at once: {protocols} with another client, or another service",
}
"""The text about the received bytes, by kind of evidence."""


@click.command(
    help="Find cameras in networks: opens the protocols' ports, sends nothing, and shows "
    "greetings. NETWORK: 192.168.0.0/24, 192.168.0.10-20, an address, a host's name; several "
    "may be given. Cameras that speak UDP are not found."
)
@click.argument("networks", metavar="NETWORK...", nargs=-1, required=True)
@click.option(
    "--port",
    "ports",
    type=click.IntRange(1, 0xFFFF),
    multiple=True,
    help="Also open this port, for each protocol; repeatable.",
)
@click.option(
    "--protocol",
    "protocols",
    multiple=True,
    metavar="NAME",
    help='Only look for this protocol, see "smartcam protocols"; repeatable.',
)
@click.option(
    "--fleet",
    "fleet_file",
    type=click.Path(dir_okay=False),
    metavar="FILE",
    help="A fleet file, whose cameras are listed by name, and not touched.",
)
@click.option("--exclude", multiple=True, metavar="NETWORK", help="Do not touch these; repeatable.")
@click.option(
    "--may-disturb",
    is_flag=True,
    help="Allow --ask to take cameras from their clients.",
)
@click.option(
    "--ask",
    is_flag=True,
    help='Also ask the cameras found, as "smartcam probe" does. That takes a camera from its '
    "client, so it needs --may-disturb, or --protocol for cameras that serve several.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0, MAX_OPENINGS_PER_SECOND, min_open=True),
    default=100.0,
    show_default=True,
    help="Largest number of openings per second.",
)
@click.option(
    "--at-once",
    type=click.IntRange(1, MAX_OPEN_CONNECTIONS),
    default=64,
    show_default=True,
    help="Largest number of connections at a time.",
)
@click.option(
    "--timeout",
    "port_timeout",
    type=click.FloatRange(0, MAX_SECONDS, min_open=True),
    default=1.0,
    show_default=True,
    help="Seconds to wait for a connection, and again as many for a greeting.",
)
@click.option(
    "--max-addresses",
    type=click.IntRange(1, MAX_ADDRESSES),
    default=DEFAULT_ADDRESSES,
    show_default=True,
    help="Refuse more.",
)
@click.option("--yaml", "as_yaml", is_flag=True, help="Print cameras as entries of a fleet file.")
@async_command(*OUTPUT_OPTIONS)
async def find(
    networks: tuple[str, ...],
    ports: tuple[int, ...],
    protocols: tuple[str, ...],
    fleet_file: str | None,
    exclude: tuple[str, ...],
    port_timeout: float,
    options: Options,
    as_yaml: bool,
    **search_options: Any,
) -> None:
    """Search, and show what was found; also after Ctrl-C.

    Raises ConfigurationError: an argument is wrong, or consent is missing.
    """
    from smartcam.doctor._inside import CameraSearch

    if as_yaml and options.as_json:
        raise click.UsageError("--json and --yaml do not go together")
    fleet_cameras: dict[str, dict[str, str]] = {}
    used_names: set[str] = set()
    if fleet_file is not None:
        fleet_cameras, used_names = await asyncio.to_thread(_fleet_cameras, fleet_file)
    search = CameraSearch(
        networks,
        ports=ports,
        protocols=protocols or None,
        exclude=[*exclude, *fleet_cameras],
        timeout=port_timeout,
        **search_options,
    )
    try:
        async with show_progress_line(search):
            await search.run()
    finally:
        if search.has_begun:
            left_alone = {
                host: fleet_cameras[text]
                for host, text in search.excluded.items()
                if text in fleet_cameras
            }
            if as_yaml:
                click.echo("\n".join(fleet_lines(search.results(), used_names)))
            else:
                _show_findings(search.results(), left_alone, options)
            click.echo(summary(search), err=True)


def _fleet_cameras(path: str) -> tuple[dict[str, dict[str, str]], set[str]]:
    """Return the URLs of a fleet file's cameras by host and name, and the names of all cameras."""
    with from_part("fleet", "a fleet file needs"):
        from smartcam.fleet import load_fleet
    from smartcam.settings import parse_address

    cameras: dict[str, dict[str, str]] = {}
    plan = load_fleet(path).plan()
    for planned in plan:
        if planned.entry.url is not None:
            address = parse_address(planned.entry.url, model=planned.entry.model)
            cameras.setdefault(address.host, {})[planned.name] = address.url
    return cameras, {planned.name for planned in plan}


# ---------------------------------------------------------------------- showing


def _show_findings(
    ports: Sequence[FoundPort], left_alone: Mapping[str, Mapping[str, str]], options: Options
) -> None:
    """Print the open ports, and the addresses that were left alone, as a table or as JSON."""
    if options.as_json:
        for port in ports:
            value = {name: getattr(port, name) for name in port.__dataclass_fields__}
            value["said"] = value.pop("received")
            options.show({**value, "greeting": port.greeting, "urls": port.urls}, "")
        for host, cameras in left_alone.items():
            for name, url in cameras.items():
                options.show({"host": host, "url": url, "fleet_camera": name}, "")
    elif ports or left_alone:
        rows = [
            (
                port.host,
                str(port.port),
                ", ".join(port.protocols) or "-",
                f"{port.seconds * 1e3:.1f} ms",
                evidence_text(port),
            )
            for port in ports
        ]
        rows += [
            (host, "", "", "", f"not touched: it is {' and '.join(cameras)} of the fleet")
            for host, cameras in left_alone.items()
        ]
        click.echo(table_text(("host", "port", "protocol", "opened", "what is known"), rows))


def evidence_text(port: FoundPort) -> str:
    """Return a line about the device at an open port."""
    if port.answer is not None:
        return f"a camera answers: {port.answer.url}"
    if port.evidence == "other":
        greeting = f"it says {port.greeting!r:.60}" if port.received else "it does not greet"
        return f"another service: {greeting}"
    protocols = " or ".join(port.protocols)
    text = _EVIDENCE_TEXTS[port.evidence].format(protocols=protocols, greeting=port.greeting[:60])
    return f"{text}; asked: {port.refusal}" if port.refusal else text


def summary(search: CameraSearch) -> str:
    """Return the outcome of the search as text."""
    outcomes = ("open", "refused", "no answer", "unreachable", "failed")
    outcome_counts = [f"{search.counts[name]} {name}" for name in outcomes if search.counts[name]]
    text = f"{search.tried} of {search.total} ports tried: {', '.join(outcome_counts) or 'none'}"
    if search.failure:
        text += f" (failed: {search.failure})"
    text += ". Cameras that are set to UDP do not show."
    if search.exclusive:
        text += f" {DISTURBANCE_WARNING.format(' or '.join(search.exclusive))}"
    return text


def fleet_lines(ports: Iterable[FoundPort], used_names: Iterable[str] = ()) -> list[str]:
    """Return lines for a fleet file; a port that may not be a camera's becomes a comment.

    ``used_names``: names of the fleet's cameras, which no line may use.
    """
    names, lines = set(used_names), ["cameras:"]
    any_certain = False
    for port in ports:
        for index, url in enumerate(port.urls):
            name = _unused_name(port, names)
            is_certain = index == 0 and not port.refusal
            any_certain = any_certain or is_certain
            line = f'{name}: {{url: "{url}"}}'
            if is_certain:
                names.add(name)
            lines.append(f"  {'' if is_certain else '# '}{line}  # {evidence_text(port)}")
    if not any_certain:
        lines[0] = "# cameras: none was found"
    return lines


def _unused_name(port: FoundPort, used_names: set[str]) -> str:
    """Return a name made from a camera's address that is not used yet."""
    host = re.sub(r"[^a-z0-9]", "-", port.host.lower())
    base = f"found/{host}-{port.port}"
    names = itertools.chain((f"found/{host}", base), (f"{base}-{n}" for n in itertools.count(2)))
    return next(name for name in names if name not in used_names)


@contextlib.asynccontextmanager
async def show_progress_line(search: CameraSearch) -> AsyncIterator[None]:
    """Show a progress line on stderr while the block runs, if stderr is a terminal."""
    if not sys.stderr.isatty() or os.environ.get("TERM") == "dumb":
        yield
        return
    task = asyncio.create_task(_show_progress(search), name="smartcam.find.telling")
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        click.echo("\r\x1b[K", err=True, nl=False)


async def _show_progress(search: CameraSearch) -> None:
    while True:
        await asyncio.sleep(PERIOD)
        text = f"{search.tried} of {search.total} ports, {search.counts['open']} open"
        click.echo(f"\r\x1b[K{text}", err=True, nl=False)
