"""Helpers of the tests of access: an authority, and ends of a bus that show its certificates."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from datetime import timedelta
from pathlib import Path
from typing import Any

from smartcam._zenoh import BusLink
from smartcam.fleet import FleetFile
from smartcam.fleet._inside import ZenohConnection, make_certificates
from tests.fleet.fleetkit import PATIENCE
from tests.fleet.inside import ConnectionFilter, access_control
from tests.processes import free_port

NAMES = {
    "agent": ("line1", "line2"),
    "viewer": ("dashboard",),
    "operator": ("robot",),
    "router": ("hub",),
}
WHO = {role: names[0] for role, names in NAMES.items()}

CAMERA = "line1/cam3"


async def certified(folder: Path, names: Any = None, **options: Any) -> Path:
    """Make certificates; return their folder."""
    await asyncio.to_thread(make_certificates, folder, NAMES if names is None else names, **options)
    return folder


async def short_lived(folder: Path, role: str, name: str, seconds: float) -> None:
    """Have the certificate of a name end in so many seconds."""
    (folder / name / "cert.pem").unlink(missing_ok=True)
    await certified(folder, {role: [name]}, lifetime=timedelta(seconds=seconds))


@contextlib.asynccontextmanager
async def guarded(
    plant: Path, domain: int | None = None
) -> AsyncIterator[tuple[ZenohConnection, str]]:
    """Give an end that listens and guards by roles, and where."""
    place = f"tls/127.0.0.1:{free_port()}"
    link = BusLink((place,), (), str(plant / WHO["agent"]))
    end = ZenohConnection(link, {"access_control": access_control(domain)})
    await end.open(PATIENCE)
    try:
        yield end, place
    finally:
        await end.close()


@contextlib.asynccontextmanager
async def joined(place: str, certificates: Path) -> AsyncIterator[ZenohConnection]:
    """Give an end that has connected, with a certificate."""
    end = ZenohConnection(BusLink((), (place,), str(certificates)))
    await end.open(PATIENCE)
    try:
        yield end
    finally:
        await end.close()


def plant_file(folder: Path, name: str = "line1", **more: Any) -> FleetFile:
    """Return a fleet file with an emulated camera, over TLS."""
    return FleetFile.model_validate(
        {
            "agent": name,
            "listen": f"tls/127.0.0.1:{free_port()}",
            "certificates": str(folder / name),
            "cameras": {CAMERA: {"emulated": {}, "application": 7, "interpret_as": "raw"}},
            **more,
        }
    )


def url_of(port: int, certificates: Path, camera: str = CAMERA, host: str = "localhost") -> str:
    """Return a fleet URL."""
    return f"fleet+tls://{host}:{port}/{camera}?certificates={certificates}"


@contextlib.asynccontextmanager
async def router_end(place: str, certificates: str) -> AsyncIterator[None]:
    """Be the router at a place, with a door."""
    end = ZenohConnection(BusLink((place,), (), certificates), {"access_control": access_control()})
    await end.open(PATIENCE)
    door = ConnectionFilter(frozenset({int(place.rpartition(":")[2])}), end.connected_addresses)
    door.open()
    try:
        yield
    finally:
        door.close()
        await end.close()
