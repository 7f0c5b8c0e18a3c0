"""Helpers of the tests of types: messages with values drawn, and texts for other tools."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam.ros2._inside import MessageField
from tests.ros2.inside import INTEGERS, NUMBERS, stored_fields

if TYPE_CHECKING:
    import random

    from smartcam.ros2 import RosTypes
    from smartcam.ros2._inside import MessageType

ASCII = ("", "a", "camera", "x" * 17)
WORDS = (*ASCII, "größe", "部品")
ORDER = (
    *("bool", "byte", "char", "float32", "float64"),
    *(f"{sign}int{bits}" for bits in (8, 16, 32, 64) for sign in ("", "u")),
)
"""The basic types of one size, as ``test_msgs`` have them."""

SHAPES = {
    "Arrays": "3",
    "BoundedSequences": "<=3",
    "BoundedPlainSequences": "<=3",
    "UnboundedSequences": "",
}


def forget_stores() -> None:
    """Have the messages of ROS read from rosbags anew."""
    stored_fields.cache_clear()


def each(suffix: str, shape: str = "", kinds: tuple[str, ...] = ORDER) -> str:
    """Return a field of each type."""
    return "".join(f"{kind}{shape} {kind}{suffix}\n" for kind in kinds)


def add_test_msgs(types: RosTypes) -> list[str]:
    """Add ``test_msgs``, with which ROS tests its middlewares, and one; return their names."""
    texts = {
        "Empty": "",
        "Constants": "uint8 UINT8_CONST=200\nstring S='a # b'\n",
        "BasicTypes": each("_value"),
        "Defaults": each("_value"),
        "Strings": "".join(
            f"{kind}string_value{end}\n"
            for kind in ("string ", "string<=22 bounded_")
            for end in ("", *(f"_default{number}" for number in range(1, 6)))
        ),
        "Ours": "string[] words\nstring<=9[2] short\nEmpty[<=2] none\nStrings text\nint64 last\n",
    }
    for name, shape in SHAPES.items():
        kinds = ORDER if "Plain" in name else (*ORDER, "string")
        nested = "".join(
            f"{kind}[{shape}] {field}_values\n"
            for kind, field in (
                ("BasicTypes", "basic_types"),
                ("Constants", "constants"),
                ("Defaults", "defaults"),
            )
        )
        values = each("_values", f"[{shape}]", kinds)
        defaults = each("_values_default", f"[{shape}]", kinds)
        texts[name] = f"{values}{nested}{defaults}int32 alignment_check\n"
    for name, text in texts.items():
        types.add(f"test_msgs/msg/{name}", text)
    return [f"test_msgs/msg/{name}" for name in texts]


def drawn(
    kind: MessageType, draw: random.Random, longest: int = 4, words: tuple[str, ...] = WORDS
) -> Any:
    """Return a message with values drawn."""

    def value(field: MessageField) -> Any:
        if not field.shape:
            return one(field)
        most = min(field.size or longest, longest)
        count = field.size if field.shape == "array" else draw.randint(0, most)
        values = [one(field) for _ in range(count)]
        return np.array(values, NUMBERS[field.type]) if field.type in NUMBERS else values

    def one(field: MessageField) -> Any:
        if field.nested:
            return drawn(kind.nested[field.type], draw, longest, words)
        if field.type == "string":
            return draw.choice([word for word in words if not 0 < field.limit < len(word.encode())])
        if field.type == "bool":
            return draw.random() < 0.5
        if field.type == "byte":
            return draw.randint(0, 127)  # rosbags takes it for signed
        if field.type in INTEGERS:
            limits = np.iinfo(NUMBERS[field.type])
            return draw.choice((int(limits.min), 0, 1, int(limits.max), draw.randint(0, 100)))
        number = draw.choice((0.0, -1.5, 1e-9, 1e30, float("inf"), draw.gauss(0, 1)))
        return float(np.float32(number)) if field.type == "float32" else number

    return kind.new(**{field.attribute: value(field) for field in kind.fields})
