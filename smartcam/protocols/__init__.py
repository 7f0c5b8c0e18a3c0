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
    from smartcam.protocols._framed.framing import Frame, HeaderLayout
    from smartcam.protocols._framed.machine import (
        Counters,
        LinkEnded,
        LinkFailed,
        LinkMachine,
        Machine,
        State,
    )
    from smartcam.protocols._insight.dialect import INSIGHT
    from smartcam.protocols._lines import LineDialect, LineMachine, LineRow

__all__ = [
    "BVS",
    "INSIGHT",
    "CodeMeaning",
    "Counters",
    "Dialect",
    "Frame",
    "FramedDialect",
    "HeaderLayout",
    "LineDialect",
    "LineMachine",
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
    "Transport",
    "Verdict",
    "WireQuirk",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_base": "CodeMeaning Dialect Protocol RawRequest Role Spelled Transport Verdict",
            "_bvs": "BVS",
            "_framed.dialect": "FramedDialect MessageRow StatusBits WireQuirk",
            "_framed.framing": "Frame HeaderLayout",
            "_framed.machine": "Counters LinkEnded LinkFailed LinkMachine Machine State",
            "_insight.dialect": "INSIGHT",
            "_lines": "LineDialect LineMachine LineRow",
        },
    )
