"""Finding plug-ins: with real entry points, from dist-info folders on ``sys.path``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import pytest

from smartcam.exceptions import PluginError
from smartcam.interpreters import Reader, resolve, run
from smartcam.registry import INTERPRETERS, PROTOCOLS, PluginInfo, Registry

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
    assert PluginInfo("raw", "smartcam.interpreters._basic:RawInterpreter", "built-in") in infos


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
    assert INTERPRETERS.load("raw") is type(resolve("raw"))


def test_name_of_two_distributions_names_both(install: Install) -> None:
    install("first", mine="first_module:f")
    install("second", mine="second_module:f")
    with pytest.raises(
        PluginError, match=r"'mine' is provided by (first and second|second and first)"
    ):
        INTERPRETERS.load("mine")
    (info,) = [info for info in INTERPRETERS.available() if info.name == "mine"]
    assert sorted(info.origin.split(", ")) == ["first", "second"]


def test_built_in_is_never_replaced_and_the_log_names_who_tried(
    install: Install, caplog: pytest.LogCaptureFixture
) -> None:
    install("first", raw="first_module:f")
    assert INTERPRETERS.load("raw") is type(resolve("raw"))
    assert [i.origin for i in INTERPRETERS.available() if i.name == "raw"] == ["built-in"]
    assert "the name 'raw' is smartcam's own, that of first is left out" in caplog.text


def test_built_in_is_loaded_without_a_look_at_what_is_installed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def looked() -> Iterator[None]:
        raise AssertionError("looked")

    registry = Registry("smartcam.nothing", {"raw": "smartcam.interpreters._basic:RawInterpreter"})
    monkeypatch.setattr("importlib.metadata.distributions", looked)
    assert registry.load("raw") is type(resolve("raw"))
    assert "raw" in registry


def test_refresh_looks_again(install: Install) -> None:
    assert "mine" not in INTERPRETERS
    install("first", mine="first_module:f")
    assert "mine" in INTERPRETERS


def test_registry_without_aliases() -> None:
    registry = Registry("smartcam.nothing", {"raw": "smartcam.interpreters._basic:RawInterpreter"})
    assert registry.load("raw") is type(resolve("raw"))
    assert [info.name for info in registry.available()] == ["raw"]


@pytest.mark.parametrize("code", ["import sys\nsys.exit(3)", "raise SystemExit", "1 +", "raise 7"])
def test_plugin_that_ends_programs_is_a_plugin_error(install: Install, code: str) -> None:
    install("first", code, mine="first_module:f")
    with pytest.raises(PluginError, match="'mine' of first failed to load") as caught:
        resolve("mine")
    assert caught.value.__cause__ is not None
    assert INTERPRETERS.load("raw") is type(resolve("raw"))


def test_plugin_that_ends_programs_when_it_is_made_is_a_plugin_error(install: Install) -> None:
    code = (
        "import sys\nfrom smartcam.interpreters import Interpreter\n"
        "class F(Interpreter):\n    def __init__(self, layout=None):\n        sys.exit(3)\n"
        "    def interpret(self, reader):\n        return 1\n"
    )
    install("first", code, mine="first_module:F")
    with pytest.raises(PluginError, match="interpreter mine: cannot be made") as caught:
        resolve("mine")
    assert isinstance(caught.value.__cause__, SystemExit)


def test_plugin_interrupted_by_the_user_is_not_kept_back(install: Install) -> None:
    install("first", "raise KeyboardInterrupt", mine="first_module:f")
    with pytest.raises(KeyboardInterrupt):
        INTERPRETERS.load("mine")


@pytest.mark.parametrize(
    "target", ["no such thing", "first_module", "first_module:g.h", ":", "1:2"]
)
def test_plugin_of_nonsense_is_a_plugin_error(install: Install, target: str) -> None:
    install("first", "f = 5\n", mine=target)
    assert "mine" in INTERPRETERS
    with pytest.raises(PluginError):
        resolve("mine")


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("METADATA", b"\xff\xfe\x00"),
        ("METADATA", None),
        ("entry_points.txt", b"\xff\xfe\x00"),
        ("entry_points.txt", b"no section = here\n"),
        ("entry_points.txt", b"[smartcam.interpreters]\nnonsense\n"),
        ("entry_points.txt", b"[smartcam.interpreters\nx=y:z"),
    ],
)
def test_broken_metadata_of_another_distribution_costs_only_its_own(
    install: Install, tmp_path: Path, file: str, content: bytes | None
) -> None:
    install("second", "", other="second_module:f")
    install("first", "def f(reader):\n    return 7\n", mine="first_module:f")
    broken = tmp_path / "second-0.1.dist-info" / file
    if content is None:
        broken.unlink()
    else:
        broken.write_bytes(content)
    INTERPRETERS.refresh()
    assert {*BUILT_IN, "mine"} <= {info.name for info in INTERPRETERS.available()}
    assert run(resolve("mine"), Reader(b"")) == 7


class _RaisingFinder:
    """Finds one distribution that cannot be asked, and then fails itself."""

    def find_distributions(self, _context: object = None) -> Iterator[object]:
        yield _Raising()
        raise OSError("the disk")

    def find_spec(self, *_: object) -> None:
        return None


class _Raising:
    @property
    def _path(self) -> str:
        return "elsewhere/hurt-1.0.dist-info"

    @property
    def entry_points(self) -> object:
        raise PermissionError("not yours")

    @property
    def metadata(self) -> object:
        raise PermissionError("not yours")


def test_metadata_that_raise_are_named_in_the_log(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, _RaisingFinder()])
    INTERPRETERS.refresh()
    try:
        assert {*BUILT_IN} <= {info.name for info in INTERPRETERS.available()}
    finally:
        INTERPRETERS.refresh()
    assert "hurt-1.0.dist-info cannot be read, they are left out: PermissionError" in caplog.text
    assert "cannot be listed to their end: OSError('the disk')" in caplog.text


def test_second_version_of_a_distribution_is_left_alone(
    install: Install, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install("first", "def f(reader):\n    return 7\n", mine="first_module:f")
    old = tmp_path / "old"
    old.mkdir()
    (tmp_path / "first-0.1.dist-info").rename(old / "first-0.0.dist-info")
    monkeypatch.syspath_prepend(str(tmp_path))
    install("first", "def f(reader):\n    return 7\n", mine="first_module:f")
    monkeypatch.setattr(sys, "path", [*sys.path, str(old)])
    INTERPRETERS.refresh()
    (info,) = [info for info in INTERPRETERS.available() if info.name == "mine"]
    assert info.origin == "first"
