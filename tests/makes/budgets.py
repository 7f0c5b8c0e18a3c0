"""The parsers of smartcam.makes for :mod:`tests.budgets`, with their slowest inputs."""

from __future__ import annotations

from smartcam.makes import EmulatedIfm
from smartcam.makes._ifm.layouts import check_layout
from smartcam.protocols import LineDialect, LineMachine, Role, Transport
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH
from tests.budgets.parser import Make, Parser, drain, fill, fill_text, streamed
from tests.makes.inside import ImageChunk, read_chunks


def _ifm_machine(pieces: list[bytes]) -> None:
    dialect = EmulatedIfm.protocol.dialects["v3"]
    assert isinstance(dialect, LineDialect)
    machine = LineMachine(dialect, Role.CLIENT, Transport.TCP, max_length=DEFAULT_MAX_LENGTH)
    for piece in pieces:
        machine.receive_data(piece)
        drain(machine.events())


def _chunks(length: int) -> Make:
    """Return a function that makes an answer with images of ``length`` bytes each."""

    def make(size: int) -> bytes:
        chunk = ImageChunk(251, length, 1, 1, 0.0, bytes(length)).encoded
        data = chunk * max(1, size // len(chunk))
        return b"%09d" % len(data) + data

    return make


def _ifm_layout(element: str) -> Make:
    """Return a function that makes a layout of equal elements."""

    def make(size: int) -> str:
        elements = element * max(1, size // len(element))
        return '{"layouter":"flexible","elements":[' + elements[:-1] + "]}"

    return make


PARSERS: tuple[Parser, ...] = (
    Parser(
        "ifm: frames of a device",
        _ifm_machine,
        streamed(
            {
                "results": fill(b"0000L000000010\r\n0000abcd\r\n"),
                "a long result": lambda size: b"0000L%09d\r\n0000" % (size + 6) + bytes(size),
                "notices": fill(b"0001L000000016\r\n0001000000000:\r\n"),
                "no frames": fill(b"9"),
            }
        ),
        DEFAULT_MAX_LENGTH,
        "protocols._framed.framing.DEFAULT_MAX_LENGTH",
        size=1000,
    ),
    Parser(
        "ifm: images",
        read_chunks,
        {
            "empty chunks": _chunks(0),
            "small chunks": _chunks(16),
            "one chunk": lambda size: _chunks(size)(size),
        },
        DEFAULT_MAX_LENGTH,
        "protocols._framed.framing.DEFAULT_MAX_LENGTH",
    ),
    Parser(
        "ifm: layouts of a client",
        check_layout,
        {
            "elements": _ifm_layout('{"type":"uint8","id":"n"},'),
            "records": _ifm_layout('{"type":"records","id":"r","elements":[]},'),
            "open brackets": fill_text("["),
            "a long text": _ifm_layout('{"type":"string","id":"s","value":"aaaaaaaaaaaaaaaa"},'),
        },
        64 << 10,
        "emulator._ticketed_camera.MAX_REQUEST_BYTES",
        refuses=(ValueError, RecursionError),
    ),
)
