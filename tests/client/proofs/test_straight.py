"""The short way of a trigger's usual answers and the long one: ``straight.py``, short."""

from __future__ import annotations

from datetime import datetime
from typing import Any

import pytest

from tests.client.proofs.straight import DifferenceError, ShortDispatch, compare
from tests.protocols.frame_times import ShortMachine

EVENTS, SEED = 2000, 1


def test_short_way_gives_what_the_long_one_gives(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("CRITICAL", logger="smartcam")
    counts = compare(EVENTS, SEED)
    assert counts["triggers at once"] > 5
    assert counts["deliveries known"] > 20


class ForgetsStatuses(ShortDispatch):
    """Does not count the statuses around a result."""

    def _handle_usual_exchange(self, events: list[Any], now: float, at: datetime) -> bool:
        heard = self._state.statuses_received
        taken = super()._handle_usual_exchange(events, now, at)
        if taken:
            self._state.statuses_received = heard
        return taken


class KeepsQueries(ShortDispatch):
    """Still waits for the answers that it has taken."""

    def _handle_usual_exchange(self, events: list[Any], now: float, at: datetime) -> bool:
        taken = super()._handle_usual_exchange(events, now, at)
        if taken:
            self._waits.expect_query_answers(2)
        return taken


class LooksAtSizes(ShortMachine):
    """Takes any delivery of a known size for the known one."""

    def _store_delivery(self, buffer: bytes, owed: tuple[int, ...]) -> None:
        super()._store_delivery(buffer, owed)
        for size, known in self._known_deliveries.items():
            self._known_deliveries[size] = known._replace(
                head=b"", data_begin=0, tail=b"", data_end=size
            )


class IsOwedAnything(ShortMachine):
    """Does not see that another answer is owed."""

    def _receive_known_delivery(self) -> bool:
        for size, known in self._known_deliveries.items():
            self._known_deliveries[size] = known._replace(pending=self._pending_ids)
        return super()._receive_known_delivery()


@pytest.mark.parametrize(
    ("machine", "dispatch"),
    [
        (ShortMachine, ForgetsStatuses),
        (ShortMachine, KeepsQueries),
        (LooksAtSizes, ShortDispatch),
        (IsOwedAnything, ShortDispatch),
    ],
)
def test_fault_in_the_short_way_is_found(
    machine: type[ShortMachine], dispatch: type[ShortDispatch], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("CRITICAL", logger="smartcam")
    with pytest.raises((DifferenceError, AssertionError)):
        compare(100 * EVENTS, SEED, machine, dispatch)
