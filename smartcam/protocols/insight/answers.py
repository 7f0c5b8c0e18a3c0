"""Answers of In-Sight native mode: a status code, and data whose form the command says."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import FrameError
from smartcam.protocols.insight.words import (
    ENCODING,
    INFO_LINES,
    AnswerForm,
    LineReader,
    StatusCode,
    checksum,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Generator

__all__ = ["MAX_IMAGE", "Answer", "AnswerReader"]

MAX_IMAGE = 1 << 26
"""Bytes of an image that are accepted: 20 million pixels of three bytes, and then some."""

_BMP_MAGIC = b"BM"
_BMP_SIZE_AT = slice(2, 6)  # of the file, UINT32 little endian


class Answer(NamedTuple):
    """One answer.

    Attributes:
        code: the status code; 1 for an answer that has none.
        text: the value.
        data: an image's bytes.
    """

    code: int
    text: str = ""
    data: bytes = b""


class AnswerReader:
    """Cuts answers from a stream; each has the form that its command says.

    Args:
        max_length: longest text of an answer that says its length, bytes.
        on_piece: called with each piece that came, and whether a line end stood behind it.
    """

    def __init__(self, *, max_length: int, on_piece: Callable[[str, bool], None]) -> None:
        self._lines = LineReader()
        self._max_length = max_length
        self._on_piece = on_piece
        self._reading: Generator[None, None, Answer] | None = None

    def __len__(self) -> int:
        """Bytes that wait."""
        return len(self._lines)

    @property
    def pending(self) -> bytes:
        """Copy of those bytes."""
        return self._lines.pending

    def feed(self, data: bytes) -> None:
        """Take what came; read until nothing is left to be read, then no more than a line waits."""
        self._lines.feed(data)

    def expect(self, form: AnswerForm) -> None:
        """The next answer has this form."""
        self._reading = self._read(form)

    def next_answer(self) -> Answer | None:
        """Return the expected answer, None if it is not all there yet.

        Raises:
            FrameError: what came is no such answer; the stream cannot be read on.
        """
        if self._reading is None:
            return None
        try:
            next(self._reading)
        except StopIteration as stop:
            self._reading = None
            answer: Answer = stop.value
            return answer
        return None

    def next_line(self) -> str | None:
        """Return the next line, None if no whole one is there.

        Raises:
            FrameError: it is too long.
        """
        line = self._lines.next_line()
        if line is not None:
            self._on_piece(line, True)
        return line

    def take_prompt(self, prompt: bytes) -> bool:
        """Take a prompt, which has no line end, if it is what comes next and all of it is there."""
        taken = self._lines.take_prompt(prompt)
        if taken:
            self._on_piece(prompt.decode(ENCODING), False)
        return taken

    # ------------------------------------------------------------------ forms

    def _read(self, form: AnswerForm) -> Generator[None, None, Answer]:
        first = yield from self._line()
        if form is AnswerForm.BARE:
            return Answer(StatusCode.DONE, first)
        code = _number(first, "a status code")
        if code != StatusCode.DONE or form is AnswerForm.CODE:
            return Answer(code)
        if form is AnswerForm.HEX:
            return Answer(code, data=(yield from self._image()))
        if form is AnswerForm.SIZED:
            return Answer(code, (yield from self._sized()))
        lines: list[str] = []
        for _ in range(INFO_LINES if form is AnswerForm.INFO else 1):
            line = yield from self._line()
            lines.append(line)
        return Answer(code, "\n".join(lines))

    def _line(self) -> Generator[None, None, str]:
        while (line := self.next_line()) is None:
            yield
        return line

    def _sized(self) -> Generator[None, None, str]:
        size = _number((yield from self._line()), "a length")
        if not 0 <= size <= self._max_length:
            raise FrameError(f"a text of {size} bytes comes; 0 to {self._max_length} are accepted")
        while (data := self._lines.take(size)) is None:
            yield
        text = data.decode(ENCODING)
        self._on_piece(text, False)
        if end := (yield from self._line()):
            raise FrameError(f"{end[:64]!r} came behind a text of {size} bytes, its end was due")
        return text

    def _image(self) -> Generator[None, None, bytes]:
        """Read a bitmap; its own header says how long it is, the size may count digits."""
        _number((yield from self._line()), "an image's size")
        data = bytearray()
        size = 0
        while not size or len(data) < size:
            line = yield from self._line()
            try:
                more = bytes.fromhex(line) if line.isalnum() else b""
            except ValueError:
                more = b""
            if not more:
                raise FrameError(f"{line[:64]!r} came, hexadecimal digits of an image were due")
            data += more
            if not size and len(data) >= _BMP_SIZE_AT.stop:
                size = _bitmap_size(data)
        if len(data) > size:
            raise FrameError(f"{len(data)} bytes of a bitmap of {size} bytes came")
        told = yield from self._line()
        right = checksum(data.hex().upper().encode(ENCODING))
        if told.strip().upper() != right:
            raise FrameError(f"the image's checksum is {told[:16]!r}, {right} was expected")
        return bytes(data)


def _bitmap_size(data: bytearray) -> int:
    if not data.startswith(_BMP_MAGIC):
        raise FrameError("an image came that is no bitmap", data=bytes(data[:64]))
    size = int.from_bytes(data[_BMP_SIZE_AT], "little")
    if not _BMP_SIZE_AT.stop < size <= MAX_IMAGE:
        raise FrameError(f"a bitmap of {size} bytes comes; at most {MAX_IMAGE} are accepted")
    return size


def _number(line: str, what: str) -> int:
    text = line.strip()
    if not text.removeprefix("-").isdecimal() or not text.isascii() or len(text) > 12:
        raise FrameError(
            f"{line[:64]!r} came, {what} was expected", data=line.encode(ENCODING, "replace")
        )
    return int(text)
