"""Cameras of a fleet as nodes of ROS 1, and ``smartcam ros1``."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path
from typing import Any

import pytest

import smartcam
import smartcam.fleet
from smartcam.fleet import FleetFile
from smartcam.fleet._inside import FleetAddress, RosSection
from smartcam.ros1 import RosbridgeNode
from smartcam.ros1._inside import run_bridged_nodes
from tests.cli.commandline import closed_port, run
from tests.processes import Process, free_place
from tests.ros1.bridge import Bridge
from tests.ros2.roskit import PATIENCE

EMULATED = {"emulated": {}, "application": 7, "interpret_as": "localizations"}


@pytest.mark.long
@pytest.mark.real_time
async def test_a_fleet_is_seen_and_used_from_ros1() -> None:
    place = free_place()
    plant = FleetFile.model_validate(
        {"listen": place, "cameras": {"line-1/cam3": EMULATED, "cam4": EMULATED}}
    )
    section = RosSection.model_validate({"namespace": "plant"})
    heard: list[RosbridgeNode] = []
    async with Bridge() as bridge, smartcam.fleet.serve(plant) as server, asyncio.timeout(PATIENCE):
        address = FleetAddress.parse(server.address.url)
        async with run_bridged_nodes(bridge.url, heard.append, address, section) as ros:
            await ros.wait_first_attempts()
            names = ["/plant/cam4", "/plant/line_1/cam3"]
            assert [one.full_name for one in ros.bridged_nodes] == ros.names == names
            assert sorted(one.full_name for one in heard) == names
            camera = "/plant/line_1/cam3"

            response = await bridge.call(f"{camera}/TriggerLocalization", {"timeout": PATIENCE})
            values = response["values"]
            assert (response["result"], values["error"]) == (True, "")
            found = values["localizations"]
            assert found[0]["pose"]["header"]["frame_id"] == "line_1_cam3"

            topics = [f"{camera}/localizations", f"{camera}/results"]
            await bridge.until(lambda: all(said_on(bridge, topic) for topic in topics))
            poses = said_on(bridge, f"{camera}/localizations")[0]["poses"]
            assert poses == [one["pose"]["pose"] for one in found]
            stamp = found[0]["pose"]["header"]["stamp"]
            (result,) = said_on(bridge, f"{camera}/results")
            assert (result["header"]["stamp"], result["result_id"]) == (stamp, 1)

            await bridge.until(
                lambda: any(one["ready"] for one in said_on(bridge, f"{camera}/status"))
            )
            assert bridge.topics[f"{camera}/status"]["latch"] is True
            await bridge.until(lambda: said_on(bridge, "/diagnostics"))
            kinds = {one["type"] for one in bridge.topics.values()}
            kinds |= {one.type for one in bridge.services.values()}
            assert not {one.partition("/")[0] for one in kinds} & {
                "lifecycle_msgs", "rcl_interfaces", "vision_msgs",
            }  # fmt: skip
            other = await bridge.call("/plant/cam4/stop")
            assert other["values"]["success"] is True
        assert not bridge.services
        assert not bridge.links


def said_on(bridge: Bridge, topic: str) -> list[Any]:
    return [one["msg"] for one in bridge.published if one["topic"] == topic]


# ---------------------------------------------------------------------- the command


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (("fleet.yaml", "--bridge", "http://host:9090"), 2, "expected a URL such as ws://192.168"),
        (("none.yaml", "--bridge", "ws://host:9090"), 2, "none.yaml"),
        (("fleet://host/cam3", "--bridge", "ws://host:9090"), 2, "is a camera's"),
        (("fleet://host", "--bridge", "ws://h:1", "--namespace", "a b"), 2, "ROS namespace"),
    ],
)
def test_what_cannot_be(
    arguments: tuple[str, ...],
    code: int,
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    run("ros1", *arguments).failed(code, text)


def test_a_bridge_has_to_be_said() -> None:
    outcome = run("ros1", "fleet.yaml")
    assert outcome.code == 2
    assert "Missing option '--bridge'" in outcome.err


def test_no_fleet() -> None:
    with closed_port() as gone:
        run("ros1", f"fleet://{gone}", "--bridge", "ws://127.0.0.1:9").failed(3, gone)


@pytest.mark.long
def test_a_bridge_that_is_not_there_is_tried_on(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text(
        "listen: tcp/127.0.0.1:0\ncameras:\n  cam3: {emulated: {}}\n"
    )
    with (
        closed_port() as gone,
        Process(
            "smartcam", "ros1", str(tmp_path / "fleet.yaml"), "--bridge", f"ws://{gone}"
        ) as command,
    ):
        line = command.read_until(b"\n")
        assert line.startswith(f"/cam3  no rosbridge: ws://{gone}: [Errno ")
        command.send_signal(signal.SIGINT)
        outcome = command.wait()
    assert (outcome.code, outcome.err) == (0, "")
