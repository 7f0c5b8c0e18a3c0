"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import functools

from smartcam.gateway._lines import RequestReader, TooLongError
from tests.budgets.parser import Make, Parser, fill, streamed


def _robots(form: str, pieces: list[bytes]) -> None:
    reader = RequestReader(form)
    for piece in pieces:
        reader.feed(piece)


_ROBOTS: dict[str, Make] = {
    "requests": fill(b"12 TRIGGER 7\r\n"),
    "empty lines": fill(b"\r\n"),
    "a line without an end": fill(b"A"),
    "XML": fill(b"<Robot><Id>1</Id><Request>NEXT</Request></Robot>"),
    "XML without an end": fill(b"<Robot>"),
    "zeros": fill(b"\0"),
}

PARSERS: tuple[Parser, ...] = (
    Parser(
        "robots: requests as text",
        functools.partial(_robots, "text"),
        streamed(_ROBOTS),
        256,
        "gateway._lines.MAX_LINE_BYTES",
        size=1000,
        refuses=(TooLongError,),
    ),
    Parser(
        "robots: requests as XML",
        functools.partial(_robots, "xml"),
        streamed(_ROBOTS),
        256,
        "gateway._lines.MAX_LINE_BYTES",
        size=1000,
        refuses=(TooLongError,),
    ),
)
