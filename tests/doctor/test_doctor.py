"""Test the doctor in a session: its checks, and how it leaves the camera."""

from __future__ import annotations

import asyncio
from contextlib import aclosing
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

import smartcam
from smartcam import doctor
from smartcam.doctor import examine
from smartcam.doctor._context import Examination
from smartcam.doctor._inside import Finding, summary
from smartcam.doctor._timing import time_statistics
from smartcam.emulator import Application, EmulatedCamera, EmulatedInSight, faults
from smartcam.emulator._inside import BaseFault
from smartcam.exceptions import ConfigurationError
from smartcam.models import Status
from smartcam.protocols import messages as m
from tests.doctor.doctorkit import WATCH, errors, examined, finding_of, severities
from tests.doctor.inside import Exit
from tests.handmade import until

APPLICATIONS = [
    Application(id=2, layout="n: int32", constant={"n": 1}, load_time=0, processing_time=0.001),
    Application(id=4, load_time=0, processing_time=0.001),
    Application(
        id=5, layout="n: int32", constant={"n": 1}, rate=100, load_time=0, processing_time=0
    ),
    Application(id=6, rate=100, load_time=0, processing_time=0),
    Application(id=10, load_time=0, processing_time=0),
]
"""Applications: 2 waits for triggers; 4 has no "send results" tool; 5 runs free; 6 runs free and
sends nothing; 10 sends nothing and takes no time."""


def camera(active: int = 2, **options: Any) -> EmulatedCamera:
    options.setdefault("running", True)
    return EmulatedCamera(APPLICATIONS, active=active, **options)


def sent_message_types(emulator: EmulatedCamera) -> set[type[m.Message]]:
    """Return the types of the messages from clients."""
    return {type(e.message) for e in emulator.log if e.direction == "in" and e.message is not None}


async def set_clock(emulator: EmulatedCamera, when: datetime) -> None:
    async with smartcam.connect(emulator.url) as client:
        await client.set_clock(when)
        await client.query_application()


# ---------------------------------------------------------------------- nothing is wrong


async def test_healthy_camera_has_nothing_wrong() -> None:
    async with camera() as emulator:
        await set_clock(emulator, datetime.now())  # noqa: DTZ005 - as a camera has it
        findings = await examined(emulator.url, trigger=True, count=3, interpret_as="n: int32")
    assert [(one.check, one.severity) for one in findings] == [
        ("notice", "ok"), ("session", "ok"), ("status", "ok"), ("application", "ok"),
        ("round trip", "ok"), ("run state", "ok"), ("trigger", "ok"), ("layout", "ok"),
        ("clock", "ok"),
    ]  # fmt: skip
    assert summary(findings).text == "nothing is wrong"


async def test_round_trip_has_figures_of_thirty_requests() -> None:
    async with camera() as emulator:
        found = finding_of(await examined(emulator.url), "round trip")
    times = found.details["round_trip"]
    assert times["samples"] == 30
    assert 0 < times["min"] <= times["median"] <= times["p99"] < 1.0


# ---------------------------------------------------------------------- it changes nothing

ASKING = {m.Connect, m.Disconnect, m.Query, m.GetClock, m.GetStatus}


@pytest.mark.parametrize("transport", ["tcp", "udp"])
@pytest.mark.parametrize("dialect", ["handbook", "thesis", "b16", "bid"])
@pytest.mark.parametrize("active", [2, 5])
async def test_without_trigger_it_only_asks(dialect: str, transport: Any, active: int) -> None:
    async with camera(active, dialect=dialect, transport=transport) as emulator:
        await examined(emulator.url, application=2, interpret_as="n: int32", count=3)
        assert sent_message_types(emulator) <= ASKING
        assert emulator.device.active_application == active
        assert emulator.device.running


async def test_without_trigger_a_stopped_camera_stays_stopped() -> None:
    async with camera(running=False) as emulator:
        await examined(emulator.url, application=5)
        assert sent_message_types(emulator) <= ASKING
        assert (emulator.device.active_application, emulator.device.running) == (2, False)


async def test_with_trigger_without_application_it_only_triggers() -> None:
    async with camera() as emulator:
        await examined(emulator.url, trigger=True, count=2)
        assert sent_message_types(emulator) == {*ASKING - {m.GetStatus}, m.Trigger}


@pytest.mark.parametrize("running", [True, False])
async def test_with_trigger_and_application_everything_goes_back(running: bool) -> None:
    async with camera(5, running=running) as emulator:
        findings = await examined(emulator.url, trigger=True, application=2, count=2)
        state = (emulator.device.active_application, emulator.device.running)
    assert errors(findings) == []
    assert finding_of(findings, "trigger").details["trigger_time"]["samples"] == 2
    assert state == (5, running)


async def test_session_is_ended_with_disconnect() -> None:
    async with camera() as emulator:
        await examined(emulator.url)
        assert [e.message for e in emulator.log if e.direction == "in"][-1] == m.Disconnect()
        assert emulator.sessions == []


async def test_cancelled_while_watching_says_disconnect() -> None:
    async with camera() as emulator:
        task = asyncio.create_task(examined(emulator.url, seconds=60))
        await emulator.wait_received(m.Query, count=5 + 1 + 30)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert [e.message for e in emulator.log if e.direction == "in"][-1] == m.Disconnect()


async def test_cancelled_while_triggering_goes_back() -> None:
    slow = Application(id=8, layout="n: int32", constant={"n": 1}, processing_time=60, load_time=0)
    async with EmulatedCamera([*APPLICATIONS, slow], active=2, running=True) as emulator:
        task = asyncio.create_task(examined(emulator.url, application=8, trigger=True, timeout=30))
        await emulator.wait_received(m.Trigger)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert (emulator.device.active_application, emulator.device.running) == (2, True)


async def test_closed_early_says_disconnect() -> None:
    async with camera() as emulator:
        async with aclosing(examine(emulator.url, seconds=WATCH)) as findings:
            async for finding in findings:
                if finding.check == "status":
                    break
        await emulator.wait_received(m.Disconnect)
        assert emulator.sessions == []


@pytest.mark.parametrize(
    ("url", "options", "text"),
    [
        ("bvs://", {}, "no host"),
        ("bvs://h", {"interpret_as": "n: int33"}, "int33"),
        ("bvs://h", {"timeout": 0.0}, "timeout: .* got 0.0"),
        ("bvs://h", {"seconds": 0.0}, "seconds: .* got 0.0"),
        ("bvs://h", {"count": 0}, "count: .* got 0"),
    ],
)
async def test_wrong_options_are_refused_before_anything(
    url: str, options: dict[str, Any], text: str
) -> None:
    with pytest.raises(ConfigurationError, match=text):
        await anext(examine(url, **options))


# ---------------------------------------------------------------------- status


@pytest.mark.parametrize(
    ("condition", "severity", "code", "text"),
    [
        ("system_error", "error", Exit.REFUSED, "System Error"),
        ("overheat", "warning", Exit.DONE, "too hot"),
    ],
)
async def test_condition_of_the_camera_is_reported(
    condition: Any, severity: str, code: Exit, text: str
) -> None:
    async with camera(faults=[faults.Condition(condition=condition)]) as emulator:
        findings = await examined(emulator.url)
    found = finding_of(findings, "status")
    assert (found.severity, found.exit_code) == (severity, code)
    assert text in found.text
    assert summary(findings).exit_code == code


@pytest.mark.parametrize(
    ("word", "severity", "text"),
    [
        (0x284, "warning", "input data and inspections are out of step"),
        (0x380, "hint", "has just dropped a trigger"),
    ],
)
async def test_bit_of_the_status_is_reported(word: int, severity: str, text: str) -> None:
    status = faults.Insert(
        on="StatusReport",
        message="StatusReport",
        fields={"status": word},
        where="instead",
        times=None,
    )
    async with camera(faults=[status]) as emulator:
        findings = await examined(emulator.url)
    found = finding_of(findings, "status")
    assert found.severity == severity
    assert text in found.text
    assert errors(findings) == []


# ---------------------------------------------------------------------- application


async def test_application_that_is_active_is_reported() -> None:
    async with camera() as emulator:
        found = finding_of(await examined(emulator.url, application=2), "application")
    assert (found.severity, found.text) == ("ok", "application 2 is active")


async def test_application_that_is_not_active_is_a_warning_without_triggers() -> None:
    async with camera() as emulator:
        findings = await examined(emulator.url, application=77)
    found = finding_of(findings, "application")
    assert found.severity == "warning"
    assert "application 2 is active, not 77" in found.text
    assert "cannot be known without loading it" in found.text
    assert summary(findings).exit_code == Exit.DONE


async def test_application_that_is_not_there_is_an_error_with_triggers() -> None:
    async with camera() as emulator:
        findings = await examined(emulator.url, application=77, trigger=True)
        assert m.Trigger not in sent_message_types(emulator)
        assert (emulator.device.active_application, emulator.device.running) == (2, True)
    assert errors(findings) == [("application", Exit.REFUSED)]
    found = finding_of(findings, "application")
    assert found.text.startswith("the camera has no application 77: ")
    assert found.details == {"active": 2, "wanted": 77}


@pytest.mark.parametrize("trigger", [True, False])
async def test_application_zero_is_an_error(trigger: bool) -> None:
    async with camera() as emulator:
        findings = await examined(emulator.url, application=0, trigger=trigger, count=1)
        assert m.Trigger not in sent_message_types(emulator)
    assert errors(findings) == [("application", Exit.REFUSED)]
    assert "no application has the id 0" in finding_of(findings, "application").text


async def test_application_that_does_not_get_ready_is_an_error_and_not_triggered() -> None:
    async with camera(faults=[faults.BusyForEver()]) as emulator:
        findings = await examined(emulator.url, application=5, trigger=True, timeout=0.2)
        assert m.Trigger not in sent_message_types(emulator)
    assert errors(findings) == [("application", Exit.TIMED_OUT), ("run state", Exit.TIMED_OUT)]
    assert "did not get ready in time" in finding_of(findings, "application").text


async def test_application_that_cannot_go_back_is_a_warning() -> None:
    busy = faults.BusyForEver(on="Trigger", when="after")
    async with camera(5, faults=[busy]) as emulator:
        findings = await examined(emulator.url, application=2, trigger=True, count=1, timeout=0.3)
    made, failed = [one for one in findings if one.check == "application"]
    assert (made.severity, failed.severity) == ("ok", "warning")
    assert failed.text.startswith("the camera did not go back to how it was: ")


# ---------------------------------------------------------------------- run state


async def test_stopped_camera_is_an_error_that_says_how_to_start() -> None:
    async with camera(running=False) as emulator:
        findings = await examined(emulator.url, trigger=True)
        assert m.Trigger not in sent_message_types(emulator)
    assert errors(findings) == [("run state", Exit.REFUSED)]
    found = finding_of(findings, "run state")
    assert found.text == "application 2 is stopped, so no result comes"
    assert f"smartcam start '{emulator.url}'" in found.cure


async def test_camera_that_is_stopped_while_watched_is_an_error() -> None:
    async with camera(5) as emulator, asyncio.TaskGroup() as group:
        watching = group.create_task(examined(emulator.url, seconds=0.3))
        await emulator.wait_received(m.Query, count=5 + 1 + 30)
        emulator.device.stop()
    assert errors(watching.result()) == [("run state", Exit.REFUSED)]


async def test_camera_busy_for_long_is_an_error() -> None:
    async with camera(faults=[faults.BusyForEver()]) as emulator:
        findings = await examined(emulator.url, trigger=True)
    assert errors(findings) == [("run state", Exit.TIMED_OUT)]
    assert (
        finding_of(findings, "run state").text == f"the camera was BUSY for all of the {WATCH:g} s"
    )


async def test_waiting_camera_is_reported() -> None:
    async with camera() as emulator:
        found = finding_of(await examined(emulator.url), "run state")
    assert (found.severity, found.text) == ("ok", "application 2 runs and waits for triggers")


async def test_waiting_camera_that_a_sensor_triggers_has_a_rate() -> None:
    async with camera() as emulator, asyncio.TaskGroup() as group:
        watching = group.create_task(examined(emulator.url, seconds=0.3))
        await emulator.wait_received(m.Query, count=5 + 1 + 30)
        for _ in range(3):
            emulator.device.trigger()
            await until(lambda: emulator.device.status & Status.WAITING_FOR_TRIGGER)
    found = finding_of(watching.result(), "run state")
    assert "waits for triggers; " in found.text
    assert found.details["results"] >= 1


async def test_free_running_camera_is_reported_with_its_rate() -> None:
    async with camera(5) as emulator:
        findings = await examined(emulator.url, seconds=0.3)
    found = finding_of(findings, "run state")
    assert found.severity == "ok"
    assert "application 5 runs free: " in found.text
    assert 50 < found.details["results_per_second"] < 200
    assert found.details["interval"]["samples"] == found.details["results"] - 1
    assert finding_of(findings, "layout").details["sizes"] == [4]


async def test_free_running_camera_is_an_error_where_it_should_be_triggered() -> None:
    async with camera(5) as emulator:
        findings = await examined(emulator.url, trigger=True)
        assert m.Trigger not in sent_message_types(emulator)
    assert errors(findings) == [("run state", Exit.TIMED_OUT)]
    assert "a trigger to it would get no result" in finding_of(findings, "run state").text


async def test_free_running_camera_that_sends_nothing_is_an_error() -> None:
    async with camera(6) as emulator:
        findings = await examined(emulator.url)
    assert errors(findings) == [("run state", Exit.TIMED_OUT)]
    found = finding_of(findings, "run state")
    assert "does not wait for a trigger, and sent nothing" in found.text
    assert '"send results" tool' in found.cure


# ---------------------------------------------------------------------- triggers


async def test_triggers_have_figures_and_a_rate() -> None:
    async with camera() as emulator:
        findings = await examined(emulator.url, trigger=True, count=5)
    found = finding_of(findings, "trigger")
    times = found.details["trigger_time"]
    assert times["samples"] == 5
    assert 0.001 <= times["min"] <= times["median"] <= times["p99"]
    assert 1 < found.details["results_per_second"] < 1000


async def test_application_without_send_results_is_reported() -> None:
    async with camera(4) as emulator:
        findings = await examined(emulator.url, trigger=True, timeout=0.2)
        assert [e.message for e in emulator.log].count(m.Trigger()) == 1
    assert errors(findings) == [("trigger", Exit.TIMED_OUT)]
    found = finding_of(findings, "trigger")
    assert "trigger 1 was inspected and nothing was sent" in found.text
    assert 'no "send results" tool' in found.cure
    assert found.details["inspected"] is True


async def test_inspection_that_takes_too_long_is_reported() -> None:
    async with camera(faults=[faults.LateResult(on="Trigger", seconds=60)]) as emulator:
        findings = await examined(emulator.url, trigger=True, timeout=0.2)
    assert errors(findings) == [("trigger", Exit.TIMED_OUT)]
    assert (
        finding_of(findings, "trigger").text
        == "the inspection of trigger 1 was not done within 0.2 s"
    )


async def test_trigger_that_is_not_taken_is_reported() -> None:
    async with camera(faults=[faults.Drop(on="Trigger", times=None)]) as emulator:
        findings = await examined(emulator.url, trigger=True, timeout=0.2)
    found = finding_of(findings, "trigger")
    assert found.text == "trigger 1 was not taken: the camera went on waiting for a trigger"
    assert "another trigger source" in found.cure


async def test_trigger_without_result_where_the_status_is_asked_for_is_reported() -> None:
    async with camera(10, dialect="bid") as emulator:
        findings = await examined(emulator.url, trigger=True, timeout=0.2)
    assert errors(findings) == [("trigger", Exit.TIMED_OUT)]
    found = finding_of(findings, "trigger")
    assert found.text == "trigger 1 was taken, and no result came within 0.2 s"
    assert '"Outputs"' in found.cure


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (faults.OperatorStop(on="Trigger", when="after"), "NotRunningError"),
        (faults.Overtrigger(), "OvertriggeredError"),
    ],
)
async def test_trigger_that_fails_is_reported_with_its_error(fault: BaseFault, error: str) -> None:
    slow = Application(id=8, layout="n: int32", constant={"n": 1}, processing_time=0.2, load_time=0)
    async with EmulatedCamera([slow], running=True, faults=[fault]) as emulator:
        findings = await examined(emulator.url, trigger=True)
    assert errors(findings) == [("trigger", Exit.REFUSED)]
    found = finding_of(findings, "trigger")
    assert found.text.startswith("trigger 1 gave no result: ")
    assert found.details["error"] == error


async def test_layout_with_a_sequence_number_sets_none() -> None:
    async with camera() as emulator:
        layout = "n: int32 @sequence"
        findings = await examined(emulator.url, trigger=True, count=2, interpret_as=layout)
        assert m.SetSequenceNumber not in sent_message_types(emulator)
    assert errors(findings) == []
    assert finding_of(findings, "layout").text == "2 results fit the layout 'n: int32 @sequence'"


async def test_second_trigger_that_fails_keeps_the_figures_of_the_first() -> None:
    async with camera(faults=[faults.NoResult(on="Trigger", nth=2)]) as emulator:
        findings = await examined(emulator.url, trigger=True, timeout=0.2)
    failed, measured = [one for one in findings if one.check == "trigger"]
    assert failed.text.startswith("trigger 2 was inspected")
    assert measured.details["results_per_second"] > 5  # the wait for the second left out
    assert measured.details["trigger_time"]["samples"] == 1


async def test_several_results_for_a_trigger_get_a_hint() -> None:
    async with camera(faults=[faults.ExtraResult(on="Trigger")]) as emulator:
        findings = await examined(emulator.url, trigger=True, count=3)
    assert severities(findings, "trigger") == ["ok", "hint"]
    assert "results_per_trigger" in findings[-3].cure


# ---------------------------------------------------------------------- clock


@pytest.mark.parametrize("minutes", [-3, 3, 600])
async def test_clock_that_is_off_is_a_warning(minutes: int) -> None:
    async with camera() as emulator:
        now = datetime.now(UTC).replace(tzinfo=None)
        await set_clock(emulator, now + timedelta(minutes=minutes))
        found = finding_of(await examined(emulator.url), "clock")
    assert (found.severity, found.exit_code) == ("warning", Exit.DONE)
    assert "no time zone, and a restart of the camera loses it" in found.text
    assert "set_clock" in found.cure
    if abs(minutes) < 10:
        assert abs(found.details["seconds_off"] - 60 * minutes) < 30


async def test_clock_that_shows_utc_is_well() -> None:
    async with camera() as emulator:
        await set_clock(emulator, datetime.now(UTC).replace(tzinfo=None))
        found = finding_of(await examined(emulator.url), "clock")
    assert found.severity == "ok"
    assert abs(found.details["seconds_off"]) < 60


async def test_clock_that_is_never_told_is_a_warning_and_the_last_finding() -> None:
    async with camera(faults=[faults.Drop(on="ClockAnswer")]) as emulator:
        findings = await examined(emulator.url, timeout=0.2)
    assert findings[-1].check == "clock"
    assert findings[-1].severity == "warning"
    assert "does not tell its clock: " in findings[-1].text
    assert errors(findings) == []


async def test_clock_that_is_no_date_is_a_warning() -> None:
    fields: dict[str, int | str] = {
        "year": 2026, "month": 13, "day": 1, "hour": 0, "minute": 0, "second": 0,
    }  # fmt: skip
    wrong = faults.Insert(on="ClockAnswer", message="ClockAnswer", fields=fields, where="instead")
    async with camera(faults=[wrong]) as emulator:
        found = finding_of(await examined(emulator.url), "clock")
    assert found.severity == "warning"
    assert found.text == "the camera's clock is no date: (2026, 13, 1, 0, 0, 0)"


# ---------------------------------------------------------------------- a fault of ours


async def test_check_that_never_ends_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    never = doctor._DoctorCheck("never", lambda exam: asyncio.sleep(60), lambda options: 0.05)
    name, session, *_ = doctor._CHECKS
    monkeypatch.setattr(doctor, "_CHECKS", (name, session, never))
    async with camera() as emulator:
        findings = await examined(emulator.url)
    assert errors(findings) == [("never", Exit.TIMED_OUT)]
    assert finding_of(findings, "never").text == "this check did not end within 0.05 s"


async def test_session_lost_if_nobody_waits_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    async with camera() as emulator:

        async def lose(exam: Examination) -> None:
            emulator.inject(faults.SecondClient())
            await until(lambda: not exam.connected_camera.connected)

        idle = doctor._DoctorCheck("idle", lose, lambda options: 5.0)
        name, session, *_ = doctor._CHECKS
        monkeypatch.setattr(doctor, "_CHECKS", (name, session, idle))
        findings = await examined(emulator.url)
    assert errors(findings) == [("taken", Exit.NO_SESSION)]


# ---------------------------------------------------------------------- another maker's camera


async def test_camera_with_a_login_is_examined_and_its_password_not_shown() -> None:
    async with EmulatedInSight(users={"me": "secret"}, online=True) as emulator:
        address = emulator.url.replace("://", "://me:secret@")
        findings = await examined(address)
    assert errors(findings) == []
    assert finding_of(findings, "clock").text == "native has no message for a clock"
    assert "secret" not in repr(findings)


async def test_cells_of_a_spreadsheet_are_compared_with_the_layout() -> None:
    job = {"file": "one.job", "cells": {"B2": 112.5, "C2": "abc"}}
    async with EmulatedInSight([job], online=True) as emulator:
        address = f"{emulator.url}?cells=B2,C2"
        layout = "x: real32, name: string[3]"
        findings = await examined(address, trigger=True, count=2, interpret_as=layout)
        wrong = await examined(address, trigger=True, count=2, interpret_as="x: real32")
    assert finding_of(findings, "values").text.startswith("x goes up to 112.5")
    assert errors(wrong) == [("layout", Exit.UNREADABLE)]
    assert "2 cells came, the layout has 1 fields" in finding_of(wrong, "layout").text


# ---------------------------------------------------------------------- figures, summary


def test_figures_of_a_row_of_times() -> None:
    assert time_statistics([1.0, 3.0, 2.0, 10.0]) == (4, 1.0, 2.5, 10.0, (2 + 1 + 8) / 3)
    assert time_statistics([2.0]) == (1, 2.0, 2.0, 2.0, 0.0)
    assert time_statistics([float(n) for n in range(1, 201)]).p99 == 198.0
    assert str(time_statistics([0.001, 0.003])) == "min 1.0, median 2.0, p99 3.0 ms, jitter 2.0 ms"


def finding(severity: Any, code: Exit = Exit.DONE) -> Finding:
    return Finding(check="x", severity=severity, text="", exit_code=code)


def test_summary_counts_and_has_the_code_of_the_first_of_the_worst() -> None:
    end = summary(
        [
            finding("ok"),
            finding("hint"),
            finding("error", Exit.TIMED_OUT),
            finding("warning"),
            finding("error", Exit.UNREADABLE),
            finding("hint"),
        ]
    )
    assert end.text == "2 errors, 1 warning, 2 hints"
    assert (end.severity, end.exit_code) == ("error", Exit.TIMED_OUT)
    assert end.details == {"ok": 1, "hint": 2, "warning": 1, "error": 2}


@pytest.mark.parametrize("severity", ["ok", "hint", "warning"])
def test_summary_without_an_error_has_code_zero(severity: Any) -> None:
    assert summary([finding(severity)]).exit_code == 0
    assert summary([]).text == "nothing is wrong"
