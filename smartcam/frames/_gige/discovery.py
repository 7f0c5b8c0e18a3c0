"""Find the GigE Vision cameras on each network of this machine, by a broadcast."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import ipaddress
import socket
import struct
from collections import Counter
from typing import TYPE_CHECKING, Final, NamedTuple

from smartcam.exceptions import MessageError
from smartcam.frames._gige.gvcp import (
    ACK_REQUIRED,
    BROADCAST_ACK,
    PORT,
    DeviceInfo,
    GvcpCommand,
    decode_ack,
    encode,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

ANSWER_WAIT: Final = 0.5
"""Seconds to wait for answers; by the standard, cameras answer within 200 ms."""

MAX_CAMERAS: Final = 256

MAX_ANSWERS_OF_ONE_ADDRESS: Final = 16
"""Largest number of answers from one address, so that one host cannot fill the list."""

_REQUEST_ID: Final = 1
_SIOCGIFADDR: Final = 0x8915
_SIOCGIFBRDADDR: Final = 0x8919
_SIOCGIFNETMASK: Final = 0x891B  # linux/sockios.h


class Network(NamedTuple):
    """One of this machine's networks.

    Attributes:
        address: this machine's address in the network.
        targets: addresses that the search is sent to.
        network: range of addresses; None: not known.
    """

    address: str
    targets: tuple[str, ...]
    network: ipaddress.IPv4Network | None = None


class AnsweringCamera(NamedTuple):
    """A camera that answered.

    Attributes:
        info: the camera's description of itself.
        address: address that the answer came from.
        reachable: whether the camera's address belongs to the network that the answer came through.
    """

    info: DeviceInfo
    address: str
    reachable: bool


def networks() -> list[Network]:
    """Return this machine's IPv4 networks; one that stands for all if they cannot be listed."""
    try:
        import fcntl
    except ImportError:
        return [Network("0.0.0.0", ("255.255.255.255",))]  # noqa: S104 - every address of this machine
    found = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for _, name in socket.if_nameindex():
            request = struct.pack("256s", name.encode()[:15])
            with contextlib.suppress(OSError):  # an interface without an IPv4 address
                address, broadcast, mask = (
                    socket.inet_ntoa(fcntl.ioctl(sock.fileno(), number, request)[20:24])
                    for number in (_SIOCGIFADDR, _SIOCGIFBRDADDR, _SIOCGIFNETMASK)
                )
                network = ipaddress.IPv4Network(f"{address}/{mask}", strict=False)
                target = broadcast if broadcast != "0.0.0.0" else str(network.broadcast_address)  # noqa: S104
                targets = (target, address if network.is_loopback else "255.255.255.255")
                found.append(Network(address, targets, network))
    return found


async def find_cameras(
    interfaces: Iterable[Network], *, port: int = PORT, wait: float = ANSWER_WAIT
) -> list[AnsweringCamera]:
    """Search for cameras.

    Args:
        interfaces: networks to search; a target may be a camera's own address.
        port: UDP port that cameras listen at.
        wait: seconds to wait for answers.

    Cancellation: safe.
    """
    loop = asyncio.get_running_loop()
    searches: list[_NetworkSearch] = []
    transports: list[asyncio.DatagramTransport] = []
    try:
        for interface in interfaces:
            with contextlib.suppress(OSError):  # an interface that is just going down
                transport, search = await loop.create_datagram_endpoint(
                    functools.partial(_NetworkSearch, interface),
                    local_addr=(interface.address, 0),
                    allow_broadcast=True,
                )
                transports.append(transport)
                searches.append(search)
                flags = ACK_REQUIRED | BROADCAST_ACK
                for target in interface.targets:
                    transport.sendto(
                        encode(GvcpCommand.DISCOVERY, _REQUEST_ID, flags=flags), (target, port)
                    )
        await asyncio.sleep(wait)
    finally:
        for transport in transports:
            transport.close()
    answers = sorted(
        (answer for search in searches for answer in search.cameras),
        key=lambda answer: answer.reachable,
    )
    cameras = {(answer.info.mac, answer.info.serial, answer.address): answer for answer in answers}
    return sorted(cameras.values(), key=lambda camera: (camera.info.label, camera.address))


class _NetworkSearch(asyncio.DatagramProtocol):
    def __init__(self, interface: Network) -> None:
        self._interface = interface
        self.cameras: list[AnsweringCamera] = []
        self._answers = Counter[str]()  # number of answers by address

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        try:
            ack = decode_ack(data)
            if (
                ack.command != GvcpCommand.DISCOVERY + 1
                or ack.request_id != _REQUEST_ID
                or ack.status
            ):
                return
            info = DeviceInfo.decode(ack.payload)
        except MessageError:
            return
        network = self._interface.network
        reachable = network is None or ipaddress.IPv4Address(info.address) in network
        self._answers[addr[0]] += 1
        if len(self.cameras) < MAX_CAMERAS and self._answers[addr[0]] <= MAX_ANSWERS_OF_ONE_ADDRESS:
            self.cameras.append(AnsweringCamera(info, addr[0], reachable))

    def error_received(self, exc: Exception) -> None:
        """Ignore that no process listens at one of the targets."""
