"""Set a GigE Vision camera's IP address by its hardware address, until it is switched off.

A camera whose address fits no network of this machine can be found, but not opened, until it gets
another address. The camera accepts an address only while no application controls it.

Source: GigE Vision 2.0, chapter 14.2 (FORCEIP).
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import ipaddress
import re
import struct
from typing import TYPE_CHECKING, Final

from smartcam._arguments import check_text
from smartcam.exceptions import (
    ConfigurationError,
    FrameSourceError,
    FrameTimeoutError,
    MessageError,
)
from smartcam.frames._gige.camera_url import as_source
from smartcam.frames._gige.discovery import find_cameras, networks
from smartcam.frames._gige.gvcp import (
    ACK_REQUIRED,
    PORT,
    GvcpCommand,
    decode_ack,
    encode,
    status_text,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.frames._driver import FoundSource
    from smartcam.frames._gige.discovery import AnsweringCamera, Network

ANSWER_TIMEOUT: Final = 1.0
"""Seconds for the answer to one request."""

MAX_ATTEMPTS: Final = 3

APPEAR_TIMEOUT: Final = 5.0
"""Seconds until the camera answers a search by its new address."""

_REQUEST_ID: Final = 2
_REQUEST: Final = struct.Struct(">2x6s12x4s12x4s12x4s")


async def force_address(
    mac: str,
    address: str,
    *,
    gateway: str = "0.0.0.0",  # noqa: S104 - no gateway
    in_networks: Sequence[Network] | None = None,
    port: int = PORT,
) -> FoundSource:
    """Set a camera's IP address until it is switched off; return the camera at its new address.

    Args:
        mac: hardware address of the camera, ``00:11:22:33:44:55``.
        address: IP address with its prefix length, ``192.168.0.20/24``.
        gateway: default gateway of the camera; ``0.0.0.0``: none.
        in_networks: networks to search; None: all networks of this machine.
        port: UDP port that cameras listen at.

    Raises:
        ConfigurationError: the address is not valid, or another camera has it.
        FrameSourceError: there is no such camera, it refuses, or it does not answer at its new
            address.

    Cancellation: the camera may have the new address.
    """
    checked = checked_mac(mac)
    new_address = _parse_address(address)
    gateway_address = _ip(gateway, "gateway")
    in_networks = networks() if in_networks is None else in_networks
    cameras = await find_cameras(in_networks, port=port)
    camera = _camera_with_mac(cameras, checked)
    holders = [other for other in cameras if other.info.address == str(new_address.ip)]
    if holders and holders[0].info.mac != checked:
        raise ConfigurationError(
            f"address: {new_address.ip} is the address of {holders[0].info.label} "
            f"({holders[0].info.mac}) already"
        )
    payload = _REQUEST.pack(
        bytes.fromhex(checked.replace(":", "")),
        new_address.ip.packed,
        new_address.netmask.packed,
        gateway_address.packed,
    )
    await _send_request(payload, in_networks, port, camera)
    return await _wait_for_camera(checked, str(new_address.ip), in_networks, port)


def checked_mac(mac: str) -> str:
    """Return a hardware address in lower case with colons.

    Raises:
        ConfigurationError: the address is not valid.
    """
    given = check_text(mac, "mac", "force_address", most=100)
    digits = re.sub(r"[:.\-]", "", given.strip().lower())
    if not re.fullmatch(r"[0-9a-f]{12}", digits):
        raise ConfigurationError(
            f"mac: expected a hardware address such as 00:11:22:33:44:55, got {given[:60]!r}"
        )
    return bytes.fromhex(digits).hex(":")


def _parse_address(address: str) -> ipaddress.IPv4Interface:
    given = check_text(address, "address", "force_address", most=100)
    expected = f"address: expected an IPv4 address such as 192.168.0.20/24, got {given[:60]!r}"
    if "/" not in given:
        raise ConfigurationError(f"{expected}: the length of the network's prefix is missing")
    try:
        interface = ipaddress.IPv4Interface(given.strip())
    except ValueError as exc:
        raise ConfigurationError(f"{expected}: {exc}") from exc
    network = interface.network
    ends = (network.network_address, network.broadcast_address)
    if network.prefixlen < 31 and interface.ip in ends:
        raise ConfigurationError(f"{expected}: it is the network's own, or its broadcast address")
    if interface.ip.is_multicast or interface.ip.is_unspecified or interface.ip.is_reserved:
        raise ConfigurationError(f"{expected}: no device can have it")
    return interface


def _ip(text: str, name: str) -> ipaddress.IPv4Address:
    given = check_text(text, name, "force_address", most=100)
    try:
        return ipaddress.IPv4Address(given.strip())
    except ValueError as exc:
        raise ConfigurationError(f"{name}: expected an IPv4 address, got {given[:60]!r}") from exc


def _camera_with_mac(cameras: list[AnsweringCamera], mac: str) -> AnsweringCamera:
    for camera in cameras:
        if camera.info.mac == mac:
            return camera
    known = tuple(
        f"{camera.info.mac} {camera.info.label} at {camera.info.address}" for camera in cameras
    )
    raise FrameSourceError(
        f"no camera with the hardware address {mac} answers; there are "
        f"{', '.join(known) or 'none'}",
        available=known,
    )


async def _send_request(
    payload: bytes, in_networks: Sequence[Network], port: int, camera: AnsweringCamera
) -> None:
    """Broadcast the request in all networks until it is answered.

    Raises:
        FrameSourceError: the request is refused.
        FrameTimeoutError: no answer came.
    """
    loop = asyncio.get_running_loop()
    status_future: asyncio.Future[int] = loop.create_future()
    transports: list[tuple[asyncio.DatagramTransport, Network]] = []
    datagram = encode(GvcpCommand.FORCEIP, _REQUEST_ID, payload, flags=ACK_REQUIRED)
    try:
        for network in in_networks:
            with contextlib.suppress(OSError):  # an interface that is just going down
                transport, _ = await loop.create_datagram_endpoint(
                    functools.partial(_ForceAnswers, status_future),
                    local_addr=(network.address, 0),
                    allow_broadcast=True,
                )
                transports.append((transport, network))
        for _ in range(MAX_ATTEMPTS):
            for transport, network in transports:
                for target in network.targets:
                    transport.sendto(datagram, (target, port))
            done, _ = await asyncio.wait([status_future], timeout=ANSWER_TIMEOUT)
            if done:
                break
        else:
            raise FrameTimeoutError(
                f"{camera.info.label}: no answer to FORCEIP in "
                f"{MAX_ATTEMPTS} x {ANSWER_TIMEOUT:g} s: "
                "a camera controlled by another application does not answer"
            )
    finally:
        for transport, _ in transports:
            transport.close()
    if status := status_future.result():
        raise FrameSourceError(f"{camera.info.label}: FORCEIP: it answers {status_text(status)}")


async def _wait_for_camera(
    mac: str, address: str, in_networks: Sequence[Network], port: int
) -> FoundSource:
    loop = asyncio.get_running_loop()
    end = loop.time() + APPEAR_TIMEOUT
    while True:
        for camera in await find_cameras(in_networks, port=port):
            if camera.info.mac == mac and camera.info.address == address:
                return as_source(camera._replace(address=address))
        if loop.time() >= end:
            raise FrameTimeoutError(
                f"{mac}: it accepted the address {address}, but does not answer at it within "
                f"{APPEAR_TIMEOUT:g} s"
            )


class _ForceAnswers(asyncio.DatagramProtocol):
    def __init__(self, status_future: asyncio.Future[int]) -> None:
        self._status_future = status_future

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        try:
            ack = decode_ack(data)
        except MessageError:
            return
        fits = ack.command == GvcpCommand.FORCEIP + 1 and ack.request_id == _REQUEST_ID
        if fits and not self._status_future.done():
            self._status_future.set_result(ack.status)

    def error_received(self, exc: Exception) -> None:
        """Ignore that no process listens at one of the targets."""
