"""``smartcam fleet``: commands for all cameras of a fleet, or for those that match a pattern."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.fleet_certificates import certificates
from smartcam._cli.options import OUTPUT, Options, from_hex, runs
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import exit_code, first
from smartcam._cli.terminal import tinted
from smartcam._cli.texts import table_text
from smartcam._cli.usage import ListedGroup, error_json
from smartcam._extras import from_part
from smartcam.backoff import Backoff
from smartcam.exceptions import ConnectFailedError, SmartCamError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator, Callable

    from smartcam.camera import Camera
    from smartcam.fleet import Fleet, FleetEvent
    from smartcam.fleet._inside import CameraSummary, FleetResults
    from smartcam.models import Result
    from smartcam.streams import Subscription

_EVENTS = {
    "AgentJoined": "agent {agent}: is there",
    "AgentLeft": "agent {agent}: is gone",
    "CameraJoined": "{camera}: shared by agent {agent}",
    "CameraLeft": "{camera}: shared no more by agent {agent}",
}
"""The text for an event, by the name of its class."""

_READING = ("--interpret-as", "--y-down", "--calibration", "--units")


@click.group(
    cls=ListedGroup,
    help="Show and use the cameras of a fleet together. URL is fleet://HOST[:PORT], or a fleet "
    "file, whose agent and cameras then run in this process, for this command only. PATTERN "
    "selects cameras by their names: * is one part of a name, ** any number of them; default "
    'all. Needs the extra "fleet", but for a file.',
)
def fleet() -> None:
    """Register the commands of a fleet."""


fleet.add_command(certificates)


def _opened(url: str, options: Options) -> Fleet:
    from smartcam.fleet import open

    return open(url, connect_timeout=options.step(10.0), **options.reading(fleet=True))


def _require_cameras(opened: Fleet) -> None:
    if not len(opened):
        raise ConnectFailedError(f"no agent of {opened.url} is there")


# ---------------------------------------------------------------------- list


@fleet.command(name="list", help="List the cameras, and which have no session with their agents.")
@click.argument("url")
@click.argument("pattern", default="**")
@runs("--timeout", *OUTPUT)
async def list_(url: str, pattern: str, options: Options) -> None:
    async with _opened(url, options) as opened:
        _require_cameras(opened)
        known = await opened.status(pattern)
        cameras = [_camera(opened, name, known.get(name)) for name in opened.names(pattern)]
        warning = opened.warning
    if warning:
        click.echo(f"{tinted('error', 'warning:')} {warning}", err=True)
    if options.as_json:
        for value in cameras:
            options.show(value, "")
        return
    if not cameras:
        click.echo(f"no camera of the fleet is {pattern}")
        return
    head = ("camera", "agent", "application", "status", "url")
    click.echo(table_text(head, [_row(value) for value in cameras]))
    for value in cameras:
        if value["reason"] is not None:
            click.echo(value["reason"])


def _camera(opened: Fleet, name: str, known: CameraSummary | None) -> dict[str, Any]:
    """Return the state of a fleet's camera as values for JSON."""
    is_connected = known is not None and known.connected
    return {
        "camera": name,
        "agents": opened.agents(name) if known is None else [known.agent],
        "connected": is_connected,
        "application": known.application if known is not None and is_connected else None,
        "status": known.status if known is not None and is_connected else None,
        "url": opened.url_of(name),
        "reason": _reason(name, known),
    }


def _reason(name: str, known: CameraSummary | None) -> str | None:
    if known is None:
        return f"{name}: its agent does not answer"
    if known.reason is None:
        return None
    return f"{name}: the agent has no session with the camera: {known.reason}"


def _row(value: dict[str, Any]) -> tuple[str, ...]:
    application, status = "", "not connected"
    if value["connected"]:
        application, status = str(value["application"]), str(value["status"])
    return value["camera"], ", ".join(value["agents"]), application, status, value["url"]


# ---------------------------------------------------------------------- watch


@fleet.command(
    help="Print results of all cameras as they come, and which agents and cameras come and go, "
    "until Ctrl-C, --count results or --seconds."
)
@click.argument("url")
@click.argument("pattern", default="**")
@runs(*_READING, "--count", "--seconds", "--timeout", *OUTPUT, interrupted=0)
async def watch(url: str, pattern: str, options: Options) -> None:
    async with _opened(url, options) as opened:
        results, events = opened.results(pattern), opened.events()
        jobs = [_show_results(opened, results, options), _show_events(events, pattern, options)]
        await first(jobs, options.seconds)


async def _show_results(opened: Fleet, results: FleetResults[Any], options: Options) -> None:
    done, as_text = 0, options.result_text()
    async for result in results:
        options.show(result, functools.partial(_named_text, opened, as_text))
        done += 1
        if done == options.count:
            return


async def _show_events(events: Subscription[FleetEvent], pattern: str, options: Options) -> None:
    from smartcam.fleet._inside import meets
    from smartcam.models import jsonable

    async for event in events:
        fields: dict[str, Any] = jsonable(event)
        if meets(pattern, fields.get("camera", pattern)):
            kind = type(event).__name__
            options.show({"event": kind, **fields}, _EVENTS[kind].format(**fields))


def _named_text(opened: Fleet, as_text: Callable[[Camera, Result], str], result: Result) -> str:
    return f"{result.camera}: {as_text(opened[result.camera], result)}"


# ---------------------------------------------------------------------- reload


@fleet.command(
    help="Have the agents of a fleet read their fleet files again. Unchanged cameras go on; a "
    "wrong file changes nothing. Prints the changes, one line per agent. Exit code: 0 if all "
    "agents succeed, else that of the first error."
)
@click.argument("url")
@click.option("--agent", metavar="NAME", help="Only this agent.")
@runs("--timeout", *OUTPUT)
async def reload(url: str, agent: str | None, options: Options) -> None:
    async with _opened(url, options) as opened:
        outcomes = await opened.reload(agent, timeout=options.step(30.0))
    if not outcomes:
        raise ConnectFailedError(f"no agent of {opened.url} is there")
    codes: list[int] = []
    for name, outcome in outcomes.items():
        if isinstance(outcome, SmartCamError):
            codes.append(exit_code(outcome))
            _show_error(name, outcome, codes[-1], options, kind="agent")
        else:
            options.show(outcome, f"{name}: {outcome}")
    if codes:
        raise SystemExit(codes[0])


# ---------------------------------------------------------------------- outlets


@fleet.command(
    help="Show the accounts of outlets: results = delivered + spooled + dropped. PLACE is a "
    "fleet's URL, whose agents are asked, or a fleet file, whose spools are read, with or "
    "without a running agent."
)
@click.argument("place", metavar="URL|FLEET.yaml")
@runs("--timeout", *OUTPUT)
async def outlets(place: str, options: Options) -> None:
    if "://" in place:
        await _ask_outlets(place, options)
        return
    from pathlib import Path

    from smartcam.fleet import load_fleet

    with from_part("mqtt", '"fleet outlets" needs'):
        from smartcam.outlets._inside import stored_accounts

    section = load_fleet(place).outlets or {}
    rows: list[tuple[str, ...]] = []
    for name, account in stored_accounts(section, Path(place).parent).items():
        fields = {} if account is None else account.fields()
        if options.as_json:
            options.show({"outlet": name, "account": fields or None}, "")
        rows.append((name, *_account_row(fields)))
    if not options.as_json:
        head = ("outlet", "results", "delivered", "spooled", "dropped")
        click.echo(table_text(head, rows) if rows else "the file has no outlets")


def _account_row(fields: dict[str, Any]) -> tuple[str, ...]:
    dropped = ", ".join(f"{count} {why}" for why, count in fields.get("dropped", {}).items())
    numbers = [str(fields.get(key, "")) for key in ("results", "delivered", "spooled")]
    return (*numbers, dropped or "0" if fields else "no spool yet")


async def _ask_outlets(url: str, options: Options) -> None:
    """Show the counts of outlets that a fleet's agents report."""
    async with _opened(url, options) as opened:
        outlets = await opened.outlets(timeout=options.step(5.0))
    if options.as_json:
        for outlet in outlets:
            account = outlet._asdict()
            shown = {key: account.pop(key) for key in ("agent", "outlet", "trouble")}
            options.show({**shown, "account": account}, "")
        return
    rows = [
        (outlet.agent, outlet.outlet, *_account_row(outlet._asdict()), outlet.trouble or "well")
        for outlet in outlets
    ]
    head = ("agent", "outlet", "results", "delivered", "spooled", "dropped", "state")
    click.echo(table_text(head, rows) if rows else "no agent has outlets")


# ---------------------------------------------------------------------- take-back


@fleet.command(
    name="take-back",
    help="Have a camera's agent take it back from another client now. By itself it tries after "
    "30 s, then ever more seldom.",
)
@click.argument("url")
@click.argument("camera")
@runs("--timeout", *OUTPUT)
async def take_back(url: str, camera: str, options: Options) -> None:
    async with _opened(url, options) as opened:
        await opened[camera].take_back(timeout=options.step(10.0))
    options.show({"camera": camera, "connected": True}, f"{camera}: its agent has a session")


# ---------------------------------------------------------------------- page


@fleet.command(
    help="Serve a page of all cameras until Ctrl-C: state, rate, last result, outcomes, errors, "
    "and a page for each. The page's address goes to stdout. A fleet without a running agent "
    'is awaited. Needs the extra "web", too.'
)
@click.argument("url")
@click.option(
    "--control", is_flag=True, help="The pages may trigger, start, stop and switch applications."
)
@page_options(always=True)
@runs(*_READING, "--seconds", "--timeout", *OUTPUT, interrupted=0, terminated=0)
async def page(url: str, control: bool, web: PageOptions, options: Options) -> None:
    from smartcam.web import FleetSite

    units = options.unit_names
    with contextlib.suppress(TimeoutError):  # the time of --seconds is over
        async with (
            asyncio.timeout(options.seconds),
            contextlib.AsyncExitStack() as stack,
        ):
            opened = await stack.enter_async_context(_awaited(url, options))
            site = FleetSite(opened, control=control, units=units, **web.site_arguments)
            await stack.enter_async_context(site)
            options.show({"page": site.url}, f"page: {site.url}")
            await asyncio.Event().wait()


@contextlib.asynccontextmanager
async def _awaited(url: str, options: Options) -> AsyncGenerator[Fleet]:
    """Open the fleet, once it has an agent."""
    warned = False
    for delay in Backoff(maximum=2.0).delays():
        opened = _opened(url, options)
        try:
            await opened.open()
        except ConnectFailedError as exc:
            if not warned:
                click.echo(f"{exc}; it is awaited", err=True)
            warned = True
        else:
            try:
                yield opened
            finally:
                await opened.close()
            return
        await asyncio.sleep(delay)


# ---------------------------------------------------------------------- trigger


@fleet.command(
    help="Trigger all cameras at the same time, and print one outcome for each by name: its "
    "result, or why there is none. Exit code: 0 if all gave results, else that of the first error."
)
@click.argument("url")
@click.argument("pattern", default="**")
@click.option("--input", "input_hex", metavar="HEX", help="Input data for the inspections.")
@runs(*_READING, "--timeout", *OUTPUT)
async def trigger(url: str, pattern: str, input_hex: str | None, options: Options) -> None:
    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT

    as_text = options.result_text()
    data = None if input_hex is None else from_hex(input_hex, "--input")
    timeout = options.step(DEFAULT_TRIGGER_TIMEOUT)
    async with _opened(url, options) as opened:
        _require_cameras(opened)
        outcomes = await opened.trigger(pattern, timeout=timeout, input=data)
        codes: list[int] = []
        for name, outcome in sorted(outcomes.items()):
            if isinstance(outcome, SmartCamError):
                codes.append(exit_code(outcome))
                _show_error(name, outcome, codes[-1], options)
            else:
                options.show(outcome, functools.partial(_named_text, opened, as_text))
    if codes:
        raise SystemExit(codes[0])


def _show_error(
    name: str, error: SmartCamError, code: int, options: Options, kind: str = "camera"
) -> None:
    text = str(error)
    if options.as_json:
        click.echo(error_json(error, text, code, **{kind: name}))
    else:
        click.echo(f"{name}: {tinted('error', 'error:')} {text.removeprefix(f'{name}: ')}")
