"""The threads of tools: the event loop gets its turn while they are at work."""

from __future__ import annotations

import sys
import threading

import pytest

from smartcam.inspection._camera.tool_thread import SWITCH_INTERVAL, ToolThread
from tests.handmade import PATIENCE


def test_threads_take_turns_more_often_while_any_tool_is_at_work() -> None:
    before = sys.getswitchinterval()
    threads = [ToolThread(f"tool {number}") for number in range(2)]
    gates = [threading.Event() for _ in threads]
    begun = [threading.Event() for _ in threads]

    def work(number: int) -> float:
        begun[number].set()
        assert gates[number].wait(PATIENCE)
        if number:
            raise RuntimeError("a tool with a fault")
        return sys.getswitchinterval()

    ends = [thread.submit(lambda one=one: work(one)) for one, thread in enumerate(threads)]
    assert all(one.wait(PATIENCE) for one in begun)
    assert sys.getswitchinterval() == pytest.approx(min(before, SWITCH_INTERVAL), rel=1e-3)
    gates[1].set()
    with pytest.raises(RuntimeError):
        ends[1].result(PATIENCE)
    assert sys.getswitchinterval() == pytest.approx(min(before, SWITCH_INTERVAL), rel=1e-3)
    gates[0].set()
    assert ends[0].result(PATIENCE) == pytest.approx(min(before, SWITCH_INTERVAL), rel=1e-3)
    assert sys.getswitchinterval() == pytest.approx(before, rel=1e-3)
    for thread in threads:
        thread.close()


def test_an_interval_that_is_shorter_already_stays() -> None:
    before = sys.getswitchinterval()
    thread = ToolThread("tool")
    sys.setswitchinterval(1e-4)
    try:
        for _ in range(50):  # which do not add up what is cut off
            found = thread.submit(sys.getswitchinterval).result(PATIENCE)
            assert found == pytest.approx(1e-4, abs=2e-6)
        assert sys.getswitchinterval() == pytest.approx(1e-4, abs=2e-6)
    finally:
        sys.setswitchinterval(before)
        thread.close()
