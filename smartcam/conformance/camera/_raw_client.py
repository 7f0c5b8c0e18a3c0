"""A link to the camera: a socket, a deadline for every wait, a record of every message."""

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
"""Largest number of bytes of bodies that one client keeps: 256 of the largest results. More end the
experiment."""

MAX_TRAIL = 60
"""Largest number of lines of the record that a report shows: the last ones."""

CLOSE_TIMEOUT = 0.2
"""Seconds that the camera has to close its side after a Disconnect."""

STATUS_POLL_INTERVAL = 0.01
"""Seconds between two requests for a status that does not come unasked."""


class EndedError(Exception):
    """The camera has closed the link, or is gone."""


@dataclass(eq=False)
class RawClient:
    """A TCP connection or a UDP socket; a context manager.

    Leaving it sends Disconnect if there may be a session, and closes the socket.

    Raises:
        OSError: no connection.
    """

    wire: RawDialect
    _address: tuple[str, int]
    _tcp: bool
    _timeout: float  # seconds for the connection, and for an answer
    _quiet: float  # seconds of silence that count as no answer
    _trail: deque[str]  # record of all messages
    _on_change: Callable[[], None]  # called before a message that changes the camera's state

    def __post_init__(self) -> None:
        self.received: list[ReceivedFrame] = []  # every frame that came, in order
        self.status: int | None = None  # the last status word, None if none came
        self.ended: bool = False  # the camera has ended the link
        self._began = time.monotonic()
        self._buffer = b""
        self._kept = 0
        self._may_have_session = False
        self._socket = self._open()

    def _open(self) -> socket.socket:
        if self._tcp:
            opened = socket.create_connection(self._address, timeout=self._timeout)
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return opened
        addresses = socket.getaddrinfo(*self._address, type=socket.SOCK_DGRAM)
        family, kind, proto, _, where = addresses[0]
        opened = socket.socket(family, kind, proto)
        try:
            opened.connect(where)
        except OSError:
            opened.close()
            raise
        return opened

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the session if there may be one, and close the socket; bounded."""
        with contextlib.suppress(OSError, EndedError), self._socket:
            if self.ended:
                return
            if self._may_have_session:
                self._write(self.wire.request(m.Disconnect()))
            if self._tcp:
                # closing a socket with unread bytes sends a reset, which may overtake
                self._socket.shutdown(socket.SHUT_WR)
                deadline = time.monotonic() + CLOSE_TIMEOUT
                while (left := deadline - time.monotonic()) > 0:
                    self._socket.settimeout(left)
                    if not self._socket.recv(1 << 16):
                        break

    # ------------------------------------------------------------------ out

    def send(self, *messages: m.Message) -> float:
        """Send requests, in one write on TCP and a datagram each on UDP; return the time.

        Raises:
            EndedError: the link is down.
        """
        for message in messages:
            if isinstance(message, m.Connect):
                self._may_have_session = True
            elif isinstance(message, m.Disconnect):
                self._may_have_session = False
            elif isinstance(message, _CHANGES):
                self._on_change()
        return self.write(*[self.wire.request(message) for message in messages])

    def write(self, *data: bytes) -> float:
        """Send any bytes; as :meth:`send`."""
        for frame in data:
            self._note(">", self.wire.spell_request(frame))
        at = time.monotonic()
        for frame in [b"".join(data)] if self._tcp else data:
            self._write(frame)
        return at

    def _write(self, data: bytes) -> None:
        if self.ended:
            raise EndedError("the camera has ended the link")
        self._socket.settimeout(self._timeout)
        try:
            self._socket.sendall(data)
        except OSError as exc:
            raise self._end(exc) from exc

    # ------------------------------------------------------------------ in

    def next(self, within: float) -> ReceivedFrame | None:
        """Return the next frame, None if none comes within so many seconds.

        Raises:
            EndedError: the camera ends the link.
            Differs: the camera sends bytes that make no frame.
        """
        deadline = time.monotonic() + within
        while True:
            frame = self._cut()
            if frame is not None:
                return frame
            left = deadline - time.monotonic()
            if left <= 0 or not self._receive(left):
                return None

    def _cut(self) -> ReceivedFrame | None:
        if not self._buffer:
            return None
        try:
            parts = self.wire.cut(self._buffer)
            if not self._tcp and (parts is None or parts[2] != len(self._buffer)):
                raise BadBytesError(
                    f"a datagram is not one whole frame: {hex_excerpt(self._buffer)}"
                )
        except BadBytesError as exc:
            self._note("<", hex_excerpt(self._buffer))
            self._buffer = b""
            raise Differs(f"frames of dialect {self.wire.dialect.name}", str(exc)) from exc
        if parts is None:
            return None
        message_id, body, size = parts
        self._buffer = self._buffer[size:]
        frame = ReceivedFrame(time.monotonic(), message_id, body)
        self._note("<", self.wire.spell(frame))
        self._kept += len(body)
        if self._kept > MAX_RECEIVED_BYTES:
            raise NotObserved(f"the camera sent more than {MAX_RECEIVED_BYTES} bytes meanwhile")
        self.received.append(frame)
        if message_id == MessageId.STATUS and len(body) >= self.wire.word:
            self.status = self.wire.numbers(body)[0]
        return frame

    def _receive(self, within: float) -> bool:
        if self.ended:
            raise EndedError("the camera has ended the link")
        self._socket.settimeout(within)
        try:
            data = self._socket.recv(1 << 17)
        except TimeoutError:
            return False
        except OSError as exc:
            raise self._end(exc) from exc
        if self._tcp and not data:
            raise self._end(None)
        self._buffer += data
        return True

    def _end(self, exc: OSError | None) -> EndedError:
        self.ended = True
        how = f"the camera has ended the link: {exc or 'it is closed'}"
        self._note("!", how)
        return EndedError(how)

    def _note(self, mark: str, text: str) -> None:
        self._trail.append(f"{time.monotonic() - self._began:8.3f} {mark} {text}")

    # ------------------------------------------------------------------ waits

    def until(
        self,
        fits: Callable[[ReceivedFrame], object] | int,
        within: float,
        expected: str,
        *,
        mark: int = -1,
    ) -> ReceivedFrame:
        """Return the first frame that fits, of those after ``mark`` and those that come now.

        Args:
            fits: id of the wanted message, or a function that is true for the wanted frame.
            within: seconds from now.
            expected: text of the difference if no such frame comes.
            mark: a length of :attr:`received`; default: only frames that come now.

        Raises:
            Differs: the answer does not come in time.
            EndedError: the camera ends the link.
        """
        is_it = fits if callable(fits) else lambda frame: frame.message_id == fits
        first = len(self.received) if mark < 0 else mark
        for frame in self.received[first:]:
            if is_it(frame):
                return frame
        deadline = time.monotonic() + within
        while (left := deadline - time.monotonic()) > 0:
            heard_now = self.next(left)
            if heard_now is not None and is_it(heard_now):
                return heard_now
        raise Differs(f"{expected} within {within:g} s", self.words(first))

    def answer(self, request: m.Message, *, within: float | None = None) -> ReceivedFrame:
        """Send a request and return its answer, which has its id; raises as :meth:`until`."""
        message_id = self.wire.dialect.message_id(request)
        mark = len(self.received)
        self.send(request)
        within = self._timeout if within is None else within
        return self.until(message_id, within, f"an answer to {type(request).__name__}", mark=mark)

    def trigger(self, expected: str = "a result", *, within: float | None = None) -> ReceivedFrame:
        """Send a trigger and return the next result; raises as :meth:`until`."""
        mark = len(self.received)
        self.send(m.Trigger())
        within = self._timeout if within is None else within
        return self.until(MessageId.RESULT_CONTAINER, within, expected, mark=mark)

    def fence(self) -> list[ReceivedFrame]:
        """Send a Query and return the frames before its answer: all that were on their way.

        Raises:
            Differs: the Query is not answered.
            EndedError: the camera ends the link.
        """
        mark = len(self.received)
        self.answer(m.Query())
        return self.received[mark:-1]

    def listen(self, seconds: float) -> list[ReceivedFrame]:
        """Return the frames that come in so many seconds; the end of the link ends it."""
        mark, deadline = len(self.received), time.monotonic() + seconds
        with contextlib.suppress(EndedError):
            while (left := deadline - time.monotonic()) > 0:
                self.next(left)
        return self.received[mark:]

    def words(self, first: int = 0) -> str:
        """Describe the frames from a place of :attr:`received` on, for a difference."""
        shown = [self.wire.spell(frame) for frame in self.received[first:]]
        if len(shown) > 5:
            shown = [*shown[:4], f"{len(shown) - 4} more"]
        end = ["the end of the link"] if self.ended else []
        return "; ".join(shown + end) or "nothing"

    # ------------------------------------------------------------------ the status

    def look(self) -> int:
        """Return the present status word: by a request if possible, else the last one.

        Raises:
            NotObserved: no status came since Connect.
            Differs: a request is not answered.
        """
        if self.wire.is_bid:
            self.send(m.GetStatus())
        self.fence()
        if self.status is None:
            raise NotObserved("the camera has sent no status")
        return self.status

    def wait_status(self, fits: Callable[[int], object], within: float, expected: str) -> int:
        """Wait for a status and return it; raises as :meth:`until` and :meth:`look`."""
        deadline = time.monotonic() + within
        word = self.look()
        while not fits(word):
            left = deadline - time.monotonic()
            if left <= 0:
                raise Differs(f"{expected} within {within:g} s", f"the status stays {word:#x}")
            if self.wire.is_bid:
                self.listen(STATUS_POLL_INTERVAL)
                word = self.look()
            else:
                self.next(left)
                word = word if self.status is None else self.status
        return word


_CHANGES = (m.Start, m.Stop, m.SwitchApplication, m.Reboot)
