"""``smartcam ros1``: the cameras of a fleet as nodes of ROS 1."""

from __future__ import annotations

import asyncio
import contextlib
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from smartcam.ros1 import RosbridgeNode
    from smartcam.ros1._inside import RosbridgeFleet


@click.command(
    help="Show cameras in ROS 1, over a rosbridge, until Ctrl-C or SIGTERM: the topics and "
    'services of "smartcam ros2", without those that ROS 1 cannot have. A fleet file is '
    'served as by "smartcam serve"; a fleet\'s URL, fleet://HOST, means the cameras of a '
    "running fleet. Prints one line per camera, with its node. A missing or lost bridge is "
    "tried again, which is reported on stderr; with --json on stdout, as the node's object. "
    'Needs the extras "ros2" and "web", and no ROS on this machine.'
)
@click.argument("fleet", metavar="FLEET")
@click.option(
    "--bridge",
    required=True,
    metavar="URL",
    help="The rosbridge, such as ws://192.168.0.5:9090.",
)
@click.option("--namespace", help="Prefix of the cameras' names, such as /plant.")
@async_command(*OUTPUT_OPTIONS, interrupt_code=0, terminate_code=0)
async def ros1(fleet: str, bridge: str, namespace: str | None, options: Options) -> None:
    """Make cameras nodes in ROS 1."""
    from smartcam.ros1._inside import checked_url

    checked_url(bridge)  # raises before a camera is connected
    reported_nodes: set[str] = set()

    def report_change(node: RosbridgeNode) -> None:
        if node.full_name in reported_nodes:
            _report_node(node, bridge, options)

    from smartcam.settings import is_fleet

    open_ros = _join_fleet if is_fleet(fleet) else _serve_file
    async with open_ros(fleet, bridge, namespace, report_change) as ros:
        await ros.wait_first_attempts()
        for node in ros.bridged_nodes:
            failure_text = "" if node.connected else f"  no rosbridge: {node.failure}"
            options.show(_node_data(node, bridge), f"{node.full_name}{failure_text}")
            reported_nodes.add(node.full_name)
        await asyncio.Event().wait()


@contextlib.asynccontextmanager
async def _serve_file(
    path: str, bridge: str, namespace: str | None, report: Any
) -> AsyncIterator[RosbridgeFleet]:
    from smartcam.fleet import FleetServer, load_fleet
    from smartcam.fleet._inside import RosSection
    from smartcam.ros1._inside import run_bridged_nodes

    file, folder = load_fleet(path), Path(path).parent
    sections = {planned.name: planned.entry.ros2 for planned in file.plan()}
    calibrations = {name: section.load_calibration(folder) for name, section in sections.items()}
    hand_eyes = {name: section.load_hand_eye(folder) for name, section in sections.items()}
    section = file.ros2 or RosSection.model_validate({})
    async with FleetServer(file, folder=folder, restore=section.autostart) as server:
        await server.wait_first_attempts()
        async with run_bridged_nodes(
            bridge,
            report,
            server.address,
            _make_section(namespace or section.namespace, autostart=section.autostart),
            cameras=sections,
            calibrations={name: value for name, value in calibrations.items() if value is not None},
            hand_eyes={name: value for name, value in hand_eyes.items() if value is not None},
            wanted=lambda agent, _camera: agent == file.agent_name,
            calibrations_by_camera=server.calibrations,
        ) as ros:
            yield ros


@contextlib.asynccontextmanager
async def _join_fleet(
    url: str, bridge: str, namespace: str | None, report: Any
) -> AsyncIterator[RosbridgeFleet]:
    from smartcam.fleet._inside import FleetAddress
    from smartcam.ros1._inside import run_bridged_nodes

    address = FleetAddress.parse(url)
    if address.camera:
        raise ConfigurationError(
            f"fleet address {url!r} is a camera's: expected that of the fleet, fleet://HOST[:PORT]"
        )
    async with run_bridged_nodes(bridge, report, address, _make_section(namespace or "/")) as ros:
        yield ros


def _make_section(namespace: str, *, autostart: bool = True) -> Any:
    from smartcam._ros_names import check_namespace
    from smartcam.fleet._inside import RosSection

    fields = {"namespace": check_namespace(namespace), "autostart": autostart}
    return RosSection.model_validate(fields)


def _node_data(node: RosbridgeNode, bridge: str) -> dict[str, Any]:
    return {
        "node": node.full_name,
        "bridge": bridge,
        "connected": node.connected,
        "reason": node.failure or None,
    }


def _report_node(node: RosbridgeNode, bridge: str, options: Options) -> None:
    """Report that a bridge is connected, or lost."""
    at = datetime.now(UTC)
    if options.as_json:
        options.show({**_node_data(node, bridge), "at": at}, "")
        return
    text = "connected" if node.connected else f"no rosbridge: {node.failure}"
    click.echo(f"{at.astimezone():%H:%M:%S} {node.full_name}: {text}", err=True)
