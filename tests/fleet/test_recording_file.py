"""The section ``record:`` of a fleet file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from smartcam.exceptions import ConfigurationError
from smartcam.fleet import load_fleet
from smartcam.fleet._inside import RecordSection


def load(folder: Path, record: str) -> RecordSection:
    path = folder / "fleet.yaml"
    path.write_text(f"record: {record}\ncameras:\n  a: {{emulated: {{}}}}\n", encoding="utf-8")
    section = load_fleet(path).record
    assert section is not None
    return section


def test_nothing_said_is_enough(tmp_path: Path) -> None:
    section = load(tmp_path, "{}")
    assert (section.size, section.age, section.keep) == (1e8, 3600, 1e10)
    assert section.path(tmp_path) == tmp_path / "recordings"
    assert section.messages
    assert section.chooses("line1/cam3")


@pytest.mark.parametrize(
    ("said", "size"),
    [
        ("100 MB", 1e8),
        ("1.5GB", 1.5e9),
        ("200 kb", 2e5),
        ("1 MiB", 1 << 20),
        ("150000", 150_000),
        ("200000 B", 200_000),
    ],
)
def test_sizes_have_units(tmp_path: Path, said: str, size: float) -> None:
    assert load(tmp_path, f"{{size: {said}}}").size == size


@pytest.mark.parametrize(
    ("said", "age"), [("1 h", 3600), ("30 min", 1800), ("90 s", 90), ("1.5d", 129_600), ("60", 60)]
)
def test_ages_have_units(tmp_path: Path, said: str, age: float) -> None:
    assert load(tmp_path, f"{{age: {said}}}").age == age


@pytest.mark.parametrize(
    ("record", "text"),
    [
        ("{size: many}", "line 1: record.size: expected a number with a unit, such as '100 MB'"),
        ("{size: 1 h}", "units are B, kB, MB, GB, TB, KiB, MiB, GiB, TiB; got '1 h'"),
        ("{size: 10 kB}", "expected 100000 to "),
        ("{size: true}", "got True"),
        ("{size: .nan}", "expected 100000 to "),
        ("{age: 5 m}", "units are s, min, h, d; got '5 m'"),
        ("{age: -1 s}", "got '-1 s'"),
        ("{keep: 150 MB}", "line 1: record.keep: expected twice the size of a file"),
        ("{cameras: Line1}", "expected a camera's name, or a pattern such as line1/**"),
        ("{cameras: []}", "0 patterns, expected 1 to 1000"),
        ("{folder: fleet.yaml}", "is there, and is no folder"),
        ("{seize: 1 GB}", "did you mean 'size'?"),
    ],
)
def test_mistakes_are_told(tmp_path: Path, record: str, text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        load(tmp_path, record)
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("patterns", "chosen"),
    [
        ("**", {"a", "line1/cam1", "line1/cam2", "line2/x/cam1"}),
        ("line1/*", {"line1/cam1", "line1/cam2"}),
        ("*/cam1", {"line1/cam1"}),
        ("**/cam1", {"line1/cam1", "line2/x/cam1"}),
        (["a", "line1/*2"], {"a", "line1/cam2"}),
        ("*", {"a"}),
    ],
)
def test_cameras_are_chosen_by_patterns(patterns: Any, chosen: set[str]) -> None:
    section = RecordSection.model_validate({"cameras": patterns})
    names = {"a", "line1/cam1", "line1/cam2", "line2/x/cam1"}
    assert {name for name in names if section.chooses(name)} == chosen


def test_pattern_that_would_take_for_ever_does_not() -> None:
    many = RecordSection.model_validate({"cameras": "/".join(["**"] * 60 + ["z"])})
    assert not many.chooses("a/b/c/d")
    assert not RecordSection.model_validate({"cameras": "a*" * 60 + "z"}).chooses("a" * 200)
    with pytest.raises(ValidationError):
        RecordSection.model_validate({"cameras": "a" * 10_000 + "/"})
