"""YAML from anywhere: bombs, giants and nonsense end in a typed error that names the line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from smartcam.emulator import EmulatedCamera, load_scenario
from smartcam.emulator._inside import load_scenarios
from smartcam.exceptions import ConfigurationError
from smartcam.layout import Layout
from smartcam.layout._inside import BadYamlError, load
from tests.layout.bombs import laughs, merges
from tests.layout.inside import _yaml_files as yaml_files
from tests.layout.inside import _yaml_parsing as yamls


@pytest.mark.parametrize("text", [laughs(30), merges(40), laughs(9), "- a\n" * 6000])
def test_load_of_a_bomb_is_refused_with_its_line(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(yamls, "MAX_NODES", 5000)
    with pytest.raises(BadYamlError, match=r"expected 5000 values at most") as told:
        load(text)
    assert told.value.line is not None
    assert 1 < told.value.line <= text.count("\n") + 1


def test_load_of_too_long_a_text_is_refused() -> None:
    with pytest.raises(BadYamlError, match="8388609 characters, expected 8388608 at most"):
        load(" " * (yamls.MAX_YAML_TEXT_CHARACTERS + 1))


@pytest.mark.parametrize(
    "text", ["a: &a [*a]", "a: &a {b: *a}", "a: &a\n  <<: *a", "&a [*a, [*a]]"]
)
def test_load_of_what_contains_itself_is_refused(text: str) -> None:
    with pytest.raises(BadYamlError, match="an alias of a value that contains this alias"):
        load(text)


@pytest.mark.parametrize(
    "number", ["9" * 5000, "0x" + "f" * 4000, "-" + "1" * 30, "0b1" + "0" * 64]
)
def test_load_of_a_giant_is_refused_with_its_line(number: str) -> None:
    with pytest.raises(BadYamlError, match="characters, expected 64 bits at most") as told:
        load(f"a: 1\nb: {number}\n")
    assert told.value.line == 2


@pytest.mark.parametrize(
    "text", ["[" * 5000, "a: b: c", "!!int x", "!!python/name:os.system", "\0"]
)
def test_load_of_no_yaml_is_refused(text: str) -> None:
    with pytest.raises(BadYamlError):
        load(text)


def test_load_aliases_and_merges_of_people_are_taken() -> None:
    text = "base: &b {x: 1, y: 0x7fffffffffffffff}\nall:\n- {<<: *b, x: 2}\n- *b\n"
    assert load(text) == {
        "base": {"x": 1, "y": 2**63 - 1},
        "all": [{"x": 2, "y": 2**63 - 1}, {"x": 1, "y": 2**63 - 1}],
    }
    assert load("") is None


def scenario(tmp_path: Path, text: str) -> str:
    """Return the error of a scenario file, after the file's name."""
    path = tmp_path / "s.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as told:
        load_scenarios(path)
    assert str(told.value).startswith(f"scenario {path}, line ")
    return str(told.value).partition("s.yaml, ")[2]


def test_scenario_bombs_and_giants_name_the_line(tmp_path: Path) -> None:
    assert "expected 500000 values at most" in scenario(tmp_path, merges(40))
    assert "expected 500000 values at most" in scenario(tmp_path, laughs(30))
    assert scenario(tmp_path, f"builtins: true\nactive: 0x{'f' * 4000}\n") == (
        "line 2: the number 0xffffffffffffffffff... of 4002 characters, expected 64 bits at most"
    )
    assert scenario(tmp_path, f"active: {2**63}\n").startswith(
        "line 1: active: no application has such an id; there are "
    )


def test_scenario_of_many_mistakes_tells_the_first_ones(tmp_path: Path) -> None:
    told = scenario(tmp_path, "applications:\n" + "- {id: x}\n" * 100)
    assert told.count("applications.") == 20


def test_scenario_doubles_are_found_among_many(tmp_path: Path) -> None:
    rows = [f"- {{id: {number}, constant: [1], layout: 'n: int32'}}" for number in range(1, 300)]
    text = "\n".join(["applications:", *rows, rows[7]])
    assert "application id 8 is there twice" in scenario(tmp_path, text)


def test_emulated_camera_giant_active_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="emulator: active: expected an integer"):
        EmulatedCamera(active=10**5000)


@pytest.mark.parametrize("text", [laughs(30), merges(40), f"fields: 0x{'f' * 4000}"])
def test_layout_bombs_are_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="nor is it YAML: line"):
        Layout.from_yaml(text)


def test_scenario_with_many_mistakes_tells_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    meant = yaml_files._field_hint

    def counted(*given: Any) -> str:
        asked.append(given)
        return meant(*given)

    monkeypatch.setattr(yaml_files, "_field_hint", counted)
    path = tmp_path / "a.yaml"
    path.write_text("".join(f"no{n}: 1\n" for n in range(500)))
    with pytest.raises(ConfigurationError, match="no0"):
        load_scenario(path)
    assert len(asked) == 20


@pytest.mark.parametrize(
    "text", ["[" * 1000, "{a: " * 1000, "- " * 1000, "\n".join(" " * n + "a:" for n in range(1000))]
)
def test_yaml_nested_too_deep_says_where(text: str) -> None:
    with pytest.raises(
        BadYamlError, match=f"nested too deep: expected {yamls.MAX_DEPTH} "
    ) as caught:
        load(text)
    assert caught.value.line is not None


def test_yaml_nested_as_deep_as_it_may_be_is_read() -> None:
    text = "[" * (yamls.MAX_DEPTH - 1) + "1" + "]" * (yamls.MAX_DEPTH - 1)
    assert str(load(text)) == text
