"""Emulated cameras by their protocol's name, and generators that plug-ins bring."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import pytest

import smartcam.sync
from smartcam.emulator import Application, EmulatedCamera, EmulatedInSight, Scenario
from smartcam.emulator._inside import check_options, emulated_class, find_generator
from smartcam.emulator._line_codec import _LineForm
from smartcam.exceptions import ConfigurationError, PluginError, UnsupportedError
from smartcam.protocols import BVS
from smartcam.registry import GENERATORS, PROTOCOLS
from smartcam.testing import ThreadedCamera
from tests.emulator.inside import _LOADED

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

WEIGHTS = """
def weights(run):
    "Weights that grow."
    return {"grams": 100 + run.run_index}

NUMBER = 7
"""


@pytest.fixture
def provide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Return a function that puts a distribution with a generator on the path."""

    def add(name: str, target: str) -> None:
        info = tmp_path / f"{name}-1.0.dist-info"
        info.mkdir()
        about = f"Metadata-Version: 2.1\nName: maker-of-{name}\nVersion: 1.0\n"
        (info / "METADATA").write_text(about, encoding="utf-8")
        points = f"[smartcam.generators]\n{name} = {target}\n"
        (info / "entry_points.txt").write_text(points, encoding="utf-8")
        (tmp_path / "maker_of_weights.py").write_text(WEIGHTS, encoding="utf-8")

    monkeypatch.syspath_prepend(tmp_path)
    for registry_part in ("_points_found", "_loaded"):
        monkeypatch.setattr(
            GENERATORS, registry_part, None if registry_part == "_points_found" else {}
        )
    monkeypatch.setattr("smartcam.emulator._generators._LOADED", dict(_LOADED))
    return add


@pytest.mark.parametrize(("name", "kind"), [("bvs", EmulatedCamera), ("insight", EmulatedInSight)])
def test_protocol_names_its_emulated_camera(name: str, kind: type) -> None:
    assert emulated_class(name) is kind


@pytest.mark.parametrize(
    ("target", "error", "text"),
    [
        ("", UnsupportedError, "brings no emulated camera; those that do: bvs, insight"),
        ("no_such_module:Camera", PluginError, "failed to load"),
        ("smartcam.emulator:NoSuchCamera", PluginError, "failed to load"),
        ("smartcam.emulator:Scenario", PluginError, "no class of emulated cameras"),
    ],
)
def test_emulated_camera_that_is_none_is_refused(
    monkeypatch: pytest.MonkeyPatch, target: str, error: type[Exception], text: str
) -> None:
    monkeypatch.setitem(
        PROTOCOLS._loaded, "strange", dataclasses.replace(BVS, name="strange", emulator=target)
    )
    with pytest.raises(error, match=text):
        emulated_class("strange")


def test_option_that_a_make_has_not_is_refused_with_those_it_has() -> None:
    with pytest.raises(ConfigurationError, match=r"no option 'onlin'; .*did you mean 'online'"):
        check_options(EmulatedInSight, ["onlin"])


def test_scenario_of_another_make_says_what_it_cannot_do() -> None:
    mistake = EmulatedInSight.mistake(Scenario(protocol="insight", transport="udp"))
    assert mistake is not None
    assert mistake[0] == ("transport",)
    assert mistake[1].startswith("a camera of insight has no such field; it has active, ")


def test_threads_take_any_make() -> None:
    job = {"file": "7bolts.job", "cells": {"A1": 12.5}}
    with (
        ThreadedCamera(protocol="insight", online=True, active=7, jobs=[job]) as emulator,
        smartcam.sync.connect(emulator.url + "?cells=A1") as camera,
    ):
        assert camera.trigger().raw == b'{"A001": "12.500"}'


# ---------------------------------------------------------------------- generators


def test_generator_of_a_plugin_makes_an_applications_values(
    provide: Callable[[str, str], None],
) -> None:
    provide("weights", "maker_of_weights:weights")
    application = Application(id=5, layout="grams: int32", generator="weights")
    assert application.generator == "weights"
    info = next(one for one in GENERATORS.available() if one.name == "weights")
    assert info.origin == "maker-of-weights"
    with (
        ThreadedCamera(applications=[application], active=5, running=True) as emulator,
        smartcam.sync.connect(emulator.url, interpret_as="grams: int32") as camera,
    ):
        assert [camera.trigger().value.grams for _ in range(3)] == [100, 101, 102]


@pytest.mark.parametrize(
    ("target", "text"),
    [("no_such_module:weights", "no_such_module"), ("maker_of_weights:NUMBER", "7")],
)
def test_generator_that_is_broken_costs_only_its_own_name(
    provide: Callable[[str, str], None], target: str, text: str
) -> None:
    provide("weights", target)
    with pytest.raises(PluginError, match=text):
        find_generator("weights")
    assert callable(find_generator("tangram"))


def test_generator_that_is_unknown_names_the_known_ones() -> None:
    with pytest.raises(ConfigurationError, match="tangram"):
        find_generator("tangrm")


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
