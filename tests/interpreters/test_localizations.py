"""Parts with poses."""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError, InterpretationError
from smartcam.interpreters import Context, Reader, resolve, run
from smartcam.models import Localization

MAX_NAMES = 64


PART = struct.Struct("<50sfifff")


def interpret(data: bytes, layout: str = "", **context: Any) -> list[Localization]:
    spec = f"localizations: {layout}" if layout else "localizations"
    value: Any = run(resolve(spec), Reader(data, Context(**context)))
    return list(value)


def test_default_layout_is_the_thesis() -> None:
    data = PART.pack(b"bolt", 0.5, 3, 0.25, -0.5, math.pi / 2) + PART.pack(b"nut", 1, 0, 1, 2, 0)
    at = datetime(2024, 5, 1, tzinfo=UTC)
    bolt, nut = interpret(data, camera="left", number=7, received_at=at)
    assert (bolt.feature_id, bolt.quality, bolt.photo_index) == ("bolt", 0.5, 3)
    assert bolt.pose.position == (0.25, -0.5, 0.0)
    assert bolt.pose.orientation.theta == pytest.approx(math.pi / 2)
    assert bolt.pose.orientation == pytest.approx((0, 0, math.sqrt(0.5), math.sqrt(0.5)))
    assert bolt.pose.header == (7, at, "left")
    assert nut.pose.header is bolt.pose.header
    assert type(bolt) is Localization
    assert type(bolt.pose.position.x) is float


def test_no_bytes_are_no_parts() -> None:
    assert interpret(b"") == []


def test_names_of_features_are_right_however_many_there_are() -> None:
    reader = resolve("localizations")
    names = [*(f"part {number}" for number in range(2 * MAX_NAMES)), "", "ä", "n" * 50]
    for _ in range(3):
        for some in (names, names[::-1]):
            data = b"".join(PART.pack(name.encode(), 1, 0, 1, 2, 0) for name in some)
            value: Any = run(reader, Reader(data, Context()))
            assert [part.feature_id for part in value] == some
    behind = PART.pack(b"bolt\0nut", 1, 0, 1, 2, 0) + PART.pack(b"bolt\0pin", 1, 0, 1, 2, 0)
    read: Any = run(reader, Reader(behind, Context()))
    assert [part.feature_id for part in read] == ["bolt", "bolt"]


def test_values_follow_the_byte_order() -> None:
    data = struct.pack(">ff", 1.5, -2.0)
    (part,) = interpret(data, "(x: real32, y: real32)*", byte_order="big")
    assert part.pose.position == (1.5, -2.0, 0.0)


def test_fields_that_are_not_there_have_defaults_and_others_are_ignored() -> None:
    (part,) = interpret(b"\1\0\xff\2\0", "y: int16 mm, ok: bool, x: int16 mm")
    assert part[:3] == ("", 1.0, 0)
    assert part.pose.position == (0.002, 0.001, 0.0)
    assert part.pose.orientation == (0, 0, 0, 1)


def test_units_and_all_fields_in_another_order() -> None:
    data = struct.pack("<fhhhhi4s", 90.0, 3, 2, 1, 87, 5, b"abc")
    layout = (
        "(theta: real32 deg, z: int16 mm, y: int16 mm, x: int16 mm, quality: int16 percent, "
        "photo_index: int32, feature_id: string[4])*"
    )
    (part,) = interpret(data, layout)
    assert part[:3] == ("abc", 0.87, 5)
    assert part.pose.position == (0.001, 0.002, 0.003)
    assert part.pose.orientation.theta == pytest.approx(math.pi / 2)


def test_integers_without_a_unit_become_floats() -> None:
    (part,) = interpret(b"\1\2", "(x: int8, y: int8)*")
    assert [type(value) for value in part.pose.position] == [float] * 3
    assert part.pose.position == (1.0, 2.0, 0.0)


def test_empty_slots_are_skipped_and_counted() -> None:
    data = bytes(70) + PART.pack(b"", 0.5, 0, 0, 0, 0) + bytes(140)
    context = Context()
    value: Any = run(resolve("localizations"), Reader(data, context))
    assert [part.quality for part in value] == [0.5]
    assert context.empty_slots == 3


def test_slots_after_the_count_are_not_looked_at() -> None:
    layout = "n: int8, (x: int8, y: int8)[n]"
    context = Context()
    interpreter = resolve(f"localizations: {layout}")
    value: Any = run(interpreter, Reader(b"\2\1\2\0\0\5\6\0\0", context))
    assert [part.pose.position.x for part in value] == [1.0]
    assert context.empty_slots == 1


def test_y_down_is_turned_to_y_up() -> None:
    data = PART.pack(b"a", 1, 0, 1.0, 2.0, 0.5) + PART.pack(b"b", 1, 0, 1.0, 0.0, 0.0)
    turned, straight = interpret(data, y_down=True)
    assert turned.pose.position == (1.0, -2.0, 0.0)
    assert turned.pose.orientation.theta == pytest.approx(-0.5)
    assert math.copysign(1, straight.pose.position.y) == 1
    assert math.copysign(1, straight.pose.orientation.z) == 1


def test_z_stays_with_its_record_where_others_are_skipped() -> None:
    record = struct.Struct("<fhff")
    data = record.pack(0, 0, 0, 0) + record.pack(1, 2, 3, 0.5) + record.pack(4, 5, 6, 0.5)
    parts = interpret(data, "(z: real32 mm, x: int16, y: real32, theta: real32)*")
    assert [part.pose.position for part in parts] == [(2.0, 3.0, 0.001), (5.0, 6.0, 0.004)]


@pytest.mark.parametrize(("unused", "bad"), [("ok: bool", b"\1"), ("code: string[1]", b"\xff")])
def test_values_that_are_not_used_are_checked(unused: str, bad: bytes) -> None:
    layout = f"({unused}, x: int8, y: int8)*"
    assert len(interpret(b"\0\1\2", layout)) == 1
    with pytest.raises(InterpretationError, match=f"record 1: field '{unused.split(':')[0]}'"):
        interpret(b"\0\1\2" + bad + b"\1\2", layout)


def test_text_that_is_not_utf8_names_its_place_and_comes_before_nan() -> None:
    data = PART.pack(b"a", 1, 0, math.nan, 2, 0) + PART.pack(b"b\xff", 1, 0, 1, 2, 0)
    with pytest.raises(InterpretationError, match="record 1: field 'feature_id'") as caught:
        interpret(data)
    assert caught.value.offset == 71


@pytest.mark.parametrize(("field", "offset"), [("x", 58), ("y", 62), ("theta", 66)])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_pose_that_is_not_finite_names_field_and_offset(
    field: str, offset: int, bad: float
) -> None:
    values = {"x": 1.0, "y": 2.0, "theta": 3.0, field: bad}
    data = bytes(70) + PART.pack(b"a", 1, 0, values["x"], values["y"], values["theta"])
    with pytest.raises(InterpretationError) as caught:
        interpret(data)
    error = caught.value
    assert (error.field, error.offset) == (field, 70 + offset)
    assert f"field '{field}' (real32) at offset {70 + offset}" in str(error)
    assert f"expected a finite number, got {bad}" in str(error)


def test_large_poses_may_sum_to_infinity() -> None:
    (part,) = interpret(
        struct.pack("<fdd", 1.0, 1e308, 1e308), "quality: real32, x: real64, y: real64"
    )
    assert part.pose.position.x == 1e308


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -1.0, 7.0, 1.00001, -0.001])
def test_quality_that_is_none_names_field_and_offset(bad: float) -> None:
    good = PART.pack(b"a", 1, 0, 1, 2, 3)
    with pytest.raises(InterpretationError) as caught:
        interpret(good + bytes(70) + PART.pack(b"b", bad, 0, 1, 2, 3))
    error = caught.value
    assert (error.field, error.offset) == ("quality", 140 + 50)
    assert "field 'quality' (real32) at offset 190: expected 0 to 1" in str(error)
    assert ("percent" in str(error)) == (1 < bad <= 100)


@pytest.mark.parametrize("good", [0.0, -0.0, 1.0, 1.0000001])
def test_quality_may_be_rounded(good: float) -> None:
    (part,) = interpret(PART.pack(b"a", good, 0, 1, 2, 3))
    assert part.quality == pytest.approx(good, abs=1e-7)


@pytest.mark.parametrize(("sent", "quality"), [(0.0, 0.0), (98.0, 0.98), (100.0, 1.0)])
def test_quality_in_percent_is_judged_as_a_ratio(sent: float, quality: float) -> None:
    layout = "(quality: real32 percent, x: real32, y: real32)*"
    (part,) = interpret(struct.pack("<fff", sent, 1, 2), layout)
    assert part.quality == quality
    with pytest.raises(InterpretationError, match=r"expected 0 to 1, got 1\.01"):
        interpret(struct.pack("<fff", 101, 1, 2), layout)


def test_quality_as_an_integer_without_a_unit_is_0_or_1() -> None:
    assert interpret(b"\1\1\2", "(quality: int8, x: int8, y: int8)*")[0].quality == 1.0
    with pytest.raises(InterpretationError, match=r"expected 0 to 1 \(its unit may be percent\)"):
        interpret(b"\x62\1\2", "(quality: int8, x: int8, y: int8)*")


def test_container_that_does_not_fit_raises() -> None:
    with pytest.raises(InterpretationError, match="record 1: field 'feature_id'"):
        interpret(bytes(71))


@pytest.mark.parametrize(
    ("layout", "part"),
    [
        ("(x: real32)*", "expected a field 'y' in the layout"),
        ("(y: real32)*", "expected a field 'x' in the layout"),
        ("x: int8, (y: real32)*", "expected a field 'x' in the layout"),
        ("(x: bool, y: real32)*", "field 'x' (bool): expected a number without a unit or in m, mm"),
        ("(x: real32 deg, y: real32)*", "field 'x' (real32 deg): expected a number"),
        ("(x: real32, y: real32, theta: real32 mm)*", "without a unit or in rad, deg"),
        ("(x: real32, y: real32, quality: real32 m)*", "without a unit or in percent"),
        ("(x: real32, y: real32, photo_index: real32)*", "an integer without a unit"),
        ("(x: real32, y: real32, feature_id: int32)*", "expected a string"),
    ],
)
def test_layout_without_a_pose_is_refused(layout: str, part: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        resolve(f"localizations: {layout}")
    assert part in str(caught.value)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=70) | st.binary(min_size=140, max_size=140), st.booleans())
def test_any_bytes_give_finite_poses_or_an_interpretation_error(data: bytes, y_down: bool) -> None:
    context = Context(y_down=y_down)
    try:
        value: Any = run(resolve("localizations"), Reader(data, context))
    except InterpretationError:
        return
    assert len(value) + context.empty_slots == len(data) // 70
    for part in value:
        assert all(map(math.isfinite, (*part.pose.position, *part.pose.orientation)))


# ---------------------------------------------------------------------- errors

SIGMAS = "sigma_theta: real32 deg, sigma_y: real32 mm, sigma_x: real32 mm"
FULL = f"(x: real32 mm, y: real32 mm, {SIGMAS}, correlation_xt: real32, correlation_xy: real32)*"


def test_errors_of_poses_are_read_in_si() -> None:
    part = struct.Struct("<7f")
    data = part.pack(12, 34, 0.5, 0.2, 0.1, -0.25, 0.5) + bytes(part.size)
    data += part.pack(1, 2, 1, 0.1, 0.4, 0, 0)
    first, second = interpret(data, FULL)
    sigma = first.pose.sigma
    assert sigma is not None
    assert sigma[:3] == pytest.approx((1e-4, 2e-4, math.radians(0.5)))
    assert sigma[3:6] == pytest.approx((0.5, -0.25, 0.0))
    assert first.pose.position.x == pytest.approx(0.012)
    assert second.pose.sigma is not None
    assert second.pose.sigma.millimetres == pytest.approx(0.4)
    (down, _) = interpret(data, FULL, y_down=True)
    assert down.pose.sigma is not None
    assert down.pose.sigma[3:6] == pytest.approx((-0.5, 0.25, 0.0))
    assert down.pose.position.y == pytest.approx(-0.034)


@pytest.mark.parametrize("sigma", [math.nan, math.inf, -0.1])
def test_error_that_is_none_is_not_known(sigma: float) -> None:
    data = struct.pack("<7f", 12, 34, 0.5, 0.2, sigma, 0, 0)
    (part,) = interpret(data, FULL)
    assert part.pose.sigma is None
    (part,) = interpret(struct.pack("<7f", 12, 34, 0.5, 0.2, 0.1, 0, 1.5), FULL)
    assert part.pose.sigma is None


def test_errors_need_all_three_fields_in_units_that_fit() -> None:
    (part,) = interpret(
        struct.pack("<4f", 1, 2, 3, 4), "x: real32, y: real32, sigma_x: real32, b: real32"
    )
    assert part.pose.sigma is None
    for wrong in ("sigma_x: real32 deg", "sigma_theta: real32 mm", "correlation_xy: real32 mm"):
        with pytest.raises(ConfigurationError, match=wrong.split(":")[0]):
            interpret(b"", f"x: real32, y: real32, {wrong}")
