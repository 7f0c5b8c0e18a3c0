"""Checks of optional features: they work, or raise an error and the session continues."""
# ruff: noqa: S101 - they are tests, in a package so that others can run them

from __future__ import annotations

import struct
from datetime import datetime, timedelta
from typing import TYPE_CHECKING

import pytest

from smartcam import (
    CommandRejectedError,
    ConnectionLostError,
    ResponseTimeoutError,
    Status,
    UnsupportedError,
)
from smartcam.testing._suites.protocols.cameras_under_test import ECHO
from smartcam.testing._suites.protocols.client_checks import (
    EVENT_TIMEOUT,
    SHORT_TIMEOUT,
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

LEAP_DAY = datetime(2024, 2, 29, 23, 59, 30)  # noqa: DTZ001 - the camera's clock has no zone


class OptionalFeatureChecks(SuiteBase):
    """The checks of optional features: each works, or raises an error and the session goes on."""

    @with_event_loop
    async def test_start_and_stop(self, camera_kind: CameraKind) -> None:
        """Check that start and stop may be called twice."""
        async with open_session(camera_kind) as (_, camera):
            if not camera.capabilities.start_stop:
                await check_unsupported(camera, camera.stop())
                await check_unsupported(camera, camera.start())
                return
            await camera.stop()
            assert Status.RUNNING not in camera.status
            await camera.stop()
            await camera.start()
            await camera.start()
            assert Status.RUNNING in camera.status
            assert await trigger_and_read(camera) == 0

    @with_event_loop
    async def test_clock(self, camera_kind: CameraKind) -> None:
        """Check that the clock shows the time that was set."""
        async with open_session(camera_kind) as (_, camera):
            if camera.capabilities.set_clock:
                await camera.set_clock(LEAP_DAY)
            else:
                await check_unsupported(camera, camera.set_clock(LEAP_DAY))
            if camera.capabilities.get_clock:
                assert timedelta(0) <= await camera.get_clock() - LEAP_DAY < timedelta(seconds=30)
            else:
                await check_unsupported(camera, camera.get_clock())

    @with_event_loop
    async def test_input_belongs_to_its_trigger(self, camera_kind: CameraKind) -> None:
        """Check that input data is used by the next inspection."""
        async with open_session(camera_kind) as (_, camera):
            data = struct.pack("<I", 4711)
            if not camera.capabilities.input_data:
                await check_unsupported(camera, camera.set_input(data))
                with pytest.raises(UnsupportedError):
                    await camera.trigger(input=data)
                return
            skip_without_applications(camera_kind, ECHO)
            await camera.switch_application(ECHO)
            assert await trigger_and_read(camera, input=data) == 4711
            await camera.set_input(struct.pack("<I", 5))
            assert await trigger_and_read(camera) == 5

    @with_event_loop
    async def test_input_that_does_not_fit_is_refused_where_there_are_codes(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the input is refused, and that the camera keeps no part of it."""
        async with open_session(camera_kind) as (_, camera):
            if camera.capabilities.input_data and camera.capabilities.result_codes:
                skip_without_applications(camera_kind, ECHO)
                await camera.switch_application(ECHO)
                with pytest.raises(CommandRejectedError):
                    await camera.trigger(input=b"too long for it")
                assert await trigger_and_read(camera, input=struct.pack("<I", 1)) == 1

    @with_event_loop
    async def test_sequence_number(self, camera_kind: CameraKind) -> None:
        """Check that the next result has the number that was set."""
        async with open_session(camera_kind, interpret_as=camera_kind.numbers_with_sequence) as (
            _,
            camera,
        ):
            if not camera.capabilities.sequence_number:
                await check_unsupported(camera, camera.set_sequence_number(5000))
                return
            await camera.set_sequence_number(5000)
            result = await camera.trigger()
            assert (result.sequence, result.value.n) == (5000, 5000)
            assert (await camera.trigger()).sequence not in {None, 5000}

    @with_event_loop
    async def test_query_status(self, camera_kind: CameraKind) -> None:
        """Check that the answer is the status."""
        async with open_session(camera_kind) as (_, camera):
            if camera.capabilities.get_status:
                assert Status.RUNNING in await camera.query_status()
            else:
                await check_unsupported(camera, camera.query_status())

    @with_event_loop
    async def test_reset_errors(self, camera_kind: CameraKind) -> None:
        """Check that the answer is a status without the errors."""
        async with open_session(camera_kind) as (_, camera):
            if camera.capabilities.reset_errors:
                assert Status.OVERTRIGGERED not in await camera.reset_errors()
            else:
                await check_unsupported(camera, camera.reset_errors())

    @with_event_loop
    async def test_read_image(self, camera_kind: CameraKind) -> None:
        """Check that the camera sends a picture."""
        async with open_session(camera_kind) as (_, camera):
            if camera.capabilities.read_image:
                assert len(await camera.read_image(timeout=EVENT_TIMEOUT)) > 0
            else:
                await check_unsupported(camera, camera.read_image())

    @with_event_loop
    async def test_load_by_file(self, camera_kind: CameraKind) -> None:
        """Check that the camera refuses a file that does not exist."""
        async with open_session(camera_kind) as (_, camera):
            if camera.capabilities.load_file:
                with pytest.raises(CommandRejectedError):
                    await camera.switch_application("no such file")
                await trigger_and_read(camera)
            else:
                await check_unsupported(camera, camera.switch_application("counter"))

    @with_event_loop
    async def test_reboot(self, camera_kind: CameraKind) -> None:
        """Check that the session is over."""
        async with open_session(camera_kind, close_timeout=0.2) as (_, camera):
            if not camera.capabilities.reboot:
                await check_unsupported(camera, camera.reboot())
                return
            await camera.reboot()
            assert not camera.connected
            with pytest.raises(ConnectionLostError):
                await camera.trigger()

    @with_event_loop
    async def test_request_gives_the_answers_body(self, camera_kind: CameraKind) -> None:
        """Check that a request by its id returns the answer's body, or does not wait for it."""
        async with open_session(camera_kind) as (_, camera):
            if camera_kind.raw_request is not None:
                assert await camera.request(camera_kind.raw_request)
                assert await camera.request(camera_kind.raw_request, answered=False) is None
                assert await camera.request(camera_kind.raw_request)
            with pytest.raises(UnsupportedError):
                await camera.request(camera_kind.foreign_request)
            assert await trigger_and_read(camera) == 0

    @with_event_loop
    async def test_request_that_nobody_answers_costs_the_link(
        self, camera_kind: CameraKind
    ) -> None:
        """Check that the link is closed: a late answer could be taken for the next request's."""
        async with open_session(camera_kind, request_timeout=SHORT_TIMEOUT) as (_, camera):
            if camera.capabilities.result_codes or camera_kind.silent_request is None:
                return  # such a camera answers everything
            with pytest.raises(ResponseTimeoutError):
                await camera.request(camera_kind.silent_request)
            await wait_until(lambda: not camera.connected)
