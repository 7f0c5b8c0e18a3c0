"""``smartcam ros2``: the cameras of a fleet as nodes of ROS 2."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from smartcam.fleet._inside import RosSection


ROS_ARGS = "--ros-args"
"""The option after which all arguments are for ROS, as in every ROS program."""

RMW_NAMES = {"zenoh": "zenoh", "native": "rclpy"}
"""Values of ``--rmw``, and the corresponding values in a fleet file."""


class RosCommand(click.Command):
    """A command that leaves the arguments after ``--ros-args`` to ROS."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the arguments for ROS into ``ros_args``, and parse the others."""
        index = args.index(ROS_ARGS) if ROS_ARGS in args else len(args)
        unparsed = super().parse_args(ctx, args[:index])
        ctx.params["ros_args"] = tuple(args[index:])
        return unparsed


@click.command(
    cls=RosCommand,
    help="Show cameras in ROS 2, as nodes for programs that use rmw_zenoh, until Ctrl-C or "
    "SIGTERM; with --rmw native through the installed rclpy, over any middleware, and "
    'options after --ros-args are those of ROS then. A fleet file is served as by "smartcam '
    "serve\"; a fleet's URL, fleet://HOST, means the cameras of a running fleet. Prints one "
    'line per camera, with its node. Options win over "ros2" in a fleet file. Needs the '
    'extra "ros2", and ROS only for --rmw native.',
)
@click.argument("fleet", metavar="FLEET")
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
    type=click.Choice(list(RMW_NAMES)),
    help="zenoh: smartcam itself, like rmw_zenoh; native: the installed ROS.  [default: zenoh]",
)
@async_command(*OUTPUT_OPTIONS, interrupt_code=0, terminate_code=0)
async def ros2(
    fleet: str,
    domain: int | None,
    namespace: str | None,
    distribution: str | None,
    rmw: str | None,
    ros_args: tuple[str, ...],
    options: Options,
) -> None:
    """Make cameras nodes in ROS 2."""
    values: dict[str, object] = {
        "domain": domain,
        "namespace": namespace,
        "distribution": distribution,
        "through": None if rmw is None else RMW_NAMES[rmw],
        "args": ros_args or None,
    }
    settings = {name: value for name, value in values.items() if value is not None}
    from smartcam.settings import is_fleet

    if is_fleet(fleet):
        await _join_fleet(fleet, settings, options)
    else:
        await _serve_file(fleet, settings, options)


async def _serve_file(path: str, settings: dict[str, object], options: Options) -> None:
    from smartcam._cli.serve import AgentRunner
    from smartcam.fleet import FleetServer, load_fleet

    file = load_fleet(path)
    file_settings = {} if file.ros2 is None else file.ros2.model_dump(exclude_unset=True)
    file = file.model_copy(update={"ros2": _make_section({**file_settings, **settings})})
    server = FleetServer(file, folder=Path(path).parent)
    url = server.address.url
    await AgentRunner(
        server, options, False, lambda: _show_nodes(server.ros_nodes, url, options)
    ).run()


async def _join_fleet(url: str, settings: dict[str, object], options: Options) -> None:
    from smartcam.fleet._inside import FleetAddress, ros_of

    address = FleetAddress.parse(url)
    if address.camera:
        raise ConfigurationError(
            f"fleet address {url!r} is a camera's: expected that of the fleet, fleet://HOST[:PORT]"
        )
    async with ros_of(address, _make_section(settings)) as ros:
        _show_nodes(ros.names, address.url, options)
        await asyncio.Event().wait()


def _make_section(settings: dict[str, object]) -> RosSection:
    from pydantic import ValidationError

    from smartcam.fleet._inside import RosSection

    if settings.get("args") and settings.get("through") != RMW_NAMES["native"]:
        raise ConfigurationError(f"{ROS_ARGS}: expected --rmw native, as only ROS reads them")
    try:
        return RosSection.model_validate(settings)
    except ValidationError as exc:
        (first, *_) = exc.errors()
        raise ConfigurationError(f"--{first['loc'][0]}: {first['msg']}") from exc


def _show_nodes(names: list[str], url: str, options: Options) -> None:
    for name in names:
        options.show({"node": name, "fleet": url}, name)
