"""Containers that come together give what each gives alone: values, empty slots, errors."""

from __future__ import annotations

import math
import struct
from datetime import UTC, datetime
from random import Random
from typing import Any

from smartcam import InterpretationError
from smartcam._client._inside import Interpretation
from smartcam.layout import Layout
from smartcam.layout._inside import Field
from smartcam.models import Localization
from smartcam.protocols.messages import ResultContainer
from tests.strategies import over

NOON = datetime(2026, 3, 4, 12, tzinfo=UTC)
PLACES = "x: real32 mm, y: real32 mm"
SPECS = {
    "localizations": "localizations",
    "integers": "localizations: (feature_id: string[4], quality: uint8 percent, x: int16 mm, "
    "y: int16 mm, theta: int16 deg)*",
    "without names": f"localizations: (theta: real32, {PLACES})*",
    "height": f"localizations: ({PLACES}, z: real32)*",
    "sigma": f"localizations: ({PLACES}, sigma_x: real32, sigma_y: real32, sigma_theta: real32)*",
    "unused text": f"localizations: ({PLACES}, note: string[3])*",
    "three": f"localizations: ({PLACES})[3]",
    "head": f"localizations: n: uint8, ({PLACES})[n]",
    "records": "(name: string[5], ok: bool, x: real32 mm, n: int16)*",
    "record": "name: string[5], ok: bool, x: real32 mm, n: int16",
    "named records": "parts: (name: string[5], x: int16)*",
    "head and records": "n: uint8, (name: string[5])[n]",
    "table": "table: (name: string[5], x: int16)*",
    "strings50": "strings50",
}
ODD = [0.0, -0.0, -1.0, 1.5, 100.0, 1e38, math.nan, math.inf]
"""Numbers that one of the fields does not take, or that are easily taken for others."""


def field_bytes(field: Field, random: Random, odd: float, order: str) -> bytes:
    """Return a field's bytes; they may not fit, as often as ``odd`` says."""
    if field.type == "string":
        text = b"\xff" if random.random() < odd else random.choice([b"nut", b"b\0c", b"screw"])
        return text[: field.size].ljust(field.size, b"\0")
    if field.type == "bool":
        return b"\1" if random.random() < odd else random.choice([b"\0", b"\xff"])
    if field.wire.is_integer:
        return struct.pack(order + field.wire.code, random.randrange(9))
    value = random.choice(ODD) if random.random() < odd else random.uniform(0.01, 0.99)
    return struct.pack(order + field.wire.code, value)


def record(layout: Layout, random: Random, odd: float, order: str) -> bytes:
    if random.random() < odd:
        return bytes(layout.size)
    return b"".join(field_bytes(field, random, odd, order) for field in layout.fields)


def spoil(layout: Layout | None, data: bytes, random: Random, order: str) -> bytes:
    """Return a container in which one field is odd, or that has a byte too many."""
    if layout is None or len(data) < layout.head_size + layout.size or random.random() < 0.1:
        return data + b"\1"
    place = random.randrange(len(layout.fields))
    begin = layout.head_size + sum(field.size for field in layout.fields[:place])
    odd = field_bytes(layout.fields[place], random, 1, order)
    return data[:begin] + odd + data[begin + len(odd) :]


def container(layout: Layout | None, random: Random, odd: float, order: str) -> bytes:
    if layout is None:
        return b"".join(random.choice([b"a", b"bc\0d"]).ljust(50, b"\0") for _ in range(2))
    count = layout.repeat
    if not isinstance(count, int):
        count = 1 if count is None else random.randrange(4)
    if random.random() < odd / 4:
        count += random.choice([-1, 1])
    head = bytes([count & 0xFF]) if layout.head else b""
    return head + b"".join(record(layout, random, odd, order) for _ in range(count))


def told(value: Any) -> object:
    """Return everything of a value that must be equal, types and NaN included."""
    if isinstance(value, list) and value and isinstance(value[0], Localization):
        return [(type(one), repr(one), [*map(type, one)], one.pose.sigma) for one in value]
    return type(value), repr(value), getattr(value, "dtype", None)


@over("name", SPECS)
def test_containers_together_give_what_each_gives(name: str) -> None:
    random = Random(name)  # noqa: S311 - the same bursts each time
    whole = 0
    for turn in range(200):
        y_down, endian = random.random() < 0.5, random.randrange(2)
        made = Interpretation(SPECS[name], lenient=False, y_down=y_down)
        odd, size = 0.1 * (turn % 3 == 0), random.randrange(2, 20)
        layout, order = made.layout, "<>"[endian]
        containers = [container(layout, random, odd, order) for _ in range(size)]
        if turn % 3 == 1:
            place = random.randrange(size)
            containers[place] = spoil(layout, containers[place], random, order)
        whole += agree(made, containers, endian)
    assert 50 <= whole < 200


def agree(made: Interpretation, containers: list[bytes], endian: int) -> bool:
    """Compare both ways; return whether all containers of the burst could be read."""
    together = made.burst(7, containers, endian, camera="cell", number=5, at=NOON)
    found = None if together is None else ([*map(told, together[0])], together[1])
    each: list[object] = []
    empty = 0
    for number, data in enumerate(containers, 5):
        one = ResultContainer(application=7, data=data)
        try:
            value, _, skipped = made(one, endian, camera="cell", number=number, at=NOON)
        except InterpretationError:
            assert found is None
            return False
        each.append(told(value))
        empty += skipped
    assert found == (each, empty)
    return True
