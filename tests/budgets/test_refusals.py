"""Inputs that stand for more than they are, and are refused before that is made of them."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from smartcam._suggestions import MAX_KNOWN_WORDS, MAX_WORD_CHARACTERS, did_you_mean
from smartcam.depth import load_cloud
from smartcam.emulator import load_scenario
from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.fleet._inside import patterns_overlap


def test_scenario_with_aliases_in_a_key_is_refused(tmp_path: Path) -> None:
    lines = ["x: &a0 [1]", *(f"y{n}: &a{n + 1} [*a{n}, *a{n}]" for n in range(40)), "? *a40\n: 1"]
    path = tmp_path / "a.yaml"
    path.write_text("\n".join(lines))
    with pytest.raises(ConfigurationError, match=r"line 41: expected a text as a key, got a seq"):
        load_scenario(path)


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
    assert patterns_overlap(one, other) is met
    assert patterns_overlap(other, one) is met
