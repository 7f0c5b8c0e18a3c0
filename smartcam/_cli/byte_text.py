"""Read bytes from texts of other tools: hex, escapes, dumps with offsets."""

from __future__ import annotations

import re
from typing import Final

from smartcam.exceptions import ConfigurationError

_DUMP_LINE: Final = re.compile(r"\s*(?:0x)?([0-9a-fA-F]{4,8})(?::\s+|\s{2,})(\S.*)")
_LAST_OFFSET: Final = re.compile(r"\s*(?:0x)?[0-9a-fA-F]{4,8}:?\s*")
_ESCAPES: Final = re.compile(r"(?:\\x[0-9a-fA-F]{2})+")
_NUMBERS: Final = re.compile(r"(?:0x[0-9a-fA-F]{2}[,;\s]*)+")
_PARTED: Final = re.compile(r"[0-9a-fA-F]{2}(?:[:-][0-9a-fA-F]{2})+")


def bytes_of_text(text: str) -> bytes:
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
        return _dumped(dump)
    plain = re.sub(r"[\s\"']", "", text)
    if _ESCAPES.fullmatch(plain):
        return bytes.fromhex(plain.replace("\\x", ""))
    bare = text.strip(" \t\r\n{}[];")
    if _NUMBERS.fullmatch(bare) or _PARTED.fullmatch(bare):
        return bytes.fromhex(re.sub(r"0x|[^0-9a-fA-F]", "", text))
    return bytes.fromhex(text)


def _dumped(lines: list[re.Match[str]]) -> bytes:
    """Return the bytes of a dump; the offsets give the number of bytes of each line."""
    data, widest = b"", 0
    for number, line in enumerate(lines, 1):
        offset = int(line[1], 16)
        if offset != len(data):
            raise ConfigurationError(
                f"decode: a hex dump whose line {number} has offset {offset:#x}: expected "
                f"{len(data):#x}, since so many bytes are before it"
            )
        after = int(lines[number][1], 16) - offset if number < len(lines) else None
        part, end = _row(line, after, widest)
        data, widest = data + part, max(widest, end)
    return data


def _row(line: re.Match[str], count: int | None, widest: int) -> tuple[bytes, int]:
    """Return the bytes of a line, and the column where they end.

    Args:
        line: line of a dump.
        count: number of its bytes; None: all bytes before the text beside them.
        widest: column at which the bytes of earlier lines ended; 0 without such lines.
    """
    start = line.start(2)
    body = line.string[start:].partition("|")[0]
    if count is None and "|" not in line.string:
        body = re.split(r"\s{3,}" if widest else r"\s{2,}", body)[0]
        body = body[: widest - start] if widest else body
    digits, end = "", start
    for token in re.finditer(r"\S+", body):
        if count is not None and len(digits) >= 2 * count:
            break
        digits, end = digits + token[0], start + token.end()
    return bytes.fromhex(digits), end
