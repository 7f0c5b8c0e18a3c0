"""Private names of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam.protocols._base import UNDOCUMENTED
from smartcam.protocols._framed import frame_age, framing, machine
from smartcam.protocols._framed.frame_age import (
    FRAME_TIME,
    HINT_TIME,
    MIN_BYTES_PER_SECOND,
    UnfinishedFrame,
)
from smartcam.protocols._framed.machine import Machine
from smartcam.protocols._insight.answers import MAX_IMAGE_BYTES, AnswerReader, CommandAnswer
from smartcam.protocols._insight.dialect import NATIVE, InSightDialect
from smartcam.protocols._insight.machine import (
    MAX_READ_BYTES,
    Command,
    InSightMachine,
    Piece,
    Reply,
)
from smartcam.protocols._insight.words import (
    MAX_LINE_BYTES,
    AnswerForm,
    Cell,
    command_reader,
    hex_lines,
)
