"""Write and read the attachment of a message or request: number, time, and sender.

``AttachmentData::serialize_to_zbytes`` in ``rmw_zenoh_cpp/src/detail/attachment_helpers.cpp``: two
int64, a byte with the length 16, and 16 bytes; little-endian, as Zenoh's serializer writes them.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from smartcam.exceptions import RosMessageError

GID_BYTES = 16
_FORM = struct.Struct("<qqB16s")


class Attachment(NamedTuple):
    """The attachment of a message, a request or a reply.

    Attributes:
        number: count of the publisher's messages, or of the client's calls, from 1.
        time: time of sending, nanoseconds since 1970.
        gid: GID of the publisher, or of the client.
    """

    number: int
    time: int
    gid: bytes

    def encode(self) -> bytes:
        """Return the bytes of the attachment."""
        return _FORM.pack(self.number, self.time, GID_BYTES, self.gid)

    @classmethod
    def decode(cls, data: bytes | None) -> Attachment:
        """Read an attachment.

        Raises:
            RosMessageError: there is no attachment, or it has another form.
        """
        if data is None or len(data) != _FORM.size or data[16] != GID_BYTES:
            actual = "nothing" if data is None else f"{len(data)} bytes, {data[:48].hex()}"
            raise RosMessageError(
                f"attachment: expected {_FORM.size} bytes (number, time, the length {GID_BYTES}, "
                f"GID), got {actual}"
            )
        number, when, _, gid = _FORM.unpack(data)
        if number < 0 or when < 0:
            raise RosMessageError(f"attachment: number {number} or time {when} is below 0")
        return cls(number, when, gid)
