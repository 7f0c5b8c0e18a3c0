"""Describe by data how cameras behave, which depends on the dialect that they speak."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.protocols import messages as m
from smartcam.protocols._inside import ResultCode

if TYPE_CHECKING:
    from smartcam.emulator._bvs.quirks import Quirks
    from smartcam.protocols import FramedDialect


@dataclass(frozen=True, slots=True, kw_only=True)
class Behaviour:
    """The behaviour of a camera beyond its answers to requests."""

    coded: bool = False  # answers have a result code
    acknowledges: bool = False  # each request is answered with a result code
    answers_bad_messages: bool = False  # unknown and malformed requests are answered, too
    answers_disconnect: bool = False  # Disconnect is answered, too
    runs_always: bool = (
        False  # there is no run mode to enter or leave; not being Ready counts as BUSY
    )
    status_with_session: bool = True  # a status comes after Connect
    reports_changes: bool = True  # every change of the status is reported
    sticky_errors: bool = False  # error bits stay until they are reset

    @property
    def refusal_code(self) -> int:
        """Code of a switch that cannot be done."""
        return ResultCode.INSPECTION_ERROR if self.coded else 1


SMART_CAMERA = Behaviour()
"""The behaviour of a BVS SC, in every dialect but ``bid``."""


def behaviour_of(dialect: FramedDialect, quirks: Quirks) -> Behaviour:
    """Return the behaviour of a camera that speaks ``dialect``.

    Source: BVS ID guide p. 52, 58, 206, 210, 227 (published for ``bid``); the quirks name the
        sources of the other facts.
    """
    if not dialect.has(m.TriggerAnswer):
        return Behaviour(coded="code" in dialect.quirks)
    return Behaviour(
        coded=True,
        acknowledges=True,
        answers_bad_messages=quirks.bad_message == "code",
        answers_disconnect=quirks.disconnect_answer == "code",
        runs_always=True,
        status_with_session=False,
        reports_changes=quirks.push_status,
        sticky_errors=True,
    )
