"""Scenario files."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from pydantic import ValidationError

from smartcam.emulator import Application, Scenario, load_scenario
from smartcam.exceptions import ConfigurationError, MissingExtraError
from tests import ROOT

BOLTS = ROOT / "examples" / "scenarios" / "bolts.yaml"


def write(folder: Path, text: str) -> Path:
    path = folder / "line.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_example_loads() -> None:
    scenario = load_scenario(str(BOLTS))
    assert [app.id for app in scenario.applications] == [11, 12, 13, 14, 15]
    assert [app.id for app in scenario.all_applications] == [11, 12, 13, 14, 15, 1, 3, 7, 9, 21]
    assert scenario.quirks.overtriggered_time == 0.25
    assert scenario.applications[3].rate == 25.0


def test_scenario_defaults() -> None:
    scenario = Scenario()
    assert [app.id for app in scenario.all_applications] == [1, 3, 7, 9, 21]
    assert not scenario.running


def test_scenario_replaces_a_builtin_of_the_same_id() -> None:
    scenario = Scenario(applications=(Application(id=3, name="mine"),))
    assert [(app.id, app.name) for app in scenario.all_applications][:2] == [
        (3, "mine"),
        (1, "three texts"),
    ]


def test_scenario_id_twice_is_refused() -> None:
    with pytest.raises(ValidationError, match="application id 5 is there twice"):
        Scenario(applications=(Application(id=5), Application(id=5)))


def test_scenario_without_builtins(tmp_path: Path) -> None:
    path = write(tmp_path, "builtins: false\napplications:\n  - id: 5\n")
    assert [app.id for app in load_scenario(path).all_applications] == [5]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "line.yaml: expected fields such as 'applications:'"),
        ("- 1\n", "line.yaml: expected fields such as"),
        ("just a text\n", "line.yaml: expected fields such as"),
        ("name: a\nname: b\n", "line.yaml, line 2: 'name' stands there twice"),
        (
            "applications:\n  - id: 5\n    name: x\n    id: 6\n",
            "line.yaml, line 4: 'id' stands there twice",
        ),
        ("name: [1\n", "line.yaml, line 2: "),
        ("name: \x01\n", "line.yaml: "),
        ("name: !!python/object:os.system x\n", "line.yaml, line 1: could not determine"),
        ("running: 2020-13-45\n", "line.yaml: month must be"),
        ("colour: red\n", "line.yaml, line 1: colour: Extra inputs are not permitted"),
        (
            "timeline:\n  - {at: 1, do: {kind: drop, nthh: 3}}\n",
            "line.yaml, line 2: timeline.0.do.0.drop.nthh: Extra .*; did you mean 'nth'",
        ),
        (
            "applications:\n  - id: 5\n  - id: 6\n    rate: -1\n",
            "line.yaml, line 4: applications.1.rate: Input should be greater than or equal to "
            "0.0001",
        ),
        (
            "applications:\n  - id: 5\n  - name: x\n",
            "line.yaml, line 3: applications.1.id: Field required",
        ),
        (
            'applications:\n  - id: 5\n    layout: "n: uint8"\n    constant: [300]\n',
            "line.yaml, line 2: applications.0: layout: .*got 300",
        ),
        ("applications: 5\n", "line.yaml, line 1: applications: Input should be a valid tuple"),
        ("a: &x [*x]\n", "line.yaml, line 1: an alias of a value that contains this alias"),
        (
            "quirks:\n  bad_frame: open\n",
            "line.yaml, line 2: quirks.bad_frame: Input should be 'skip' or 'close'",
        ),
        ("applications:\n  - {id: 5}\n  - {id: 5}\n", "application id 5 is there twice"),
        (
            "rate: 1\nactive: x\n",
            "line 2: active: Input should be a valid integer.*; line 1: rate: Extra",
        ),
    ],
)
def test_mistake_is_named_with_file_line_and_field(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigurationError, match=f"(?s)scenario .*{message}"):
        load_scenario(write(tmp_path, text))


def test_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"scenario .*none.yaml: .*No such file"):
        load_scenario(tmp_path / "none.yaml")


def test_file_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "line.yaml"
    path.write_bytes(b"name: \xff\xfe\n")
    with pytest.raises(ConfigurationError, match=r"scenario .*utf-8"):
        load_scenario(path)


def test_without_pyyaml_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingExtraError, match=r'pip install "smartcam\[yaml\]"') as caught:
        load_scenario(BOLTS)
    assert caught.value.extra == "yaml"
