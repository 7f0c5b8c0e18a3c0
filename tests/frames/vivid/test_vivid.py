"""The driver with the kernel's vivid: devices that do what cameras do, and fail as told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.frames.vivid import machine


@pytest.mark.long
@pytest.mark.widest
def test_the_driver_does_with_the_kernel_what_it_should(tmp_path: Path) -> None:
    if (why := machine.missing()) is not None:
        pytest.skip(why)
    script = Path(__file__).with_name("guest.py")
    status, said = machine.run(script, [], tmp_path, timeout=1500)
    results = tmp_path / "result.json"
    assert results.exists(), said
    came = json.loads(results.read_text())
    wrong = [f"{name}: {text}" for name, text in came.items() if text]
    assert not wrong, "\n".join([*wrong, said])
    assert len(came) >= 20, said
    assert status == 0, said
