"""Reading values from a container, and running interpreters."""

from __future__ import annotations

import struct
from contextlib import nullcontext
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError, InterpretationError, WrongApplicationError
from smartcam.interpreters import Context, Interpreter, PlainInterpreter, Reader, resolve, run
from smartcam.interpreters._inside import as_plain_interpreter, run_plain
from smartcam.layout import Layout
from smartcam.models import ByteOrder
from smartcam.registry import INTERPRETERS

TableInterpreter: Any = INTERPRETERS.load("table")

NUMBERS = {
    "int8": ("b", -5),
    "int16": ("h", -500),
    "int32": ("i", -50_000),
    "int64": ("q", -5_000_000_000),
    "uint8": ("B", 250),
    "uint16": ("H", 50_000),
    "uint32": ("I", 4_000_000_000),
    "uint64": ("Q", 2**63 + 5),
    "real32": ("f", 0.5),
    "real64": ("d", 0.1),
}
GETTERS = [*NUMBERS, "bool"]


@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize(("order", "sign"), [("little", "<"), ("big", ">")])
def test_numbers_are_read_in_the_contexts_byte_order(
    name: str, order: ByteOrder, sign: str
) -> None:
    code, value = NUMBERS[name]
    reader = Reader(b"\x99" + struct.pack(sign + code, value), Context(byte_order=order))
    assert getattr(reader, f"get_{name}")(1) == value


def test_bool_is_zero_or_all_ones() -> None:
    reader = Reader(b"\x00\xff\x01")
    assert (reader.get_bool(0), reader.get_bool(1)) == (False, True)
    with pytest.raises(InterpretationError, match=r"offset 2: expected 0x00 or 0xFF .*, got 0x01"):
        reader.get_bool(2)
    assert Reader(b"\x01", Context(lenient=True)).get_bool(0) is True


def test_string_ends_at_the_first_zero() -> None:
    assert Reader(b"xab\0\xff").get_string(1, 4) == "ab"
    assert Reader("äö".encode()).get_string(0, 4) == "äö"
    with pytest.raises(InterpretationError) as caught:
        Reader(b"xab\xffc").get_string(1, 4)
    assert caught.value.offset == 3
    assert "expected UTF-8 text, got 0xFF" in str(caught.value)


def test_bytes_are_read_as_they_are() -> None:
    reader = Reader(memoryview(b"abc\0"))
    assert reader.get_bytes(1, 3) == b"bc\0"
    assert reader.get_bytes(4, 0) == b""
    assert len(reader) == 4


@pytest.mark.parametrize(
    ("first_byte", "length", "got"), [(2, 3, 2), (4, 1, 0), (9, 1, 0), (-1, 2, 4), (0, -1, 4)]
)
def test_read_outside_names_offset_and_sizes(first_byte: int, length: int, got: int) -> None:
    with pytest.raises(InterpretationError) as caught:
        Reader(b"abcd").get_bytes(first_byte, length)
    error = caught.value
    assert (error.offset, error.expected, error.got) == (first_byte, length, got)
    assert f"offset {first_byte}: expected bytes of {length} bytes, got {got}" in str(error)


@pytest.mark.parametrize("name", GETTERS)
def test_every_getter_checks_its_place(name: str) -> None:
    for first_byte in (-1, 0, 1):
        with pytest.raises(InterpretationError) as caught:
            getattr(Reader(b""), f"get_{name}")(first_byte)
        assert caught.value.offset == first_byte


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=20), st.integers(-30, 30), st.sampled_from(GETTERS))
def test_any_read_gives_a_value_or_an_interpretation_error(
    data: bytes, first_byte: int, name: str
) -> None:
    reader = Reader(data)
    try:
        getattr(reader, f"get_{name}")(first_byte)
        reader.get_string(first_byte, first_byte)
    except InterpretationError:
        pass


def test_records_gives_offsets() -> None:
    assert list(Reader(b"123456").records(2)) == [0, 2, 4]
    assert list(Reader(b"").records(2)) == []


def test_records_refuses_a_remainder() -> None:
    with pytest.raises(InterpretationError) as caught:
        Reader(b"12345").records(2)
    error = caught.value
    assert (error.offset, error.expected, error.got) == (4, 2, 1)
    assert "expected whole records of 2 bytes, got 1 bytes (the container has 5)" in str(error)


def test_records_of_nothing_is_a_mistake_of_the_interpreter() -> None:
    with pytest.raises(ValueError, match="at least 1 byte, got 0"):
        Reader(b"12").records(0)


def test_context_has_defaults() -> None:
    context = Reader(b"").context
    assert context == Context()
    assert context.received_at == datetime(1970, 1, 1, tzinfo=UTC)


# -- run ------------------------------------------------------------------------------------------


class Fails(Interpreter):
    def __init__(self, error: Exception) -> None:
        super().__init__()
        self.error = error

    def interpret(self, reader: Reader) -> object:
        raise self.error


@pytest.mark.parametrize(
    "error", [struct.error("short"), ValueError("no"), KeyError("x"), ConfigurationError("odd")]
)
def test_run_turns_any_error_into_an_interpretation_error(error: Exception) -> None:
    with pytest.raises(InterpretationError) as caught:
        run(Fails(error), Reader(b"12"))
    assert caught.value.__cause__ is error
    assert f"the interpreter failed with {type(error).__name__}" in str(caught.value)
    assert "the container has 2 bytes" in str(caught.value)


@pytest.mark.parametrize("error", [InterpretationError("no"), WrongApplicationError("other")])
def test_run_leaves_interpretation_errors_as_they_are(error: Exception) -> None:
    with pytest.raises(InterpretationError) as caught:
        run(Fails(error), Reader(b""))
    assert caught.value is error


class Reversed(PlainInterpreter):
    def read(self, data: bytes, context: Context) -> object:
        return int.from_bytes(data, context.byte_order) // len(data)


def test_plain_interpreter_needs_neither_reader_nor_context() -> None:
    interpreter = Reversed()
    assert run(interpreter, Reader(b"\1\2", Context(byte_order="big"))) == 0x81
    assert as_plain_interpreter(interpreter) is interpreter
    assert run_plain(interpreter, b"\1\2", Context(byte_order="big")) == 0x81
    assert interpreter.read_all([b"\1\2", b"\4"], Context(byte_order="big")) == [0x81, 4]


def test_run_plain_turns_any_error_into_an_interpretation_error() -> None:
    with pytest.raises(InterpretationError, match="failed with ZeroDivisionError") as caught:
        run_plain(Reversed(), b"", Context())
    assert "the container has 0 bytes" in str(caught.value)
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


@pytest.mark.parametrize(
    "spec",
    ["raw", "strings50", "a: int16", "table: (a: int16)*", "localizations: (x: int8, y: int8)*"],
)
def test_built_in_interpreters_of_bytes_alone_are_plain(spec: str) -> None:
    interpreter, data = resolve(spec), bytes(50) if spec == "strings50" else b"\1\2"
    simple = as_plain_interpreter(interpreter)
    assert simple is not None
    value: Any = run(interpreter, Reader(data, Context(byte_order="big")))
    big = Context(byte_order="big")
    assert run_plain(simple, data, big) == value
    assert simple.read_all([data], big) == [value]
    with pytest.raises(InterpretationError) if spec != "raw" else nullcontext():
        run_plain(simple, data[:1], big)


def test_table_that_is_read_otherwise_is_read_so_in_bursts() -> None:
    class Count(TableInterpreter):  # type: ignore[misc]
        def read(self, data: bytes, context: Context) -> Any:
            return len(super().read(data, context))

    class Fixed:
        def read(self, data: bytes, context: Context) -> int:
            return 7

    class Mixed(Fixed, TableInterpreter): ...  # type: ignore[misc]

    layout = Layout("(a: int16)*")
    assert Mixed(layout).read_all([bytes(4), bytes(6)], Context()) == [7, 7]
    assert Count(layout).read_all([bytes(4), bytes(6)], Context()) == [2, 3]
    tables = TableInterpreter(layout).read_all([bytes(4), b"", b"\1\0"], Context())
    assert [table.tolist() for table in tables] == [[(0,), (0,)], [], [(1,)]]
    with pytest.raises(InterpretationError):
        TableInterpreter(layout).read_all([bytes(4), bytes(3)], Context())


def test_interpreters_of_a_reader_have_no_plain_way() -> None:
    class Own(Reversed):
        def interpret(self, reader: Reader) -> object:
            return reader.context.camera

    for interpreter in (Own(), resolve(len)):
        assert as_plain_interpreter(interpreter) is None


def test_run_gives_the_reader_the_interpreters_layout() -> None:
    class Sees(Interpreter):
        default_layout = "a: int8"

        def interpret(self, reader: Reader) -> Any:
            return reader.layout

    assert run(Sees(), Reader(b"1")) == Layout("a: int8")
    assert run(Sees(), Reader(b"1", layout=Layout("b: int8"))) == Layout("b: int8")


def test_sequence_is_the_layouts() -> None:
    interpreter = Fails(ValueError())
    assert interpreter.sequence(Reader(b"1")) is None
    interpreter.layout = Layout("a: int8")
    assert interpreter.sequence(Reader(b"")) is None
    interpreter.layout = Layout("s: uint16 @sequence")
    assert interpreter.sequence(Reader(b"\0\1", Context(byte_order="big"))) == 1
    with pytest.raises(InterpretationError):
        interpreter.sequence(Reader(b"\0"))
