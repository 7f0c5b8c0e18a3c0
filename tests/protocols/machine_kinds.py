"""Machines of a client over TCP: one that reads frame by frame, one that counts what it knows."""

from __future__ import annotations

from typing import Any

from tests.protocols.inside import Machine


class JudgingMachine(Machine):
    """A machine that reads and writes each frame by itself."""

    def _take_up(self, dialect: Any) -> None:
        super()._take_up(dialect)
        self._plain = False


class ShortMachine(Machine):
    """A machine that counts the deliveries that it takes as a whole."""

    taken = 0

    def _receive_known(self) -> bool:
        taken = super()._receive_known()
        ShortMachine.taken += taken
        return taken
