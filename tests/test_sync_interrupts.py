"""Ctrl-C at any moment of a call of ``smartcam.sync``."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.sync_interrupts import CALLS, PATIENCE


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("name", [*CALLS, "open_and_close", "connect"])
def test_ctrl_c_at_any_line_leaves_a_camera_that_works(name: str) -> None:
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "tests.sync_interrupts", name],
        capture_output=True,
        text=True,
        check=False,
        timeout=10 * PATIENCE,
    )
    assert (done.returncode, done.stderr) == (0, "")
    *wrong, lines = done.stdout.splitlines()
    assert wrong == []
    assert int(lines.split()[0]) > 10  # the call has run, and its lines were seen
