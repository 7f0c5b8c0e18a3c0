"""The BVS protocol of Balluff smart cameras.

Facts with their sources stand in ``docs/protocol.md``. Grades: *published* in a manual of this
product or a sibling, *derived* from published facts, *inferred*.
"""

from __future__ import annotations

import enum

from smartcam.protocols import messages as m
from smartcam.protocols.base import Dialect, MessageRow, Protocol, Transport
from smartcam.protocols.framing import HeaderLayout

__all__ = ["BVS", "DEFAULT_PORT", "HANDBOOK", "MESSAGES", "THESIS", "MessageId"]

DEFAULT_PORT = 36701
"""Port of the camera in all documents (SC manual p. 28: published)."""


class MessageId(enum.IntEnum):
    """Message ids; an answer has the id of its request."""

    CONNECT = 0x01
    DISCONNECT = 0x02
    STATUS = 0x12
    RESULT_CONTAINER = 0x20
    QUERY_APPLICATION = 0x30
    SWITCH_APPLICATION = 0x31
    GET_CLOCK = 0x32
    SET_CLOCK = 0x33
    SET_INPUT_DATA = 0x34
    SET_SEQUENCE_NUMBER = 0x35
    TRIGGER = 0x40
    START = 0x41
    STOP = 0x42
    REBOOT = 0x43


_ID = MessageId

MESSAGES = (
    MessageRow(_ID.CONNECT, m.Connect, "Connect", "SC manual p. 29, published"),
    MessageRow(_ID.CONNECT, m.ConnectAnswer, "Connect response", "SC manual p. 29, published"),
    MessageRow(_ID.DISCONNECT, m.Disconnect, "Disconnect", "SC manual p. 28, 29, published"),
    MessageRow(_ID.STATUS, m.StatusReport, "Status", "SC manual p. 30, 33, published"),
    MessageRow(
        _ID.RESULT_CONTAINER,
        m.ResultContainer,
        "Result container",
        "SC manual p. 33 (the id) and mvBlueGEMINI manual p. 27 (the rest), published",
    ),
    MessageRow(_ID.QUERY_APPLICATION, m.Query, "Query application", "SC manual p. 34, published"),
    MessageRow(
        _ID.QUERY_APPLICATION, m.QueryAnswer, "Active application", "SC manual p. 34, published"
    ),
    MessageRow(
        _ID.SWITCH_APPLICATION,
        m.SwitchApplication,
        "Switch application",
        "SC manual p. 34, published",
    ),
    MessageRow(
        _ID.SWITCH_APPLICATION, m.SwitchAnswer, "Switch response", "SC manual p. 34, published"
    ),
    MessageRow(_ID.GET_CLOCK, m.GetClock, "Get the time stamp", "SC manual p. 34, published"),
    MessageRow(_ID.GET_CLOCK, m.ClockAnswer, "Time stamp", "mvBlueGEMINI manual p. 29, published"),
    MessageRow(
        _ID.SET_CLOCK, m.SetClock, "Set time stamp", "mvBlueGEMINI manual p. 29, 30, published"
    ),
    MessageRow(
        _ID.SET_INPUT_DATA,
        m.SetInput,
        "Setting input data",
        "SC manual p. 29 (the name), mvBlueGEMINI manual p. 30 (the body), published",
    ),
    MessageRow(
        _ID.SET_SEQUENCE_NUMBER,
        m.SetSequenceNumber,
        "Set sequence number",
        "SC manual p. 28 (the name), newest SC manual p. 48 (four bytes), inferred",
    ),
    MessageRow(_ID.TRIGGER, m.Trigger, "Trigger application", "SC manual p. 29, published"),
    MessageRow(_ID.START, m.Start, "Start application", "SC manual p. 29, published"),
    MessageRow(_ID.STOP, m.Stop, "Stop application", "SC manual p. 29, published"),
    MessageRow(
        _ID.REBOOT,
        m.Reboot,
        "Trigger reset",
        "SC manual p. 29 (the name), mvBlueGEMINI manual p. 31 (it restarts), published",
    ),
)
"""Every message of the dialects with a magic number; the one place where ids and bodies stand."""

HANDBOOK = Dialect(
    name="handbook",
    header=HeaderLayout(magic=bytes.fromhex("50535642"), code="I", order="length, id"),
    word="I",
    table=MESSAGES,
    about="magic 50 53 56 42, 32 bit, the length counts what follows the message id",
    source="SC manual p. 28, 29 and vector A-1 (mvBlueGEMINI manual p. 30), published",
)

THESIS = Dialect(
    name="thesis",
    header=HeaderLayout(
        magic=bytes.fromhex("42565350"), code="I", order="length, id", length_includes=4
    ),
    word="I",
    table=MESSAGES,
    about="magic 42 56 53 50, 32 bit, the length counts the message id too",
    source="thesis section 3.1.1, written with a BVS002C at hand, published",
)

BVS = Protocol(
    name="bvs",
    schemes={"bvs": Transport.TCP, "bvs+udp": Transport.UDP},
    default_port=DEFAULT_PORT,
    models=("BVS002C",),
    # The manuals come first: three documents and a published vector against one description.
    dialects={dialect.name: dialect for dialect in (HANDBOOK, THESIS)},
)
"""What the entry point ``bvs`` gives. ``b16`` and ``bid`` are to be two more rows of ``dialects``:
a header without magic, ``word="H"``, and a table of their own where bodies differ."""
