"""Sans-I/O wire protocols: turn bytes into events and messages into bytes, for both roles.

For authors of dialects and protocols; :mod:`smartcam.protocols.messages` has the messages.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.protocols._base import (
        CodeMeaning,
        Dialect,
        Protocol,
        RawRequest,
        Role,
        Transport,
        Verdict,
    )
    from smartcam.protocols._bvs import BVS
    from smartcam.protocols._framed.dialect import FramedDialect, MessageRow, StatusBits, WireQuirk
    from smartcam.protocols._framed.framing import HeaderLayout
    from smartcam.protocols._framed.machine import Machine
    from smartcam.protocols._lines import LineCommand, LineDialect, LineMachine, LineReply, LineRow
    from smartcam.protocols._machine import Frame, LinkEnded, LinkFailed, LinkMachine, State
    from smartcam.protocols._ticketed import TicketedDialect

__all__ = [
    "BVS",
    "CodeMeaning",
    "Dialect",
    "Frame",
    "FramedDialect",
    "HeaderLayout",
    "LineCommand",
    "LineDialect",
    "LineMachine",
    "LineReply",
    "LineRow",
    "LinkEnded",
    "LinkFailed",
    "LinkMachine",
    "Machine",
    "MessageRow",
    "Protocol",
    "RawRequest",
    "Role",
    "State",
    "StatusBits",
    "TicketedDialect",
    "Transport",
    "Verdict",
    "WireQuirk",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_base": "CodeMeaning Dialect Protocol RawRequest Role Transport Verdict",
            "_bvs": "BVS",
            "_framed.dialect": "FramedDialect MessageRow StatusBits WireQuirk",
            "_framed.framing": "HeaderLayout",
            "_framed.machine": "Machine",
            "_lines": "LineCommand LineDialect LineMachine LineReply LineRow",
            "_machine": "Frame LinkEnded LinkFailed LinkMachine State",
            "_ticketed": "TicketedDialect",
        },
    )
