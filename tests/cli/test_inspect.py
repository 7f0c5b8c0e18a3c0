"""``smartcam inspect``: results and drawings of an application on files."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from tests.cli.commandline import run

cv2 = pytest.importorskip("cv2", reason="needs the extra inspection")

from tests.inspection.cells import board, write_cell  # noqa: E402

if TYPE_CHECKING:
    from pathlib import Path

SPOT = "7: {name: spot, present: {grey: [200, 255], area: [10, 9000]}}"


@pytest.fixture
def cell(tmp_path: Path) -> str:
    """Return a cell file, with a folder of two pictures beside it."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    cv2.imwrite(str(folder / "10.png"), board())
    cv2.imwrite(str(folder / "9.png"), board((30, 20, 40, 10, 250)))
    (folder / "notes.txt").write_text("none", encoding="utf-8")
    return str(write_cell(tmp_path, SPOT))


def test_prints_what_it_saw_of_each_picture_in_the_order_of_their_numbers(
    cell: str, tmp_path: Path
) -> None:
    done = run("inspect", cell, "line1/cam1", "spot", str(tmp_path / "pictures"), "--json")
    assert done.code == 0
    first, second = map(json.loads, done.out.splitlines())
    assert first["file"].endswith("9.png")
    assert (first["ok"], first["value"]["x"], first["value"]["area"]) == (True, 49.5, 400)
    assert second["file"].endswith("10.png")
    assert (second["ok"], second["value"]["x"]) == (False, None)
    assert second["reason"] == "0 spots, expected 1 to 1000"
    text = run("inspect", cell, "line1/cam1", "7", str(tmp_path / "pictures" / "9.png"))
    assert "9.png: ok, " in text.out
    assert "  x = 49.5 px\n" in text.out


def test_draws_what_it_saw_and_a_page_of_all(cell: str, tmp_path: Path) -> None:
    seen = tmp_path / "seen"
    pictures = str(tmp_path / "pictures")
    done = run("inspect", cell, "line1/cam1", "7", pictures, "--output", str(seen))
    assert done.code == 0
    assert sorted(one.name for one in seen.iterdir()) == ["0001-9.png", "0002-10.png", "index.html"]
    drawn = cv2.imread(str(seen / "0001-9.png"))
    assert drawn.shape == (100, 200, 3)
    blue, green, red = map(int, drawn[20, 30])
    assert green > 150 > max(blue, red)  # the edge of what was found
    page = (seen / "index.html").read_text(encoding="utf-8")
    assert page.count("<figure") == 2
    assert 'class="not-ok"><img src="0002-10.png"' in page


def test_picture_that_is_none_does_not_stop_the_others(cell: str, tmp_path: Path) -> None:
    (tmp_path / "pictures" / "1.png").write_bytes(b"no picture")
    done = run("inspect", cell, "line1/cam1", "7", str(tmp_path / "pictures"), "--json")
    assert done.code == 5
    lines = [json.loads(line) for line in done.out.splitlines()]
    assert len(lines) == 3
    assert "expected PNG, JPEG, BMP or TIFF, got 10 bytes" in lines[0]["error"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("line1/cam2", "7"), "no software camera 'line1/cam2'; there are line1/cam1; did you"),
        (("line1/cam1", "8"), "no application '8'; there are 7 (spot)"),
        (("line1/cam1", "7", "--input", "xy"), "--input: 'xy' is no hex"),
        (("line1/cam1", "7", "--units", "mile"), "unit 'mile' is unknown"),
    ],
)
def test_what_is_not_there_is_wrong_usage(
    cell: str, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    done = run("inspect", cell, *arguments[:2], str(tmp_path / "pictures"), *arguments[2:])
    assert done.code == 2
    assert message in done.err


def test_empty_folder_is_wrong_usage(cell: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    done = run("inspect", cell, "line1/cam1", "7", str(tmp_path / "empty"))
    assert (done.code, "there is no picture in this folder" in done.err) == (2, True)
