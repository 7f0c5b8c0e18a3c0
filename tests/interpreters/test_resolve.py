"""What ``interpret_as`` takes."""

from __future__ import annotations

from typing import Any

import pytest

from smartcam.exceptions import ConfigurationError, LayoutError, PluginError
from smartcam.interpreters import Interpreter, Reader, resolve, run
from smartcam.interpreters.localizations import Localizations
from smartcam.interpreters.raw import Raw
from smartcam.interpreters.record import Record
from smartcam.interpreters.strings50 import Strings50
from smartcam.interpreters.table import Table
from smartcam.layout import Layout
from smartcam.registry import INTERPRETERS

XY = "(x: real32 mm, y: real32 mm)*"


@pytest.mark.parametrize(
    ("spec", "kind", "layout"),
    [
        (None, Raw, None),
        ("raw", Raw, None),
        (" raw ", Raw, None),
        ("strings50", Strings50, None),
        ("50ByteStrings", Strings50, None),
        ("localizations", Localizations, Localizations.default_layout),
        ("Localizations", Localizations, Localizations.default_layout),
        (f"localizations: {XY}", Localizations, XY),
        (f"Localizations :{XY}", Localizations, XY),
        ("table: x: real32 mm, y: bool", Table, "x: real32 mm, y: bool"),
        ("table:\n  # named bool\n  bool: bool", Table, "bool: bool"),
        ("record: parts: (x: int8)*", Record, "parts: (x: int8)*"),
        ("x: int8", Record, "x: int8"),
        ("(x: int8)*", Record, "(x: int8)*"),
        ("parts: (x: int8)*", Record, "parts: (x: int8)*"),
        ("records: (x: int8)*", Record, "records: (x: int8)*"),
        ("# first: a comment\nx: int8", Record, "x: int8"),
        # an interpreter's name may be a field's as well
        ("table: int32", Record, "table: int32"),
        ("table: int32 mm, record: bool", Record, "table: int32 mm, record: bool"),
        ("raw: string[3], x: bool", Record, "raw: string[3], x: bool"),
        ("record: int32 @sequence", Record, "record: int32 @sequence"),
        (Layout("x: int8"), Record, "x: int8"),
        (Raw, Raw, None),
        (Localizations, Localizations, Localizations.default_layout),
    ],
)
@pytest.mark.parametrize("lenient", [False, True])
def test_spec_gives_interpreter_and_layout(
    spec: Any, kind: type[Interpreter], layout: str | None, lenient: bool
) -> None:
    interpreter = resolve(spec, lenient=lenient)
    assert type(interpreter) is kind
    expected = None if layout is None else Layout(layout, lenient=lenient)
    assert interpreter.layout == expected


def test_instance_stays_itself() -> None:
    interpreter = Raw()
    assert resolve(interpreter) is interpreter


def test_lenient_layout_stays_lenient() -> None:
    layout = Layout("x: bool", lenient=True)
    assert resolve(layout).layout is layout


@pytest.mark.parametrize(
    ("spec", "position"),
    [
        ("", 0),
        ("table: x: real3", 10),
        ("table:\n x: real32 nm", 18),
        ("localizations:", 14),
        ("x: real3", 3),
        ("x: int8, y: floaty", 12),
        ("x: int8: y", 7),
    ],
)
def test_position_counts_from_the_whole_text(spec: str, position: int) -> None:
    with pytest.raises((LayoutError, PluginError)) as caught:
        resolve(spec)
    if spec:
        assert isinstance(caught.value, LayoutError)
        assert caught.value.position == position
        assert caught.value.text == spec


@pytest.mark.parametrize(
    ("spec", "name"),
    [
        ("localization", "localization"),
        ("50ByteString", "50ByteString"),
        ("50ByteString: x: bool", "50ByteString"),
        ("my-weights: (x: bool)*", "my-weights"),
        ("tabel: x: real32 mm", "tabel"),
        ("localization: (x: real32, y: real32)*", "localization"),
        ("tables : (x: real32, y: real32)*", "tables"),
    ],
)
def test_mistyped_name_lists_the_known_ones(spec: str, name: str) -> None:
    with pytest.raises(PluginError) as caught:
        resolve(spec)
    assert caught.value.name == name
    assert "known are localizations, raw, record, strings50, table" in str(caught.value)


def test_mistyped_name_before_a_layout_says_what_else_is_wrong() -> None:
    with pytest.raises(PluginError, match="nor is it a layout text: layout: expected a type"):
        resolve("passed: count: int32")
    with pytest.raises(PluginError, match="did you mean 'localizations'"):
        resolve("localization: (x: real32, y: real32)*")


@pytest.mark.parametrize("name", ["raw", "strings50"])
def test_layout_for_one_that_takes_none_is_refused(name: str) -> None:
    with pytest.raises(ConfigurationError, match=f"{name}: expected no layout, got 'x: bool'"):
        resolve(f"{name}: x: bool")


@pytest.mark.parametrize("name", ["record", "table"])
def test_no_layout_for_one_that_needs_it_says_how(name: str) -> None:
    with pytest.raises(ConfigurationError, match=f'as in "{name}: x: real32 mm, y: real32 mm"'):
        resolve(name)


def test_neither_interpreter_nor_spec_is_refused() -> None:
    spec: Any
    for spec in (5, int):
        with pytest.raises(PluginError, match="expected a function of a Reader or a subclass"):
            resolve(spec)


# -- plug-ins -------------------------------------------------------------------------------------


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Make an object known to the registry as ``mine``."""

    def install(loaded: object) -> None:
        monkeypatch.setitem(INTERPRETERS._builtins, "mine", "nowhere:mine")
        monkeypatch.setitem(INTERPRETERS._loaded, "mine", loaded)

    return install


def first_byte(reader: Reader) -> object:
    return reader.get_uint8(0), reader.layout


def test_function_is_wrapped(plugin: Any) -> None:
    plugin(first_byte)
    assert run(resolve("mine"), Reader(b"\7")) == (7, None)
    assert run(resolve(first_byte), Reader(b"\7")) == (7, None)
    assert run(resolve("mine: x: bool"), Reader(b"\7")) == (7, Layout("x: bool"))
    assert repr(resolve("mine")) == "<interpreter first_byte>"


def test_instance_as_plugin_takes_no_layout(plugin: Any) -> None:
    interpreter = Raw()
    plugin(interpreter)
    assert resolve("mine") is interpreter
    with pytest.raises(ConfigurationError, match="mine: expected no layout"):
        resolve("mine: x: bool")


def test_class_that_cannot_be_made_is_a_plugin_error(plugin: Any) -> None:
    class Abstract(Interpreter):
        pass

    plugin(Abstract)
    with pytest.raises(PluginError, match="mine: cannot be made: TypeError"):
        resolve("mine")


def test_object_that_is_no_interpreter_is_a_plugin_error(plugin: Any) -> None:
    plugin({"a": 1})
    with pytest.raises(PluginError, match=r"got \{'a': 1\}") as caught:
        resolve("mine")
    assert caught.value.name == "mine"
