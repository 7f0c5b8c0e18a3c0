"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

from smartcam.emulator._inside import HeardLine, LineCodec
from smartcam.protocols import Transport
from smartcam.protocols import messages as m
from tests.budgets.inputs import LINE_ROWS, TEXT_LINES
from tests.budgets.parser import Parser, streamed


def _line_codec() -> LineCodec:
    import re

    end = re.compile(rb"\n")
    return LineCodec(
        "lines", LINE_ROWS, line_end=b"\n", client_line_end=end, max_line=4096, encoding="utf-8"
    )


def _line_server(pieces: list[bytes]) -> None:
    from smartcam.emulator._inside import LineServer

    codec = _line_codec()
    server = LineServer(codec, Transport.TCP, lambda *_: None)
    for piece in pieces:
        server.receive_data(piece)
        for heard in server.events():
            assert isinstance(heard, HeardLine)
            codec.decode(m.Sender.CLIENT, codec.to_frame(heard))


PARSERS: tuple[Parser, ...] = (
    Parser(
        "lines of a client",
        _line_server,
        streamed(TEXT_LINES),
        64 << 10,
        "emulator._line_camera.MAX_INPUT_BYTES",
        size=1000,
    ),
)
