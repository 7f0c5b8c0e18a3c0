"""The tree of errors: bases, attributes, pickling, texts."""

from __future__ import annotations

import copy
import inspect
import pickle
from typing import Any

import pytest

from smartcam import exceptions as e
from tests.strategies import over

ROOT = e.SmartCamError

TREE: dict[type[Exception], tuple[type[Exception], ...]] = {
    e.SmartCamError: (Exception,),
    e.ConfigurationError: (ROOT, ValueError),
    e.LayoutError: (e.ConfigurationError,),
    e.PluginError: (e.ConfigurationError,),
    e.MissingExtraError: (e.ConfigurationError,),
    e.LinkError: (ROOT, ConnectionError),
    e.ConnectFailedError: (e.LinkError,),
    e.ConnectionLostError: (e.LinkError,),
    e.ConnectionTakenError: (e.LinkError,),
    e.ConnectionClosedError: (e.LinkError,),
    e.ResponseTimeoutError: (ROOT, TimeoutError),
    e.CommandRejectedError: (ROOT,),
    e.UnsupportedError: (ROOT,),
    e.NotAllowedError: (ROOT, PermissionError),
    e.ReservationLostError: (ROOT,),
    e.CameraFaultError: (ROOT,),
    e.CalibrationError: (ROOT, ValueError),
    e.FrameSourceError: (ROOT, OSError),
    e.FrameFormatError: (e.FrameSourceError,),
    e.FrameFeatureError: (e.FrameSourceError,),
    e.FrameTimeoutError: (e.FrameSourceError, TimeoutError),
    e.InspectionError: (ROOT,),
    e.OutletError: (ROOT,),
    e.EntryRefusedError: (e.OutletError,),
    e.RecordingError: (ROOT, OSError),
    e.RosError: (ROOT,),
    e.RosMessageError: (e.RosError,),
    e.ServiceCallError: (e.RosError,),
    e.ServiceTimeoutError: (e.ServiceCallError, TimeoutError),
    e.SubscriberOverflowError: (ROOT,),
    e.TriggerError: (ROOT,),
    e.OvertriggeredError: (e.TriggerError,),
    e.NotRunningError: (e.TriggerError,),
    e.CameraBusyError: (e.TriggerError,),
    e.InputContainerError: (e.TriggerError,),
    e.FrameLostError: (e.TriggerError,),
    e.TriggerTimeoutError: (e.TriggerError, TimeoutError),
    e.ProtocolError: (ROOT,),
    e.LocalProtocolError: (e.ProtocolError,),
    e.RemoteProtocolError: (e.ProtocolError,),
    e.FrameError: (e.RemoteProtocolError,),
    e.MessageError: (e.RemoteProtocolError,),
    e.InterpretationError: (ROOT, ValueError),
    e.WrongApplicationError: (e.InterpretationError,),
}

LINK: dict[str, Any] = {"host": "192.168.0.10", "port": 36701}
FRAME: dict[str, Any] = {"offset": 4, "data": b"\x01\x02"}
SOURCE: dict[str, Any] = {"source": "/dev/video0", "available": ("Mono8 640x480",)}
FIELD: dict[str, Any] = {"field": "x", "offset": 8, "expected": "real32", "got": b"\0"}

ATTRIBUTES: dict[type[Exception], dict[str, Any]] = {
    e.LayoutError: {"text": "a: bool, ?", "position": 9},
    e.PluginError: {"name": "acme"},
    e.MissingExtraError: {"extra": "yaml"},
    e.LinkError: LINK,
    e.ConnectFailedError: {**LINK, "attempts": ("attempt 1: silence", "attempt 2: refused")},
    e.ConnectionLostError: LINK,
    e.ConnectionTakenError: LINK,
    e.ConnectionClosedError: LINK,
    e.ResponseTimeoutError: {"message_id": 0x30, "waited": 2.5},
    e.CommandRejectedError: {"message_id": 0x31, "code": 1, "active_application": 3},
    e.NotAllowedError: {"role": "viewer", "certificate": "dashboard"},
    e.TriggerTimeoutError: {"waited": 5.0},
    e.CalibrationError: {"code": "TOO_FEW", "expected": 3, "got": 2},
    e.FrameSourceError: SOURCE,
    e.InspectionError: {"application": 7, "tool": "read"},
    e.FrameFormatError: SOURCE,
    e.FrameFeatureError: SOURCE,
    e.FrameTimeoutError: SOURCE,
    e.EntryRefusedError: {"index": 3},
    e.RemoteProtocolError: FRAME,
    e.FrameError: FRAME,
    e.MessageError: FRAME,
    e.InterpretationError: FIELD,
    e.WrongApplicationError: {"field": "", "offset": 0, "expected": 7, "got": 3},
}

DEFAULTS: dict[str, Any] = {
    "text": "", "position": 0, "name": "", "extra": "", "host": "", "port": 0, "attempts": (),
    "message_id": None, "waited": 0.0, "code": 0, "active_application": None, "offset": 0,
    "data": b"", "field": "", "expected": None, "got": None, "source": "", "available": (),
    "role": "", "certificate": "", "application": None, "tool": "", "index": 0,
}  # fmt: skip

SPECIAL: dict[tuple[type[Exception], str], Any] = {
    (e.CommandRejectedError, "message_id"): 0,
    (e.CalibrationError, "code"): "",
}

each_error = over("kind", TREE, lambda one: one.__name__)


def public_errors() -> set[type]:
    names = [name for name in e.__all__ if inspect.isclass(getattr(e, name))]
    return {getattr(e, name) for name in names}


def test_tree_has_every_public_error() -> None:
    assert public_errors() == set(TREE)


@each_error
def test_error_has_its_bases(kind: type[Exception]) -> None:
    assert kind.__bases__ == TREE[kind]


@each_error
def test_error_stands_in_the_modules_tree(kind: type[Exception]) -> None:
    assert e.__doc__ is not None
    assert f" {kind.__name__}" in e.__doc__


@each_error
def test_error_with_a_text_only_has_default_attributes(kind: type[Exception]) -> None:
    error = kind("what happened")
    assert str(error) == "what happened"
    for name in ATTRIBUTES.get(kind, {}):
        assert getattr(error, name) == SPECIAL.get((kind, name), DEFAULTS[name])


def test_text_of_an_error_has_a_bound() -> None:
    error = e.ConfigurationError("begin " + "x" * 1_000_000 + " end")
    text = str(error)
    assert len(text) <= e.MAX_TEXT_CHARACTERS
    assert text.startswith("begin x")
    assert " ... " in text
    assert text.endswith("x end")
    assert str(pickle.loads(pickle.dumps(error))) == text  # noqa: S301 - ours
    short = "x" * e.MAX_TEXT_CHARACTERS
    assert str(e.SmartCamError(short)) == short


@each_error
@over("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_error_survives_pickle_with_its_attributes(kind: type[Exception], protocol: int) -> None:
    error = kind("what happened", **ATTRIBUTES.get(kind, {}))
    error.add_note("seen at night")
    for again in (pickle.loads(pickle.dumps(error, protocol)), copy.copy(error)):  # noqa: S301 - ours
        assert type(again) is kind
        assert (str(again), again.args) == ("what happened", ("what happened",))
        assert again.__dict__ == error.__dict__
        for name, value in ATTRIBUTES.get(kind, {}).items():
            assert getattr(again, name) == value


@each_error
def test_error_attributes_are_keywords_only(kind: type[Exception]) -> None:
    if kind in ATTRIBUTES:
        with pytest.raises(TypeError):
            kind("what happened", "surplus")


def test_remote_protocol_error_keeps_64_bytes_of_any_buffer() -> None:
    data = bytes(range(100))
    for given in (data, bytearray(data), memoryview(data)):
        assert e.FrameError("broken", data=given).data == data[:64]
    assert type(e.FrameError("broken", data=bytearray(b"ab")).data) is bytes


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_hex_excerpt_is_cut_after_64_bytes(kind: type[bytes | bytearray | memoryview]) -> None:
    assert e.hex_excerpt(kind(b"")) == ""
    assert e.hex_excerpt(kind(b"\x01\xff")) == "01 ff"
    assert e.hex_excerpt(kind(bytes(64))) == " ".join(["00"] * 64)
    assert e.hex_excerpt(kind(bytes(65))) == " ".join(["00"] * 64) + " ... (65 bytes)"


@pytest.mark.parametrize(
    ("kind", "builtin"),
    [
        (e.ConfigurationError, ValueError),
        (e.ConnectFailedError, OSError),
        (e.ResponseTimeoutError, TimeoutError),
        (e.TriggerTimeoutError, TimeoutError),
        (e.InterpretationError, ValueError),
    ],
)
def test_error_is_caught_where_users_expect_it(
    kind: type[Exception], builtin: type[Exception]
) -> None:
    with pytest.raises(builtin, match="what happened"):
        raise kind("what happened")
