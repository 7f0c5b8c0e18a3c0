"""Test the driver with the kernel's vivid, whose devices act and fail like cameras."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.frames.vivid import machine


@pytest.mark.long
@pytest.mark.widest
def test_driver_works_with_the_kernel(tmp_path: Path) -> None:
    if (why := machine.missing()) is not None:
        pytest.skip(why)
    script = Path(__file__).with_name("guest.py")
    status, output = machine.run(script, [], tmp_path, timeout=1500)
    results = tmp_path / "result.json"
    assert results.exists(), output
    came = json.loads(results.read_text())
    wrong = [f"{name}: {text}" for name, text in came.items() if text]
    assert not wrong, "\n".join([*wrong, output])
    assert len(came) >= 20, output
    assert status == 0, output
