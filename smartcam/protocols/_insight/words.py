"""Lines, commands, status codes and cell names of Cognex In-Sight native mode, for both ends.

Native mode is text over telnet (TCP port 23). The client sends one command a line, the camera
answers with a status code on a line of its own and, for some commands, data after it. Nothing in
this module does input or output.

``docs/insight.md`` has the sources of the facts: *manual* is the maker's published help,
*clients* are public clients and records of their traffic (derived).
"""

from __future__ import annotations

import binascii
import enum
import re
from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import ConfigurationError
from smartcam.protocols._line_reader import LineReader

if TYPE_CHECKING:
    from collections.abc import Mapping

DEFAULT_PORT = 23
"""The telnet port (manual, published)."""

ENCODING = "latin-1"
"""Encoding of all texts: a value with a degree sign came as the one byte B0 (derived)."""

LINE_END = b"\r\n"
"""The end of each line over telnet, in both directions (manual, published)."""

WELCOME = "Welcome to In-Sight"
"""The beginning of the camera's first line (clients, derived)."""

USER_PROMPT = b"User: "
"""The prompt for the user, which no line end follows (clients, derived)."""

PASSWORD_PROMPT = b"Password: "
"""The prompt for the password, which no line end follows (clients, derived)."""

LOGGED_IN = "User Logged In"
"""The line after which the camera accepts commands (clients, derived)."""

INVALID_PASSWORD = "Invalid Password"  # noqa: S105 - the camera's words
"""The line that refuses a login (clients, derived)."""

MAX_LINE_BYTES = 4096
"""Largest number of bytes of a line, without its end, that either side accepts. The longest
regular lines are values of cells; the camera's own bound is not published."""

LAST_COLUMN = "Z"
"""The last column of the spreadsheet; the first one is A (manual, published)."""

LAST_ROW = 399
"""The last row of the spreadsheet; the first one is 0 (manual, published)."""

MAX_CELLS = 1024
"""Largest number of cells that a range, or a result, may have. Ranges are an addition of this
library: each cell is read by a separate command, which takes a round trip."""

LAST_JOB_ID = 999
"""The largest id of a job; the first one is 0 (manual, published)."""

TRIGGER_EVENT = 8
"""The event that acquires an image; 0 to 7 are soft events of the job (manual, published)."""

ERROR_VALUE = "#ERR"
"""The text of a cell whose function failed (manual, published)."""

HEX_WIDTH = 80
"""Number of hexadecimal digits in a line of image data (manual, published)."""


class StatusCode(enum.IntEnum):
    """The number that begins an answer (manual, published). Its meaning depends on the command.

    :func:`code_text` returns the meaning for a command.
    """

    DONE = 1
    UNRECOGNIZED = 0
    INVALID_ARGUMENT = -1
    FAILED = -2
    CHECKSUM_OR_READ_ONLY = -3
    OUT_OF_MEMORY_OR_WRONG_TYPE = -4
    STILL_OFFLINE = -5
    NO_ACCESS = -6


class AnswerForm(enum.Enum):
    """The parts of an answer. Nothing follows a code other than 1."""

    CODE = "code"
    """The code, nothing else."""
    BARE = "bare"
    """One line with the value, without a code before it."""
    LINE = "line"
    """The code, then one line."""
    INFO = "info"
    """The code, then five lines of the form ``name: value``."""
    SIZED = "sized"
    """The code, a line with a number, that number of characters, then a line end."""
    HEX = "hex"
    """The code, a line with a size, lines of hexadecimal digits, a line with their checksum."""


class CommandMode(enum.Enum):
    """The mode of the camera that a command needs."""

    ANY = "any"
    ONLINE = "online"
    OFFLINE = "offline"


class CommandRow(NamedTuple):
    """One command.

    Attributes:
        mnemonic: the command's two letters, in upper or lower case (manual, published).
        title: name of the command in the manual.
        arguments: text after the letters, without a space unless one is shown.
        form: form of the answer.
        mode: mode in which the command is possible; in the other mode the answer is -2.
        codes: meaning of the status codes other than 1 and 0.
        source: document that the row is from, and whether that is published by the maker, or
            derived from traffic.
    """

    mnemonic: str
    title: str
    arguments: str
    form: AnswerForm
    mode: CommandMode
    codes: Mapping[int, str]
    source: str


INFO_LINES = 5
"""Number of lines in the answer to ``GI`` (clients, derived)."""

_NO_ACCESS = {-6: "the user has no full access"}
_EVENT = {
    -1: "the event is no number from 0 to 8",
    -2: "not possible, or the camera is offline",
    **_NO_ACCESS,
}
_LOAD = "the camera is online, there is no such job, or it failed to load"
_NO_MEMORY = {-4: "out of memory", **_NO_ACCESS}
_SET_FAILURES = {
    -3: "the cell is read-only (newer firmware)",
    -4: "wrong type (newer firmware)",
    **_NO_ACCESS,
}
_ANY, _ONLINE, _OFFLINE = CommandMode
_MANUAL = "manual: published"
_CLIENTS = "clients: derived"

_ROWS = (
    CommandRow("GO", "Get Online", "", AnswerForm.BARE, _ANY, {}, _CLIENTS),
    CommandRow(
        "SO",
        "Set Online",
        "0 or 1",
        AnswerForm.CODE,
        _ANY,
        {
            -1: "neither 0 nor 1",
            -2: "not possible",
            -5: "accepted, but an operator or an input holds the camera offline",
            **_NO_ACCESS,
        },
        _MANUAL,
    ),
    CommandRow("SE", "Set Event", "0 to 8", AnswerForm.CODE, _ONLINE, _EVENT, _CLIENTS),
    CommandRow("SW", "Set Event and Wait", "0 to 8", AnswerForm.CODE, _ONLINE, _EVENT, _CLIENTS),
    CommandRow(
        "LF",
        "Load File",
        "FILE",
        AnswerForm.CODE,
        _OFFLINE,
        {-1: "the file name is missing", -2: _LOAD, **_NO_MEMORY},
        _CLIENTS,
    ),
    CommandRow(
        "GF",
        "Get File",
        "",
        AnswerForm.LINE,
        _ANY,
        {-2: "the active job was never saved"},
        _CLIENTS,
    ),
    CommandRow(
        "SJ",
        "Set Job",
        "ID",
        AnswerForm.CODE,
        _OFFLINE,
        {-1: "the id is no number, or negative", -2: _LOAD, **_NO_MEMORY},
        _CLIENTS,
    ),
    CommandRow(
        "GJ",
        "Get Job",
        "",
        AnswerForm.LINE,
        _ANY,
        {-2: "the active job was never saved, or its name does not begin with a number"},
        _CLIENTS,
    ),
    CommandRow(
        "GV",
        "Get Value",
        "CELL or NAME",
        AnswerForm.LINE,
        _ANY,
        {-1: "no such cell or name", -2: "not possible"},
        _CLIENTS,
    ),
    CommandRow(
        "SI",
        "Set Integer",
        "CELL VALUE without a space, or NAME VALUE",
        AnswerForm.CODE,
        _ANY,
        {
            -1: "no such cell or name, or no integer",
            -2: "out of the control's range, or the cell has no control for integers",
            **_SET_FAILURES,
        },
        _MANUAL,
    ),
    CommandRow(
        "SF",
        "Set Float",
        "CELL VALUE without a space, or NAME VALUE",
        AnswerForm.CODE,
        _ANY,
        {
            -1: "no such cell or name, or no number",
            -2: "the cell has no control for numbers",
            **_SET_FAILURES,
        },
        _CLIENTS,
    ),
    CommandRow(
        "SS",
        "Set String",
        "CELL TEXT without a space, or NAME TEXT",
        AnswerForm.CODE,
        _ANY,
        {
            -1: "no such cell or name",
            -2: "too long, or the cell has no control for texts",
            **_SET_FAILURES,
        },
        _MANUAL,
    ),
    CommandRow("GI", "Get Info", "", AnswerForm.INFO, _ANY, {-2: "not possible"}, _CLIENTS),
    CommandRow(
        "EV",
        "Evaluate",
        " EXPRESSION",
        AnswerForm.SIZED,
        _ANY,
        {-1: "no such cell", -2: "not possible", **_NO_MEMORY},
        _MANUAL,
    ),
    CommandRow("RI", "Read Image", "", AnswerForm.HEX, _ANY, _NO_MEMORY, _MANUAL),
    CommandRow("RB", "Read BMP", "", AnswerForm.HEX, _ANY, _NO_MEMORY, _MANUAL),
)

COMMANDS: Mapping[str, CommandRow] = {row.mnemonic: row for row in _ROWS}
"""The commands that this library knows, by mnemonic. The camera has more."""

_COMMON_TEXTS = {1: "done", 0: "the camera does not know the command"}
_GENERAL_TEXTS = {
    **_COMMON_TEXTS,
    -1: "the argument is wrong",
    -2: "not possible",
    -3: "wrong checksum, or a cell that is read-only",
    -4: "out of memory, or a value of the wrong type",
    -5: "accepted, but an operator or an input holds the camera offline",
    **_NO_ACCESS,
}
"""Meanings of the codes in the answer to a command that this library does not know."""


def code_text(command: str, code: int) -> str:
    """Return the meaning of a status code in the answer to a command, in words.

    ``command``: the command line, or its two letters.
    """
    row = COMMANDS.get(command[:2].upper())
    texts = _GENERAL_TEXTS if row is None else {**_COMMON_TEXTS, **row.codes}
    return texts.get(code, "a code that is not documented for this command")


# ---------------------------------------------------------------------- cells


class Cell(NamedTuple):
    """A cell of the spreadsheet.

    Attributes:
        column: letter of the column, upper case.
        row: number of the row, 0 to 399.
    """

    column: str
    row: int

    @property
    def wire(self) -> str:
        """The cell as commands name it: the letter and three digits (manual, published)."""
        return f"{self.column}{self.row:03d}"

    def __str__(self) -> str:
        return f"{self.column}{self.row}"


_CELL = re.compile(r"([A-Za-z])([0-9]{1,3})", re.ASCII)
_WIRE_CELL = re.compile(r"([A-Za-z])([0-9]{3})", re.ASCII)
_TAG = re.compile(r"[A-Za-z_][A-Za-z0-9_.]{0,126}", re.ASCII)
_CELL_LIKE = re.compile(r"[A-Za-z][0-9]+", re.ASCII)
_JOB_NUMBER = re.compile(r"([0-9]{1,3})(?![0-9])", re.ASCII)


def parse_cell(text: str) -> Cell:
    """Read a cell as people write it, ``A1`` or ``b012``; ConfigurationError: no such cell."""
    match = _CELL.fullmatch(text)
    if match is None or int(match[2]) > LAST_ROW:
        raise ConfigurationError(
            f"{text!r} is no cell: expected a column A to {LAST_COLUMN} and a row 0 to {LAST_ROW}"
        )
    return Cell(match[1].upper(), int(match[2]))


def parse_cells(text: str) -> list[Cell]:
    """Read a cell or a rectangle of cells, such as ``B2:D4``: row by row, each from left to right.

    Raises ConfigurationError: the text is neither, its corners are not top left and bottom right,
    or it has more than 1024 cells.
    """
    first_text, colon, last_text = text.partition(":")
    first = parse_cell(first_text)
    last = parse_cell(last_text) if colon else first
    if last.column < first.column or last.row < first.row:
        raise ConfigurationError(f"{text!r}: the second cell lies left of the first, or above it")
    columns = [chr(code) for code in range(ord(first.column), ord(last.column) + 1)]
    rows = range(first.row, last.row + 1)
    if len(columns) * len(rows) > MAX_CELLS:
        raise ConfigurationError(
            f"{text!r} has {len(columns) * len(rows)} cells, more than {MAX_CELLS}"
        )
    return [Cell(column, row) for row in rows for column in columns]


def parse_wire_cell(text: str) -> tuple[Cell, str] | None:
    """Read the cell at the beginning of a command's argument: a letter and exactly three digits.

    Returns the cell and the text after it; None if no cell stands there.
    """
    match = _WIRE_CELL.match(text)
    if match is None or int(match[2]) > LAST_ROW:
        return None
    return Cell(match[1].upper(), int(match[2])), text[match.end() :]


def parse_tag(text: str) -> str:
    """Read a cell's name: letters, digits, underscores and dots, at most 127 (manual, published).

    Two names that differ only in case are the same (manual, published), so the name is returned in
    lower case. Raises ConfigurationError: the name is not valid, or has the form of a cell.
    """
    if not _TAG.fullmatch(text) or _CELL_LIKE.fullmatch(text):
        raise ConfigurationError(
            f"{text!r} is no name of a cell: expected 1 to 127 letters, digits, '_' and '.', "
            "no digit first, not the form of a cell"
        )
    return text.lower()


def job_id(file: str) -> int | None:
    """Return the id of a job: the number that its file name begins with (manual, published).

    None if it begins with no number, or one above 999.
    """
    match = _JOB_NUMBER.match(file)
    return None if match is None else int(match[1])


# ---------------------------------------------------------------------- data


def checksum(digits: bytes, before: str = "") -> str:
    """Return the checksum of hexadecimal data: CRC-16 with polynomial 0x1021, first value 0.

    It is calculated over the digits as upper-case characters, without line ends (manual,
    published).
    ``before``: checksum of the preceding digits.
    """
    return f"{binascii.crc_hqx(digits, int(before or '0', 16)):04X}"


def hex_lines(data: bytes) -> tuple[int, bytes]:
    """Write data as the camera sends it.

    Returns the number of hexadecimal digits, and the lines: 80 digits each, then the checksum.
    """
    digits = binascii.hexlify(data).upper()
    # negative: the short line is the last one
    lines = binascii.hexlify(data, b"\n", -HEX_WIDTH // 2).upper().replace(b"\n", LINE_END)
    tail = checksum(digits).encode("ascii") + LINE_END
    return len(digits), lines + LINE_END * bool(lines) + tail


# ---------------------------------------------------------------------- lines

ENDS = re.compile(rb"\r\n")
"""The end of a line from the camera."""

COMMAND_ENDS = re.compile(rb"\r\n|\r?\x00")
r"""The end of a line from a client: CR LF, or a byte NUL (manual, published). A CR directly before
a NUL is dropped, since ``\r\0`` is telnet's form of a single CR."""


def command_reader() -> LineReader:
    """Return a new reader that cuts a client's bytes into lines."""
    return LineReader(COMMAND_ENDS, max_line=MAX_LINE_BYTES, encoding=ENCODING)
