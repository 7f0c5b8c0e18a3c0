"""``smartcam calibrate compare`` and ``draw``."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from smartcam.calibration import CameraModel, fit_plane
from smartcam.calibration.formats import CameraChain, write_camera_info, write_cameras
from tests.calibration import lenskit
from tests.calibration.lens.estimates import Bench, spread_poses
from tests.calibration.lens.test_drawing import hand, pair
from tests.cli.commandline import run

DIFFERENT = 7


POSES = spread_poses(lenskit.LEFT, 10)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of calibrations: two of one lens, one of another, pairs, bare lenses."""
    folder = tmp_path_factory.mktemp("files")
    bench = Bench(lenskit.LEFT, POSES)
    for seed in (1, 2):
        bench.calibration(seed).save(folder / f"lens{seed}.json")
    write_camera_info(folder / "lens1.yaml", bench.lens(1))
    Bench(lenskit.RIGHT, POSES).calibration(3).save(folder / "other.json")
    pair().save(folder / "pair.json")
    write_cameras(folder / "pair-cv.yaml", "opencv", CameraChain.of(pair()))
    small = CameraModel(size=(320, 240), matrix=np.array([[300, 0, 160], [0, 300, 120], [0, 0, 1]]))
    write_cameras(
        folder / "small.yaml", "kalibr", CameraChain(cameras=(bare(small),), names=("c",))
    )
    hand("eye-in-hand").save(folder / "hand.json")
    corners = np.array([[0.0, 0], [0.2, 0], [0.2, 0.1], [0, 0.1], [0.1, 0.05]])
    plane = fit_plane(corners, np.column_stack([corners, np.zeros(5)]), tool_z=(0, 0, -1))
    plane.save(folder / "plane.json")
    return folder


def bare(camera: CameraModel) -> CameraModel:
    return dataclasses.replace(camera, distortion=np.zeros(5))


@pytest.fixture(autouse=True)
def _inside(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(files)


def compare(*arguments: str) -> list[str]:
    return ["calibrate", "compare", *arguments]


def test_calibrations_of_one_lens_are_the_same() -> None:
    outcome = run(*compare("lens1.json", "lens2.json", "--distance", "0.5")).done()
    verdict, head, difference, noise, where = outcome.out.splitlines()
    assert verdict.startswith("camera: the same within their noise: ")
    assert head.split() == ["centre", "corners", "worst", "rms"]
    assert difference.split()[0] == "difference"
    assert noise.split()[:2] == ["from", "noise"]
    assert where.startswith("  pixels, of a coordinate, at 0.5 m; after a turn of ")


def test_lens_that_is_another_is_an_exit_code() -> None:
    outcome = run(*compare("lens1.json", "other.json", "--json"))
    assert outcome.code == DIFFERENT
    (line,) = outcome.lines
    assert line["same"] is False
    assert line["ratio"] > 5
    assert line["chance"] < 1e-9
    assert line["distance_m"] is None
    assert line["difference_px"]["rms"] > 5 * line["predicted_px"]["rms"]


def test_bare_lens_gives_no_verdict() -> None:
    outcome = run(*compare("lens1.yaml", "lens1.json")).done()
    assert outcome.out.startswith("camera: no verdict: ")
    assert "from noise" not in outcome.out


def test_pair_is_compared_camera_by_camera_in_whatever_format() -> None:
    left, right, rig = run(*compare("pair.json", "pair-cv.yaml", "--json")).done().lines
    assert (left["camera"], right["camera"]) == ("left", "right")
    assert left["difference_px"]["worst"] < 1e-6
    assert rig["between"] == "right to left"
    assert abs(rig["shift_mm"]) < 1e-6
    assert abs(rig["turn_deg"]) < 1e-5


def test_comparison_is_drawn(files: Path) -> None:
    run(*compare("lens1.json", "lens2.json", "--svg", "one.svg")).done()
    drawn = (files / "one.svg").read_text()
    assert drawn.startswith("<svg ")
    assert ">expected from noise<" in drawn
    run(*compare("pair.json", "pair.json", "--svg", "two.svg")).done()
    assert (files / "two-left.svg").exists()
    assert (files / "two-right.svg").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("lens1.json", "pair.json"), "expected as many cameras in both, got 1 and 2"),
        (("lens1.json", "none.json"), "none.json: No such file or directory"),
        (("lens1.json", "plane.json"), "plane.json: holds 'plane', expected a calibration that"),
        (("lens1.json", "small.yaml"), "got 640 x 480 and 320 x 240 pixels"),
        (("lens1.json", "lens2.json", "--svg", "a.png"), "expected a name that ends with .svg"),
    ],
)
def test_what_cannot_be_compared_is_refused(arguments: tuple[str, ...], said: str) -> None:
    outcome = run(*compare(*arguments))
    assert outcome.code == 2
    assert said in outcome.err


def test_file_of_no_format_is_refused(files: Path) -> None:
    (files / "notes.txt").write_text("focal length: about 500\n")
    outcome = run(*compare("notes.txt", "lens1.json"))
    assert outcome.code == 2
    assert "notes.txt: expected a calibration of smartcam, or one of " in outcome.err


@pytest.mark.parametrize(
    ("file", "what", "has"),
    [
        ("lens1.json", None, "residuals"),
        ("lens1.json", "scene", 'class="board"'),
        ("lens1.json", "uncertainty", "a point at infinity"),
        ("pair.json", "views", "held out, lengths"),
        ("pair.json", "scene", ">right<"),
        ("hand.json", None, "on the target"),
        ("hand.json", "scene", ">base<"),
        ("plane.json", None, "touches"),
    ],
)
def test_file_is_drawn(files: Path, file: str, what: str | None, has: str) -> None:
    options = () if what is None else ("--what", what)
    (line,) = run("calibrate", "draw", file, "-o", "out.svg", "--json", *options).done().lines
    assert line == {"file": "out.svg"}
    assert has in (files / "out.svg").read_text()


def test_picture_that_a_file_does_not_have_is_refused() -> None:
    outcome = run("calibrate", "draw", "pair.json", "-o", "out.svg", "--what", "uncertainty")
    assert outcome.code == 2
    said = (
        "expected the picture uncertainty, got a file of kind 'stereo', which has views and scene"
    )
    assert said in outcome.err


def test_calibrate_alone_is_the_wizard_as_before() -> None:
    outcome = run("calibrate", "--help").done()
    assert outcome.out.startswith("Usage: smartcam calibrate [OPTIONS] [URL]")
    assert "--wizard" in outcome.out
    assert "compare" in outcome.out.partition("Commands:\n")[2]
    outcome = run("calibrate")
    assert outcome.code == 2
    assert re.search(r"Try 'smartcam calibrate (-h|--help)' for help\.", outcome.err)
    assert "a URL is missing" in outcome.err
