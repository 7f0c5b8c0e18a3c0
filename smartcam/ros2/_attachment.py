"""What goes with each message and request: number, time, and whose it is.

``AttachmentData::serialize_to_zbytes`` in ``rmw_zenoh_cpp/src/detail/attachment_helpers.cpp``: two
int64, and 16 bytes behind their number, little-endian, as Zenoh's serializer writes them.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from smartcam.exceptions import RosMessageError

GID_BYTES = 16
_FORM = struct.Struct("<qqB16s")


class Attachment(NamedTuple):
    """What goes with a message, a request or a reply.

    Attributes:
        number: of the publisher's messages, or of the client's calls; from 1.
        time: when it was sent, nanoseconds since 1970.
        gid: the publisher's, or the client's.
    """

    number: int
    time: int
    gid: bytes

    def encode(self) -> bytes:
        """Return its bytes."""
        return _FORM.pack(self.number, self.time, GID_BYTES, self.gid)

    @classmethod
    def decode(cls, data: bytes | None) -> Attachment:
        """Read it.

        Raises:
            RosMessageError: there is none, or it has another form.
        """
        if data is None or len(data) != _FORM.size or data[16] != GID_BYTES:
            got = "nothing" if data is None else f"{len(data)} bytes, {data[:48].hex()}"
            raise RosMessageError(
                f"attachment: expected {_FORM.size} bytes (number, time, {GID_BYTES}, GID), "
                f"got {got}"
            )
        number, when, _, gid = _FORM.unpack(data)
        if number < 0 or when < 0:
            raise RosMessageError(f"attachment: number {number} and time {when} are not below 0")
        return cls(number, when, gid)
