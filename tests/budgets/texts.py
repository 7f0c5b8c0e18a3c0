"""Parsers of texts and files: layouts, YAML, calibrations, clouds, recordings, descriptions."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import io
import json
import struct
import zipfile
from pathlib import Path
from typing import Any

from smartcam.calibration._files import store
from smartcam.calibration.formats import SAMPLES, TRAJECTORIES, TRANSFORMS
from smartcam.calibration.formats._cameras import FORMS
from smartcam.calibration.formats._file_format import Format
from smartcam.depth import load_cloud
from smartcam.depth._cloud_files import MAX_FILE_BYTES as MAX_CLOUD
from smartcam.emulator import load_scenario
from smartcam.fleet import load_fleet
from smartcam.frames._codecs.bitmap import MAX_PIXEL_BYTES as MAX_BITMAP
from smartcam.frames._codecs.jpeg import decode_jpeg
from smartcam.frames._gige import description as _description
from smartcam.frames._gige import expressions as _expressions
from smartcam.frames._gige.features import GenicamFeatures
from smartcam.frames._inside import entry_point, jpeg_header, read_bitmap
from smartcam.inspection import load_cell
from smartcam.inspection._read.gs1 import elements
from smartcam.inspection._read.tool import MAX_TEXT_BYTES as MAX_CODE_BYTES
from smartcam.interpreters import Context, Reader, resolve, run
from smartcam.layout import Layout
from smartcam.layout._inside import load, pack_texts
from smartcam.layout._text import MAX_TEXT_CHARACTERS as MAX_LAYOUT
from smartcam.layout._yamls import MAX_YAML_TEXT_CHARACTERS
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH
from smartcam.ros2._types.definitions import parse_message
from tests.budgets.parser import Make, Parser, fill, fill_text, from_file, grown

# ---------------------------------------------------------------------- layouts and containers

_LAYOUTS: dict[str, Make] = {
    "fields": fill_text("f{}: int8, ", tail="z: int8"),
    "records": fill_text("f{}: real32 mm, ", "n: uint8, (", "z: int8)[n]"),
    "comments": fill_text("#\n", tail="a: int8"),
    "spaces": fill_text(" ", "a:", "int8"),
    "a long name": fill_text("a", tail=": int8"),
    "a name that is none": fill_text("a", "1"),
    "opening brackets": fill_text("("),
    "digits": fill_text("9", "a: string[", "]"),
    "a type that is none": fill_text("t", "a: "),
    "one name again and again": fill_text("a: int8,"),
}


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

_CELLS: dict[str, Make] = {
    "numbers": grown(lambda count: [f"{at % 9}" for at in range(count)], 1),
    "long numbers": grown(lambda count: ["1" * 100] * count, 100),
    "one long number": lambda size: ["1" * size],
    "one number of zeros": lambda size: ["0." + "0" * size],
}


def _pack(cells: list[str]) -> None:
    pack_texts(Layout("(x: real32)*"), [(f"A{at}", text) for at, text in enumerate(cells)])
    pack_texts(Layout("(x: int32)*"), [(f"A{at}", text) for at, text in enumerate(cells)])


# ---------------------------------------------------------------------- YAML and JSON

_MERGED = "mappings merged one into the other"

PAST_LOOKAHEAD = 1500
"""Bytes from which on PyYAML's work grows with the input: until 1,024 characters behind an opening
bracket it may be a key, and for each token all open brackets are looked at."""

_YAML: dict[str, Make] = {
    "a long list": fill_text("- 1\n"),
    "a list in brackets": fill_text("1,", "[", "]"),
    "keys": fill_text("k{}: 1\n"),
    "one key again and again": fill_text("k: 1\n"),
    "nested brackets": fill_text("["),
    "nested mappings": fill_text("{a: "),
    "nested lists": lambda size: "- " * (size // 2),
    "quotation marks": fill_text("'' "),
    "a text that does not end": fill_text("a", '"'),
    "a long text": fill_text("a "),
    "a text of many lines": fill_text("  a\n", "|\n"),
    "a folded text": fill_text("  a\n\n", ">\n"),
    "comments": fill_text("# a\n", tail="a: 1"),
    "anchors": fill_text("- &a{} 1\n"),
    "aliases": fill_text("- *a\n", "- &a [1]\n"),
    "aliases of aliases": lambda size: _laughs(size),
    "merged mappings": fill_text("- {<<: *a, k{}: 1}\n", "- &a {b: 1, c: 2}\n"),
    "a mapping merged many times": lambda size: (
        "- &a {b: 1}\n- <<: [" + "*a, " * (size // 4) + "*a]\n"
    ),
    _MERGED: lambda size: (
        "- &a0 {b: 1}\n"
        + "".join(f"- &a{n + 1} {{<<: *a{n}, k{n}: 1}}\n" for n in range(size // 30))
    ),
    "keys that are aliases of aliases": lambda size: _laughs(size) + "? *a9\n: 1\n",
    "a number of many digits": fill_text("9", "a: "),
    "a number of many zeros": fill_text("0", "a: 0."),
    "a number to the base 60": fill_text(":1", "a: 1"),
    "numbers with an exponent": fill_text("- 1e999999999\n"),
    "tags": fill_text("- !!int x{}\n"),
    "documents": fill_text("--- 1\n"),
    "complex keys": fill_text("? [a{}]\n: 1\n"),
    "directives": fill_text("%TAG !a{}! tag:\n", tail="--- 1\n"),
    "escapes": fill_text("\\x41", '"', '"'),
    "binary": fill_text("AAAA", "!!binary "),
    "dates": fill_text("- 2001-01-01 1:1:1\n"),
}


def _laughs(size: int) -> str:
    lines = ["- &a0 [1, 1]"]
    lines += [f"- &a{n + 1} [*a{n}, *a{n}]" for n in range(max(10, size // 20))]
    return "\n".join(lines) + "\n"


_SCENARIO = "name: a\nseed: 1\n"
_SCENARIOS: dict[str, Make] = {
    **{
        f"YAML: {kind}": _YAML[kind]
        for kind in (
            "a long list",
            "nested brackets",
            "aliases of aliases",
            "complex keys",
            _MERGED,
        )
    },
    "unknown fields": fill_text("field{}: 1\n", _SCENARIO),
    "applications": fill_text("- {id: {}, layout: 'x: int32'}\n", _SCENARIO + "applications:\n"),
    "wrong applications": fill_text("- {id: x, nothing{}: 1}\n", _SCENARIO + "applications:\n"),
    "faults": fill_text("- {kind: drop, on: Trigger}\n", _SCENARIO + "faults:\n"),
    "wrong faults": fill_text("- {kind: no, on: 1, x{}: 2}\n", _SCENARIO + "faults:\n"),
    "cues": fill_text("- {at: {}, do: []}\n", _SCENARIO + "timeline:\n"),
    "a key of many letters": fill_text("k", _SCENARIO, ": 1\n"),
    "aliases as a key": lambda size: f"x:\n{_laughs(size)}? [*a9]\n: 1\n",
    "lists as a key": lambda size: "? " + "[" * 20 + "a, " * (size // 3) + "]" * 20 + "\n: 1\n",
}
_FLEETS: dict[str, Make] = {
    "cameras": fill_text("  c{}: bvs://h{}\n", "fleet: a\nname: a\ncameras:\n"),
    "wrong cameras": fill_text("  c{}: {url: 1, no{}: 2}\n", "name: a\ncameras:\n"),
    "unknown fields": fill_text("field{}: 1\n"),
    "endpoints": fill_text("- tcp/h:{}\n", "name: a\nlisten:\n"),
    "patterns that match twice": fill_text(
        "**/", "name: a\nrecord: {folder: x, cameras: ['", "!']}\n"
    ),
    "keys that are aliases": lambda size: f"x:\n{_laughs(size)}? [*a9]\n: 1\n",
}
_APPLICATIONS = "cameras:\n  c:\n    software:\n      frames: x\n      applications:\n"
_CELL_FILES: dict[str, Make] = {
    "cameras": fill_text(
        "  c{}: {software: {frames: x, applications: {7: {present: {grey: [0, 9]}}}}}\n",
        "cameras:\n",
    ),
    "cameras of a fleet": fill_text("  c{}: {url: bvs://h{}}\n", "cameras:\n"),
    "applications": fill_text("        {}: {present: {grey: [0, 9]}}\n", _APPLICATIONS),
    "wrong applications": fill_text("        {}: {no{}: 1}\n", _APPLICATIONS),
    "applications that follow": lambda size: (
        _APPLICATIONS
        + "".join(
            f"        {n}: {{name: n{n}, present: {{grey: [0, 9], follow: n{n + 1}}}}}\n"
            for n in range(size // 60)
        )
    ),
    "tools": fill_text("          present t{}: {grey: [0, 9]}\n", f"{_APPLICATIONS}        7:\n"),
    "settings": fill_text("s{}: 1, ", f"{_APPLICATIONS}        7: {{read: {{", "}}\n"),
    "corners of a region": fill_text(
        "[{}, 1], ", f"{_APPLICATIONS}        7: {{read: {{region: [", "]}}\n"
    ),
    "a pattern": fill_text("(a+)", f"{_APPLICATIONS}        7: {{read: {{expect: '", "'}}\n"),
    "repetitions in a pattern": fill_text(
        "(", f"{_APPLICATIONS}        7: {{read: {{expect: '", "a+)+'}}\n"
    ),
}
_ELEMENTS: dict[str, Make] = {
    "elements of a length": fill_text("11250101"),
    "elements with an end": fill_text("10A\x1d"),
    "one element": fill_text("a", "10"),
    "separators": fill_text("\x1d"),
    "no numbers": fill_text("\u00b2"),
}

_JSON: dict[str, Make] = {
    "a list": fill_text("1,", "[", "1]"),
    "lists in a list": fill_text("[],", "[", "1]"),
    "nested lists": fill_text("["),
    "nested objects": fill_text('{"a":'),
    "keys": fill_text('"k{}":1,', "{", '"z":1}'),
    "a long text": fill_text("a", '"', '"'),
    "escapes": fill_text("\\u0041", '"', '"'),
    "a number of many digits": fill_text("9"),
    "numbers with an exponent": fill_text("1e999999999,", "[", "1]"),
    "no end": fill_text("a", '"'),
}

# ---------------------------------------------------------------------- GenICam


def _described(inner: Make) -> Make:
    head, tail = "<RegisterDescription>", "</RegisterDescription>"
    return lambda size: f"{head}{inner(size)}{tail}".encode()


_DESCRIPTIONS: dict[str, Make] = {
    kind: _described(make)
    for kind, make in {
        "text in pieces": fill_text("1" * 36 + "<x/>", '<Integer Name="a">', "</Integer>"),
        "text in pieces by comments": fill_text("1<!---->", '<Integer Name="a">', "</Integer>"),
        "text in pieces by instructions": fill_text("1<?a?>", '<Integer Name="a">', "</Integer>"),
        "text in pieces by sections": fill_text(
            "<![CDATA[1]]>", '<Integer Name="a">', "</Integer>"
        ),
        "text in pieces by entities": fill_text("&#49;", '<Integer Name="a">', "</Integer>"),
        "a long text": fill_text("1 ", '<Integer Name="a">', "</Integer>"),
        "elements": fill_text('<Integer Name="n{}"/>'),
        "one name again and again": fill_text('<Integer Name="n"/>'),
        "attributes": fill_text('a{}="" ', "<Integer ", "/>"),
        "a long attribute": fill_text("a", '<Integer Name="', '"/>'),
        "a long comment": fill_text("a", "<!--", "-->"),
        "nested elements": fill_text("<Group>"),
        "namespaces": fill_text('<a:Integer xmlns:a="{}"/>'),
        "entries of a structure": lambda size: (
            "<StructReg>"
            + "<Sign/>" * (size // 14)
            + "".join(f'<StructEntry Name="e{n}"/>' for n in range(size // 50))
            + "</StructReg>"
        ),
    }.items()
}


def _zipped(make: Make) -> Make:
    def made(size: int) -> bytes:
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("a.xml", make(size))
        return packed.getvalue()

    return made


def _many_files(size: int) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for number in range(max(1, size // 110)):
            archive.writestr(f"{number}", b"")
    return packed.getvalue()


def _bomb(method: int) -> Make:
    def make(size: int) -> bytes:
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w", method) as archive:
            archive.writestr("a.xml", bytes(size * 100))
        return packed.getvalue()

    return make


_FORMULAS: dict[str, Make] = {
    "a sum": fill_text("+1", "1"),
    "brackets": lambda size: "(" * min(size // 2, 4000) + "1" + ")" * min(size // 2, 4000),
    "signs": fill_text("-", tail="1"),
    "powers": fill_text("**9", "9"),
    "shifts": fill_text("<<63", "1"),
    "digits": fill_text("9"),
    "hex digits": fill_text("F", "0x"),
    "an exponent": fill_text("9", "1e"),
    "a name": fill_text("a"),
    "spaces": fill_text(" ", tail="1"),
    "choices": fill_text("1?1:", tail="1"),
    "arguments": fill_text("1,", "SIN(", "1)"),
    "products": fill_text("*99999999", "1"),
}


class _Memory:
    async def read(self, address: int, length: int) -> bytes:
        return bytes(length)

    async def write(self, address: int, data: bytes) -> None:
        pass


def _features(text: bytes) -> None:
    nodes = _description.parse(text)
    features = GenicamFeatures(nodes, _Memory(), "camera")

    async def ask() -> None:
        for name in ("A", "Zzz"):
            with contextlib.suppress(SmartCamError):
                await features.get(name)
        with contextlib.suppress(SmartCamError):
            await features.set("A", 3)

    asyncio.run(ask())


from smartcam.exceptions import SmartCamError  # noqa: E402

_FEATURES: dict[str, Make] = {
    kind: _described(make)
    for kind, make in {
        "variables": fill_text(
            '<pVariable Name="V{}">B</pVariable>',
            '<Integer Name="B"><Value>1</Value></Integer><SwissKnife Name="A">',
            "<Formula>1</Formula></SwissKnife>",
        ),
        "expressions asked for again and again": lambda size: "".join(
            (
                '<SwissKnife Name="A">',
                *(f'<pVariable Name="V{n}">B</pVariable>' for n in range(size // 80)),
                '<Formula>1</Formula></SwissKnife><SwissKnife Name="B">',
                *(f'<Expression Name="E{n}">1+1+1</Expression>' for n in range(size // 80)),
                "<Formula>1</Formula></SwissKnife>",
            )
        ),
        "nodes that lead to two others": lambda size: "".join(
            f'<SwissKnife Name="{"A" if not n else f"N{n}"}"><pVariable Name="X">N{n + 1}'
            f'</pVariable><pVariable Name="Y">N{n + 1}</pVariable><Formula>X+Y</Formula>'
            "</SwissKnife>"
            for n in range(size // 130)
        ),
        "a circle": fill_text('<Integer Name="A"><pValue>A</pValue></Integer>'),
        "addresses": fill_text(
            "<Address>1</Address>",
            '<Port Name="P"/><IntReg Name="A"><pPort>P</pPort><Length>4</Length>',
            "</IntReg>",
        ),
        "entries": fill_text(
            '<EnumEntry Name="e{}"><Value>{}</Value></EnumEntry>',
            '<Enumeration Name="A"><Value>0</Value>',
            "</Enumeration>",
        ),
        "features": fill_text(
            '<Integer Name="Zz{}"/><Category Name="C{}"><pFeature>Zz{}</pFeature></Category>'
        ),
        "indexed values": fill_text(
            '<pValueIndexed Index="{}">B</pValueIndexed>',
            '<Integer Name="B"><Value>1</Value></Integer><Integer Name="A"><pIndex>B</pIndex>',
            "</Integer>",
        ),
    }.items()
}

# ---------------------------------------------------------------------- clouds


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

# ---------------------------------------------------------------------- pictures


def _bmp(bits: int) -> Make:
    def make(size: int) -> bytes:
        side = max(4, int((8 * size / bits) ** 0.5) // 4 * 4)
        pixels = bytes(side * bits // 8 * side)
        info = struct.pack("<IiiHHIIiiII", 40, side, side, 1, bits, 0, 0, 0, 0, 0, 0)
        place = 14 + 40 + 1024 * (bits == 8)
        return struct.pack("<2sIHHI", b"BM", 0, 0, 0, place) + info + bytes(place - 54) + pixels

    return make


def _jpeg(inner: bytes) -> Make:
    return fill(inner, b"\xff\xd8", b"\xff\xd9")


def _read_jpeg(data: bytes) -> None:
    width, height, _ = jpeg_header(data, "JPEG")
    decode_jpeg(data, "RGB", (width, height), "JPEG")


# ---------------------------------------------------------------------- calibrations

_NUMBERS = {"x": 1, "y": 1, "z": 1, "qx": 0, "qy": 0, "qz": 0, "qw": 1}
_CSV = "#t [s],x [m],y [m],z [m],qx [],qy [],qz [],qw []\n"

_POSES: dict[str, Make] = {
    "YAML: keys": _YAML["keys"],
    "YAML: nested brackets": _YAML["nested brackets"],
    "YAML: aliases": _YAML["aliases"],
    "YAML: a long text": _YAML["a long text"],
    "JSON: a list": _JSON["a list"],
    "words": fill_text("1 "),
    "a long word": fill_text("1"),
    "quotation marks": fill_text("'' "),
    "a long quotation": fill_text("a", "'", "'"),
    "comments": fill_text("#\n"),
    "nodes": fill_text("<node >", "<launch>"),
    "a node without an end": fill_text("a", "<node "),
    "attributes": fill_text('a="b" ', '<node type="static_transform_publisher" ', ">"),
    "attributes without an end": fill_text('a="', "<node ", ">"),
    "remarks": fill_text("<!---->", "<launch>"),
    "remarks without an end": fill_text("<!--", "<launch>"),
    "arguments of a node": fill_text("1", '<node type="static_transform_publisher" args="', '"/>'),
}

_XML: dict[str, Make] = {
    "XML: elements": fill_text("<a/>", "<opencv_storage>", "</opencv_storage>"),
    "XML: names": fill_text("<a{}>1 2</a{}>", "<opencv_storage>", "</opencv_storage>"),
    "XML: nested elements": fill_text("<a>"),
    "XML: a long text": fill_text("1 ", "<opencv_storage><a>", "</a></opencv_storage>"),
    "XML: attributes": fill_text('b{}="1" ', "<robot><joint ", "/></robot>"),
    "XML: entities": fill_text("&lt;", "<robot>", "</robot>"),
    "XML: joints": fill_text(
        '<joint><parent link="a"/><child link="b{}"/><origin/></joint>', "<robot>", "</robot>"
    ),
}

_POSES |= {
    **_XML,
    "Python: calls": fill_text("f(a=1)\n", "import a\n"),
    "Python: nested calls": fill_text("f(", "import a\n"),
    "Python: signs": fill_text("-", "import a\nb=", "1"),
    "Python: a sum": fill_text("+1", "import a\nb=1"),
    "Python: arguments": fill_text(
        '"1",', "import a\nN(executable='static_transform_publisher', arguments=[", "])"
    ),
}

_CAMERAS: dict[str, Make] = {
    **_XML,
    "lines of numbers": fill_text("1 OPENCV 1 1 1 1 1 1 1 1 1 1\n"),
    "titles": fill_text("a\n1 2 3\n", "[image]\n"),
    "JSON: cameras": fill_text('{"camera_type":"kb4"},', '{"value0":{"intrinsics":[', "1]}}"),
    "JSON: nested lists": _JSON["nested lists"],
    "YAML: keys": _YAML["keys"],
    "YAML: a list in brackets": _YAML["a list in brackets"],
    "coefficients": fill_text(
        "0, ",
        "image_width: 1\nimage_height: 1\ndistortion_model: plumb_bob\ncamera_matrix: {rows: 3, "
        "cols: 3, data: [1,0,0,0,1,0,0,0,1]}\ndistortion_coefficients:\n  rows: 1\n  cols: 9\n"
        "  data: [",
        "]\n",
    ),
    "cameras": fill_text("cam{}: {camera_model: pinhole}\n"),
    "matrices": fill_text(
        "m{}: !!opencv-matrix {rows: 4, cols: 4, dt: d, data: []}\n", "%YAML:1.0\n---\n"
    ),
}

_SAMPLES: dict[str, Make] = {
    "pairs": fill_text(
        "[[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]],[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]],",
        "[",
        "[]]",
    ),
    "a list": _JSON["a list"],
    "nested lists": _JSON["nested lists"],
    "a number of many digits": _JSON["a number of many digits"],
    "pairs of YAML": fill_text(
        "- {effector_wrt_world: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1], "
        "object_wrt_sensor: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]}\n"
    ),
}

_TRAJECTORIES: dict[str, Make] = {
    "poses": fill_text("{}.5,1,2,3,0,0,0,1\n", _CSV),
    "remarks": fill_text("#\n"),
    "columns": fill_text("a [s],", "#"),
    "brackets of columns": fill_text("[", "#t "),
    "a long line": fill_text("1,", _CSV),
    "long numbers": fill_text("1,1,2,3,0,0,0," + "1" * 60 + "\n", _CSV),
}


def _stored(inner: Make) -> Make:
    def make(size: int) -> bytes:
        content = {
            "schema": store.SCHEMA,
            "schema_version": "{}.{}".format(*store.SCHEMA_VERSION),
            "kind": "intrinsics",
            "written_at": "",
            "units": {},
            "software": {},
            "context": {},
            "data": json.loads(inner(size)),
        }
        return json.dumps({**content, "sha256": store._digest(content)}).encode()

    return make


def _read_stored(path: Path) -> None:
    from smartcam.calibration import IntrinsicCalibration

    IntrinsicCalibration.load(path)


def _read_between(form: Format[Any], target: str, source: str, path: Path) -> None:
    form.read(path, target, source, unit="m")


_STORED: dict[str, Make] = {
    **{f"JSON: {kind}": make for kind, make in _JSON.items()},
    "unknown fields": _stored(fill_text('"k{}":1,', "{", '"z":1}')),
    "views": _stored(fill_text("{},".replace("{}", '{"a":1}'), '{"views":[', "{}]}")),
    "numbers": _stored(fill_text("1,", '{"matrix":[', "1]}")),
}

# ---------------------------------------------------------------------- ROS

_MESSAGES: dict[str, Make] = {
    "fields": fill_text("int32 f{}\n"),
    "constants": fill_text("int32 C{}=1\n"),
    "comments": fill_text("#\n"),
    "a long name": fill_text("a", "int32 "),
    "a long type": fill_text("a", "", " a"),
    "a long type of a package": fill_text("a", "", "/! b"),
    "parts of a type": fill_text("a_", "", "a/B c"),
    "spaces": fill_text(" ", "int32 a", "b"),
    "a list as a default": fill_text("1,", "int32[] a [", "1]"),
    "brackets": fill_text("[", "int32[] a "),
    "a number of many digits": fill_text("9", "int32 A="),
    "a text": fill_text("\\'", "string A='"),
    "signs": fill_text("-", "int32 A=", "1"),
}

# ---------------------------------------------------------------------- the table

TEXTS: tuple[Parser, ...] = (
    Parser("layouts", Layout, _LAYOUTS, MAX_LAYOUT, "layout._text.MAX_TEXT", size=4000),
    Parser(
        "layouts as YAML",
        Layout.from_yaml,
        {
            "fields": fill_text("- {name: f{}, type: int8}\n", "fields:\n"),
            "wrong fields": fill_text("- {name: 1, no: {}}\n", "fields:\n"),
            **{
                f"YAML: {kind}": _YAML[kind]
                for kind in ("keys", "aliases of aliases", "nested brackets")
            },
        },
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yamls.MAX_YAML_TEXT",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml",),
    ),
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
    Parser(
        "cells of a spreadsheet",
        _pack,
        _CELLS,
        1024 * 4096,
        "protocols._insight.words.MAX_CELLS, MAX_LINE",
    ),
    Parser(
        "YAML",
        load,
        _YAML,
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yamls.MAX_YAML_TEXT",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml",),
        refused_from={_MERGED: 20_000},
    ),
    Parser(
        "scenarios",
        from_file(load_scenario, "a.yaml"),
        _SCENARIOS,
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yamls.MAX_YAML_TEXT",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml",),
        refused_from={f"YAML: {_MERGED}": 20_000},
    ),
    Parser(
        "fleet files",
        from_file(load_fleet, "a.yaml"),
        _FLEETS,
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yamls.MAX_YAML_TEXT",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml",),
    ),
    Parser(
        "cell files",
        from_file(load_cell, "a.yaml"),
        _CELL_FILES,
        MAX_YAML_TEXT_CHARACTERS,
        "layout._yamls.MAX_YAML_TEXT",
        size=2500,
        short=PAST_LOOKAHEAD,
        needs=("yaml", "cv2", "zxingcpp"),
    ),
    Parser(
        "GS1 elements",
        elements,
        _ELEMENTS,
        MAX_CODE_BYTES,
        "inspection._read.tool.MAX_TEXT_BYTES",
        size=1000,
    ),
    Parser(
        "GenICam: descriptions",
        _description.parse,
        _DESCRIPTIONS,
        _description.MAX_PLAIN_BYTES,
        "frames._gige.description.MAX_PLAIN_BYTES",
        refused_from={"entries of a structure": 20_000},
    ),
    Parser(
        "GenICam: archives",
        lambda data: _description.parse(_description.unpack(data)),
        {
            "text in pieces": _zipped(_DESCRIPTIONS["text in pieces"]),
            "many files": _many_files,
            "zeros": _bomb(zipfile.ZIP_DEFLATED),
            "zeros, by bzip2": _bomb(zipfile.ZIP_BZIP2),
            "zeros, by LZMA": _bomb(zipfile.ZIP_LZMA),
        },
        _description.MAX_PACKED_BYTES,
        "frames._gige.description.LARGEST_PACKED",
    ),
    Parser(
        "GenICam: formulas",
        lambda text: _expressions.evaluate(text, {}, whole=True),
        _FORMULAS,
        _expressions.MAX_FORMULA_CHARACTERS,
        "frames._gige.expressions.MAX_FORMULA_CHARACTERS",
        size=1500,
    ),
    Parser(
        "GenICam: values",
        _features,
        _FEATURES,
        _description.MAX_PLAIN_BYTES,
        "frames._gige.description.MAX_PLAIN_BYTES",
        refused_from={"expressions asked for again and again": 30_000},
    ),
    Parser(
        "PLY",
        from_file(functools.partial(load_cloud, unit="m"), "a.ply"),
        _PLY,
        MAX_CLOUD,
        "depth._cloud_files.MAX_FILE_BYTES",
    ),
    Parser(
        "PCD",
        from_file(functools.partial(load_cloud, unit="m"), "a.pcd"),
        _PCD,
        MAX_CLOUD,
        "depth._cloud_files.MAX_FILE_BYTES",
    ),
    Parser(
        "bitmaps",
        read_bitmap,
        {"grey": _bmp(8), "colours": _bmp(24), "zeros": fill(b"\0", b"BM")},
        MAX_BITMAP,
        "frames._codecs.bitmap.MAX_PIXEL_BYTES",
    ),
    Parser(
        "JPEG",
        _read_jpeg,
        {
            "markers": _jpeg(b"\xff\xe0\0\2"),
            "fill bytes": _jpeg(b"\xff"),
            "zeros": _jpeg(b"\0"),
            "tables": _jpeg(b"\xff\xdb\0\x43\0" + b"\1" * 64),
            "restarts": _jpeg(b"\xff\xd0"),
        },
        1 << 28,
        "the frame that it comes in",
        needs=("simplejpeg",),
    ),
    Parser(
        "H.264: entry points",
        entry_point,
        {
            "small units": fill(b"\0\0\1\x09"),
            "start codes": fill(b"\0\0\1"),
            "messages": fill(b"\1\0", b"\0\0\1\6"),
            "lengths without an end": fill(b"\xff", b"\0\0\1\6"),
            "units of messages": fill(b"\0\0\1\6\1\1a"),
        },
        1 << 28,
        "the frame that it comes in",
    ),
    Parser(
        "calibrations",
        from_file(_read_stored, "a.json"),
        _STORED,
        store.MAX_FILE_BYTES,
        "calibration._files.store.MAX_FILE_BYTES",
    ),
    *(
        Parser(
            f"transforms: {name}",
            from_file(functools.partial(_read_between, form, "robot", "camera"), "a"),
            _POSES,
            form.most,
            "calibration.formats._file_format.MAX_TEXT",
            size=2500,
            short=PAST_LOOKAHEAD,
            needs=("yaml",),
        )
        for name, form in TRANSFORMS.items()
    ),
    *(
        Parser(
            f"samples: {name}",
            from_file(form.read, "a"),
            _SAMPLES,
            form.most,
            f"calibration.formats._file_format.{'MAX_YAML' if 'yaml' in name else 'MAX_FILE'}",
            size=2500,
            short=PAST_LOOKAHEAD,
            needs=("yaml",),
        )
        for name, form in SAMPLES.items()
    ),
    *(
        Parser(
            f"trajectories: {name}",
            from_file(functools.partial(_read_between, form, "a", "b"), "a"),
            _TRAJECTORIES,
            form.most,
            "calibration.formats._file_format.MAX_FILE",
            size=2500,
            short=PAST_LOOKAHEAD,
        )
        for name, form in TRAJECTORIES.items()
    ),
    *(
        Parser(
            f"cameras: {name}",
            from_file(form.read, "a"),
            _CAMERAS,
            form.most,
            "calibration.formats._cameras.MAX_FILE",
            size=2500,
            short=PAST_LOOKAHEAD,
            needs=("yaml",),
        )
        for name, form in FORMS.items()
    ),
    Parser(
        "ROS: definitions of messages",
        lambda text: parse_message("a_b/msg/C", text),
        _MESSAGES,
        1 << 20,
        "the program's own texts",
        size=1000,
    ),
)
