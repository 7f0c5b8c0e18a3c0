"""The sorting cell, against an emulated camera over real TCP and a simulated robot."""

import pytest
from sorting import APPLICATION, CONTAINERS, MARKS, PARTS, TableRobot, calibrate, lay, main, sort

from smartcam.emulator import TablePose

pytestmark = [
    pytest.mark.asyncio,
    pytest.mark.smartcam(application=APPLICATION, interpret_as="localizations"),
]


async def test_each_kind_lands_in_its_container(camera, emulated_camera):
    robot = TableRobot(emulated_camera.scene)
    lay(emulated_camera.scene, MARKS)
    calibration = await calibrate(camera, robot)
    lay(emulated_camera.scene, PARTS)
    counts = await sort(camera, robot, calibration)
    assert counts == {"screw": 3, "nut": 3}
    assert robot.contents[CONTAINERS["screw"]] == ["screw_1", "screw_2", "screw_3"]
    assert robot.contents[CONTAINERS["nut"]] == ["nut_1", "nut_2", "nut_3"]
    assert emulated_camera.scene.pieces == {}


async def test_part_without_a_container_stays(camera, emulated_camera):
    robot = TableRobot(emulated_camera.scene)
    lay(emulated_camera.scene, MARKS)
    calibration = await calibrate(camera, robot)
    things = {"washer_1": TablePose(0.1, 0.1, 0), "nut_1": TablePose(0.2, 0.1, 0)}
    lay(emulated_camera.scene, things)
    assert await sort(camera, robot, calibration) == {"nut": 1}
    assert list(emulated_camera.scene.pieces) == ["washer_1"]


async def test_part_that_cannot_be_taken_does_not_keep_the_cell_for_ever(camera, emulated_camera):
    robot = TableRobot(emulated_camera.scene, grip=0.0)
    lay(emulated_camera.scene, MARKS)
    calibration = await calibrate(camera, robot)
    lay(emulated_camera.scene, PARTS)
    assert await sort(camera, robot, calibration) == {}
    assert len(emulated_camera.scene.pieces) == 6
    names = [type(entry.message).__name__ for entry in emulated_camera.log]
    assert names.count("Trigger") == 1 + 3


async def test_script_says_what_it_sorted(capsys):
    await main()
    assert capsys.readouterr().out.splitlines() == [
        "3 screws: screw_1, screw_2, screw_3",
        "3 nuts: nut_1, nut_2, nut_3",
    ]
