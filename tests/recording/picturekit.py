"""Pictures to be recorded."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from smartcam.exceptions import FrameFormatError
from smartcam.frames import Frame, Moment, find_format
from smartcam.models import Result
from tests.recording.recordingkit import at

FIELDS = [field.name for field in dataclasses.fields(Frame) if field.name != "data"]
BEGIN = at(0).timestamp()


def shot(
    number: int, form: str = "Mono8", width: int = 64, height: int = 32, **other: Any
) -> Frame:
    """Return a picture that no other number has."""
    found = find_format(form)
    stride = found.stride(width)
    size = found.size(width, height) or 500
    data = np.random.default_rng(number).integers(0, 256, size, np.uint8).tobytes()
    about: dict[str, Any] = {
        "data": data,
        "format": found,
        "width": width,
        "height": height,
        "stride": stride,
        "captured": 100.0 + number / 10,
        "utc": BEGIN + number / 10,
        "moment": Moment.EXPOSURE_START,
        "sequence": number,
        "source": "left",
    }
    return Frame(**(about | other))


def same(one: Frame, other: Frame) -> bool:
    """Return True if two frames are equal in everything."""
    size = min(len(one.data), len(other.data)) if one.format.compressed else len(one.data)
    return bytes(one.data) == bytes(other.data)[:size] and all(
        getattr(one, name) == getattr(other, name) for name in FIELDS
    )


VARIED: list[dict[str, Any]] = [
    {},
    {"lost": 3, "device_time": 0.0, "moment": Moment.ARRIVAL, "duration": math.inf},
    {"width": 32, "height": 16, "remark": "odd", "device_time": 12.5, "duration": 0.25},
]


def all_formats() -> list[str]:
    """Return the names of the formats that there are, as the error of an unknown one has them."""
    try:
        find_format("none of them")
    except FrameFormatError as error:
        return list(error.available)
    raise AssertionError("there is a format of that name")


def result(number: int, seconds: float, triggered: float | None = None) -> Result[Any]:
    """Return a result that came at a moment, and was triggered at one or by nobody."""
    when = None if triggered is None else at(triggered)
    return Result("left", 5, None, number, when, at(seconds), None, b"\0", b"\0")
