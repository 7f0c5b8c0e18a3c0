"""Descriptions of cameras, valid and hostile ones."""

import contextlib
import io
import struct
import zipfile
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import FrameSourceError, MessageError
from smartcam.frames._inside import GenicamFeatures
from tests.frames.gige.camera import DESCRIPTION, HEAD
from tests.frames.inside import (
    MAX_CHUNKS,
    MessageFeatures,
    cut_chunks,
    decode_events,
    evaluate,
    locate,
    parse,
    unpack,
)
from tests.frames.inside import description as _description


def described(inside: str) -> str:
    return f"<RegisterDescription>{inside}</RegisterDescription>"


def zipped(text: bytes, name: str = "a.xml") -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.txt", b"no")
        archive.writestr(name, text)
    return file.getvalue()


@pytest.mark.parametrize(
    ("url", "place"),
    [
        ("Local:a.xml;10000;3e67", ("a.xml", 0x10000, 0x3E67)),
        ("local:a.zip;0xC0000000;1FF", ("a.zip", 0xC0000000, 0x1FF)),
        ("Local:///a.zip;1000;20?SchemaVersion=1.1.0", ("a.zip", 0x1000, 0x20)),
    ],
)
def test_url_gives_the_place_of_the_description(url: str, place: tuple[str, int, int]) -> None:
    assert locate(url) == place


@pytest.mark.parametrize(
    "url",
    ["", "http://example.invalid/a.xml", "Local:a.xml", "Local:a;1;0", "Local:a;1;7fffffff",
     "Local:a;123456789;1", "File:a.zip"],
)  # fmt: skip
def test_another_url_is_refused(url: str) -> None:
    with pytest.raises(MessageError):
        locate(url)


def test_description_is_unpacked() -> None:
    assert unpack(zipped(b"<a/>")) == b"<a/>"
    assert unpack(b"<a/>\0\0\0") == b"<a/>"


def test_archive_of_too_many_bytes_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_description, "MAX_PLAIN_BYTES", 10_000)
    with pytest.raises(MessageError, match="more than 10000"):
        unpack(zipped(bytes(10_001)))
    assert len(unpack(zipped(bytes(10_000)))) == 10_000


@given(st.integers(0, 200), st.integers(0, 255))
def test_a_damaged_archive_is_refused_or_read(at: int, byte: int) -> None:
    data = bytearray(zipped(b"<a/>" * 10))
    data[2 + at % (len(data) - 2)] = byte
    with contextlib.suppress(MessageError):
        unpack(bytes(data))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "no XML"),
        (b"<a>", "no XML"),
        (b"\xff\xfe", "no XML"),
        (b"<?xml version='1.0' encoding='nonsense'?><a/>", "no XML"),
        (b"<other/>", "expected <RegisterDescription>, got <other>"),
        (b"<!DOCTYPE a [<!ENTITY b 'c'>]><RegisterDescription>&b;</RegisterDescription>",
         "document type"),
        (described("<Group>" * 40 + "</Group>" * 40).encode(), "32 levels"),
    ],
)  # fmt: skip
def test_text_without_a_description_is_refused(text: bytes, message: str) -> None:
    with pytest.raises(MessageError, match=message):
        parse(text)


@given(st.binary(max_size=200))
def test_any_bytes_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        parse(unpack(data))


class Memory:
    def __init__(self) -> None:
        self.data = bytearray(0x30000)
        self.reads = 0

    async def read(self, address: int, length: int) -> bytes:
        self.reads += 1
        return bytes(self.data[address : address + length])

    async def write(self, address: int, data: bytes) -> None:
        self.data[address : address + len(data)] = data


def features(text: str) -> tuple[GenicamFeatures, Memory]:
    memory = Memory()
    return GenicamFeatures(parse(text.encode()), memory, "cam"), memory


async def test_features_of_each_kind() -> None:
    there, memory = features(DESCRIPTION)
    memory.data[0x10000:0x10028] = struct.pack(
        ">5Id3I", 64, 48, 0x01080001, 0, 40_000, 1500.0, 0x00FBFB00, 0, 0
    )[:40]
    assert await there.get("Width") == 64
    assert await there.get("Height") == 48
    assert await there.get("PixelFormat") == "Mono8"
    assert await there.entries("PixelFormat") == {"Mono8": 0x01080001, "Odd8": 0x01080FFF}
    assert await there.get("AcquisitionFrameRate") == 25
    assert await there.get("ExposureTime") == 1500
    assert await there.get("ReverseX") is False
    assert await there.get("Gain") == -0.5
    assert await there.get("PayloadSize") == 64 * 48
    await there.set("AcquisitionFrameRate", "50")
    assert await there.number("PeriodReg") == 20_000
    await there.set("GainBits", -1)
    assert memory.data[0x1001C:0x10020].hex() == "00ffff00" or await there.get("Gain") == -0.1
    assert await there.number("Nothing") is None
    assert await there.number("Absent") is None


async def test_bits_count_from_the_highest_in_big_endian_registers() -> None:
    text = described(
        "".join(
            f'<MaskedIntReg Name="{name}"><Address>0</Address><Length>4</Length>'
            f"<LSB>{low}</LSB><MSB>{high}</MSB><pPort>Device</pPort>"
            f"<Endianess>{order}</Endianess></MaskedIntReg>"
            for name, low, high, order in (
                ("Big", 31, 24, "BigEndian"),
                ("Little", 0, 7, "LittleEndian"),
            )
        )
    )
    there, memory = features(text)
    memory.data[:4] = bytes([1, 2, 3, 4])
    assert await there.get("Big") == 4
    assert await there.get("Little") == 1
    await there.set("Big", 9)
    assert memory.data[:4] == bytes([1, 2, 3, 9])
    with pytest.raises(FrameSourceError, match="256 does not fit into 8 bits"):
        await there.set("Big", 256)


async def test_index_and_selectors_lead_to_their_registers() -> None:
    text = described(
        '<Integer Name="Sel"><Value>2</Value></Integer>'
        '<IntReg Name="R"><Address>0x100</Address><pIndex Offset="0x20">Sel</pIndex>'
        '<IntSwissKnife Name="S"><Formula>4 * 2</Formula></IntSwissKnife>'
        "<Length>4</Length><pPort>Device</pPort></IntReg>"
        '<Integer Name="I"><pIndex>Sel</pIndex><pValueIndexed Index="2">R</pValueIndexed>'
        "<pValueDefault>Sel</pValueDefault></Integer>"
        '<StringReg Name="T"><Address>0x200</Address><Length>8</Length><pPort>Device</pPort>'
        "</StringReg>"
    )
    there, memory = features(text)
    await there.set("I", 7)
    assert memory.data[0x148] == 7
    await there.set("Sel", 3)
    assert await there.get("I") == 3
    await there.set("T", "name")
    assert await there.get("T") == "name"
    with pytest.raises(FrameSourceError, match="at most 8 bytes"):
        await there.set("T", "a long name")


KNIFE = (
    '<IntSwissKnife Name="{}"><pVariable Name="X">{}</pVariable><Formula>{}</Formula>'
    "</IntSwissKnife>"
)


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        (KNIFE.format("A", "A", "X"), "depends on itself"),
        (KNIFE.format("A", "B", "X") + KNIFE.format("B", "A", "X"), "depends on itself"),
        (KNIFE.format("A", "None", "X"), "no node 'None'"),
        (KNIFE.format("A", "Five", "X /"), "expected a number, a name or"),
        (KNIFE.format("A", "Five", "X / 0"), "no value"),
        (KNIFE.format("A", "Five", "Y"), "unknown name 'Y'"),
        ('<Integer Name="A"/>', "has no <Value>"),
        ('<Integer Name="A"><Value>many</Value></Integer>', "expected a number"),
        ('<IntReg Name="A"><Length>99999999</Length><pPort>D</pPort></IntReg>', "length"),
        ('<IntReg Name="A"><Address>-4</Address><pPort>D</pPort></IntReg>', "address"),
        ('<FloatReg Name="A"><Length>3</Length><pPort>D</pPort></FloatReg>', "4 or 8 bytes"),
        ('<IntReg Name="A"><Address>0</Address></IntReg>', "no register"),
        ('<Port Name="C"><ChunkID>1</ChunkID></Port><IntReg Name="A"><Address>0</Address>'
         "<pPort>C</pPort></IntReg>", "with each frame only"),
        ('<MaskedIntReg Name="A"><Address>0</Address><Bit>99</Bit><pPort>D</pPort></MaskedIntReg>',
         "impossible bits"),
        ('<Float Name="A"><pValue>Gone</pValue></Float>', "no node 'Gone'"),
    ],
)  # fmt: skip
async def test_description_with_dangling_references_is_refused(inside: str, message: str) -> None:
    there, _ = features(described('<Integer Name="Five"><Value>5</Value></Integer>' + inside))
    with pytest.raises(FrameSourceError, match=f"feature A: .*{message}"):
        await there.get("A")


async def test_a_fan_of_variables_is_bounded() -> None:
    """Each level reads the next one twice: without a bound 2 to the 40 reads."""
    knives = "".join(
        f'<IntSwissKnife Name="N{at}"><pVariable Name="X">N{at + 1}</pVariable>'
        f'<pVariable Name="Y">N{at + 1}</pVariable><Formula>X + Y</Formula></IntSwissKnife>'
        for at in range(40)
    )
    there, _ = features(described(knives + '<Integer Name="N40"><Value>1</Value></Integer>'))
    with pytest.raises(FrameSourceError, match="depends on itself"):
        await there.get("N0")


VARIABLES = {"A": 0, "B": 5, "A.Max": 7}


@pytest.mark.parametrize(
    ("formula", "whole", "expected"),
    [
        ("1+2*3", True, 7),
        ("2**(3**2)", True, 512),
        ("-(2**2)", True, -4),
        ("-7/2", True, -3),
        ("-7%3", True, -1),
        ("7/2", False, 3.5),
        ("A?1:B?2:3", True, 2),
        ("(A=0)&&(B<>0)||X", True, 1),
        ("(0xFF>>4)&3", True, 3),
        ("1<<63", True, -(1 << 63)),
        ("ROUND(2.345, 2)", False, 2.35),
        ("SQRT(16)+TRUNC(2.9)-FLOOR(1.5)+CEIL(1.1)", False, 7),
        ("10-3-2", True, 5),
        ("~0 + !B", True, -1),
        ("1>0=1", True, 1),
        ("LG(1000)+LN(E)+SGN(-3)", False, 3),
        ("A.Max+1", True, 8),
        ("1|(2^(3&1))", True, 3),
        ("(A<B) && (B=5)", True, 1),
        ("(A=0)?1:((B=2)?3:4)", True, 1),
        ("1e3", False, 1000),
    ],
)
def test_formulas(formula: str, whole: bool, expected: float) -> None:
    assert evaluate(formula, VARIABLES, integers=whole) == expected


@pytest.mark.parametrize(
    ("formula", "by_c", "by_emva"),
    [
        ("2**3**2", "512", "64"),
        ("-2**2", "-4", "4"),
        ("0xFF>>4&3", "3", "255"),
        ("1<<2+1", "8", "5"),
        ("B=5 && A=1", "0", "0"),
        ("A=0 || B=5 && B=6", "1", "0"),
        ("-(B)+1", "-4", "-6"),
        ("(A=0)?2:(B=2)?3:4", "2", "3"),
    ],
)
def test_a_formula_of_two_readings_has_no_value_where_they_differ(
    formula: str, by_c: str, by_emva: str
) -> None:
    if by_c == by_emva:
        assert evaluate(formula, VARIABLES, integers=True) == int(by_c)
        return
    with pytest.raises(MessageError, match=f"got {by_c} in C's order .* {by_emva} in that of EMVA"):
        evaluate(formula, VARIABLES, integers=True)


@pytest.mark.parametrize(
    "formula",
    ["", "1 +", "(1", "1)", "1 ? 2", "SQRT(-1)", "SIN(1, 2)", "1 // 2", "a b", "9" * 9000,
     "(" * 5000 + "1", "-" * 5000 + "1", "1" + "+1" * 4000, "9**9**9**9", "1e308*10", "2.0**0.5**",
     "1?" * 1000 + "1" + ":1" * 1000, "__import__('os')", "1/0", "-1**0.5 + (0-8)**(1/3)"],
)  # fmt: skip
def test_a_formula_that_has_no_value_is_refused(formula: str) -> None:
    with pytest.raises(MessageError):
        evaluate(formula, VARIABLES, integers=False)


@given(st.text("0123456789+-*/%&|^~<>=?:(),!AB. eEx", max_size=40), st.booleans())
def test_any_formula_has_a_number_or_is_refused(formula: str, whole: bool) -> None:
    try:
        value: Any = evaluate(formula, VARIABLES, integers=whole)
    except MessageError:
        return
    assert isinstance(value, int if whole else float)


def test_a_damaged_stream_in_the_archive_is_refused() -> None:
    data = bytearray(zipped(b"<a/>" * 1000))
    at = data.index(b"a.xml") + 5
    data[at : at + 8] = bytes(8)
    with pytest.raises(MessageError):
        unpack(bytes(data))


# chunks and events


def chunk(number: int, data: bytes) -> bytes:
    return data + struct.pack(">II", number, len(data))


class NoMemory:
    """A camera that must not be read."""

    async def read(self, address: int, length: int) -> bytes:
        raise AssertionError(f"{length} bytes at {address:#x} were read")

    async def write(self, address: int, data: bytes) -> None:
        raise AssertionError(f"{data.hex()} was written at {address:#x}")


def chunk_features() -> MessageFeatures:
    return MessageFeatures(GenicamFeatures(parse(DESCRIPTION.encode()), NoMemory(), "T"), "ChunkID")


def test_chunks_are_cut_from_the_end() -> None:
    data = chunk(1, b"pixels") + chunk(7, b"") + chunk(0xFFFFFFFF, b"abc")
    found = {number: bytes(part) for number, part in cut_chunks(memoryview(data)).items()}
    assert found == {1: b"pixels", 7: b"", 0xFFFFFFFF: b"abc"}


@pytest.mark.parametrize(
    "data",
    [
        b"1234567",
        struct.pack(">II", 1, 1),
        struct.pack(">II", 1, 0xFFFFFFFF),
        b"x" + chunk(1, b"abcd"),
        chunk(1, b"a") + chunk(1, b"b"),
        b"".join(chunk(number, b"") for number in range(MAX_CHUNKS + 1)),
    ],
)
def test_lengths_that_do_not_fit_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError, match="chunk data"):
        cut_chunks(memoryview(data))


@given(st.binary(max_size=200))
def test_any_bytes_are_chunks_or_an_error(data: bytes) -> None:
    try:
        found = cut_chunks(memoryview(data))
    except MessageError:
        return
    assert sum(len(one) + 8 for one in found.values()) == len(data)


def test_too_short_chunk_gives_no_value() -> None:
    values, problems = chunk_features().read({0xA0000001: memoryview(bytes(7)), 3: memoryview(b"")})
    assert values == {}
    assert "ChunkExposureTime: expected 8 bytes at 0x0, its message has 7" in problems


def test_missing_chunk_gives_no_value() -> None:
    values, problems = chunk_features().read({3: memoryview(struct.pack(">I", 0x01080001))})
    assert values == {"ChunkPixelFormat": "Mono8"}
    assert not problems


@pytest.mark.long
@given(st.binary(min_size=8, max_size=8), st.binary(min_size=8, max_size=8))
def test_chunk_values_are_those_of_emvas_genapi(exposure: bytes, counter: bytes) -> None:
    genapi = pytest.importorskip("genicam.genapi", reason="needs PyPI's genicam")
    begin = DESCRIPTION.index('<Float Name="ChunkExposureTime">')
    inside = DESCRIPTION[begin : DESCRIPTION.index('<Category Name="EventControl">')]
    inside = inside.replace("<pIsAvailable>ChunkModeActive</pIsAvailable>", "")
    text = (
        f'{HEAD}<Category Name="Root"><pFeature>ChunkFrameID</pFeature></Category>{inside}'
        "</RegisterDescription>"
    )
    theirs = genapi.NodeMap()
    theirs.load_xml_from_string(text)
    adapter = genapi.ChunkAdapterGEV(theirs)
    data = chunk(1, b"pixels..") + chunk(0xA0000001, exposure) + chunk(0xA0000002, counter)
    adapter.attach_buffer(data, len(data))
    values, problems = chunk_features().read(cut_chunks(memoryview(data)))
    assert not problems
    assert set(values) == {"ChunkExposureTime", "ChunkFrameID", "ChunkLineStatusAll"}
    for name, ours in values.items():
        value = theirs.get_node(name).value
        assert value == ours or (value != value and ours != ours), name


def message(command: int, *items: bytes, flags: int = 1) -> bytes:
    return struct.pack(">BBHHH", 0x42, flags, command, sum(map(len, items)), 3) + b"".join(items)


def item_of(number: int, size: int = 0) -> bytes:
    return struct.pack(">HHHHQ", size, number, 0, 1, 2)


def test_several_events_in_one_message() -> None:
    request = decode_events(message(0xC0, item_of(0x9001), item_of(0x9002)))
    assert [one.number for one in request.items] == [0x9001, 0x9002]
    assert [one.data[:2] for one in request.items] == [b"\0\x10"] * 2
    long = struct.pack(">HHHHQQ", 26, 0x9001, 0, 0, 7, 8) + b"ab"
    request = decode_events(message(0xC2, long, long, flags=0x10))
    assert [(one.block, one.ticks, one.data[24:]) for one in request.items] == [(7, 8, b"ab")] * 2
    assert not request.wants_ack


@pytest.mark.parametrize(
    "data",
    [
        b"",
        message(0xC0, item_of(1))[:-1],
        message(0xC0, item_of(1) + b"x"),
        message(0x80, item_of(1)),
        b"\x43" + message(0xC0, item_of(1))[1:],
        message(0xC2, struct.pack(">HHHHQQ", 99, 1, 0, 0, 7, 8), flags=0x11),
        message(0xC2, struct.pack(">HHHHQQ", 8, 1, 0, 0, 7, 8), flags=0x11),
        message(0xC0, *[item_of(1)] * 101),
    ],
)
def test_bytes_without_an_event_are_refused(data: bytes) -> None:
    with pytest.raises(MessageError):
        decode_events(data)


@given(st.binary(max_size=120), st.sampled_from([0xC0, 0xC2]), st.sampled_from([1, 0x11]))
def test_any_bytes_are_events_or_an_error(data: bytes, command: int, flags: int) -> None:
    try:
        request = decode_events(message(command, data, flags=flags))
    except MessageError:
        return
    assert sum(len(one.data) for one in request.items) == len(data)


@pytest.mark.long
@given(st.integers(0, 0xFFFF), st.integers(0, (1 << 63) - 1), st.binary(min_size=4, max_size=20))
def test_event_values_are_those_of_emvas_genapi(block: int, ticks: int, more: bytes) -> None:
    genapi = pytest.importorskip("genicam.genapi", reason="needs PyPI's genicam")
    names = ["EventExposureEndTimestamp", "EventExposureEndFrameID", "EventExposureEndLines"]
    inside = DESCRIPTION
    begin = inside.index('<Integer Name="EventExposureEndTimestamp">')
    inside = inside[begin : inside.index('<Port Name="Device"/>', begin)]
    listed = "".join(f"<pFeature>{name}</pFeature>" for name in names)
    text = f'{HEAD}<Category Name="Root">{listed}</Category>{inside}</RegisterDescription>'
    theirs = genapi.NodeMap()
    theirs.load_xml_from_string(text)
    adapter = genapi.EventAdapterGEV()
    adapter.attach_node_map(theirs.pointer)
    datagram = message(0xC2, struct.pack(">HHHHQ", 0, 0x9002, 0, block, ticks) + more)
    adapter.deliver_message(datagram)
    ours = MessageFeatures(GenicamFeatures(parse(DESCRIPTION.encode()), NoMemory(), "T"), "EventID")
    (event,) = decode_events(datagram).items
    values, problems = ours.read({event.number: memoryview(event.data)})
    expected = {name: theirs.get_node(name).value for name in names}
    adapter.detach_node_map()
    assert values == expected
    assert not problems


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_description_packed_by_other_than_deflate_is_refused(method: int) -> None:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", method) as archive:
        archive.writestr("a.xml", b"<RegisterDescription/>")
    with pytest.raises(MessageError, match=rf"expected DEFLATE .* got method {method}"):
        _description.unpack(packed.getvalue())


def test_description_in_a_large_archive_is_refused() -> None:
    with pytest.raises(MessageError, match="ZIP archive: expected at most"):
        _description.unpack(b"PK" + bytes(_description.MAX_PACKED_BYTES))


def test_description_of_a_structure_with_many_entries_is_refused() -> None:
    text = "<Sign/>" * 1000 + '<StructEntry Name="e"/>' * 1000
    text = f"<RegisterDescription><StructReg>{text}</StructReg></RegisterDescription>"
    with pytest.raises(MessageError, match="copies for the entries of StructRegs"):
        _description.parse(text.encode())
