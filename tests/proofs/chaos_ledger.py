"""Where every result container of a chaotic link has stayed.

*Sent* is what the emulator's log shows on a link of the client's, whatever a fault made of it then.
*Received* is what the client's machine has made a message of. Each container has a serial of its
own, so the two are matched one by one, in the order in which they were sent.

On TCP what came over a link must be the beginning of what was sent over it, in order and without a
gap; what is missing behind it was lost with the link, and such a link must have ended. On UDP each
that came must have been sent.
"""

from __future__ import annotations

import struct
from array import array
from collections import Counter, deque
from typing import TYPE_CHECKING, NamedTuple

from smartcam.models import Connected, Disconnected, Reconnected
from smartcam.observers import Observer
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.link import TraceEntry
    from smartcam.emulator import EmulatedCamera
    from smartcam.models import CameraEvent

__all__ = ["NOBODY", "RECORD", "ClientEar", "Ledger"]

RECORD = struct.Struct("<5i")
"""The containers of the soak: serial, tag, number, token, application."""

NOBODY = -1
"""Tag of a run that no trigger of ours began."""

STRANGER = "second client"
"""Whose log entries are on no link of ours."""

MEMORY = 1 << 14
"""UDP: serials that are remembered; a datagram does not come later than that."""

RECENT, RECENT_WIDTH = 40, 120
"""Frames that are shown beside a violation, and characters of each."""


class _Entry(NamedTuple):
    peer: str
    serial: int


class Ledger:
    """Sent and received, for one camera and all its clients.

    Args:
        name: of the camera.
        emulator: whose log is read, and emptied by that.
        ordered: TCP.
        complain: told of what must not be.

    Attributes:
        sent: containers that the log showed.
        received: those that came.
        lost: with a link that ended; on UDP, all that did not come.
    """

    def __init__(
        self, name: str, emulator: EmulatedCamera, complain: Callable[[str], None], *, ordered: bool
    ) -> None:
        self.sent = self.received = self.lost = 0
        self._name = name
        self._emulator = emulator
        self._ordered = ordered
        self._complain = complain
        self._open: deque[_Entry] = deque()
        self._recent = array("q", bytes(8 * MEMORY))  # serials rise by one

    def read_log(self) -> None:
        """Note what was sent since the last time; the log is empty then."""
        log = self._emulator.log
        while log:
            entry = log.popleft()
            message = entry.message
            if isinstance(message, m.ResultContainer) and entry.peer != STRANGER:
                self.sent += 1
                serial = RECORD.unpack(message.data)[0]
                if self._ordered:
                    self._open.append(_Entry(entry.peer, serial))
                else:
                    self._recent[serial % MEMORY] = serial

    def on_received(self, serial: int) -> None:
        """A container came."""
        self.read_log()
        self.received += 1
        if not self._ordered:
            if self._recent[serial % MEMORY] != serial:
                self._complain(f"{self._name}: container {serial} came and was not sent")
            return
        passed: Counter[str] = Counter()
        while self._open:
            entry = self._open.popleft()
            if entry.serial == serial:
                self.lost += passed.total()
                if passed[entry.peer]:
                    gap = passed[entry.peer]
                    self._complain(f"{self._name}: {gap} containers before {serial} are missing")
                return
            passed[entry.peer] += 1
        self._complain(f"{self._name}: container {serial} came once more than it was sent")

    def close(self) -> None:
        """Everything has been heard: on the link that is open now nothing may be missing."""
        self.read_log()
        alive = set(self._emulator.sessions)
        missing = sum(entry.peer in alive for entry in self._open)
        if missing:
            self._complain(f"{self._name}: {missing} containers did not come over an open link")
        self.lost = self.sent - self.received if not self._ordered else self.lost + len(self._open)
        self._open.clear()


class ClientEar(Observer):
    """Hears what one client receives; knows which links became sessions.

    Args:
        ledger: of its camera.

    Attributes:
        before: containers of sessions, until the client was told to close.
        after: those that came later.
        closing: it was told to close.
        triggered_as: the number that was set before the last trigger, :data:`NOBODY` for none.
        recent: the last frames in both directions, for who looks into a violation.
    """

    def __init__(self, ledger: Ledger) -> None:
        self.before = self.after = 0
        self.closing = False
        self.triggered_as = NOBODY
        self.recent: deque[str] = deque(maxlen=RECENT)
        self._told = NOBODY
        self._ledger = ledger
        self._adopted = False
        self._early = 0  # of an attempt that may fail

    def on_frame(self, entry: TraceEntry) -> None:
        what = f"{entry.at:%S.%f} {entry.direction} {entry.message} {entry.fields}"
        self.recent.append(what[:RECENT_WIDTH])
        if entry.direction == ">":
            self._on_sent(entry)
        if entry.direction != "<" or entry.message != "ResultContainer":
            return
        self._ledger.on_received(RECORD.unpack(bytes.fromhex(entry.fields["data"]))[0])
        if not self._adopted:
            self._early += 1
        elif self.closing:
            self.after += 1
        else:
            self.before += 1

    def _on_sent(self, entry: TraceEntry) -> None:
        match entry.message:
            case "Connect" if not self._adopted:  # in a session it asks for the status
                self._early = 0
            case "SetSequenceNumber":
                self._told = entry.fields["number"]
            case "Trigger":
                self.triggered_as, self._told = self._told, NOBODY
            case _:
                pass

    def on_state(self, event: CameraEvent) -> None:
        if isinstance(event, (Connected, Reconnected)):
            self._adopted = True
            self.before += self._early
            self._early = 0
        elif isinstance(event, Disconnected):
            self._adopted = self.closing
