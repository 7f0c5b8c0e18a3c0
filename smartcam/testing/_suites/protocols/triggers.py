"""Checks of triggers: each has one outcome, and its own result."""
# ruff: noqa: S101 - they are tests, in a package so that others can run them

from __future__ import annotations

import asyncio
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import pytest

from smartcam import (
    CommandRejectedError,
    ConfigurationError,
    InterpretationError,
    NotRunningError,
    OvertriggeredError,
    Status,
    TriggerTimeoutError,
    WrongApplicationError,
)
from smartcam.testing._suites.protocols.cameras_under_test import (
    COUNTER,
    FREE,
    OTHER,
    SLOW,
    UNUSED_APPLICATION_ID,
)
from smartcam.testing._suites.protocols.client_checks import (
    EVENT_TIMEOUT,
    SHORT_TIMEOUT,
    check_balance,
    check_unsupported,
    open_session,
    skip_without_applications,
    trigger_and_read,
    wait_until,
    with_event_loop,
)
from smartcam.testing._suites.protocols.parameters import SuiteBase

if TYPE_CHECKING:
    from smartcam.testing._suites.protocols.cameras_under_test import CameraKind


class TriggerChecks(SuiteBase):
    """Triggers: each has one outcome, and its own result."""

    @with_event_loop
    async def test_trigger_gives_a_typed_result(self, camera_kind: CameraKind) -> None:
        """Check a result's value, camera, application, number, times and latency."""
        async with open_session(camera_kind, name="cell 1") as (_, camera):
            before = datetime.now(UTC)
            first, second = await camera.trigger(), await camera.trigger()
            assert (first.value.n, second.value.n) == (0, 1)
            assert (second.camera, second.application, second.number) == ("cell 1", COUNTER, 2)
            assert first.triggered_at is not None
            assert before <= first.triggered_at <= first.received_at
            assert first.latency is not None
            assert 0 <= first.latency < EVENT_TIMEOUT
            assert camera.statistics().triggered == 2

    @with_event_loop
    async def test_triggers_at_one_time_take_turns(self, camera_kind: CameraKind) -> None:
        """Check that each trigger has its own result."""
        async with open_session(camera_kind) as (_, camera):
            numbers = await asyncio.gather(*(trigger_and_read(camera) for _ in range(5)))
            assert sorted(numbers) == [0, 1, 2, 3, 4]
            check_balance(camera.statistics())

    @with_event_loop
    async def test_trigger_in_another_application_is_undone(self, camera_kind: CameraKind) -> None:
        """Check that the application that was active before is active afterwards."""
        skip_without_applications(camera_kind, OTHER)
        async with open_session(camera_kind) as (_, camera):
            result = await camera.trigger(OTHER)
            assert result.application == OTHER
            assert camera.active_application == COUNTER
            async with camera.application(OTHER):
                assert (await camera.trigger()).application == OTHER
            assert await camera.query_application() == COUNTER
            assert (await camera.trigger()).application == COUNTER

    @with_event_loop
    async def test_trigger_whose_result_does_not_fit_fails_and_the_next_one_works(
        self, camera_kind: CameraKind
    ) -> None:
        """Check for an InterpretationError, after which the session continues."""
        async with open_session(camera_kind) as (_, camera):
            with pytest.raises(InterpretationError):
                await camera.trigger(interpret_as="a: uint32, b: uint32, c: string[40]")
            assert await trigger_and_read(camera) == 1
            statistics = camera.statistics()
            assert (statistics.uninterpretable, statistics.triggered) == (1, 1)
            check_balance(statistics)

    @with_event_loop
    async def test_trigger_that_timed_out_leaves_the_next_one_its_own_result(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the late result is not taken for the next trigger's result."""
        async with open_session(camera_kind, application=SLOW) as (_, camera):
            inspections = 0
            for _ in range(3):
                with pytest.raises(TriggerTimeoutError) as caught:
                    await camera.trigger(timeout=SHORT_TIMEOUT)
                if "no trigger was sent" not in str(caught.value):  # a slow machine may send none
                    inspections += 1
                assert await trigger_and_read(camera) == inspections
                inspections += 1
            check_balance(camera.statistics())

    @with_event_loop
    async def test_trigger_that_was_cancelled_leaves_the_next_one_its_own_result(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the late result is not taken for the next trigger's result."""
        async with open_session(camera_kind, application=SLOW) as (live, camera):
            task = asyncio.create_task(camera.trigger())
            await wait_until(lambda: live.inspects)
            task.cancel()
            await asyncio.wait({task})
            assert task.cancelled()
            assert await trigger_and_read(camera) == 1
            check_balance(camera.statistics())

    @with_event_loop
    async def test_trigger_dropped_while_ours_is_under_way_is_an_overtrigger(
        self, camera_kind: CameraKind
    ) -> None:
        """Check for an OvertriggeredError if the digital input triggers during an inspection."""
        async with open_session(camera_kind, application=SLOW) as (live, camera):
            if not camera.capabilities.unasked_results:
                return  # the camera has no other triggers than the client's
            task = asyncio.create_task(camera.trigger(timeout=EVENT_TIMEOUT))
            await wait_until(lambda: live.inspects)
            live.trigger()
            with pytest.raises(OvertriggeredError):
                await task
            assert camera.statistics().overtriggers == 1
            assert await trigger_and_read(camera) >= 1
            check_balance(camera.statistics())

    @with_event_loop
    async def test_trigger_while_somebody_elses_inspection_runs_waits_for_its_end(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the result of another inspection is not taken for the trigger's."""
        async with open_session(camera_kind, application=SLOW) as (live, camera):
            if not camera.capabilities.unasked_results:
                return
            live.trigger()
            await camera.wait_status(lambda status: Status.WAITING_FOR_TRIGGER not in status)
            assert await trigger_and_read(camera) == 1
            check_balance(camera.statistics())

    @with_event_loop
    async def test_trigger_of_a_stopped_application_is_refused_at_once(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the trigger raises a NotRunningError."""
        async with open_session(camera_kind) as (_, camera):
            if camera.capabilities.start_stop:
                await camera.stop()
                with pytest.raises(NotRunningError):
                    await camera.trigger()
                await camera.start()
            assert await trigger_and_read(camera) == 0

    @with_event_loop
    async def test_trigger_of_another_application_than_the_named_one_fails(
        self, camera_kind: CameraKind
    ) -> None:
        """Check for a WrongApplicationError after an operator has switched."""
        skip_without_applications(camera_kind, OTHER)
        async with open_session(camera_kind, application=COUNTER) as (live, camera):
            live.switch(OTHER)
            if camera.capabilities.unasked_status:
                await wait_until(lambda: camera.active_application == OTHER)
            with pytest.raises(WrongApplicationError):
                await camera.trigger()
            await camera.switch_application(COUNTER)
            assert (await camera.trigger()).application == COUNTER
            check_balance(camera.statistics())

    # ---------------------------------------------------------------------- switching

    @with_event_loop
    async def test_switch_loads_the_application(self, camera_kind: CameraKind) -> None:
        """Check that the camera's status and its results name the new application."""
        async with open_session(camera_kind) as (_, camera):
            if not camera.capabilities.switch:
                await check_unsupported(camera, camera.switch_application(OTHER))
                return
            skip_without_applications(camera_kind, OTHER)
            await camera.switch_application(OTHER)
            assert camera.active_application == OTHER
            assert await camera.query_application() == OTHER
            assert (await camera.trigger()).application == OTHER

    @with_event_loop
    async def test_switch_to_an_id_that_is_not_there_is_refused_and_the_old_one_runs(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the error has the code, and the active application."""
        async with open_session(camera_kind) as (_, camera):
            if not camera.capabilities.switch:
                return
            with pytest.raises(CommandRejectedError) as caught:
                await camera.switch_application(UNUSED_APPLICATION_ID)
            assert caught.value.active_application == COUNTER
            assert caught.value.code != 0
            assert await trigger_and_read(camera) == 0

    @with_event_loop
    async def test_switch_to_id_0_is_refused(self, camera_kind: CameraKind) -> None:
        """Check that the client refuses id 0 if no application may have it, else the camera."""
        async with open_session(camera_kind) as (_, camera):
            if not camera.capabilities.switch:
                return
            with pytest.raises(CommandRejectedError) as caught:
                await camera.switch_application(0)
            assert ("id 0" in str(caught.value)) is not camera_kind.has_zero
            assert caught.value.active_application == COUNTER
            assert await trigger_and_read(camera) == 0

    @with_event_loop
    async def test_switch_to_an_id_that_does_not_fit_is_a_mistake(
        self, camera_kind: CameraKind
    ) -> None:
        """Check for a ConfigurationError before anything is sent."""
        async with open_session(camera_kind) as (_, camera):
            if not camera.capabilities.switch:
                return
            for application in (-1, 1 << 32):
                with pytest.raises(ConfigurationError):
                    await camera.switch_application(application)
            assert await trigger_and_read(camera) == 0

    # ---------------------------------------------------------------------- streams

    @with_event_loop
    async def test_next_result_is_the_next_one_whoever_triggers(
        self, camera_kind: CameraKind
    ) -> None:
        """Check the next result, and that a wait without a result ends in time."""
        async with open_session(camera_kind) as (live, camera):
            waiting = asyncio.create_task(camera.next_result(timeout=EVENT_TIMEOUT))
            await asyncio.sleep(0)
            if camera.capabilities.unasked_results:
                live.trigger()
            else:
                await trigger_and_read(camera)
            assert (await waiting).value.n == 0
            with pytest.raises(TriggerTimeoutError):
                await camera.next_result(timeout=SHORT_TIMEOUT)

    @with_event_loop
    async def test_stream_has_every_result_of_a_free_running_application(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the stream has no gap, and that a trigger gets no result."""
        async with open_session(camera_kind) as (_, camera):
            if not camera.capabilities.unasked_results:
                return
            skip_without_applications(camera_kind, FREE)
            await camera.switch_application(FREE)
            async with camera.results() as results, asyncio.timeout(EVENT_TIMEOUT):
                numbers = [(await anext(results)).value.n for _ in range(10)]
            assert numbers == list(range(numbers[0], numbers[0] + 10))
            with pytest.raises(TriggerTimeoutError):
                await camera.trigger(timeout=SHORT_TIMEOUT)
            check_balance(camera.statistics())

    @with_event_loop
    async def test_stream_has_triggered_results_too(self, camera_kind: CameraKind) -> None:
        """Check that the stream has triggered results in order, each once."""
        async with open_session(camera_kind) as (_, camera), camera.results() as results:
            for run in range(3):
                assert await trigger_and_read(camera) == run
                async with asyncio.timeout(EVENT_TIMEOUT):
                    assert (await anext(results)).value.n == run
            check_balance(camera.statistics())

    @with_event_loop
    async def test_accounts_balance_whatever_happens(self, camera_kind: CameraKind) -> None:
        """Check that each container, and each item of a stream, has one fate."""
        async with (
            open_session(camera_kind) as (live, camera),
            camera.results(max_queue=2) as results,
        ):
            await trigger_and_read(camera)
            async with asyncio.timeout(EVENT_TIMEOUT):
                await anext(results)
            live.trigger()
            await trigger_and_read(camera)
            with pytest.raises(InterpretationError):
                await camera.trigger(interpret_as="a: uint32, b: uint32, c: string[40]")
            if camera.capabilities.switch and SLOW in camera_kind.applications:
                await camera.switch_application(SLOW)
                with pytest.raises(TriggerTimeoutError):
                    await camera.trigger(timeout=SHORT_TIMEOUT)
            await trigger_and_read(camera, COUNTER)
            statistics = camera.statistics()
            assert statistics.triggered == 3
            check_balance(statistics)
            if camera.capabilities.unasked_results:
                await wait_until(lambda: camera.statistics().received >= 5)
            (counts,) = statistics.subscribers
            assert (counts.taken, counts.name) == (1, "results")
