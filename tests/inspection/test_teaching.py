"""Teaching: the file keeps its notation, and saved tools equal the tried ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam.exceptions import ConfigurationError
from smartcam.inspection import Picture, load_cell
from smartcam.inspection._inside import Teaching, learn_tolerances, read_settings, setting_text

if TYPE_CHECKING:
    from pathlib import Path

pytest.importorskip("ruamel.yaml")
pytest.importorskip("cv2")

FILE = """\
# the cell of line 1
cameras:
  cam:   # above the belt
    software:
      frames: 'shots'
      applications:
        # spots of glue
        7: {name: "glue", present: {region: [0, 0, 40, 30], grey: [0, 120]}} # one line
        9:
          name: other  # stays
          present:
            grey: [0, 9]   # dark
            region: [0, 0, 9, 9]
  other: {url: bvs://192.168.0.1}
"""

REGION = [0, 0, 64, 48]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(FILE)
    return path


def spots(*sides: int) -> Picture:
    """Return a picture with dark squares."""
    pixels = np.full((48, 64), 200, np.uint8)
    for number, side in enumerate(sides):
        pixels[4 : 4 + side, 4 + 15 * number : 4 + 15 * number + side] = 20
    return Picture(pixels)


def test_only_differences_are_written(path: Path) -> None:
    teaching = Teaching(path, "cam", 9)
    assert teaching.tools == {"present": {"grey": [0, 9], "region": [0, 0, 9, 9]}}
    teaching.save({"present": {"grey": [0, 20], "region": [0, 0, 9, 9], "count": 2}})
    before, after = FILE.splitlines(), path.read_text().splitlines()
    assert [line for line in after if line not in before] == [
        "            grey: [0, 20]  # dark",
        "            count: 2",
    ]
    assert [line for line in before if line not in after] == ["            grey: [0, 9]   # dark"]


def test_a_line_of_its_own_keeps_its_quotes_and_comment(path: Path) -> None:
    Teaching(path, "cam", 7).save({"present": {"region": REGION, "grey": [0, 120]}})
    line = '        7: {name: "glue", present: {region: [0, 0, 64, 48], grey: [0, 120]}} # one line'
    assert line in path.read_text().splitlines()


def test_an_application_may_be_named(path: Path) -> None:
    assert [Teaching(path, "cam", one).application for one in ("glue", "7", 7, "12")] == [
        7,
        7,
        7,
        12,
    ]
    with pytest.raises(ConfigurationError, match=r"no application 'glu'; there are 7 \(glue\)"):
        Teaching(path, "cam", "glu")
    for number in (0, "0", "99999999999"):
        with pytest.raises(ConfigurationError, match="expected an integer, 1 to 4294967295"):
            Teaching(path, "cam", number)


def test_a_new_application_is_added_and_loads(path: Path) -> None:
    Teaching(path, "cam", 12).save({"present": {"grey": [0, 9]}, "present two": {"grey": [3, 4]}})
    camera = load_cell(path)["cam"]
    assert [step.name for step in camera.programs[12].steps] == ["present", "two"]
    assert sorted(camera.programs) == [7, 9, 12]


def test_saving_twice_changes_nothing(path: Path) -> None:
    teaching = Teaching(path, "cam", 9)
    tools = {"present": {"grey": [1, 2]}}
    teaching.save(tools)
    once = path.read_text()
    teaching.save(tools)
    assert path.read_text() == once


def test_concurrent_changes_of_the_file_are_kept(path: Path) -> None:
    teaching = Teaching(path, "cam", 9)
    path.write_text(FILE.replace("# stays", "# changed by hand"))
    teaching.save({"present": {"grey": [1, 2]}})
    assert "# changed by hand" in path.read_text()


@pytest.mark.parametrize(
    ("tools", "said"),
    [
        ({"present": {"gray": [0, 9]}}, "present.gray: .*did you mean 'grey'"),
        ({"present": {"grey": [9, 0]}}, "present.grey"),
        ({"nothing_like_it": {}}, "nothing_like_it"),
        ({"measure": {"width": {"acros": 3}}}, "measure.width.acros: .*did you mean 'across'"),
        ({"measure": {"distance": {"first": {"lin": 3}}}}, "first.lin: .*did you mean 'line'"),
        ({}, "tool"),
    ],
)
def test_a_wrong_setting_is_refused_and_the_file_stays(
    path: Path, tools: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigurationError, match=said):
        Teaching(path, "cam", 9).save(tools)
    assert path.read_text() == FILE


@pytest.mark.parametrize(
    ("camera", "said"), [("cm", "did you mean 'cam'"), ("other", "no software camera 'other'")]
)
def test_unknown_camera_is_refused_with_the_known_ones(path: Path, camera: str, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        Teaching(path, camera, 9)


def test_tolerances_make_the_good_pictures_good_and_others_not(path: Path) -> None:
    teaching = Teaching(path, "cam", 7)
    tools: dict[str, dict[str, Any]] = {"present": {"grey": [0, 120], "area": [1, 9999], "most": 4}}
    good = [spots(10, 10), spots(9, 11), spots(10, 11)]
    program = teaching.program(tools)
    found, remarks = learn_tolerances(
        tools, {str(n): program.inspect(one) for n, one in enumerate(good)}
    )
    assert remarks == [
        "present: 2 spots in each of 3 pictures, of 81 to 121 pixels; area allows 20% less and "
        "more."
    ]
    assert found["present"]["count"] == [2, 2]
    assert found["present"]["area"] == [64, 146]
    taught = teaching.program(found)
    assert all(taught.inspect(one).ok for one in good)
    assert not any(taught.inspect(one).ok for one in (spots(10), spots(10, 10, 10), spots(13, 10)))


def test_tolerances_of_unknown_areas_are_not_learned(path: Path) -> None:
    tools = {"present": {"grey": [0, 120]}}  # only the largest is in the result
    program = Teaching(path, "cam", 7).program(tools)
    found = learn_tolerances(tools, {"one": program.inspect(spots(10, 6))})
    assert found.tools == {"present": {"grey": [0, 120], "count": [2, 2]}}


@pytest.mark.parametrize("value", [[1, 2], 3, 0.5, True, "a", r"\d{3}", {"hue": [1, 2]}, "12", ""])
def test_shown_setting_can_be_read(value: object) -> None:
    text = setting_text(value)
    assert "\n" not in text
    assert read_settings({"tool": {"x": text}}) == {"tool": {"x": value}}


def test_an_empty_setting_is_left_out() -> None:
    assert read_settings({"tool": {"x": "  ", "y": "1"}}) == {"tool": {"y": 1}}
