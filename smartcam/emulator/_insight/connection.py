"""Clients of the emulated In-Sight camera: they log in, then their commands are carried out."""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from smartcam.emulator._line_camera import LineClient
from smartcam.models import Status
from smartcam.protocols import LineRow
from smartcam.protocols import messages as m
from smartcam.protocols._inside import ONLINE, words

if TYPE_CHECKING:
    from smartcam.emulator._client_link import ClientLink
    from smartcam.emulator._insight.camera import EmulatedInSight
    from smartcam.emulator._line_codec import LineServer

MAX_SESSIONS = 16
"""Largest number of connections at a time. For a new one, the connection that has waited longest
for its login is closed; if all are logged in, the new one is closed. The real camera's bound is not
published."""

WRITE_LIMIT = 1 << 25
"""Bytes kept for a client that does not read; if there are more, its connection ends. An image of 8
megapixels needs 17 million."""


def _read_code(line: str) -> int:
    """Return the status code of an answer; raise ValueError if it has none."""
    return int(line.partition("\r\n")[0])


def _read_value(line: str) -> int:
    """Return the number after the status code, or UNNAMED_APPLICATION without one."""
    code, _, value = line.partition("\r\n")
    return int(value) if int(code) == words.StatusCode.DONE else m.UNNAMED_APPLICATION


def _read_status(line: str) -> m.StatusReport:
    """Return the status for a mode; raise LookupError for an unknown mode."""
    return m.StatusReport(status={"0": Status(0), "1": ONLINE}[line])


ROWS = (
    LineRow(m.GetStatus, "GO", m.StatusReport, _read_status),
    LineRow(
        m.Query, "GJ", m.QueryAnswer, lambda line: m.QueryAnswer(application=_read_value(line))
    ),
    LineRow(
        m.SwitchApplication,
        "SJ{application}",
        m.SwitchAnswer,
        lambda line: m.SwitchAnswer(code=_read_code(line), application=m.UNNAMED_APPLICATION),
    ),
    LineRow(
        m.LoadFile,
        "LF{name}",
        m.SwitchAnswer,
        lambda line: m.SwitchAnswer(code=_read_code(line), application=m.UNNAMED_APPLICATION),
    ),
    LineRow(m.Start, "SO1", m.StartAnswer, lambda line: m.StartAnswer(code=_read_code(line))),
    LineRow(m.Stop, "SO0", m.StopAnswer, lambda line: m.StopAnswer(code=_read_code(line))),
    LineRow(m.Trigger, "SW8", m.TriggerAnswer, lambda line: m.TriggerAnswer(code=_read_code(line))),
    LineRow(m.ReadImage, "RI", m.Image, lambda line: m.Image(code=_read_code(line), data=b"")),
)
"""The commands that are requests of the library; a fault's ``on`` is the name of the request."""


class _LoginState(enum.Enum):
    """The progress of a client's login."""

    USER = "user"
    PASSWORD = "password"  # noqa: S105 - a state
    COMMANDS = "commands"


class TelnetClient(LineClient):
    """One client: it logs in, then its commands are carried out one by one.

    Attributes:
        number: number of the session, from 0.
    """

    def __init__(
        self, emulator: EmulatedInSight, link: ClientLink, server: LineServer, number: int
    ) -> None:
        super().__init__(emulator, link, server)
        self.number: int = number
        self._emulator = emulator
        self._state = _LoginState.USER
        self._user = ""

    @property
    def logged_in(self) -> bool:
        """True once the client is logged in, so that its commands are carried out."""
        return self._state is _LoginState.COMMANDS

    def handle_line(self, line: str) -> None:
        """Handle a line."""
        if self._state is _LoginState.COMMANDS:
            self._emulator.execute(self, line)
        elif self._state is _LoginState.USER:
            self._user = line
            self._state = _LoginState.PASSWORD
            self.hide_next_line()
            self.respond(words.PASSWORD_PROMPT)
        elif self._emulator.admits(self._user, line):
            self._state = _LoginState.COMMANDS
            self.respond(words.LOGGED_IN.encode("ascii") + words.LINE_END)
        else:
            self.say_bytes(words.INVALID_PASSWORD.encode("ascii") + words.LINE_END)
            self.end("the login was refused")

    def respond(self, data: bytes, *, more: bool = False) -> None:
        """Answer the current line; with ``more``, another call sends the remaining bytes."""
        self.say_bytes(data)
        if not more:
            self.end_line()
