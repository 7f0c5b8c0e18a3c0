"""Define the BVS protocol of Balluff smart cameras: its dialects, messages and result codes.

Facts with their sources stand in ``docs/protocol.md``. Grades: *published* in a manual of this
product or a sibling, *derived* from published facts, *inferred*.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from smartcam.models import Status
from smartcam.protocols import messages as m
from smartcam.protocols._base import CodeMeaning, Protocol, Transport, Verdict
from smartcam.protocols._framed.dialect import (
    SHOWS_TRIGGERS,
    FramedDialect,
    MessageRow,
    StatusBits,
    WireQuirk,
)
from smartcam.protocols._framed.framing import HeaderLayout
from smartcam.protocols._framed.machine import Machine

if TYPE_CHECKING:
    from collections.abc import Mapping

DEFAULT_PORT = 36701
"""Port of the camera in all documents (SC manual p. 28: published)."""


class MessageId(enum.IntEnum):
    """Message ids; an answer has the id of its request."""

    CONNECT = 0x01
    DISCONNECT = 0x02
    STATUS = 0x12
    RESET_ERRORS = 0x16
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
    MessageRow(
        _ID.CONNECT,
        m.ConnectAnswer,
        "Connect response",
        "SC manual p. 29, published",
        omits=("code",),
    ),
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
        _ID.QUERY_APPLICATION,
        m.QueryAnswer,
        "Active application",
        "SC manual p. 34, published",
        omits=("code",),
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
    MessageRow(
        _ID.GET_CLOCK,
        m.ClockAnswer,
        "Time stamp",
        "mvBlueGEMINI manual p. 29, published",
        omits=("code",),
    ),
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
"""Every message of the dialects with a magic number: the only place with their ids and bodies."""

HANDBOOK = FramedDialect(
    name="handbook",
    header=HeaderLayout(magic=bytes.fromhex("50535642"), code="I", order="length, id"),
    word="I",
    table=MESSAGES,
    about="magic 50 53 56 42, 32 bit, the length counts the bytes after the message id",
    source="SC manual p. 28, 29 and vector A-1 (mvBlueGEMINI manual p. 30), published",
)

THESIS = FramedDialect(
    name="thesis",
    header=HeaderLayout(
        magic=bytes.fromhex("42565350"), code="I", order="length, id", length_includes=4
    ),
    word="I",
    table=MESSAGES,
    about="magic 42 56 53 50, 32 bit, the length counts the message id too",
    source="thesis section 3.1.1, written with a BVS002C at hand, published",
)

# ---------------------------------------------------------------------- 16 bit

_NARROWED = "the bodies of the dialects with 32 bits, narrowed, inferred"
_KB_SEQUENCE = "Balluff knowledge base, sequence of commands, published"
_KB_STRUCTURE = "Balluff knowledge base, message structure, published"

B16_MESSAGES = (
    MessageRow(_ID.CONNECT, m.Connect, "Connect", _KB_SEQUENCE),
    MessageRow(_ID.CONNECT, m.ConnectAnswer, "Connect response", _NARROWED, omits=("code",)),
    MessageRow(_ID.DISCONNECT, m.Disconnect, "Disconnect", _KB_SEQUENCE),
    MessageRow(_ID.STATUS, m.StatusReport, "Status", _NARROWED, omits=("endian",)),
    MessageRow(
        _ID.RESULT_CONTAINER,
        m.ResultContainer,
        "Result container",
        "newest SC manual p. 43; Balluff knowledge base, result container, published",
    ),
    MessageRow(_ID.QUERY_APPLICATION, m.Query, "Get inspection program id", _KB_STRUCTURE),
    MessageRow(
        _ID.QUERY_APPLICATION, m.QueryAnswer, "Inspection program id", _NARROWED, omits=("code",)
    ),
    MessageRow(
        _ID.SWITCH_APPLICATION, m.SwitchApplication, "Change inspection program", _KB_SEQUENCE
    ),
    MessageRow(_ID.SWITCH_APPLICATION, m.SwitchAnswer, "Change response", _NARROWED),
    MessageRow(_ID.GET_CLOCK, m.GetClock, "Get timestamp", _KB_STRUCTURE),
    MessageRow(_ID.GET_CLOCK, m.ClockAnswer, "Timestamp", _NARROWED, omits=("code",)),
    MessageRow(_ID.SET_CLOCK, m.SetClock, "Set timestamp", _NARROWED),
    MessageRow(_ID.SET_INPUT_DATA, m.SetInput, "Set input data", _KB_STRUCTURE),
    MessageRow(
        _ID.SET_SEQUENCE_NUMBER,
        m.SetSequenceNumber,
        "Set sequence number",
        "newest SC manual p. 48; the order of its bytes is doubtful, published",
    ),
    MessageRow(_ID.TRIGGER, m.Trigger, "Trigger", "newest SC manual p. 48; " + _KB_SEQUENCE),
    MessageRow(_ID.START, m.Start, "Start", _KB_SEQUENCE),
    MessageRow(_ID.STOP, m.Stop, "Stop", _KB_SEQUENCE),
    MessageRow(
        _ID.REBOOT,
        m.Reboot,
        "Restart camera",
        "Balluff knowledge base, message structure (the name only), inferred",
    ),
)
"""Every message of ``b16``."""


class ResultCode(enum.IntEnum):
    """The first word of BVS ID's answers.

    Source: BVS ID guide p. 52 (published).
    """

    OK = 0x00
    OK_INSPECTION_ID = 0x02
    OK_DATE_TIME = 0x06
    ERROR = 0x10
    INVALID_COMMAND = 0x13
    BUSY = 0x16
    INSPECTION_ERROR = 0x1A


CODES: Mapping[int, CodeMeaning] = {
    ResultCode.OK: CodeMeaning("OK: executed", Verdict.DONE),
    ResultCode.OK_INSPECTION_ID: CodeMeaning("OK Inspection ID", Verdict.DONE),
    ResultCode.OK_DATE_TIME: CodeMeaning("OK Date Time", Verdict.DONE),
    ResultCode.ERROR: CodeMeaning(
        "NOK Error: transfer or execution failed, e.g. wrong format or length", Verdict.REFUSED
    ),
    ResultCode.INVALID_COMMAND: CodeMeaning(
        "NOK Invalid Command: unknown command code", Verdict.UNKNOWN
    ),
    ResultCode.BUSY: CodeMeaning("NOK Busy: Ready status is not set", Verdict.BUSY),
    ResultCode.INSPECTION_ERROR: CodeMeaning(
        "NOK Inspection Error: program change failed", Verdict.REFUSED
    ),
}
"""Meanings of BVS ID's result codes (BVS ID guide p. 52, published)."""

_16_BIT = HeaderLayout(code="H", order="id, length")
_CODE_GUESS = "BVS ID's answers carried over to BVS SC, inferred"

B16 = FramedDialect(
    name="b16",
    header=_16_BIT,
    word="H",
    table=B16_MESSAGES,
    about="16 bit, no magic number, the message id first",
    source="newest SC manual p. 40, 43, 48; Balluff knowledge base, published",
    wire_quirks={
        "code": WireQuirk(
            about="answers begin with a result code, as those of bid do",
            source=_CODE_GUESS,
            rows=(
                MessageRow(_ID.CONNECT, m.ConnectAnswer, "Connect response", _CODE_GUESS),
                MessageRow(
                    _ID.QUERY_APPLICATION, m.QueryAnswer, "Inspection program id", _CODE_GUESS
                ),
                MessageRow(_ID.GET_CLOCK, m.ClockAnswer, "Timestamp", _CODE_GUESS),
            ),
            codes=CODES,
        ),
        "no_id": WireQuirk(
            about="result containers do not begin with the program's id",
            source="example of the newest SC manual p. 43, against its table, published",
            rows=(
                MessageRow(
                    _ID.RESULT_CONTAINER,
                    m.ResultContainer,
                    "Result container",
                    "newest SC manual p. 43 (its example), published",
                    omits=("application",),
                ),
            ),
        ),
        "big_endian_number": WireQuirk(
            about="the sequence number is big endian",
            source="example of the newest SC manual p. 48, against its general rule, published",
            rows=(
                MessageRow(
                    _ID.SET_SEQUENCE_NUMBER,
                    m.SetSequenceNumber,
                    "Set sequence number",
                    "newest SC manual p. 48 (its example), published",
                    byte_order=">",
                ),
            ),
        ),
    },
)

BID_MESSAGES = (
    MessageRow(_ID.CONNECT, m.Connect, "Connect", "BVS ID guide p. 226, published"),
    MessageRow(_ID.CONNECT, m.ConnectAnswer, "Connect response", "BVS ID guide p. 226, published"),
    MessageRow(_ID.DISCONNECT, m.Disconnect, "Disconnect", "BVS ID guide p. 227, published"),
    MessageRow(
        _ID.DISCONNECT,
        m.DisconnectAnswer,
        "Disconnect response",
        "BVS ID guide (German) p. 58, published",
    ),
    MessageRow(_ID.STATUS, m.GetStatus, "Get status", "BVS ID guide p. 210, published"),
    MessageRow(
        _ID.STATUS, m.StatusReport, "Status", "BVS ID guide p. 210, published", omits=("endian",)
    ),
    MessageRow(_ID.RESET_ERRORS, m.ResetErrors, "Reset errors", "BVS ID guide p. 227, published"),
    MessageRow(
        _ID.RESET_ERRORS,
        m.ResetErrorsAnswer,
        "Reset errors response",
        "BVS ID guide p. 227, published",
    ),
    MessageRow(
        _ID.RESULT_CONTAINER,
        m.ResultContainer,
        "Result container",
        "BVS ID guide p. 213, published",
    ),
    MessageRow(
        _ID.QUERY_APPLICATION, m.Query, "Get inspection id", "BVS ID guide p. 216, published"
    ),
    MessageRow(
        _ID.QUERY_APPLICATION, m.QueryAnswer, "Inspection id", "BVS ID guide p. 216, published"
    ),
    MessageRow(
        _ID.SWITCH_APPLICATION,
        m.SwitchApplication,
        "Set inspection id",
        "BVS ID guide p. 229, published",
    ),
    MessageRow(
        _ID.SWITCH_APPLICATION,
        m.SwitchAnswer,
        "Set inspection id response",
        "BVS ID guide p. 229, published",
    ),
    MessageRow(_ID.GET_CLOCK, m.GetClock, "Get date/time", "BVS ID guide p. 218, published"),
    MessageRow(_ID.GET_CLOCK, m.ClockAnswer, "Date/time", "BVS ID guide p. 218, published"),
    MessageRow(_ID.SET_CLOCK, m.SetClock, "Set date/time", "BVS ID guide p. 231, published"),
    MessageRow(
        _ID.SET_CLOCK, m.SetClockAnswer, "Set date/time response", "BVS ID guide p. 231, published"
    ),
    MessageRow(
        _ID.SET_INPUT_DATA, m.SetInput, "Set reference value", "BVS ID guide p. 220, 232, published"
    ),
    MessageRow(
        _ID.SET_INPUT_DATA,
        m.SetInputAnswer,
        "Set reference value response",
        "BVS ID guide p. 220, 232, published",
    ),
    MessageRow(_ID.TRIGGER, m.Trigger, "Trigger inspection", "BVS ID guide p. 221, published"),
    MessageRow(_ID.TRIGGER, m.TriggerAnswer, "Trigger response", "BVS ID guide p. 221, published"),
)
"""Every message of ``bid``."""

BID = FramedDialect(
    name="bid",
    header=_16_BIT,
    word="H",
    table=BID_MESSAGES,
    about="BVS ID and BVS VS: as b16, every request is answered with a result code",
    source="BVS ID guide p. 52, 206 to 232, published",
    status_bits=StatusBits(
        # The examples show Ready as bit 5 where p. 216 says "4th bit": the bytes are trusted.
        # Where the other error bits are is unknown, so they have no meaning here.
        named={
            0x0001: Status.WAITING_FOR_TRIGGER,  # p. 210, published
            0x0100: Status.OVERTRIGGERED,  # Trigger Error; from the example on p. 227, derived
        },
        inverted={0x0020: Status.BUSY},  # Ready; from the example on p. 227, derived
        always=Status.RUNNING,  # the dialect has neither start nor stop
        unnamed_shift=32,
    ),
    codes=CODES,
    unasked_status=False,
)


class _Bvs(Protocol):
    """A protocol whose dialects are framed."""

    dialects: Mapping[str, FramedDialect]


# as long as BID and B16 with the quirk "code" both fit, traces show BID's frames: it is published
_16_BIT_GROUP = (B16, BID, B16.with_quirks(["code"]))

BVS: _Bvs = _Bvs(
    name="bvs",
    schemes={"bvs": Transport.TCP, "bvs+udp": Transport.UDP},
    default_port=DEFAULT_PORT,
    models=("BVS002C",),
    dialects={dialect.name: dialect for dialect in (HANDBOOK, THESIS, B16, BID)},
    machine=Machine,
    parameters={
        SHOWS_TRIGGERS: (
            "`no`: the camera's status does not show each trigger that it accepts. Then the client "
            "takes a result without proof that it belongs to this trigger: it may be a late result "
            "or another client's"
        ),
    },
    detection={
        # The manuals show the dialects with a magic number over UDP only, and for TCP nothing but
        # 16 bits. Three documents and a published test vector support the framing of the dialect
        # handbook, one description that of the dialect thesis.
        Transport.TCP: (_16_BIT_GROUP, (HANDBOOK,), (THESIS,)),
        Transport.UDP: ((HANDBOOK,), _16_BIT_GROUP, (THESIS,)),
    },
    emulator="smartcam.emulator._camera:EmulatedCamera",
    greeting=b"",  # the camera sends nothing before Connect (SC manual p. 28: published)
)
"""The protocol that the entry point ``bvs`` gives."""
