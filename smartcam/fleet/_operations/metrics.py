"""Collect the numbers for an agent's metrics from the counts that the agent keeps.

The counts may be read only in the agent's event loop. They are read for a few cameras at a time, so
that the loop is not blocked.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NamedTuple

from smartcam.fleet._operations.trigger_counts import Totals

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.fleet._agent.host import Host
    from smartcam.fleet._agent.server import FleetServer
    from smartcam.frames._inside import SourceStatistics
    from smartcam.models import Statistics
    from smartcam.outlets._inside import OutletState

CAMERAS_PER_SLICE = 24
"""Number of cameras that are read in one turn of the event loop, half a millisecond."""

FATES = ("triggered", "streamed", "late", "wrong_application", "uninterpretable", "unclaimed")


class CameraNumbers(NamedTuple):
    """The numbers of one camera."""

    name: str
    connected: bool
    is_taken: bool
    account: Statistics
    triggers: dict[str, int]
    stream_count: int
    frames: SourceStatistics | None


class AgentNumbers(NamedTuple):
    """The numbers of an agent; ``gauges`` are current values."""

    agent: str
    fleet: str
    started_at: float
    gauges: dict[str, float]
    reloads: dict[str, int]
    last_reload_succeeded: bool
    totals: Totals
    cameras: list[CameraNumbers]
    outlets: Mapping[str, OutletState]


async def read_numbers(server: FleetServer) -> AgentNumbers | None:
    """Return an agent's numbers, read in its event loop; None if the agent does not run."""
    agent = server.agent
    if agent is None:
        return None
    hosts = [*agent.hosts.values()]
    numbers_read: list[tuple[Host, CameraNumbers]] = []
    kept_results = kept_bytes = waiting_count = reserved_count = 0
    for begin in range(0, len(hosts), CAMERAS_PER_SLICE):
        for host in hosts[begin : begin + CAMERAS_PER_SLICE]:
            if agent.hosts.get(host.name) is host:  # the camera may have been removed meanwhile
                numbers_read.append((host, _camera_numbers(host)))
                kept_results += host.results.kept_count
                kept_bytes += host.results.kept_bytes
                waiting_count += host.gate.waiting_count
                reserved_count += host.gate.holder is not None
        await asyncio.sleep(0)
    gauges: dict[str, float] = {
        "programs": agent.program_count,
        "calls": agent.call_count,
        "kept_results": kept_results,
        "kept_bytes": kept_bytes,
        "waiting_commands": waiting_count,
        "reserved": reserved_count,
        "bus_bytes": server.bus_bytes,
    }
    reloads = server.reloads
    # no await from here on, so that each camera counts once: here, or among the removed cameras
    cameras = [numbers for host, numbers in numbers_read if agent.hosts.get(host.name) is host]
    totals = Totals(agent.past_totals)
    totals.add(host.camera.statistics() for host in agent.closing_hosts)
    for begin in range(0, len(cameras), 4 * CAMERAS_PER_SLICE):
        totals.add(camera.account for camera in cameras[begin : begin + 4 * CAMERAS_PER_SLICE])
        await asyncio.sleep(0)
    return AgentNumbers(
        agent.name,
        server.file.fleet,
        agent.epoch / 1e9,
        gauges,
        dict(reloads.outcomes),
        not isinstance(reloads.last, Exception),
        totals,
        cameras,
        server.outlet_states(),
    )


def _camera_numbers(host: Host) -> CameraNumbers:
    frames = host.frames
    return CameraNumbers(
        host.name,
        host.connected,
        host.camera.is_taken,
        host.camera.statistics(),
        dict(host.triggers),
        frames.stream_count,
        frames.statistics,
    )
