"""A correlation with what the rest of the client does around it."""

from __future__ import annotations

from smartcam import Status
from smartcam._client.correlation import Correlation, Debt, Match, Progress, SentTrigger

READY = Status.RUNNING | Status.WAITING_FOR_TRIGGER
WORKING = Status.RUNNING


class Line:
    """A correlation with what the rest of the client does around it.

    Args:
        ordered: every status comes, and in order.
        fences: a trigger has a Query in front of it; default where it is ordered.
    """

    def __init__(self, *, ordered: bool = True, fences: bool | None = None) -> None:
        self.is_ordered = ordered
        self.fences = ordered if fences is None else fences
        self.at = Correlation(chance=0.5)
        self.at.begin_session(ordered=ordered)
        self.status: Status | None = None
        self.fence_open = False
        self.numbered = False  # a trigger had a number: a container's is read
        self.wants_query = False  # a container is held: have a Query answered
        self.cancelled = False  # the trigger's caller, who was not woken yet
        self.held: list[tuple[int | None, object]] = []
        self.judged: list[tuple[object, Match]] = []  # each container's fate, in order
        self.others = 0  # inspections that somebody else has triggered

    @property
    def pending(self) -> SentTrigger | None:
        return self.at.pending

    # -- what the client does

    def send(
        self,
        number: int | None = None,
        wanted: int = 1,
        *,
        fenced: bool | None = None,
        certain: bool = False,
        confirms: bool = False,
    ) -> SentTrigger:
        """Send a trigger; the fence in front of it is not answered yet."""
        self.fence_open = self.fences if fenced is None else fenced
        run = Progress(reached=not self.fence_open, confirmed=not confirms)
        pending = SentTrigger(wanted, number, certain, run)
        self.numbered = self.numbered or number is not None
        self.at.send(pending)
        return pending

    def trigger(self, number: int | None = None, wanted: int = 1) -> SentTrigger:
        """Send a trigger whose fence is answered at once."""
        pending = self.send(number, wanted)
        self.answer()
        return pending

    def leave(self) -> None:
        """The caller of the trigger has been woken."""
        self.look()
        self.at.leave()
        self.cancelled = False
        self.release()

    def cancel(self) -> None:
        """The trigger's caller is cancelled, which shows when it, or the client, looks."""
        self.cancelled = True

    def look(self) -> None:
        """The client looks at the trigger."""
        if self.cancelled and self.pending is not None and not self.pending.ended:
            self.pending.ended = True
            self.at.give_up(self.pending)

    def give_up(self, debt: Debt = "late") -> None:
        assert self.pending is not None
        self.at.give_up(self.pending, debt)
        self.leave()

    def reconnect(self) -> None:
        self.look()
        pending, self.fence_open = self.pending, False
        if pending is not None and not pending.ended:
            self.at.give_up(pending)
            pending.ended = True
        self.release()
        self.leave()
        self.at.begin_session(ordered=self.is_ordered)
        self.status = None

    # -- what comes

    def answer(self) -> None:
        """A Query is answered: the fence, or another one."""
        if self.fence_open:
            self.fence_open = False
            self.at.on_fence(int(self.status or 0))
        elif self.held:
            self.at.on_query_answer()
            self.release()

    def hear(self, *statuses: Status) -> None:
        for status in statuses:
            before, self.status = self.status, status
            self.others += self.at.on_status(None if before is None else int(before), int(status))
            if self.held:
                self.release()
            self._complete()

    def release(self) -> None:
        self.look()
        held, self.held = self.held, []
        pending = self.pending
        older = pending is None or pending.ended or pending.progress.begun
        for number, container in held:
            self.result(number, container, older=older)

    def result(
        self, number: int | None = None, container: object = None, *, older: bool = False
    ) -> Match:
        """A container comes; what is held gets its fate later."""
        self.look()
        pending = self.pending
        match = self.at.judge_older(number) if older else self.at.judge(number)
        if match.fate == "held":
            assert pending is not None
            if len(self.held) < pending.wanted:
                self.held.append((number, container))
                self.wants_query = True
                return match
            match = self.at.judge_older(number)
        self.judged.append((container, match))
        if match.fate == "triggered":
            assert pending is not None
            pending.came += 1
            self._complete()
        return match

    def _complete(self) -> None:
        self.look()
        pending = self.pending
        if pending is None or pending.ended or not pending.progress.confirmed:
            return
        if pending.came == pending.wanted:
            self.at.done(pending)
            pending.ended = True


def ready(*, ordered: bool = True) -> Line:
    """A camera that waits for a trigger; whether it shows one is not known."""
    line = Line(ordered=ordered)
    line.hear(READY)
    return line


def shown(*, ordered: bool = True) -> Line:
    """A camera that was seen to drop Waiting for SentTrigger at a trigger, and waits again."""
    line = ready(ordered=ordered)
    line.trigger()
    line.hear(WORKING)
    line.result()
    line.leave()
    line.hear(READY)
    line.judged.clear()
    return line
