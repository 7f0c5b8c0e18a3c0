"""The marks of a picture as Foxglove's message ``foxglove.ImageAnnotations``.

A viewer draws the marks over the picture. Fields with numbers from 100 on are smartcam's, and
are in the file's schema. With these fields a mark is read exactly as it was written. Foxglove
counts pixels from the upper left corner of the upper left pixel, smartcam from its centre.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Any, Final, get_args

from smartcam.frames._inside import COLOURS, Drawing, Kind, Role, stroke_width
from smartcam.recording._pictures.protobuf import (
    TIMESTAMP,
    Fields,
    WireField,
    encode_message,
    encode_timestamp,
    file_descriptor_set,
    parse_message,
)

if TYPE_CHECKING:
    from smartcam.frames import Frame

MAX_DRAWINGS: Final = 1000
"""Largest number of marks of a picture that are written, or read."""

MAX_POINTS: Final = 10_000
"""Largest number of points of a mark that is written, or read."""

MAX_TEXT_CHARACTERS: Final = 120
"""Largest number of characters of a text that is written."""

_STAMP: Final = WireField(1, "message", TIMESTAMP)
_POINT, _COLOUR = ".foxglove.Point2", ".foxglove.Color"

_MESSAGES: Final[dict[str, Fields]] = {
    "Point2": {"x": WireField(1, "double"), "y": WireField(2, "double")},
    "Color": {
        name: WireField(number, "double") for number, name in enumerate(("r", "g", "b", "a"), 1)
    },
    "CircleAnnotation": {  # never written; viewers look for it
        "timestamp": _STAMP,
        "position": WireField(2, "message", _POINT),
        "diameter": WireField(3, "double"),
        "thickness": WireField(4, "double"),
        "fill_color": WireField(5, "message", _COLOUR),
        "outline_color": WireField(6, "message", _COLOUR),
    },
    "PointsAnnotation": {
        "timestamp": _STAMP,
        "type": WireField(2, "enum", ".foxglove.PointsAnnotation.Type"),
        "points": WireField(3, "message", _POINT, repeated=True),
        "outline_color": WireField(4, "message", _COLOUR),
        "outline_colors": WireField(5, "message", _COLOUR, repeated=True),
        "fill_color": WireField(6, "message", _COLOUR),
        "thickness": WireField(7, "double"),
        "mark_number": WireField(101, "uint64"),
        "role": WireField(102, "string"),
        "label": WireField(103, "string"),
    },
    "TextAnnotation": {
        "timestamp": _STAMP,
        "position": WireField(2, "message", _POINT),
        "text": WireField(3, "string"),
        "font_size": WireField(4, "double"),
        "text_color": WireField(5, "message", _COLOUR),
        "background_color": WireField(6, "message", _COLOUR),
        "mark_number": WireField(101, "uint64"),
        "role": WireField(102, "string"),
    },
    "ImageAnnotations": {
        "circles": WireField(1, "message", ".foxglove.CircleAnnotation", repeated=True),
        "points": WireField(2, "message", ".foxglove.PointsAnnotation", repeated=True),
        "texts": WireField(3, "message", ".foxglove.TextAnnotation", repeated=True),
    },
}
"""Foxglove's messages and their fields. ``mark_number`` counts the marks of a picture from 1.
``label`` is the text beside a mark's first point, which viewers get as a text without a number."""

_TYPES: Final = ("UNKNOWN", "POINTS", "LINE_LOOP", "LINE_STRIP", "LINE_LIST")
_KINDS: Final[dict[int, Kind]] = {1: "points", 2: "polygon", 3: "line"}
_TYPE_OF: Final = {kind: number for number, kind in _KINDS.items()}


@cache
def schema_data(name: str) -> bytes:
    """Return the message's schema in MCAP's form: a FileDescriptorSet."""
    return file_descriptor_set(name, _MESSAGES, {"PointsAnnotation": {"Type": _TYPES}})


def annotations_message(frame: Frame) -> bytes:
    """Return the message of a frame's marks.

    Marks after the first thousand are left out, and marks whose coordinates are not finite.
    """
    line_width = stroke_width(frame.width, frame.height)
    stamp = encode_timestamp(frame.utc)
    annotations: dict[str, list[bytes]] = {"points": [], "texts": []}
    for number, drawing in enumerate(frame.drawings[:MAX_DRAWINGS], 1):
        points = drawing.points[:MAX_POINTS]
        if not points or not all(math.isfinite(x) and math.isfinite(y) for x, y in points):
            continue
        common = {"timestamp": stamp, "mark_number": number, "role": drawing.role}
        text = drawing.text[:MAX_TEXT_CHARACTERS]
        if drawing.kind != "text":
            values = {
                **common,
                "type": _TYPE_OF[drawing.kind],
                "points": [_point(*point) for point in points],
                "outline_color": _colour(drawing.role),
                "thickness": line_width * (3.0 if drawing.kind == "points" else 1.0),
                "label": text,
            }
            annotations["points"].append(encode_message(_MESSAGES["PointsAnnotation"], values))
            common = {"timestamp": stamp}
        if text:
            values = {
                **common,
                "position": _point(*points[0]),
                "text": text,
                "font_size": 14.0 * line_width,
                "text_color": _colour(drawing.role),
                "background_color": _colour(None),
            }
            annotations["texts"].append(encode_message(_MESSAGES["TextAnnotation"], values))
    return encode_message(_MESSAGES["ImageAnnotations"], annotations)


def drawings_of(data: memoryview) -> tuple[Drawing, ...]:
    """Return the marks of a message.

    Raises:
        ValueError: the message is not valid.
    """
    lists = parse_message(_MESSAGES["ImageAnnotations"], data, 2 * MAX_DRAWINGS)
    drawings: dict[int, Drawing] = {}
    for annotation in lists.get("points", ()):
        values = parse_message(_MESSAGES["PointsAnnotation"], annotation, MAX_POINTS + 100)
        kind = _KINDS.get(values.get("type", 0))
        if kind is None:
            raise ValueError(f"type: {values.get('type', 0)} came, expected 1 to 3")
        points = tuple(map(_coordinates, values.get("points", ())))
        label = _text(values, "label")
        drawings[_mark_number(values)] = Drawing(kind, points, _role(values), label)
    for annotation in lists.get("texts", ()):
        values = parse_message(_MESSAGES["TextAnnotation"], annotation, 100)
        if "mark_number" in values:  # texts without a number are the labels of points
            point = _coordinates(values.get("position", memoryview(b"")))
            text = _text(values, "text")
            drawings[_mark_number(values)] = Drawing("text", (point,), _role(values), text)
    return tuple(drawing for _, drawing in sorted(drawings.items()))


def _point(x: float, y: float) -> bytes:
    return encode_message(_MESSAGES["Point2"], {"x": x + 0.5, "y": y + 0.5})


def _coordinates(data: memoryview) -> tuple[float, float]:
    values = parse_message(_MESSAGES["Point2"], data, 10)
    return values.get("x", 0.0) - 0.5, values.get("y", 0.0) - 0.5


def _colour(role: Role | None) -> bytes:
    """Return the colour of a role; without a role half-transparent black, for a background."""
    red, green, blue = (0, 0, 0) if role is None else COLOURS[role]
    opacity = 0.5 if role is None else 1.0
    values = {"r": red / 255, "g": green / 255, "b": blue / 255, "a": opacity}
    return encode_message(_MESSAGES["Color"], values)


def _mark_number(values: dict[str, Any]) -> int:
    number: int = values.get("mark_number", 0)
    if not 1 <= number <= MAX_DRAWINGS:
        raise ValueError(f"mark_number: {number} came, expected 1 to {MAX_DRAWINGS}")
    return number


def _role(values: dict[str, Any]) -> Role:
    text = _text(values, "role")
    role: Role | None = next((known for known in get_args(Role) if known == text), None)
    if role is None:
        raise ValueError(f"role: {text!r:.60} came, expected {', '.join(get_args(Role))}")
    return role


def _text(values: dict[str, Any], name: str) -> str:
    data = values.get(name, memoryview(b""))
    if len(data) > 4 * MAX_TEXT_CHARACTERS:
        raise ValueError(f"{name}: {len(data)} bytes, expected {4 * MAX_TEXT_CHARACTERS} at most")
    return str(data, "utf-8")
