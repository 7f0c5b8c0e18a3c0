"""The one function that says which word was meant, and the errors that ask it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import smartcam
from smartcam._settings_model import SettingsModel
from smartcam._suggestions import closest, did_you_mean
from smartcam.emulator.faults import FAULTS
from smartcam.exceptions import ConfigurationError
from smartcam.fleet import FleetFile, load_fleet
from smartcam.layout import Layout
from smartcam.protocols import BVS

OPTIONS = [*SettingsModel.model_fields]
FLEET_FIELDS = [*FleetFile.model_fields]
KINDS = [*FAULTS]

CASES: list[tuple[str, list[str], str | None]] = [
    # a part of the word that was meant
    ("timeout", OPTIONS, "connect_timeout"),
    ("interpret", OPTIONS, "interpret_as"),
    ("attempts", OPTIONS, "connect_attempts"),
    ("liveness", OPTIONS, "liveness_timeout"),
    ("timeout_s", OPTIONS, "connect_timeout"),
    ("result", ["late_result", "no_result"], "late_result"),
    ("hand", [*BVS.dialects], "handbook"),
    ("int", ["bool", "integer", "double"], "integer"),
    # the parts in another order, joined otherwise, or with a typo in one
    ("timeout_connect", OPTIONS, "connect_timeout"),
    ("connectTimeout", OPTIONS, "connect_timeout"),
    ("connect-timeout", OPTIONS, "connect_timeout"),
    ("interpretas", OPTIONS, "interpret_as"),
    ("conect_timout", OPTIONS, "connect_timeout"),
    ("swich_timeout", OPTIONS, "switch_timeout"),
    ("y_Down", OPTIONS, "y_down"),
    ("ExposurTime", ["ExposureTime", "ExposureAuto"], "ExposureTime"),
    # a typo
    ("no_resul", KINDS, "no_result"),
    ("truncat", KINDS, "truncate"),
    ("aplication", OPTIONS, "application"),
    ("bsv", ["bvs", "bvs+udp", "insight"], "bvs"),
    ("fbs", ["fps", "size", "format"], "fps"),
    ("nmae", ["name", "node"], "name"),
    ("cameraas", FLEET_FIELDS, "cameras"),
    ("operation", FLEET_FIELDS, "operations"),
    ("line1/cam", ["line1/cam3", "line2/cam3"], "line1/cam3"),
    ("line2/camera3", ["line1/cam3", "line2/cam3"], "line2/cam3"),
    # the whole word beats a part of a longer one
    ("names", ["frame_name", "name"], "name"),
    # nothing
    ("page", FLEET_FIELDS, None),
    ("colour", FLEET_FIELDS, None),
    ("x", OPTIONS, None),
    ("", OPTIONS, None),
    ("___", OPTIONS, None),
    ("timeout", [], None),
]


@pytest.mark.parametrize(("word", "known", "meant"), CASES)
def test_word_that_is_none_is_told_which_was_meant(
    word: str, known: list[str], meant: str | None
) -> None:
    assert closest(word, known) == meant
    assert did_you_mean(word, known) == (f"; did you mean {meant!r}?" if meant else "")


@pytest.mark.parametrize("known", [OPTIONS, FLEET_FIELDS, KINDS])
def test_known_word_means_itself_and_so_does_one_without_a_letter(known: list[str]) -> None:
    for word in known:
        assert closest(word, known) == word
        for place in range(len(word)) if len(word) > 4 else ():
            assert closest(word[:place] + word[place + 1 :], known) == word


def test_name_that_others_use_is_reported_by_a_table() -> None:
    assert did_you_mean("float", ["bool", "real32"], {"float": "real32"}).endswith("'real32'?")


def test_slip_of_a_plug_ins_name_must_be_sure() -> None:
    assert closest("row", ["raw"]) == "raw"
    assert closest("row", ["raw"], least=0.8) is None


def test_option_of_connect_is_reported() -> None:
    options: dict[str, Any] = {"timeout": 2}
    with pytest.raises(ConfigurationError, match=r"timeout: .*did you mean 'connect_timeout'"):
        smartcam.connect("bvs://127.0.0.1", **options)


def test_field_of_a_fleet_file_with_no_like_lists_what_there_is(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"
    path.write_text("page: 3\ncameras:\n  a/b: {emulated: {}}\n")
    with pytest.raises(ConfigurationError) as caught:
        load_fleet(path)
    assert "did you mean" not in str(caught.value)
    assert "known are access, agent, calibrations, cameras," in str(caught.value)


def test_kind_of_a_fault_in_a_scenario_is_reported(tmp_path: Path) -> None:
    from smartcam.emulator import load_scenario

    path = tmp_path / "scenario.yaml"
    path.write_text("timeline:\n- {at: 1, do: {kind: no_resul}}\n")
    with pytest.raises(ConfigurationError, match="did you mean 'no_result'"):
        load_scenario(path)


def test_choice_of_a_few_words_in_a_scenario_is_reported(tmp_path: Path) -> None:
    from smartcam.emulator import load_scenario

    path = tmp_path / "scenario.yaml"
    path.write_text("quirks:\n  bad_frame: skipp\n")
    with pytest.raises(ConfigurationError, match="did you mean 'skip'"):
        load_scenario(path)


def test_interpreters_name_is_reported() -> None:
    from smartcam.exceptions import PluginError
    from smartcam.interpreters import resolve

    with pytest.raises(PluginError, match="did you mean 'strings50'"):
        resolve("string50-x: y: int32")
    assert Layout("row: (x: int16)*").parse(b"\x01\x00").row[0].x == 1  # a group, not "raw"
