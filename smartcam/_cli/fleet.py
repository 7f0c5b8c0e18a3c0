"""``smartcam fleet``: all cameras of a fleet, or those of a pattern."""

from __future__ import annotations

import asyncio
import contextlib
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.fleet_certificates import certificates
from smartcam._cli.options import OUTPUT, Options, from_hex, runs
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.running import exit_code, first
from smartcam._cli.terminal import tinted
from smartcam._cli.texts import result_text, table_text
from smartcam._cli.usage import JsonErrors, error_json
from smartcam.backoff import Backoff
from smartcam.exceptions import ConnectFailedError, SmartCamError

if TYPE_CHECKING:
    from collections.abc import AsyncGenerator

    from smartcam.fleet import CameraSummary, Fleet, FleetEvent, FleetResults
    from smartcam.models import Result
    from smartcam.streams import Subscription

_EVENTS = {
    "AgentJoined": "agent {agent}: is there",
    "AgentLeft": "agent {agent}: is gone",
    "CameraJoined": "{camera}: shared by agent {agent}",
    "CameraLeft": "{camera}: shared no more by agent {agent}",
}
"""What is said of an event, by the name of its class."""

_READING = ("--interpret-as", "--y-down", "--calibration")


class FleetCommands(JsonErrors, click.Group):
    """Its commands tell a wrong use as JSON, too."""


@click.group(
    cls=FleetCommands,
    help="Show and use the cameras of a fleet together. URL is fleet://HOST[:PORT], or a fleet "
    "file: then agent and cameras are in this process, for this command only. PATTERN means "
    "cameras by their names: * is one part of a name, ** any number of them; default all. Needs "
    'the extra "fleet", but for a file.',
)
def fleet() -> None:
    """Have the commands of a fleet."""


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
        found = [_camera(opened, name, known.get(name)) for name in opened.names(pattern)]
        warning = opened.warning
    if warning:
        click.echo(f"{tinted('error', 'warning:')} {warning}", err=True)
    if options.as_json:
        for value in found:
            options.show(value, "")
        return
    if not found:
        click.echo(f"no camera of the fleet is {pattern}")
        return
    head = ("camera", "agent", "application", "status", "url")
    click.echo(table_text(head, [_row(value) for value in found]))
    for value in found:
        if value["reason"] is not None:
            click.echo(value["reason"])


def _camera(opened: Fleet, name: str, known: CameraSummary | None) -> dict[str, Any]:
    """Return what is known of a camera, for JSON."""
    there = known is not None and known.connected
    return {
        "camera": name,
        "agents": opened.agents(name) if known is None else [known.agent],
        "connected": there,
        "application": known.application if known is not None and there else None,
        "status": known.status if known is not None and there else None,
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
        jobs = [_show_results(results, options), _show_events(events, pattern, options)]
        await first(jobs, options.seconds)


async def _show_results(results: FleetResults[Any], options: Options) -> None:
    done = 0
    async for result in results:
        options.show(result, _named_text)
        done += 1
        if done == options.count:
            return


async def _show_events(events: Subscription[FleetEvent], pattern: str, options: Options) -> None:
    from smartcam.fleet._keys import meets
    from smartcam.models import jsonable

    async for event in events:
        fields: dict[str, Any] = jsonable(event)
        if meets(pattern, fields.get("camera", pattern)):
            kind = type(event).__name__
            options.show({"event": kind, **fields}, _EVENTS[kind].format(**fields))


def _named_text(result: Result) -> str:
    return f"{result.camera}: {result_text(result)}"


# ---------------------------------------------------------------------- reload


@fleet.command(
    help="Have the agents of a fleet read their fleet files again. Cameras that did not change go "
    "on; a file that is wrong leaves all as it was. Prints what has changed, one line per agent. "
    "Exit code: 0 if all did it, else that of the first error."
)
@click.argument("url")
@click.option("--agent", metavar="NAME", help="This one only.")
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


# ---------------------------------------------------------------------- page


@fleet.command(
    help="Serve a page of all cameras until Ctrl-C: state, rate, last result, outcomes, errors, "
    "and a page for each. The page's address goes to stdout. A fleet of which no agent is there is "
    'awaited. Needs the extra "web", too.'
)
@click.argument("url")
@click.option(
    "--control", is_flag=True, help="The pages may trigger, start, stop and switch applications."
)
@page_options("", always=True)
@runs(*_READING, "--seconds", "--timeout", *OUTPUT, interrupted=0, terminated=0)
async def page(url: str, control: bool, web: PageOptions, options: Options) -> None:
    from smartcam.web import FleetSite

    with contextlib.suppress(TimeoutError):  # --seconds are over
        async with (
            asyncio.timeout(options.seconds),
            contextlib.AsyncExitStack() as stack,
        ):
            opened = await stack.enter_async_context(_awaited(url, options))
            site = FleetSite(opened, control=control, **web.place)
            await stack.enter_async_context(site)
            options.show({"page": site.url}, f"page: {site.url}")
            await asyncio.Event().wait()


@contextlib.asynccontextmanager
async def _awaited(url: str, options: Options) -> AsyncGenerator[Fleet]:
    """Have the fleet open, once an agent of it is there."""
    told = False
    for delay in Backoff(maximum=2.0).delays():
        opened = _opened(url, options)
        try:
            await opened.open()
        except ConnectFailedError as exc:
            if not told:
                click.echo(f"{exc}; it is awaited", err=True)
            told = True
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
            options.show(outcome, _named_text)
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
