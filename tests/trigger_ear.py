"""Hears which Trigger message each call of a client sends, and when."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.observers import Observer

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam._client.link import TraceEntry


class Sending(NamedTuple):
    """A Trigger message that was sent.

    Attributes:
        session: in which, counted from 1 by the Connects that were sent.
        trigger: which of that session, from 1.
        at: when, as the loop says.
    """

    session: int
    trigger: int
    at: float


class TriggerEar(Observer):
    """Counts what is said; one for all clients of a camera, one after the other.

    Attributes:
        session: Connects that were sent.
        said: frames that the client sent, by message.
        results: containers that came, by session.
        sendings: Trigger messages by the task that sent them; a command runs in its caller's.
        at_trigger: called when one goes out, with the task that sent it.
    """

    def __init__(self) -> None:
        self.session = 0
        self.said: Counter[str] = Counter()
        self.results: Counter[int] = Counter()
        self.sendings: dict[asyncio.Task[Any], list[Sending]] = {}
        self.at_trigger: Callable[[asyncio.Task[Any]], None] | None = None
        self._in_session = 0

    @property
    def last(self) -> tuple[int, int]:
        """Session and count of the last Trigger message."""
        return self.session, self._in_session

    def on_frame(self, entry: TraceEntry) -> None:
        if entry.direction == "<":
            self.results[self.session] += entry.message == "ResultContainer"
            return
        self.said[entry.message] += 1
        if entry.message == "Connect":
            self.session += 1
            self._in_session = 0
        elif entry.message == "Trigger":
            self._in_session += 1
            task = asyncio.current_task()
            assert task is not None
            sending = Sending(self.session, self._in_session, asyncio.get_running_loop().time())
            self.sendings.setdefault(task, []).append(sending)
            if self.at_trigger is not None:
                self.at_trigger(task)
