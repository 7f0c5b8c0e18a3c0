"""An attribution with what the inbox and the conversation do around it."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime

from smartcam import Status
from smartcam.attribution import (
    Attribution,
    Debt,
    PendingTrigger,
    Verdict,
)
from smartcam.interpretation import Interpretation
from smartcam.models import Result

READY = Status.RUNNING | Status.WAITING_FOR_TRIGGER
WORKING = Status.RUNNING
RAW = Interpretation("raw", lenient=False, y_down=False)
NOW = datetime(2024, 5, 1, tzinfo=UTC)
SOME = Result("press 4", 7, None, 1, None, NOW, None, b"", b"")

NO_LOOP = asyncio.new_event_loop()
NO_LOOP.close()  # the futures here are never awaited


class Line:
    """An attribution with what the inbox and the conversation do around it."""

    def __init__(self, *, ordered: bool = True) -> None:
        self.is_ordered = ordered
        self.at = Attribution()
        self.at.begin_session(ordered=ordered)
        self.status: Status | None = None

    @property
    def pending(self) -> PendingTrigger | None:
        return self.at.pending

    def trigger(self, number: int | None = None, wanted: int = 1) -> PendingTrigger:
        outcome: asyncio.Future[list[Result]] = asyncio.Future(loop=NO_LOOP)
        pending = PendingTrigger(outcome, RAW, False, 0.0, NOW, wanted=wanted, number=number)
        self.at.send(pending)
        return pending

    def hear(self, *statuses: Status) -> None:
        for status in statuses:
            self.at.on_status(self.status, status)
            self.status = status

    def result(self, number: int | None = None) -> Verdict:
        verdict = self.at.judge(number)
        pending = self.pending
        if verdict.fate == "triggered":
            assert pending is not None
            pending.results.append(SOME)
            if len(pending.results) == pending.wanted:
                self.at.done(pending)
                pending.outcome.set_result(pending.results)
        return verdict

    def leave(self) -> None:
        """The caller of the trigger has been woken."""
        self.at.pending = None

    def give_up(self, debt: Debt = "late") -> None:
        assert self.pending is not None
        self.at.give_up(self.pending, debt)
        self.leave()

    def reconnect(self) -> None:
        if self.pending is not None and not self.pending.outcome.done():
            self.give_up()
        self.leave()
        self.at.begin_session(ordered=self.is_ordered)
        self.status = None


def shown(*, ordered: bool = True) -> Line:
    """A camera that was seen to drop Waiting for Trigger at a trigger, and waits again."""
    line = Line(ordered=ordered)
    line.hear(READY)
    line.trigger()
    line.hear(WORKING)
    line.result()
    line.leave()
    line.hear(READY)
    return line
