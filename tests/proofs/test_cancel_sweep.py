"""The cancel sweep in short: every call over the plain wire, some over the others."""

from __future__ import annotations

import pytest

from tests.proofs.cancel_sweep import (
    CALLS,
    ID,
    SMART,
    WIRES,
    Wire,
    calls_over,
    missing_calls,
    run_sweep,
)

STRIDE = 5
"""Steps between two cancellations; the long form has every one."""

SHORT_WIRES = (*WIRES[:4], *(wire for wire in WIRES if wire.dialect == "b16"))
ID_WIRES = tuple(wire for wire in WIRES if wire.dialect in ID)


def short_sweeps() -> list[tuple[str, Wire]]:
    """Each call over one wire of each kind of camera that has it."""
    return [
        (name, wires[number % len(wires)])
        for number, (name, call) in enumerate(CALLS.items())
        for wires, dialects in ((SHORT_WIRES, SMART), (ID_WIRES, ID))
        if call.dialects & dialects
    ]


@pytest.mark.long
@pytest.mark.widest
@pytest.mark.parametrize(("name", "wire"), short_sweeps(), ids=str)
def test_call_cancelled_at_any_step_leaves_client_and_camera_as_they_were(
    name: str, wire: Wire
) -> None:
    sweep = run_sweep(name, wire, STRIDE)
    assert sweep.ends["over"] == 2
    assert sweep.ends["cancelled"] > 0


@pytest.mark.long
@pytest.mark.widest
@pytest.mark.parametrize(
    ("name", "wire"),
    [(n, wire) for n in ("trigger", "reboot") for wire in WIRES if n in calls_over(wire)],
    ids=str,
)
def test_call_cancelled_at_each_step_leaves_client_and_camera_as_they_were(
    name: str, wire: Wire
) -> None:
    sweep = run_sweep(name, wire)
    assert sweep.ends["cancelled"] == 2 * sweep.steps


def test_no_coroutine_is_left_out() -> None:
    assert missing_calls() == set()
