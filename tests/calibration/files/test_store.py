"""The store writes exactly, whole or not at all, and reads known versions only."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import CalibrationError
from tests.calibration.inside import keep_backup, read, read_document, replace_file, store, write


def files(folder: Path) -> list[str]:
    return sorted(one.name for one in folder.iterdir())


def rewritten(path: Path, **changes: Any) -> None:
    """Change fields of a file, and its hash with them."""
    content = json.loads(path.read_bytes())
    content.pop("sha256")
    content.update(changes)
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    content["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    path.write_text(json.dumps(content))


def refusal(path: Path, kind: str = "plane") -> tuple[str, str]:
    """Return code and text of the error of a file."""
    with pytest.raises(CalibrationError) as caught:
        read(path, kind)
    return caught.value.code, str(caught.value)


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False)))
def test_floats_come_back_bit_by_bit(tmp_path_factory: Any, values: list[float]) -> None:
    path: Path = tmp_path_factory.getbasetemp() / "floats.json"
    write(path, "plane", {"values": values}, backups=0)
    back = read(path, "plane")["values"]
    assert [struct.pack("<d", one) for one in back] == [struct.pack("<d", one) for one in values]


def test_document_has_all_written_fields(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write(path, "plane", {"x": [1, 2.5, None, "ü\ud800"]}, context={"tool": "pin"})
    document = read_document(path)
    assert (document.kind, document.data, document.context, document.version) == (
        "plane", {"x": [1, 2.5, None, "ü\ud800"]}, {"tool": "pin"}, (1, 0),
    )  # fmt: skip
    assert {"python", "smartcam", "numpy"} <= set(document.software)
    content = json.loads(path.read_text())
    assert content["units"] == {"length": "m", "angle": "rad", "time": "s"}
    assert content["written_at"].endswith("+00:00")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), object(), {1, 2}])
def test_write_of_values_that_json_lacks_is_refused_and_leaves_the_file(
    tmp_path: Path, value: object
) -> None:
    path = tmp_path / "a.json"
    write(path, "plane", {"x": 1})
    with pytest.raises(CalibrationError, match="cannot be stored") as caught:
        write(path, "plane", {"x": value})
    assert caught.value.code == "NOT_STORABLE"
    assert read(path, "plane") == {"x": 1}
    assert files(tmp_path) == ["a.json"]


def test_write_of_too_much_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="expected 16777216 at most"):
        write(tmp_path / "a.json", "plane", {"x": "x" * store.MAX_FILE_BYTES})


def test_read_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write(path, "camera", {})
    assert refusal(path) == ("WRONG_KIND", f"{path}: holds 'camera', expected 'plane'")


@pytest.mark.parametrize(
    ("body", "text"),
    [
        (b"", "no JSON"),
        (b"\xff\xfe", "no JSON"),
        (b"[" * 100_000, "no JSON"),
        (b"[]", "no JSON object"),
        (b'{"a": 1}', "schema None, expected 'smartcam.calibration'"),
        (b'{"schema": "smartcam.calibration"}', "schema_version None"),
        (b'{"schema": "smartcam.calibration", "schema_version": "1.0"}', "its hash does not match"),
        (b" " * (store.MAX_FILE_BYTES + 1), "more than 16777216 bytes"),
    ],
)
def test_read_of_no_calibration_is_refused(tmp_path: Path, body: bytes, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(body)
    code, said = refusal(path)
    assert code == "BROKEN_FILE"
    assert text in said


def test_read_after_any_byte_was_changed_is_refused_or_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write(path, "plane", {"x": [0.1, 2]})
    body = path.read_bytes()
    for index in range(len(body)):
        changed = bytearray(body)
        changed[index] ^= 1
        path.write_bytes(changed)
        try:
            assert read(path, "plane") == {"x": [0.1, 2]}  # without a meaning between two values
        except CalibrationError as exc:
            assert exc.code in {"BROKEN_FILE", "NEWER_VERSION"}  # noqa: PT017  either is good


def test_read_of_a_newer_major_is_refused_and_of_a_newer_minor_is_not(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    write(path, "plane", {"x": 1})
    rewritten(path, schema_version="2.0")
    assert refusal(path) == (
        "NEWER_VERSION",
        f"{path}: schema version 2.0, expected 1 at most: a newer smartcam wrote it",
    )
    rewritten(path, schema_version="1.7", new="thing")
    assert read(path, "plane") == {"x": 1}


def test_read_of_an_older_major_migrates_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.json"
    write(path, "plane", {"x_mm": 5})
    assert refusal_of_version(path, "0.9")[0] == "BROKEN_FILE"
    monkeypatch.setitem(
        store.MIGRATIONS, 0, lambda old: {**old, "data": {"x": old["data"]["x_mm"] / 1000}}
    )
    assert read(path, "plane") == {"x": 0.005}


def refusal_of_version(path: Path, version: str) -> tuple[str, str]:
    rewritten(path, schema_version=version)
    return refusal(path)


def test_backups_are_kept_newest_first(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for number in range(6):
        write(path, "plane", {"n": number})
    kept = [read(tmp_path / name, "plane")["n"] for name in ("a.json", "a.json.1", "a.json.2")]
    assert kept == [5, 4, 3]
    assert files(tmp_path) == ["a.json", "a.json.1", "a.json.2", "a.json.3"]


def test_keep_backup_copies_if_links_are_impossible(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise OSError("no links here")

    path = tmp_path / "a"
    path.write_text("old")
    monkeypatch.setattr(os, "link", refuse)
    keep_backup(path, 2)
    assert (tmp_path / "a.1").read_text() == "old"


def test_replace_file_takes_the_place_of_a_link_and_leaves_its_target(tmp_path: Path) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("secret")
    link.symlink_to(target)
    replace_file(link, b"new", backups=2)
    assert (target.read_text(), link.read_text(), link.is_symlink()) == ("secret", "new", False)


class PowerCutError(Exception):
    """The error of a power failure."""


CALLS = {"open", "os.rename", "os.remove", "os.link", "os.truncate", "shutil.copyfile"}
"""Audit events of calls that change files."""

_calls_left: list[int] = []
"""Number of calls before the power failure; empty: no failure."""


def _cut(event: str, _arguments: object) -> None:
    if _calls_left and event in CALLS:
        _calls_left[0] -= 1
        if _calls_left[0] < 0:
            raise PowerCutError


sys.addaudithook(_cut)


def test_power_cut_before_any_call_leaves_the_old_file_or_the_new_one(tmp_path: Path) -> None:
    seen: list[int] = []
    cut = True
    while cut:
        path = tmp_path / str(len(seen)) / "a.json"
        path.parent.mkdir()
        for number in range(3):
            write(path, "plane", {"n": number})
        _calls_left.append(len(seen))
        try:
            write(path, "plane", {"n": 3})
            cut = False
        except PowerCutError:
            cut = True
        finally:
            _calls_left.clear()
        seen.append(read(path, "plane")["n"])
        backups = {read(one, "plane")["n"] for one in path.parent.glob("a.json.*")}
        assert {0, 1, 2} <= backups | {seen[-1]}
    assert (seen[0], seen[-1], set(seen)) == (2, 3, {2, 3})
    assert len(seen) > 5
