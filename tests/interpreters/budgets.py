"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import functools
import struct

from smartcam.interpreters import Context, Reader, resolve, run
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH
from tests.budgets.parser import Make, Parser, fill


def _read_container(spec: str, data: bytes) -> None:
    interpreter = resolve(spec)
    context = Context()
    if (layout := interpreter.layout) is not None:  # whole records, or none would be looked at
        data = data[: len(data) - (len(data) - layout.head_size) % layout.size]
    run(interpreter, Reader(data, context, interpreter.layout))


_CONTAINERS: dict[str, Make] = {
    "zeros": fill(b"\0"),
    "ones": fill(b"\xff"),
    "text": fill(b"a"),
    "half, and what is no text": lambda size: bytes(size // 2) + b"\xff" * (size // 2),
    "numbers": fill(struct.pack("<f", 0.5)),
}

PARSERS: tuple[Parser, ...] = (
    *(
        Parser(
            f"containers: {spec.partition(':')[0]}",
            functools.partial(_read_container, spec),
            _CONTAINERS,
            DEFAULT_MAX_LENGTH,
            "protocols._framed.framing.DEFAULT_MAX_LENGTH",
        )
        for spec in (
            "raw",
            "strings50",
            "localizations",
            "record: n: uint16, (a: string[2], b: bool, x: real32 mm)*",
            "table: (x: real32, y: real32)*",
        )
    ),
)
