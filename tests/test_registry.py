"""Finding plug-ins: with real entry points, from dist-info folders on ``sys.path``."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Protocol

import pytest

from smartcam.exceptions import PluginError
from smartcam.interpreters import Reader, resolve, run
from smartcam.interpreters.raw import Raw
from smartcam.registry import INTERPRETERS, PROTOCOLS, PluginInfo, Registry

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

GROUP = "smartcam.interpreters"
BUILT_IN = ["localizations", "raw", "record", "strings50", "table"]


class Install(Protocol):
    def __call__(self, distribution: str, code: str = "", **names: str) -> None: ...


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Return what installs a distribution: one module, some entry points."""
    monkeypatch.syspath_prepend(str(tmp_path))
    modules = set(sys.modules)

    def install(distribution: str, code: str = "", **names: str) -> None:
        (tmp_path / f"{distribution}_module.py").write_text(code)
        info = tmp_path / f"{distribution}-0.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 0.1\n"
        )
        points = "".join(f"{name} = {target}\n" for name, target in names.items())
        (info / "entry_points.txt").write_text(f"[{GROUP}]\n{points}")
        INTERPRETERS.refresh()

    yield install
    INTERPRETERS.refresh()
    for name in set(sys.modules) - modules:
        del sys.modules[name]


def test_built_ins_are_listed_sorted() -> None:
    infos = INTERPRETERS.available()
    assert [info.name for info in infos if info.origin == "built-in"] == BUILT_IN
    assert PluginInfo("raw", "smartcam.interpreters.raw:Raw", "built-in") in infos


@pytest.mark.parametrize("name", [*BUILT_IN, "Localizations", "50ByteStrings"])
def test_built_ins_load_once(name: str) -> None:
    assert name in INTERPRETERS
    assert INTERPRETERS.load(name) is INTERPRETERS.load(name)


def test_names_are_known_or_not() -> None:
    assert "raw" in INTERPRETERS
    assert "rwa" not in INTERPRETERS
    assert 5 not in INTERPRETERS
    assert "bvs" in PROTOCOLS


def test_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(
        PluginError, match="'rwa' is unknown; known are localizations, raw"
    ) as caught:
        INTERPRETERS.load("rwa")
    assert caught.value.name == "rwa"


def test_plugin_is_listed_without_being_imported(install: Install) -> None:
    install("first", "raise RuntimeError('imported')", mine="first_module:f")
    assert PluginInfo("mine", "first_module:f", "first") in INTERPRETERS.available()
    assert "mine" in INTERPRETERS
    assert "first_module" not in sys.modules


def test_plugin_runs_by_its_name(install: Install) -> None:
    install("first", "def f(reader):\n    return reader.get_uint8(0)\n", mine="first_module:f")
    assert run(resolve("mine"), Reader(b"\7")) == 7


def test_broken_plugin_costs_only_its_own_name(install: Install) -> None:
    install("first", "raise RuntimeError('broken')", mine="first_module:f")
    with pytest.raises(PluginError, match="'mine' of first failed to load") as caught:
        INTERPRETERS.load("mine")
    assert isinstance(caught.value.__cause__, RuntimeError)
    assert INTERPRETERS.load("raw") is Raw


def test_name_of_two_distributions_names_both(install: Install) -> None:
    install("first", mine="first_module:f")
    install("second", mine="second_module:f")
    with pytest.raises(
        PluginError, match=r"'mine' is provided by (first and second|second and first)"
    ):
        INTERPRETERS.load("mine")
    (info,) = [info for info in INTERPRETERS.available() if info.name == "mine"]
    assert sorted(info.origin.split(", ")) == ["first", "second"]


def test_built_in_is_never_replaced_silently(install: Install) -> None:
    install("first", raw="first_module:f")
    with pytest.raises(PluginError, match="'raw' is smartcam's own, but first also provides it"):
        INTERPRETERS.load("raw")
    assert [i.origin for i in INTERPRETERS.available() if i.name == "raw"] == ["built-in"]


def test_refresh_looks_again(install: Install) -> None:
    assert "mine" not in INTERPRETERS
    install("first", mine="first_module:f")
    assert "mine" in INTERPRETERS


def test_registry_without_aliases() -> None:
    registry = Registry("smartcam.nothing", {"raw": "smartcam.interpreters.raw:Raw"})
    assert registry.load("raw") is Raw
    assert [info.name for info in registry.available()] == ["raw"]
