"""Inputs that stand for more than they are, and are refused before that is made of them."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path
from typing import Any

import pytest

from smartcam._suggestions import MAX_KNOWN_WORDS, MAX_WORD_CHARACTERS, did_you_mean
from smartcam.depth import load_cloud
from smartcam.emulator import load_scenario
from smartcam.emulator._line_codec import _LineForm
from smartcam.exceptions import ConfigurationError, FrameFormatError, MessageError
from smartcam.fleet._bus.address import CERTIFICATE_FILES
from smartcam.fleet._inside import meets, read_identity
from smartcam.fleet._security.certificates import MAX_BYTES
from smartcam.frames._gige import description as _description
from smartcam.layout._inside import BadYamlError, load
from smartcam.layout._yamls import MAX_DEPTH


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
    with pytest.raises(MessageError, match="StructReg counted for each entry"):
        _description.parse(text.encode())


def test_scenario_with_aliases_in_a_key_is_refused(tmp_path: Path) -> None:
    lines = ["x: &a0 [1]", *(f"y{n}: &a{n + 1} [*a{n}, *a{n}]" for n in range(40)), "? *a40\n: 1"]
    path = tmp_path / "a.yaml"
    path.write_text("\n".join(lines))
    with pytest.raises(ConfigurationError, match=r"line 41: expected a text as a key, got a seq"):
        load_scenario(path)


def test_scenario_with_many_mistakes_tells_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import smartcam.layout._yaml_files as module

    asked: list[object] = []
    meant = module._meant

    def counted(*given: Any) -> str:
        asked.append(given)
        return meant(*given)

    monkeypatch.setattr(module, "_meant", counted)
    path = tmp_path / "a.yaml"
    path.write_text("".join(f"no{n}: 1\n" for n in range(500)))
    with pytest.raises(ConfigurationError, match="no0"):
        load_scenario(path)
    assert len(asked) == 20


@pytest.mark.parametrize(
    "text",
    ["[" * 1000, "{a: " * 1000, "- " * 1000, "\n".join(" " * n + "a:" for n in range(1000))],
)
def test_yaml_nested_too_deep_says_where(text: str) -> None:
    with pytest.raises(BadYamlError, match=f"nested too deep: expected {MAX_DEPTH} ") as caught:
        load(text)
    assert caught.value.line is not None


def test_yaml_nested_as_deep_as_it_may_be_is_read() -> None:
    text = "[" * (MAX_DEPTH - 1) + "1" + "]" * (MAX_DEPTH - 1)
    assert str(load(text)) == text


def test_suggestion_for_a_long_word_is_none() -> None:
    assert did_you_mean("colour", ["color"]) == "; did you mean 'color'?"
    assert did_you_mean("a" * (MAX_WORD_CHARACTERS + 1), ["a" * MAX_WORD_CHARACTERS]) == ""
    assert did_you_mean("abc", [*map(str, range(MAX_KNOWN_WORDS)), "abd"]) == ""


def test_cloud_that_unpacks_to_more_than_a_file_may_have_is_refused(tmp_path: Path) -> None:
    points = 1 << 28
    path = tmp_path / "a.pcd"
    head = f"VERSION 0.7\nFIELDS x\nSIZE 8\nTYPE F\nWIDTH {points}\nHEIGHT 1\nPOINTS {points}\n"
    body = struct.pack("<II", 4, (8 * points) & 0xFFFFFFFF)
    path.write_bytes(f"{head}DATA binary_compressed\n".encode() + body + bytes(4))
    with pytest.raises(FrameFormatError, match="points that unpack to"):
        load_cloud(path, unit="m")


def test_cloud_with_a_line_of_a_megabyte_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    head = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n"
    path.write_bytes(head + b"1 " * (1 << 20))
    with pytest.raises(FrameFormatError, match="lines of up to 1048576 bytes, got 2097152"):
        load_cloud(path, unit="m")


def test_certificate_of_more_than_a_megabyte_is_refused(tmp_path: Path) -> None:
    for name in CERTIFICATE_FILES:
        (tmp_path / name).write_bytes(bytes(MAX_BYTES + 1))
    with pytest.raises(ConfigurationError, match=f"expected {MAX_BYTES} bytes at most"):
        read_identity(tmp_path)


@pytest.mark.parametrize(
    ("one", "other", "met"),
    [
        ("**/" * 1000 + "z", "a/b/c/d", False),
        ("**/" * 1000 + "d", "a/b/c/d", True),
        ("a/" + "$*a" * 1000 + "b", "a/" + "a" * 999, False),
        ("a/$*b$*d", "a/abcd", True),
        ("a/b$*b", "a/b", False),
        ("**/a/**", "**/b/**", True),
        ("*/b", "a/**", True),
        ("**", "", True),
    ],
)
def test_patterns_meet(one: str, other: str, met: bool) -> None:
    assert meets(one, other) is met
    assert meets(other, one) is met


@pytest.mark.parametrize(
    ("line", "text", "fields"),
    [
        ("HELLO", "HELLO", {}),
        ("HELLO", "HELLO!", None),
        ("C {a} {b}", "C 1 2 3", {"a": "1 2", "b": "3"}),
        ("C {a} {b} END", "C 1 2 END", {"a": "1", "b": "2"}),
        ("C {a} {b} END", "C" + " 1" * 2000, None),
        ("{a}aa{b}aa", "aaa", None),
        ("{a}{b}", "xy", {"a": "xy", "b": ""}),
    ],
)
def test_line_is_read_as_its_row_writes_it(
    line: str, text: str, fields: dict[str, str] | None
) -> None:
    assert _LineForm.of(line).read(text) == fields
