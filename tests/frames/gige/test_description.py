"""Descriptions of cameras: what is read of them, and what a hostile one cannot do."""

import contextlib
import io
import struct
import zipfile
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import FrameSourceError, MessageError
from smartcam.frames._gige import _description
from smartcam.frames._gige._description import locate, parse, unpack
from smartcam.frames._gige._expressions import evaluate
from smartcam.frames._gige._features import GenicamFeatures
from tests.frames.gige.camera import DESCRIPTION


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
def test_a_url_tells_where_it_lies(url: str, place: tuple[str, int, int]) -> None:
    assert locate(url) == place


@pytest.mark.parametrize(
    "url",
    ["", "http://example.invalid/a.xml", "Local:a.xml", "Local:a;1;0", "Local:a;1;7fffffff",
     "Local:a;123456789;1", "File:a.zip"],
)  # fmt: skip
def test_another_url_is_refused(url: str) -> None:
    with pytest.raises(MessageError):
        locate(url)


def test_it_is_unpacked() -> None:
    assert unpack(zipped(b"<a/>")) == b"<a/>"
    assert unpack(b"<a/>\0\0\0") == b"<a/>"


def test_what_unpacks_to_too_much_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_description, "LARGEST", 10_000)
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
    ("text", "said"),
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
def test_what_is_no_description_is_refused(text: bytes, said: str) -> None:
    with pytest.raises(MessageError, match=said):
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
    with pytest.raises(FrameSourceError, match="256 has no room in 8 bits"):
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
    ("inside", "said"),
    [
        (KNIFE.format("A", "A", "X"), "in a circle"),
        (KNIFE.format("A", "B", "X") + KNIFE.format("B", "A", "X"), "in a circle"),
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
async def test_a_description_that_leads_nowhere_is_said(inside: str, said: str) -> None:
    there, _ = features(described('<Integer Name="Five"><Value>5</Value></Integer>' + inside))
    with pytest.raises(FrameSourceError, match=f"feature A: .*{said}"):
        await there.get("A")


async def test_a_fan_of_variables_is_bounded() -> None:
    """Each level asks the next one twice: without a bound 2 to the 40 reads."""
    knives = "".join(
        f'<IntSwissKnife Name="N{at}"><pVariable Name="X">N{at + 1}</pVariable>'
        f'<pVariable Name="Y">N{at + 1}</pVariable><Formula>X + Y</Formula></IntSwissKnife>'
        for at in range(40)
    )
    there, _ = features(described(knives + '<Integer Name="N40"><Value>1</Value></Integer>'))
    with pytest.raises(FrameSourceError, match="circle"):
        await there.get("N0")


VARIABLES = {"A": 0, "B": 5, "A.Max": 7}


@pytest.mark.parametrize(
    ("formula", "whole", "expected"),
    [
        ("1+2*3", True, 7),
        ("2**3**2", True, 512),
        ("-2**2", True, -4),
        ("-7/2", True, -3),
        ("-7%3", True, -1),
        ("7/2", False, 3.5),
        ("A?1:B?2:3", True, 2),
        ("(A=0)&&(B<>0)||X", True, 1),
        ("0xFF>>4&3", True, 3),
        ("1<<63", True, -(1 << 63)),
        ("ROUND(2.345, 2)", False, 2.35),
        ("SQRT(16)+TRUNC(2.9)-FLOOR(1.5)+CEIL(1.1)", False, 7),
        ("10-3-2", True, 5),
        ("~0 + !B", True, -1),
        ("1>0=1", True, 1),
        ("LG(1000)+LN(E)+SGN(-3)", False, 3),
        ("A.Max+1", True, 8),
        ("1|2^3&1", True, 3),
        ("1e3", False, 1000),
    ],
)
def test_formulas(formula: str, whole: bool, expected: float) -> None:
    assert evaluate(formula, VARIABLES, whole=whole) == expected


@pytest.mark.parametrize(
    "formula",
    ["", "1 +", "(1", "1)", "1 ? 2", "SQRT(-1)", "SIN(1, 2)", "1 // 2", "a b", "9" * 9000,
     "(" * 5000 + "1", "-" * 5000 + "1", "1" + "+1" * 4000, "9**9**9**9", "1e308*10", "2.0**0.5**",
     "1?" * 1000 + "1" + ":1" * 1000, "__import__('os')", "1/0", "-1**0.5 + (0-8)**(1/3)"],
)  # fmt: skip
def test_a_formula_that_has_no_value_is_refused(formula: str) -> None:
    with pytest.raises(MessageError):
        evaluate(formula, VARIABLES, whole=False)


@given(st.text("0123456789+-*/%&|^~<>=?:(),!AB. eEx", max_size=40), st.booleans())
def test_any_formula_has_a_number_or_is_refused(formula: str, whole: bool) -> None:
    try:
        value: Any = evaluate(formula, VARIABLES, whole=whole)
    except MessageError:
        return
    assert isinstance(value, int if whole else float)


def test_a_damaged_stream_in_the_archive_is_refused() -> None:
    data = bytearray(zipped(b"<a/>" * 1000))
    at = data.index(b"a.xml") + 5
    data[at : at + 8] = bytes(8)
    with pytest.raises(MessageError):
        unpack(bytes(data))
