"""``smartcam depth``: show and convert."""

from __future__ import annotations

import json
import signal
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from smartcam.depth import Cloud, load_cloud, save_cloud
from tests.cli.commandline import run
from tests.processes import PATIENCE, Process

pytest.importorskip("scipy", reason="needs the extra depth")


@pytest.fixture
def ply(tmp_path: Path) -> str:
    """Return a file: a square of 30 x 30 points at 1 m, 1 cm apart, and three far beyond it."""
    steps = 0.01 * np.arange(30)
    points = np.stack([*np.meshgrid(steps, steps), np.ones((30, 30))], axis=-1).reshape(-1, 3)
    points = np.concatenate([points, [[0, 0, 3], [0.2, 0, 4], [0, 0.2, 5]]])
    path = tmp_path / "cloud.ply"
    save_cloud(path, Cloud(points, np.full(points.shape, 9, np.uint8)))
    return str(path)


def test_convert_keeps_all(ply: str, tmp_path: Path) -> None:
    target = str(tmp_path / "b.pcd")
    done = run("depth", "convert", ply, target, "--text")
    assert (done.code, done.out) == (0, f"{target}: 903 of 903 points\n")
    assert b"DATA ascii" in Path(target).read_bytes()
    assert np.array_equal(load_cloud(target).points, load_cloud(ply).points)


@pytest.mark.parametrize(
    ("options", "points"),
    [
        (["--pass", "z:0.5:3.5"], 901),
        (["--pass", "z:3:"], 3),
        (["--pass", "z::3", "--pass", "x::0.095"], 301),
        (["--outliers"], 900),
        (["--voxel", "0.1"], 12),
        (["--outliers", "--voxel", "0.1"], 9),
    ],
)
def test_convert_filters(ply: str, tmp_path: Path, options: list[str], points: int) -> None:
    target = str(tmp_path / "b.ply")
    done = run("depth", "convert", ply, target, *options, "--json")
    assert done.code == 0, done.err
    assert json.loads(done.out) == {
        "file": target, "points": points, "of": 903, "colours": True, "sigma": False,
    }  # fmt: skip
    assert len(load_cloud(target)) == points


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["convert", "{ply}", "{ply}"], 2, "exists already; --force"),
        (["convert", "{ply}", "b.stl"], 2, "ends in .ply or .pcd"),
        (["convert", "no.ply", "b.ply"], 3, "no.ply: cannot be read"),
        (["convert", "torn.ply", "b.ply"], 5, "expected a PLY file"),
        (["convert", "{ply}", "b.ply", "--pass", "z:2:1"], 2, "expected AXIS:LOW:HIGH"),
        (["convert", "{ply}", "b.ply", "--pass", "w:1:2"], 2, "expected AXIS:LOW:HIGH"),
        (["convert", "{ply}", "b.ply", "--pass", "z:1"], 2, "expected AXIS:LOW:HIGH"),
        (["convert", "{ply}", "b.ply", "--voxel", "0"], 2, "--voxel"),
        (["show", "torn.ply"], 5, "expected a PLY file"),
        (["show", "{ply}", "--up", "w"], 2, "--up"),
    ],
)
def test_what_cannot_be_done_is_reported(
    ply: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    code: int,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "torn.ply").write_bytes(b"\0\1")
    done = run("depth", *(ply if one == "{ply}" else one for one in arguments))
    assert (done.code, done.out) == (code, "")
    assert said in done.err
    assert not (tmp_path / "b.ply").exists()


def test_convert_takes_the_place_by_force(ply: str) -> None:
    assert run("depth", "convert", ply, ply, "--pass", "z::2", "--force").code == 0
    assert len(load_cloud(ply)) == 900


def test_show_ends_after_its_seconds(ply: str) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra web")
    done = run("depth", "show", ply, "--seconds", "0.01", "--json")
    assert done.code == 0, done.err
    told = json.loads(done.out)
    assert (told["file"], told["points"]) == (ply, 903)


@pytest.mark.long
@pytest.mark.real_time
def test_show_serves_until_it_is_interrupted(ply: str) -> None:
    pytest.importorskip("aiohttp", reason="needs the extra web")
    with Process("smartcam", "depth", "show", ply, "--up", "-y", "--json") as process:
        page = json.loads(process.read_until(b"\n"))["page"]
        with urllib.request.urlopen(f"{page}api/cloud", timeout=PATIENCE) as answer:  # noqa: S310
            state = json.load(answer)
        process.send_signal(signal.SIGINT)
        ended = process.wait()
    assert (state["points"], state["up"]) == (903, "-y")
    assert (ended.code, ended.err) == (0, "")
