"""The services over a folder, and that no name leads out of it."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from smartcam.calibration import Folder, PlaneCalibration, fit_plane
from smartcam.calibration.wizards import CalibrationService, plane_wizard
from smartcam.exceptions import CalibrationError
from tests.calibration import lenskit
from tests.calibration.lens import estimates as lenses
from tests.calibration.wizards.bench import GRID, Bench, say, where

BAD_NAMES = [
    "", ".", "..", "../out", "/etc/passwd", "a/b", "a\\b", "a.b", ".hidden", "-a", "a-", "a b",
    "a\x00", "a\n", "ü", "CON", "lpt1", "x" * 65, "~root", "$HOME", "a:b",
]  # fmt: skip


def served(tmp_path: Path, bench: Bench | None = None) -> CalibrationService:
    folder = Folder(tmp_path / "folder")
    bench = bench or Bench()
    wizard = plane_wizard(localize=bench.localize, save_to=folder.calibration)
    return CalibrationService(folder, [wizard])


def saved(service: CalibrationService, name: str) -> None:
    """Put an exact calibration into the folder."""
    calibration = fit_plane(
        GRID, [where(*mark) for mark in GRID], touch_sigma=0.0002, tool_z=(0, 0, -1),
        robot_frame="base",
    )  # fmt: skip
    calibration.save(service.folder.calibration(name))


def tree(path: Path) -> list[str]:
    return sorted(str(one.relative_to(path)) for one in path.rglob("*"))


async def run_through(service: CalibrationService, bench: Bench) -> dict[str, Any]:
    """Answer all steps from the picture on."""
    await say(service.session)
    await say(service.session)
    await say(service.session)
    for mark in bench.marks:
        await say(service.session, bench.touch_mm(*mark))
    await say(service.session)
    return await say(service.session)


# ---------------------------------------------------------------------- names


@pytest.mark.parametrize("name", BAD_NAMES)
def test_invalid_name_is_refused_everywhere(tmp_path: Path, name: str) -> None:
    service = served(tmp_path)
    saved(service, "good")
    before = tree(tmp_path)
    for call in (
        lambda: service.start(name),
        lambda: service.load(name),
        lambda: service.export(name, "out.json"),
        lambda: service.export("good", name),
        lambda: service.export("good", f"{name}.yaml"),
        lambda: service.load(f"exports/{name}.json"),
        lambda: service.load(f"{name}/good"),
    ):
        with pytest.raises(CalibrationError) as caught:
            call()
        assert caught.value.code == "BAD_NAME"
    assert [one for one in tree(tmp_path) if one != "folder/exports"] == before


def test_symbolic_link_in_the_folder_is_refused(tmp_path: Path) -> None:
    service = served(tmp_path)
    saved(service, "good")
    secret = tmp_path / "secret.json"
    secret.write_bytes((tmp_path / "folder/good.json").read_bytes())
    (tmp_path / "folder/bad.json").symlink_to(secret)
    (tmp_path / "folder/evil.journal").symlink_to(tmp_path / "made")
    (tmp_path / "folder/exports").symlink_to(tmp_path)
    for call in (
        lambda: service.load("bad"),
        lambda: service.start("evil"),
        lambda: service.export("good", "secret.json"),
        lambda: service.load("exports/secret.json"),
    ):
        with pytest.raises(CalibrationError, match="expected no symbolic link"):
            call()
    assert service.names == ["good"]
    assert not (tmp_path / "made").exists()


def test_names_are_those_of_calibrations_only(tmp_path: Path) -> None:
    service = served(tmp_path)
    for name in ("b", "a"):
        saved(service, name)
    (service.folder.path / "a.b.json").touch()
    (service.folder.path / "a.journal").touch()
    assert service.names == ["a", "b"]


# ---------------------------------------------------------------------- the wizard


async def test_wizard_run_through_makes_a_calibration_that_transforms(tmp_path: Path) -> None:
    bench = Bench()
    service = served(tmp_path, bench)
    view = service.start("table", parameters={"touch_sigma": 0.2})
    assert (view["step"], service.name) == ("about", "table")
    view = await run_through(service, bench)
    assert view["result"]["name"] == "table"
    assert service.names == ["table"]
    service.load("table")
    pose = service.transform(0.1, 0.2, 0.5)
    assert np.allclose(pose.position, where(0.1, 0.2), atol=1e-12)
    assert pose.header.frame_id == "robot"
    service.close()


async def test_start_of_a_name_that_was_broken_off_goes_on(tmp_path: Path) -> None:
    bench = Bench()
    first = served(tmp_path, bench)
    first.start("table", parameters={"tool": "pin"})
    await say(first.session)
    view = await say(first.session)
    first.close()
    second = served(tmp_path, bench)
    assert second.start("table") == view
    assert second.session.parameters["tool"] == "pin"
    assert bench.pictures == 1
    second.close()


async def test_start_fresh_or_after_the_end_begins_anew_and_keeps_the_journal(
    tmp_path: Path,
) -> None:
    service = served(tmp_path)
    first = service.start("table")
    await service.session.abort(first["token"])
    second = service.start("table")
    await say(service.session)
    third = service.start("table", fresh=True)
    assert [one["step"] for one in (first, second, third)] == ["about"] * 3
    assert len({one["run_id"] for one in (first, second, third)}) == 3
    journals = [f"folder/table.journal{number}" for number in ("", ".1", ".2")]
    assert tree(tmp_path) == ["folder", *journals]
    assert second["run_id"] in (tmp_path / "folder/table.journal.1").read_text()
    service.close()


def test_start_fresh_where_nothing_was_keeps_no_journal(tmp_path: Path) -> None:
    service = served(tmp_path)
    service.start("table", fresh=True)
    assert tree(tmp_path) == ["folder", "folder/table.journal"]
    service.close()


def test_start_over_a_broken_journal_is_refused_unless_fresh(tmp_path: Path) -> None:
    service = served(tmp_path)
    journal = service.folder.journal("table")
    journal.write_text("hello\n")
    with pytest.raises(CalibrationError, match="line 1 is no JSON"):
        service.start("table")
    assert service.start("table", fresh=True)["number"] == 1
    assert journal.with_name("table.journal.1").read_text() == "hello\n"
    service.close()


def test_start_with_a_wrong_parameter_is_refused(tmp_path: Path) -> None:
    service = served(tmp_path)
    with pytest.raises(CalibrationError, match="parameter unit: 'inch': expected one of mm, m"):
        service.start("table", parameters={"unit": "inch"})
    assert service.start("table", parameters={"unit": "m"})["defaults"]["unit"] == "m"
    service.close()


def test_start_of_a_name_in_use_is_refused(tmp_path: Path) -> None:
    one, other = served(tmp_path), served(tmp_path)
    one.start("table")
    for fresh in (False, True):
        with pytest.raises(CalibrationError, match="another sequence writes it") as caught:
            other.start("table", fresh=fresh)
        assert caught.value.code == "IN_USE"
    other.start("bench")
    one.close()
    assert other.start("table")["number"] == 1
    other.close()


async def test_start_while_an_action_is_under_way_is_refused(tmp_path: Path) -> None:
    began, go_on = asyncio.Event(), asyncio.Event()

    class Slow(Bench):
        async def localize(self) -> Any:
            began.set()
            await go_on.wait()
            return await super().localize()

    service = served(tmp_path, Slow())
    service.start("table")
    await say(service.session)
    async with asyncio.timeout(5), asyncio.TaskGroup() as tasks:
        work = tasks.create_task(service.session.submit(service.session.token))
        await began.wait()
        with pytest.raises(CalibrationError, match="an action is under way"):
            service.start("other")
        go_on.set()
    assert work.result()["step"] == "which"
    service.close()


def test_service_without_a_sequence_or_a_calibration_reports_it(tmp_path: Path) -> None:
    service = served(tmp_path)
    with pytest.raises(CalibrationError, match="no calibration is under way"):
        _ = service.session
    with pytest.raises(CalibrationError, match="no calibration is loaded"):
        service.transform(0, 0)
    with pytest.raises(CalibrationError, match="no wizard is called 'eye'; expected one of plane"):
        service.start("table", "eye")
    with pytest.raises(CalibrationError, match="no calibration 'table'; there are none"):
        service.load("table")
    service.close()


# ---------------------------------------------------------------------- files


def test_export_as_json_is_a_copy_that_can_be_loaded(tmp_path: Path) -> None:
    service = served(tmp_path)
    saved(service, "table")
    assert service.export("table", "copy.json") == "exports/copy.json"
    folder = service.folder.path
    assert (folder / "exports/copy.json").read_bytes() == (folder / "table.json").read_bytes()
    service.load("exports/copy.json")
    assert np.allclose(service.transform(0.0, 0.0).position, where(0.0, 0.0))


def test_export_as_yaml_is_read_by_pyyaml_and_by_opencv(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="needs the extra calibration")
    service = served(tmp_path)
    saved(service, "table")
    calibration = service.load("table")
    assert isinstance(calibration, PlaneCalibration)
    matrix = calibration.matrix
    path = service.folder.path / service.export("table", "matrix.yaml")
    read = yaml.safe_load(path.read_text())
    assert read["data"] == matrix.ravel().tolist()
    assert (read["rows"], read["cols"], read["robot_frame"]) == (4, 3, "base")
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    data = storage.getNode("data")
    assert [data.at(i).real() for i in range(data.size())] == read["data"]
    assert storage.getNode("robot_frame").string() == "base"
    storage.release()


def test_export_to_another_kind_of_file_is_refused(tmp_path: Path) -> None:
    service = served(tmp_path)
    saved(service, "table")
    with pytest.raises(CalibrationError, match=r"expected a name that ends in one of \.json, "):
        service.export("table", "table.sh")


def test_load_of_another_kind_is_refused(tmp_path: Path) -> None:
    service = served(tmp_path)
    lens = lenses.Bench(lenskit.LEFT, lenses.spread_poses(lenskit.LEFT, 4)).calibration()
    lens.save(service.folder.calibration("lens"))
    with pytest.raises(CalibrationError, match="holds 'camera', expected 'plane'"):
        service.load("lens")


def test_transform_to_another_frame_is_refused(tmp_path: Path) -> None:
    service = served(tmp_path)
    saved(service, "table")
    service.load("table")
    assert service.transform(0, 0, frame="base").header.seq == 1
    with pytest.raises(CalibrationError, match="frame 'world': expected 'base'"):
        service.transform(0, 0, frame="world")


def test_folder_that_is_a_link_itself_is_used(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    service = CalibrationService(tmp_path / "link")
    saved(service, "table")
    assert json.loads((tmp_path / "real/table.json").read_text())["kind"] == "plane"
    assert service.folder.path.samefile(tmp_path / "real")


def test_export_of_a_text_without_a_format_is_refused(tmp_path: Path) -> None:
    service = served(tmp_path)
    saved(service, "table")
    with pytest.raises(CalibrationError, match=r"table\.txt: expected the format to be named"):
        service.export("table", "table.txt")
    assert service.export("table", "table.txt", "tf2") == "exports/table.txt"


def test_folder_with_a_directory_called_as_a_calibration_does_not_list_it(tmp_path: Path) -> None:
    service = served(tmp_path)
    (service.folder.path / "table.json").mkdir()
    assert service.folder.names() == []
    with pytest.raises(CalibrationError, match="no calibration 'table'; there are none"):
        service.load("table")
