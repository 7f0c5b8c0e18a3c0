"""Cameras of a plant, shared by many programs.

A camera takes one client, and the newcomer wins. So one process, the *agent*, has the sessions with
the cameras and shares them: :func:`serve`, or ``smartcam serve fleet.yaml``. Any number of programs
use them, each by :func:`smartcam.connect` with a URL such as ``fleet://plant-server/line1/cam3``,
or all of a fleet together by :func:`open`.

Between processes this needs the extra ``fleet``; :func:`open` with a fleet file has agent and
cameras in this process, and needs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.fleet._agent.server import FleetServer
    from smartcam.fleet._bus.bus import MemoryBus
    from smartcam.fleet._file.fleet_file import FleetFile, load_fleet
    from smartcam.fleet._frames.wire import FleetFrame
    from smartcam.fleet._opening import open, serve
    from smartcam.fleet._program.camera import FleetCamera, ReservationLost
    from smartcam.fleet._program.fleet import (
        AgentJoined,
        AgentLeft,
        CameraJoined,
        CameraLeft,
        Fleet,
        FleetEvent,
    )

__all__ = [
    "AgentJoined",
    "AgentLeft",
    "CameraJoined",
    "CameraLeft",
    "Fleet",
    "FleetCamera",
    "FleetEvent",
    "FleetFile",
    "FleetFrame",
    "FleetServer",
    "MemoryBus",
    "ReservationLost",
    "load_fleet",
    "open",
    "serve",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_agent.server": "FleetServer",
            "_bus.bus": "MemoryBus",
            "_file.fleet_file": "FleetFile load_fleet",
            "_frames.wire": "FleetFrame",
            "_opening": "open serve",
            "_program.camera": "FleetCamera ReservationLost",
            "_program.fleet": "AgentJoined AgentLeft CameraJoined CameraLeft Fleet FleetEvent",
        },
    )
