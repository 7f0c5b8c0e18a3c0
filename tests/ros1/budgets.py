"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

import json

from smartcam.exceptions import SmartCamError
from tests.budgets.inputs import JSON, ros_types
from tests.budgets.parser import Make, Parser, fill_text
from tests.ros1.inside import from_json

_OPERATIONS: dict[str, Make] = {
    "messages": fill_text("{},".replace("{}", "{ }"), '{"parts":[', "{ }]}"),
    "texts": fill_text('"a",', '{"texts":[', '"a"]}'),
    "base64": fill_text("AAAA", '{"data":"', '"}'),
    "no base64": fill_text("A", '{"data":"', '!"}'),
    "numbers": fill_text("1,", '{"numbers":[', "1]}"),
    "unknown fields": fill_text('"k{}":1,', "{", '"z":1}'),
    "nested lists": JSON["nested lists"],
    "an array of fields": fill_text("[],", "[", "[]]"),
}

PARSERS: tuple[Parser, ...] = (
    Parser(
        "rosbridge: operations",
        lambda text: from_json(ros_types().message("a_b/msg/Parts"), json.loads(text)),
        _OPERATIONS,
        8 << 20,
        "ros1._link.MAX_MESSAGE_BYTES",
        refuses=(ValueError, RecursionError, SmartCamError),
        needs=("rosbags",),
    ),
)
