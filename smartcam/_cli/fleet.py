"""``smartcam fleet``: commands for all cameras of a fleet, or for those that match a pattern."""

from __future__ import annotations

import asyncio
import contextlib
import functools
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.fleet_certificates import certificates
from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, from_hex
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import exit_code, run_until_first
from smartcam._cli.terminal import coloured
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

_EVENT_TEXTS = {
    "AgentJoined": "agent {agent}: is there",
    "AgentLeft": "agent {agent}: is gone",
    "CameraJoined": "{camera}: shared by agent {agent}",
    "CameraLeft": "{camera}: shared no more by agent {agent}",
}
"""The text for an event, by the name of its class."""

_VALUE_OPTIONS = ("--interpret-as", "--y-down", "--calibration", "--units")


@click.group(
    cls=ListedGroup,
    help="Show and use the cameras of a fleet together. URL is fleet://HOST[:PORT], or a fleet "
    "file, whose agent and cameras then run in this process, for this command only. PATTERN "
    "selects cameras by their names: * is one part of a name, ** any number of them; default "
    'all. A URL needs the extra "fleet".',
)
def fleet() -> None:
    """Register the commands of a fleet."""


fleet.add_command(certificates)


def _make_fleet(url: str, options: Options) -> Fleet:
    from smartcam.fleet import open

    return open(
        url, connect_timeout=options.step_timeout(10.0), **options.interpret_options(fleet=True)
    )


def _require_cameras(fleet: Fleet) -> None:
    """Raise ConnectFailedError if the fleet has no cameras."""
    if not len(fleet):
        raise ConnectFailedError(f"{fleet.url}: no agent shares a camera")


# ---------------------------------------------------------------------- list


@fleet.command(name="list", help="List the cameras, and which have no session with their agents.")
@click.argument("url")
@click.argument("pattern", default="**")
@async_command("--timeout", *OUTPUT_OPTIONS)
async def list_(url: str, pattern: str, options: Options) -> None:
    async with _make_fleet(url, options) as fleet:
        _require_cameras(fleet)
        summaries = await fleet.status(pattern)
        cameras = [_camera_data(fleet, name, summaries.get(name)) for name in fleet.names(pattern)]
        warning = fleet.warning
    if warning:
        click.echo(f"{coloured('error', 'warning:')} {warning}", err=True)
    if options.as_json:
        for value in cameras:
            options.show(value, "")
        return
    if not cameras:
        click.echo(f"no camera of the fleet matches {pattern}")
        return
    head = ("camera", "agent", "application", "status", "url")
    click.echo(table_text(head, [_camera_row(value) for value in cameras]))
    for value in cameras:
        if value["reason"] is not None:
            click.echo(value["reason"])


def _camera_data(fleet: Fleet, name: str, summary: CameraSummary | None) -> dict[str, Any]:
    """Return the state of a fleet's camera as values for JSON."""
    is_connected = summary is not None and summary.connected
    return {
        "camera": name,
        "agents": fleet.agents(name) if summary is None else [summary.agent],
        "connected": is_connected,
        "application": summary.application if summary is not None and is_connected else None,
        "status": summary.status if summary is not None and is_connected else None,
        "url": fleet.url_of(name),
        "reason": _missing_reason(name, summary),
    }


def _missing_reason(name: str, summary: CameraSummary | None) -> str | None:
    if summary is None:
        return f"{name}: its agent does not answer"
    if summary.reason is None:
        return None
    return f"{name}: the agent has no session with the camera: {summary.reason}"


def _camera_row(value: dict[str, Any]) -> tuple[str, ...]:
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
@async_command(
    *_VALUE_OPTIONS, "--count", "--seconds", "--timeout", *OUTPUT_OPTIONS, interrupt_code=0
)
async def watch(url: str, pattern: str, options: Options) -> None:
    async with _make_fleet(url, options) as fleet:
        results, events = fleet.results(pattern), fleet.events()
        jobs = [_show_results(fleet, results, options), _show_events(events, pattern, options)]
        await run_until_first(jobs, options.seconds)


async def _show_results(fleet: Fleet, results: FleetResults[Any], options: Options) -> None:
    count, make_text = 0, options.result_text()
    async for result in results:
        options.show(result, functools.partial(_camera_result_text, fleet, make_text))
        count += 1
        if count == options.count:
            return


async def _show_events(events: Subscription[FleetEvent], pattern: str, options: Options) -> None:
    from smartcam.fleet._inside import patterns_overlap
    from smartcam.models import jsonable

    async for event in events:
        fields: dict[str, Any] = jsonable(event)
        if patterns_overlap(pattern, fields.get("camera", pattern)):
            kind = type(event).__name__
            options.show({"event": kind, **fields}, _EVENT_TEXTS[kind].format(**fields))


def _camera_result_text(
    fleet: Fleet, make_text: Callable[[Camera, Result], str], result: Result
) -> str:
    return f"{result.camera}: {make_text(fleet[result.camera], result)}"


# ---------------------------------------------------------------------- reload


@fleet.command(
    help="Have the agents of a fleet read their fleet files again. Unchanged cameras go on; a "
    "wrong file changes nothing. Prints the changes, one line per agent. Exit code: 0 if all "
    "agents succeed, else that of the first error."
)
@click.argument("url")
@click.option("--agent", metavar="NAME", help="Only this agent.")
@async_command("--timeout", *OUTPUT_OPTIONS)
async def reload(url: str, agent: str | None, options: Options) -> None:
    async with _make_fleet(url, options) as fleet:
        outcomes = await fleet.reload(agent, timeout=options.step_timeout(30.0))
    if not outcomes:
        raise ConnectFailedError(f"{fleet.url}: no agent answers")
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
    help="Show the counts of outlets: results = delivered + spooled + dropped. URL: asks the "
    "agents of a fleet; FLEET.yaml: reads the spools of the outlets in the file, with or "
    "without a running agent."
)
@click.argument("url_or_file", metavar="URL|FLEET.yaml")
@async_command("--timeout", *OUTPUT_OPTIONS)
async def outlets(url_or_file: str, options: Options) -> None:
    if "://" in url_or_file:
        await _ask_outlets(url_or_file, options)
        return
    from pathlib import Path

    from smartcam.fleet import load_fleet

    with from_part("mqtt", '"fleet outlets" needs'):
        from smartcam.outlets._inside import stored_counts

    section = load_fleet(url_or_file).outlets or {}
    rows: list[tuple[str, ...]] = []
    for name, account in stored_counts(section, Path(url_or_file).parent).items():
        fields = {} if account is None else account.fields()
        if options.as_json:
            options.show({"outlet": name, "counts": fields or None}, "")
        rows.append((name, *_counts_row(fields)))
    if not options.as_json:
        head = ("outlet", "results", "delivered", "spooled", "dropped")
        click.echo(table_text(head, rows) if rows else "the file has no outlets")


def _counts_row(fields: dict[str, Any]) -> tuple[str, ...]:
    dropped = ", ".join(f"{count} {reason}" for reason, count in fields.get("dropped", {}).items())
    numbers = [str(fields.get(key, "")) for key in ("results", "delivered", "spooled")]
    return (*numbers, dropped or "0" if fields else "no spool yet")


async def _ask_outlets(url: str, options: Options) -> None:
    """Ask a fleet's agents for the counts of their outlets, and show them."""
    async with _make_fleet(url, options) as fleet:
        outlets = await fleet.outlets(timeout=options.step_timeout(5.0))
    if options.as_json:
        for outlet in outlets:
            counts = outlet._asdict()
            labels = {key: counts.pop(key) for key in ("agent", "outlet", "trouble")}
            options.show({**labels, "counts": counts}, "")
        return
    rows = [
        (outlet.agent, outlet.outlet, *_counts_row(outlet._asdict()), outlet.trouble or "well")
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
@async_command("--timeout", *OUTPUT_OPTIONS)
async def take_back(url: str, camera: str, options: Options) -> None:
    async with _make_fleet(url, options) as fleet:
        await fleet[camera].take_back(timeout=options.step_timeout(10.0))
    options.show({"camera": camera, "connected": True}, f"{camera}: its agent has a session")


# ---------------------------------------------------------------------- page


@fleet.command(
    help="Serve a page of all cameras until Ctrl-C: state, rate, last result, outcomes, errors, "
    "and a page for each. The page's address goes to stdout. If no agent runs yet, the command "
    'waits for one. Needs the extra "web", too.'
)
@click.argument("url")
@click.option(
    "--control", is_flag=True, help="The pages may trigger, start, stop and switch applications."
)
@page_options(always=True)
@async_command(
    *_VALUE_OPTIONS, "--seconds", "--timeout", *OUTPUT_OPTIONS, interrupt_code=0, terminate_code=0
)
async def page(url: str, control: bool, web: PageOptions, options: Options) -> None:
    from smartcam.web import FleetSite

    units = options.unit_names
    with contextlib.suppress(TimeoutError):  # the time of --seconds is over
        async with (
            asyncio.timeout(options.seconds),
            contextlib.AsyncExitStack() as stack,
        ):
            fleet = await stack.enter_async_context(_wait_for_fleet(url, options))
            site = FleetSite(fleet, control=control, units=units, **web.site_arguments)
            await stack.enter_async_context(site)
            options.show({"page": site.url}, f"page: {site.url}")
            await asyncio.Event().wait()


@contextlib.asynccontextmanager
async def _wait_for_fleet(url: str, options: Options) -> AsyncGenerator[Fleet]:
    """Try to open the fleet until one of its agents answers, then yield it."""
    warned = False
    for delay in Backoff(maximum=2.0).delays():
        fleet = _make_fleet(url, options)
        try:
            await fleet.open()
        except ConnectFailedError as exc:
            if not warned:
                click.echo(f"{exc}; waiting for it", err=True)
            warned = True
        else:
            try:
                yield fleet
            finally:
                await fleet.close()
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
@async_command(*_VALUE_OPTIONS, "--timeout", *OUTPUT_OPTIONS)
async def trigger(url: str, pattern: str, input_hex: str | None, options: Options) -> None:
    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT

    make_text = options.result_text()
    data = None if input_hex is None else from_hex(input_hex, "--input")
    timeout = options.step_timeout(DEFAULT_TRIGGER_TIMEOUT)
    async with _make_fleet(url, options) as fleet:
        _require_cameras(fleet)
        outcomes = await fleet.trigger(pattern, timeout=timeout, input=data)
        codes: list[int] = []
        for name, outcome in sorted(outcomes.items()):
            if isinstance(outcome, SmartCamError):
                codes.append(exit_code(outcome))
                _show_error(name, outcome, codes[-1], options)
            else:
                options.show(outcome, functools.partial(_camera_result_text, fleet, make_text))
    if codes:
        raise SystemExit(codes[0])


def _show_error(
    name: str, error: SmartCamError, code: int, options: Options, kind: str = "camera"
) -> None:
    text = str(error)
    if options.as_json:
        click.echo(error_json(error, text, code, **{kind: name}))
    else:
        click.echo(f"{name}: {coloured('error', 'error:')} {text.removeprefix(f'{name}: ')}")
