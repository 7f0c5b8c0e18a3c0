"""Create a fleet, an agent or a camera from a fleet's address or file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from smartcam._arguments import check_seconds, check_text
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError, UnsupportedError
from smartcam.fleet._agent.server import FleetServer
from smartcam.fleet._bus.address import FleetAddress, missing_certificates
from smartcam.fleet._bus.bus import MemoryBus
from smartcam.fleet._bus.zenoh import ZenohConnection
from smartcam.fleet._file.fleet_file import FleetFile
from smartcam.fleet._program.camera import FleetCamera
from smartcam.fleet._program.fleet import Fleet
from smartcam.fleet._program.program import Program
from smartcam.settings import CameraSettings

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from typing import Unpack

    from smartcam.backoff import Backoff
    from smartcam.interpreters._inside import Spec
    from smartcam.models import Calibration
    from smartcam.observers import Observer


class FleetOptions(TypedDict, total=False):
    """Options of all cameras of a fleet; see :class:`~smartcam.settings.CameraSettings`."""

    interpret_as: Spec | Mapping[int, Spec]
    calibration: Calibration | Mapping[int, Calibration | None] | None
    y_down: bool
    lenient: bool
    switch_timeout: float
    request_timeout: float
    reconnect: Backoff | None


def serve(file: str | Path | FleetFile) -> FleetServer:
    """Return an agent that shares cameras while ``async with`` runs.

    ::

        async with smartcam.fleet.serve("fleet.yaml") as server:
            print(server.urls)

    Args:
        file: path of a fleet file, or its contents.

    Raises:
        ConfigurationError: the file is wrong; the text names the field.
        MissingExtraError: the extra ``fleet`` is not installed.
    """
    return FleetServer(file)


def open(
    address_or_file: str | Path | FleetFile,
    *,
    connect_timeout: float = 10.0,
    **options: Unpack[FleetOptions],
) -> Fleet:
    """Return a fleet, which ``async with`` opens.

    Args:
        address_or_file: the fleet's URL, ``fleet://HOST[:PORT]``; or a fleet file, whose agent and
            cameras then are in this process, without Zenoh, and only for this program.
        connect_timeout: seconds for connecting to the fleet and finding its cameras.
        **options: ``interpret_as``, ``calibration``, ``y_down``, ``lenient``, ``switch_timeout``,
            ``request_timeout``, ``reconnect``, as for :func:`smartcam.connect`.

    Raises:
        ConfigurationError: the URL, the file or an option is wrong.
        MissingExtraError: a URL was given, and the extra ``fleet`` is not installed.
    """
    for name in options:
        if name not in FleetOptions.__annotations__:
            known = [*FleetOptions.__annotations__]
            raise ConfigurationError(
                f"open: a fleet has no option {name!r}; it has {', '.join(known)}"
                f"{did_you_mean(name, known)}"
            )
    connect_timeout = check_seconds(connect_timeout, "connect_timeout", "open")
    if not isinstance(address_or_file, (Path, FleetFile)):
        address_or_file = check_text(address_or_file, "fleet", least=1)
    if isinstance(address_or_file, str) and "://" in address_or_file:
        address = FleetAddress.parse(address_or_file)
        if address.camera:
            raise ConfigurationError(
                f"fleet address {address_or_file!r} is a camera's; smartcam.connect() takes it"
            )
        return Fleet(_connection(address), address, address.fleet, None, connect_timeout, options)
    bus = MemoryBus()
    server = FleetServer(address_or_file, bus=bus.new_connection())
    return Fleet(bus.new_connection(), None, server.file.fleet, server, connect_timeout, options)


SESSION_OPTIONS = frozenset(
    {"connect_attempts", "close_timeout", "liveness_timeout", "restore", "max_length"}
)
"""Options of the session with the camera, which are set in the agent's file."""


def fleet_camera(
    url: str, options: dict[str, Any], observers: Iterable[Observer]
) -> FleetCamera[Any]:
    """Return a camera by its fleet URL.

    Raises:
        ConfigurationError: the URL or an option is wrong.
        UnsupportedError: an option concerns the session, which belongs to the agent.
        MissingExtraError: the extra ``fleet`` is not installed.
    """
    address = FleetAddress.parse(url)
    if not address.camera:
        raise ConfigurationError(
            f"fleet address {url!r} names no camera: expected fleet://HOST[:PORT]/CAMERA; "
            "smartcam.fleet.open() takes the fleet"
        )
    settings = CameraSettings.of(address.of(address.camera), options)
    refused = sorted(SESSION_OPTIONS & options.keys())
    if refused:
        raise UnsupportedError(
            f"{url}: {', '.join(refused)}: these are options of the camera's session, which its "
            "agent has: set them in fleet.yaml"
        )
    program = Program(
        _connection(address), address.fleet, address.camera, display_name=address.program
    )
    return FleetCamera(settings, address.camera, program, observers=observers)


def _connection(address: FleetAddress) -> ZenohConnection:
    folder = address.certificates
    if folder is not None and (missing := missing_certificates(Path(folder))):
        raise ConfigurationError(f"fleet address {address.url!r}: certificates: {missing}")
    return ZenohConnection(address.link)
