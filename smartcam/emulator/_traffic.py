"""Log the frames on an emulated camera's wire, and wait for frames."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias, overload

from smartcam.emulator._tally import Tally
from smartcam.exceptions import RemoteProtocolError, ResponseTimeoutError
from smartcam.protocols import Frame
from smartcam.protocols.messages import Message, Sender, UnknownMessage

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.emulator.faults._wire_effects import WireCodec


MAX_ENTRIES = 10_000
"""Largest number of entries kept; the oldest are dropped first. This is too few for a day of a fast
production line."""

MAX_BYTES = 1 << 25
"""Largest number of bytes of all entries, read or not; the oldest are dropped first. It keeps
10,000 results of seven localizations, or 120 of the largest containers, 64 kB."""

MAX_IDS = 1000
"""Largest number of unknown message ids that are counted; ids of the dialect are always counted.
Only a client that sends arbitrary ids uses more."""

_ENTRY_BYTES = 400  # bytes of an entry with its message, without the payload
_BYTES_PER_BYTE = 4  # bytes per byte of payload: one in the message, three in hex

MAX_ENDED_CONNECTIONS = 1000
"""Largest number of ended connections whose record is kept; the oldest are dropped first."""


Direction = Literal["in", "out"]


class LogEntry(NamedTuple):
    """One message as a frame, or bytes that make no frame.

    Attributes:
        time: time of the emulator's clock, seconds.
        direction: ``in`` from a client, ``out`` to it.
        peer: address and port of the client.
        message_id: id of the frame, None for bytes that make no frame.
        message: the decoded message; None for an unknown id, a body that does not fit, and bytes
            that make no frame.
        hex: the frame's payload, or the first bytes that make no frame.
        error: why the bytes were ignored, None for a frame. A whole frame that is ignored has two
            entries: the frame, then the reason.
        fault: kinds of the faults that acted on the frame, in order; followed by ``connection
            ended`` or ``not sent`` if it was lost for that reason. None without faults. An entry is
            made when the frame has passed or is lost. A frame of the camera is logged as it was
            before the faults, a frame of a client as it was received.
        wire: the bytes that were really transferred, with header, as hex; empty for none. None: the
            bytes of the frame.
    """

    time: float
    direction: Direction
    peer: str
    message_id: int | None
    message: Message | None
    hex: str
    error: str | None = None
    fault: str | None = None
    wire: str | None = None

    @property
    def text(self) -> str:
        """Text of a line, for a camera that uses lines; a client's line is without its end."""
        text = bytes.fromhex(self.hex).decode("latin-1")
        return text.rstrip("\r\n\0") if self.direction == "in" else text


class EndedConnection(NamedTuple):
    """A TCP connection that has ended.

    Attributes:
        time: seconds of the emulator's clock when the connection ended.
        peer: address and port of the client.
        ended_by: the side that closed the connection first.
        reset: True if the connection ended by a reset instead of a normal close.
    """

    time: float
    peer: str
    ended_by: Literal["client", "camera"]
    reset: bool


_EntryParts: TypeAlias = tuple[float, str, Sender, Frame | bytes, str | None, bytes | None]
"""Time, peer, sender, frame or bytes, faults, and passed bytes: the parts of an entry."""

_DIRECTIONS: dict[Sender, Direction] = {Sender.CLIENT: "in", Sender.CAMERA: "out"}


class Log(Sequence[LogEntry]):
    """The last frames in both directions, oldest first; the oldest are dropped when it is full.

    A frame is decoded when its entry is read; until then the log keeps its bytes. The limits do not
    depend on this.

    Args:
        dialect: dialect in which frames are decoded.
        maxlen: largest number of entries.
        max_bytes: largest number of bytes of all entries; the last one is kept at any size.

    Attributes:
        maxlen: largest number of entries.
        max_bytes: largest number of bytes of all entries.
        dropped_count: entries dropped because the log was full, since the beginning or the last
            :meth:`clear`.
    """

    def __init__(
        self, dialect: WireCodec, maxlen: int = MAX_ENTRIES, max_bytes: int = MAX_BYTES
    ) -> None:
        self.maxlen: int = maxlen
        self.max_bytes: int = max_bytes
        self.dropped_count: int = 0
        self._dialect = dialect
        self._entries: deque[LogEntry] = deque()
        # the later entries, whose messages are not decoded yet
        self._raw_entries: deque[LogEntry | _EntryParts] = deque()
        self._sizes: deque[int] = deque()  # sizes of all entries in order, bytes
        self._size = 0  # sum of the sizes, bytes
        self._removed_count = 0  # number of entries removed so far

    def __repr__(self) -> str:
        return f"Log({list(self)!r})"

    def __len__(self) -> int:
        return len(self._sizes)

    def __iter__(self) -> Iterator[LogEntry]:
        return iter(self._make_entries())

    @overload
    def __getitem__(self, index: int, /) -> LogEntry: ...
    @overload
    def __getitem__(self, index: slice, /) -> list[LogEntry]: ...
    def __getitem__(self, index: int | slice, /) -> LogEntry | list[LogEntry]:
        """Return an entry, or some as a list.

        Raises:
            IndexError: there is no such entry.
        """
        entries = self._make_entries()
        return entries[index] if isinstance(index, int) else list(entries)[index]

    @property
    def size(self) -> int:
        """Bytes that the entries hold, counted as if all had been read."""
        return self._size

    def add_frame(
        self, time: float, peer: str, sender: Sender, frame: Frame, fault: str | None
    ) -> None:
        """Add a frame that was transferred unchanged, like :meth:`append`."""
        self._raw_entries.append((time, peer, sender, frame, fault, None))
        entry_size = _ENTRY_BYTES + _BYTES_PER_BYTE * len(frame[1])
        if fault is not None:
            entry_size += len(fault)
        self._sizes.append(entry_size)
        self._size += entry_size
        if len(self._sizes) > self.maxlen or self._size > self.max_bytes:
            self._drop_oldest()

    def append(self, entry: LogEntry | _EntryParts) -> None:
        """Add an entry, or the parts of one."""
        if isinstance(entry, LogEntry):
            size, texts = (len(entry.hex) + 1) // 3, (entry.error, entry.fault, entry.wire)
            entry_size = (
                _ENTRY_BYTES + _BYTES_PER_BYTE * size + sum(len(text) for text in texts if text)
            )
        else:  # size of the entry once it is read
            _, _, _, content, fault, wire = entry
            size = len(content.payload if isinstance(content, Frame) else content)
            entry_size = _ENTRY_BYTES + _BYTES_PER_BYTE * size
            if fault is not None or wire is not None:
                entry_size += len(fault or "") + max(0, 3 * len(wire or b"") - 1)
        self._raw_entries.append(entry)
        self._sizes.append(entry_size)
        self._size += entry_size
        self._drop_oldest()

    def _drop_oldest(self) -> None:
        """Drop the oldest entries while the log is full."""
        sizes = self._sizes
        while len(sizes) > self.maxlen or (self._size > self.max_bytes and len(sizes) > 1):
            (self._entries or self._raw_entries).popleft()
            self._subtract_oldest()
            self.dropped_count += 1

    def since(self, serial: int, limit: int | None = None) -> tuple[list[LogEntry], int]:
        """Return the entries after the first ``serial`` ones, and the number of all so far.

        ::

            new, count = emulator.log.since(serial)
            missed = count - serial - len(new)

        Entries that were dropped before the call are missing in the list.

        Args:
            serial: number of entries that the caller knows already.
            limit: largest number of entries returned, the oldest first; default all.
        """
        entries = self._make_entries()
        first = min(max(0, serial - self._removed_count), len(entries))
        last = len(entries) if limit is None else first + limit
        return list(islice(entries, first, last)), self._removed_count + len(entries)

    def popleft(self) -> LogEntry:
        """Remove and return the oldest entry.

        Raises:
            IndexError: there is no entry.
        """
        entry = self._make_entries().popleft()
        self._subtract_oldest()
        return entry

    def clear(self) -> None:
        """Remove all entries."""
        self._removed_count += len(self)
        self._entries.clear()
        self._raw_entries.clear()
        self._sizes.clear()
        self._size = self.dropped_count = 0

    def _subtract_oldest(self) -> None:
        """Subtract the size of the oldest entry."""
        self._removed_count += 1
        self._size -= self._sizes.popleft()

    def _make_entries(self) -> deque[LogEntry]:
        raw_entries, entries = self._raw_entries, self._entries
        while raw_entries:
            entry = raw_entries.popleft()
            entries.append(entry if isinstance(entry, LogEntry) else self._entry(*entry))
        return entries

    def _entry(
        self,
        time: float,
        peer: str,
        sender: Sender,
        content: Frame | bytes,
        fault: str | None,
        wire: bytes | None,
    ) -> LogEntry:
        passed = None if wire is None else wire.hex(" ")
        if isinstance(content, bytes):
            message_id, message, payload = None, None, content
        else:
            message_id, payload = content
            message = _decode(self._dialect, sender, content)
        direction, data = _DIRECTIONS[sender], payload.hex(" ")
        return LogEntry(time, direction, peer, message_id, message, data, None, fault, passed)


class TrafficLog:
    """Keeps the last entries and counts what clients sent."""

    def __init__(self, dialect: WireCodec) -> None:
        self.ended_connections: deque[EndedConnection] = deque(maxlen=MAX_ENDED_CONNECTIONS)
        self.entries: Log = Log(dialect)  # the last frames
        self._dialect = dialect
        self._received: Tally[int | type[Message] | None] = Tally(
            {row.message_id: 0 for row in dialect.table}
        )

    def add(
        self,
        time: float,
        peer: str,
        sender: Sender,
        content: Frame | bytes | RemoteProtocolError,
        fault: str | None = None,
        wire: bytes | None = None,
    ) -> None:
        """Add a frame, bytes that make no frame, or the reason why they are ignored."""
        if isinstance(content, RemoteProtocolError):
            # keep only the text, since the error keeps its traceback alive
            data, error = content.data.hex(" "), str(content)
            self.entries.append(
                LogEntry(time, _DIRECTIONS[sender], peer, None, None, data, error, fault)
            )
        else:
            self.entries.append((time, peer, sender, content, fault, wire))

    async def wait_received(
        self, what: int | type[Message], *, count: int = 1, timeout: float = 5.0
    ) -> None:
        """Wait as :meth:`~smartcam.emulator.EmulatedCamera.wait_received` does."""
        try:
            await self._received.wait(what, count, timeout)
        except TimeoutError as exc:
            name = f"message {what:#04x}" if isinstance(what, int) else what.__name__
            raise ResponseTimeoutError(
                f"the emulator received {self._received[what]} of {count} {name} in {timeout} s",
                message_id=what if isinstance(what, int) else None,
                waited=timeout,
            ) from exc

    def count(self, frame: Frame) -> None:
        """Count a frame that the camera has received."""
        message_id, payload = frame
        received = self._received
        if message_id in received or len(received) < MAX_IDS:
            received[message_id] += 1
        received.add(_message_type(self._dialect, message_id, len(payload)))


@functools.lru_cache(maxsize=256)
def _message_type(dialect: WireCodec, message_id: int, size: int) -> type[Message] | None:
    """Return the type of a client's frame; id and size of its payload decide that."""
    message = _decode(dialect, Sender.CLIENT, Frame(message_id, bytes(size)))
    return None if message is None else type(message)


def _decode(dialect: WireCodec, sender: Sender, frame: Frame) -> Message | None:
    """Return a frame decoded; None for an unknown id and for a body that does not fit."""
    if dialect.surplus(sender, frame) > 0:
        return None
    try:
        message = dialect.decode(sender, frame)
    except RemoteProtocolError:
        return None
    return None if isinstance(message, UnknownMessage) else message
