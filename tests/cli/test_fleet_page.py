"""``smartcam fleet page``."""

from __future__ import annotations

import signal
import urllib.error
from typing import TYPE_CHECKING

import pytest

from tests.cli.commandline import closed_port
from tests.cli.test_live import ask, page_of
from tests.processes import Process, free_place

if TYPE_CHECKING:
    from pathlib import Path

FILE = """\
listen: {place}
cameras:
  line1/**: {{emulated: {{count: 2}}, application: 7, interpret_as: localizations}}
"""


@pytest.mark.long
def test_page_of_a_file_looks_only_and_ends_with_ctrl_c(tmp_path: Path) -> None:
    path = tmp_path / "plant.yaml"
    path.write_text(FILE.format(place="tcp/127.0.0.1:0"), encoding="utf-8")
    with Process("smartcam", "fleet", "page", str(path)) as shown:
        page = page_of(shown)
        told = ask(f"{page}api/fleet")
        assert (told["totals"]["cameras"], told["control"]) == (2, False)
        with pytest.raises(urllib.error.HTTPError, match="403") as refused:
            ask(f"{page}api/cameras/line1%2Fcam1/trigger", {})
        refused.value.close()
        shown.send_signal(signal.SIGINT)
        ended = shown.wait()
    assert (ended.code, ended.err) == (0, "")


@pytest.mark.long
def test_fleet_that_is_not_there_yet_is_awaited(tmp_path: Path) -> None:
    pytest.importorskip("zenoh", reason="needs the extra fleet")
    place = free_place()
    path = tmp_path / "plant.yaml"
    path.write_text(FILE.format(place=place), encoding="utf-8")
    url = f"fleet://{place.removeprefix('tcp/')}"
    with Process("smartcam", "fleet", "page", url, "--control", "--timeout", "2") as shown:
        assert shown.read_until(b"\n", stream="stderr").endswith("; waiting for it\n")
        with Process("smartcam", "serve", str(path)):
            page = page_of(shown)
            answer = ask(f"{page}api/cameras/line1%2Fcam1/trigger", {})
            assert answer["number"] == 1
        shown.send_signal(signal.SIGTERM)
        assert shown.wait().code == 0


@pytest.mark.long
def test_waiting_ends_after_its_seconds() -> None:
    pytest.importorskip("zenoh", reason="needs the extra fleet")
    with closed_port() as gone:
        options = ("--timeout", "0.2", "--seconds", "0.6")
        with Process("smartcam", "fleet", "page", f"fleet://{gone}", *options) as shown:
            ended = shown.wait()
    assert (ended.code, ended.out) == (0, "")
