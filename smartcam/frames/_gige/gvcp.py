"""Encode and decode GVCP, the control protocol of GigE Vision: packets, registers, status codes.

A request has a header of eight bytes: key 0x42, flags, command, length, request id. An answer's
header of eight bytes is status, command, length, and the request's id. All numbers are big-endian.

Source: GigE Vision 2.0, chapters 14 to 16 (messages), 19 (status codes), 28 (bootstrap registers).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final, NamedTuple

from smartcam.exceptions import MessageError

PORT: Final = 3956
"""UDP port that cameras listen at."""

MAX_BYTES_PER_REQUEST: Final = 512
"""Largest number of bytes of one READMEM or WRITEMEM, a multiple of four; the standard's limit is
536."""

ACK_REQUIRED: Final = 0x01
BROADCAST_ACK: Final = 0x10
"""Flag of a DISCOVERY: a camera that is in none of this machine's subnets may broadcast
its answer."""
EXTENDED_ID: Final = 0x10
"""Flag of a PACKETRESEND: the block's id has 64 bits."""

_KEY: Final = 0x42
_REQUEST: Final = struct.Struct(">BBHHH")
_ANSWER: Final = struct.Struct(">HHHH")
_WORD: Final = struct.Struct(">I")


class GvcpCommand(IntEnum):
    """The command of a request; the answer's number is larger by one."""

    DISCOVERY = 0x0002
    FORCEIP = 0x0004
    PACKETRESEND = 0x0040
    READREG = 0x0080
    WRITEREG = 0x0082
    READMEM = 0x0084
    WRITEMEM = 0x0086
    PENDING_ACK = 0x0089
    EVENT = 0x00C0
    EVENTDATA = 0x00C2


class GvcpStatus(IntEnum):
    """A camera's status code for a request, or for a packet of its stream."""

    SUCCESS = 0x0000
    PACKET_RESEND = 0x0100
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    LOCAL_PROBLEM = 0x8008
    MSG_MISMATCH = 0x8009
    INVALID_PROTOCOL = 0x800A
    NO_MSG = 0x800B
    PACKET_UNAVAILABLE = 0x800C
    DATA_OVERRUN = 0x800D
    INVALID_HEADER = 0x800E
    WRONG_CONFIG = 0x800F
    PACKET_NOT_YET_AVAILABLE = 0x8010
    PACKET_AND_PREV_REMOVED_FROM_MEMORY = 0x8011
    PACKET_REMOVED_FROM_MEMORY = 0x8012
    NO_REF_TIME = 0x8013
    PACKET_TEMPORARILY_UNAVAILABLE = 0x8014
    OVERFLOW = 0x8015
    ACTION_LATE = 0x8016
    ERROR = 0x8FFF


class Register(IntEnum):
    """Addresses of the bootstrap registers, which every camera has."""

    VERSION = 0x0000
    MANUFACTURER_NAME = 0x0048
    """Text of 32 bytes, followed by model (32), version (32), information (48), serial number (16)
    and the user-defined name (16)."""
    FIRST_URL = 0x0200
    """URL of the description, a text of 512 bytes, followed by a second URL."""
    HEARTBEAT_TIMEOUT = 0x0938
    """Time without a heartbeat after which control ends, milliseconds."""
    TICK_FREQUENCY_HIGH = 0x093C
    TICK_FREQUENCY_LOW = 0x0940
    TIMESTAMP_CONTROL = 0x0944
    """Register whose bit :data:`LATCH` makes the camera store the time of its clock."""
    LATCHED_TIMESTAMP_HIGH = 0x0948
    LATCHED_TIMESTAMP_LOW = 0x094C
    CONTROL_PRIVILEGE = 0x0A00
    PRIMARY_APPLICATION_ADDRESS = 0x0A14
    MESSAGE_PORT = 0x0B00
    MESSAGE_DESTINATION = 0x0B10
    MESSAGE_TIMEOUT = 0x0B14
    """Time after which an event is sent again, milliseconds; 0: never."""
    MESSAGE_RETRIES = 0x0B18
    STREAM_PORT = 0x0D00
    STREAM_PACKET_SIZE = 0x0D04
    STREAM_DESTINATION = 0x0D18


EXCLUSIVE: Final = 0x1
CONTROL: Final = 0x2
"""Bit of CONTROL_PRIVILEGE that takes control."""

LATCH: Final = 0x2
"""Bit of TIMESTAMP_CONTROL."""

FIRE_TEST_PACKET: Final = 0x80000000
DO_NOT_FRAGMENT: Final = 0x40000000
PACKET_SIZE_MASK: Final = 0xFFFF
"""Bits of STREAM_PACKET_SIZE with the size of the IP packets, in bytes."""


class Ack(NamedTuple):
    """The acknowledgement of a request.

    Attributes:
        status: member of :class:`GvcpStatus`, or a maker's code.
        command: member of :class:`GvcpCommand`, plus one; or PENDING_ACK.
        request_id: id of the answered request.
        payload: bytes after the header.
    """

    status: int
    command: int
    request_id: int
    payload: bytes


class DeviceInfo(NamedTuple):
    """A camera's description of itself in the answer to a search.

    Attributes:
        mac: hardware address, as ``00:11:22:33:44:55``.
        address: IP address.
        manufacturer: name of the manufacturer.
        model: name of the model.
        version: version of the device.
        serial: serial number of the device.
        user_name: name that a user gave the device, or "".
    """

    mac: str
    address: str
    manufacturer: str
    model: str
    version: str
    serial: str
    user_name: str

    @property
    def label(self) -> str:
        """Display name of the device."""
        names = (f'"{self.user_name}"' if self.user_name else "", self.manufacturer, self.model)
        serial = f"({self.serial})" if self.serial else ""
        return " ".join(part for part in (*names, serial) if part)

    @classmethod
    def decode(cls, payload: bytes) -> DeviceInfo:
        """Read the payload of the answer to a DISCOVERY.

        Raises:
            MessageError: the payload is too short.
        """
        if len(payload) < 0xF8:
            raise MessageError(
                f"answer to DISCOVERY: expected 248 bytes, got {len(payload)}", data=payload
            )
        address = ".".join(str(part) for part in payload[0x24:0x28])
        return cls(
            payload[0x0A:0x10].hex(":"),
            address,
            text(payload[0x48:0x68]),
            text(payload[0x68:0x88]),
            text(payload[0x88:0xA8]),
            text(payload[0xD8:0xE8]),
            text(payload[0xE8:0xF8]),
        )


def text(data: bytes) -> str:
    """Return a register's text up to its first zero, with unprintable bytes replaced."""
    shown = data.split(b"\0", 1)[0].decode("utf-8", "replace").strip()
    return "".join(character if character.isprintable() else "?" for character in shown)


def status_text(status: int) -> str:
    """Return the text of a status code."""
    try:
        return f"{GvcpStatus(status).name} ({status:#06x})"
    except ValueError:
        return f"status {status:#06x}"


def encode(command: int, request_id: int, payload: bytes = b"", flags: int = ACK_REQUIRED) -> bytes:
    """Return a request."""
    return _REQUEST.pack(_KEY, flags, command, len(payload), request_id) + payload


def decode_ack(datagram: bytes) -> Ack:
    """Read an answer.

    Raises:
        MessageError: the answer is not valid.
    """
    if len(datagram) < _ANSWER.size:
        raise MessageError(f"GVCP: expected 8 bytes or more, got {len(datagram)}", data=datagram)
    status, command, length, request_id = _ANSWER.unpack_from(datagram)
    payload = datagram[_ANSWER.size :]
    if len(payload) < length:
        raise MessageError(
            f"GVCP: {length} bytes of payload are announced, got {len(payload)}",
            offset=4,
            data=datagram,
        )
    return Ack(status, command, request_id, payload[:length])


def readreg_payload(*addresses: int) -> bytes:
    """Return the payload of a READREG of some addresses."""
    return b"".join(_WORD.pack(address) for address in addresses)


def writereg_payload(*pairs: tuple[int, int]) -> bytes:
    """Return the payload of a WRITEREG of (address, value)."""
    return b"".join(struct.pack(">II", *pair) for pair in pairs)


def readmem_payload(address: int, count: int) -> bytes:
    """Return the payload of a READMEM of ``count`` bytes, a multiple of four."""
    return struct.pack(">IHH", address, 0, count)


def writemem_payload(address: int, data: bytes) -> bytes:
    """Return the payload of a WRITEMEM; the length is a multiple of four."""
    return _WORD.pack(address) + data


def encode_resend(request_id: int, block: int, first: int, last: int, *, extended: bool) -> bytes:
    """Return a PACKETRESEND for packets ``first`` to ``last`` of a block; cameras send no answer.

    Args:
        request_id: id of the request, 1 to 65535.
        block: id of the block.
        first: id of the first packet.
        last: id of the last packet.
        extended: whether the stream has ids of 64 bits.
    """
    if extended:
        payload = struct.pack(">HHIIQ", 0, 0, first, last, block)
    else:
        payload = struct.pack(">HHII", 0, block, first, last)
    return encode(GvcpCommand.PACKETRESEND, request_id, payload, EXTENDED_ID if extended else 0)
