"""Log lines that a camera causes, at a bounded rate, and its notices as events."""

from __future__ import annotations

import asyncio
import logging

import pytest

import smartcam
from smartcam import NoticeReceived
from smartcam.makes import EmulatedIfm
from tests.makes.test_ifm import PATIENCE, scripted_device

FLOOD = 1000
MAX_LINES = 20
"""Lines of a kind that are logged in each minute."""


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    """Return the lines about what the camera says, and about what of it was left out."""
    return [one for one in caplog.messages if "the camera says" in one or "of the kind" in one]


@pytest.mark.asyncio
async def test_lines_of_a_kind_have_a_bound_in_each_minute(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "smartcam.client")
    async with scripted_device(liveness_timeout=None) as (peer, camera):
        for number in range(FLOOD):
            peer.say("0001", b"%09d:short circuit" % number)
        peer.say("0010", b"000500002:{}")
        await camera.query_application()
        lines = said(caplog)
        assert lines[0].endswith("! the camera says: error 0: short circuit")
        assert len(lines) == MAX_LINES + 2
        assert "more than 20 lines of the kind 'notice error' in 60 s" in lines[-2]
        assert lines[-1].endswith("notification 500002: {}")
        caplog.clear()
        await asyncio.sleep(60)
        peer.say("0001", b"000000007:short circuit")
        await camera.query_application()
        left_out, line = said(caplog)
        assert left_out.endswith(
            f"! {FLOOD - MAX_LINES} of the kind 'notice error' were not logged"
        )
        assert line.endswith("error 7: short circuit")


@pytest.mark.asyncio
async def test_end_of_a_session_says_what_was_left_out(caplog: pytest.LogCaptureFixture) -> None:
    async with scripted_device() as (peer, camera):
        for _ in range(MAX_LINES + 3):
            peer.say("0001", b"110002001:short circuit")
        await camera.query_application()
        caplog.clear()
    (line,) = said(caplog)
    assert line.endswith("! 3 of the kind 'notice error' were not logged")


@pytest.mark.asyncio
async def test_camera_that_floods_floods_no_log_and_is_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "smartcam.client")
    async with scripted_device() as (peer, camera):
        for number in range(FLOOD):
            peer.say("0001", b"%09d:short circuit" % (110002001 + number % 2))
            peer.say("0010", b"000500002:{}")
        await camera.query_application()
        assert camera.statistics().notices == 2 * FLOOD
        assert len(said(caplog)) == 2 * MAX_LINES + 2


@pytest.mark.asyncio
async def test_notices_are_events_in_order_with_the_others() -> None:
    async with scripted_device() as (peer, camera):
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
