"""Run the judge of cameras on software cameras: each check holds in every dialect."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import pytest

from smartcam.conformance.camera import judge
from smartcam.inspection import SoftwareDevice, load_cell
from tests.conformance.camera_world import WORLDS, loop_thread, short_options
from tests.inspection.seeing import Desk, cell_of

if TYPE_CHECKING:
    from pathlib import Path

IN_EVERY_RUN = [("handbook", "tcp"), ("bid", "udp")]


@pytest.mark.parametrize(
    ("dialect", "transport"),
    [
        world if world in IN_EVERY_RUN else pytest.param(*world, marks=pytest.mark.long)
        for world in WORLDS
    ],
)
def test_the_judge_finds_no_difference_to_a_documented_camera(
    tmp_path: Path, dialect: str, transport: Literal["tcp", "udp"]
) -> None:
    camera = load_cell(cell_of(tmp_path, Desk("judged")))["line1/cam1"]
    quirks = {"reboot_time": 0.2}
    device = SoftwareDevice(camera, dialect=dialect, transport=transport, quirks=quirks)
    with loop_thread() as thread:
        thread.run_coroutine(device.start)
        try:
            report = judge(short_options(device.url, application=40, other_application=7))
        finally:
            thread.run_coroutine(device.stop)
    assert report.differing == []
    assert report.quirks["busy_while_processing"] is True
