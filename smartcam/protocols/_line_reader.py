"""Cut lines, prompts and texts of a given length from a stream of bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.exceptions import FrameError

if TYPE_CHECKING:
    import re


class LineReader:
    """Cuts lines, prompts and texts of a given length from a stream of bytes.

    Args:
        line_end: pattern of the end of a line, one or two bytes.
        max_line: largest number of bytes of a line, without its end.
        encoding: encoding of the characters; bytes that are not valid are replaced.
    """

    def __init__(self, line_end: re.Pattern[bytes], *, max_line: int, encoding: str) -> None:
        self._line_end = line_end
        self._max_line = max_line
        self._encoding = encoding
        self._buffer = bytearray()
        self._search_start = 0  # offset where the search for a line end goes on

    def __len__(self) -> int:
        """Return the number of bytes that are kept."""
        return len(self._buffer)

    @property
    def unfinished_bytes(self) -> bytes:
        """Copy of the bytes that are kept."""
        return bytes(self._buffer)

    def feed(self, data: bytes) -> None:
        """Add bytes. The caller limits the number of kept bytes, which :func:`len` returns."""
        self._buffer += data

    def next_line(self) -> str | None:
        """Return the next line without its end, None if there is no whole line yet.

        Raises FrameError: the line is too long; the stream cannot be read on.
        """
        match = self._line_end.search(self._buffer, self._search_start)
        size = match.start() if match is not None else len(self._buffer)
        # the last byte may be half of a line end
        if size > self._max_line + (match is None):
            raise FrameError(
                f"a line of more than {self._max_line} bytes came", data=self._buffer[:64]
            )
        if match is None:
            self._search_start = max(0, size - 1)
            return None
        line = self._buffer[:size].decode(self._encoding, "replace")
        del self._buffer[: match.end()]
        self._search_start = 0
        return line

    def take(self, size: int) -> bytes | None:
        """Remove and return the next ``size`` bytes; return None if fewer have come."""
        if len(self._buffer) < size:
            return None
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        self._search_start = 0
        return data

    def take_prompt(self, prompt: bytes) -> bool:
        """Remove a prompt if the kept bytes begin with it; return False if they do not."""
        if not self._buffer.startswith(prompt):
            return False
        self.take(len(prompt))
        return True
