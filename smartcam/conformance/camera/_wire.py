"""Encode requests with the dialect's table, and decode received frames with independent code.

The library decodes with the same table, so a fault of the table would stay hidden. Here only the
header's form and the message ids come from the table; this module reads the numbers itself.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import hex_excerpt
from smartcam.protocols import Frame as LibraryFrame
from smartcam.protocols._inside import MessageId
from smartcam.protocols.messages import Sender

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from smartcam.protocols import FramedDialect
    from smartcam.protocols.messages import Message

MAX_BODY_BYTES = 1 << 20
"""Largest number of bytes of a body: the camera sends about 64 kB (HAL 15, published)."""


_REFUSAL_CODES = frozenset({(0x10,), (0x13,), (0x16,), (0x1A,)})
"""Result codes of BVS ID that may be the whole body of an answer (ID-a 52, published)."""


class BadBytesError(Exception):
    """Received bytes are not a frame of this dialect; the text gives the reason."""


class ReceivedFrame(NamedTuple):
    """One frame of the camera."""

    at: float  # time of arrival of the last byte, time.monotonic()
    message_id: int
    body: bytes  # the bytes after the header


def frames_with_id(frames: Iterable[ReceivedFrame], message_id: int) -> list[ReceivedFrame]:
    """Return the frames whose message id is ``message_id``."""
    return [frame for frame in frames if frame.message_id == message_id]


@dataclass(frozen=True, slots=True)
class Bits:
    """Masks of a status word's bits by meaning; 0 if no bit has the meaning.

    Sources, by the keys of docs/sources.md: SC-A30, SC-B33 (published) for smart cameras; ID-b 210
    and the example of ID-a 227 (published and derived) for BVS ID.
    """

    waiting: int
    overtriggered: int
    running: int = 0
    busy: int = 0
    ready: int = 0
    input_container: int = 0


_SMART_BITS = Bits(waiting=0x200, overtriggered=0x100, running=0x80, busy=0x10, input_container=4)
BITS: Mapping[str, Bits] = {
    "handbook": _SMART_BITS,
    "thesis": _SMART_BITS,
    "b16": _SMART_BITS,
    "bid": Bits(waiting=0x001, overtriggered=0x100, ready=0x20),
}
"""Status bits by dialect."""


class RawDialect:
    """One dialect on the wire, including its quirks."""

    def __init__(self, dialect: FramedDialect) -> None:
        self.dialect: FramedDialect = dialect
        self.bits: Bits = BITS[dialect.name]
        self.word_size: int = 4 if dialect.word == "I" else 2  # bytes of an ordinary number

    @property
    def magic(self) -> bytes:
        """Beginning of a frame; empty in the dialects with 16 bits."""
        return self.dialect.header.magic

    @property
    def is_bid(self) -> bool:
        """True if the dialect is BVS ID's."""
        return self.dialect.name == "bid"

    # ------------------------------------------------------------------ out

    def encode_request(self, message: Message) -> bytes:
        """Return a request's bytes by the table."""
        return self.dialect.encode(message)

    def make_frame(self, message_id: int, body: bytes = b"", *, length: int | None = None) -> bytes:
        """Return any frame; ``length`` replaces the correct value of the length field."""
        return self.dialect.header.pack(message_id, len(body) if length is None else length) + body

    # ------------------------------------------------------------------ in

    def parse_frame(self, buffer: bytes) -> tuple[int, bytes, int] | None:
        """Return message id, body and total size of the first frame; None while it is incomplete.

        Raises:
            BadBytesError: no frame begins with these bytes.
        """
        magic, word_size = self.magic, self.word_size
        if not magic.startswith(buffer[: len(magic)]):
            raise BadBytesError(
                f"no frame of {self.dialect.name} begins with {hex_excerpt(buffer)}: "
                f"expected {magic.hex(' ')}"
            )
        begin = len(magic) + 2 * word_size
        if len(buffer) < begin:
            return None
        first = int.from_bytes(buffer[len(magic) : len(magic) + word_size], "little")
        second = int.from_bytes(buffer[len(magic) + word_size : begin], "little")
        message_id, length = (second, first) if magic else (first, second)
        length -= 4 if self.dialect.name == "thesis" else 0  # the length counts the message id
        if not 0 <= length <= MAX_BODY_BYTES:
            raise BadBytesError(f"a frame announces {length} bytes: {hex_excerpt(buffer[:begin])}")
        end = begin + length
        return (message_id, buffer[begin:end], end) if end <= len(buffer) else None

    def read_numbers(self, body: bytes) -> tuple[int, ...]:
        """Return a body as numbers of ``word_size`` bytes; surplus bytes at the end are ignored."""
        code = "I" if self.word_size == 4 else "H"
        count = len(body) // self.word_size
        return struct.unpack_from(f"<{count}{code}", body)

    def status_words(self, frames: Iterable[ReceivedFrame]) -> list[int]:
        """Return the status word of each status among frames."""
        bodies = (frame.body for frame in frames_with_id(frames, MessageId.STATUS))
        return [int.from_bytes(body[: self.word_size], "little") for body in bodies]

    # ------------------------------------------------------------------ in words

    def describe(self, frame: ReceivedFrame) -> str:
        """Return a frame of the camera in readable form, with hex."""
        return self._describe(Sender.CAMERA, frame.message_id, frame.body)

    def describe_request(self, data: bytes) -> str:
        """Return a sent frame in readable form, with hex; only hex if the bytes are not a frame."""
        try:
            parts = self.parse_frame(data)
        except BadBytesError:
            parts = None
        if parts is None or parts[2] != len(data):
            return hex_excerpt(data)
        return self._describe(Sender.CLIENT, parts[0], parts[1], data)

    def _describe(self, sender: Sender, message_id: int, body: bytes, raw: bytes = b"") -> str:
        readable = self.dialect.make_readable(sender, LibraryFrame(message_id, body))
        fields = ", ".join(f"{name}={value}" for name, value in (readable.fields or {}).items())
        label = f"{readable.message}({fields})" if len(fields) <= 100 else readable.message
        if not self.dialect.knows(sender, message_id):
            label = f"id {message_id:#04x}"
        return f"{label}: {hex_excerpt(raw or readable.data)}"

    def find_flaw(self, frame: ReceivedFrame) -> str | None:
        """Return in what a frame's id or length differs from the documents; None if it does not."""
        if self.is_bid and self.read_numbers(frame.body) in _REFUSAL_CODES:
            return None  # a refusal may be only its code, for any request
        size = self._body_sizes().get(frame.message_id)
        if size is None:
            return f"message {frame.message_id:#04x} is not one that a camera sends"
        min_size, exact = size
        if len(frame.body) < min_size or (exact and len(frame.body) != min_size):
            more = "" if exact else " or more"
            name = MessageId(frame.message_id).name
            return f"{name} has {len(frame.body)} bytes of body: expected {min_size}{more}"
        return None

    def _body_sizes(self) -> Mapping[int, tuple[int, bool]]:
        """Return the body length of each message that a camera sends, and whether it is exact."""
        word = self.word_size
        code_bytes = word if self.dialect.coded else 0
        table: dict[int, tuple[int, bool]] = {
            MessageId.CONNECT: (code_bytes + word, True),
            MessageId.STATUS: (2 * word if self.magic else word, True),
            MessageId.RESULT_CONTAINER: (0 if "no_id" in self.dialect.quirks else word, False),
            MessageId.QUERY_APPLICATION: (code_bytes + word, True),
            MessageId.SWITCH_APPLICATION: (2 * word, True),
            MessageId.GET_CLOCK: (code_bytes + 6 * word, True),
        }
        if self.is_bid:
            acknowledged = (
                MessageId.DISCONNECT,
                MessageId.RESET_ERRORS,
                MessageId.SET_CLOCK,
                MessageId.SET_INPUT_DATA,
                MessageId.TRIGGER,
            )
            table |= dict.fromkeys(acknowledged, (word, True))
        return table
