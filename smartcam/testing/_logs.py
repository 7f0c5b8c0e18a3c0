"""Expectations on the messages on the wire, for tests of any client.

::

    emulated_camera.log.expect(Connect, Query, Trigger, ResultContainer, Disconnect)
    emulated_camera.log.expect_nothing_while_busy()
    emulated_camera.log.expect_disconnect_before_close()

Expected messages may still arrive, so each method repeats its check until its timeout. A failure is
an ``AssertionError`` that shows the log.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias, overload

from smartcam._arguments import (
    check_flag,
    check_integer,
    check_seconds,
    check_text,
    wrong_argument,
)
from smartcam.emulator._inside import MESSAGE_NAMES, known_name
from smartcam.exceptions import ConfigurationError
from smartcam.models import Status
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.emulator._inside import EndedConnection, LogEntry

Expected: TypeAlias = "type[m.Message] | m.Message | str | int"
"""A message type or its name, a message with all its fields, or a message id."""

ALLOWED_WHILE_BUSY: tuple[type[m.Message], ...] = (
    m.Connect,
    m.Query,
    m.GetStatus,
    m.Disconnect,
)
"""Messages that a client may send while the camera is BUSY, since they take none of the
camera's time (inferred)."""

MAX_SHOWN_ENTRIES = 40
"""Largest number of entries of the log that a failure shows: the last ones."""

CHECK_INTERVAL = 0.005
"""Seconds between two checks of the log."""


class CameraLog(Sequence["LogEntry"]):
    """The log of an emulated camera's traffic, oldest first; each use reads it from the camera.

    Args:
        read: function that returns the entries.
        ended_connections: function that returns the connections that have ended.
        links: function that returns the connected clients; empty without connections.
        dropped_count: function that returns the number of entries that a full log dropped.
    """

    def __init__(
        self,
        read: Callable[[], list[LogEntry]],
        ended_connections: Callable[[], list[EndedConnection]],
        links: Callable[[], list[str]],
        dropped_count: Callable[[], int] = lambda: 0,
    ) -> None:
        self._read = read
        self._dropped_count = dropped_count
        self._ended_connections = ended_connections
        self._links = links

    def __len__(self) -> int:
        return len(self._read())

    def __iter__(self) -> Iterator[LogEntry]:
        return iter(self._read())

    @overload
    def __getitem__(self, index: int, /) -> LogEntry: ...
    @overload
    def __getitem__(self, index: slice, /) -> list[LogEntry]: ...
    def __getitem__(self, index: int | slice, /) -> LogEntry | list[LogEntry]:
        """Return an entry; for a slice, a list of entries.

        Raises:
            IndexError: there is no such entry.
        """
        return self._read()[index]

    @property
    def dropped_count(self) -> int:
        """Entries dropped because the log was full; expectations about all entries then fail."""
        return self._dropped_count()

    @property
    def received(self) -> list[m.Message]:
        """Messages that clients have sent; frames that the camera refused are left out."""
        return _messages(self._read(), "in")

    @property
    def sent(self) -> list[m.Message]:
        """Messages that the camera has sent."""
        return _messages(self._read(), "out")

    # ------------------------------------------------------------------ expectations

    def expect(self, *expected: Expected, only: bool = False, timeout: float = 5.0) -> None:
        """Check that messages were transferred in a given order.

        Args:
            expected: messages of the client and of the camera; others may be between them.
            only: True if the client must have sent no other message. The camera may have sent
                others.
            timeout: seconds to wait for the messages.

        Raises:
            AssertionError: the messages did not arrive in time.
            ConfigurationError: there is no message of this name.
        """
        __tracebackhide__ = True
        only = check_flag(only, "only", "expect")
        timeout = check_seconds(timeout, "timeout", "expect")
        expectations = [_checked_expectation(message) for message in expected]
        self._expect_no_mistake(
            lambda entries: _find_order_mistake(entries, expectations, only=only),
            timeout,
            needs_whole_log=only,
        )

    def expect_nothing_while_busy(
        self, *also: type[m.Message], grace: float = 0.0, timeout: float = 0.0
    ) -> None:
        """Check that clients sent nothing between the camera's BUSY and the status without it.

        Queries, Get status, Connect and Disconnect are allowed. Messages in one TCP
        segment with the message that made the camera BUSY count as sent before.

        Args:
            also: other types of messages that are allowed.
            grace: seconds after BUSY in which a message may have been on its way already.
            timeout: seconds to repeat a failed check; a wrong message stays in the log.

        Raises:
            AssertionError: another message was sent.
        """
        __tracebackhide__ = True
        grace = check_seconds(grace, "grace", "expect_nothing_while_busy")
        timeout = check_seconds(timeout, "timeout", "expect_nothing_while_busy")
        for kind in also:
            if not (isinstance(kind, type) and issubclass(kind, m.Message)):
                raise wrong_argument("also", "types of messages", kind)
        allowed = (*ALLOWED_WHILE_BUSY, *also)
        self._expect_no_mistake(
            lambda entries: _find_message_while_busy(entries, allowed, grace),
            timeout,
            needs_whole_log=True,
        )

    def expect_disconnect_before_close(self, *, timeout: float = 5.0) -> None:
        """Check that every client with a session sent Disconnect and then closed its connection.

        Over UDP there is no connection: Disconnect has to be the last message of each client.

        Args:
            timeout: seconds to wait for the end of every session and connection.

        Raises:
            AssertionError: one of the clients did not, or is still connected.
        """
        __tracebackhide__ = True
        timeout = check_seconds(timeout, "timeout", "expect_disconnect_before_close")
        self._expect_no_mistake(self._find_unfinished_session, timeout, needs_whole_log=True)

    def expect_no_errors(self) -> None:
        """Check that the camera accepted all frames of clients.

        Raises:
            AssertionError: a frame was ignored.
        """
        __tracebackhide__ = True
        self._expect_no_mistake(_find_refused_frame, 0.0, needs_whole_log=True)

    def _find_unfinished_session(self, entries: list[LogEntry]) -> str | None:
        last: dict[str, LogEntry] = {}
        sessions: set[str] = set()
        for entry in entries:
            if entry.direction == "in":
                last[entry.peer] = entry
                if isinstance(entry.message, m.Connect):
                    sessions.add(entry.peer)
        for peer in sorted(sessions):
            if not isinstance(last[peer].message, m.Disconnect):
                visit = next((v for v in self._ended_connections() if v.peer == peer), None)
                how = "" if visit is None else f", and {_end_text(visit)}"
                return (
                    f"the last message of {peer} was {_entry_text(last[peer])}, not Disconnect{how}"
                )
        connected = sorted(sessions.intersection(self._links()))
        return f"still connected: {', '.join(connected)}" if connected else None

    def _expect_no_mistake(
        self,
        find_mistake: Callable[[list[LogEntry]], str | None],
        timeout: float,
        *,
        needs_whole_log: bool,
    ) -> None:
        """Repeat a check until it finds no mistake, or until the timeout.

        With ``needs_whole_log`` the check also fails if the log has dropped entries.
        """
        __tracebackhide__ = True
        deadline = time.monotonic() + timeout
        while True:
            entries = self._read()
            failure = find_mistake(entries)
            dropped_count = self._dropped_count()
            missing = (
                f"{dropped_count} older entries were pushed out of the full log"
                if dropped_count
                else None
            )
            if failure is None and not (missing and needs_whole_log):
                return
            if time.monotonic() >= deadline or failure is None:
                reasons = [text for text in (failure, missing) if text]
                raise AssertionError("\n".join([*reasons, _log_text(entries)]))
            time.sleep(CHECK_INTERVAL)


def _messages(entries: list[LogEntry], direction: str) -> list[m.Message]:
    return [
        entry.message
        for entry in entries
        if entry.direction == direction and entry.message is not None and entry.error is None
    ]


def _checked_expectation(expected: Expected) -> Expected:
    if isinstance(expected, type) and issubclass(expected, m.Message):
        return expected
    if isinstance(expected, m.Message):
        return expected
    if not isinstance(expected, str):
        return check_integer(expected, "expected", 0, 0xFFFFFFFF)
    expected = check_text(expected, "expected", most=200)
    try:
        return MESSAGE_NAMES[known_name(expected)]
    except ValueError as exc:
        raise ConfigurationError(str(exc)) from exc


def _matches(entry: LogEntry, expected: Expected) -> bool:
    if isinstance(expected, int):
        return entry.message_id == expected
    if isinstance(expected, type):
        return isinstance(entry.message, expected)
    return entry.message == expected


def _find_order_mistake(
    entries: list[LogEntry], expectations: list[Expected], *, only: bool
) -> str | None:
    """Return the mistake as text, None without one."""
    frames = [entry for entry in entries if entry.error is None]
    matched_count = 0
    for entry in frames:
        if matched_count < len(expectations) and _matches(entry, expectations[matched_count]):
            matched_count += 1
        elif only and entry.direction == "in":
            position = _position_text(expectations, matched_count)
            return f"the client also sent {_entry_text(entry)}, {position}"
    if matched_count == len(expectations):
        return None
    missing = _expectation_name(expectations[matched_count])
    return f"expected {missing}, {_position_text(expectations, matched_count)}; it did not come"


def _position_text(expectations: list[Expected], matched_count: int) -> str:
    done = ", ".join(_expectation_name(message) for message in expectations[:matched_count])
    return f"after {done}" if done else "at first"


def _find_message_while_busy(
    entries: list[LogEntry], allowed: tuple[type[m.Message], ...], grace: float
) -> str | None:
    busy: dict[str, float] = {}
    for entry in entries:
        message = entry.message
        if isinstance(message, m.StatusReport) and entry.direction == "out":
            if Status.BUSY not in message.status:
                busy.pop(entry.peer, None)
            else:
                busy.setdefault(entry.peer, entry.time)
        elif isinstance(message, m.Connect):
            busy.pop(entry.peer, None)
        elif entry.direction == "in" and entry.error is None and entry.peer in busy:
            busy_seconds = entry.time - busy[entry.peer]
            if not isinstance(message, allowed) and busy_seconds >= grace:
                text = _entry_text(entry)
                return f"the client sent {text} while the camera was BUSY, for {busy_seconds:g} s"
    return None


def _find_refused_frame(entries: list[LogEntry]) -> str | None:
    refused = next((entry for entry in entries if entry.direction == "in" and entry.error), None)
    return None if refused is None else f"the client sent what the camera refuses: {refused.error}"


def _end_text(visit: EndedConnection) -> str:
    manner = "reset" if visit.reset else "closed"
    return f"the {visit.ended_by} {manner} the connection"


def _expectation_name(expected: Expected) -> str:
    if isinstance(expected, type):
        return expected.__name__
    return f"message {expected:#04x}" if isinstance(expected, int) else str(expected)


def _entry_text(entry: LogEntry) -> str:
    if entry.message is not None:
        return str(entry.message)
    return f"message {entry.message_id:#04x}" if entry.message_id is not None else "no frame"


def _log_text(entries: list[LogEntry]) -> str:
    """Return the log as text for a failure."""
    lines = (
        [f"  ... {len(entries) - MAX_SHOWN_ENTRIES} before"]
        if len(entries) > MAX_SHOWN_ENTRIES
        else []
    )
    start_time = entries[0].time if entries else 0.0
    for entry in entries[-MAX_SHOWN_ENTRIES:]:
        mark = "!" if entry.error else "<" if entry.direction == "in" else ">"
        text = entry.error or _entry_text(entry)
        fault = f"  ({entry.fault})" if entry.fault else ""
        lines.append(f"  {entry.time - start_time:9.4f} s {mark} {entry.peer}  {text}{fault}")
    return "\n".join(
        ["what went over the wire (< from a client, > to it):", *(lines or ["  nothing"])]
    )
