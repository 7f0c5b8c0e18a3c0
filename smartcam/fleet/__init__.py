"""Cameras of a plant, shared by many programs.

A camera serves one client at a time: a new client replaces the old one. So one process, the
*agent*, is the client of the cameras, and shares them (:func:`serve`, or ``smartcam serve
fleet.yaml``). Any number of programs use the shared cameras. A program opens one camera by
:func:`smartcam.connect` with a URL such as ``fleet://plant-server/line1/cam3``, or all cameras of a
fleet by :func:`open`.

If agent and programs are different processes, they need the extra ``fleet``. :func:`open` with a
fleet file runs the agent in this process, and needs no extra.
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
