"""From one direction's bytes and rules to steps: what to write, and what to do in between. Pure."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from smartcam.testing.proxy.rules import (
    Coalesce,
    Cut,
    Drip,
    Duplicate,
    Insert,
    PointRule,
    RangeRule,
    Reset,
    Split,
    Stall,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from smartcam.testing.proxy.rules import Rule

__all__ = ["Act", "Editor", "Gap", "Hold", "Note", "Send", "Step"]


class Send(NamedTuple):
    """Write bytes, byte by byte where ``drip`` says how many seconds lie between."""

    data: bytes | memoryview
    drip: float | None = None


class Gap(NamedTuple):
    """Wait: seconds, or two turns of the event loop at 0."""

    seconds: float


class Hold(NamedTuple):
    """Gather what follows, ``size`` bytes or for ``seconds``, and write it at once."""

    size: int
    seconds: float


class Note(NamedTuple):
    """Log a rule that acts here: on the bytes that follow, or between."""

    what: str
    at: int


class Act(NamedTuple):
    """Do to the connection what a rule says; None is the sender's end."""

    rule: Cut | Reset | Stall | None


Step = Send | Gap | Hold | Note | Act


class _Mark(NamedTuple):
    """A place where something begins or ends; they are taken in this order."""

    offset: int
    order: int
    begins: bool
    rule: PointRule | RangeRule


class Editor:
    """One direction of one connection.

    Args:
        rules: those that concern it, in order.
    """

    def __init__(self, rules: Iterable[Rule]) -> None:
        self._marks: deque[_Mark] = deque()
        self._rules = 0
        self._position = 0
        self._active: dict[int, RangeRule] = {}  # by their place in the list of rules
        self._copies: dict[int, bytearray] = {}
        self._out = bytearray()
        self._steps: list[Step] = []
        self._ended = False
        self.add(rules)

    def add(self, rules: Iterable[Rule]) -> None:
        """Put rules behind the others; those for places that are past do nothing."""
        marks = list(self._marks)
        for order, rule in enumerate(rules, self._rules):
            self._rules = order + 1
            if isinstance(rule, (PointRule, RangeRule)) and rule.at >= self._position:
                marks.append(_Mark(rule.span.begin, order, True, rule))
                if isinstance(rule, RangeRule) and rule.span.end is not None:
                    marks.append(_Mark(rule.span.end, order, False, rule))
        self._marks = deque(sorted(marks, key=lambda mark: mark[:3]))

    @property
    def position(self) -> int:
        """Bytes that have come."""
        return self._position

    def feed(self, data: bytes) -> list[Step]:
        """Return the steps that bytes cause; with none, what stands at the very beginning.

        Behind a cut or a reset there are no more.
        """
        rest = memoryview(data)
        self._reach_marks()
        while rest and not self._ended:
            size = len(rest)
            if self._marks:
                size = min(size, self._marks[0].offset - self._position)
            self._pass(bytes(rest[:size]))
            rest = rest[size:]
            self._position += size
            self._reach_marks()
        self._flush()
        steps, self._steps = self._steps, []
        return steps

    def _reach_marks(self) -> None:
        while self._marks and self._marks[0].offset == self._position and not self._ended:
            _, order, begins, rule = self._marks.popleft()
            if isinstance(rule, PointRule):
                self._act(rule)
            elif begins:
                if isinstance(rule, Drip):
                    self._flush()
                    self._steps.append(Gap(0.0))  # its first byte stands alone too
                self._active[order] = rule
                self._active = dict(sorted(self._active.items()))
            else:
                del self._active[order]
                self._out += self._copies.pop(order, b"")

    def _act(self, rule: PointRule) -> None:
        if not isinstance(rule, Insert):
            self._flush()
        self._steps.append(Note(rule.name, self._position))
        if isinstance(rule, Insert):
            self._out += rule.data
        elif isinstance(rule, Split):
            self._steps.append(Gap(rule.pause))
        elif isinstance(rule, Coalesce):
            self._steps.append(Hold(rule.size, rule.seconds))
        elif isinstance(rule, (Cut, Reset, Stall)):
            self._steps.append(Act(rule))
            self._ended = not isinstance(rule, Stall)

    def _pass(self, piece: bytes) -> None:
        drip: float | None = None
        for rule in self._active.values():
            if rule.at == self._position:
                self._steps.append(Note(rule.name, self._position))
            piece = rule.change(piece)
            if isinstance(rule, Drip):
                drip = rule.pause
        for order, rule in self._active.items():
            if isinstance(rule, Duplicate):
                self._copies.setdefault(order, bytearray()).extend(piece)
        if drip is None:
            self._out += piece
        elif piece:
            self._flush()
            self._steps.append(Send(piece, drip))

    def _flush(self) -> None:
        if self._out:
            self._steps.append(Send(bytes(self._out)))
            self._out.clear()
