"""Read answers of In-Sight native mode: a status code, and data whose form the command sets."""

from __future__ import annotations

import binascii
from bisect import bisect_right
from itertools import accumulate
from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import FrameError
from smartcam.protocols._insight.words import (
    ENCODING,
    ENDS,
    INFO_LINES,
    LINE_END,
    MAX_LINE_BYTES,
    AnswerForm,
    StatusCode,
    checksum,
)
from smartcam.protocols._line_reader import LineReader

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

MAX_IMAGE_BYTES = 1 << 26
"""Largest number of bytes of an image that is accepted: a little more than 20 million pixels of
three bytes."""

_BMP_MAGIC = b"BM"
_BMP_SIZE_AT = slice(2, 6)  # offset of the file's size, UINT32 little endian


class CommandAnswer(NamedTuple):
    """One answer.

    Attributes:
        code: the status code; 1 for an answer that has none.
        text: the value.
        data: an image's bytes.
    """

    code: int
    text: str = ""
    data: bytes = b""


class AnswerReader(LineReader):
    """Cuts answers from a stream; the form of each depends on its command.

    The machine calls :meth:`next_answer` until it gets None, so at most one line is kept.

    Args:
        max_length: longest text accepted in an answer that states the text's length, bytes.
        on_pieces: function that is called with received pieces, and whether a line end followed
            each.
    """

    def __init__(
        self, *, max_length: int, on_pieces: Callable[[Sequence[bytes], bool], None]
    ) -> None:
        super().__init__(ENDS, max_line=MAX_LINE_BYTES, encoding=ENCODING)
        self._max_length = max_length
        self._on_pieces = on_pieces
        self._reading: Generator[None, None, CommandAnswer] | None = None

    def expect(self, form: AnswerForm) -> None:
        """Read the next answer in this form."""
        self._reading = self._read(form)

    def next_answer(self) -> CommandAnswer | None:
        """Return the expected answer, None if it is not complete yet.

        Raises FrameError: the bytes are no such answer; the stream cannot be read on.
        """
        if self._reading is None:
            return None
        try:
            next(self._reading)
        except StopIteration as stop:
            self._reading = None
            answer: CommandAnswer = stop.value
            return answer
        return None

    def next_line(self) -> str | None:
        """Return the next line as :meth:`LineReader.next_line`, and pass it to ``on_pieces``."""
        line = super().next_line()
        if line is not None:
            self._on_pieces((line.encode(ENCODING),), True)
        return line

    def take_prompt(self, prompt: bytes) -> bool:
        """Remove a prompt as :meth:`LineReader.take_prompt`, and pass it to ``on_pieces``."""
        taken = super().take_prompt(prompt)
        if taken:
            self._on_pieces((prompt,), False)
        return taken

    # ------------------------------------------------------------------ forms

    def _read(self, form: AnswerForm) -> Generator[None, None, CommandAnswer]:
        first_line = yield from self._read_line()
        if form is AnswerForm.BARE:
            return CommandAnswer(StatusCode.DONE, first_line)
        code = _parse_number(first_line, "a status code")
        if code != StatusCode.DONE or form is AnswerForm.CODE:
            return CommandAnswer(code)
        if form is AnswerForm.HEX:
            return CommandAnswer(code, data=(yield from self._read_image()))
        if form is AnswerForm.SIZED:
            return CommandAnswer(code, (yield from self._read_sized()))
        lines: list[str] = []
        for _ in range(INFO_LINES if form is AnswerForm.INFO else 1):
            line = yield from self._read_line()
            lines.append(line)
        return CommandAnswer(code, "\n".join(lines))

    def _read_line(self) -> Generator[None, None, str]:
        while (line := self.next_line()) is None:
            yield
        return line

    def _read_sized(self) -> Generator[None, None, str]:
        size = _parse_number((yield from self._read_line()), "a length")
        if not 0 <= size <= self._max_length:
            raise FrameError(f"a text of {size} bytes comes; 0 to {self._max_length} are accepted")
        while (data := self.take(size)) is None:
            yield
        self._on_pieces((data,), False)
        if end := (yield from self._read_line()):
            raise FrameError(f"{end[:64]!r} came after a text of {size} bytes, its end was due")
        return data.decode(ENCODING)

    def _read_image(self) -> Generator[None, None, bytes]:
        """Read a bitmap. Its own header gives its size: the size line may count digits instead."""
        _parse_number((yield from self._read_line()), "an image's size")
        data = bytearray()
        size, crc, is_regular = 0, "", True
        while not size or len(data) < size:
            chunk: bytes | None = b""
            if size and is_regular:
                chunk = self._take_hex_lines(2 * (size - len(data)))
                is_regular = chunk is not None
            if not chunk:
                chunk = yield from self._read_hex_line()
            data += chunk
            crc = checksum(binascii.hexlify(chunk).upper(), crc)
            if not size and len(data) >= _BMP_SIZE_AT.stop:
                size = _bitmap_size(data)
        if len(data) > size:
            raise FrameError(f"{len(data)} bytes of a bitmap of {size} bytes came")
        crc_text = yield from self._read_line()
        if crc_text.strip().upper() != crc:
            raise FrameError(f"the image's checksum is {crc_text[:16]!r}, {crc} was expected")
        return bytes(data)

    def _read_hex_line(self) -> Generator[None, None, bytes]:
        """Read one line of an image."""
        line = yield from self._read_line()
        data = _from_hex(line.encode(ENCODING))
        if not data:
            raise FrameError(f"{line[:64]!r} came, hexadecimal digits of an image were due")
        return data

    def _take_hex_lines(self, max_digits: int) -> bytes | None:
        """Remove all whole lines of an image, up to ``max_digits`` digits, and return their bytes.

        An image has thousands of lines, so they are read together. If a line is broken, remove
        nothing and return None: then the caller reads line by line, and finds the broken line.
        """
        end = self._buffer.rfind(LINE_END)
        if end < 0:
            return b""
        lines = bytes(memoryview(self._buffer)[:end]).split(LINE_END)
        if end - (len(lines) - 1) * len(LINE_END) > max_digits:
            del lines[bisect_right(list(accumulate(map(len, lines))), max_digits) :]
        digits = b"".join(lines)
        if any(not 0 < size <= MAX_LINE_BYTES or size % 2 for size in set(map(len, lines))):
            return None
        data = _from_hex(digits)
        if data:
            self.take(len(digits) + len(lines) * len(LINE_END))
            self._on_pieces(lines, True)
        return data


def _from_hex(digits: bytes) -> bytes | None:
    """Return the bytes that hexadecimal digits stand for; None for any other text."""
    try:
        return binascii.unhexlify(digits)
    except ValueError:
        return None


def _bitmap_size(data: bytearray) -> int:
    if not data.startswith(_BMP_MAGIC):
        raise FrameError("an image came that is no bitmap", data=bytes(data[:64]))
    size = int.from_bytes(data[_BMP_SIZE_AT], "little")
    if not _BMP_SIZE_AT.stop < size <= MAX_IMAGE_BYTES:
        raise FrameError(f"a bitmap of {size} bytes comes; at most {MAX_IMAGE_BYTES} are accepted")
    return size


def _parse_number(line: str, expected: str) -> int:
    text = line.strip()
    if not text.removeprefix("-").isdecimal() or not text.isascii() or len(text) > 12:
        raise unexpected_line_error(line, expected)
    return int(text)


def unexpected_line_error(line: str, expected: str) -> FrameError:
    """Return the error of a line in place of the expected one."""
    return FrameError(
        f"{line[:64]!r} came, {expected} was expected", data=line.encode(ENCODING, "replace")
    )
