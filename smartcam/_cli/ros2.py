"""``smartcam ros2``: the cameras of a fleet as nodes of ROS 2."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import OUTPUT, Options, runs
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from smartcam.fleet._inside import RosSection


ROS_ARGS = "--ros-args"
"""The option after which all arguments are for ROS, as in any program of ROS."""

THROUGH = {"zenoh": "zenoh", "native": "rclpy"}
"""Values of ``--rmw``, and their names in a fleet file."""


class RosCommand(click.Command):
    """A command that leaves the arguments after ``--ros-args`` to ROS."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Keep the arguments for ROS, and parse the others."""
        at = args.index(ROS_ARGS) if ROS_ARGS in args else len(args)
        left = super().parse_args(ctx, args[:at])
        ctx.params["ros_args"] = tuple(args[at:])
        return left


@click.command(
    cls=RosCommand,
    help="Show cameras in ROS 2, as nodes for programs that use rmw_zenoh, until Ctrl-C or "
    "SIGTERM; with --rmw native through the installed rclpy, over any middleware, and "
    'options after --ros-args are those of ROS then. A fleet file is served as by "smartcam '
    "serve\"; a fleet's URL, fleet://HOST, means the cameras of a running fleet. Prints one "
    'line per camera, with its node. Options win over "ros2" in a fleet file. Needs the '
    'extra "ros2", and ROS only for --rmw native.',
)
@click.argument("place", metavar="FLEET")
@click.option(
    "--domain",
    type=click.IntRange(0, 0xFFFFFFFF),
    help="The domain's number; default ROS_DOMAIN_ID, or 0.",
)
@click.option("--namespace", help="Prefix of the cameras' names, such as /plant.")
@click.option(
    "--distribution",
    type=click.Choice(["humble", "jazzy", "kilted", "lyrical", "rolling"]),
    help="ROS distribution whose type hashes are used; default jazzy, or the installed one.",
)
@click.option(
    "--rmw",
    type=click.Choice(list(THROUGH)),
    help="zenoh: smartcam itself, like rmw_zenoh; native: the installed ROS.  [default: zenoh]",
)
@runs(*OUTPUT, interrupted=0, terminated=0)
async def ros2(
    place: str,
    domain: int | None,
    namespace: str | None,
    distribution: str | None,
    rmw: str | None,
    ros_args: tuple[str, ...],
    options: Options,
) -> None:
    """Make cameras nodes in ROS 2."""
    chosen: dict[str, object] = {
        "domain": domain,
        "namespace": namespace,
        "distribution": distribution,
        "through": None if rmw is None else THROUGH[rmw],
        "args": ros_args or None,
    }
    given = {name: value for name, value in chosen.items() if value is not None}
    from smartcam.settings import is_fleet

    if is_fleet(place):
        await _of_fleet(place, given, options)
    else:
        await _served(place, given, options)


async def _served(path: str, given: dict[str, object], options: Options) -> None:
    from smartcam._cli.serve import Serving
    from smartcam.fleet import FleetServer, load_fleet

    file = load_fleet(path)
    already = {} if file.ros2 is None else file.ros2.model_dump(exclude_unset=True)
    file = file.model_copy(update={"ros2": _section({**already, **given})})
    server = FleetServer(file, folder=Path(path).parent)
    url = server.address.url
    await Serving(server, options, False, lambda: _show(server.ros_nodes, url, options)).run()


async def _of_fleet(url: str, given: dict[str, object], options: Options) -> None:
    from smartcam.fleet._inside import FleetAddress, ros_of

    address = FleetAddress.parse(url)
    if address.camera:
        raise ConfigurationError(
            f"fleet address {url!r} is a camera's: expected that of the fleet, fleet://HOST[:PORT]"
        )
    async with ros_of(address, _section(given)) as ros:
        _show(ros.names, address.url, options)
        await asyncio.Event().wait()


def _section(given: dict[str, object]) -> RosSection:
    from pydantic import ValidationError

    from smartcam.fleet._inside import RosSection

    if given.get("args") and given.get("through") != THROUGH["native"]:
        raise ConfigurationError(f"{ROS_ARGS}: expected --rmw native, which has them read by ROS")
    try:
        return RosSection.model_validate(given)
    except ValidationError as exc:
        (first, *_) = exc.errors()
        raise ConfigurationError(f"--{first['loc'][0]}: {first['msg']}") from exc


def _show(names: list[str], url: str, options: Options) -> None:
    for name in names:
        options.show({"node": name, "fleet": url}, name)
