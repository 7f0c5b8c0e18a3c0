"""How cameras behave that speak different dialects, as data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam.protocols import messages as m
from smartcam.protocols.bvs import ResultCode

if TYPE_CHECKING:
    from smartcam.emulator.bvs.quirks import Quirks
    from smartcam.protocols.framed.dialect import FramedDialect

__all__ = ["SMART_CAMERA", "Manner", "manner_of"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Manner:
    """What a camera does beside answering what is asked.

    Attributes:
        coded: its answers tell a result code.
        acknowledges: every request is answered with one.
        tells_bad_messages: unknown and malformed requests are answered with one, too.
        answers_disconnect: so is Disconnect.
        runs_always: there is no run mode to enter or leave; not Ready is BUSY.
        status_with_session: a status comes after Connect.
        reports_changes: a status comes with every change of it.
        sticky_errors: error bits stay until they are reset.
    """

    coded: bool = False
    acknowledges: bool = False
    tells_bad_messages: bool = False
    answers_disconnect: bool = False
    runs_always: bool = False
    status_with_session: bool = True
    reports_changes: bool = True
    sticky_errors: bool = False

    @property
    def refused(self) -> int:
        """Code of a switch that cannot be done."""
        return ResultCode.INSPECTION_ERROR if self.coded else 1


SMART_CAMERA = Manner()
"""BVS SC, in every dialect but ``bid``."""


def manner_of(dialect: FramedDialect, quirks: Quirks) -> Manner:
    """Return how a camera behaves that speaks ``dialect``.

    Source: BVS ID guide p. 52, 58, 206, 210, 227 (published for ``bid``); the rest is told at the
    quirks.
    """
    if not dialect.has(m.TriggerAnswer):
        return Manner(coded="code" in dialect.quirks)
    return Manner(
        coded=True,
        acknowledges=True,
        tells_bad_messages=quirks.bad_message == "code",
        answers_disconnect=quirks.disconnect_answer == "code",
        runs_always=True,
        status_with_session=False,
        reports_changes=quirks.push_status,
        sticky_errors=True,
    )
