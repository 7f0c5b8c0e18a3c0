"""Collect an agent's counts for its metrics.

The counts may be read only in the agent's event loop. They are read for a few cameras at a time, so
that the loop is not blocked.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, NamedTuple

from smartcam.fleet._operations.trigger_counts import Totals

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.fleet._agent.server import FleetServer
    from smartcam.fleet._agent.shared_camera import SharedCamera
    from smartcam.frames._inside import SourceStatistics
    from smartcam.models import Statistics
    from smartcam.outlets._inside import OutletState

CAMERAS_PER_SLICE = 24
"""Number of cameras that are read in one turn of the event loop, half a millisecond."""

FATES = ("triggered", "streamed", "late", "wrong_application", "uninterpretable", "unclaimed")


class CameraCounts(NamedTuple):
    """The counts of one camera."""

    name: str
    connected: bool
    is_taken: bool
    statistics: Statistics
    triggers: dict[str, int]
    stream_count: int
    frames: SourceStatistics | None


class AgentCounts(NamedTuple):
    """The counts of an agent; ``gauges`` are current values."""

    agent: str
    fleet: str
    started_at: float
    gauges: dict[str, float]
    reloads: dict[str, int]
    last_reload_succeeded: bool
    totals: Totals
    cameras: list[CameraCounts]
    outlets: Mapping[str, OutletState]


async def read_counts(server: FleetServer) -> AgentCounts | None:
    """Return an agent's counts, read in its event loop; None if the agent does not run."""
    agent = server.agent
    if agent is None:
        return None
    shared_cameras = [*agent.shared_cameras.values()]
    numbers_read: list[tuple[SharedCamera, CameraCounts]] = []
    kept_results = kept_bytes = waiting_count = reserved_count = 0
    is_shared = agent.is_shared  # a camera may have been removed meanwhile
    for begin in range(0, len(shared_cameras), CAMERAS_PER_SLICE):
        for shared in shared_cameras[begin : begin + CAMERAS_PER_SLICE]:
            if is_shared(shared):
                numbers_read.append((shared, _camera_counts(shared)))
                kept_results += shared.results.kept_count
                kept_bytes += shared.results.kept_bytes
                waiting_count += shared.gate.waiting_count
                reserved_count += shared.gate.holder is not None
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
    # no await until the closing cameras are added, so that each camera counts once
    cameras = [counts for shared, counts in numbers_read if is_shared(shared)]
    totals = Totals(agent.past_totals)
    totals.add(shared.client.statistics() for shared in agent.closing_cameras)
    for begin in range(0, len(cameras), 4 * CAMERAS_PER_SLICE):
        totals.add(camera.statistics for camera in cameras[begin : begin + 4 * CAMERAS_PER_SLICE])
        await asyncio.sleep(0)
    return AgentCounts(
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


def _camera_counts(camera: SharedCamera) -> CameraCounts:
    frames = camera.frames
    return CameraCounts(
        camera.name,
        camera.connected,
        camera.client.is_taken,
        camera.client.statistics(),
        dict(camera.triggers),
        frames.stream_count,
        frames.statistics,
    )
