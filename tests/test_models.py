"""Public values and their JSON."""

from __future__ import annotations

import dataclasses
import enum
import json
import math
import pickle
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from smartcam import models
from smartcam.layout import Layout
from smartcam.models import (
    ApplicationChanged,
    CameraEvent,
    Capabilities,
    Connected,
    Disconnected,
    Header,
    Histogram,
    Localization,
    NoticeReceived,
    Pose,
    PoseSigma,
    Position,
    Quaternion,
    Reconnected,
    Result,
    Statistics,
    Status,
    StatusChanged,
    SubscriberStatistics,
    jsonable,
)

AT = datetime(2026, 2, 3, 4, 5, 6, 789000, tzinfo=UTC)
AT_TEXT = "2026-02-03T04:05:06.789000+00:00"
POSE = Pose(Header(4, AT, "cell 1"), Position(0.1, 0.2), Quaternion.from_theta(0.0))
POSE_JSON = {
    "header": {"seq": 4, "stamp": AT_TEXT, "frame_id": "cell 1"},
    "position": {"x": 0.1, "y": 0.2, "z": 0.0},
    "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
}
ACCOUNT = SubscriberStatistics(
    name="results", policy="drop_oldest", offered=3, taken=1, dropped=1, queued=1, queued_bytes=40
)


# ---------------------------------------------------------------------- status


@pytest.mark.parametrize(
    ("value", "names", "text"),
    [
        (0x000, [], "no bit set"),
        (0x280, ["RUNNING", "WAITING_FOR_TRIGGER"], "RUNNING + WAITING_FOR_TRIGGER"),
        (0x180, ["RUNNING", "OVERTRIGGERED"], "RUNNING + OVERTRIGGERED"),
        (0x048, ["0x8", "0x40"], "0x8 + 0x40"),
        (0x8000_0001, ["OVERHEAT", "0x80000000"], "OVERHEAT + 0x80000000"),
        (0x8_0000_0080, ["RUNNING", "SIMULATION_MODE"], "RUNNING + SIMULATION_MODE"),
        (0x1000_0000_0080, ["RUNNING", "0x100000000000"], "RUNNING + 0x100000000000"),
    ],
)
def test_status_names_are_lowest_first_and_unknown_bits_hex(
    value: int, names: list[str], text: str
) -> None:
    status = Status(value)
    assert int(status) == value
    assert status.names == names
    assert str(status) == text


def test_status_bits_are_the_manuals() -> None:
    assert {bit.name: bit.value for bit in Status} == {
        "OVERHEAT": 0x001,
        "SYSTEM_ERROR": 0x002,
        "INPUT_CONTAINER": 0x004,
        "BUSY": 0x010,
        "RUNNING": 0x080,
        "OVERTRIGGERED": 0x100,
        "WAITING_FOR_TRIGGER": 0x200,
        "SIMULATION_MODE": 0x8_0000_0000,
    }


@given(value=st.integers(0, 0xFFFF_FFFF_FFFF))
def test_status_any_word_is_kept_and_named(value: int) -> None:
    names = Status(value).names
    assert len(names) == value.bit_count()
    bits = [Status[one] if one in Status.__members__ else int(one, 16) for one in names]
    assert sum(bits) == value


# ---------------------------------------------------------------------- capabilities


def test_capabilities_without_more_are_none() -> None:
    nothing = Capabilities(dialect="small")
    assert nothing.names == []
    values = {getattr(nothing, f.name) for f in dataclasses.fields(nothing) if f.name != "dialect"}
    assert values == {False}


def test_capabilities_names_are_in_the_documented_order() -> None:
    some = Capabilities(dialect="switch", unasked_results=True, start_stop=True, switch=True)
    assert some.names == ["switch", "start_stop", "unasked_results"]
    everything = [f.name for f in dataclasses.fields(Capabilities) if f.name != "dialect"]
    assert Capabilities(dialect="all", **dict.fromkeys(everything, True)).names == everything


def test_jsonable_capabilities_have_every_ability() -> None:
    seen = jsonable(Capabilities(dialect="bid", get_status=True))
    assert (seen["dialect"], seen["get_status"], seen["reboot"]) == ("bid", True, False)
    assert [*seen] == [f.name for f in dataclasses.fields(Capabilities)]


# ---------------------------------------------------------------------- poses


@pytest.mark.parametrize("theta", [0.0, 1.0, -1.0, math.pi / 2, -3.0, math.pi])
def test_quaternion_from_theta_turns_about_z(theta: float) -> None:
    turned = Quaternion.from_theta(theta)
    assert turned[:2] == (0.0, 0.0)
    assert turned.theta == pytest.approx(theta)
    assert math.hypot(*turned) == pytest.approx(1.0)


def test_quaternion_without_arguments_is_no_turn() -> None:
    assert Quaternion() == (0.0, 0.0, 0.0, 1.0)
    assert Quaternion().theta == 0.0


def test_quaternion_quarter_turn_has_the_sign_of_counter_clockwise() -> None:
    half = math.sqrt(0.5)
    assert Quaternion.from_theta(math.pi / 2) == pytest.approx((0.0, 0.0, half, half))


@given(theta=st.floats(-1e3, 1e3))
def test_quaternion_theta_is_the_angle_in_one_turn(theta: float) -> None:
    seen = Quaternion.from_theta(theta).theta
    assert -math.pi <= seen <= math.pi
    assert math.cos(seen) == pytest.approx(math.cos(theta), abs=1e-9)
    assert math.sin(seen) == pytest.approx(math.sin(theta), abs=1e-9)


def test_position_without_z_lies_in_the_plane() -> None:
    assert Position(1.0, 2.0) == (1.0, 2.0, 0.0)


# ---------------------------------------------------------------------- immutability


@pytest.mark.parametrize(
    "value",
    [
        Connected(camera="c", at=AT, url="bvs://c:1"),
        Disconnected(camera="c", at=AT, reason="gone", expected=False),
        ACCOUNT,
        Capabilities(dialect="b16"),
        Statistics(),
    ],
    ids=lambda one: type(one).__name__,
)
def test_dataclass_values_are_frozen_with_slots(value: Any) -> None:
    assert not hasattr(value, "__dict__")
    name = dataclasses.fields(value)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(value, name, "other")


def test_statistics_start_at_zero_with_a_list_of_their_own() -> None:
    one, other = Statistics(), Statistics()
    assert one == other
    assert one.subscribers is not other.subscribers
    counters = [getattr(one, f.name) for f in dataclasses.fields(one) if f.name != "subscribers"]
    histograms = [value for value in counters if isinstance(value, Histogram)]
    assert [(h.count, h.shortest, h.longest) for h in histograms] == [(0, None, None)] * 2
    assert {value for value in counters if not isinstance(value, Histogram)} == {0, None}


@pytest.mark.parametrize(
    "kind",
    [Connected, Reconnected, Disconnected, StatusChanged, ApplicationChanged, NoticeReceived],
)
def test_camera_events_have_one_base(kind: type[CameraEvent]) -> None:
    assert issubclass(kind, CameraEvent)
    assert [f.name for f in dataclasses.fields(kind)][:2] == ["camera", "at"]


# ---------------------------------------------------------------------- jsonable


class Colour(enum.Enum):
    RED = "red"


class Number(enum.IntEnum):
    ONE = 1


class Settings(BaseModel):
    at: datetime
    raw: bytes


class Mapping:
    def items(self) -> list[tuple[int, bytes]]:
        return [(1, b"\x01")]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, None),
        (True, True),
        (7, 7),
        ("text", "text"),
        (1.5, 1.5),
        (math.nan, None),
        (-math.inf, None),
        (b"\x01\xff", "01ff"),
        (bytearray(b"\x01"), "01"),
        (memoryview(b"\x01\xff"), "01ff"),
        (AT, AT_TEXT),
        (Status(0x281), ["OVERHEAT", "RUNNING", "WAITING_FOR_TRIGGER"]),
        (Status(0), []),
        (Colour.RED, "red"),
        (Number.ONE, 1),
        ((1, [2, {3}], frozenset()), [1, [2, [3]], []]),
        ({1: b"\x02", "a": {"b": math.inf}}, {"1": "02", "a": {"b": None}}),
        (Mapping(), {"1": "01"}),
        (POSE, POSE_JSON),
        (Settings(at=AT, raw=b"ab"), {"at": AT_TEXT, "raw": "6162"}),
        (Path("a/b"), "a/b"),
        (timedelta(seconds=1), "0:00:01"),
    ],
)
def test_jsonable_gives_what_json_takes(value: object, expected: object) -> None:
    assert jsonable(value) == expected
    assert type(jsonable(value)) is type(expected)
    json.dumps(jsonable(value), allow_nan=False)


RECORD = np.dtype([("n", "<i4"), ("x", "<f4"), ("code", "S4"), ("place", "<f4", (2,))])
ROWS = np.array([(1, 0.5, b"ok", (1, 2)), (2, math.nan, b"\xff", (3, 4))], dtype=RECORD)
ROWS_JSON = [
    {"n": 1, "x": 0.5, "code": "ok", "place": [1.0, 2.0]},
    {"n": 2, "x": None, "code": "ff", "place": [3.0, 4.0]},
]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.float32(0.5), 0.5),
        (np.float64("nan"), None),
        (np.int32(3), 3),
        (np.bool_(True), True),
        (np.bytes_(b"\x01"), "01"),
        (np.array([1.0, math.inf]), [1.0, None]),
        (np.arange(4).reshape(2, 2), [[0, 1], [2, 3]]),
        (np.array(3), 3),
        (np.zeros(0), []),
        (ROWS, ROWS_JSON),
        (ROWS.reshape(2, 1), [[ROWS_JSON[0]], [ROWS_JSON[1]]]),
        (ROWS[0], ROWS_JSON[0]),
        (ROWS.reshape(2, 1)[:, 0].reshape(2)[0:1].reshape(()), ROWS_JSON[0]),
    ],
)
def test_jsonable_numpy_values_are_lists_and_objects(value: object, expected: object) -> None:
    assert jsonable(value) == expected
    json.dumps(jsonable(value), allow_nan=False)


def test_jsonable_result_has_the_documented_names() -> None:
    part = Localization("square", 0.9, 0, POSE)
    result = Result("cell 1", 7, None, 4, AT, AT, 0.02, b"\x01\x02", [part])
    assert jsonable(result) == {
        "camera": "cell 1",
        "application": 7,
        "sequence": None,
        "number": 4,
        "triggered_at": AT_TEXT,
        "received_at": AT_TEXT,
        "latency": 0.02,
        "raw": "0102",
        "value": [{"feature_id": "square", "quality": 0.9, "photo_index": 0, "pose": POSE_JSON}],
    }


def test_result_is_shown_short() -> None:
    small = Result("cell 1", 7, None, 4, None, AT, None, b"\x01\x02", 5)
    assert repr(small) == (
        f"Result(camera='cell 1', application=7, number=4, received_at={AT!r}, "
        "raw=b'\\x01\\x02', value=5)"
    )
    large = Result("cell 1", 7, 1, 4, AT, AT, 0.02, bytes(60_000), ["part"] * 1000)
    assert len(repr(large)) < 700
    assert "sequence=1" in repr(large)


def test_result_in_a_notebook_is_a_table_of_parts() -> None:
    parts = [Localization(f"<{number}>", 0.9, 0, POSE) for number in range(102)]
    html = Result("cell & 1", 7, None, 4, AT, AT, 0.02, b"\x01\x02", parts)._repr_html_()
    assert "<td>cell &amp; 1</td>" in html
    assert "<td>20 ms</td>" in html
    assert "<td>102 localizations</td>" in html
    assert html.count("<td>&lt;") == 100
    assert html.endswith("<p>and 2 more</p>")
    x = f"<td>{1e3 * POSE.position.x:.3f}</td>"
    assert x in parts[0]._repr_html_()
    record = Layout("x: real32 mm, ok: bool").parse(bytes.fromhex("00004841ff"))
    table = "<tr><th>x [m]</th><th>ok</th></tr><tr><td>0.0125</td><td>True</td></tr>"
    assert table in record._repr_html_()
    assert table in Result("c", 7, None, 4, None, AT, None, b"", [record])._repr_html_()
    plain = Result("cell 1", 7, None, 4, None, AT, None, b"", {"a": "<b>"})._repr_html_()
    assert "<td>{&#x27;a&#x27;: &#x27;&lt;b&gt;&#x27;}</td>" in plain
    assert "latency" not in plain


@pytest.mark.parametrize(
    ("event", "own"),
    [
        (Connected(camera="c", at=AT, url="bvs://c:1"), {"url": "bvs://c:1"}),
        (Reconnected(camera="c", at=AT, url="bvs://c:1"), {"url": "bvs://c:1"}),
        (
            Disconnected(camera="c", at=AT, reason="gone", expected=False),
            {"reason": "gone", "expected": False},
        ),
        (
            StatusChanged(camera="c", at=AT, status=Status.BUSY, previous=None),
            {"status": ["BUSY"], "previous": None},
        ),
        (
            ApplicationChanged(camera="c", at=AT, application=2, previous=1),
            {"application": 2, "previous": 1},
        ),
    ],
    ids=lambda one: type(one).__name__,
)
def test_jsonable_event_has_its_fields(event: CameraEvent, own: dict[str, object]) -> None:
    assert jsonable(event) == {"camera": "c", "at": AT_TEXT, **own}


def test_jsonable_statistics_hold_the_subscribers_accounts() -> None:
    seen = jsonable(Statistics(received=2, streamed=2, subscribers=[ACCOUNT]))
    assert (seen["received"], seen["streamed"], seen["last_error"]) == (2, 2, None)
    assert seen["subscribers"] == [
        {
            "name": "results",
            "policy": "drop_oldest",
            "offered": 3,
            "taken": 1,
            "dropped": 1,
            "queued": 1,
            "queued_bytes": 40,
            "missed": 0,
        }
    ]


def test_jsonable_without_numpy_does_not_import_it() -> None:
    code = (
        "import sys; from smartcam.models import jsonable; "
        "print(jsonable([object, 1])[1], 'numpy' in sys.modules)"
    )
    done = subprocess.run(  # noqa: S603 - our own interpreter
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout == "1 False\n"


def test_models_public_values_are_all_exported() -> None:
    defined = {
        name
        for name, one in vars(models).items()
        if isinstance(one, type) and one.__module__ == models.__name__ and name[0] != "_"
    }
    assert defined - set(models.__all__) == {"Histogram", "SubscriberStatistics"}  # of Statistics


def test_status_words_with_unknown_bits_are_kept_as_they_are_but_not_in_memory() -> None:
    before = len(Status._value2member_map_)
    words = [Status(0x8000_0080 | number << 11) for number in range(1000)]
    assert len(Status._value2member_map_) == before
    assert [int(word) for word in words] == [0x8000_0080 | n << 11 for n in range(1000)]
    assert all(Status.RUNNING in word and Status.BUSY not in word for word in words)
    assert words[0] == Status(0x8000_0080)
    assert repr(words[0]) == "<Status: 2147483776>"
    assert words[0] & Status.RUNNING == Status.RUNNING
    assert pickle.loads(pickle.dumps(words[0])) == words[0]  # noqa: S301


# ---------------------------------------------------------------------- errors of poses


@given(st.floats(1e-6, 10), st.floats(1e-6, 10), st.floats(-1, 1))
def test_sigma_of_a_place_is_that_of_the_worst_direction(x: float, y: float, xy: float) -> None:
    sigma = PoseSigma(x, y, 0.01, correlation_xy=xy)
    covariance = [[x * x, xy * x * y], [xy * x * y, y * y]]
    worst = math.sqrt(float(np.linalg.eigvalsh(covariance)[-1]))
    assert sigma.worst_xy == pytest.approx(worst)
    assert sigma.millimetres == pytest.approx(1000 * worst)
    assert sigma.degrees == pytest.approx(math.degrees(0.01))


def test_pose_with_sigma_is_the_same_pose() -> None:
    sigma = PoseSigma(1e-4, 2e-4, 1e-3)
    pose = POSE.with_sigma(sigma)
    assert (POSE.sigma, pose.sigma) == (None, sigma)
    assert pose == POSE
    assert hash(pose) == hash(POSE)
    assert isinstance(pose, Pose)
    assert jsonable(POSE) == POSE_JSON
    assert jsonable(pose) == POSE_JSON | {"sigma": sigma._asdict()}
    assert pickle.loads(pickle.dumps(pose)).sigma == sigma  # noqa: S301 - our own
    assert "sigma=PoseSigma(x=0.0001, y=0.0002, theta=0.001" in repr(pose)
    moved = pose._replace(position=Position(0.3, 0.2))
    assert moved.sigma is None
    assert sigma.z is None
