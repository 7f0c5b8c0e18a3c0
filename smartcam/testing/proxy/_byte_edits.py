"""Apply rules to one direction's bytes: the passing bytes, and the actions between them. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from smartcam.emulator._inside import Ending, Transmission
from smartcam.testing.proxy._rules import (
    CoalesceBytes,
    Cut,
    Drip,
    DuplicateBytes,
    InsertBytes,
    PlacedRule,
    RangeRule,
    ResetConnection,
    SplitBytes,
    Stall,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from smartcam.testing.proxy._rules import Rule

CUT = Ending("close", Cut.name)
RESET = Ending("reset", ResetConnection.name)
STALL = Ending("stall", Stall.name)
BOTH_STALL = Ending("half_open", Stall.name)


@dataclass(slots=True, eq=False)
class Edit(Transmission):
    """Bytes that pass, or an action between them."""

    at: int = 0  # place in the stream at which the rule named by ``faults`` acts


def _gap(seconds: float) -> Edit:
    """Return a wait of so many seconds, or of two turns of the event loop at 0."""
    return Edit([b"", b""], pauses=[seconds])


class _Boundary(NamedTuple):
    """A place where a rule begins or ends; places are handled in this order."""

    offset: int
    order: int
    begins: bool
    rule: PlacedRule


class Editor:
    """One direction of one connection, and the rules for it."""

    def __init__(self, rules: Iterable[Rule]) -> None:
        self.position: int = 0  # number of received bytes
        self._marks: deque[_Boundary] = deque()
        self._rules = 0
        self._active: dict[int, RangeRule] = {}  # active rules by their index in the list of rules
        self._copies: dict[int, bytearray] = {}
        self._out = bytearray()
        self._edits: list[Edit] = []
        self._ended = False
        self.add(rules)

    def add(self, rules: Iterable[Rule]) -> None:
        """Add rules after the others; rules for places that have passed do nothing."""
        marks = list(self._marks)
        for order, rule in enumerate(rules, self._rules):
            self._rules = order + 1
            if isinstance(rule, PlacedRule) and rule.at >= self.position:
                marks.append(_Boundary(rule.at, order, True, rule))
                if isinstance(rule, RangeRule) and rule.end is not None:
                    marks.append(_Boundary(rule.end, order, False, rule))
        self._marks = deque(sorted(marks, key=lambda mark: mark[:3]))

    def feed(self, data: bytes) -> list[Edit]:
        """Return the edits that bytes cause; without bytes, the edits at the very beginning.

        After a cut or a reset there are no more.
        """
        unread = memoryview(data)
        self._reach_marks()
        while unread and not self._ended:
            size = len(unread)
            if self._marks:
                size = min(size, self._marks[0].offset - self.position)
            self._pass(bytes(unread[:size]))
            unread = unread[size:]
            self.position += size
            self._reach_marks()
        self._flush()
        edits, self._edits = self._edits, []
        return edits

    def _reach_marks(self) -> None:
        while self._marks and self._marks[0].offset == self.position and not self._ended:
            _, order, begins, rule = self._marks.popleft()
            if not isinstance(rule, RangeRule):
                self._act(rule)
            elif begins:
                if isinstance(rule, Drip):
                    self._flush()
                    self._edits.append(_gap(0.0))  # the first byte is written alone, too
                self._active[order] = rule
                self._active = dict(sorted(self._active.items()))
            else:
                del self._active[order]
                self._out += self._copies.pop(order, b"")

    def _act(self, rule: PlacedRule) -> None:
        if not isinstance(rule, InsertBytes):
            self._flush()
        self._note(rule)
        if isinstance(rule, InsertBytes):
            self._out += rule.data
        elif isinstance(rule, SplitBytes):
            self._edits.append(_gap(rule.pause))
        elif isinstance(rule, CoalesceBytes):
            self._edits.append(Edit([], gather=(rule.size, rule.seconds)))
        elif isinstance(rule, Stall):
            self._edits.append(Edit([], end=BOTH_STALL if rule.both else STALL))
        elif isinstance(rule, (Cut, ResetConnection)):
            self._edits.append(Edit([], end=CUT if isinstance(rule, Cut) else RESET))
            self._ended = True

    def _note(self, rule: PlacedRule) -> None:
        self._edits.append(Edit([], faults=[rule.name], at=self.position))

    def _pass(self, piece: bytes) -> None:
        drip: float | None = None
        for rule in self._active.values():
            if rule.at == self.position:
                self._note(rule)
            piece = rule.change(piece)
            if isinstance(rule, Drip):
                drip = rule.pause
        for order, rule in self._active.items():
            if isinstance(rule, DuplicateBytes):
                self._copies.setdefault(order, bytearray()).extend(piece)
        if drip is None:
            self._out += piece
        elif piece:
            self._flush()
            parts = [*(bytes([byte]) for byte in piece), b""]
            self._edits.append(Edit(parts, pauses=[drip] * len(piece)))

    def _flush(self) -> None:
        if self._out:
            self._edits.append(Edit([bytes(self._out)]))
            self._out.clear()
