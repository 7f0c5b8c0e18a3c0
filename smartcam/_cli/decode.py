"""``smartcam decode``: decode bytes by a dialect or a layout, without a camera."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.byte_text import parse_bytes
from smartcam._cli.options import DIALECTS, OUTPUT_OPTIONS, Options, async_command, option
from smartcam._cli.texts import table_text
from smartcam.exceptions import ConfigurationError, FrameError, hex_excerpt

if TYPE_CHECKING:
    from smartcam.interpreters import Interpreter
    from smartcam.models import ByteOrder
    from smartcam.protocols import Frame, FramedDialect
    from smartcam.protocols._inside import Framer
    from smartcam.protocols.messages import Sender


@click.command(
    help="Decode DATA: hex, the name of a file (binary, hex or a dump of it), or - for standard "
    "input. "
    "Frames are shown field by field (those without a magic number need --dialect); anything else "
    "is a result container's data and needs --interpret-as."
)
@click.argument("data")
@option("--interpret-as", help="Interpretation of a result container's data.")
@option("--units")
@click.option("--big-endian", is_flag=True, help="The container is big endian.")
@click.option(
    "--dialect",
    "dialect_name",
    type=click.Choice(DIALECTS),
    help="Dialect of the frames.",
)
@click.option("--quirks", metavar="NAMES", default="", help="The dialect's quirks, as in a URL.")
@async_command(*OUTPUT_OPTIONS)
async def decode(
    data: str, big_endian: bool, dialect_name: str | None, quirks: str, options: Options
) -> None:
    """Print the meaning of bytes; a frame's magic number tells its dialect."""
    from smartcam.interpreters import resolve
    from smartcam.protocols import BVS

    payload = _read_bytes(data)
    if not payload:
        raise ConfigurationError("decode: there are no bytes to decode")
    byte_order: ByteOrder = "big" if big_endian else "little"
    interpreter = None if options.interpret_as is None else resolve(options.interpret_as)
    if dialect_name is None and quirks:
        raise ConfigurationError("decode: --quirks are a dialect's: name it with --dialect")
    dialect = _find_dialect(payload) if dialect_name is None else BVS.dialects[dialect_name]
    if dialect is not None and quirks:
        dialect = dialect.with_quirks(name.strip() for name in quirks.split(","))
    if dialect is not None:
        _decode_frames(payload, dialect, interpreter, byte_order, options)
        return
    if interpreter is None:
        raise ConfigurationError(
            f"decode: {hex_excerpt(payload[:8])} begins no frame (no magic number), so "
            "--dialect must name their dialect, or --interpret-as the container's contents"
        )
    value = _interpret(payload, interpreter, byte_order)
    options.show({"value": value}, options.value_text(value))


def _read_bytes(data: str) -> bytes:
    if data == "-":
        raw = sys.stdin.buffer.read() if sys.stdin is not None else b""
    else:
        try:
            path = Path(data)
            if not path.is_file():
                return _parse_text(data)
            raw = path.read_bytes()
        except (OSError, ValueError) as exc:
            if isinstance(exc, ConfigurationError):
                raise
            raise ConfigurationError(f"decode: {data[:64]!r}: {exc}") from exc
    try:
        return parse_bytes(raw.decode("ascii"))
    except ConfigurationError:
        raise
    except ValueError:
        return raw  # a binary file


def _parse_text(data: str) -> bytes:
    try:
        return parse_bytes(data)
    except ConfigurationError:
        raise
    except ValueError as exc:
        raise ConfigurationError(
            f"decode: {data[:64]!r} is neither a file nor hex: expected two of 0-9 and a-f for "
            "each byte, such as 50 53, 50:53, 0x50, 0x53 or \\x50\\x53, or a dump with offsets"
        ) from exc


def _find_dialect(payload: bytes) -> FramedDialect | None:
    from smartcam.protocols import BVS

    for dialect in BVS.dialects.values():
        if dialect.header.magic and payload.startswith(dialect.header.magic):
            return dialect
    return None


def _decode_frames(
    payload: bytes,
    dialect: FramedDialect,
    interpreter: Interpreter | None,
    byte_order: ByteOrder,
    options: Options,
) -> None:
    from smartcam.protocols._inside import Framer

    # no frame is longer than the input, so no memory is reserved for a larger one
    framer = Framer(dialect.header, min(len(payload), dialect.header.max_payload))
    framer.feed(payload)
    offset = 0
    while (frame := _next_frame(framer, dialect)) is not None:
        _show_frame(frame, offset, dialect, interpreter, byte_order, options)
        offset += dialect.header.size + len(frame.payload)
    if framer.buffered:
        raise FrameError(
            f"decode: the last {framer.buffered} bytes, from offset {offset}, are no whole frame: "
            f"{hex_excerpt(framer.unfinished_bytes)}",
            offset=offset,
            data=framer.unfinished_bytes,
        )


def _next_frame(framer: Framer, dialect: FramedDialect) -> Frame | None:
    """Return the next frame; None if there is none, or only a part of one."""
    try:
        return framer.next_frame()
    except FrameError as exc:
        if exc.offset == len(dialect.header.magic):  # the length is wrong
            return None
        raise


def _show_frame(
    frame: Frame,
    offset: int,
    dialect: FramedDialect,
    interpreter: Interpreter | None,
    byte_order: ByteOrder,
    options: Options,
) -> None:
    """Print one frame field by field, as each message that it can be."""
    from smartcam.protocols._inside import view_fields
    from smartcam.protocols.messages import ResultContainer

    raw = dialect.encode_frame(frame)
    for sender in _possible_senders(dialect, frame):
        name = type(dialect.decode(sender, frame)).__name__  # raises if it is too short
        fields = view_fields(dialect, sender, raw)
        frame_data: dict[str, Any] = {
            "offset": offset,
            "dialect": dialect.name,
            "sender": sender.value,
            "message_id": frame.message_id,
            "message": name,
            "fields": fields,
        }
        lines = [f"at {offset}: {name} from the {sender.value}, dialect {dialect.label}"]
        rows = [
            (f.offset, f.name, hex_excerpt(f.raw), f.value if isinstance(f.value, int) else "")
            for f in fields
        ]
        lines.append(table_text(("offset", "field", "bytes", "value"), rows))
        if name == ResultContainer.__name__ and interpreter is not None:
            frame_data["value"] = _interpret(fields[-1].raw, interpreter, byte_order)
            lines.append(options.value_text(frame_data["value"]))
        options.show(frame_data, "\n".join(lines))


def _possible_senders(dialect: FramedDialect, frame: Frame) -> list[Sender]:
    """Return the senders whose message fits by id and size, else one by the id, or the camera."""
    from smartcam.protocols.messages import Sender

    exact = [
        sender
        for sender in Sender
        if dialect.knows(sender, frame.message_id) and dialect.surplus(sender, frame) == 0
    ]
    possible = [sender for sender in Sender if dialect.knows(sender, frame.message_id)]
    return exact or possible[-1:] or [Sender.CAMERA]


def _interpret(payload: bytes, interpreter: Interpreter, byte_order: ByteOrder) -> Any:
    from smartcam.interpreters import Context, Reader, run

    reader = Reader(payload, Context(byte_order=byte_order), interpreter.layout)
    return run(interpreter, reader)
