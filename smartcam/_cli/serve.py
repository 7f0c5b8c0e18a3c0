"""``smartcam serve``: the agent of a fleet, which shares the cameras of a fleet file."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.options import OUTPUT, Options, runs
from smartcam._cli.terminal import tinted
from smartcam.models import Connected, Disconnected, Reconnected

if TYPE_CHECKING:
    from smartcam.fleet import FleetServer
    from smartcam.models import CameraEvent


@click.command(
    help="Have the sessions with the cameras of a fleet file, and share them with any number of "
    "programs, until Ctrl-C or SIGTERM. Prints one line per camera, its fleet URL, which every "
    "command takes that takes a camera's. A camera that is not there says so on its line, and is "
    "tried on; what comes and goes later is told on stderr, with --json on stdout, by the same "
    'object again. Needs the extra "fleet".'
)
@click.argument("file", required=False, metavar="FLEET.yaml")
@click.option("--schema", is_flag=True, help="Print the JSON Schema of fleet files, and end.")
@runs(*OUTPUT, interrupted=0, terminated=0)
async def serve(file: str | None, schema: bool, options: Options) -> None:
    """Share cameras."""
    import smartcam.fleet

    if schema:
        click.echo(json.dumps(smartcam.fleet.fleet_schema(), indent=2))
        return
    if file is None:
        raise click.UsageError("a fleet file is missing: smartcam serve FLEET.yaml, or --schema")
    async with smartcam.fleet.serve(file) as server:
        await server.wait_tried()
        if server.warning:
            click.echo(f"{tinted('error', 'warning:')} {server.warning}", err=True)
        events = server.events()
        for name in server.hosts:
            value = _camera(server, name)
            why = "" if value["connected"] else f"  not connected: {value['reason']}"
            options.show(value, f"{value['url']}{why}")
        async for event in events:
            tell(server, event, options)


def _camera(server: FleetServer, name: str) -> dict[str, Any]:
    """Return what is known of a camera, for JSON."""
    host = server.hosts[name]
    connected = host.connected
    failure = host.failure or "it is tried for the first time"
    return {
        "url": server.address.of(name).url,
        "name": name,
        "camera": host.camera.url,
        "connected": connected,
        "application": host.camera.active_application if connected else None,
        "reason": None if connected else str(failure).removeprefix(f"{name}: "),
    }


def tell(server: FleetServer, event: CameraEvent, options: Options) -> None:
    """Say that a camera has come, or is gone."""
    known = event.camera in server.hosts
    if not (known and isinstance(event, (Connected, Disconnected, Reconnected))):
        return
    value = _camera(server, event.camera)
    if isinstance(event, Disconnected):
        value |= {"connected": False, "application": None, "reason": event.reason}
        text = f"not connected: {event.reason}"
    else:
        value |= {"connected": True, "reason": None}
        text = "connected"
    if options.as_json:
        options.show({**value, "at": event.at}, "")
    else:
        click.echo(f"{event.at.astimezone():%H:%M:%S} {event.camera}: {text}", err=True)
