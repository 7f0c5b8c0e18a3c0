"""The wizard of the plane: both ways, refusals, and saved files."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import PlaneCalibration
from smartcam.calibration.wizards import WizardSession, plane_wizard
from tests.calibration.inside import Journal, read_document
from tests.calibration.wizards.bench import GRID, OFFSET, Bench, say, where
from tests.processes import printed_by

MAX_MARKS = 25


def begin(
    folder: Path,
    bench: Bench,
    *,
    reads: bool = False,
    y_down: bool | None = None,
    journal: Path | None = None,
    **parameters: Any,
) -> WizardSession:
    wizard = plane_wizard(
        localize=bench.localize,
        save_to=lambda name: folder / f"{name}.json",
        read_robot=bench.read_robot if reads else None,
        y_down=y_down,
    )
    opened = None if journal is None else Journal(journal)
    return WizardSession(wizard, opened, parameters={"name": "table", **parameters})


async def touch_all(session: WizardSession, bench: Bench) -> dict[str, Any]:
    """Take a picture and touch all marks of it."""
    view = await say(session)
    if view["step"] == "which":
        view = await say(session)
    for x, y in bench.marks:
        assert view["step"].startswith("touch-")
        assert f"x {1e3 * x:.1f} mm, y {1e3 * y:.1f} mm" in view["description"]
        view = await say(session, bench.touch_mm(x, y))
    return view


async def test_marks_touched_give_a_calibration_in_a_file(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    view = await say(session, {"touch_sigma": 0.2, "tool": "pin"})
    assert (view["step"], view["button"]) == ("picture", "Take a picture")
    view = await touch_all(session, bench)
    assert (view["step"], view["defaults"]["next"]) == ("review", "accept")
    assert view["notes"][0].endswith("from 9 points")
    assert [note.split()[0] for note in view["notes"][1:4]] == [
        "residual", "held-out", "predicted",
    ]  # fmt: skip
    view = await say(session)
    assert (view["step"], view["title"]) == ("save", "Save table")
    view = await say(session)
    assert view["type"] == "result"
    assert view["result"]["file"] == "table.json"
    assert view["result"]["predicted_mm"] < 0.3
    calibration = PlaneCalibration.load(tmp_path / "table.json")
    error = calibration.transform([[0.15, 0.12]])[0] - where(0.15, 0.12)
    assert np.linalg.norm(error) < 0.0005
    context = read_document(tmp_path / "table.json").context
    assert context["frames"] == {"camera": None, "robot": "robot"}
    assert context["tool"] == "pin"
    assert [one["camera"][:2] for one in context["samples"]] == [list(one) for one in GRID]
    assert context["samples"][0]["tool_z"] == [0.0, 0.0, -1.0]


async def test_marks_with_a_robot_that_is_read_need_no_typing(tmp_path: Path) -> None:
    bench = Bench(marks=GRID[:1])
    session = begin(tmp_path, bench, reads=True)
    assert "side" not in session.current["schema"]["properties"]
    await say(session, {"touch_sigma": 0.2})
    for mark in (GRID[0], GRID[2], GRID[6]):
        bench.marks = [mark]
        view = await say(session)
        assert (view["type"], view["button"]) == ("confirm", "It is there")
        bench.touch(*mark)
        view = await say(session)
    assert (view["step"], view["verdict"]["level"]) == ("review", "unknown")
    assert "3 points can look right: touch 5 or more" in view["verdict"]["text"]
    assert view["defaults"]["next"] == "more"
    await say(session, {"next": "accept"})
    await say(session)
    calibration = PlaneCalibration.load(tmp_path / "table.json")
    assert np.allclose(calibration.origin, OFFSET, atol=1e-12)
    assert bench.pictures == 3


async def test_mark_left_out_is_not_touched(tmp_path: Path) -> None:
    bench = Bench(marks=GRID[:4])
    session = begin(tmp_path, bench)
    await say(session)
    view = await say(session)
    assert view["defaults"] == {f"mark_{number}": True for number in range(1, 5)}
    view = await say(session, {"mark_1": False, "mark_2": False, "mark_3": False})
    assert view["title"] == "Touch mark 1 of 1"
    view = await say(session, bench.touch_mm(*GRID[3]))
    assert (view["step"], view["notes"]) == ("picture", ["1 points so far"])
    session.close()


async def test_wrong_touch_is_named_the_worst_and_touched_again(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0001)
    session = begin(tmp_path, bench)
    await say(session, {"touch_sigma": 0.1})
    await say(session)
    await say(session)
    for number, mark in enumerate(GRID, 1):
        answer = bench.touch_mm(*mark)
        view = await say(session, {**answer, "y": answer["y"] + (5.0 if number == 4 else 0.0)})
    assert view["defaults"] == {"next": "redo", "point": 4}
    assert view["verdict"] == {"level": "poor", "text": "Not good enough: touch point 4 again"}
    assert view["preview"]["worst"] == 3
    view = await say(session)
    assert view["title"] == "Touch point 4 again"
    view = await say(session, bench.touch_mm(*GRID[3]))
    await say(session, {"next": "accept"})
    view = await say(session)
    assert view["result"]["held_out_mm"] < 0.4


async def test_exchanged_touches_are_put_right_by_one_answer(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0001)
    session = begin(tmp_path, bench)
    for _ in range(3):
        view = await say(session)
    for number in (0, 1, 5, 3, 4, 2, 6, 7, 8):
        view = await say(session, bench.touch_mm(*GRID[number]))
    assert view["defaults"]["next"] == "reorder"
    assert view["verdict"]["level"] == "poor"
    assert any("points 3 and 6 look exchanged" in note for note in view["notes"])
    view = await say(session)
    assert (view["verdict"]["level"], view["defaults"]["next"]) == ("good", "accept")
    await say(session)
    view = await say(session)
    assert view["result"]["held_out_mm"] < 0.4


async def test_touches_in_an_order_that_a_grid_does_not_tell_are_touched_again(
    tmp_path: Path,
) -> None:
    bench = Bench(sigma=0.0001)
    session = begin(tmp_path, bench)
    for _ in range(3):
        view = await say(session)
    for number in (1, 2, 3, 4, 5, 6, 7, 8, 0):
        view = await say(session, bench.touch_mm(*GRID[number]))
    assert "reorder" not in [one["const"] for one in view["schema"]["properties"]["next"]["oneOf"]]
    assert (view["verdict"]["level"], view["defaults"]["next"]) == ("poor", "redo")


async def test_error_beyond_the_allowed_one_is_not_good(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    await say(session, {"touch_sigma": 0.2, "allowed": 0.5})
    view = await touch_all(session, bench)
    assert (view["verdict"]["level"], view["defaults"]["next"]) == ("poor", "more")
    assert "but 0.5 mm are allowed" in view["verdict"]["text"]


async def touch_some_wrong(
    session: WizardSession, bench: Bench, wrong: Mapping[int, float]
) -> dict[str, Any]:
    """Touch all nine marks, some of them off by a number of millimetres; return the review."""
    await say(session, {"touch_sigma": 0.2})
    await say(session)
    view = await say(session)
    for number, mark in enumerate(GRID, 1):
        answer = bench.touch_mm(*mark)
        view = await say(session, {**answer, "x": answer["x"] + wrong.get(number, 0.0)})
    assert view["step"] == "review"
    return view


async def test_one_wrong_touch_again_and_again_gets_another_advice(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    view = await touch_some_wrong(session, bench, {4: 5.0})
    assert view["defaults"] == {"next": "redo", "point": 4}
    await say(session, {"next": "redo", "point": 4})
    answer = bench.touch_mm(*GRID[3])
    view = await say(session, {**answer, "x": answer["x"] + 5.0})
    assert view["defaults"] == {"next": "remove", "point": 4}
    assert "point 4 was touched again, and still does not agree" in view["verdict"]["text"]
    view = await say(session, {"next": "remove", "point": 4})
    assert view["verdict"]["level"] == "good"


def choices(view: dict[str, Any]) -> list[str]:
    return [one["const"] for one in view["schema"]["properties"]["next"]["oneOf"]]


async def test_wrong_touches_can_be_left_out_and_count_nowhere(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    view = await touch_some_wrong(session, bench, {3: 5.0, 6: -5.0})
    assert choices(view) == ["accept", "more", "redo", "remove", "robust"]
    view = await say(session, {"next": "robust"})
    assert view["notes"][0] == "model rigid from 7 of 9 points"
    said = [note.partition(" is left out")[0] for note in view["notes"] if "left out" in note]
    assert said == ["OUTLIER: point 3", "OUTLIER: point 6"]
    assert (choices(view)[-1], view["defaults"]["point"]) == ("all", 3)
    left_out = [one["label"] for one in view["preview"]["points"] if one["left_out"]]
    assert left_out == ["3", "6"]
    await say(session)
    result = (await say(session))["result"]
    assert (result["points"], result["left_out"]) == (7, [3, 6])
    assert max(result["residual_mm"], result["held_out_mm"]) < 0.8
    assert PlaneCalibration.load(tmp_path / "table.json").outliers == (2, 5)


async def test_points_left_out_can_count_again_or_be_touched_again(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    plain = await touch_some_wrong(session, bench, {4: 5.0})
    await say(session, {"next": "robust"})
    view = await say(session, {"next": "all"})
    assert (view["notes"], choices(view)) == (plain["notes"], choices(plain))
    await say(session, {"next": "robust"})
    view = await say(session, {"next": "redo"})
    assert view["title"] == "Touch point 4 again"
    view = await say(session, bench.touch_mm(*GRID[3]))
    assert view["notes"][0].endswith("from 9 points")
    session.close()


async def test_points_that_agree_are_not_offered_to_be_left_out(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    assert "robust" not in choices(await touch_some_wrong(session, bench, {}))
    session.close()


async def test_points_left_out_down_to_five_all_count(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    await touch_some_wrong(session, bench, {4: 5.0})
    view = await say(session, {"next": "robust"})
    for _ in range(4):
        view = await say(session, {"next": "remove"})
    assert view["notes"][0].endswith("from 5 points")
    session.close()


async def test_wizard_resumed_leaves_out_the_same_points(tmp_path: Path) -> None:
    bench, journal = Bench(sigma=0.0002), tmp_path / "table.journal"
    session = begin(tmp_path, bench, journal=journal)
    await touch_some_wrong(session, bench, {3: 5.0, 6: -5.0})
    before = await say(session, {"next": "robust"})
    session.close()
    session = begin(tmp_path, bench, journal=journal)
    assert session.current == before
    await say(session)
    assert (await say(session))["result"]["left_out"] == [3, 6]
    session.close()


@pytest.mark.parametrize("y_down", [True, False, None])
@pytest.mark.parametrize("method", ["marks", "rays"])
async def test_wizard_keeps_y_down_with_the_calibration(
    tmp_path: Path, y_down: bool | None, method: str
) -> None:
    bench = Bench(marks=GRID[:1] if method == "rays" else [GRID[0], GRID[2], GRID[6]])
    session = begin(tmp_path, bench, y_down=y_down, method=method)
    view = await say(session)
    if method == "rays":
        await say(session)
        await say(session)
        for mark in (GRID[0], GRID[2], GRID[6]):
            view = await say(session, bench.touch_mm(*mark))
    else:
        view = await touch_all(session, bench)
    assert (view["step"], view["verdict"]["level"]) == ("review", "unknown")
    await say(session, {} if method == "rays" else {"next": "accept"})
    await say(session)
    assert PlaneCalibration.load(tmp_path / "table.json").y_down is y_down


async def test_wizard_resumed_with_another_y_down_takes_no_picture(tmp_path: Path) -> None:
    bench, journal = Bench(marks=GRID[:1]), tmp_path / "table.journal"
    session = begin(tmp_path, bench, y_down=True, journal=journal)
    await say(session)
    await touch_all(session, bench)
    session.close()
    session = begin(tmp_path, bench, y_down=False, journal=journal)
    view = await session.submit(session.token)
    assert view["errors"] == {
        "base": "the previous picture has y_down=True, now it is False, and everything "
        "would be mirrored; expected y_down=True"
    }
    assert bench.pictures == 1
    session.close()


async def test_marks_in_a_line_are_reported_and_more_can_be_added(tmp_path: Path) -> None:
    bench = Bench(marks=GRID[:3])
    session = begin(tmp_path, bench)
    await say(session)
    view = await touch_all(session, bench)
    assert view["notes"][0].startswith("COLLINEAR: ")
    options = [one["const"] for one in view["schema"]["properties"]["next"]["oneOf"]]
    assert options == ["more", "redo", "remove"]
    assert (await session.submit(session.token, {"next": "accept"}))["errors"]["next"].startswith(
        "'accept': expected one of more"
    )
    view = await say(session, {"next": "more"})
    bench.marks = [GRID[8]]
    view = await touch_all(session, bench)
    assert view["notes"][0].endswith("from 4 points")
    session.close()


async def test_removed_point_is_gone_and_with_too_few_left_a_picture_is_taken(
    tmp_path: Path,
) -> None:
    bench = Bench(marks=[GRID[0], GRID[2], GRID[6], GRID[8]])
    session = begin(tmp_path, bench)
    await say(session)
    await touch_all(session, bench)
    view = await say(session, {"next": "remove", "point": 2})
    assert [one["camera"] for one in view["preview"]["points"]] == [
        list(GRID[0]), list(GRID[6]), list(GRID[8]),
    ]  # fmt: skip
    view = await say(session, {"next": "remove", "point": 1})
    assert view["step"] == "picture"
    session.close()


@pytest.mark.parametrize("count", [0, MAX_MARKS + 1])
async def test_picture_with_no_mark_or_too_many_keeps_the_step(tmp_path: Path, count: int) -> None:
    session = begin(tmp_path, Bench(marks=[(0.01 * i, 0.0) for i in range(count)]))
    await say(session)
    view = await session.submit(session.token)
    assert view["step"] == "picture"
    assert view["errors"]["base"].startswith(f"the camera found {count} marks among {count} ")
    session.close()


async def test_feature_of_another_name_does_not_count(tmp_path: Path) -> None:
    session = begin(tmp_path, Bench(), feature="origin")
    await say(session)
    view = await session.submit(session.token)
    assert view["errors"]["base"] == (
        "the camera found 0 marks 'origin' among 9 localizations; expected 1 to 25"
    )
    session.close()


async def test_rays_touched_give_the_thesis_calibration_with_the_ruler_s_scale(
    tmp_path: Path,
) -> None:
    bench = Bench(marks=[(0.02, 0.03)])
    session = begin(tmp_path, bench, method="rays")
    view = await say(session, {"touch_sigma": 0.2})
    assert (view["step"], view["defaults"]) == ("scale", {"ruler": 100.0})
    view = await say(session, {"ruler": 101.0})
    assert view["step"] == "origin"
    view = await say(session)
    for letter, (along, across) in {"O": (0, 0), "A": (0.2, 0), "B": (0, 0.15)}.items():
        assert (view["step"], view["preview"]) == (f"touch-{letter}", None)
        x = 0.02 + along * np.cos(0.3) - across * np.sin(0.3)
        y = 0.03 + along * np.sin(0.3) + across * np.cos(0.3)
        view = await say(session, bench.touch_mm(x, y))
    assert view["step"] == "review"
    assert [one["label"] for one in view["preview"]["points"]] == ["O", "A", "B"]
    assert [note.split(":")[0] for note in view["notes"] if note[0].isupper()] == [
        "SCALE_ASSUMED", "NOT_HELD_OUT",
    ]  # fmt: skip
    await say(session)
    view = await say(session)
    assert (view["result"]["model"], view["result"]["held_out_mm"]) == ("touches", None)
    calibration = PlaneCalibration.load(tmp_path / "table.json")
    points = calibration.transform([[0.02, 0.03], [0.12, 0.03]])
    assert np.allclose(points[0], where(0.02, 0.03), atol=1e-12)
    assert np.linalg.norm(points[1] - points[0]) == pytest.approx(0.101)


async def test_rays_in_a_line_keep_the_last_touch(tmp_path: Path) -> None:
    bench = Bench(marks=[(0.0, 0.0)])
    session = begin(tmp_path, bench, method="rays", camera_unit="px")
    await say(session)
    await say(session, {"pixel": 0.25})
    await say(session)
    await say(session, bench.touch_mm(0.0, 0.0))
    await say(session, bench.touch_mm(0.2, 0.0))
    view = await session.submit(session.token, bench.touch_mm(0.3, 0.0))
    assert view["step"] == "touch-B"
    assert "base" in view["errors"]
    view = await say(session, bench.touch_mm(0.0, 0.2))
    assert view["step"] == "review"
    session.close()


async def test_one_of_several_marks_can_be_the_origin(tmp_path: Path) -> None:
    bench = Bench(marks=GRID[:3])
    session = begin(tmp_path, bench, method="rays")
    await say(session)
    await say(session)
    view = await say(session)
    assert view["title"] == "Which one is the origin?"
    view = await say(session, {"mark": "2"})
    assert view["step"] == "touch-O"
    session.close()


async def test_parameters_are_defaults_of_the_first_step(tmp_path: Path) -> None:
    session = begin(tmp_path, Bench(), unit="m", robot_frame="base", touch_sigma=0.3)
    defaults = session.current["defaults"]
    assert (defaults["unit"], defaults["robot_frame"], defaults["touch_sigma"]) == (
        "m", "base", 0.3,
    )  # fmt: skip
    session.close()


async def test_preview_has_residuals_and_covariances_and_is_json(tmp_path: Path) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    await say(session)
    view = await touch_all(session, bench)
    preview = view["preview"]
    assert json.loads(json.dumps(preview, allow_nan=False)) == preview
    point = preview["points"][4]
    assert point["robot"] == pytest.approx(where(*GRID[4]), abs=0.001)
    assert np.linalg.norm(point["residual"]) < 0.001
    assert np.linalg.eigvalsh(point["covariance"])[0] > 0
    assert np.linalg.norm(point["at"]) < 0.001
    session.close()


async def test_wizard_resumed_after_each_step_gives_the_same_calibration(tmp_path: Path) -> None:
    bench, path = Bench(sigma=0.0002), tmp_path / "table.journal"

    def opened() -> WizardSession:
        return WizardSession(
            begin(tmp_path, bench).wizard, Journal(path), parameters={"name": "table"}
        )

    answers: list[Any] = [None, None, None, *(bench.touch_mm(*mark) for mark in GRID), None, None]
    for answer in answers:
        session = opened()
        await say(session, answer)
        session.close()
    session = opened()
    assert session.state == "ended"
    assert session.result["points"] == 9
    assert bench.pictures == 1
    session.close()


async def test_wrong_touch_that_looks_like_another_scale_is_blamed(tmp_path: Path) -> None:
    bench = Bench(marks=[GRID[n] for n in (0, 2, 3, 5, 6, 8)])
    session = begin(tmp_path, bench)
    await say(session, {"touch_sigma": 0.2})
    await say(session)
    view = await say(session)
    for number, mark in enumerate(bench.marks, 1):
        answer = bench.touch_mm(*mark)
        view = await say(session, {**answer, "x": answer["x"] + 20.0 * (number == 2)})
    assert view["notes"][0].startswith("SCALE_MISMATCH: ")
    assert view["verdict"]["text"] == "Not good enough: touch point 2 again"
    assert view["defaults"] == {"next": "redo", "point": 2}
    session.close()


async def test_marks_can_be_chosen_in_the_picture(tmp_path: Path) -> None:
    session = begin(tmp_path, Bench(marks=GRID[:3]))
    await say(session)
    view = await say(session)
    titles = [one["title"] for one in view["schema"]["properties"].values()]
    assert titles[1] == "2: mark at x 150.0 mm, y 40.0 mm"
    assert view["preview"]["choices"] == [
        {"at": list(mark), "label": str(number), "answers": {f"mark_{number}": True}}
        for number, mark in enumerate(GRID[:3], 1)
    ]
    session.close()


async def test_origin_mark_of_a_camera_in_pixels_is_shown_in_pixels(tmp_path: Path) -> None:
    session = begin(tmp_path, Bench(marks=[(320.25, 240.0), (10.0, 7.0)]), method="rays")
    await say(session, {"camera_unit": "px"})
    await say(session, {"pixel": 0.5})
    view = await say(session)
    (marks,) = [one["oneOf"] for one in view["schema"]["properties"].values()]
    assert marks[0]["title"] == "mark at x 320.2 px, y 240.0 px"
    assert [one["answers"] for one in view["preview"]["choices"]] == [{"mark": "1"}, {"mark": "2"}]
    session.close()


async def test_end_has_the_file_the_verdict_the_picture_and_lines_that_work(
    tmp_path: Path,
) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    await say(session, {"touch_sigma": 0.2})
    review = await touch_all(session, bench)
    await say(session)
    view = await say(session)
    result = view["result"]
    assert result["path"] == str(tmp_path / "table.json")
    assert view["verdict"] == review["verdict"]
    assert view["verdict"]["text"].startswith(f"Good for {result['good_for_mm']:g} mm")
    assert view["preview"] == review["preview"]
    program, *_, last = shlex.split(result["use"]["command"])
    assert (program, last) == ("smartcam", str(tmp_path))
    printed = printed_by(result["use"]["python"])
    told = [float(one) for one in printed.strip("[]\n").split()]
    assert told == pytest.approx(where(*GRID[0]), abs=0.001)


async def test_wizard_asks_for_a_missing_side_before_a_good_verdict(
    tmp_path: Path,
) -> None:
    bench = Bench(sigma=0.0002)
    session = begin(tmp_path, bench)
    await say(session, {"touch_sigma": 0.2, "side": "unknown"})
    view = await touch_all(session, bench)
    assert (view["verdict"]["level"], view["defaults"]["next"]) == ("unknown", "side")
    view = await say(session)
    assert view["step"] == "side"
    view = await say(session, {"side": "-z"})
    assert (view["verdict"]["level"], view["defaults"]["next"]) == ("good", "accept")
    await say(session)
    await say(session)
    found = PlaneCalibration.load(tmp_path / "table.json")
    assert found.tool_z is not None
    assert found.tool_z.tolist() == [0.0, 0.0, -1.0]


async def test_side_that_contradicts_the_touches_is_reported_as_mirrored(tmp_path: Path) -> None:
    bench = Bench()
    session = begin(tmp_path, bench)
    await say(session, {"touch_sigma": 0.2, "side": "unknown"})
    await touch_all(session, bench)
    await say(session)
    view = await say(session, {"side": "+z"})
    assert (view["verdict"]["level"], view["defaults"]["next"]) == ("poor", "more")
    assert view["notes"][0].startswith("MIRRORED: ")
