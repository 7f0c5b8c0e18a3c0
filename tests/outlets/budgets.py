"""Parsers of the room for :mod:`tests.budgets`, with the hardest inputs."""

from __future__ import annotations

from smartcam.outlets._mqtt import _command_fields
from tests.budgets.inputs import JSON
from tests.budgets.parser import Parser

PARSERS: tuple[Parser, ...] = (
    Parser(
        "MQTT: commands",
        lambda text: _command_fields(text.encode()),
        JSON,
        64 << 10,
        "outlets._mqtt.MAX_COMMAND_BYTES",
    ),
)
