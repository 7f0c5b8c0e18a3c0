"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import functools
import struct

from smartcam.depth import load_cloud
from tests.budgets.parser import Make, Parser, fill, from_file


def _ply(rows: Make, *, text: bool = True, kinds: tuple[str, ...] = ("x", "y", "z")) -> Make:
    def make(size: int) -> bytes:
        body = rows(size)
        count = body.count(b"\n") if text else len(body) // (4 * len(kinds))
        form = "ascii" if text else "binary_little_endian"
        properties = "".join(f"property float {one}\n" for one in kinds)
        head = f"ply\nformat {form} 1.0\nelement vertex {count}\n{properties}end_header\n"
        made: bytes = head.encode() + body
        return made

    return make


_PLY: dict[str, Make] = {
    "rows of text": _ply(fill(b"1 2 3\n")),
    "rows of bytes": _ply(fill(bytes(12)), text=False),
    "empty lines": _ply(fill(b"\n")),
    "a line without an end": _ply(fill(b"1 ", b"1 2 3\n")),
    "long numbers": _ply(fill(b"1" * 300 + b" 2 3\n")),
    "numbers with an exponent": _ply(fill(b"1e999999999 2 3\n")),
    "what is no number": _ply(fill(b"x y z\n")),
    "comments": fill(b"comment\n", b"ply\n"),
    "a header without an end": fill(b"c", b"ply\n"),
    "elements": fill(b"element e 9\n", b"ply\nformat ascii 1.0\n"),
    "properties": lambda size: (
        b"ply\nformat ascii 1.0\nelement vertex 1\n"
        + b"".join(b"property float p%d\n" % n for n in range(size // 18))
    ),
}


def _pcd(how: str, body: bytes, points: int, count: int = 1) -> bytes:
    return (
        f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 {count}\nWIDTH {points}\n"
        f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {how}\n"
    ).encode() + body


def _packed_pcd(unit: bytes, each: int) -> Make:
    def make(size: int) -> bytes:
        packed = b"\x1f" + bytes(32) + unit * (size // len(unit))
        points = max(1, (32 + each * (size // len(unit))) // 12)
        return _pcd(
            "binary_compressed", struct.pack("<II", len(packed), 12 * points) + packed, points
        )

    return make


_PCD: dict[str, Make] = {
    "rows of text": lambda size: _pcd("ascii", b"1 2 3\n" * (size // 6), size // 6),
    "rows of bytes": lambda size: _pcd("binary", bytes(size), size // 12),
    "a line without an end": lambda size: _pcd("ascii", b"1 " * (size // 2), size // 6),
    "many numbers of a field": lambda size: _pcd(
        "ascii", (b"1 " * 258 + b"\n") * max(1, size // 517), max(1, size // 517), 256
    ),
    "packed literally": _packed_pcd(b"\0\0", 1),
    "packed to the most": _packed_pcd(b"\xe0\xff\0", 264),
    "comments": fill(b"#\n"),
}

PARSERS: tuple[Parser, ...] = (
    Parser(
        "PLY",
        from_file(functools.partial(load_cloud, unit="m"), "a.ply"),
        _PLY,
        1 << 30,
        "depth._cloud_files.MAX_FILE_BYTES",
    ),
    Parser(
        "PCD",
        from_file(functools.partial(load_cloud, unit="m"), "a.pcd"),
        _PCD,
        1 << 30,
        "depth._cloud_files.MAX_FILE_BYTES",
    ),
)
