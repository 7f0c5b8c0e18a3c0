"""Target ``interpreters``: any container, in any byte order, through every interpreter of ours.

Input: interpreter, options, endian field, a number, then the container.
"""

from __future__ import annotations

import functools
import json
import math
from datetime import UTC, datetime
from typing import Any

from smartcam._client._inside import Interpretation
from smartcam.exceptions import InterpretationError
from smartcam.interpreters import resolve
from smartcam.models import Localization, jsonable
from smartcam.protocols.messages import ResultContainer
from tests.fuzz.fuzz_input import Choices
from tests.fuzz.fuzz_layout import fitted

SPECS = (
    "localizations",
    "localizations: n: uint8, (feature_id: string[3], x: int16 px, y: uint8, z: real64 inch)[n]",
    "localizations: (x: real32 mm, y: real32 mm, theta: real32 deg, quality: uint8 percent)[2]",
    "localizations: x: real64, y: real64, photo_index: int8, ok: bool, number: int16 @sequence",
    "strings50",
    "raw",
    "record: passed: bool, count: int32, x: real32 mm, code: string[4]",
    "s: uint8 @sequence, (a: bool, b: int64 um)*",
    "table: (a: bool, b: real32 deg, c: uint16, d: string[2], e: real32)*",
    "table: n: int8, (a: int16)[n]",
)
AT = datetime(2024, 2, 29, 12, tzinfo=UTC)
ENDIANS = (0, 1, 2, 0xFFFFFFFF)


@functools.cache
def interpretation(spec: str, *, lenient: bool, y_down: bool) -> Interpretation:
    """Return how containers are read; made once, as a client does."""
    return Interpretation(spec, lenient=lenient, y_down=y_down)


def check(data: bytes) -> None:
    """Interpret one container: a value, or an error that tells the place."""
    choices = Choices(data)
    spec, options, endian = choices.pick(SPECS), choices.byte(), choices.pick(ENDIANS)
    number, payload = choices.byte(), choices.rest()
    layout = resolve(spec).layout if options & 4 else None
    if layout is not None:
        payload = fitted(layout, payload, number)
    elif options & 4:
        payload = payload[: 50 * (number % 4)].ljust(50 * (number % 4), b"\0")
    lenient, y_down = bool(options & 1), bool(options & 2)
    read = interpretation(spec, lenient=lenient, y_down=y_down)
    container = ResultContainer(application=number, data=payload)
    try:
        value, sequence, empty = read(container, endian, camera="camera", number=number, at=AT)
    except InterpretationError as error:
        cause = f"{type(error.__cause__).__name__}: {error.__cause__}"
        assert "the interpreter failed" not in str(error), cause
        assert 0 <= error.offset <= len(payload)
        assert len(str(error)) < 700
        return
    assert endian in (0, 1)
    assert sequence is None or "@sequence" in spec
    assert 0 <= empty <= len(payload)
    json.dumps(jsonable(value), allow_nan=False).encode()
    if spec.startswith("localizations"):
        check_localizations(value, number)
        mirrored = interpretation(spec, lenient=lenient, y_down=not y_down)
        other, _, _ = mirrored(container, endian, camera="camera", number=number, at=AT)
        check_mirrored(value, other)


def check_localizations(found: list[Localization], number: int) -> None:
    """Every pose is one that a robot could go to."""
    for one in found:
        assert isinstance(one, Localization)
        assert one.pose.header == (number, AT, "camera")
        assert all(isinstance(x, float) and math.isfinite(x) for x in one.pose.position)
        turn: Any = one.pose.orientation
        assert turn[:2] == (0.0, 0.0)
        assert math.isclose(math.hypot(*turn), 1.0)
        assert isinstance(one.feature_id, str)
        assert isinstance(one.quality, float)
        assert isinstance(one.photo_index, int)


def check_mirrored(up: list[Localization], down: list[Localization]) -> None:
    """Turning the y axis round changes y and theta alone."""
    assert len(up) == len(down)
    for one, other in zip(up, down, strict=True):
        a, b = one.pose, other.pose
        assert (a.position.x, a.position.z) == (b.position.x, b.position.z)
        assert a.position.y == -b.position.y
        assert (a.orientation.z, a.orientation.w) == (-b.orientation.z, b.orientation.w)
        assert (one.feature_id, one.photo_index) == (other.feature_id, other.photo_index)
        assert repr(one.quality) == repr(other.quality)
