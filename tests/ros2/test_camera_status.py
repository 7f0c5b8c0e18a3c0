"""The status of a camera, and its diagnostics, with faults that come and go."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import pytest

import smartcam
from smartcam import Status
from smartcam.ros2 import CameraNode, CameraNodeOptions, RosTypes
from smartcam.ros2._inside import LATCHED, OK, WARN, KnownState, health, status_fields
from tests.ros2.nodekit import COUNTER, NAME, OTHER, NotedNode, Seen, away, box, seen, until
from tests.timed_loop import spend

NO_SESSION = "there was no session yet"
ERROR, STALE = 2, 3
"""Levels of ``diagnostic_msgs/msg/DiagnosticStatus``."""

DIAGNOSTICS, STATUS = "/diagnostics", "~/status"


def _statuses(one: Seen) -> list[Any]:
    return [each.message for each in one.node.topics[STATUS].said]


def _diagnosis(one: Seen) -> Any:
    (found,) = one.node.last(DIAGNOSTICS).status
    return found


def _values(one: Seen) -> dict[str, str]:
    return {each.key: each.value for each in _diagnosis(one).values}


async def _until_diagnosed(one: Seen, level: int) -> Any:
    await until(lambda: _diagnosis(one).level == level)
    return _diagnosis(one)


# ---------------------------------------------------------------------- what is said at first


async def test_status_is_there_at_once_and_latched() -> None:
    async with seen(frame_id="cell") as one:
        (status,) = _statuses(one)
        assert one.node.topics[STATUS].qos == LATCHED
        assert (status.camera_name, status.header.frame_id) == (NAME, "cell")
        assert (status.connected, status.ready, status.running) == (True, True, True)
        assert (status.busy, status.error, status.application_id) == (False, "", COUNTER)
        assert (status.status, status.status_names) == (0x280, ["RUNNING", "WAITING_FOR_TRIGGER"])
        assert abs(status.header.stamp.sec - asyncio.get_running_loop().time()) > 1e9  # the day's
        await asyncio.sleep(10)
        assert len(_statuses(one)) == 1  # nothing has changed


async def test_diagnostics_say_who_and_how() -> None:
    async with seen() as one:
        await asyncio.sleep(1.5)
        found = _diagnosis(one)
        assert (found.level, found.message, found.name) == (OK, "ready", f"{NAME}: camera")
        assert found.hardware_id == one.camera.url.partition("//")[2].partition("?")[0]
        values = _values(one)
        assert values["life cycle"] == "active"
        assert values["status"] == "RUNNING WAITING_FOR_TRIGGER"
        assert (values["application"], values["errors"], values["sessions"]) == ("11", "", "1")
        assert values["connected since"].startswith("20")
        assert {"triggered", "late", "overtriggers", "dropped", "reconnects"} <= set(values)
        await one.camera.trigger()
        await asyncio.sleep(1.0)
        assert _values(one)["triggered"] == "1"
        assert float(_values(one)["processing mean"]) > 0
    async with seen(hardware_id="serial 7") as one:
        assert one.node.last(STATUS).header.frame_id == NAME
        assert _diagnosis(one).hardware_id == "serial 7"


# ---------------------------------------------------------------------- the period


async def test_the_period_does_not_drift() -> None:
    async with seen() as one:
        begun = asyncio.get_running_loop().time()
        for _ in range(40):
            await asyncio.sleep(0.25)
            spend(0.1)  # the loop is held up again and again
        said = [each.at - begun for each in one.node.topics[DIAGNOSTICS].said]
        assert len(said) >= 13
        assert all(at - round(at) < 0.11 for at in said)
        assert [round(at) for at in said] == list(range(len(said)))


async def test_what_was_missed_is_left_out() -> None:
    async with seen() as one:
        begun = asyncio.get_running_loop().time()
        await asyncio.sleep(0.5)
        spend(5.0)
        await asyncio.sleep(2.0)
        said = [round(each.at - begun, 1) for each in one.node.topics[DIAGNOSTICS].said]
        assert said == [0.0, 5.5, 6.0, 7.0]


async def test_another_period_counts_at_once() -> None:
    async with seen(diagnostics_period=3600) as one:
        await asyncio.sleep(1.0)
        said = one.node.topics[DIAGNOSTICS].said
        assert len(said) == 1
        one.seen.status.set_period(0.5)
        await asyncio.sleep(1.9)
        assert len(said) == 1 + 4


async def test_nothing_is_made_where_nobody_hears() -> None:
    async with seen() as one:
        await asyncio.sleep(0)
        topic = one.node.topics[DIAGNOSTICS]
        topic.has_subscribers = False
        count = len(topic.said)
        await asyncio.sleep(5.5)
        assert len(topic.said) == count
        topic.has_subscribers = True
        await asyncio.sleep(1)
        assert len(topic.said) == count + 1


# ---------------------------------------------------------------------- what happens to a camera


async def test_a_camera_that_goes_and_comes_back() -> None:
    async with seen() as one:
        before, since = _statuses(one)[0], _values(one)["connected since"]
        one.box.inject({"kind": "refuse", "seconds": 5}, {"kind": "close"})
        await until(lambda: not _statuses(one)[-1].connected)
        gone = _statuses(one)[-1]
        assert (gone.ready, gone.running, gone.status, gone.application_id) == (False, False, 0, 0)
        assert "closed the connection" in gone.error
        found = await _until_diagnosed(one, ERROR)
        assert found.message == gone.error or "refused" in found.message
        assert _values(one)["connected since"] == ""
        await until(lambda: _statuses(one)[-1].ready)
        back = _statuses(one)[-1]
        assert (back.status, back.error) == (before.status, "")
        await _until_diagnosed(one, OK)
        assert _values(one)["reconnects"] == "1"
        assert _values(one)["connected since"] > since
        assert _values(one)["last error"] != ""


@pytest.mark.parametrize(
    ("condition", "level", "word"),
    [("system_error", ERROR, "System Error"), ("overheat", WARN, "Overheat")],
)
async def test_an_error_bit_is_said_until_it_falls(condition: str, level: int, word: str) -> None:
    async with seen() as one:
        one.box.inject({"kind": "condition", "condition": condition})
        await until(lambda: word in _statuses(one)[-1].error)
        status = _statuses(one)[-1]
        assert condition.upper() in status.status_names
        assert status.ready == (condition != "system_error")
        found = await _until_diagnosed(one, level)
        assert word in found.message
        assert _values(one)["errors"] == condition.upper()
        one.box.inject({"kind": "condition", "condition": condition, "active": False})
        await until(lambda: _statuses(one)[-1].error == "")
        await _until_diagnosed(one, OK)


async def test_the_worst_is_said_and_all_are_named() -> None:
    async with seen() as one:
        for condition in ("overheat", "system_error"):
            one.box.inject({"kind": "condition", "condition": condition})
        found = await _until_diagnosed(one, ERROR)
        assert "System Error" in found.message
        assert _values(one)["errors"] == "SYSTEM_ERROR OVERHEAT"


async def test_busy_and_stopped() -> None:
    async with seen() as one:
        one.box.inject({"kind": "busy_for_ever", "seconds": 3})
        await until(lambda: _statuses(one)[-1].busy)
        assert not _statuses(one)[-1].ready
        await until(lambda: _diagnosis(one).message == "busy")
        assert _diagnosis(one).level == OK
        await until(lambda: _statuses(one)[-1].ready)
        one.box.inject({"kind": "stop"})
        await until(lambda: not _statuses(one)[-1].running)
        assert not _statuses(one)[-1].ready
        assert "stopped" in (await _until_diagnosed(one, WARN)).message


async def test_another_application_is_said() -> None:
    async with seen() as one:
        await one.camera.switch_application(OTHER)
        await until(lambda: _statuses(one)[-1].application_id == OTHER)
        await until(lambda: _statuses(one)[-1].ready)
        await asyncio.sleep(1.0)
        assert _values(one)["application"] == str(OTHER)


async def test_changes_that_come_too_fast_leave_the_last_one() -> None:
    async with seen() as one:
        begun = asyncio.get_running_loop().time()
        for number in range(301):
            active = number % 2 == 0
            one.box.inject({"kind": "condition", "condition": "overheat", "active": active})
            await asyncio.sleep(0.002)
        lasted = asyncio.get_running_loop().time() - begun
        await asyncio.sleep(1.0)
        assert one.camera.statistics().frames_received > 200  # it did say them
        said = one.node.topics[STATUS].said
        gaps = [after.at - before.at for before, after in itertools.pairwise(said)]
        assert min(gaps) >= 0.05 - 1e-9
        assert 3 <= len(said) <= 2 + lasted * 20
        assert "OVERHEAT" in said[-1].message.status_names
        one.box.inject({"kind": "condition", "condition": "overheat", "active": False})
        await asyncio.sleep(0.04)
        assert "OVERHEAT" not in said[-1].message.status_names  # a single one is said at once


# ---------------------------------------------------------------------- nothing heard, and the end


async def test_a_camera_that_was_not_heard_of_is_stale() -> None:
    heard = False
    async with away(3600, is_agent_alive=lambda: heard) as one:
        assert _diagnosis(one).level == STALE
        assert "closed the connection" in _diagnosis(one).message
        heard = True
        await asyncio.sleep(1.0)
        assert _diagnosis(one).level == ERROR
    async with box() as emulated:
        camera = smartcam.connect(emulated.url, name=NAME)  # not opened yet
        node = NotedNode()
        async with CameraNode(camera, node) as made:
            await asyncio.sleep(0)
            one = Seen(emulated, camera, node, made)
            assert _diagnosis(one).level == STALE
            assert not _statuses(one)[-1].connected
            async with camera:
                await until(lambda: _statuses(one)[-1].ready)
                await until(lambda: made.lifecycle.active)
                assert (await _until_diagnosed(one, OK)).message == "ready"
            await until(lambda: not _statuses(one)[-1].connected)
            assert "closed" in _statuses(one)[-1].error
            assert (await _until_diagnosed(one, ERROR)).message == _statuses(one)[-1].error


async def test_a_camera_that_ended_for_good_says_why() -> None:
    async with seen(client={"reconnect": None}) as one:
        one.box.inject({"kind": "close"})
        await until(lambda: not _statuses(one)[-1].connected)
        await asyncio.sleep(30)
        assert "closed the connection" in _statuses(one)[-1].error
        assert _diagnosis(one).level == ERROR
        assert one.node.topics[DIAGNOSTICS].said[-1].at > 29  # it goes on saying so


# ---------------------------------------------------------------------- results


async def test_lost_and_unreadable_results_are_a_warning_once() -> None:
    async with seen() as one:
        slow = one.camera.results(max_queue=1)
        await asyncio.sleep(0.5)
        for _ in range(3):
            await one.camera.trigger()
        await asyncio.sleep(1.0)
        assert _diagnosis(one).level == WARN
        assert "too slow" in _diagnosis(one).message
        assert _values(one)["dropped"] == "2"
        await asyncio.sleep(1.0)
        assert _diagnosis(one).level == OK
        slow.close()
        with pytest.raises(smartcam.InterpretationError):
            await one.camera.trigger(interpret_as="text: string[50]")
        await asyncio.sleep(1.0)
        assert (_diagnosis(one).level, _values(one)["uninterpretable"]) == (WARN, "1")
        assert "layout" in _diagnosis(one).message


# ---------------------------------------------------------------------- what goes wrong


async def test_what_cannot_be_said_is_said_later(caplog: pytest.LogCaptureFixture) -> None:
    async with seen() as one:
        await until(lambda: one.seen.lifecycle.active)
        for topic in one.node.topics.values():
            topic.fails = True
        one.box.inject({"kind": "condition", "condition": "overheat"})
        await asyncio.sleep(2.0)
        assert _statuses(one)[-1].error == ""
        assert "status was not published" in caplog.text
        for topic in one.node.topics.values():
            topic.fails = False
        await asyncio.sleep(1.1)
        assert "Overheat" in _statuses(one)[-1].error
        assert _diagnosis(one).level == WARN


async def test_no_password_is_said() -> None:
    url = (
        "insight://admin:secret@127.0.0.1:1?user=a"
        if False
        else "insight://admin:secret@127.0.0.1:1"
    )
    camera = smartcam.connect(url, name=NAME, reconnect=None)
    node = NotedNode()
    async with CameraNode(camera, node, options=CameraNodeOptions(autostart=False)):
        await asyncio.sleep(0)
        text = "".join(repr(each) for one in node.topics.values() for each in one.said)
        assert "127.0.0.1:1" in text
        assert "secret" not in text


@pytest.mark.parametrize(
    ("known", "said"),
    [
        (KnownState("cam", connected=True), (False, 0, "", OK, "connected")),
        (KnownState("cam", True, Status.RUNNING, -1), (True, 0, "", OK, "ready")),
        (KnownState("cam", True, Status.RUNNING, 7), (True, 7, "", OK, "ready")),
        (KnownState("cam", True, Status.RUNNING | Status.BUSY, 7), (False, 7, "", OK, "busy")),
        (KnownState("cam", failure="gone"), (False, 0, "gone", ERROR, "gone")),
        (
            KnownState("cam"),
            (False, 0, "there was no session yet", ERROR, "there was no session yet"),
        ),
        (KnownState("cam", False, Status.RUNNING, 7, "\0"), (False, 0, "\ufffd", ERROR, "\0")),
    ],
)
def test_state_that_is_known_is_said_in_one_way(known: KnownState, said: tuple[Any, ...]) -> None:
    fields, how, message = (
        status_fields(known),
        health(known),
        RosTypes().message("smartcam_msgs/msg/CameraStatus"),
    )
    got = message.decode(message.encode(fields))
    assert (got.ready, got.application_id, got.error, how.level, how.text) == said
    assert health(known, session_alive=False).level == (how.level if known.connected else STALE)


async def test_unknown_bits_are_kept() -> None:
    async with seen() as one:
        fields = status_fields(KnownState.of(one.camera))
        message = one.node.topics[STATUS].type
        fields["status"] |= 1 << 63
        assert message.decode(message.encode(fields)).status == 0x280 | 1 << 63
