"""Log lines that a camera causes, at a bounded rate, and its notices as events."""

from __future__ import annotations

import asyncio
import logging

import pytest

import smartcam
from smartcam import NoticeReceived
from smartcam._client.remarks import MAX_REMARKS, PERIOD, Remarks
from smartcam.makes import EmulatedIfm
from tests.makes.test_ifm import PATIENCE, by_hand

FLOOD = 1000


def test_lines_of_a_kind_have_a_bound_in_each_period(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "smartcam.client")
    remarks = Remarks("left")
    for number in range(FLOOD):
        remarks.log("notice error", logging.WARNING, "! error %d", number, now=0.01 * number)
    remarks.log("heat", logging.WARNING, "! hot", now=1.0)
    lines = [one.getMessage() for one in caplog.records]
    assert lines[:2] == ["left ! error 0", "left ! error 1"]
    assert len(lines) == MAX_REMARKS + 2
    assert "more of the kind 'notice error'" in lines[-2]
    assert lines[-1] == "left ! hot"
    caplog.clear()
    remarks.log("notice error", logging.WARNING, "! error %d", FLOOD, now=PERIOD)
    assert [one.getMessage() for one in caplog.records] == [
        f"left ! {FLOOD - MAX_REMARKS} of the kind 'notice error' were not logged",
        f"left ! error {FLOOD}",
    ]


def test_end_of_a_session_says_what_was_left_out(caplog: pytest.LogCaptureFixture) -> None:
    remarks = Remarks("left")
    for _ in range(MAX_REMARKS + 3):
        remarks.log("heat", logging.WARNING, "! hot", now=0.0)
    caplog.clear()
    remarks.end()
    remarks.end()
    assert caplog.messages == ["left ! 3 of the kind 'heat' were not logged"]


@pytest.mark.asyncio
async def test_camera_that_floods_floods_no_log_and_is_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "smartcam.client")
    async with by_hand() as (peer, camera):
        for number in range(FLOOD):
            peer.say("0001", b"%09d:short circuit" % (110002001 + number % 2))
            peer.say("0010", b"000500002:{}")
        await camera.query_application()
        assert camera.statistics().notices == 2 * FLOOD
        said = [one for one in caplog.messages if "the camera says" in one]
        assert len(said) == 2 * MAX_REMARKS


@pytest.mark.asyncio
async def test_notices_are_events_in_order_with_the_others() -> None:
    async with by_hand() as (peer, camera):
        events = camera.events(max_queue=8)
        peer.say("0001", b"110002001:Short circuit on OUT1")
        peer.say("0010", b'000500002:{"ID":1}')
        peer.say("0020", b"x" * 5000)
        await camera.query_application()
        async with asyncio.timeout(PATIENCE):
            found = [await anext(events) for _ in range(3)]
        told = [(e.kind, e.code, e.text) for e in found if isinstance(e, NoticeReceived)]
        assert told[0] == ("error", 110002001, "Short circuit on OUT1")
        assert told[1] == ("notification", 500002, '{"ID":1}')
        assert told[2][:2] == ("debug", 0)
        for _ in range(100):
            peer.say("0001", b"110002001:Short circuit on OUT1")
        await camera.query_application()
        (account,) = camera.statistics().subscribers
        assert (account.offered, account.dropped) == (103, 92)


@pytest.mark.asyncio
async def test_overrun_of_the_emulated_sensor_is_an_event() -> None:
    slow = [{"id": 1, "processing_time": 5.0}]
    async with (
        EmulatedIfm(applications=slow) as emulator,
        smartcam.connect(emulator.url) as camera,
    ):
        events = camera.events()
        emulator.device.trigger()
        emulator.device.trigger()
        async with asyncio.timeout(PATIENCE):
            event = await anext(events)
        assert isinstance(event, NoticeReceived)
        assert (event.kind, event.code) == ("error", 110001006)
