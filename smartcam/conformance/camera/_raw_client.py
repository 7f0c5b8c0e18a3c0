"""A link to the camera: a socket, with a timeout for each wait and a log of all messages."""

from __future__ import annotations

import contextlib
import socket
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.conformance.camera._verdicts import Differs, NotObserved
from smartcam.conformance.camera._wire import BadBytesError, RawDialect, ReceivedFrame
from smartcam.exceptions import hex_excerpt
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from collections import deque
    from collections.abc import Callable
    from typing import Self

MAX_RECEIVED_BYTES = 1 << 24
"""Largest number of bytes of bodies that one client keeps: 256 of the largest results. More bytes
end the experiment."""

MAX_LOG_LINES = 60
"""Largest number of lines of the message log that a report shows: the last ones."""

CLOSE_TIMEOUT = 0.2
"""Seconds that the camera has to close its side after a Disconnect."""

STATUS_POLL_INTERVAL = 0.01
"""Seconds between two requests for a status that does not come unasked."""


class LinkClosedError(Exception):
    """The camera has closed the link, or is gone."""


@dataclass(eq=False)
class RawClient:
    """A TCP connection or a UDP socket; a context manager.

    Leaving it sends Disconnect if there may be a session, and closes the socket.

    Raises:
        OSError: there is no connection.
    """

    codec: RawDialect
    _address: tuple[str, int]
    _tcp: bool
    _timeout: float  # seconds for the connection, and for an answer
    _quiet: float  # seconds without a message that count as no answer
    _message_log: deque[str]  # record of all messages
    _on_change: Callable[[], None]  # called before a message that changes the camera's state

    def __post_init__(self) -> None:
        self.received: list[ReceivedFrame] = []  # every frame that came, in order
        self.status: int | None = None  # the last status word, None if none came
        self.ended: bool = False  # the camera has ended the link
        self._opened_at = time.monotonic()
        self._buffer = b""
        self._received_bytes = 0
        self._may_have_session = False
        self._socket = self._open()

    def _open(self) -> socket.socket:
        if self._tcp:
            sock = socket.create_connection(self._address, timeout=self._timeout)
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return sock
        addresses = socket.getaddrinfo(*self._address, type=socket.SOCK_DGRAM)
        family, kind, proto, _, address = addresses[0]
        sock = socket.socket(family, kind, proto)
        try:
            sock.connect(address)
        except OSError:
            sock.close()
            raise
        return sock

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the session if there may be one, and close the socket, within ``CLOSE_TIMEOUT``."""
        with contextlib.suppress(OSError, LinkClosedError), self._socket:
            if self.ended:
                return
            if self._may_have_session:
                self._write(self.codec.encode_request(m.Disconnect()))
            if self._tcp:
                # closing a socket with unread bytes sends RST, which may overtake the Disconnect
                self._socket.shutdown(socket.SHUT_WR)
                deadline = time.monotonic() + CLOSE_TIMEOUT
                while (remaining := deadline - time.monotonic()) > 0:
                    self._socket.settimeout(remaining)
                    if not self._socket.recv(1 << 16):
                        break

    # ------------------------------------------------------------------ out

    def send(self, *messages: m.Message) -> float:
        """Send requests and return the time; TCP gets one write, UDP a datagram for each request.

        Raises:
            LinkClosedError: the link is down.
        """
        for message in messages:
            if isinstance(message, m.Connect):
                self._may_have_session = True
            elif isinstance(message, m.Disconnect):
                self._may_have_session = False
            elif isinstance(message, _STATE_CHANGES):
                self._on_change()
        return self.write(*[self.codec.encode_request(message) for message in messages])

    def write(self, *data: bytes) -> float:
        """Send any bytes, and return the time as :meth:`send` does."""
        for frame in data:
            self._note(">", self.codec.describe_request(frame))
        sent_at = time.monotonic()
        for frame in [b"".join(data)] if self._tcp else data:
            self._write(frame)
        return sent_at

    def _write(self, data: bytes) -> None:
        if self.ended:
            raise LinkClosedError("the camera has ended the link")
        self._socket.settimeout(self._timeout)
        try:
            self._socket.sendall(data)
        except OSError as exc:
            raise self._mark_ended(exc) from exc

    # ------------------------------------------------------------------ in

    def next_frame(self, timeout: float) -> ReceivedFrame | None:
        """Return the next frame, None if none comes within ``timeout`` seconds.

        Raises:
            LinkClosedError: the camera ends the link.
            Differs: the camera sends bytes that make no frame.
        """
        deadline = time.monotonic() + timeout
        while True:
            frame = self._take_frame()
            if frame is not None:
                return frame
            remaining = deadline - time.monotonic()
            if remaining <= 0 or not self._receive(remaining):
                return None

    def _take_frame(self) -> ReceivedFrame | None:
        if not self._buffer:
            return None
        try:
            parts = self.codec.parse_frame(self._buffer)
            if not self._tcp and (parts is None or parts[2] != len(self._buffer)):
                raise BadBytesError(
                    f"a datagram is not one whole frame: {hex_excerpt(self._buffer)}"
                )
        except BadBytesError as exc:
            self._note("<", hex_excerpt(self._buffer))
            self._buffer = b""
            raise Differs(f"frames of dialect {self.codec.dialect.name}", str(exc)) from exc
        if parts is None:
            return None
        message_id, body, size = parts
        self._buffer = self._buffer[size:]
        frame = ReceivedFrame(time.monotonic(), message_id, body)
        self._note("<", self.codec.describe(frame))
        self._received_bytes += len(body)
        if self._received_bytes > MAX_RECEIVED_BYTES:
            raise NotObserved(f"the camera sent more than {MAX_RECEIVED_BYTES} bytes meanwhile")
        self.received.append(frame)
        if message_id == MessageId.STATUS and len(body) >= self.codec.word_size:
            self.status = self.codec.read_numbers(body)[0]
        return frame

    def _receive(self, timeout: float) -> bool:
        if self.ended:
            raise LinkClosedError("the camera has ended the link")
        self._socket.settimeout(timeout)
        try:
            data = self._socket.recv(1 << 17)
        except TimeoutError:
            return False
        except OSError as exc:
            raise self._mark_ended(exc) from exc
        if self._tcp and not data:
            raise self._mark_ended(None)
        self._buffer += data
        return True

    def _mark_ended(self, exc: OSError | None) -> LinkClosedError:
        self.ended = True
        text = f"the camera has ended the link: {exc or 'it is closed'}"
        self._note("!", text)
        return LinkClosedError(text)

    def _note(self, sign: str, text: str) -> None:
        self._message_log.append(f"{time.monotonic() - self._opened_at:8.3f} {sign} {text}")

    # ------------------------------------------------------------------ waits

    def wait_for_frame(
        self,
        wanted: Callable[[ReceivedFrame], object] | int,
        timeout: float,
        expected: str,
        *,
        start_index: int = -1,
    ) -> ReceivedFrame:
        """Return the first wanted frame among received frames and those that come now.

        Args:
            wanted: id of the wanted message, or a function that is true for the wanted frame.
            timeout: seconds from now.
            expected: text on the wanted frame, for the report if none comes.
            start_index: index of the first frame of :attr:`received` to look at; without it, only
                frames that come now are looked at.

        Raises:
            Differs: the answer does not come in time.
            LinkClosedError: the camera ends the link.
        """
        matches = wanted if callable(wanted) else lambda frame: frame.message_id == wanted
        first_index = len(self.received) if start_index < 0 else start_index
        for frame in self.received[first_index:]:
            if matches(frame):
                return frame
        deadline = time.monotonic() + timeout
        while (remaining := deadline - time.monotonic()) > 0:
            next_frame = self.next_frame(remaining)
            if next_frame is not None and matches(next_frame):
                return next_frame
        raise Differs(f"{expected} within {timeout:g} s", self.describe_received(first_index))

    def ask(self, request: m.Message, *, timeout: float | None = None) -> ReceivedFrame:
        """Send a request, return the next frame with its id; raise as :meth:`wait_for_frame`."""
        message_id = self.codec.dialect.message_id(request)
        start_index = len(self.received)
        self.send(request)
        timeout = self._timeout if timeout is None else timeout
        return self.wait_for_frame(
            message_id, timeout, f"an answer to {type(request).__name__}", start_index=start_index
        )

    def trigger(self, expected: str = "a result", *, timeout: float | None = None) -> ReceivedFrame:
        """Send a trigger and return the next result; raises as :meth:`wait_for_frame`."""
        start_index = len(self.received)
        self.send(m.Trigger())
        timeout = self._timeout if timeout is None else timeout
        return self.wait_for_frame(
            MessageId.RESULT_CONTAINER, timeout, expected, start_index=start_index
        )

    def round_trip(self) -> list[ReceivedFrame]:
        """Send a Query and return the frames that come before its answer.

        Raises:
            Differs: the Query is not answered.
            LinkClosedError: the camera ends the link.
        """
        start_index = len(self.received)
        self.ask(m.Query())
        return self.received[start_index:-1]

    def listen(self, seconds: float) -> list[ReceivedFrame]:
        """Return the frames that come in ``seconds``, or until the link ends."""
        start_index, deadline = len(self.received), time.monotonic() + seconds
        with contextlib.suppress(LinkClosedError):
            while (remaining := deadline - time.monotonic()) > 0:
                self.next_frame(remaining)
        return self.received[start_index:]

    def describe_received(self, start_index: int = 0) -> str:
        """Return the frames of :attr:`received` from an index on as text, at most five of them."""
        texts = [self.codec.describe(frame) for frame in self.received[start_index:]]
        if len(texts) > 5:
            texts = [*texts[:4], f"{len(texts) - 4} more"]
        end = ["the end of the link"] if self.ended else []
        return "; ".join(texts + end) or "nothing"

    # ------------------------------------------------------------------ the status

    def read_status(self) -> int:
        """Return the status word: the last received one; in the dialect ``bid``, ask for it.

        Raises:
            NotObserved: no status came since Connect.
            Differs: a request is not answered.
        """
        if self.codec.is_bid:
            self.send(m.GetStatus())
        self.round_trip()
        if self.status is None:
            raise NotObserved("the camera has sent no status")
        return self.status

    def wait_status(self, is_wanted: Callable[[int], object], timeout: float, expected: str) -> int:
        """Wait for a wanted status word and return it; raise as :meth:`read_status`, or Differs."""
        deadline = time.monotonic() + timeout
        word = self.read_status()
        while not is_wanted(word):
            remaining = deadline - time.monotonic()
            if remaining <= 0:
                raise Differs(f"{expected} within {timeout:g} s", f"the status stays {word:#x}")
            if self.codec.is_bid:
                self.listen(STATUS_POLL_INTERVAL)
                word = self.read_status()
            else:
                self.next_frame(remaining)
                word = word if self.status is None else self.status
        return word


_STATE_CHANGES = (m.Start, m.Stop, m.SwitchApplication, m.Reboot)
