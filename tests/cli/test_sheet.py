"""``smartcam sheet``."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from smartcam.calibration import (
    Charuco,
    Checkerboard,
    CircleGrid,
    MarkerGrid,
    make_sheet,
    target_from_data,
)
from smartcam.calibration._inside import target_from_description
from tests.cli.commandline import run

BOARD = ("sheet", "checkerboard", "--columns", "9", "--rows", "6", "--square", "25")


@pytest.fixture(autouse=True)
def _inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_sheet_writes_svg_and_pdf_as_the_library_makes_them(tmp_path: Path) -> None:
    outcome = run(*BOARD, "-o", "a.svg", "-o", "b.PDF").done()
    sheet = make_sheet(Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True))
    assert (tmp_path / "a.svg").read_text() == sheet.svg()
    assert (tmp_path / "b.PDF").read_bytes() == sheet.pdf()
    assert outcome.out == f"{sheet.title}\n  297 x 210 mm: a.svg, b.PDF\n"


def test_sheet_with_json_says_id_files_page_and_target() -> None:
    (line,) = run(*BOARD, "-o", "a.svg", "--no-origin-mark", "--page", "A3", "--json").done().lines
    target = Checkerboard(columns=9, rows=6, square=0.025)
    assert line["id"] == make_sheet(target).id
    assert (line["files"], line["page_mm"]) == (["a.svg"], [297, 420])
    assert line["origin_mm"] == pytest.approx(make_sheet(target, page="A3").origin)
    assert target_from_data(line["target"]) == target


def test_sheet_of_markers_is_opencvs_or_kalibrs() -> None:
    grid = ("sheet", "marker_grid", "--columns", "4", "--rows", "3", "--marker", "30", "--gap", "9")
    (line,) = run(*grid, "-o", "a.svg", "--json").done().lines
    target = MarkerGrid(columns=4, rows=3, marker=0.03, gap=0.009)
    assert target_from_data(line["target"]) == target
    assert line["id"] == make_sheet(target).id
    (line,) = run(*grid, "--kalibr", "-o", "b.svg", "--json").done().lines
    april = MarkerGrid.april_grid(columns=4, rows=3, tag=0.03, spacing=0.3)
    assert target_from_data(line["target"]) == april


def test_sheet_describes_the_target(tmp_path: Path) -> None:
    run(*BOARD, "--describe", "target.json").done()
    target = target_from_data(json.loads((tmp_path / "target.json").read_text()))
    assert target == Checkerboard(columns=9, rows=6, square=0.025, origin_mark=True)


def test_sheet_with_measured_rulers_describes_real_lengths(tmp_path: Path) -> None:
    run(*BOARD, "-o", "a.svg", "--describe", "t.json", "--measured-ruler", "99.2", "99.4").done()
    target = target_from_data(json.loads((tmp_path / "t.json").read_text()))
    assert target == Checkerboard(columns=9, rows=6, square=0.024825, origin_mark=True)
    assert "squares of 25 mm" in (tmp_path / "a.svg").read_text()


@pytest.mark.parametrize(
    ("arguments", "target"),
    [
        (
            ("charuco", "--columns", "7", "--rows", "5", "--square", "30"),
            Charuco(columns=7, rows=5, square=0.03, marker=0.0225),
        ),
        (
            ("charuco", "--columns", "5", "--rows", "6", "--square", "30", "--marker", "20",
             "--dictionary", "DICT_4X4_50", "--legacy-pattern"),
            Charuco(columns=5, rows=6, square=0.03, marker=0.02, dictionary="DICT_4X4_50",
                    legacy_pattern=True),
        ),
        (
            ("circles", "--columns", "8", "--rows", "9", "--spacing", "16", "--origin-diameter",
             "12"),
            CircleGrid(columns=8, rows=9, spacing=0.016, diameter=0.008, origin_diameter=0.012),
        ),
        (
            ("circles", "--columns", "4", "--rows", "11", "--spacing", "40", "--asymmetric"),
            CircleGrid(columns=4, rows=11, spacing=0.04, diameter=0.016, asymmetric=True),
        ),
    ],
)  # fmt: skip
def test_sheet_of_each_kind_takes_its_options(
    tmp_path: Path, arguments: tuple[str, ...], target: Charuco | CircleGrid
) -> None:
    run("sheet", *arguments, "-o", "a.svg", "--describe", "t.json").done()
    assert target_from_data(json.loads((tmp_path / "t.json").read_text())) == target
    assert (tmp_path / "a.svg").read_text() == make_sheet(target).svg()


def test_sheet_of_rays_is_described_too(tmp_path: Path) -> None:
    run("sheet", "rays", "--page", "200x300", "-o", "r.pdf", "--describe", "r.json").done()
    text = '{"kind": "rays", "diameter": 0.02}\n'
    assert (tmp_path / "r.json").read_text() == text
    same = make_sheet(target_from_description(json.loads(text)), page="200x300")
    assert (tmp_path / "r.pdf").read_bytes() == same.pdf()


def test_sheet_that_does_not_fit_says_by_how_much_and_writes_nothing(tmp_path: Path) -> None:
    outcome = run(*BOARD[:-1], "30", "-o", "a.svg")
    outcome.failed(2, "does not fit on A4 (297 x 210 mm)", "40.5 mm too wide and 37.5 mm too high")
    assert not (tmp_path / "a.svg").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--page", "A9", "-o", "a.svg"), "page: expected one of A5, A4, "),
        (("-o", "no/a.svg"), "no/a.svg: No such file or directory"),
        (("--describe", "t.json", "--measured-ruler", "90", "100"), "got 90 mm; print at 100 %"),
    ],
)
def test_sheet_that_cannot_be_made_is_one_line(arguments: tuple[str, ...], text: str) -> None:
    run(*BOARD, *arguments).failed(2, text)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), "nothing to write: give -o FILE.svg, -o FILE.pdf or --describe FILE"),
        (("-o", "a.png"), "-o a.png: expected a name that ends with .svg or .pdf"),
        (("-o", "a.svg", "--measured-ruler", "99", "99"), "--measured-ruler needs --describe"),
        (("--describe", "a.json", "--square", "nan"), "nan"),
    ],
)
def test_sheet_with_wrong_usage_reports_it(arguments: tuple[str, ...], text: str) -> None:
    outcome = run(*BOARD, *arguments)
    assert outcome.code == 2
    assert text in outcome.err
    assert "Traceback" not in outcome.err


def test_sheet_without_opencv_names_the_extra_where_it_is_needed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    run(*BOARD, "-o", "a.svg").done()
    outcome = run(
        "sheet", "charuco", "--columns", "7", "--rows", "5", "--square", "30", "-o", "a.svg"
    )
    outcome.failed(2, 'pip install "smartcam[calibration]"')
