"""The check of a calibration: its result, its files and its refusals."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from smartcam.calibration import Folder, PlaneCalibration, fit_plane, fit_touches
from smartcam.calibration.wizards import WizardSession, drift_wizard
from smartcam.calibration.wizards._verification import MAX_TOUCHES, touches_needed
from smartcam.exceptions import CalibrationError
from smartcam.models import Header, Localization, Pose, Position, Quaternion
from tests.calibration.inside import Journal, write
from tests.calibration.wizards.bench import GRID, Bench, say, where

SIGMA = 0.0002
SHIFT = np.array([0.0, 0.001, 0.0])


def calibrated(seed: int = 1, sigma: float | None = SIGMA, **options: Any) -> PlaneCalibration:
    """Return a calibration from nine touches with noise."""
    noise = np.random.default_rng(seed).normal(0.0, SIGMA, (len(GRID), 3))
    touched = np.array([where(*mark) for mark in GRID]) + noise
    return fit_plane(GRID, touched, touch_sigma=sigma, model="similarity", **options)


def begin(
    tmp_path: Path,
    bench: Bench,
    *,
    reads: bool = False,
    journal: Path | None = None,
    y_down: bool | None = None,
    **more: Any,
) -> WizardSession:
    folder = Folder(tmp_path)
    wizard = drift_wizard(
        localize=bench.localize,
        find=folder.find,
        record_to=folder.checks,
        read_robot=bench.read_robot if reads else None,
        y_down=y_down,
    )
    opened = None if journal is None else Journal(journal)
    return WizardSession(wizard, opened, parameters={"name": "table", **more})


def saved(tmp_path: Path, calibration: PlaneCalibration, tool: str = "pin") -> None:
    write(tmp_path / "table.json", "plane", calibration.to_data(), context={"tool": tool})


async def touch(session: WizardSession, bench: Bench, by: Any = (0.0, 0.0, 0.0)) -> dict[str, Any]:
    """Take a picture and touch all its marks with a given offset."""
    view = await say(session)
    if view["step"] == "which":
        view = await say(session)
    for mark in bench.marks:
        place = np.array(bench.touch(*mark)) + by
        view = await say(session, dict(zip("xyz", (1e3 * place).tolist(), strict=True)))
    return view


async def test_check_of_an_unmoved_camera_holds_and_is_noted(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    bench = Bench([GRID[4], GRID[0]], SIGMA)
    session = begin(tmp_path, bench)
    assert session.current["title"] == "Is table still true?"
    view = await say(session)
    assert view["notes"][0].endswith(" UTC, with the tool 'pin'")
    view = await touch(session, bench)
    assert view["title"] == "table still holds"
    assert view["notes"][0].startswith("2 touches: 0.")
    assert view["notes"][2] == (
        "a knock of 1 mm is noticed in 95 of 100 checks with 2 touches of the mark of touch 1"
    )
    result = (await say(session))["result"]
    assert (result["stale"], result["touches"], result["needed"]) == (False, 2, 2)
    assert result["rms_mm"] < 2 * result["expected_mm"]
    assert result["file"] == "table.checks.jsonl"


async def test_check_after_a_knock_finds_it_stale(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    bench = Bench([GRID[2], GRID[4], GRID[6]], SIGMA)
    session = begin(tmp_path, bench, unit="mm")
    await say(session)
    view = await touch(session, bench, SHIFT)
    assert view["title"] == "table is stale"
    assert view["preview"]["worst"] == np.argmax(
        [np.linalg.norm(one["residual"]) for one in view["preview"]["points"]]
    )
    assert view["preview"]["points"][1]["residual"][1] == pytest.approx(0.000866, abs=0.0005)
    result = (await say(session))["result"]
    assert result["stale"]
    assert result["z"] > 3
    assert result["rms_mm"] == pytest.approx(1.0, abs=0.3)


async def test_check_with_a_robot_that_is_read_needs_no_typing(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    bench = Bench(GRID[:1])
    session = begin(tmp_path, bench, reads=True)
    assert list(session.current["schema"]["properties"]) == ["touch_sigma"]
    await say(session)
    await say(session)
    bench.touch(*GRID[0])
    view = await say(session)
    assert view["title"] == "table still holds"
    session.close()


async def test_check_goes_on_until_it_is_finished(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    bench = Bench(GRID[:1], SIGMA)
    session = begin(tmp_path, bench)
    await say(session)
    await touch(session, bench)
    view = await say(session, {"next": "more"})
    assert view["notes"][1] == "1 touch so far"
    assert not (tmp_path / "table.checks.jsonl").exists()
    bench.marks = [GRID[8]]
    view = await touch(session, bench)
    assert [one["camera"] for one in view["preview"]["points"]] == [list(GRID[0]), list(GRID[8])]
    assert (await say(session))["result"]["touches"] == 2


async def test_check_without_a_mark_takes_another_picture(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    session = begin(tmp_path, Bench(GRID[:2]))
    await say(session)
    await say(session)
    view = await say(session, {"mark_1": False, "mark_2": False})
    assert view["step"] == "picture"
    session.close()


async def test_checks_are_lines_of_one_file_with_their_samples(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    before = (tmp_path / "table.json").read_bytes()
    for by in (np.zeros(3), SHIFT):
        bench = Bench(GRID[:3], SIGMA)
        session = begin(tmp_path, bench)
        await say(session)
        await touch(session, bench, by)
        await say(session)
    lines = (tmp_path / "table.checks.jsonl").read_text().splitlines()
    first, *checks = [json.loads(line) for line in lines]
    assert first == {"schema": "smartcam.checks/1", "name": "table"}
    assert [one["stale"] for one in checks] == [False, True]
    assert [one["camera"] for one in checks[1]["samples"]] == [list(one) for one in GRID[:3]]
    assert np.linalg.norm(checks[1]["samples"][0]["offset"]) == pytest.approx(0.001, abs=0.0006)
    assert (tmp_path / "table.json").read_bytes() == before
    assert Folder(tmp_path).names() == ["table"]


async def test_check_resumed_uses_the_calibration_that_it_began_with(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    bench, journal = Bench(GRID[:1]), tmp_path / "table.drift.journal"
    session = begin(tmp_path, bench, journal=journal)
    await say(session)
    session.close()
    (tmp_path / "table.json").unlink()
    session = begin(tmp_path, bench, journal=journal)
    view = await touch(session, bench)
    assert view["title"] == "table still holds"
    session.close()


async def test_check_with_another_y_down_than_the_calibration_keeps_the_step(
    tmp_path: Path,
) -> None:
    saved(tmp_path, calibrated(y_down=True))
    session = begin(tmp_path, Bench(), y_down=False)
    view = await session.submit(session.token)
    assert (view["step"], view["errors"]) == ("about", {
        "base": "table has y_down=True, now it is False, and everything would be "
        "mirrored; expected y_down=True"
    })  # fmt: skip
    session.close()


async def test_check_resumed_with_another_y_down_takes_no_picture(tmp_path: Path) -> None:
    saved(tmp_path, calibrated(y_down=False))
    bench, journal = Bench(GRID[:1]), tmp_path / "table.drift.journal"
    session = begin(tmp_path, bench, journal=journal, y_down=False)
    await say(session)
    session.close()
    session = begin(tmp_path, bench, journal=journal, y_down=True)
    view = await session.submit(session.token)
    assert view["errors"]["base"].startswith("table has y_down=False, now it is True")
    assert bench.pictures == 0
    session.close()


async def test_check_of_a_calibration_with_a_point_left_out_does_not_count_it(
    tmp_path: Path,
) -> None:
    touched = np.array([where(*mark) for mark in GRID])
    touched[4] += 1000.0
    saved(tmp_path, fit_plane(GRID, touched, touch_sigma=SIGMA, robust=True))
    bench = Bench([GRID[4]], SIGMA)
    session = begin(tmp_path, bench)
    await say(session)
    view = await touch(session, bench)
    assert view["title"] == "table still holds"
    assert np.ptp(view["preview"]["view"], axis=0).max() < 0.5
    assert [one["left_out"] for one in view["preview"]["points"]] == [False]
    session.close()


@pytest.mark.parametrize(
    ("frame", "marks", "text"),
    [
        ("eye", GRID[:1], "localizations are in frame 'camera', the calibration expected 'eye'"),
        (None, [], "the camera found 0 marks among 0 localizations; expected 1 to 25"),
    ],
)
async def test_check_of_a_picture_that_does_not_fit_keeps_the_step(
    tmp_path: Path, frame: str | None, marks: list[Any], text: str
) -> None:
    saved(tmp_path, calibrated(camera_frame=frame))
    session = begin(tmp_path, Bench(marks))
    await say(session)
    view = await session.submit(session.token)
    assert view["step"] == "picture"
    assert text in view["errors"]["base"]
    session.close()


async def test_check_of_too_many_touches_keeps_the_step(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    bench = Bench([*GRID, *GRID, *GRID[:7]])
    session = begin(tmp_path, bench)
    await say(session)
    for _ in range(MAX_TOUCHES // 25):
        await touch(session, bench)
        await say(session, {"next": "more"})
    bench.marks = bench.marks[:1]
    view = await session.submit(session.token)
    assert view["errors"] == {"base": "101 touches, expected 100 at most"}
    session.close()


async def test_check_of_a_calibration_without_sigma_asks_for_it(tmp_path: Path) -> None:
    unknown = replace(calibrated(), touch_sigma=None, sigma_given=False)
    saved(tmp_path, unknown)
    bench = Bench(GRID[4:5])
    session = begin(tmp_path, bench)
    view = await session.submit(session.token)
    assert view["errors"] == {
        "touch_sigma": "no answer, and the calibration has none: expected one"
    }
    await say(session, {"touch_sigma": 0.2})
    view = await touch(session, bench)
    assert view["title"] == "table still holds"
    session.close()


async def test_check_of_a_missing_calibration_keeps_the_step(tmp_path: Path) -> None:
    session = begin(tmp_path, Bench())
    view = await session.submit(session.token)
    assert view["errors"] == {"base": "no calibration 'table'; there are none: the folder is empty"}
    session.close()


async def test_check_of_an_uncertain_mark_reports_it(tmp_path: Path) -> None:
    saved(tmp_path, replace(calibrated(), touch_sigma=0.001))
    bench = Bench(GRID[:1])
    session = begin(tmp_path, bench)
    await say(session)
    view = await touch(session, bench)
    assert view["notes"][2].endswith(
        "with no number of touches of these marks: the calibration is too uncertain there"
    )
    assert (await say(session))["result"]["needed"] is None


async def test_check_whose_file_is_a_link_is_refused(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    (tmp_path / "table.checks.jsonl").symlink_to(tmp_path / "made")
    bench = Bench(GRID[:1])
    session = begin(tmp_path, bench)
    await say(session)
    await touch(session, bench)
    view = await session.submit(session.token)
    assert "expected no symbolic link" in view["errors"]["base"]
    assert not (tmp_path / "made").exists()
    session.close()


async def test_check_of_a_calibration_by_rays_holds(tmp_path: Path) -> None:
    header = Header(0, datetime.now(UTC), "")
    origin = Localization("mark", 1.0, 0, Pose(header, Position(0.0, 0.0), Quaternion()))
    o, a, b = (where(*place) for place in ((0.0, 0.0), (0.2, 0.0), (0.0, 0.15)))
    saved(tmp_path, fit_touches(origin, o, a, b, nominal_scale=1.0, touch_sigma=SIGMA))
    bench = Bench([(0.1, 0.1)])
    session = begin(tmp_path, bench)
    await say(session)
    view = await touch(session, bench)
    assert view["title"] == "table still holds"
    session.close()


async def test_check_over_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    saved(tmp_path, calibrated())
    (tmp_path / "table.checks.jsonl").write_text('{"schema":"mine"}\n')
    bench = Bench(GRID[:1])
    session = begin(tmp_path, bench)
    await say(session)
    await touch(session, bench)
    view = await session.submit(session.token)
    assert view["errors"] == {
        "base": "table.checks.jsonl: schema 'mine', expected 'smartcam.checks/1'"
    }
    session.close()


# ---------------------------------------------------------------------- how many touches


@functools.cache
def sample(sigma: float | None) -> list[PlaneCalibration]:
    return [calibrated(seed, sigma) for seed in range(200)]


@pytest.mark.long
@pytest.mark.parametrize(("sigma", "mark"), [(SIGMA, GRID[0]), (SIGMA, GRID[4]), (None, GRID[4])])
def test_touches_needed_notice_a_knock_at_the_stated_rate(
    sigma: float | None, mark: tuple[float, float]
) -> None:
    known = replace(calibrated(), sigma_given=sigma is not None)
    count = touches_needed(known, mark)
    assert count is not None
    random, found = np.random.default_rng(5), {count: 0, count - 1: 0}
    for calibration in sample(sigma):
        for number in filter(None, found):
            again = random.normal(where(*mark), SIGMA, (number, 3)) + calibration.normal * 0.001
            found[number] += calibration.check([mark] * number, again).stale
    assert found[count] >= 0.92 * 200
    assert found[count - 1] < 0.97 * 200


def test_touches_needed_grow_with_sigma_until_none_are_enough() -> None:
    needed = [touches_needed(replace(calibrated(), touch_sigma=sigma), GRID[0])
              for sigma in (0.0, 0.0001, 0.0002, 0.0003, 0.001)]  # fmt: skip
    assert needed[:2] == [1, 1]
    assert needed[4] is None
    known = [one for one in needed if one is not None]
    assert known == sorted(known)


def test_touches_needed_of_a_calibration_without_sigma_raises() -> None:
    with pytest.raises(CalibrationError, match="expected touch_sigma") as caught:
        touches_needed(replace(calibrated(), touch_sigma=None), GRID[0])
    assert caught.value.code == "UNVERIFIED"
