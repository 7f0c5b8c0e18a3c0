"""First inputs: the frames of the golden vectors, the layouts and scenarios of the documents."""

from __future__ import annotations

import contextlib
import re
import struct
import tomllib
from collections.abc import Callable, Iterator
from typing import Any

from smartcam.exceptions import LayoutError
from smartcam.layout import Layout
from smartcam.protocols import Role, State, Transport
from smartcam.protocols import messages as m
from tests import ROOT
from tests.emulator.builtins import BUILTIN_APPLICATIONS, LOCALIZATIONS
from tests.fuzz.fuzz_interpreters import SPECS
from tests.machines import DIALECTS

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
VECTORS = ROOT / "tests" / "data" / "vectors.toml"
FILES = (*sorted((ROOT / "examples").rglob("*.yaml")),)
LAYOUT = re.compile(r"\"([^\"\n]*\w: ?(?:u?int\d|real\d|bool|string\[)[^\"\n]*)\"")
URL = re.compile(r"bvs(?:\+udp)?://[^\s\"'`)>]+")

ODD_YAML = (
    "&a {name: *a}",
    "applications: &a [{id: *a}, *a]",
    "<<: [{name: x}, {seed: 1}]",
    'name: "\\ud800 \\U0001F600"',
    "? [name]\n: 1",
    "seed: 1:30:30",
    "active: 0xffffffffffffffffffffff",
    "running: 2001-01-01 00:00:00 +23:59",
    "name: !!binary aGVsbG8=",
    "applications: !!pairs [id: 5]",
    "name: &x [a, a]\nactive: &y [*x, *x]\nseed: &z [*y, *y]\nquirks: [*z, *z]",
    'applications:\n  - {id: 5, layout: "n: int32", constant: [.nan]}',
    'applications:\n  - {id: 5, layout: "s: string[3]", constant: {s: "\\ud800"}}',
    'applications:\n  - {id: 5, layout: "(s: string[9])*", slots: 65535, constant: []}',
    'applications:\n  - {id: 5, layout: "n: int32", generator: input, input: "n: int32"}',
    'applications:\n  - {id: 5, layout: "x: real32", generator: tangram, parameters: {pieces: 5}}',
    'applications:\n  - {id: 5, layout: "n: int8", generator: sequence, rate: 1000}\nrunning: true',
)
"""Texts that YAML allows and nobody writes."""

WRONG_LAYOUTS = (
    "x: int8, x: int8",
    "n: bool, (x: int8)[n]",
    "n: int8, (x: int8)[m]",
    "(x: int8)[0]",
    "s: string[65536]",
    "records: int8, (x: int8)*",
    "a: int8 @sequence, b: int8 @sequence",
    "x: bool mm",
    "class: int8",
    "(x: (y: int8)*)*",
    "x: float",
    "x: int8 y: int8",
    "_x: int8",
)
"""Mistakes that a text can have."""

PART = struct.pack("<50sfifff", b"bolt", 0.98, 0, 0.112, 0.045, 0.31)


def seeds(name: str) -> list[bytes]:
    """Return the first inputs of a target, each once."""
    return list(dict.fromkeys(_MAKERS[name]()))


def vectors() -> Iterator[tuple[int, m.Sender, bytes]]:
    """Yield dialect's place, sender and bytes of every golden vector."""
    tables: dict[str, list[dict[str, Any]]] = tomllib.loads(VECTORS.read_text(encoding="utf-8"))
    for place, dialect in enumerate(DIALECTS):
        for one in tables["_".join(("bvs", dialect.name, *dialect.quirks))]:
            yield place, m.Sender(one["sender"]), bytes.fromhex(one["hex"])


def broken_lengths(place: int, frame: bytes, limit: int) -> Iterator[bytes]:
    """Yield a frame with lengths that are impossible, too large, or one too small or too large."""
    begin, end = (4, 8) if DIALECTS[place].header.magic else (2, 4)
    most = (1 << 8 * (end - begin)) - 1
    length = int.from_bytes(frame[begin:end], "little")
    for wrong in {0, 3, length - 1, length + 1, limit + 1, limit + 5, most} - {-1, length}:
        yield frame[:begin] + wrong.to_bytes(end - begin, "little") + frame[end:]


def documents() -> str:
    """Return the text of every page."""
    return "\n".join(page.read_text(encoding="utf-8") for page in PAGES)


def layouts() -> Iterator[str]:
    """Yield the layout texts of the documents and of the built-in applications."""
    yield from (application.layout or "" for application in BUILTIN_APPLICATIONS)
    yield from LAYOUT.findall(documents())
    yield from WRONG_LAYOUTS


def _framing() -> Iterator[bytes]:
    limit, as_bytes, cuts = 64, 0, (b"\0", b"\1\5", b"\1\1", b"\2\0\x0d")
    for turn, (place, _, frame) in enumerate(vectors()):
        yield bytes((place, limit, as_bytes)) + cuts[turn % len(cuts)] + frame
        if turn % 4 == 0:
            yield bytes((place, limit, turn % 3)) + cuts[1] + frame[3:] + frame + frame[:7]
    for place, _, frame in vectors():
        for broken in broken_lengths(place, frame, limit):
            yield bytes((place, limit, as_bytes, 0)) + broken + frame


def _messages() -> Iterator[bytes]:
    for place, sender, frame in vectors():
        dialect = DIALECTS[place]
        begin, end = (8, 12) if dialect.header.magic else (0, 2)
        number = int.from_bytes(frame[begin:end], "little")
        row = next(i for i, row in enumerate(dialect.table) if row.message_id == number)
        sent_by = list(m.Sender).index(sender)
        yield bytes((place, sent_by, row)) + frame[dialect.header.size :]
        yield bytes((place, sent_by, 0xFF)) + frame[begin:end] + frame[dialect.header.size :]


def _machine() -> Iterator[bytes]:
    connecting, connected = (list(State).index(one) for one in (State.CONNECTING, State.CONNECTED))
    for place, sender, frame in vectors():
        role = list(Role).index(Role.CLIENT if sender is m.Sender.CAMERA else Role.CAMERA)
        for transport in range(len(Transport)):
            for state in (0, connecting, connected):
                start = bytes((place, role, transport, 0, state, 64))
                yield start + bytes((0, len(frame))) + frame
                for broken in broken_lengths(place, frame, 64):
                    yield start + bytes((0, len(frame))) + broken + bytes((0, len(frame))) + frame
    # a session in the client's role: what it says, and what comes to that
    says = [bytes((5, place, 0)) for place in range(18)]
    frames = [f for place, who, f in vectors() if place == 0 and who is m.Sender.CAMERA]
    hears = b"".join(bytes((0, len(frame))) + frame for frame in frames[:4])
    yield bytes((0, 0, 0, 0, 0, 64)) + says[0] + hears + says[5] + hears + says[7] + says[9] + hears


MAKES_SAY: tuple[tuple[int, int, bytes], ...] = (
    (0, 0, b"1002L000000010\r\n1002star\r\n1003L000000020\r\n1003003\t07\t01\t07\r\n"),
    (0, 0, b"0000L000000010\r\n0000star\r\n1002L000000007\r\n1002!\r\n"),
    (1, 0, b"1002L000000007\r\n1002*\r\n0001L000000016\r\n0001110001006:\r\n"),
    (0, 0, b"1002L000000005\r\n1002\r\n"),
    (2, 1, b"L000000006\r\nstar\r\nL000000012\r\n001\t01\t01\r\n"),
    (4, 2, b"0000old\r\n1002star\r\n1003001\t01\t01\r\n"),
    (6, 3, b"star\r\n001\t01\t01\r\n"),
    (8, 4, b"RT,00001,OK,01,NG,0000095\rPR,007\r"),
    (8, 4, b"ER,T2,03\rPR,007\rPW\r"),
    (9, 5, b"OK,NUM,1,0\r4006381333931\rERROR\rOK,BUSYSTAT,NONE\r"),
    (9, 5, b"ER,LON,20\rER,LOFF,20\r4006381333931\r"),
)
"""By the places of dialect and greeting: what a device of another make says."""


def _makes() -> Iterator[bytes]:
    for dialect, greeting, stream in MAKES_SAY:
        yield bytes((dialect, 3, 0, 1, 2, 3, 1, 4, 2, greeting)) + stream
        yield bytes((dialect, 2, 0, 3, 5, *range(5), greeting)) + stream
        yield bytes((dialect, 0, 0, greeting)) + stream


def _layout() -> Iterator[bytes]:
    payload = bytes.fromhex("ff 02000000 0000cb42 000050c0 4142430000000000")
    for turn, text in enumerate(layouts()):
        yield text.encode() + b"\0" + bytes(((4, 6, 4 + 8, 4 + 16, 4 + 32)[turn % 5], 2)) + payload


def _interpreters() -> Iterator[bytes]:
    for place in range(len(SPECS)):
        for options in (0, 4, 6):
            yield bytes((place, options, place % 2, 1)) + PART
    yield bytes((0, 0, 0, 9)) + PART + bytes(len(PART)) + PART
    yield bytes((4, 0, 0, 9)) + b"a short text".ljust(50, b"\0") + b"x" * 50 + bytes(50)


def _scenario() -> Iterator[bytes]:
    texts = [path.read_text(encoding="utf-8") for path in FILES]
    texts += re.findall(r"^```yaml\n(.*?)^```$", documents(), re.DOTALL | re.MULTILINE)
    yield from (text.encode() for text in ODD_YAML)
    for text in texts:
        yield text.encode()
        begin, *parts = re.split(r"^(?=  - id:)", text, flags=re.MULTILINE)
        for part in parts:
            yield b"applications:\n" + part.encode()
        yield begin.encode()


def _layout_file() -> Iterator[bytes]:
    for text in layouts():
        yield text.encode()
        with contextlib.suppress(LayoutError):  # the documents show mistakes as well
            yield Layout(text).to_yaml().encode()
    yield from (text.encode() for text in ODD_YAML)


def _camera() -> Iterator[bytes]:
    requests = [bytes((2, place)) for place in range(8)]
    for application in range(len(BUILTIN_APPLICATIONS) + 1):
        for place in range(8):
            start = bytes((place % 5, place % 5, application, place // 4))
            yield start + requests[0] + b"\x05ab\xff" + requests[1] + b"\x07\x07" + requests[place]
            yield start + bytes((8, place, 1)) + requests[place] + b"\x03\x01\x07" + requests[0]
    for place, sender, frame in vectors():
        if sender is m.Sender.CLIENT:
            yield bytes((place, 0, 1, 1, 0, len(frame))) + frame + b"\x06\x05"


def _address() -> Iterator[bytes]:
    for url in URL.findall(documents()):
        yield b"\0" + url.encode()
    for host in ("192.168.0.10", "[::1]:36701", "camera-3.local:1"):
        yield b"\x01" + host.encode()


def _spec() -> Iterator[bytes]:
    yield from (text.encode() for text in (*SPECS, *layouts(), f"table: {LOCALIZATIONS}"))


def _cell_file() -> Iterator[bytes]:
    for text in re.findall(r"^```yaml\n(.*?)^```$", documents(), re.DOTALL | re.MULTILINE):
        if "software:" in text or "present" in text or "measure" in text:
            yield text.encode()
            yield f"cameras: {{c: {{software: {{frames: x, {text}}}}}}}".encode()
    yield from (text.encode() for text in ODD_YAML)
    for tool in (
        "present: {grey: [0, 90]}",
        "read: {codes: [QRCode], expect: '[0-9]+'}",
        "measure: {width: {across: [[1, 1], [9, 1]]}, tolerance: 9 +- 1 px}",
        "measure: {circle: {centre: [30, 30], radius: 25}}",
        "present: {grey: [0, 9]}, read two: {follow: present, region: [0, 0, 5, 9]}",
        "read: {expect: '(a+)+'}",
    ):
        application = f"applications: {{7: {{{tool}}}}}"
        yield f"cameras: {{c: {{software: {{frames: x, {application}}}}}}}".encode()


def _gs1() -> Iterator[bytes]:
    yield from (
        b"0104012345678901",
        b"\x1d010401234567890110AB\x1d21X",
        b"3103001750",
        b"8005",
        b"",
    )
    yield from (b"10AB", b"10\x1d", b"xx", b"01040", "10\u00b2".encode(), b"00\x1d\x1d\xff")


def _program_result() -> Iterator[bytes]:
    for program in range(4):
        for value in range(23):
            yield bytes((program, 2, 0, value, value, value)) + b"a reason"
        yield bytes((program, 0, 0)) + "\u00fc".encode() * 50 + b"\0\xff"


_MAKERS: dict[str, Callable[[], Iterator[bytes]]] = {
    "framing": _framing,
    "messages": _messages,
    "machine": _machine,
    "makes": _makes,
    "layout": _layout,
    "interpreters": _interpreters,
    "scenario": _scenario,
    "camera": _camera,
    "layout_file": _layout_file,
    "address": _address,
    "spec": _spec,
    "cell_file": _cell_file,
    "gs1": _gs1,
    "program_result": _program_result,
}
