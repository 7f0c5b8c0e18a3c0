"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import struct

from smartcam.exceptions import ConfigurationError
from tests.budgets.inputs import ros_types
from tests.budgets.parser import Make, Parser, fill, fill_text, grown
from tests.ros2.inside import Entity, parse_message

_DEFINITIONS: dict[str, Make] = {
    "fields": fill_text("int32 f{}\n"),
    "constants": fill_text("int32 C{}=1\n"),
    "comments": fill_text("#\n"),
    "a long name": fill_text("a", "int32 "),
    "a long type": fill_text("a", "", " a"),
    "a long type of a package": fill_text("a", "", "/! b"),
    "parts of a type": fill_text("a_", "", "a/B c"),
    "spaces": fill_text(" ", "int32 a", "b"),
    "a list as a default": fill_text("1,", "int32[] a [", "1]"),
    "brackets": fill_text("[", "int32[] a "),
    "a number of many digits": fill_text("9", "int32 A="),
    "a text": fill_text("\\'", "string A='"),
    "signs": fill_text("-", "int32 A=", "1"),
}


def _parts(parts: int = 0, texts: bytes = b"", count: int = 0) -> bytes:
    body = struct.pack("<I", parts) + bytes(parts)
    body += bytes(-len(body) % 4) + struct.pack("<I", count) + texts
    body += bytes(-len(body) % 4) + struct.pack("<I", 0) + struct.pack("<I", 0)
    return b"\0\1\0\0" + body


_CDR: dict[str, Make] = {
    "messages of nothing": lambda size: _parts(size),
    "texts of nothing": grown(lambda count: _parts(0, bytes(4 * count), count), 4),
    "texts": grown(lambda count: _parts(0, b"\4\0\0\0abc\0" * count, count), 8),
    "messages that are not there": lambda size: b"\0\1\0\0" + b"\xff" * size,
    "zeros": fill(b"\0", b"\0\1\0\0"),
}

_TOKENS: dict[str, Make] = {
    "parts": fill_text("a/", "@ros2_lv/"),
    "percent signs": fill_text("%", "@ros2_lv/0/z/0/0/NN/%/", "/a"),
    "digits": fill_text("9", "@ros2_lv/", "/z/0/0/NN/%/%/a"),
    "colons": fill_text(":", "@ros2_lv/0/z/0/0/MP/%/%/a/%b/c/d/"),
    "a long type": fill_text("a", "@ros2_lv/0/z/0/0/MP/%/%/a/%b/", "/d/::,5:,:,:,,"),
}


def _token(text: str) -> None:
    ros_types().message(Entity.parse(text).ros_type)


PARSERS: tuple[Parser, ...] = (
    Parser(
        "ROS: definitions of messages",
        lambda text: parse_message("a_b/msg/C", text),
        _DEFINITIONS,
        1 << 20,
        "the program's own texts",
        size=1000,
    ),
    Parser(
        "ROS: messages",
        lambda data: ros_types().message("a_b/msg/Parts").decode(data),
        _CDR,
        1 << 30,
        "Zenoh: a message",
        needs=("rosbags",),
    ),
    Parser(
        "ROS: tokens",
        _token,
        _TOKENS,
        1 << 16,
        "Zenoh: a key",
        size=1000,
        refuses=(ValueError, ConfigurationError),
        needs=("rosbags",),
    ),
)
