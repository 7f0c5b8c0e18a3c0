"""Read bytes from texts of other tools: hex, escapes, dumps with offsets."""

from __future__ import annotations

import re
from typing import Final

from smartcam.exceptions import ConfigurationError

_DUMP_LINE: Final = re.compile(r"\s*(?:0x)?([0-9a-fA-F]{4,8})(?::\s+|\s{2,})(\S.*)")
_LAST_OFFSET: Final = re.compile(r"\s*(?:0x)?[0-9a-fA-F]{4,8}:?\s*")
_ESCAPES: Final = re.compile(r"(?:\\x[0-9a-fA-F]{2})+")
_NUMBERS: Final = re.compile(r"(?:0x[0-9a-fA-F]{2}[,;\s]*)+")
_SEPARATED: Final = re.compile(r"[0-9a-fA-F]{2}(?:[:-][0-9a-fA-F]{2})+")


def parse_bytes(text: str) -> bytes:
    r"""Return the bytes that a text stands for.

    It may be hex with or without blanks, with ``:`` or ``-`` between the bytes, ``0x50, 0x53``,
    ``\x50\x53``, or a dump with offsets in the form of Wireshark, ``xxd``, ``hexdump -C`` or
    ``tcpdump -X``.

    Raises:
        ConfigurationError: the offsets of a dump do not follow each other.
        ValueError: the text has no known form.
    """
    lines = [line for line in text.splitlines() if line.strip()]
    matches = [_DUMP_LINE.fullmatch(line) for line in lines]
    if len(lines) > 1 and matches[-1] is None and _LAST_OFFSET.fullmatch(lines[-1]):
        matches.pop()
    dump = [match for match in matches if match is not None]
    if dump and len(dump) == len(matches) and int(dump[0][1], 16) == 0:
        return _parse_dump(dump)
    without_blanks = re.sub(r"[\s\"']", "", text)
    if _ESCAPES.fullmatch(without_blanks):
        return bytes.fromhex(without_blanks.replace("\\x", ""))
    stripped = text.strip(" \t\r\n{}[];")
    if _NUMBERS.fullmatch(stripped) or _SEPARATED.fullmatch(stripped):
        return bytes.fromhex(re.sub(r"0x|[^0-9a-fA-F]", "", text))
    return bytes.fromhex(text)


def _parse_dump(lines: list[re.Match[str]]) -> bytes:
    """Return the bytes of a dump; the next line's offset gives the number of bytes of a line."""
    data, bytes_end = b"", 0
    for number, line in enumerate(lines, 1):
        offset = int(line[1], 16)
        if offset != len(data):
            raise ConfigurationError(
                f"decode: a hex dump whose line {number} has offset {offset:#x}: expected "
                f"{len(data):#x}, the number of bytes before it"
            )
        count = int(lines[number][1], 16) - offset if number < len(lines) else None
        part, end = _parse_dump_line(line, count, bytes_end)
        data, bytes_end = data + part, max(bytes_end, end)
    return data


def _parse_dump_line(line: re.Match[str], count: int | None, bytes_end: int) -> tuple[bytes, int]:
    """Return the bytes of a line, and the column where they end.

    Args:
        line: line of a dump.
        count: number of its bytes; None: all bytes before the dump's text column.
        bytes_end: largest column at which the bytes of an earlier line ended; 0 without one.
    """
    start = line.start(2)
    body = line.string[start:].partition("|")[0]
    if count is None and "|" not in line.string:
        body = re.split(r"\s{3,}" if bytes_end else r"\s{2,}", body)[0]
        body = body[: bytes_end - start] if bytes_end else body
    digits, end = "", start
    for token in re.finditer(r"\S+", body):
        if count is not None and len(digits) >= 2 * count:
            break
        digits, end = digits + token[0], start + token.end()
    return bytes.fromhex(digits), end
