"""Apply rules to one direction's bytes, without I/O; the result is bytes and actions in order."""

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
    """Bytes to send, or an action between them."""

    at: int = 0  # offset in the stream at which the rule named by ``effects`` acts


def _pause_edit(seconds: float) -> Edit:
    """Return a wait of ``seconds``; at 0, of two turns of the event loop."""
    return Edit([b"", b""], pauses=[seconds])


class _Boundary(NamedTuple):
    """An offset at which a rule begins or ends; boundaries are sorted by the first three fields."""

    offset: int
    order: int
    is_start: bool
    rule: PlacedRule


class Editor:
    """One direction of one connection, and the rules for it."""

    def __init__(self, rules: Iterable[Rule]) -> None:
        self.position: int = 0  # number of received bytes
        self._boundaries: deque[_Boundary] = deque()
        self._rule_count = 0
        self._active: dict[int, RangeRule] = {}  # active rules by their index in the list of rules
        self._copies: dict[int, bytearray] = {}
        self._unflushed = bytearray()
        self._edits: list[Edit] = []
        self._ended = False
        self.add_rules(rules)

    def add_rules(self, rules: Iterable[Rule]) -> None:
        """Add rules after the present ones; a rule for an offset that has passed does nothing."""
        boundaries = list(self._boundaries)
        for order, rule in enumerate(rules, self._rule_count):
            self._rule_count = order + 1
            if isinstance(rule, PlacedRule) and rule.at >= self.position:
                boundaries.append(_Boundary(rule.at, order, True, rule))
                if isinstance(rule, RangeRule) and rule.end is not None:
                    boundaries.append(_Boundary(rule.end, order, False, rule))
        self._boundaries = deque(sorted(boundaries, key=lambda boundary: boundary[:3]))

    def feed(self, data: bytes) -> list[Edit]:
        """Return the edits for received bytes; without bytes, those of rules at this position.

        After a cut or a reset there are no further edits.
        """
        unread = memoryview(data)
        self._apply_boundaries()
        while unread and not self._ended:
            size = len(unread)
            if self._boundaries:
                size = min(size, self._boundaries[0].offset - self.position)
            self._pass_piece(bytes(unread[:size]))
            unread = unread[size:]
            self.position += size
            self._apply_boundaries()
        self._flush()
        edits, self._edits = self._edits, []
        return edits

    def _apply_boundaries(self) -> None:
        while self._boundaries and self._boundaries[0].offset == self.position and not self._ended:
            _, order, is_start, rule = self._boundaries.popleft()
            if not isinstance(rule, RangeRule):
                self._apply_point_rule(rule)
            elif is_start:
                if isinstance(rule, Drip):
                    self._flush()
                    self._edits.append(_pause_edit(0.0))  # the first byte is written alone, too
                self._active[order] = rule
                self._active = dict(sorted(self._active.items()))
            else:
                del self._active[order]
                self._unflushed += self._copies.pop(order, b"")

    def _apply_point_rule(self, rule: PlacedRule) -> None:
        if not isinstance(rule, InsertBytes):
            self._flush()
        self._note_rule(rule)
        if isinstance(rule, InsertBytes):
            self._unflushed += rule.data
        elif isinstance(rule, SplitBytes):
            self._edits.append(_pause_edit(rule.pause))
        elif isinstance(rule, CoalesceBytes):
            self._edits.append(Edit([], gather=(rule.size, rule.seconds)))
        elif isinstance(rule, Stall):
            self._edits.append(Edit([], end=BOTH_STALL if rule.both else STALL))
        elif isinstance(rule, (Cut, ResetConnection)):
            self._edits.append(Edit([], end=CUT if isinstance(rule, Cut) else RESET))
            self._ended = True

    def _note_rule(self, rule: PlacedRule) -> None:
        self._edits.append(Edit([], effects=[rule.name], at=self.position))

    def _pass_piece(self, piece: bytes) -> None:
        drip_pause: float | None = None
        for rule in self._active.values():
            if rule.at == self.position:
                self._note_rule(rule)
            piece = rule.change(piece)
            if isinstance(rule, Drip):
                drip_pause = rule.pause
        for order, rule in self._active.items():
            if isinstance(rule, DuplicateBytes):
                self._copies.setdefault(order, bytearray()).extend(piece)
        if drip_pause is None:
            self._unflushed += piece
        elif piece:
            self._flush()
            parts = [*(bytes([byte]) for byte in piece), b""]
            self._edits.append(Edit(parts, pauses=[drip_pause] * len(piece)))

    def _flush(self) -> None:
        if self._unflushed:
            self._edits.append(Edit([bytes(self._unflushed)]))
            self._unflushed.clear()
