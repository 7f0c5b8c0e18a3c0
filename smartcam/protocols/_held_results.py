"""Hold results without an application until the camera has named the application.

The client asks the camera for its application after each result, and before each trigger. A result
is reported when the question after it is answered. If all answers around the result name one
application, the result is assigned to it; otherwise the result gets an error text, and counts for
no application. All events after a held result wait with it, so that events keep their order.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from smartcam.exceptions import FrameError
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from smartcam.protocols._machine import Event

MAX_HELD = 4096
"""Largest number of events that wait for a result's application; the camera answers within a
round trip."""

MAX_HELD_BYTES = 1 << 26
"""Largest number of bytes of the waiting results: four pictures of 16 MB."""


@dataclass(slots=True, eq=False)
class _Held:
    """Messages of one answer or one text line, with a result among them.

    Attributes:
        messages: the messages to report.
        size: bytes of the results.
        question: number of the first question after the result.
        before_trigger: number of the question before the trigger, 0 for none.
        seen: applications that the camera has named around the result.
    """

    messages: tuple[Event, ...]
    size: int
    question: int
    before_trigger: int
    seen: set[int]


class HeldResults:
    """The events of one link, in order; those from the first unassigned result on wait."""

    def __init__(self) -> None:
        self._ready: list[Event] = []
        self._waiting: deque[Event | _Held] = deque()
        self._size = 0
        self._last = 0  # number of the last question
        self._unanswered: set[int] = set()  # numbers of questions without an answer
        self._named: int | None = None  # the application that the camera named last
        self._before_trigger = 0  # number of the question before the last trigger
        # applications named since that question; None after the trigger's answer
        self._applications_seen: set[int] | None = None

    def ask(self, *, trigger: bool = False) -> int:
        """Return the number of a new question, which may stand before a trigger."""
        self._last += 1
        self._unanswered.add(self._last)
        if trigger:
            self._before_trigger, self._applications_seen = self._last, set()
        return self._last

    def add(self, messages: tuple[Event, ...], *, answers_trigger: bool) -> bool:
        """Add messages; return True if a result among them needs a question now.

        Raises:
            FrameError: too many events wait for an answer.
        """
        results = [message for message in messages if isinstance(message, m.ResultContainer)]
        seen = set[int]() if self._named is None else {self._named}
        if answers_trigger and self._applications_seen is not None:
            seen, self._applications_seen = self._applications_seen, None
        if results:
            size = sum(len(result.data) for result in results)
            self._waiting.append(_Held(messages, size, self._last + 1, self._before_trigger, seen))
            self._size += size
        elif self._waiting:
            self._waiting.extend(messages)
        else:
            self._ready += messages
        if len(self._waiting) > MAX_HELD or self._size > MAX_HELD_BYTES:
            raise FrameError(
                f"{len(self._waiting)} events came, with results of {self._size} bytes, and no "
                "answer to the question which application they belong to"
            )
        return bool(results) and not self._unanswered

    def pass_on(self, events: tuple[Event, ...]) -> None:
        """Report events at once: the link asks for no application, or has ended."""
        self._ready += events

    def application_named(self, application: int, question: int = 0) -> bool:
        """Note the application that the camera names as active now.

        Args:
            application: id of the application.
            question: number of the question that the message answers, 0 for none.

        Returns:
            True if a question is needed now for a result that came since the last question.
        """
        self._named = application
        self._unanswered.discard(question)
        held = [item for item in self._waiting if isinstance(item, _Held)]
        for seen in (self._applications_seen, *(item.seen for item in held)):
            if seen is not None:
                seen.add(application)
        self._release()
        return bool(self._waiting) and held[-1].question > self._last and not self._unanswered

    def take(self) -> list[Event]:
        """Return the events that can be reported, in order; the caller owns the list."""
        ready, self._ready = self._ready, []
        return ready

    def end(self) -> None:
        """Note that no more answers come: the waiting results are reported with a fault."""
        self._release(ended=True)

    def _release(self, *, ended: bool = False) -> None:
        while self._waiting:
            first = self._waiting[0]
            if isinstance(first, _Held):
                waits = first.question > self._last or not self._unanswered.isdisjoint(
                    {first.before_trigger, first.question}
                )
                if waits and not ended:
                    return
                self._ready += _with_application(first, self._named, unknown=waits)
                self._size -= first.size
            else:
                self._ready.append(first)
            self._waiting.popleft()


def _with_application(held: _Held, named: int | None, *, unknown: bool) -> tuple[Event, ...]:
    """Return messages whose results have their application, or a fault."""
    fault = None
    if unknown or named is None:
        fault = "the link ended before the camera said of which application the result is"
    elif len(held.seen) > 1:
        which = ", ".join(map(str, sorted(held.seen)))
        fault = f"the application changed while the result was made: it may be of any of {which}"
    application = m.UNNAMED_APPLICATION if named is None else named
    return tuple(
        replace(message, application=application, fault=message.fault or fault)
        if isinstance(message, m.ResultContainer)
        else message
        for message in held.messages
    )
