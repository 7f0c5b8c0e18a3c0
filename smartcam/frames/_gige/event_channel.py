"""Receive the events of a GigE Vision camera through its message channel, each only once.

The data of an event are the bytes of its item, as EMVA's GenApi passes them to the description's
event port: the item's size at address 0, its number at 2, and its data after the timestamp.

Source: GigE Vision 2.0, chapters 17 (EVENT, EVENTDATA) and 28 (message channel's registers); SFNC
2.7, chapter 12 (``EventSelector``, ``EventNotification``).
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import ipaddress
import struct
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple, cast

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import FrameSourceError, MessageError, UnsupportedError
from smartcam.frames._events import FrameEvent
from smartcam.frames._gige.control import RequestRefusedError
from smartcam.frames._gige.gvcp import ACK_REQUIRED, EXTENDED_ID, GvcpCommand, Register
from smartcam.frames._gige.messages import MessageFeatures

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Sequence

    from smartcam.frames._gige.session import GigESession

MAX_KEPT_REQUESTS: Final = 256
"""Number of remembered request ids, so that an event that is sent again counts once."""

MAX_EVENTS_IN_MESSAGE: Final = 100

RESEND_TIMEOUT_MS: Final = 300
"""Milliseconds after which the camera repeats an event that was not acknowledged."""

RETRIES: Final = 3

_REQUEST: Final = struct.Struct(">BBHHH")
_ITEM: Final = struct.Struct(">HHHHQ")
_LONG_ITEM: Final = struct.Struct(">HHHHQQ")
_KEY: Final = 0x42
_ON_ENTRIES: Final = ("On", "GigEVisionEvent", "GenICamEvent")
"""Entries of EventNotification that switch an event on: of today's SFNC, then of its first
versions."""


class EventItem(NamedTuple):
    """One event in a message.

    Attributes:
        number: number of the event.
        block: id of the block that the event belongs to; 0: no block.
        ticks: reading of the camera's clock.
        data: bytes of the item for the description's event port.
    """

    number: int
    block: int
    ticks: int
    data: bytes


class EventRequest(NamedTuple):
    """A message with events.

    Attributes:
        command: EVENT or EVENTDATA.
        request_id: id to repeat in the acknowledgement.
        wants_ack: whether the camera waits for an acknowledgement.
        items: the events.
    """

    command: int
    request_id: int
    wants_ack: bool
    items: list[EventItem]


def decode_events(datagram: bytes) -> EventRequest:
    """Read a message of the message channel.

    Raises:
        MessageError: the message is not valid, or its lengths do not fit.
    """
    if len(datagram) < _REQUEST.size:
        raise MessageError(f"event: expected 8 bytes or more, got {len(datagram)}", data=datagram)
    key, flags, command, length, request_id = _REQUEST.unpack_from(datagram)
    payload = memoryview(datagram)[_REQUEST.size :][:length]
    if key != _KEY or command not in (GvcpCommand.EVENT, GvcpCommand.EVENTDATA):
        raise MessageError(
            f"event: expected EVENT or EVENTDATA, got key {key:#x}, command {command:#06x}",
            data=datagram,
        )
    if len(payload) < length:
        raise MessageError(f"event: {length} bytes are announced, got {len(payload)}")
    extended = bool(flags & EXTENDED_ID)
    header_bytes = _LONG_ITEM.size if extended else _ITEM.size
    items: list[EventItem] = []
    while payload:
        if len(payload) < header_bytes or len(items) >= MAX_EVENTS_IN_MESSAGE:
            raise MessageError(
                f"event {len(items) + 1}: expected {header_bytes} bytes or more and at most "
                f"{MAX_EVENTS_IN_MESSAGE} events, got {len(payload)} bytes",
                data=datagram,
            )
        size = len(payload) if command == GvcpCommand.EVENTDATA else header_bytes
        if extended:
            size = int.from_bytes(payload[:2], "big") or size
        if not header_bytes <= size <= len(payload):
            raise MessageError(
                f"event {len(items) + 1}: expected {header_bytes} to {len(payload)} bytes, it says "
                f"{size}",
                data=datagram,
            )
        items.append(_item(bytes(payload[:size]), extended))
        payload = payload[size:]
    return EventRequest(command, request_id, bool(flags & ACK_REQUIRED), items)


def _item(data: bytes, extended: bool) -> EventItem:
    if extended:
        _, number, _, _, block, ticks = _LONG_ITEM.unpack_from(data)
    else:
        _, number, _, block, ticks = _ITEM.unpack_from(data)
    return EventItem(number, block, ticks, len(data).to_bytes(2, "big") + data[2:])


def encode_event_ack(command: int, request_id: int) -> bytes:
    """Return the acknowledgement of a message with events."""
    return struct.pack(">HHHH", 0, command + 1, 0, request_id)


class _EventWatcher(NamedTuple):
    names: tuple[str, ...]
    on_event: Callable[[FrameEvent], None]
    on_end: Callable[[FrameSourceError | None], None]


class EventChannel(asyncio.DatagramProtocol):
    """Receive the events of a camera for any number of watchers, until :meth:`close`.

    Args:
        session: session with the camera.
    """

    def __init__(self, session: GigESession) -> None:
        self._session = session
        self._transport: asyncio.DatagramTransport | None = None
        self._lock = asyncio.Lock()
        self._watchers: list[_EventWatcher] = []
        self._names_by_number: dict[int, str] = {}
        self._numbers_by_name: dict[str, int] = {}
        self._event_features: MessageFeatures | None = None
        self._recent_requests: collections.deque[int] = collections.deque(maxlen=MAX_KEPT_REQUESTS)
        self.dropped = 0
        """Number of datagrams that were no events, or came from other hosts."""

    async def names(self) -> list[str]:
        """Return the names of the events that the camera can report."""
        features = self._session.features
        if "EventSelector" not in features or "EventNotification" not in features:
            return []
        return list(await features.entries("EventSelector"))

    async def watch(
        self,
        names: Sequence[str],
        on_event: Callable[[FrameEvent], None],
        on_end: Callable[[FrameSourceError | None], None],
    ) -> Callable[[], Coroutine[Any, Any, None]]:
        """Start reports of events; return the coroutine function that stops them.

        Raises:
            UnsupportedError: the camera reports no events.
            FrameSourceError: the camera has no such event.
        """
        known = await self.names()
        label = self._session.label
        if not known:
            raise UnsupportedError(f"{label}: it reports no events: it has no EventSelector")
        for name in names:
            if name not in known:
                raise FrameSourceError(
                    f"{label}: it has no event {name!r}{did_you_mean(name, known)}; it has "
                    f"{', '.join(known)}",
                    source=label,
                    available=tuple(known),
                )
        watcher = _EventWatcher(tuple(dict.fromkeys(names)), on_event, on_end)
        async with self._lock:
            await self._open()
            self._watchers.append(watcher)
            try:
                for name in watcher.names:
                    await self._learn_number(name)
                    await self._set_notification(name, on=True)
            except BaseException:
                self._watchers.remove(watcher)
                raise

        async def stop() -> None:
            await self._remove_watcher(watcher)

        return stop

    async def _remove_watcher(self, watcher: _EventWatcher) -> None:
        async with self._lock:
            if watcher in self._watchers:
                self._watchers.remove(watcher)
            still_watched = {name for other in self._watchers for name in other.names}
            if self._session.loss_error is None and self._transport is not None:
                for name in watcher.names:
                    if name not in still_watched:
                        with contextlib.suppress(FrameSourceError):
                            await self._set_notification(name, on=False)

    async def _open(self) -> None:
        """Direct the camera's message channel to a new socket."""
        if self._transport is not None:
            return
        control = self._session.control
        local = control.local_address
        try:
            transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
                lambda: self, local_addr=(local, 0)
            )
        except OSError as exc:
            raise FrameSourceError(
                f"{self._session.label}: no socket for its events: {exc}",
                source=self._session.label,
            ) from exc
        try:
            port = int(transport.get_extra_info("sockname")[1])
            address = int(ipaddress.IPv4Address(local))
            await control.write_register(Register.MESSAGE_DESTINATION, address)
            await control.write_register(Register.MESSAGE_PORT, port)
            for register, value in (
                (Register.MESSAGE_TIMEOUT, RESEND_TIMEOUT_MS),
                (Register.MESSAGE_RETRIES, RETRIES),
            ):
                with contextlib.suppress(RequestRefusedError):  # not all cameras resend events
                    await control.write_register(register, value)
            if self._event_features is None:
                self._event_features = MessageFeatures(self._session.features, "EventID")
        except BaseException:
            transport.abort()
            raise
        self._transport = transport

    async def _learn_number(self, name: str) -> None:
        """Store an event's number, from its port in the description or from its feature."""
        if self._event_features is None or name in self._numbers_by_name:
            return
        number: float | None = self._event_features.find_number(f"Event{name}")
        if number is None:
            number = await self._session.features.number(f"Event{name}")
        if number is None:
            raise FrameSourceError(
                f"{self._session.label}: its description does not say which number the event "
                f"{name} has",
                source=self._session.label,
            )
        self._numbers_by_name[name] = int(number)
        self._names_by_number[int(number)] = name

    async def _set_notification(self, name: str, *, on: bool) -> None:
        features = self._session.features
        await features.set("EventSelector", name)
        entries = await features.entries("EventNotification")
        entry = next((entry for entry in _ON_ENTRIES if entry in entries), "On") if on else "Off"
        await features.set("EventNotification", entry)

    def end_watchers(self, error: FrameSourceError | None) -> None:
        """End all watchers, since no more events come."""
        watchers, self._watchers = self._watchers, []
        for watcher in watchers:
            watcher.on_end(error)

    async def close(self) -> None:
        """Close the socket. Idempotent."""
        transport, self._transport = self._transport, None
        self.end_watchers(None)
        if transport is not None:
            transport.abort()
            if self._session.loss_error is None:
                with contextlib.suppress(FrameSourceError):
                    await self._session.control.write_register(Register.MESSAGE_PORT, 0)

    # asyncio calls these

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport, since acknowledgements may be needed at once."""
        self._ack_transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Acknowledge events, and report them."""
        if addr[0] != self._session.control.camera_address:
            self.dropped += 1
            return
        try:
            request = decode_events(data)
        except MessageError:
            self.dropped += 1
            return
        if request.wants_ack:
            self._ack_transport.sendto(encode_event_ack(request.command, request.request_id), addr)
        if request.request_id in self._recent_requests:
            return
        self._recent_requests.append(request.request_id)
        for item in request.items:
            self._report(item)

    def _report(self, item: EventItem) -> None:
        name = self._names_by_number.get(item.number)
        if name is None or self._event_features is None:
            return
        values, problems = self._event_features.read({item.number: memoryview(item.data)})
        ticks = self._session.ticks_per_second
        event = FrameEvent(
            name,
            item.number,
            item.block,
            item.ticks / ticks if ticks else None,
            time.monotonic(),
            values,
            remark="; ".join(problems)[:1000],
        )
        for watcher in [*self._watchers]:
            if name in watcher.names:
                watcher.on_event(event)
