"""Scenario files with a timeline and with several cameras; cameras that are started together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

import smartcam
from smartcam.emulator import EmulatedCamera, EmulatedFleet, ManualClock, Scenario, load_scenario
from smartcam.emulator._inside import load_scenarios, scenario_schema
from smartcam.exceptions import ConfigurationError
from tests import ROOT
from tests.schemas import plain

CELL = """\
seed: 10
quirks: {busy_while_processing: true, reboot_time: 2}
applications:
  - {id: 5, layout: "n: int32", constant: [1]}
builtins: false
timeline:
  - at: 1
    do: {kind: drop, on: QueryAnswer}
cameras:
  - name: left
    dialect: bid
    active: 6
    applications:
      - {id: 5, layout: "n: int32", constant: [2]}
      - id: 6
  - transport: udp
    seed: 3
    quirks: {reboot_time: 3}
    timeline:
      - command: jam
        chance: 0.5
        do: {kind: stop}
      - entering: running
        do:
          - kind: start
          - {kind: switch_application, application: 5}
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "cell.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_cameras_share_what_stands_beside_them(tmp_path: Path) -> None:
    left, right = load_scenarios(write(tmp_path, CELL))
    assert (left.name, left.dialect, left.transport, left.seed) == ("left", "bid", "tcp", 10)
    assert (right.name, right.dialect, right.transport, right.seed) == (
        "camera2", "handbook", "udp", 3
    )  # fmt: skip
    assert [(app.id, app.constant) for app in left.all_applications] == [(5, [2]), (6, None)]
    assert [(app.id, app.constant) for app in right.all_applications] == [(5, [1])]
    assert (left.quirks.reboot_time, right.quirks.reboot_time) == (2, 3)
    assert left.quirks.busy_while_processing
    assert right.quirks.busy_while_processing
    assert [cue.at for cue in left.timeline] == [1]
    assert [cue.at for cue in right.timeline] == [1, None, None]
    assert (left.commands, right.commands) == ((), ("jam",))
    assert (left.is_random, right.is_random) == (False, True)


def test_one_camera_is_asked_of_a_file_with_two(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"has 2: left, camera2; EmulatedFleet takes them"):
        load_scenario(write(tmp_path, CELL))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("at: 1\n", "at: -1\n", "cell.yaml, line 7: timeline.0.at: Input should be greater"),
        ("on: QueryAnswer", "on: Answer", "line 8: timeline.0.do.0.drop.on: no message is called"),
        ("QueryAnswer", "TriggerAnswer", "line 8: timeline.0.do.0.on: dialect handbook has no"),
        ("chance: 0.5", "chance: 5", "line 21: cameras.1.timeline.0.chance: Input should be less"),
        ("kind: stop", "kind: stopp", "line 22: cameras.1.timeline.0.do.0: Input tag 'stopp'"),
        ("entering: running", "entering: x", "line 23: cameras.1.timeline.1.entering: Input"),
        ("application: 5", "application: 7", "line 26: cameras.1.timeline.1.do.1.application: the"),
        ("active: 6", "active: 7", "line 12: cameras.0.active: no application has the id 7"),
        ("id: 6", "id: 65536", "line 15: cameras.0.applications.1.id: application id 65536 does"),
        ("{id: 5, layout: \"n: int32\", constant: [1]}", "{id: 65536}",
         "line 4: applications.0.id: application id 65536 does not fit dialect bid"),
        ("dialect: bid", "dialect: bib", "line 11: cameras.0.dialect: unknown; known are handbook"),
        ("transport: udp", "transport: ip", "line 16: cameras.1.transport: Input should be 'tcp'"),
        ("transport: udp", "name: left", "line 1: two cameras are called 'left'"),
        ("reboot_time: 3", "code: true", "line 18: cameras.1.quirks: dialect handbook has no"),
        ("seed: 10", "port: 3000", "line 1: port: with several cameras each has its own"),
        ("seed: 10", "colour: red", "line 1: colour: Extra inputs are not permitted"),
    ],
)  # fmt: skip
def test_mistake_is_named_with_file_line_and_field(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in CELL
    with pytest.raises(ConfigurationError) as caught:
        load_scenarios(write(tmp_path, CELL.replace(old, new, 1)))
    assert message in str(caught.value)


def test_dialect_that_is_given_goes_before_the_files(tmp_path: Path) -> None:
    path = write(tmp_path, "quirks: {code: true}\n")
    with pytest.raises(ConfigurationError, match="line 1: quirks: dialect handbook has no quirk"):
        load_scenario(path)
    assert load_scenario(path, dialect="b16").dialect == "b16"
    assert EmulatedCamera(scenario=path, dialect="b16").wire_dialect.quirks == ("code",)


def test_scenario_says_dialect_transport_and_port() -> None:
    scenario = Scenario(dialect="thesis", transport="udp", port=45_000)
    emulator = EmulatedCamera(scenario=scenario)
    assert emulator.url == "bvs+udp://127.0.0.1:45000?dialect=thesis"
    other = EmulatedCamera(scenario=scenario, dialect="b16", transport="tcp", port=0)
    assert other.url == "bvs://127.0.0.1:0?dialect=b16"


async def test_fleet_starts_and_stops_all(tmp_path: Path) -> None:
    clock = ManualClock()
    fleet = EmulatedFleet(write(tmp_path, CELL), clock=clock, quirks={"reboot_time": 9})
    assert (len(fleet), list(fleet.cameras)) == (2, ["left", "camera2"])
    async with fleet:
        assert fleet.urls == {name: fleet[name].url for name in ("left", "camera2")}
        for emulator in fleet:
            assert isinstance(emulator, EmulatedCamera)
            assert emulator.quirks.reboot_time == 9
            async with smartcam.connect(emulator.url) as camera:
                assert camera.active_application in {5, 6}
        clock.advance(1)
        assert [emulator.cue_counts for emulator in fleet] == [[1], [1, 0, 0]]
    with pytest.raises(smartcam.ConnectFailedError):
        await smartcam.connect(fleet["left"].url, reconnect=None, connect_timeout=1)


def test_fleet_says_which_cameras_it_has(tmp_path: Path) -> None:
    fleet = EmulatedFleet([Scenario(name="one"), Scenario(name="two")])
    with pytest.raises(ConfigurationError, match="has no camera 'three'; there are one, two"):
        fleet["three"]
    with pytest.raises(ConfigurationError, match="two cameras are called 'one'"):
        EmulatedFleet([Scenario(name="one"), Scenario(name="one")])


async def test_fleet_of_which_one_cannot_listen_starts_none() -> None:
    async with EmulatedCamera() as taken:
        fleet = EmulatedFleet([Scenario(name="one"), Scenario(name="two", port=taken.port)])
        with pytest.raises(ConfigurationError, match="cannot listen"):
            await fleet.start()
        with pytest.raises(smartcam.ConnectFailedError):
            await smartcam.connect(fleet["one"].url, reconnect=None, connect_timeout=1)


# ---------------------------------------------------------------------- the schema

EXAMPLES = sorted((ROOT / "examples" / "scenarios").glob("*.yaml"))


def check(data: Any) -> list[str]:
    """Return the schema's complaints about a file."""
    jsonschema = pytest.importorskip("jsonschema", reason="needs jsonschema, of the extra dev")
    validator = jsonschema.Draft202012Validator(scenario_schema())
    return [error.json_path for error in validator.iter_errors(bare_on(data))]


def bare_on(data: Any) -> Any:
    """Return the same with "on" where YAML 1.1 has read it as true, as editors do not."""
    if isinstance(data, list):
        return [bare_on(one) for one in data]
    if isinstance(data, dict):
        return {"on" if key is True else key: bare_on(value) for key, value in data.items()}
    return data


@pytest.mark.long
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_loads_and_fits_the_schema(path: Path) -> None:
    EmulatedFleet(path)
    assert check(yaml.safe_load(path.read_text(encoding="utf-8"))) == []


@pytest.mark.long
def test_schema_finds_mistakes() -> None:
    assert check(yaml.safe_load(CELL)) == []
    assert check({"timeline": [{"at": -1, "do": {"kind": "stop"}}]}) == ["$.timeline[0].at"]
    assert check({"timeline": [{"at": 1, "do": {"kind": "split"}}]}) == ["$.timeline[0].do"]
    assert check({"cameras": [{"colour": "red"}]}) == ["$.cameras[0]"]


def test_schema_in_the_documents_is_that_of_the_code() -> None:
    text = (ROOT / "docs" / "scenario.schema.json").read_text(encoding="utf-8")
    assert plain(json.loads(text)) == plain(scenario_schema())
