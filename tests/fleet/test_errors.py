"""Errors keep their class, text and attributes on the bus."""

from __future__ import annotations

import inspect
import json
from typing import Any

import pytest

import smartcam.exceptions
from smartcam.exceptions import (
    ConfigurationError,
    ConnectFailedError,
    RemoteProtocolError,
    SmartCamError,
)
from smartcam.fleet._bus.errors import MAX_CHAIN, from_fields, to_fields

KINDS = [
    getattr(smartcam.exceptions, name)
    for name in smartcam.exceptions.__all__
    if inspect.isclass(getattr(smartcam.exceptions, name))
]

VALUES: dict[str, Any] = {
    "str": "some text",
    "int": 7,
    "float": 1.5,
    "tuple[str, ...]": ("tried this", "tried that"),
    "int | None": 8,
    "object": [1, {"two": 3.0}, None],
    "bytes | bytearray | memoryview": b"\x00\xff\x80data",
    "str | None": "text",
}
"""Values of the attributes, by their types as they are written."""


def example_of(kind: type[SmartCamError]) -> SmartCamError:
    """Return an error with a value of its own for each attribute."""
    wanted = inspect.signature(kind.__init__).parameters
    named = {
        name: VALUES[str(one.annotation)]
        for name, one in wanted.items()
        if one.kind is inspect.Parameter.KEYWORD_ONLY
    }
    return kind(f"{kind.__name__}: what was tried, what came", **named)


def crossed(error: BaseException) -> SmartCamError:
    """Return an error as it comes out at the other end."""
    return from_fields(json.loads(json.dumps(to_fields(error), allow_nan=False)))


@pytest.mark.parametrize("kind", KINDS)
def test_error_crosses_with_kind_text_attributes_and_cause(kind: type[SmartCamError]) -> None:
    error = example_of(kind)
    error.__cause__ = ConnectFailedError("the cause", host="h", port=7, attempts=("a", "b"))
    got = crossed(error)
    assert type(got) is kind
    assert str(got) == str(error)
    assert vars(got) == vars(error)
    assert {name: type(value) for name, value in vars(got).items()} == {
        name: type(value) for name, value in vars(error).items()
    }
    cause = got.__cause__
    assert isinstance(cause, ConnectFailedError)
    assert (str(cause), vars(cause)) == (str(error.__cause__), vars(error.__cause__))


@pytest.mark.parametrize("kind", KINDS)
def test_error_with_nothing_said_crosses_too(kind: type[SmartCamError]) -> None:
    error = kind("text")
    got = crossed(error)
    assert (type(got), str(got), vars(got)) == (kind, "text", vars(error))
    assert got.__cause__ is None


class SpecialError(ConfigurationError):
    """A plug-in's own."""


@pytest.mark.parametrize(
    ("error", "kind", "text"),
    [
        (SpecialError("mine"), ConfigurationError, "mine"),
        (KeyError("x"), SmartCamError, "KeyError: 'x'"),
        (ConnectionResetError(104, "gone"), SmartCamError, "gone"),
        (TimeoutError(), SmartCamError, "TimeoutError: "),
    ],
)
def test_other_error_crosses_as_the_nearest_that_is_known(
    error: Exception, kind: type[SmartCamError], text: str
) -> None:
    got = crossed(error)
    assert type(got) is kind
    assert text in str(got)


def test_chain_is_bounded() -> None:
    error = SmartCamError("0")
    first = error
    for number in range(1, 50):
        error.__cause__ = SmartCamError(str(number))
        error = error.__cause__
    error.__cause__ = first  # and even one that bites its tail has an end
    got: BaseException | None = crossed(first)
    depth = 0
    while got is not None:
        got, depth = got.__cause__, depth + 1
    assert depth == MAX_CHAIN + 1


@pytest.mark.parametrize("fields", [None, 7, "text", [], {}, {"kind": []}, {"kind": "os.system"}])
def test_what_is_no_error_is_one_all_the_same(fields: Any) -> None:
    assert isinstance(from_fields(fields), SmartCamError)


def test_attributes_that_are_not_the_kinds_own_are_left_out() -> None:
    said = {"kind": "RemoteProtocolError", "text": "t", "attributes": {"args": [1], "new": 1}}
    got = from_fields(said)
    assert isinstance(got, RemoteProtocolError)
    assert (got.args, vars(got)) == (("t",), vars(RemoteProtocolError("t")))
