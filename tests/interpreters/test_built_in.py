"""``raw``, ``strings50``, ``record`` and ``table``."""

from __future__ import annotations

import json
from typing import Any

import pytest

from smartcam.exceptions import InterpretationError
from smartcam.interpreters import Context, Reader, resolve, run
from smartcam.models import jsonable


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
