"""The cancel sweep in short: every call over the plain wire, some over the others."""

from __future__ import annotations

import pytest
from cancel_sweep import CALLS, WIRES, Wire, missing_calls, run_sweep

STRIDE = 5
"""Steps between two cancellations; the long form has every one."""

SHORT_WIRES = WIRES[:4]


@pytest.mark.parametrize("name", CALLS)
def test_call_cancelled_at_any_step_leaves_client_and_camera_as_they_were(name: str) -> None:
    wire = SHORT_WIRES[list(CALLS).index(name) % len(SHORT_WIRES)]
    sweep = run_sweep(name, wire, STRIDE)
    assert sweep.ends["over"] == 2
    assert sweep.ends["cancelled"] > 0


@pytest.mark.parametrize("wire", WIRES, ids=str)
@pytest.mark.parametrize("name", ["trigger", "reboot"])
def test_call_cancelled_at_each_step_leaves_client_and_camera_as_they_were(
    name: str, wire: Wire
) -> None:
    sweep = run_sweep(name, wire)
    assert sweep.ends["cancelled"] == 2 * sweep.steps


def test_no_coroutine_is_left_out() -> None:
    assert missing_calls() == set()
