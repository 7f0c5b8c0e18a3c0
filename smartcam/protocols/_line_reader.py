"""Lines, prompts and counted text, cut from a stream of bytes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam.exceptions import FrameError

if TYPE_CHECKING:
    import re


class LineReader:
    """Cuts lines, prompts and counted text from a stream of bytes.

    Args:
        ends: pattern of a line's end, one or two bytes.
        max_line: largest number of bytes of a line, without its end.
        encoding: encoding of its characters; bytes that are not valid are replaced.
    """

    def __init__(self, ends: re.Pattern[bytes], *, max_line: int, encoding: str) -> None:
        self._ends = ends
        self._max_line = max_line
        self._encoding = encoding
        self._buffer = bytearray()
        self._searched = 0  # no line end begins before this place

    def __len__(self) -> int:
        """Return the number of bytes that are kept."""
        return len(self._buffer)

    @property
    def pending(self) -> bytes:
        """Copy of the bytes that are kept."""
        return bytes(self._buffer)

    def feed(self, data: bytes) -> None:
        """Add bytes. The caller bounds the kept bytes, by :func:`len`."""
        self._buffer += data

    def next_line(self) -> str | None:
        """Return the next line without its end, None if no whole one is there.

        Raises FrameError: the line is too long; the stream cannot be read on.
        """
        match = self._ends.search(self._buffer, self._searched)
        size = match.start() if match is not None else len(self._buffer)
        # the last byte may be half of a line end
        if size > self._max_line + (match is None):
            raise FrameError(
                f"a line of more than {self._max_line} bytes came", data=self._buffer[:64]
            )
        if match is None:
            self._searched = max(0, size - 1)
            return None
        line = self._buffer[:size].decode(self._encoding, "replace")
        del self._buffer[: match.end()]
        self._searched = 0
        return line

    def take(self, size: int) -> bytes | None:
        """Return the next ``size`` bytes, None if they are not all there yet."""
        if len(self._buffer) < size:
            return None
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        self._searched = 0
        return data

    def take_prompt(self, prompt: bytes) -> bool:
        """Remove a prompt, which has no line end, if it comes next and is complete."""
        if not self._buffer.startswith(prompt):
            return False
        self.take(len(prompt))
        return True
