"""Checks of the connection to a fleet's camera: bus, agent, and the agent's session with it."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from smartcam._suggestions import did_you_mean
from smartcam.doctor._findings import Exit
from smartcam.exceptions import (
    ConfigurationError,
    ConnectFailedError,
    ConnectionLostError,
    NotAllowedError,
    ResponseTimeoutError,
)
from smartcam.fleet._inside import (
    FleetAddress,
    Keys,
    ZenohConnection,
    expiry_warning,
    may_command,
    read_identity,
    shake_hands,
)

if TYPE_CHECKING:
    from smartcam.doctor._context import Examination
    from smartcam.exceptions import SmartCamError
    from smartcam.fleet import FleetCamera
    from smartcam.settings import Address

AGENT_SEARCH_SECONDS = 1.0
"""Seconds to wait for an agent that was just started or has just joined its router."""

AGENT_SEARCH_INTERVAL = 0.1
"""Seconds between two searches for agents."""

MAX_CAMERAS_LISTED = 20
"""Largest number of cameras that a finding names."""

SERVE_CURE = "Is smartcam serve running on {host}? What is the entry `listen` of its fleet file? "
LISTEN_CURE = (
    "Without one it is tcp/127.0.0.1:7447, which only programs on the same computer reach; "
    "tls/0.0.0.0:7447 is for all that have a certificate."
)


def fleet_camera_address(url: str) -> Address:
    """Return the address of a camera of a fleet.

    Raises:
        ConfigurationError: the address is not valid.
    """
    address = FleetAddress.parse(url)
    if not address.camera:
        raise ConfigurationError(
            f"doctor: {url!r:.200} names no camera: expected fleet://HOST[:PORT]/CAMERA; "
            "smartcam fleet list URL lists them"
        )
    return address.of(address.camera)


# ---------------------------------------------------------------------- the bus


async def reach_bus(exam: Examination) -> None:
    """Check ``bus``: whether the port accepts a connection, and a bus answers there."""
    address, limit = FleetAddress.parse(exam.address.url), exam.options.step_timeout(10.0)
    host_and_port, cure = (
        exam.host_and_port,
        SERVE_CURE.format(host=exam.address.host) + LISTEN_CURE,
    )
    try:
        async with asyncio.timeout(limit):
            _, writer = await asyncio.open_connection(exam.address.host, exam.address.port)
    except TimeoutError:
        exam.fail(
            f"nobody answers at {host_and_port} within {limit:g} s",
            "Look at address, network, cable, power and firewall.",
        )
        return
    except OSError as exc:
        reason = os.strerror(exc.errno) if exc.errno else exc
        exam.fail(f"nothing takes a connection at {host_and_port}: {reason}", cure)
        return
    writer.transport.abort()
    if not await _check_certificates(exam, address):
        return
    bus = ZenohConnection(address.link)
    begin = asyncio.get_running_loop().time()
    try:
        await bus.open(limit)
    except ConnectFailedError as exc:
        is_tls = address.scheme == "fleet+tls"
        exam.fail(
            f"something listens at {host_and_port}, and it is no bus of a fleet: {exc.attempts[0]}",
            "Look at the certificates: their authority, the host's name in the agent's, and "
            "whether this program's is one of its clients."
            if is_tls
            else "Something else has this port, or it wants TLS (fleet+tls://). " + cure,
        )
        return
    exam.cleanup.push_async_callback(bus.close)
    exam.bus = bus
    milliseconds = 1e3 * (asyncio.get_running_loop().time() - begin)
    exam.report(
        "ok",
        f"the bus at {host_and_port} answers, after {milliseconds:.1f} ms",
        url=address._replace(camera="").url,
    )


async def _check_certificates(exam: Examination, address: FleetAddress) -> bool:
    """Check the certificates of both sides, if any; return True if they allow a connection."""
    if address.certificates is None:
        return True
    folder, loop = Path(address.certificates), asyncio.get_running_loop()
    try:
        own_identity = await loop.run_in_executor(None, read_identity, folder)
    except ConfigurationError as exc:
        exam.fail(str(exc), f"smartcam fleet certificates makes what belongs into {folder}.")
        return False
    if own_identity.expired_text:
        exam.fail(own_identity.expired_text, "With this certificate the agent refuses the program.")
        return False
    peer_identity = await shake_hands(address.host, address.port, folder)
    if peer_identity.trouble:
        exam.fail(
            f"no handshake as {own_identity}: {peer_identity.trouble}",
            "Both sides have to show a certificate of one authority (ca.pem), and the agent's has "
            "to name the host of the URL: smartcam fleet certificates --host.",
        )
        return False
    warning = own_identity.warning or expiry_warning(
        "the agent's certificate", peer_identity.expires_at
    )
    exam.report(
        "hint" if warning else "ok",
        f"this program is {own_identity}: it may look"
        + (", and command" if may_command(own_identity.role) else ""),
        warning,
        check="certificates",
        role=own_identity.role,
        certificate=own_identity.name,
        ends=own_identity.expires_at,
        agent_ends=peer_identity.expires_at,
    )
    return True


# ---------------------------------------------------------------------- the agent


async def find_agent(exam: Examination) -> None:
    """Check ``agent``: whether there is an agent that has the camera."""
    address = FleetAddress.parse(exam.address.url)
    cameras = await _list_cameras(exam, address)
    agents = sorted({agent for _, agent, _ in cameras})
    fleet_name = address.fleet
    fleet_text = "" if fleet_name is None else f" of the fleet {fleet_name}"
    if not cameras:
        exam.fail(
            f"the bus answers, and no agent{fleet_text} is there",
            "Something is a router there, and no smartcam serve has joined it. Is it running, and "
            "is this router in the entry `connect` of its fleet file?"
            + (
                ""
                if fleet_name is None
                else f" Has its fleet file the entry `fleet: {fleet_name}`?"
            ),
        )
        return
    agents_of_camera = [(fleet, agent) for fleet, agent, name in cameras if name == address.camera]
    fleets = sorted({fleet for fleet, _ in agents_of_camera})
    details: dict[str, Any] = {"agents": agents, "cameras": len({camera[2] for camera in cameras})}
    if not agents_of_camera:
        names = sorted({name for _, _, name in cameras})
        listed = ", ".join(names[:MAX_CAMERAS_LISTED]) + (
            " ..." if len(names) > MAX_CAMERAS_LISTED else ""
        )
        suggestion = did_you_mean(address.camera, names)
        exam.fail(
            f"no agent{fleet_text} has a camera {address.camera}{suggestion}",
            f"Agents there: {', '.join(agents)}. Their cameras: {listed}.",
            **details,
        )
    elif len(fleets) > 1:
        exam.fail(
            f"several fleets have a camera {address.camera}: {', '.join(fleets)}",
            f"Say which one is meant: ?fleet={fleets[0]}.",
            **details,
        )
    else:
        names = [agent for _, agent in agents_of_camera]
        several = len(names) > 1
        exam.report(
            "hint" if several else "ok",
            f"agent{'s' if several else ''} {', '.join(names)} of the fleet {fleets[0]} "
            f"{'have' if several else 'has'} this camera; cameras there: {details['cameras']}",
            "A camera serves one client: one of them takes it from the other." if several else "",
            **details,
        )


async def _list_cameras(exam: Examination, address: FleetAddress) -> list[tuple[str, str, str]]:
    """Return fleet, agent and name of all cameras; wait a while for the wanted one."""
    bus, loop = exam.bus, asyncio.get_running_loop()
    if bus is None:
        raise LookupError("there is no bus; checks that use it run after the check that reaches it")
    deadline = loop.time() + AGENT_SEARCH_SECONDS
    pattern = Keys(address.fleet or "*").camera("*", "**")
    while True:
        cameras: list[tuple[str, str, str]] = []
        for key in await bus.present_keys(
            pattern, max(AGENT_SEARCH_INTERVAL, deadline - loop.time())
        ):
            _, fleet, _, _, agent, *chunks = key.split("/")
            cameras.append((fleet, agent, "/".join(chunks)))
        if loop.time() > deadline or any(name == address.camera for *_, name in cameras):
            return sorted(cameras)
        await asyncio.sleep(AGENT_SEARCH_INTERVAL)


# ---------------------------------------------------------------------- the session


async def connect(exam: Examination) -> None:
    """Check ``session``: whether the agent answers, and has a session with the camera."""
    loop = asyncio.get_running_loop()
    camera = exam.make_camera()
    try:
        await camera.open()
    except ConnectFailedError as exc:
        has_lost_camera = isinstance(exc.__cause__, ConnectionLostError)
        exam.fail(
            exc.attempts[0],
            "Ask the doctor about the camera's own address, on the agent's host: the url: of its "
            "fleet file, which smartcam serve --json prints, too."
            if has_lost_camera
            else "The agent is there and does not answer: is it stopped, or so busy? Restart it.",
        )
        return
    exam.camera, exam.connected_at = camera, loop.time()
    exam.report(
        "ok",
        f"the agent has a session with the camera: dialect {camera.capabilities.dialect}, "
        f"protocol version {camera.protocol_version}",
        protocol_version=camera.protocol_version,
    )


async def reserve(exam: Examination) -> None:
    """Check ``reservation``: reserve the camera, so that nobody else triggers it meanwhile."""
    if not exam.wants_trigger:
        return
    exam.wants_trigger = False  # until the camera is reserved
    camera, limit = cast("FleetCamera[Any]", exam.connected_camera), exam.options.step_timeout(10.0)
    try:
        await exam.cleanup.enter_async_context(camera.reserve(limit))
    except ResponseTimeoutError as exc:
        exam.fail(
            f"no triggers are sent: {exc}",
            "Wait for the program that has it, or leave out --trigger.",
            exit_code=Exit.TIMED_OUT,
        )
        return
    except NotAllowedError as exc:
        exam.fail(
            f"no triggers are sent: {exc}",
            "Take the certificate of an operator, or leave out --trigger.",
            exit_code=Exit.REFUSED,
        )
        return
    exam.wants_trigger = True
    exam.report("ok", "the camera is reserved, so that no other program's triggers come between")


def explain_loss(exam: Examination, error: SmartCamError) -> None:
    """Report why a session is over."""
    age = asyncio.get_running_loop().time() - exam.connected_at
    exam.check = "lost"
    exam.fail(
        f"the session ended after {age:.1f} s: {error}",
        "Look at the agent: does smartcam serve still run, what does it say? And ask the doctor "
        "about the camera's own address, on the agent's host.",
        exit_code=Exit.TIMED_OUT if isinstance(error, ResponseTimeoutError) else Exit.NO_SESSION,
        after=age,
        error=str(error),
    )
