"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.protocols._base import POLICIES, Policy, ReadableFrame, load_protocol
    from smartcam.protocols._bvs import DEFAULT_PORT, HANDBOOK, MessageId, ResultCode
    from smartcam.protocols._framed.constructs import view_fields
    from smartcam.protocols._framed.dialect import SHOWS_TRIGGERS
    from smartcam.protocols._framed.framing import DEFAULT_MAX_LENGTH, Framer
    from smartcam.protocols._insight import words
    from smartcam.protocols._insight.dialect import INSIGHT
    from smartcam.protocols._insight.machine import ONLINE
    from smartcam.protocols._insight.words import TRIGGER_EVENT, StatusCode
    from smartcam.protocols._lines import refuse_line
    from smartcam.protocols._machine import Counters, Event, ResultBurst, send_each

__all__ = [
    "DEFAULT_MAX_LENGTH",
    "DEFAULT_PORT",
    "HANDBOOK",
    "INSIGHT",
    "ONLINE",
    "POLICIES",
    "SHOWS_TRIGGERS",
    "TRIGGER_EVENT",
    "Counters",
    "Event",
    "Framer",
    "MessageId",
    "Policy",
    "ReadableFrame",
    "ResultBurst",
    "ResultCode",
    "StatusCode",
    "load_protocol",
    "refuse_line",
    "send_each",
    "view_fields",
    "words",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_lines": "refuse_line",
            "_insight.dialect": "INSIGHT",
            "_base": "ReadableFrame POLICIES Policy load_protocol",
            "_bvs": "DEFAULT_PORT HANDBOOK MessageId ResultCode",
            "_framed.constructs": "view_fields",
            "_framed.dialect": "SHOWS_TRIGGERS",
            "_framed.framing": "DEFAULT_MAX_LENGTH Framer",
            "_insight.": "words",
            "_insight.machine": "ONLINE",
            "_insight.words": "TRIGGER_EVENT StatusCode",
            "_machine": "Counters Event ResultBurst send_each",
        },
    )
