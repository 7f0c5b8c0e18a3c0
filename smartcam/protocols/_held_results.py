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
        question_after: number of the first question after the result.
        question_before: number of the question before the trigger, 0 for none.
        applications: applications that the camera has named around the result.
    """

    messages: tuple[Event, ...]
    size: int
    question_after: int
    question_before: int
    applications: set[int]


class HeldResults:
    """The events of one link, in order; events after an unassigned result wait with it."""

    def __init__(self) -> None:
        self._ready: list[Event] = []
        self._waiting: deque[Event | _Held] = deque()
        self._held_size = 0
        self._last_question = 0  # number of the last question
        self._unanswered: set[int] = set()  # numbers of questions without an answer
        self._last_application: int | None = None  # the application that the camera named last
        self._question_before = 0  # number of the question before the last trigger
        # applications named since that question; None after the trigger's answer
        self._applications_since: set[int] | None = None

    def add_question(self, *, trigger: bool = False) -> int:
        """Record a new question, and return its number; ``trigger``: a trigger follows it."""
        self._last_question += 1
        self._unanswered.add(self._last_question)
        if trigger:
            self._question_before, self._applications_since = self._last_question, set()
        return self._last_question

    def add(self, messages: tuple[Event, ...], *, answers_trigger: bool) -> bool:
        """Add messages; return True if a result among them needs a question now.

        Raises:
            FrameError: too many events wait for an answer.
        """
        results = [message for message in messages if isinstance(message, m.ResultContainer)]
        applications = set[int]() if self._last_application is None else {self._last_application}
        if answers_trigger and self._applications_since is not None:
            applications, self._applications_since = self._applications_since, None
        if results:
            size = sum(len(result.data) for result in results)
            self._waiting.append(
                _Held(messages, size, self._last_question + 1, self._question_before, applications)
            )
            self._held_size += size
        elif self._waiting:
            self._waiting.extend(messages)
        else:
            self._ready += messages
        if len(self._waiting) > MAX_HELD or self._held_size > MAX_HELD_BYTES:
            raise FrameError(
                f"{len(self._waiting)} events came, with results of {self._held_size} bytes, and "
                "no answer to the question which application they belong to"
            )
        return bool(results) and not self._unanswered

    def add_ready(self, events: tuple[Event, ...]) -> None:
        """Report events at once: the link asks for no application, or has ended."""
        self._ready += events

    def note_application(self, application: int, question: int = 0) -> bool:
        """Record the application that the camera names as active now.

        Args:
            application: id of the application.
            question: number of the question that the message answers, 0 for none.

        Returns:
            True if a question is needed now for a result that came since the last question.
        """
        self._last_application = application
        self._unanswered.discard(question)
        held = [item for item in self._waiting if isinstance(item, _Held)]
        for applications in (self._applications_since, *(item.applications for item in held)):
            if applications is not None:
                applications.add(application)
        self._release()
        return (
            bool(self._waiting)
            and held[-1].question_after > self._last_question
            and not self._unanswered
        )

    def take_ready(self) -> list[Event]:
        """Return the events that can be reported, in order; the caller owns the list."""
        ready, self._ready = self._ready, []
        return ready

    def end_link(self) -> None:
        """Record that no more answers come: the waiting results are reported with an error text."""
        self._release(ended=True)

    def _release(self, *, ended: bool = False) -> None:
        while self._waiting:
            oldest = self._waiting[0]
            if isinstance(oldest, _Held):
                is_waiting = (
                    oldest.question_after > self._last_question
                    or not self._unanswered.isdisjoint(
                        {oldest.question_before, oldest.question_after}
                    )
                )
                if is_waiting and not ended:
                    return
                self._ready += _with_application(
                    oldest, self._last_application, is_unknown=is_waiting
                )
                self._held_size -= oldest.size
            else:
                self._ready.append(oldest)
            self._waiting.popleft()


def _with_application(
    held: _Held, last_application: int | None, *, is_unknown: bool
) -> tuple[Event, ...]:
    """Return messages, with the application or an error text in their results."""
    fault = None
    if is_unknown or last_application is None:
        fault = "the link ended before the camera said of which application the result is"
    elif len(held.applications) > 1:
        ids = ", ".join(map(str, sorted(held.applications)))
        fault = f"the application changed while the result was made: it may be of any of {ids}"
    application = m.UNNAMED_APPLICATION if last_application is None else last_application
    return tuple(
        replace(message, application=application, fault=message.fault or fault)
        if isinstance(message, m.ResultContainer)
        else message
        for message in held.messages
    )
