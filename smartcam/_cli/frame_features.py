"""``smartcam frames features`` and ``frames force-address``: features and address of a device."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.frame_sources import make_source
from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, option

if TYPE_CHECKING:
    from collections.abc import Sequence


@click.command(
    name="features",
    help="Read and set the features of a source's device: exposure time, gain, trigger and so on, "
    "by their names in GenICam's SFNC, of a GigE camera, a V4L2 device or a fleet's camera. "
    "Without a name, all are listed with value, range and unit. NAME shows one, NAME=VALUE "
    "sets it, in the given order; then come --load, --execute and --save.",
)
@click.argument("url")
@click.argument("features", nargs=-1, metavar="[NAME[=VALUE]]...")
@click.option("--load", metavar="SET", help="Have the device load a user set, such as Default.")
@click.option("--execute", multiple=True, metavar="COMMAND", help="Execute a command.")
@click.option("--save", metavar="SET", help="Have the device keep its features in a user set.")
@option("--timeout", help="Longest time for each feature, command or set.  [default: 10]")
@async_command(*OUTPUT_OPTIONS)
async def features_command(
    url: str,
    features: Sequence[str],
    load: str | None,
    execute: Sequence[str],
    save: str | None,
    options: Options,
) -> None:
    from smartcam.frames._inside import FEATURE_TIMEOUT
    from smartcam.models import jsonable

    seconds = options.step_timeout(FEATURE_TIMEOUT)
    async with make_source(url, options) as source:
        for argument in features:
            name, equals, value = argument.partition("=")
            feature = source.features[name]
            if equals:
                await feature.set(value, timeout=seconds)
            description = await feature.describe(timeout=seconds)
            options.show(jsonable(description), str(description))
        if load is not None:
            await source.features.load(load, timeout=seconds)
        for command in execute:
            await source.features[command].execute(timeout=seconds)
        if save is not None:
            await source.features.save(save, timeout=seconds)
        if not (features or load or execute or save):
            for description in (await source.features.describe()).values():
                options.show(jsonable(description), str(description))


@click.command(
    name="force-address",
    help="Give a GigE camera an IP address until it is switched off. MAC is its hardware address, "
    "ADDRESS is like 192.168.0.20/24. It also works if the camera's own address is outside "
    "of all networks here; `frames list` finds such a camera. No program may have the camera "
    "open. It asks first, unless there is --yes.",
)
@click.argument("mac")
@click.argument("address")
@click.option("--gateway", default="0.0.0.0", help="The camera's gateway.  [default: none]")  # noqa: S104
@click.option("--yes", is_flag=True, help="Do not ask.")
@async_command(*OUTPUT_OPTIONS)
async def force_address_command(
    mac: str, address: str, gateway: str, yes: bool, options: Options
) -> None:
    from smartcam.frames._inside import checked_mac, force_address

    checked_mac(mac)
    if not yes:
        if not sys.stdin.isatty():
            raise click.UsageError("it changes the camera's address: confirm with --yes")
        click.confirm(f"give the camera {mac} the address {address}?", abort=True, err=True)
    answer = await force_address(mac, address, gateway=gateway)
    value: dict[str, Any] = {"url": answer.url, "name": answer.name, "remark": answer.remark}
    remark = f"\n  {answer.remark}" if answer.remark else ""
    options.show(value, f"{answer.url}  {answer.name}{remark}")
