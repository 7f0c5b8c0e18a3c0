"""Sans-I/O wire protocols: bytes to events and back, for both roles.

For authors of dialects and protocols; :mod:`smartcam.protocols.messages` has the words.
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
        Spelled,
        Transport,
        Verdict,
    )
    from smartcam.protocols._bvs import BVS
    from smartcam.protocols._framed.dialect import FramedDialect, MessageRow, StatusBits, WireQuirk
    from smartcam.protocols._framed.framing import HeaderLayout
    from smartcam.protocols._framed.machine import Machine
    from smartcam.protocols._insight.dialect import INSIGHT
    from smartcam.protocols._lines import (
        LineCommand,
        LineDialect,
        LineMachine,
        LineReply,
        LineRow,
        unread,
    )
    from smartcam.protocols._machine import (
        Counters,
        Frame,
        LinkEnded,
        LinkFailed,
        LinkMachine,
        State,
    )
    from smartcam.protocols._ticketed import TicketedDialect

__all__ = [
    "BVS",
    "INSIGHT",
    "CodeMeaning",
    "Counters",
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
    "Spelled",
    "State",
    "StatusBits",
    "TicketedDialect",
    "Transport",
    "Verdict",
    "WireQuirk",
    "unread",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_base": "CodeMeaning Dialect Protocol RawRequest Role Spelled Transport Verdict",
            "_bvs": "BVS",
            "_framed.dialect": "FramedDialect MessageRow StatusBits WireQuirk",
            "_framed.framing": "HeaderLayout",
            "_framed.machine": "Machine",
            "_insight.dialect": "INSIGHT",
            "_lines": "LineCommand LineDialect LineMachine LineReply LineRow unread",
            "_machine": "Counters Frame LinkEnded LinkFailed LinkMachine State",
            "_ticketed": "TicketedDialect",
        },
    )
