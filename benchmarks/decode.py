"""Decode: from a container's bytes to a table, to localizations, to texts; no socket, no loop.

smartcam decodes as its client does: an interpreter that takes the bytes by itself is given them and
a Context that is used again, another one a Reader and a Context, made for each container. Every
side is called with the container and returns the values, and its values are looked at once before
it is measured.
"""

from __future__ import annotations

import math
import struct
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, TypeAdapter

from benchmarks.constructs import parse_localizations
from benchmarks.measure import Comparison, Curve, Goal, Plan, cpu_microseconds, take_turns
from benchmarks.peers import wire
from smartcam.interpreters import Context, Reader, resolve
from smartcam.interpreters import _base as base

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from benchmarks.measure import Cost, How, Series
    from smartcam.interpreters import Interpreter

    Decode = Callable[[bytes], Any]
    Sides = tuple[bytes, dict[str, Decode]]

__all__ = ["run"]

COUNTS = (1, 10, 100, 1000)
"""Records of a container."""

BUDGET = 25_000
"""Microseconds of a round of one side, about."""

SMARTCAM = "smartcam"
CAMERA, NUMBER, AT = "camera", 7, datetime(2024, 5, 1, tzinfo=UTC)

TABLE = "table: (part: int32, x: real32, y: real32, theta: real32, score: real32)*"
TABLE_SI = (
    "table: (part: int32, x: real32 mm, y: real32 mm, theta: real32 deg, score: real32 percent)*"
)
NUMERIC = struct.Struct("<iffff")
NUMERIC_DTYPE = np.dtype(
    [("part", "<i4"), ("x", "<f4"), ("y", "<f4"), ("theta", "<f4"), ("score", "<f4")]
)
SI_DTYPE = np.dtype(
    [("part", "<i4"), ("x", "<f8"), ("y", "<f8"), ("theta", "<f8"), ("score", "<f8")]
)
TEXT = struct.Struct("50s")


def run(plan: Plan) -> Iterable[Comparison | Curve]:
    """Measure tables, localizations and texts, the other libraries, and the layout's fields."""
    more, times = Goal("at most", 3.0, "us"), Goal("at most", 1.5)
    cases: list[tuple[str, Callable[[int], Sides], How, Goal | None]] = [
        ("table", _table_sides, "more", more),
        ("table in SI", _table_si_sides, "ratio", None),
        ("list[Localization]", _localization_sides, "ratio", times),
        ("strings50", _text_sides, "ratio", times),
    ]
    for what, sides_of, how, goal in cases:
        curve = Curve(
            "decode", f"Decode: {what}", "records of a container", "microseconds for each record"
        )
        for count in COUNTS:
            series = _measure(plan, *sides_of(count))
            ours, yardstick = series.values()
            noun = "record" if count == 1 else "records"
            yield Comparison("decode", f"{what}, {count} {noun}", ours, yardstick, how, goal)
            for one in (ours, yardstick):
                curve.lines.setdefault(one.name, []).append((count, one.median / count))
        yield curve
    yield from _libraries(plan)
    yield _fields(plan)


def _measure(plan: Plan, data: bytes, sides: dict[str, Decode]) -> dict[str, Series]:
    """Let the sides decode one container, each as often as fills the slowest one's budget."""
    count = plan.operations(round(BUDGET / _estimate(data, sides)), least=2)
    return take_turns(plan, {name: _side(data, decode, count) for name, decode in sides.items()})


def _estimate(data: bytes, sides: dict[str, Decode]) -> Cost:
    """Return about what the slowest side costs, microseconds."""
    costs: list[Cost] = []
    for decode in sides.values():
        decode(data)
        begin = time.process_time()
        decode(data)
        costs.append(cpu_microseconds(begin, 1))
    return max(*costs, 1.0)


def _side(data: bytes, decode: Decode, count: int) -> Callable[[], Cost]:
    def measure() -> Cost:
        begin = time.process_time()
        for _ in range(count):
            decode(data)
        return cpu_microseconds(begin, count)

    return measure


def _as_the_client(interpreter: Interpreter) -> Decode:
    """Return what decodes a container as the client does."""
    simple = base.as_plain_interpreter(interpreter)
    context = Context(CAMERA, wire.APPLICATION, NUMBER, AT)
    if simple is not None:

        def decode_plainly(data: bytes) -> Any:
            context.number, context.received_at, context.empty_slots = NUMBER, AT, 0
            return base.run_plain(simple, data, context)

        return decode_plainly

    def decode(data: bytes) -> Any:
        context = Context(CAMERA, wire.APPLICATION, NUMBER, AT, "little", False, False)
        return base.run(interpreter, Reader(data, context, interpreter.layout))

    return decode


# -- tables -------------------------------------------------------------------------------------


def _numeric(count: int) -> bytes:
    return b"".join(NUMERIC.pack(n, 0.5 * n, -0.25 * n, 45.0, 97.5) for n in range(count))


def _table_sides(count: int) -> Sides:
    data = _numeric(count)
    ours = _as_the_client(resolve(TABLE))

    def bare(data: bytes) -> Any:
        return np.frombuffer(data, NUMERIC_DTYPE)

    assert ours(data).dtype == NUMERIC_DTYPE
    assert ours(data).tolist() == bare(data).tolist() == list(NUMERIC.iter_unpack(data))
    assert not ours(data).flags.writeable
    return data, {SMARTCAM: ours, "np.frombuffer": bare}


def _table_si_sides(count: int) -> Sides:
    data = _numeric(count)
    ours = _as_the_client(resolve(TABLE_SI))

    def by_hand(data: bytes) -> Any:
        found = np.frombuffer(data, NUMERIC_DTYPE)
        rows = np.empty(len(found), SI_DTYPE)
        rows["part"] = found["part"]
        rows["x"] = found["x"].astype(np.float64) / 1000.0
        rows["y"] = found["y"].astype(np.float64) / 1000.0
        rows["theta"] = found["theta"].astype(np.float64) * (math.pi / 180.0)
        rows["score"] = found["score"].astype(np.float64) / 100.0
        return rows

    assert ours(data).dtype == SI_DTYPE
    assert ours(data).tolist() == by_hand(data).tolist()
    last = ours(data)[-1]
    assert math.isclose(last["x"], 0.0005 * (count - 1))
    assert math.isclose(last["theta"], math.pi / 4)
    return data, {SMARTCAM: ours, "frombuffer, by hand": by_hand}


# -- localizations ------------------------------------------------------------------------------


@dataclass(slots=True)
class PlainHeader:
    """As smartcam's Header."""

    seq: int
    stamp: datetime
    frame_id: str


@dataclass(slots=True)
class PlainPosition:
    """As smartcam's Position."""

    x: float
    y: float
    z: float


@dataclass(slots=True)
class PlainQuaternion:
    """As smartcam's Quaternion."""

    x: float
    y: float
    z: float
    w: float


@dataclass(slots=True)
class PlainPose:
    """As smartcam's Pose."""

    header: PlainHeader
    position: PlainPosition
    orientation: PlainQuaternion


@dataclass(slots=True)
class PlainLocalization:
    """As smartcam's Localization."""

    feature_id: str
    quality: float
    photo_index: int
    pose: PlainPose


def _localizations(count: int) -> bytes:
    return b"".join(map(wire.localization, range(count)))


def _by_struct(data: bytes) -> list[PlainLocalization]:
    header = PlainHeader(NUMBER, AT, CAMERA)
    sin, cos = math.sin, math.cos
    found: list[PlainLocalization] = []
    for text, quality, photo_index, x, y, theta in wire.RECORD.iter_unpack(data):
        half = 0.5 * theta
        orientation = PlainQuaternion(0.0, 0.0, sin(half), cos(half))
        pose = PlainPose(header, PlainPosition(x, y, 0.0), orientation)
        feature_id = text.partition(b"\0")[0].decode()
        found.append(PlainLocalization(feature_id, quality, photo_index, pose))
    return found


def _localization_sides(count: int) -> Sides:
    data = _localizations(count)
    ours = _as_the_client(resolve("localizations"))
    assert len(ours(data)) == count
    for one, plain_one in zip(ours(data), _by_struct(data), strict=True):
        _check_same(one, plain_one)
    return data, {SMARTCAM: ours, "slots dataclasses": _by_struct}


def _check_same(one: Any, other: Any) -> None:
    """Check that two localizations of whatever classes have the same values."""
    for name in ("feature_id", "quality", "photo_index"):
        assert getattr(one, name) == getattr(other, name)
    for name in ("seq", "stamp", "frame_id"):
        assert getattr(one.pose.header, name) == getattr(other.pose.header, name)
    for name in "xyz":
        assert getattr(one.pose.position, name) == getattr(other.pose.position, name)
    for name in "xyzw":
        assert getattr(one.pose.orientation, name) == getattr(other.pose.orientation, name)


# -- texts --------------------------------------------------------------------------------------


def _text_sides(count: int) -> Sides:
    texts = [f"text {number}" for number in range(count)]
    data = b"".join(map(TEXT.pack, map(str.encode, texts)))
    ours = _as_the_client(resolve("strings50"))

    def by_struct(data: bytes) -> list[str]:
        return [text.partition(b"\0")[0].decode() for (text,) in TEXT.iter_unpack(data)]

    assert ours(data) == by_struct(data) == texts
    return data, {SMARTCAM: ours, "struct.iter_unpack": by_struct}


# -- what it would cost otherwise ---------------------------------------------------------------


class ModelHeader(BaseModel):
    """As smartcam's Header."""

    seq: int
    stamp: datetime
    frame_id: str


class ModelPosition(BaseModel):
    """As smartcam's Position."""

    x: float
    y: float
    z: float


class ModelQuaternion(BaseModel):
    """As smartcam's Quaternion."""

    x: float
    y: float
    z: float
    w: float


class ModelPose(BaseModel):
    """As smartcam's Pose."""

    header: ModelHeader
    position: ModelPosition
    orientation: ModelQuaternion


class ModelLocalization(BaseModel):
    """As smartcam's Localization."""

    feature_id: str
    quality: float
    photo_index: int
    pose: ModelPose


MODELS = TypeAdapter(list[ModelLocalization])


def _by_pydantic(data: bytes) -> list[ModelLocalization]:
    header = ModelHeader(seq=NUMBER, stamp=AT, frame_id=CAMERA)
    return MODELS.validate_python(
        [
            {
                "feature_id": text.partition(b"\0")[0].decode(),
                "quality": quality,
                "photo_index": photo_index,
                "pose": {
                    "header": header,
                    "position": {"x": x, "y": y, "z": 0.0},
                    "orientation": {
                        "x": 0.0,
                        "y": 0.0,
                        "z": math.sin(0.5 * theta),
                        "w": math.cos(0.5 * theta),
                    },
                },
            }
            for text, quality, photo_index, x, y, theta in wire.RECORD.iter_unpack(data)
        ]
    )


def _libraries(plan: Plan) -> Iterable[Comparison]:
    """Localizations by libraries; construct gives flat records without a pose."""
    count = 10
    data, sides = _localization_sides(count)
    ours = sides[SMARTCAM]
    for one, model in zip(ours(data), _by_pydantic(data), strict=True):
        _check_same(one, model)
    for one, record in zip(ours(data), parse_localizations(data), strict=True):
        assert (one.feature_id, one.quality) == (record.feature_id, record.quality)
        assert one.pose.position[:2] == (record.x, record.y)
    others: dict[str, Decode] = {"pydantic": _by_pydantic, "construct": parse_localizations}
    series = _measure(plan, data, {SMARTCAM: ours, **others})
    for name in others:
        yield Comparison(
            "decode",
            f"list[Localization] by {name}, {count} records",
            series[SMARTCAM],
            series[name],
            "speed",
            note="what it would cost; construct gives flat records without a pose",
        )


# -- fields of a layout -------------------------------------------------------------------------

FIELDS = (1, 2, 4, 8, 16, 32, 64, 96, 128, 192, 256)


def _fields(plan: Plan) -> Curve:
    """Return the cost of a container over the number of its layout's fields."""
    curve = Curve(
        "decode", "Decode: a record", "fields of the layout", "microseconds for a container"
    )
    for count in FIELDS:
        for name, series in _measure(plan, *_record_sides(count)).items():
            curve.lines.setdefault(name, []).append((count, series.median))
    return curve


def _record_sides(count: int) -> Sides:
    """An int32 and a real32 in turn; with units, every real32 is in millimetres."""
    whole = struct.Struct("<" + ("if" * count)[:count])
    values = [number if number % 2 == 0 else 0.5 * number for number in range(count)]
    data = whole.pack(*values)
    types = ("int32", "real32"), ("int32", "real32 mm")
    layouts = [
        ", ".join(f"v{number}: {pair[number % 2]}" for number in range(count)) for pair in types
    ]
    ours, in_si = (_as_the_client(resolve(layout)) for layout in layouts)
    metres = [value if number % 2 == 0 else value / 1000 for number, value in enumerate(values)]
    assert ours(data) == whole.unpack(data) == tuple(values)
    assert in_si(data) == tuple(metres)
    return data, {SMARTCAM: ours, "smartcam, in metres": in_si, "struct.unpack": whole.unpack}
