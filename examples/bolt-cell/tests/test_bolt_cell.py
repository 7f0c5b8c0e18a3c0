"""The cell without a camera: everything here runs against an emulated one, over real TCP."""

import pytest
from bolt_cell import APPLICATION, LAYOUT, sort_bolts

import smartcam

pytestmark = [
    pytest.mark.asyncio,
    pytest.mark.smartcam(
        scenario="bolts.yaml",
        application=APPLICATION,
        interpret_as=LAYOUT,
        connect={"reconnect": None},
    ),
]


async def test_bolts_are_sorted(camera, emulated_camera):
    tally = await sort_bolts(camera, 3)
    assert tally.good == pytest.approx([0.0401, 0.0399])
    assert (tally.scrap, tally.unseen) == (1, 0)
    emulated_camera.log.expect("Connect", "Trigger", "ResultContainer", "Trigger")
    emulated_camera.log.expect_nothing_while_busy()


async def test_bolt_without_a_result_is_not_good(camera):
    tally = await sort_bolts(camera, 6, timeout=5.0)
    assert (len(tally.good), tally.scrap, tally.unseen) == (3, 2, 1)


async def test_result_of_another_application_is_not_taken(camera, emulated_camera):
    emulated_camera.command("next-shift")
    await camera.wait_status(lambda status: smartcam.Status.BUSY in status)
    await camera.wait_ready()
    tally = await sort_bolts(camera, 2)
    assert (tally.good, tally.scrap, tally.unseen) == ([], 0, 2)


async def test_lost_camera_stops_the_cell(camera, emulated_camera):
    emulated_camera.command("unplug")
    with pytest.raises(smartcam.ConnectionLostError):
        await sort_bolts(camera, 1)


@pytest.mark.smartcam(transport="udp", faults=[{"kind": "drop", "on": "ResultContainer"}])
async def test_result_lost_on_the_way(camera):
    tally = await sort_bolts(camera, 2, timeout=5.0)
    assert (len(tally.good), tally.unseen) == (1, 1)
