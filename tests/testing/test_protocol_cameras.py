"""The client in front of every camera that smartcam knows; the checks are the suite's."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import AsyncIterator, Callable
from datetime import datetime
from types import SimpleNamespace
from typing import Any

import pytest

from smartcam.camera import Camera
from smartcam.client import SmartCamera
from smartcam.exceptions import SmartCamError
from smartcam.models import Status
from smartcam.testing import CameraKind, CameraSuite, LiveCamera
from smartcam.testing._suites.protocols.client_checks import with_event_loop
from tests.testing.cameras_under_test import BVS_WORLDS, INSIGHT_WORLDS, LONELY_WORLDS

pytestmark = [pytest.mark.long, pytest.mark.widest]


class TestBvs(CameraSuite):
    camera_kinds = BVS_WORLDS


class TestOneApplication(CameraSuite):
    camera_kinds = LONELY_WORLDS


class TestInSight(CameraSuite):
    camera_kinds = INSIGHT_WORLDS


HANDBOOK, BID = (
    next(camera_kind for camera_kind in BVS_WORLDS if camera_kind.name == name)
    for name in ("handbook over tcp", "bid over tcp")
)
TRIGGER = Camera.trigger

# ---------------------------------------------------------------------- what is wrong


def gives(value: object) -> Any:
    """Return a method that does nothing."""

    async def method(*_: Any, **__: Any) -> object:
        return value

    return method


def unbalanced(camera: Camera, _statistics: Any = Camera.statistics) -> Any:
    found = _statistics(camera)
    return dataclasses.replace(found, received=found.received + 1)


async def counting(camera: Camera, *args: Any, **options: Any) -> Any:
    """Trigger once too often."""
    await TRIGGER(camera, *args, **options)
    return await TRIGGER(camera, *args, **options)


async def patient(camera: Camera, *_: Any, **__: Any) -> Any:
    """Wait for the result, whatever was asked for."""
    return await TRIGGER(camera)


async def stubborn(camera: Camera, *args: Any, **options: Any) -> Any:
    """Go on when cancelled."""
    with contextlib.suppress(asyncio.CancelledError):
        await TRIGGER(camera, *args, **options)
    return await TRIGGER(camera)


def with_site(camera_kind: CameraKind, **members: Any) -> CameraKind:
    """Return a kind of camera that is otherwise in some respect."""

    @contextlib.asynccontextmanager
    async def put_up() -> AsyncIterator[LiveCamera]:
        async with camera_kind.open() as live:
            own = type(live)
            yield type(own.__name__, (own,), members)(live.emulator)  # type: ignore[attr-defined]

    return dataclasses.replace(camera_kind, open=put_up)


UNPINNED = property(lambda live: live.emulator.url.partition("?")[0])
NOBODY = property(lambda _: False)


def patched(**methods: Any) -> Callable[[pytest.MonkeyPatch], CameraKind]:
    def patch(monkeypatch: pytest.MonkeyPatch) -> CameraKind:
        for name, method in methods.items():
            monkeypatch.setattr(SmartCamera, name, method)
        return HANDBOOK

    return patch


def patched_bid(**methods: Any) -> Callable[[pytest.MonkeyPatch], CameraKind]:
    return lambda monkeypatch: (patched(**methods)(monkeypatch), BID)[1]


def other(camera_kind: CameraKind) -> Callable[[pytest.MonkeyPatch], CameraKind]:
    return lambda _: camera_kind


MISTAKES: dict[str, Callable[[pytest.MonkeyPatch], CameraKind]] = {
    "test_accounts_balance_whatever_happens": patched(statistics=unbalanced),
    "test_clock": patched(get_clock=gives(datetime(2000, 1, 1))),  # noqa: DTZ001
    "test_close_ends_the_session_and_leaves_the_camera_as_it_is": other(
        with_site(HANDBOOK, has_session=NOBODY)
    ),
    "test_connect_with_the_dialect_knows_the_camera": other(with_site(HANDBOOK, url=UNPINNED)),
    "test_connect_without_the_dialect_finds_it_out": other(with_site(HANDBOOK, url=UNPINNED)),
    "test_connect_with_an_application_has_it_running": patched(
        active_application=property(lambda _: 1)
    ),
    "test_input_belongs_to_its_trigger": patched(set_input=gives(None)),
    "test_input_that_does_not_fit_is_refused_where_there_are_codes": patched_bid(trigger=patient),
    "test_killed_camera_ends_what_waits_for_it": patched(statistics=unbalanced),
    "test_load_by_file": patched(switch_application=gives(None)),
    "test_lost_camera_is_reported_and_comes_back": patched(statistics=unbalanced),
    "test_second_client_takes_the_camera_or_is_served_too": other(
        dataclasses.replace(HANDBOOK, exclusive=False)
    ),
    "test_next_result_is_the_next_one_whoever_triggers": patched_bid(
        next_result=gives(SimpleNamespace(value=SimpleNamespace(n=5)))
    ),
    "test_query_status": patched_bid(query_status=gives(Status(0))),
    "test_read_image": patched(read_image=gives(b"")),
    "test_reboot": patched(reboot=gives(None)),
    "test_request_gives_the_answers_body": patched(request=gives(None)),
    "test_request_that_nobody_answers_costs_the_link": patched(request=gives(None)),
    "test_reset_errors": patched_bid(reset_errors=gives(Status.OVERTRIGGERED)),
    "test_sequence_number": patched(set_sequence_number=gives(None)),
    "test_start_and_stop": patched(stop=gives(None)),
    "test_stream_has_every_result_of_a_free_running_application": patched(statistics=unbalanced),
    "test_stream_has_triggered_results_too": patched(trigger=counting),
    "test_switch_loads_the_application": patched(switch_application=gives(None)),
    "test_switch_to_an_id_that_does_not_fit_is_a_mistake": patched(switch_application=gives(None)),
    "test_switch_to_an_id_that_is_not_there_is_refused_and_the_old_one_runs": patched(
        switch_application=gives(None)
    ),
    "test_switch_to_id_0_is_refused": other(dataclasses.replace(HANDBOOK, has_zero=True)),
    "test_trigger_dropped_while_ours_is_under_way_is_an_overtrigger": other(
        with_site(HANDBOOK, trigger=lambda _: None)
    ),
    "test_trigger_gives_a_typed_result": patched(trigger=counting),
    "test_trigger_in_another_application_is_undone": patched(trigger=patient),
    "test_trigger_of_a_stopped_application_is_refused_at_once": patched(stop=gives(None)),
    "test_trigger_of_another_application_than_the_named_one_fails": other(
        with_site(BID, switch=lambda *_: None)
    ),
    "test_trigger_that_timed_out_leaves_the_next_one_its_own_result": patched(trigger=patient),
    "test_trigger_that_was_cancelled_leaves_the_next_one_its_own_result": patched(trigger=stubborn),
    "test_trigger_while_somebody_elses_inspection_runs_waits_for_its_end": patched(
        statistics=unbalanced
    ),
    "test_trigger_whose_result_does_not_fit_fails_and_the_next_one_works": patched(trigger=patient),
    "test_triggers_at_one_time_take_turns": patched(trigger=counting),
    "test_two_that_want_the_camera_do_not_fight_for_it": patched(statistics=unbalanced),
}


@pytest.mark.parametrize("check", MISTAKES)
def test_check_finds_the_mistake(check: str, monkeypatch: pytest.MonkeyPatch) -> None:
    camera_kind = MISTAKES[check](monkeypatch)
    errors = (AssertionError, pytest.fail.Exception, SmartCamError, TypeError)
    with pytest.raises(errors):
        getattr(CameraSuite(), check)(camera_kind)


def test_every_check_has_a_mistake() -> None:
    assert sorted(MISTAKES) == [name for name in dir(CameraSuite) if name.startswith("test_")]


def test_check_that_leaves_a_task_running_fails() -> None:
    left: list[asyncio.Task[None]] = []

    @with_event_loop
    async def check(_: object) -> None:
        left.append(asyncio.create_task(asyncio.sleep(60), name="leaked"))

    with pytest.raises(pytest.fail.Exception, match=r"left behind: <Task.*leaked"):
        check(CameraSuite())
