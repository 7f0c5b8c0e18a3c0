"""ROS 2 in a fleet with roles: operators' nodes may do everything, viewers' nodes nothing."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

import smartcam.fleet
from smartcam._zenoh import BusLink
from smartcam.fleet._inside import ZenohConnection, read_identity
from tests.fleet.fleetkit import PATIENCE, until
from tests.fleet.inside import renewal as _renewal
from tests.fleet.plantkit import certified, plant_file

pytest.importorskip("rosbags", reason="needs the extra ros2")

from smartcam.ros2 import Node
from smartcam.ros2._inside import SETTINGS, RosContext

pytestmark = [pytest.mark.real_time, pytest.mark.long]

DOMAIN = 7
STATUS = "/line1/cam3/status"


def topics(context: RosContext) -> set[str]:
    """Return the topics and services of others' cameras that a node sees."""
    names = {one.name for one in context.graph._entities.values()}
    return {name for name in names if name.startswith("/line1/cam3/")}


async def test_roles_and_renewal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_renewal, "CHECK_INTERVAL", 0.02)
    folder = await certified(tmp_path)
    file = plant_file(folder, ros2={"domain": DOMAIN})
    async with smartcam.fleet.serve(file) as server:
        place = f"tls/localhost:{server.address.port}"
        ends = {
            name: ZenohConnection(BusLink((), (place,), str(folder / name)), SETTINGS)
            for name in ("robot", "dashboard")
        }
        for end in ends.values():
            await end.open(PATIENCE)
        contexts = {name: RosContext(end, domain=DOMAIN) for name, end in ends.items()}
        async with (
            Node("robot", context=contexts["robot"]),
            Node("dashboard", context=contexts["dashboard"]),
        ):
            await until(lambda: "/line1/cam3/trigger" in topics(contexts["robot"]))
            before = topics(contexts["robot"])

            (folder / "line1" / "cert.pem").unlink()
            await certified(folder, {"agent": ["line1"]})
            digest = read_identity(folder / "line1").digest
            await until(lambda: not topics(contexts["robot"]))
            await until(lambda: topics(contexts["robot"]) >= before)
            assert server._bus.identity is not None
            assert server._bus.identity.digest == digest
            assert server.ros_nodes == ["/line1/cam3"]
            assert topics(contexts["dashboard"]) == set()
        await asyncio.gather(*(end.close() for end in ends.values()))
