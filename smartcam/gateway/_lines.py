"""Parse a robot's requests, and format the gateway's answers."""

from __future__ import annotations

import enum
import re
from typing import TYPE_CHECKING, Final, NamedTuple
from xml.sax.saxutils import escape, quoteattr

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.gateway._settings import Style

MAX_LINE_BYTES: Final = 256
"""Largest number of bytes of a request; a longer request ends the connection."""

MAX_BRACKETED_NUMBERS: Final = 30
"""Largest number of numbers that a robot's ``socket_read_ascii_float`` can read at once (Universal
Robots' Script Manual, module interfaces)."""

MAX_NUMBER: Final = 1e9
"""Largest absolute value that an answer may have; controllers read 32-bit floats."""

_REQUEST = re.compile(rb"(?:(\d{1,9}) +)?([A-Za-z]{1,16})(?: +(\d{1,10}))?", re.ASCII)
_XML = re.compile(
    rb"<(?P<root>\w{1,30})>\s*(?:<Id>\s*(?P<id>\d{1,9})\s*</Id>\s*)?"
    rb"<Request>\s*(?P<word>[A-Za-z]{1,16})\s*</Request>\s*"
    rb"(?:<Application>\s*(?P<number>\d{0,10})\s*</Application>\s*)?</(?P=root)>",
    re.ASCII,
)
_XML_BEGIN = re.compile(rb"<(\w{1,30})>", re.ASCII)
_BLANK_RUN = re.compile(rb"[ \t\r\n\0]*")
_LINE_END = re.compile(rb"[\r\n]")
_BLANKS = b" \t\r\n\0"


class AnswerCode(enum.IntEnum):
    """The number with which each answer begins; 0 and 1 report success, the others errors."""

    OK = 0
    NO_PART = 1
    BAD_REQUEST = 10
    TOO_LONG = 11
    BUSY = 20
    TIMEOUT = 21
    NOT_CONNECTED = 22
    NOT_RUNNING = 23
    REFUSED = 24
    UNREADABLE = 25
    NO_RESULT = 26
    FAULT = 27
    FULL = 30

    @property
    def is_error(self) -> bool:
        """True if the request failed."""
        return self > AnswerCode.NO_PART


class RobotRequest(NamedTuple):
    """A request of a robot.

    Attributes:
        word: the word, in capitals; "" if the request is not valid.
        application: number after the word; None without one.
        tag: number before the word, which the answer repeats; None without one.
        text: text of the request, for errors.
    """

    word: str
    application: int | None = None
    tag: int | None = None
    text: str = ""


class RobotAnswer(NamedTuple):
    """An answer to a robot.

    Attributes:
        code: outcome of the request.
        left: number of parts of the result that the robot can still request.
        values: values of the part, or of the camera's state.
        text: the reason of an error, for people.
    """

    code: AnswerCode
    left: int = 0
    values: Sequence[float | str] = ()
    text: str = ""


class TooLongError(ValueError):
    """A request is longer than :data:`MAX_LINE_BYTES`."""


class WriteError(ValueError):
    """An answer is too long, or has a number that a controller cannot read."""


def _skip_blanks(data: bytes, start: int) -> int:
    """Return the index of the first byte from ``start`` on that is no blank or line end."""
    blanks = _BLANK_RUN.match(data, start)
    return blanks.end() if blanks else start


class RequestReader:
    """Cuts the bytes of a connection into requests.

    A line ends with CR, LF or both. Blanks and zero bytes around it are ignored, since some
    controllers send arrays of a fixed length. XML ends with the closing tag of its first element.

    Args:
        form: form of the requests: ``text``, ``brackets`` or ``xml``, as in :attr:`Style.form`.
    """

    def __init__(self, form: str) -> None:
        self._xml = form == "xml"
        self._unread = b""

    def feed(self, data: bytes) -> list[RobotRequest]:
        """Add received bytes; return the requests that are complete now.

        Raises:
            TooLongError: one of the requests is longer than :data:`MAX_LINE_BYTES`.
        """
        data, requests = self._unread + data, []
        start = _skip_blanks(data, 0)
        while (end := self._find_end(data, start)) > 0 and end - start <= MAX_LINE_BYTES:
            line = data[start:end].strip(_BLANKS)
            if line:
                requests.append(self._parse(line))
            start = _skip_blanks(data, end)
        self._unread = data[start:].lstrip(_BLANKS)
        if len(self._unread) > MAX_LINE_BYTES:
            raise TooLongError(f"a request has more than {MAX_LINE_BYTES} bytes")
        return requests

    def _find_end(self, data: bytes, start: int) -> int:
        """Return the index after the request that begins at ``start``; 0 if its end is missing."""
        begin = _XML_BEGIN.match(data, start) if self._xml else None
        if begin is None:  # a line, which may also come instead of XML
            line_end = _LINE_END.search(data, start)
            return line_end.end() if line_end else 0
        closing = b"</" + begin[1] + b">"
        end = data.find(closing, start)
        return 0 if end < 0 else end + len(closing)

    def _parse(self, line: bytes) -> RobotRequest:
        text = line.decode("ascii", "backslashreplace")[:40]
        if self._xml:
            xml = _XML.fullmatch(line)
            if xml is None:
                return RobotRequest("", text=text)
            tag, word, number = xml["id"], xml["word"], xml["number"] or None
        else:
            match = _REQUEST.fullmatch(line)
            if match is None:
                return RobotRequest("", text=text)
            tag, word, number = match.groups()
        return RobotRequest(
            word.decode().upper(),
            None if number is None else int(number),
            None if tag is None else int(tag),
            text,
        )


class AnswerWriter:
    """Writes answers in a robot's form.

    Args:
        style: the form, units and bounds.
        names: names of a part's values.
    """

    def __init__(self, style: Style, names: Sequence[str]) -> None:
        self._style, self.names = style, tuple(names)

    def write(self, answer: RobotAnswer, tag: int | None) -> bytes:
        """Return the bytes of an answer.

        Raises:
            WriteError: the answer is too long, or a number cannot be written.
        """
        style = self._style
        values = [self._value(value) for value in answer.values]
        line = getattr(self, f"_{style.form}")(answer, values, tag)
        data: bytes = line.encode("ascii", "replace")
        end = style.line_end.encode()
        if style.width:
            data = data.ljust(style.width - len(end))
        return data + end

    def _value(self, value: float | str) -> str:
        if isinstance(value, str):
            return "".join(
                " " if char == self._style.separator else char for char in to_one_line(value)
            )
        if not abs(value) < MAX_NUMBER:
            raise WriteError(f"{value} is no number that a controller reads")
        if isinstance(value, int):
            return str(int(value))
        return f"{round(value, self._style.decimals) + 0.0:.{self._style.decimals}f}"

    def _text(self, answer: RobotAnswer, values: list[str], tag: int | None) -> str:
        style = self._style
        head = [str(item) for item in (tag, int(answer.code), answer.left) if item is not None]
        line = style.separator.join([*head, *values])
        room = style.max_bytes - len(style.line_end)
        if len(line) > room:
            raise WriteError(f"an answer has {len(line)} characters, {room} are allowed")
        if answer.text:
            line = f"{line}{style.separator}{self._words(answer)}"[:room]
        return line

    def _brackets(self, answer: RobotAnswer, values: list[str], tag: int | None) -> str:
        if answer.text and not answer.code.is_error:
            return to_one_line(answer.text)[: self._style.max_bytes]  # the answer to WHY
        padded = values + ["0"] * (len(self.names) - len(values))
        head = [str(item) for item in (tag, int(answer.code), answer.left) if item is not None]
        if len(head) + len(padded) > MAX_BRACKETED_NUMBERS:
            raise WriteError(
                f"an answer has {len(head) + len(padded)} numbers, {MAX_BRACKETED_NUMBERS} are read"
            )
        return f"({','.join([*head, *padded])})"

    def _xml(self, answer: RobotAnswer, values: list[str], tag: int | None) -> str:
        # write every element: EthernetKRL queues each element separately, and reads row by row
        padded = values + ["0"] * (len(self.names) - len(values))
        part = " ".join(
            f"{name.upper()}={quoteattr(value)}"
            for name, value in zip(self.names, padded, strict=False)
        )
        words = escape(self._words(answer)[:80]) if answer.text else ""
        return (
            f"<Gateway><Id>{tag or 0}</Id><Code>{int(answer.code)}</Code>"
            f"<Left>{answer.left}</Left><Part {part}/><Words>{words}</Words></Gateway>"
        )

    @staticmethod
    def _words(answer: RobotAnswer) -> str:
        name = f"{answer.code.name} " if answer.code.is_error else ""
        return name + to_one_line(answer.text)


def to_one_line(words: str) -> str:
    """Return a text on one line, of printable characters."""
    return " ".join("".join(char if char.isprintable() else " " for char in words).split())
