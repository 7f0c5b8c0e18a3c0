"""Values that ``interpret_as`` takes, and the interpreters of every kind of data."""

from __future__ import annotations

import json
from typing import Any

import pytest

from smartcam.exceptions import ConfigurationError, InterpretationError, LayoutError, PluginError
from smartcam.interpreters import Context, Interpreter, Reader, resolve, run
from smartcam.interpreters._inside import LocalizationsInterpreter
from smartcam.layout import Layout
from smartcam.models import jsonable
from smartcam.registry import INTERPRETERS

RawInterpreter: Any = INTERPRETERS.load("raw")
RecordInterpreter: Any = INTERPRETERS.load("record")
Strings50Interpreter: Any = INTERPRETERS.load("strings50")
TableInterpreter: Any = INTERPRETERS.load("table")

XY = "(x: real32 mm, y: real32 mm)*"


@pytest.mark.parametrize(
    ("spec", "kind", "layout"),
    [
        (None, RawInterpreter, None),
        ("raw", RawInterpreter, None),
        (" raw ", RawInterpreter, None),
        ("strings50", Strings50Interpreter, None),
        ("50ByteStrings", Strings50Interpreter, None),
        ("localizations", LocalizationsInterpreter, LocalizationsInterpreter.default_layout),
        ("Localizations", LocalizationsInterpreter, LocalizationsInterpreter.default_layout),
        (f"localizations: {XY}", LocalizationsInterpreter, XY),
        (f"Localizations :{XY}", LocalizationsInterpreter, XY),
        ("table: x: real32 mm, y: bool", TableInterpreter, "x: real32 mm, y: bool"),
        ("table:\n  # named bool\n  bool: bool", TableInterpreter, "bool: bool"),
        ("record: parts: (x: int8)*", RecordInterpreter, "parts: (x: int8)*"),
        ("x: int8", RecordInterpreter, "x: int8"),
        ("(x: int8)*", RecordInterpreter, "(x: int8)*"),
        ("parts: (x: int8)*", RecordInterpreter, "parts: (x: int8)*"),
        ("records: (x: int8)*", RecordInterpreter, "records: (x: int8)*"),
        ("# first: a comment\nx: int8", RecordInterpreter, "x: int8"),
        # an interpreter's name may be a field's as well
        ("table: int32", RecordInterpreter, "table: int32"),
        ("table: int32 mm, record: bool", RecordInterpreter, "table: int32 mm, record: bool"),
        ("raw: string[3], x: bool", RecordInterpreter, "raw: string[3], x: bool"),
        ("record: int32 @sequence", RecordInterpreter, "record: int32 @sequence"),
        (Layout("x: int8"), RecordInterpreter, "x: int8"),
        (RawInterpreter, RawInterpreter, None),
        (
            LocalizationsInterpreter,
            LocalizationsInterpreter,
            LocalizationsInterpreter.default_layout,
        ),
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
    interpreter = RawInterpreter()
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
        with pytest.raises(PluginError, match="expected a function of a Reader, a subclass"):
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
    interpreter = RawInterpreter()
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


# ----------------------------------------------------------------------
# ``raw``, ``strings50``, ``record`` and ``table``.


def interpret(spec: str, data: bytes, **context: Any) -> Any:
    return run(resolve(spec), Reader(data, Context(**context)))


def test_raw_is_the_bytes_and_hex_in_json() -> None:
    value = interpret("raw", b"\x01\xff")
    assert value == b"\x01\xff"
    assert jsonable(value) == "01ff"


def test_strings50_keeps_empty_ones() -> None:
    data = b"".join(text.ljust(50, b"\0") for text in (b"one", b"", b"x" * 50))
    assert interpret("strings50", data) == ["one", "", "x" * 50]
    assert interpret("50ByteStrings", b"") == []


def test_strings50_refuses_a_remainder_and_no_text() -> None:
    with pytest.raises(InterpretationError, match="whole records of 50 bytes, got 49 bytes"):
        interpret("strings50", bytes(99))
    with pytest.raises(InterpretationError) as caught:
        interpret("strings50", bytes(50) + b"ab\xff" + bytes(47))
    assert caught.value.offset == 52


def test_strings50_reads_ascii_published_example() -> None:
    # Balluff's knowledge base has this text in 20 bytes; 50 is the thesis' width
    data = bytes.fromhex("48656c6c6f20576f726c64").ljust(50, b"\0")
    assert interpret("strings50", data) == ["Hello World"]


def test_record_gives_what_the_layout_says() -> None:
    value = interpret("n: int16, x: real32 mm", b"\0\5\x41\x20\0\0", byte_order="big")
    assert (value.n, value.x) == (5, 0.01)
    assert json.dumps(jsonable(value)) == '{"n": 5, "x": 0.01}'
    assert jsonable(interpret("(a: int8)*", b"\1\2")) == [{"a": 1}, {"a": 2}]


def test_record_lenient_takes_any_true() -> None:
    assert run(resolve("ok: bool", lenient=True), Reader(b"\1")) == (True,)
    with pytest.raises(InterpretationError, match="field 'ok'"):
        interpret("ok: bool", b"\1")


def test_published_container_of_one_string() -> None:
    # Balluff knowledge base, result container (docs/protocol.md), behind the application id
    data = bytes.fromhex("48656C6C6F20576F726C64000000000000000000")
    assert interpret("text: string[20]", data).text == "Hello World"


def test_table_is_an_array_in_si() -> None:
    table = interpret("table: (n: int16, x: int16 mm)*", b"\0\1\0\2\0\3\0\4", byte_order="big")
    assert table["x"].tolist() == [0.002, 0.004]
    assert jsonable(table) == [{"n": 1, "x": 0.002}, {"n": 3, "x": 0.004}]
