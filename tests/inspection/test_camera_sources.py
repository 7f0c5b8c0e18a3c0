"""Software cameras in a process, a fleet and a command, with pictures from files."""

from __future__ import annotations

import asyncio
import json
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import smartcam
import smartcam.fleet
from smartcam.exceptions import ConfigurationError
from smartcam.recording import FleetRecorder, load_recording
from tests.handmade import PATIENCE
from tests.inspection.seeing import Desk, cell_of

cv2: Any = pytest.importorskip("cv2")

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

pytestmark = pytest.mark.real_time

FOLDER = """
cameras:
  cam:
    software:
      frames: {frames}
      applications:
        7: {{name: bright, level: {{most: 25}}}}
        30: {{name: free, rate: 100, level: {{}}}}
"""


def write_pictures(folder: Path, levels: list[int]) -> None:
    cv2: Any = pytest.importorskip("cv2")
    folder.mkdir()
    for number, level in enumerate(levels, start=1):
        picture = np.full((48, 64), level, np.uint8)
        assert cv2.imwrite(str(folder / f"part{number}.png"), picture)


@pytest.mark.parametrize("frames", ["shots", "'shots/*.png'", "'shots#pace=none'"])
async def test_each_trigger_takes_the_next_picture_of_a_folder_and_begins_again(
    tmp_path: Path, frames: str
) -> None:
    pytest.importorskip("av")
    write_pictures(tmp_path / "shots", [10, 20, 30])
    (tmp_path / "cell.yaml").write_text(FOLDER.format(frames=frames))
    async with smartcam.connect(f"software:{tmp_path / 'cell.yaml'}") as camera:
        found = [(await camera.trigger(timeout=PATIENCE)).value for _ in range(7)]
        assert [one.level for one in found] == [10, 20, 30, 10, 20, 30, 10]
        assert [one.ok for one in found] == [True, True, False, True, True, False, True]


async def test_pictures_of_other_sizes_and_kinds_in_a_folder_have_their_turn(
    tmp_path: Path,
) -> None:
    pytest.importorskip("av")
    write_pictures(tmp_path / "shots", [10, 20])
    others = [np.full((9, 5), 7 * 257, np.uint16), np.full((30, 20, 3), 15, np.uint8)]
    for number, picture in enumerate(others, start=3):
        assert cv2.imwrite(str(tmp_path / f"shots/part{number}.png"), picture)
    (tmp_path / "cell.yaml").write_text(FOLDER.format(frames="shots"))
    async with smartcam.connect(f"software:{tmp_path / 'cell.yaml'}") as camera:
        found = [(await camera.trigger(timeout=PATIENCE)).value.level for _ in range(5)]
        assert found == [10, 20, 7, 15, 10]


async def test_damaged_picture_in_a_folder_is_one_system_error(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("av")
    write_pictures(tmp_path / "shots", [10, 20, 30])
    second = sorted((tmp_path / "shots").iterdir())[1]
    second.write_bytes(second.read_bytes()[:50])
    (tmp_path / "cell.yaml").write_text(FOLDER.format(frames="shots"))
    found: list[float] = []
    async with smartcam.connect(f"software:{tmp_path / 'cell.yaml'}") as camera:
        for _ in range(2):
            found.append((await camera.trigger(timeout=PATIENCE)).value.level)
            with pytest.raises(smartcam.CameraFaultError, match="damaged"):
                await camera.trigger(timeout=PATIENCE)
            await camera.wait_status(
                lambda status: not status & smartcam.Status.SYSTEM_ERROR, timeout=PATIENCE
            )
            found.append((await camera.trigger(timeout=PATIENCE)).value.level)
    assert found == [10, 30, 10, 30]
    assert f"left out: {second}" in caplog.text


async def test_a_free_run_goes_round_a_folder_in_order(tmp_path: Path) -> None:
    pytest.importorskip("av")
    write_pictures(tmp_path / "shots", [10, 20, 30])
    (tmp_path / "cell.yaml").write_text(FOLDER.format(frames="shots"))
    async with smartcam.connect(f"software:{tmp_path / 'cell.yaml'}", application=30) as camera:
        results = camera.results()
        async with asyncio.timeout(PATIENCE):
            levels = [(await anext(results)).value.level for _ in range(6)]
        results.close()
    begin = levels[0] // 10 - 1
    assert levels == [10 * (1 + (begin + n) % 3) for n in range(6)]


async def test_unreadable_picture_is_a_system_error_not_a_result(tmp_path: Path) -> None:
    pytest.importorskip("av")
    write_pictures(tmp_path / "shots", [10])
    (tmp_path / "shots" / "part2.png").write_bytes(b"\x89PNG\r\n\x1a\nnothing")
    (tmp_path / "cell.yaml").write_text(FOLDER.format(frames="shots"))
    async with smartcam.connect(f"software:{tmp_path / 'cell.yaml'}") as camera:
        assert (await camera.trigger(timeout=PATIENCE)).value.level == 10
        with pytest.raises(smartcam.CameraFaultError):
            await camera.trigger(timeout=PATIENCE)
        await camera.wait_status(
            lambda status: not status & smartcam.Status.SYSTEM_ERROR, timeout=PATIENCE
        )
        assert (await camera.trigger(timeout=PATIENCE)).value.level == 10


# ---------------------------------------------------------------------- in a fleet


async def test_fleet_shares_a_software_camera_with_typed_results_and_pictures(
    tmp_path: Path,
) -> None:
    pytest.importorskip("zenoh")
    desk = Desk("fleet")
    desk.level = 61
    path = cell_of(tmp_path, desk)
    text = path.read_text() + "listen: tcp/127.0.0.1:0\n"
    path.write_text(text)
    async with (
        smartcam.fleet.serve(path) as server,
        smartcam.connect(server.urls["line1/cam1"]) as camera,
    ):
        found = (await camera.trigger(timeout=PATIENCE)).value
        assert (found.ok, found.level) == (True, 61)
        async with camera.frames() as frames:
            async with asyncio.timeout(PATIENCE):
                frame = await anext(frames)
        assert frame.format.name == "RGB8"
        assert (frame.array()[-1, -1] == 61).all()
        desk.unplug()
        await camera.wait_status(
            lambda status: bool(status & smartcam.Status.SYSTEM_ERROR), timeout=PATIENCE
        )
    assert desk.sink is None


def write_located(folder: Path) -> Path:
    """Write a fleet file with a camera that locates a part, whose agent records."""
    picture = np.full((160, 200), 60, np.uint8)
    cv2.fillPoly(picture, [np.array([(60, 40), (140, 40), (140, 70), (90, 110), (60, 110)])], 190)
    (folder / "shots").mkdir()
    cv2.imwrite(str(folder / "shots" / "1.png"), cv2.GaussianBlur(picture, (0, 0), 0.8))
    cell = FOLDER.format(frames="shots").replace(
        "{name: bright, level: {most: 25}}", "{locate: {taught: shots/1.png}}"
    )
    path = folder / "fleet.yaml"
    path.write_text(f"{cell}listen: tcp/127.0.0.1:0\nrecord: {{folder: rec, pictures: judged}}\n")
    return path


def outlined(pixels: NDArray[Any]) -> bool:
    """Return whether the middles of three of the part's edges are drawn over in green."""
    whole = pixels.astype(int)
    green = whole[:, :, 1] - whole[:, :, 0] > 40
    return all(
        green[y - 2 : y + 3, x - 2 : x + 3].any() for x, y in ((100, 40), (60, 75), (75, 110))
    )


async def test_outlines_of_located_parts_are_in_a_fleets_frames(tmp_path: Path) -> None:
    pytest.importorskip("zenoh")
    server = smartcam.fleet.serve(write_located(tmp_path))
    assert server.file.record is not None
    async with FleetRecorder(server, server.file.record), server:
        await server.wait_first_attempts()
        url = server.urls["cam"]
        async with smartcam.connect(url) as camera, camera.frames() as frames:
            shown = []
            for _ in range(3):
                found = await camera.trigger(timeout=PATIENCE)
                assert found.value.count == 1
                async with asyncio.timeout(PATIENCE):
                    shown.append(await anext(frames))
        assert all(outlined(one.array()) for one in shown)
    judged = [*load_recording(tmp_path / "rec").results_with_pictures("cam")]
    pictures = [one.picture for one in judged if one.picture is not None]
    assert len(judged) == 3
    assert pictures
    assert all(one.array().ndim == 2 for one in pictures)  # as they came, to be judged again
    for one in pictures:
        *marks, verdict = one.drawings
        assert "found" in {mark.role for mark in marks}
        assert (verdict.kind, verdict.text) == ("text", "7: ok")


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({"software": {"frames": "desk://x"}}, "applications"),
        (
            {"software": {"frames": "desk://x", "applications": {7: {"lovel": {}}}}},
            "lovel",
        ),
        (
            {"url": "bvs://h", "software": {"frames": "desk://x", "applications": {}}},
            "expected one of url, emulated, software; got url and software",
        ),
        ({}, "expected one of url, emulated, software; got none of them"),
    ],
)
def test_mistake_in_a_fleet_file_is_reported(
    tmp_path: Path, entry: dict[str, Any], said: str
) -> None:
    pytest.importorskip("yaml")
    path = tmp_path / "fleet.yaml"
    path.write_text(json.dumps({"cameras": {"cam": entry}}))
    with pytest.raises(ConfigurationError, match=said):
        smartcam.fleet.load_fleet(path)


# ---------------------------------------------------------------------- by the command


async def test_command_serves_a_software_camera_until_ended(tmp_path: Path) -> None:
    pytest.importorskip("click")
    pytest.importorskip("yaml")
    path = tmp_path / "cell.yaml"
    path.write_text("""
cameras:
  cam:
    software:
      frames: "synthetic://?size=320x240&fps=50"
      applications:
        5: {name: there, present: {grey: [0, 255]}}
""")
    command = "from smartcam._cli.smartcam_emulator import command; command()"
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", command, "--program", str(path), "--json"),
        stdout=asyncio.subprocess.PIPE,
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(PATIENCE):
            told = json.loads(await process.stdout.readline())
        assert told["name"] == "cam"
        async with smartcam.connect(told["url"], connect_timeout=PATIENCE) as camera:
            result = await camera.trigger(timeout=PATIENCE)
            assert result.application == 5
            assert result.raw[0] == 0xFF
    finally:
        process.terminate()
        async with asyncio.timeout(PATIENCE):
            code = await process.wait()
    assert code == 0


# ---------------------------------------------------------------------- on a page


async def test_live_page_shows_the_picture_with_the_tools_marks(
    tmp_path: Path,
) -> None:
    aiohttp: Any = pytest.importorskip("aiohttp")
    cv2: Any = pytest.importorskip("cv2")
    from smartcam.web import LiveSite

    desk = Desk("page")
    desk.level = 44
    path = cell_of(tmp_path, desk)
    async with (
        smartcam.connect(f"software:{path}", connect_timeout=PATIENCE) as camera,
        LiveSite(camera) as site,
        aiohttp.ClientSession() as session,
        session.get(f"{site.origin}/api/events") as events,  # somebody looks
    ):
        assert events.status == 200
        await camera.trigger(timeout=PATIENCE)
        async with asyncio.timeout(PATIENCE):
            while True:
                async with session.get(f"{site.origin}/api/picture") as answer:
                    if answer.status == 200:
                        break
                await asyncio.sleep(0.05)
            assert answer.content_type == "image/png"
            async with session.get(f"{site.origin}/api/picture") as answer:
                data = await answer.read()
    drawn = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert drawn.shape == (48, 64, 3)
    assert (drawn[-1, -1] == 44).all()
    assert (drawn != 44).any()
