"""The state machine of one link with binary frames, in either role.

It turns bytes into events; it imports no socket, loop or clock. Two rules hold: a transition
outside :data:`TRANSITIONS` is illegal, and ``receive_*`` never raises for bad input. The role's
:class:`~smartcam.protocols._base.Policy` says whether bad input ends the link with a
:class:`LinkFailed` event, or is dropped and counted.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeAlias

from smartcam.exceptions import (
    FrameError,
    LocalProtocolError,
    MessageError,
    RemoteProtocolError,
    hex_excerpt,
)
from smartcam.protocols import messages as m
from smartcam.protocols._base import POLICIES, Policy, Role, Transport
from smartcam.protocols._framed import frame_age
from smartcam.protocols._framed.framing import DEFAULT_MAX_LENGTH, Framer
from smartcam.protocols._machine import (
    Counters,
    Event,
    Frame,
    LinkEnded,
    LinkFailed,
    ResultBurst,
    State,
    send_each,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.protocols._base import Dialect
    from smartcam.protocols._framed.dialect import Codec, FramedDialect
    from smartcam.protocols.messages import Message

MAX_EVENTS_PER_READ = 64
"""If one read gives more events than this, the next read takes fewer bytes, so that the work on one
read does not delay other cameras."""

MAX_FRAMES_PER_READ = 512
"""If one read gives more frames than this, the next read takes fewer bytes, even if all are one
burst of results. The receive task handles fewer in a turn, so reading would pause after each read.
"""


MAX_KNOWN_MESSAGES = 64
"""Largest number of messages of a type that are recognized by their frames. A camera has few
different statuses and answers, but a peer could send any number."""

MAX_KNOWN_CHUNKS = 16
"""Largest number of whole chunks that a camera's machine recognizes; a client has few different
short requests."""

MAX_KNOWN_CHUNK_BYTES = 64
"""Largest number of bytes of a recognized chunk: Query, sequence number and Trigger have 40."""

MAX_KNOWN_DELIVERIES = 64
"""Largest number of deliveries that a client's machine stores in one state. A delivery is the bytes
that one read returns; a stored one is recognized when it comes again with another result."""

MAX_KNOWN_DELIVERY_BYTES = 1 << 12
"""Largest number of bytes of a stored delivery: the answers to a trigger, with a result of ordinary
size."""

MAX_KNOWN_DELIVERY_FRAMES = 8
"""Largest number of frames of a stored delivery: a trigger's five, and a few more statuses."""


_SESSION_REQUESTS = (
    m.Query,
    m.SwitchApplication,
    m.GetClock,
    m.SetClock,
    m.SetInput,
    m.SetSequenceNumber,
    m.Trigger,
    m.Start,
    m.Stop,
    m.Reboot,
    m.GetStatus,
    m.ResetErrors,
)
_SESSION_REPORTS = (
    m.StatusReport,
    m.ResultContainer,
    m.QueryAnswer,
    m.SwitchAnswer,
    m.ClockAnswer,
    m.TriggerAnswer,
    m.SetClockAnswer,
    m.SetInputAnswer,
    m.ResetErrorsAnswer,
)


# Messages that are accepted without a pending request; some cameras do not answer Disconnect.
_BY_ITSELF = frozenset((m.StatusReport, m.ResultContainer, m.DisconnectAnswer))


def _transitions() -> dict[tuple[State, m.Sender, type[Message]], State]:
    client, camera = m.Sender.CLIENT, m.Sender.CAMERA
    idle, connecting, connected = State.IDLE, State.CONNECTING, State.CONNECTED
    table: dict[tuple[State, m.Sender, type[Message]], State] = {
        # harmless without a session; it ends the session of a client that has crashed
        (idle, client, m.Disconnect): idle,
        (idle, client, m.Connect): connecting,
        (connecting, client, m.Disconnect): State.DISCONNECTED,
        (connecting, client, m.Connect): connecting,
        (connecting, camera, m.ConnectAnswer): connected,
        # the answers to requests before it may still come
        (connected, client, m.Connect): connected,
        (connected, client, m.Disconnect): State.DISCONNECTED,
        (State.DISCONNECTED, client, m.Disconnect): State.DISCONNECTED,
        (State.DISCONNECTED, client, m.Connect): connecting,
        (State.DISCONNECTED, camera, m.ConnectAnswer): State.DISCONNECTED,
        # the answer to a second Connect that came in the same bytes as the first
        (connected, camera, m.ConnectAnswer): connected,
    }
    for state in (idle, connecting, connected, State.DISCONNECTED):
        # answers to the Disconnect that was sent before a Connect, or that ended the session
        table[state, camera, m.DisconnectAnswer] = state
    for request in (*_SESSION_REQUESTS, m.UnknownMessage, m.MalformedMessage):
        table[connected, client, request] = connected
        # sent before the answer to Connect has come; the camera answers it after that
        table[connecting, client, request] = connecting
    for report in (*_SESSION_REPORTS, m.UnknownMessage):
        table[connected, camera, report] = connected
        table[State.DISCONNECTED, camera, report] = State.DISCONNECTED
    return table


TRANSITIONS: Mapping[tuple[State, m.Sender, type[Message]], State] = _transitions()
"""``{(state, sender, message type): next state}``, for both roles. All other cases are illegal."""


_NEXT_STATES: dict[m.Sender, dict[State, dict[type[Message], State]]] = {
    sender: {
        state: {
            kind: next_state
            for (before, message_sender, kind), next_state in TRANSITIONS.items()
            if (before, message_sender) == (state, sender)
        }
        for state in State
    }
    for sender in m.Sender
}
""":data:`TRANSITIONS` by sender and state, which is faster to look up for each message."""


_EncodedFrame: TypeAlias = "tuple[tuple[bytes, int, int | None], Frame]"
"""The encoded frame, its message id and the id of its answer; and the frame before encoding."""


class _Delivery(NamedTuple):
    """A delivery of whole frames that were all received before, with at most one result.

    Attributes:
        head: bytes before the result's data; all bytes if there is no result.
        data_begin: offset where the data begins.
        tail: bytes after the data.
        data_end: offset where the data ends.
        pending: ids of the answers that were pending before the delivery.
        pending_after: ids of the answers that were pending after the delivery.
        messages_before: messages before the result; all messages if there is no result.
        make: function that makes the result from its data; None if there is no result.
        messages_after: messages after the result.
        frames: number of frames.
    """

    head: bytes
    data_begin: int
    tail: bytes
    data_end: int
    pending: tuple[int, ...]
    pending_after: tuple[int, ...]
    messages_before: list[Message]
    make: Callable[[bytes], Message] | None
    messages_after: list[Message]
    frames: int


class _SentTogether(NamedTuple):
    """Messages that the client sent together, to be sent again faster.

    Attributes:
        messages: the messages; they are recognized by this tuple object.
        data: frames of the messages; on TCP joined.
        frames: number of frames.
        size: number of bytes of all frames.
        pending: ids of the answers that were pending before they were sent.
        pending_after: ids of the answers that were pending afterwards.
    """

    messages: tuple[Message, ...]
    data: list[bytes]
    frames: int
    size: int
    pending: tuple[int, ...]
    pending_after: tuple[int, ...]


class Machine:
    """One link's protocol: bytes to events and messages to bytes.

    Feed received bytes to :meth:`receive_data` and take :meth:`events`; give messages to
    :meth:`send` and write :meth:`data_to_send`.

    Args:
        dialect: the wire variant.
        role: side of the link that this machine speaks for.
        transport: stream or datagrams.
        max_length: bytes of the largest payload that is accepted.
        policy: policy in place of the role's own; the emulator's quirks use it.
        trace: function that is called with the sender and each whole frame, in both directions, and
            with the error for bytes that make no frame.
        candidates: dialects whose sessions begin alike, of which the camera speaks one;
            ``dialect`` is the first. The answer to Connect removes the dialects that it does not
            fit; if several remain, :meth:`adopt` decides.

    Attributes:
        get_buffer: function that returns the buffer for a stream's next bytes; call
            :meth:`buffer_updated` next.
        may_reply: False: received bytes never give bytes to send.
        transitions: the next state by state, sender and type of message; all other messages are
            illegal.
    """

    # an object with more than thirty attributes and no slots is slower at each of them
    __slots__ = (
        *("_bounded", "_burst_reader", "_burst_size", "_bodiless_frames", "_decoders"),
        *("_deliveries_left", "_events", "_framer", "_header_size", "_ignores_bytes"),
        *("_is_client", "_is_connecting", "_known_chunks", "_known_deliveries"),
        *("_known_messages", "_known_results", "_known_statuses", "_makes_bursts", "_outbox"),
        *("_own_sender", "_peer_sender", "_pending_ids", "_policy", "_receivable"),
        *("_receive_transitions", "_recognizes", "_result_head", "_result_id"),
        *("_send_transitions", "_sendable", "_sent_data_key", "_sent_frames", "_sent_together"),
        *("_state", "_status_id", "_status_size", "_trace", "_unfinished_age"),
        *("_unfinished_number", "_unfinished_since"),
        *(
            "counters",
            "dialect",
            "error",
            "candidates",
            "may_reply",
            "role",
            "get_buffer",
            "transport",
        ),
    )

    transitions: ClassVar[Mapping[tuple[State, m.Sender, type[Message]], State]] = TRANSITIONS

    def __init__(
        self,
        dialect: FramedDialect,
        role: Role,
        transport: Transport,
        *,
        max_length: int = DEFAULT_MAX_LENGTH,
        policy: Policy | None = None,
        trace: Callable[[m.Sender, Frame | RemoteProtocolError], None] | None = None,
        candidates: Sequence[FramedDialect] = (),
    ) -> None:
        self.dialect: FramedDialect = dialect
        self.candidates: Sequence[FramedDialect] = candidates or (dialect,)
        self.role = role
        self.transport = transport
        self.may_reply: bool = False
        self.error: RemoteProtocolError | None = None
        self.counters: Counters = Counters()
        self._policy = policy or POLICIES[role, transport]
        self._bounded = self._policy.bounded
        self._header_size = dialect.header.size
        self._framer = Framer(dialect.header, max_length)
        self.get_buffer: Callable[[], memoryview] = self._framer.get_buffer
        self._unfinished_number = -1  # number of the unfinished frame
        self._unfinished_since = 0.0  # time at which its first bytes came
        self._unfinished_age = frame_age.UnfinishedFrame()
        self._trace = trace
        self._events: list[Event] = []
        self._outbox: list[bytes] = []
        # ids of pending answers (client role), in order; twice if a request was sent ``again``
        self._pending_ids: tuple[int, ...] = ()
        self._peer_sender, self._own_sender = role.receives, role.sends
        self._receive_transitions = _NEXT_STATES[self._peer_sender]
        self._send_transitions = _NEXT_STATES[self._own_sender]
        self._is_client = role is Role.CLIENT
        self._recognizes = self._is_client and trace is None
        self._decoders: dict[int, Codec] = {}
        # by id: the messages received in this state, by their whole frames
        self._known_messages: dict[int, dict[bytes, Message]] = {}
        self._known_statuses: dict[bytes, Message] = {}  # messages of statuses, by their frames
        # by the bytes before the data: size of the frame, function that makes the result
        self._known_results: dict[bytes, tuple[int, Callable[[bytes], Message]]] = {}
        # of a client: stored deliveries by their sizes; how many more may be stored
        self._known_deliveries: dict[int, _Delivery] = {}
        self._deliveries_left = MAX_KNOWN_DELIVERIES
        # last messages that a client sent together
        self._sent_together: _SentTogether | None = None
        # of a camera: messages and frames of chunks received in this state
        self._known_chunks: dict[bytes, tuple[list[Message], list[Frame]]] = {}
        # of a camera, by the id of a message object sent before: the message and its frame
        self._sent_frames: dict[int, tuple[Message, _EncodedFrame]] = {}
        self._sent_data_key = 0  # the key of the last message with data
        self._status_id = self._status_size = 0
        self.state = State.IDLE
        self._use_dialect(dialect)

    def adopt(self, dialect: Dialect) -> None:
        """Speak this one of :attr:`candidates`; statuses that were returned before stay unchanged.

        Raises:
            LocalProtocolError: the dialect is not in :attr:`candidates`.
        """
        chosen = [candidate for candidate in self.candidates if candidate is dialect]
        if not chosen:
            raise LocalProtocolError(
                f"{dialect.name} is none of {[d.name for d in self.candidates]}"
            )
        self.candidates = chosen
        self._use_dialect(chosen[0])

    def _use_dialect(self, dialect: FramedDialect) -> None:
        self.dialect = dialect
        self._decoders = dialect.decoders(self._peer_sender)
        self._bodiless_frames = dialect.bodiless_frames
        if self._bounded:
            self._framer.limit_lengths(dialect.lengths(self._peer_sender))
        result = dialect.encoder(m.ResultContainer)
        self._burst_size = result.size
        self._result_id, self._result_head = result.message_id, dialect.header.size + result.size
        self._burst_reader = dialect.header.reader(result.size)
        status = dialect.encoder(m.StatusReport)
        self._status_id, self._status_size = status.message_id, dialect.header.size + status.size
        self._makes_bursts = self._is_client and result.size > 0
        self._sent_frames = {}
        self._forget_known()
        self._known_messages = {self._status_id: self._known_statuses}

    @property
    def state(self) -> State:
        """State of the link."""
        return self._state

    @state.setter
    def state(self, state: State) -> None:
        self._state = state
        self._ignores_bytes = state is State.FAILED or state is State.CLOSED
        self._is_connecting = state is State.CONNECTING
        self._receivable, self._sendable = (
            self._receive_transitions[state],
            self._send_transitions[state],
        )
        self._forget_known()

    # ------------------------------------------------------------------ bytes in

    @property
    def buffered(self) -> int:
        """Bytes of an unfinished frame; at most one header and one payload."""
        return self._framer.buffered

    @property
    def unfinished_bytes(self) -> bytes:
        """Copy of the bytes of an unfinished frame."""
        return self._framer.unfinished_bytes

    def receive_data(self, data: bytes | bytearray | memoryview) -> None:
        """Add bytes of a stream, or one whole datagram; call :meth:`events` next.

        Never raises for bad bytes. In state FAILED or CLOSED they are dropped.
        """
        if self._ignores_bytes:
            return
        self.counters.bytes_received += len(data)
        if (
            self._is_client
            or type(data) is not bytes
            or len(data) > MAX_KNOWN_CHUNK_BYTES
            or self._framer.buffered
        ):
            self._receive(data)
            return
        known = self._known_chunks.get(data)
        if known is None:
            self._receive_chunk(data)
            return
        messages, frames = known
        self._events += messages
        self.counters.frames_received += len(frames)
        if self._trace is not None:
            for frame in frames:
                self._trace(self._peer_sender, frame)

    def _receive(self, data: bytes | bytearray | memoryview) -> None:
        self._framer.feed(data)
        if self.transport is Transport.UDP:
            self._receive_datagram()
        else:
            self._receive_frames()

    def _receive_chunk(self, data: bytes) -> None:
        """Read a short chunk while no frame is unfinished; store a chunk that can be recognized.

        A chunk can be recognized if it has only whole frames that leave the state unchanged, and
        if its messages, encoded again, give exactly its bytes.
        """
        state, before = self._state, len(self._events)
        self._receive(data)
        if state is not self._state or self._framer.buffered:
            return
        messages = [event for event in self._events[before:] if isinstance(event, m.Message)]
        if len(self._known_chunks) < MAX_KNOWN_CHUNKS and messages:
            frames = [self.dialect.to_frame(message) for message in messages]
            if b"".join(map(self.dialect.encode_frame, frames)) == data:
                self._known_chunks[data] = messages, frames

    def buffer_updated(self, count: int, now: float = 0.0) -> bool:
        """Accept ``count`` bytes in the buffer of :meth:`get_buffer`, like :meth:`receive_data`.

        If the policy bounds frames, a frame that is not complete in time counts as broken.

        Args:
            count: number of the bytes.
            now: time at which they came, seconds of any clock.

        Returns:
                False if a large frame is unfinished, so that there are no events yet.
        """
        if self._ignores_bytes:
            return False
        self.counters.bytes_received += count
        has_frames, is_unfinished = self._framer.buffer_updated(count), True
        if has_frames and self._known_deliveries and self._receive_known_delivery():
            return True
        if has_frames:
            before = self.counters.frames_received
            is_unfinished = self._receive_frames()
            received = self.counters.frames_received - before
            if received > MAX_FRAMES_PER_READ or len(self._events) > MAX_EVENTS_PER_READ:
                self._framer.halve_reads()
        if is_unfinished and self._bounded:
            number = self.counters.frames_received
            if number != self._unfinished_number:
                self._unfinished_number, self._unfinished_since = number, now
            else:
                return self._reject_overdue(now) or has_frames
        return has_frames

    def receive_eof(self) -> None:
        """Record that the peer will send no more; call :meth:`events` next."""
        if self._ignores_bytes:
            return
        self._events.append(LinkEnded(pending=self._framer.buffered))
        self._framer.clear()
        self.state = State.CLOSED

    def events(self) -> list[Event]:
        """Return the events since the last call, in order; the caller owns the list."""
        events, self._events = self._events, []
        return events

    # ------------------------------------------------------------------ messages out

    def send(self, message: Message, *, answered: bool | None = None, again: bool = False) -> None:
        """Send a message; write :meth:`data_to_send` next.

        Args:
            message: the message.
            answered: True if an answer is expected to an
                :class:`~smartcam.protocols.messages.UnknownMessage`; by default as the table
                says, and True for an unknown id.
            again: True if another request of the same kind may still wait for its answer: the
                answers come in the order of the requests.

        Raises:
            LocalProtocolError: this state forbids it, it does not fit its fields, or an answer of
                the same id is pending (answers carry no request number). Nothing has changed.
        """
        kind = type(message)
        next_state = self._sendable.get(kind)
        if next_state is None:
            raise LocalProtocolError(
                f"{kind.__name__} cannot be sent by the {self.role.value} "
                f"in state {self.state.value}"
            )
        encoded, frame = self._bodiless_frames.get(kind), None
        if encoded is None:
            known = self._sent_frames.get(id(message))
            encoded, frame = self._make_frame(message) if known is None else known[1]
        data, message_id, answer_id = encoded
        if answered is not None:
            answer_id = message_id if answered else None
        if answer_id is not None and self._is_client:
            max_pending = 2 if again else 1
            if self._pending_ids.count(answer_id) >= max_pending:
                raise LocalProtocolError(
                    f"an answer to message {message_id:#04x} is still owed; only one request of an "
                    "id may be open at a time"
                )
            self._pending_ids += (answer_id,)
        if next_state is not self._state:
            self.state = next_state
        self._outbox.append(data)
        counters = self.counters
        counters.frames_sent += 1
        counters.bytes_sent += len(data)
        if self._trace is not None:
            if frame is None:
                frame = Frame(message_id, data[self._header_size :])
            self._trace(self._own_sender, frame)

    def send_all(self, messages: Sequence[Message]) -> None:
        """Send messages together, as :func:`~smartcam.protocols._machine.send_each` does.

        If the same tuple is sent again while the same answers are pending, the stored frames are
        sent.

        Raises:
            LocalProtocolError: the state forbids a message; :meth:`data_to_send` has those before.
        """
        sent_before = self._sent_together
        if sent_before is not None:
            known, data, frames, size, pending, pending_after = sent_before
            if known is messages and pending == self._pending_ids:
                self._pending_ids = pending_after
                self._outbox += data
                counters = self.counters
                counters.frames_sent += frames
                counters.bytes_sent += size
                return
        pending, state, sent = self._pending_ids, self._state, len(self._outbox)
        send_each(self, messages)
        if self._recognizes and state is self._state and isinstance(messages, tuple):
            data = self._outbox[sent:]
            frames, size = len(data), sum(map(len, data))
            data = [b"".join(data)] if self.transport is Transport.TCP else data
            self._sent_together = _SentTogether(
                messages, data, frames, size, pending, self._pending_ids
            )

    def data_to_send(self) -> list[bytes]:
        """Return the frames to write, in order: one write each on UDP, any on TCP."""
        outbox, self._outbox = self._outbox, []
        return outbox

    # ------------------------------------------------------------------ inside

    def _make_frame(self, message: Message) -> _EncodedFrame:
        """Return a message's frame; a camera's machine keeps it for the next use of that object.

        Of messages with data, such as results, only the last frame is kept.
        """
        dialect = self.dialect
        message_id = dialect.message_id(message)
        frame = dialect.to_frame(message)
        made = (dialect.encode_frame(frame), message_id, dialect.answer_id(message_id)), frame
        if not self._is_client and dialect.has(type(message)):
            if dialect.encoder(type(message)).has_data:
                self._sent_frames.pop(self._sent_data_key, None)
                self._sent_data_key = id(message)
            if len(self._sent_frames) < MAX_KNOWN_MESSAGES:
                self._sent_frames[id(message)] = message, made
        return made

    def _receive_frames(self) -> bool:
        """Make events of the whole received frames; return True if a frame is unfinished."""
        framer = self._framer
        self._receive_known_frames()
        while framer.start < len(framer.buffer):
            try:
                frame = framer.cut()
            except RemoteProtocolError as error:
                if self._reject(error):
                    return False
                framer.resync()
                continue
            if frame is None:
                return True
            message = self._receive_frame(*frame)
            if framer.start == len(framer.buffer):
                break
            if self._makes_bursts and isinstance(message, m.ResultContainer):
                self._receive_burst(message, frame[1])
            self._receive_known_frames()
        return False

    def _receive_known_frames(self) -> None:
        """Read the next messages as long as their frames are known.

        A camera has few different statuses, and sends two around each result. Statuses and pending
        answers are recognized by all bytes, results by all bytes before their data.
        """
        if not (self._known_statuses or self._known_results or len(self._known_messages) > 1):
            return
        framer, events = self._framer, self._events
        buffer, start = framer.buffer, framer.start
        if not self._recognizes or isinstance(buffer, memoryview):
            return
        find_status, size, status_id = self._known_statuses.get, self._status_size, self._status_id
        before, available = len(events), len(buffer)
        may_store = self._deliveries_left and available <= MAX_KNOWN_DELIVERY_BYTES
        pending_before = self._pending_ids if may_store and not start and not before else None
        while start < available:
            end = start + size
            message = find_status(buffer[start:end])
            if message is None:
                match = self._find_result(buffer, start)
                if match is None and self._pending_ids:
                    match = self._find_answer(buffer, start)
                if match is None:
                    break
                message, end = match
            elif status_id in self._pending_ids:
                self._remove_pending(status_id)
            events.append(message)
            start = end
        framer.start = start
        self.counters.frames_received += len(events) - before
        if pending_before is not None and 0 < start == available:
            self._store_delivery(buffer, pending_before)

    def _store_delivery(self, buffer: bytes, pending: tuple[int, ...]) -> None:
        """Store a delivery that consisted only of known frames, each of which is an event."""
        framer = self._framer
        events = [event for event in self._events if isinstance(event, m.Message)]
        results = [at for at, event in enumerate(events) if isinstance(event, m.ResultContainer)]
        self._deliveries_left -= 1
        if len(results) > 1 or len(events) > MAX_KNOWN_DELIVERY_FRAMES:
            return
        at, begin, end = len(events), len(buffer), len(buffer)  # position of the result's data
        make = None
        framer.start = 0
        for number in range(len(events)):
            frame = framer.cut()
            if frame is not None and number in results:
                at, begin, end = number, frame[1] + self._burst_size, frame[2]
                make = self._known_results[buffer[begin - self._result_head : begin]][1]
        self._known_deliveries[len(buffer)] = _Delivery(
            buffer[:begin],
            begin,
            buffer[end:],
            end,
            pending,
            self._pending_ids,
            events[:at],
            make,
            events[at + 1 :],
            len(events),
        )

    def _receive_known_delivery(self) -> bool:
        """Read a delivery that equals a stored one in all bytes except its result's data.

        Its messages are the stored delivery's, with other data in the result. Return False if no
        such delivery is stored.
        """
        framer, events = self._framer, self._events
        buffer = framer.buffer
        size = len(buffer)
        known = self._known_deliveries.get(size)
        if known is None or events or framer.start or type(buffer) is not bytes:
            return False
        head, begin, tail, end, pending, pending_after, before, make, after, frames = known
        if not (buffer.startswith(head) and buffer.endswith(tail)):
            return False
        if pending != self._pending_ids:
            return False
        self._pending_ids = pending_after
        events += before
        if make is not None:
            events.append(make(buffer[begin:end]))
            events += after
        framer.start = size
        self.counters.frames_received += frames
        return True

    def _find_result(self, buffer: bytes, start: int) -> tuple[Message, int] | None:
        """Return the next message and its end if it is a result like an earlier one.

        It must have the same application and size, and a known status or the end of the bytes must
        follow it: if another message follows, the result may begin a burst.
        """
        data = start + self._result_head
        known = self._known_results.get(buffer[start:data])
        if known is None:
            return None
        length, make = known
        end = start + length
        if end != len(buffer) and buffer[end : end + self._status_size] not in self._known_statuses:
            return None
        if self._result_id in self._pending_ids:
            self._remove_pending(self._result_id)
        return make(buffer[data:end]), end

    def _find_datagram(self, datagram: bytes) -> Message | None:
        """Return the message of a datagram that is a known status, or a result like a known one."""
        message, message_id = self._known_statuses.get(datagram), self._status_id
        if message is None:
            known, message_id = (
                self._known_results.get(datagram[: self._result_head]),
                self._result_id,
            )
            if known is None or known[0] != len(datagram):
                return None
            message = known[1](datagram[self._result_head :])
        if message_id in self._pending_ids:
            self._remove_pending(message_id)
        return message

    def _find_answer(self, buffer: bytes, start: int) -> tuple[Message, int] | None:
        """Return the next message and its end if it is a pending answer with a known frame."""
        for message_id in self._pending_ids:
            frames = self._known_messages.get(message_id)
            if frames:
                end = start + self._header_size + self._decoders[message_id].size
                message = frames.get(buffer[start:end])
                if message is not None:
                    self._remove_pending(message_id)
                    return message, end
        return None

    def _reject_overdue(self, now: float) -> bool:
        """Reject the unfinished frame if it will never be complete; return True if rejected."""
        framer, unfinished = self._framer, self._unfinished_age
        age = unfinished.age(self._unfinished_number, self._unfinished_since, now)
        if age < frame_age.HINT_TIME:
            return False
        header = self.dialect.header
        message_id, size = framer.unfinished() or (None, header.size)
        which = "a header" if message_id is None else f"a frame of message {message_id:#04x}"
        progress = f"{framer.buffered} of {size} bytes are there after {age:.1f} s"
        other = framer.header_within(unfinished.searched)
        if other is not None:
            text = f"{which} holds another header at byte {other}; {progress}"
        elif age > frame_age.FRAME_TIME + size / frame_age.MIN_BYTES_PER_SECOND:
            text = f"{which} does not become whole: {progress}"
        else:
            unfinished.searched = max(framer.buffered - header.size + 1, 0)
            return False
        data = framer.unfinished_bytes[: header.size]
        self._reject(FrameError(text, offset=other or 0, data=data))
        return True

    def _receive_datagram(self) -> None:
        framer = self._framer
        if self._recognizes and isinstance(framer.buffer, bytes):
            message = self._find_datagram(framer.buffer)
            if message is not None:
                self.counters.frames_received += 1
                self._events.append(message)
                framer.clear()
                return
        try:
            frame = framer.cut()
            if frame is None or framer.buffered:
                raise MessageError(
                    f"a datagram is not one whole frame: {hex_excerpt(framer.unfinished_bytes)}",
                    data=framer.unfinished_bytes,
                )
        except RemoteProtocolError as error:
            self._reject(error)
        else:
            self._receive_frame(*frame)
        framer.clear()

    def _receive_frame(self, message_id: int, begin: int, end: int) -> Message | None:
        """Make a message of a frame, report it and return it; return None if it is dropped.

        ``begin`` and ``end`` are the offsets of its payload in the framer's buffer.
        """
        counters, framer, size = self.counters, self._framer, end - begin
        counters.frames_received += 1
        if self._is_connecting and len(self.candidates) > 1:
            self._narrow_candidates(message_id, size)
        if self._trace is not None:
            self._trace(self._peer_sender, Frame(message_id, framer.take(begin, end)))
        codec = self._decoders.get(message_id)
        message: Message
        try:
            if codec is not None and (size == codec.size or (codec.has_data and size > codec.size)):
                message, surplus = codec.decode(framer.buffer, begin, end), 0
            else:
                message, surplus = self._decode_unusual(codec, message_id, begin, end)
            kind = type(message)
            next_state = self._receivable.get(kind)
            if next_state is None:
                raise MessageError(
                    f"{type(message).__name__} ({message_id:#04x}) came in state "
                    f"{self._state.value}, where it is not expected",
                    data=framer.take(begin, end),
                )
        except RemoteProtocolError as error:
            self._reject(error)
            return None
        if surplus > 0:
            counters.long_bodies += 1
        if next_state is not self._state:
            self.state = next_state
        elif self._recognizes and codec is not None and surplus == 0:
            self._store_known_frame(codec, message, begin, end)
        if kind in _BY_ITSELF:
            if message_id in self._pending_ids:  # answers a request, perhaps a raw one
                self._remove_pending(message_id)
        elif self._is_client and not self._accept_answer(message_id, known=codec is not None):
            return None
        self._events.append(message)
        return message

    def _decode_unusual(
        self, codec: Codec | None, message_id: int, begin: int, end: int
    ) -> tuple[Message, int]:
        """Return the message of a frame with an unknown id or another length than documented.

        Also return the number of surplus bytes, if the policy accepts them.

        Raises:
            MessageError: the body is too short, or too long.
        """
        payload = self._framer.take(begin, end)
        if codec is None:
            return m.UnknownMessage(message_id=message_id, payload=payload), 0
        if self._policy.reports_malformed:
            return m.MalformedMessage(message_id=message_id, payload=payload), 0
        surplus = len(payload) - codec.size
        if surplus > 0 and self._policy.exact_length:
            raise MessageError(
                f"message {message_id:#04x} is {surplus} bytes too long", data=payload
            )
        return codec.decode(payload, 0, len(payload)), surplus

    def _store_known_frame(self, codec: Codec, message: Message, begin: int, end: int) -> None:
        """Store a message by its frame, for this state only; ``begin``: offset of its payload."""
        frame = begin - self._header_size
        if type(message) is m.ResultContainer:
            if self._makes_bursts and len(self._known_results) < MAX_KNOWN_MESSAGES:
                head = self._framer.take(frame, begin + codec.size)
                if head not in self._known_results:
                    self._known_results[head] = end - frame, codec.make_copier(message)
        elif not codec.has_data and end - begin == codec.size:
            frames = self._known_messages.setdefault(codec.message_id, {})
            if len(frames) < MAX_KNOWN_MESSAGES:
                frames[self._framer.take(frame, end)] = message

    def _forget_known(self) -> None:
        """Forget known frames, since in another state a message may have another meaning."""
        known = (
            self._known_statuses or self._known_results or self._known_chunks or self._sent_together
        )
        if known or len(self._known_messages) > 1 or self._deliveries_left < MAX_KNOWN_DELIVERIES:
            (
                self._known_statuses,
                self._known_results,
                self._known_chunks,
                self._known_deliveries,
            ) = {}, {}, {}, {}
            self._deliveries_left, self._sent_together = MAX_KNOWN_DELIVERIES, None
            self._known_messages = {self._status_id: self._known_statuses}

    def _narrow_candidates(self, message_id: int, size: int) -> None:
        """Remove the candidates that have no such message, or another length for it."""
        decoders = [
            dialect.decoders(self._peer_sender).get(message_id) for dialect in self.candidates
        ]
        fitting_dialects = tuple(
            dialect
            for dialect, codec in zip(self.candidates, decoders, strict=True)
            if codec is not None and codec.fits(size)
        )
        if fitting_dialects and fitting_dialects != self.candidates:
            self.candidates = fitting_dialects
            self._use_dialect(fitting_dialects[0])

    def _receive_burst(self, first: m.ResultContainer, begin: int) -> None:
        """Read the next result containers, as long as they are of the same application.

        ``first`` is the last event so far; ``begin`` is the offset of its payload.
        """
        framer, head = self._framer, self._header_size + self._burst_size
        start = framer.start
        more = framer.following(self._burst_reader, begin - self._header_size, self._burst_size)
        if not more:
            return
        self.counters.frames_received += len(more)
        if self._trace is not None:
            head_bytes = framer.take(begin, begin + self._burst_size)
            for data in more:
                self._trace(self._peer_sender, Frame(self._result_id, head_bytes + data))
        size = len(first.data) + framer.start - start - len(more) * head
        more.insert(0, first.data)
        self._events[-1] = ResultBurst(application=first.application, data=more, size=size)

    def _accept_answer(self, message_id: int, *, known: bool) -> bool:
        """Record that a pending answer has come; return False for an answer to no request.

        A message with an unknown id is accepted in any case.
        """
        self.counters.unknown_ids += not known
        if message_id in self._pending_ids:
            self._remove_pending(message_id)
            return True
        self.counters.unexpected_messages += known
        return not known

    def _remove_pending(self, message_id: int) -> None:
        """Record that a pending answer has come."""
        at = self._pending_ids.index(message_id)
        self._pending_ids = self._pending_ids[:at] + self._pending_ids[at + 1 :]

    def _reject(self, error: RemoteProtocolError) -> bool:
        """Fail the link and return True, or drop and count the input, as the policy says."""
        if self._trace is not None:
            self._trace(self._peer_sender, error)
        if not isinstance(error, self._policy.fatal):
            self.counters.ignored_frames += 1
            return False
        self.state = State.FAILED
        self.error = error
        self._framer.clear()
        self._events.append(LinkFailed(error=error))
        return True
