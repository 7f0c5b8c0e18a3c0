"""The client with an In-Sight camera: the emulated one, over real TCP."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import logging
from typing import TYPE_CHECKING, Any

import pytest

import smartcam
from smartcam import (
    ApplicationChanged,
    Backoff,
    CameraBusyError,
    CommandRejectedError,
    ConfigurationError,
    Connected,
    ConnectFailedError,
    ConnectionLostError,
    Disconnected,
    InterpretationError,
    Localization,
    NotRunningError,
    Reconnected,
    Status,
    StatusChanged,
    TriggerTimeoutError,
    UnsupportedError,
)
from smartcam.doctor._inside import try_ways
from smartcam.emulator import EmulatedInSight, ManualClock
from smartcam.observers import Observer
from smartcam.settings import parse_address
from tests.client.clientkit import SHORT, balance, cancelled, gone, steps
from tests.handmade import Peer, scripted, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine

    from smartcam import Camera
    from smartcam.observers import TraceEntry

    Call = Callable[[Camera], Coroutine[Any, Any, object]]

AT_ONCE = {"load_time": 0, "acquisition_time": 0, "processing_time": 0}
JOBS: list[dict[str, Any]] = [
    {
        "file": "7bolts.job",
        **AT_ONCE,
        "cells": {
            "A1": [12.5, 12.75],
            "B2": "M6",
            "C3": lambda run: run,
            "D4": [1, 0],
            "Part.Code": "\xb05",
            "E5": {"kind": "int", "value": 3, "low": 0, "high": 10},
        },
    },
    {"file": "12nuts.job", **AT_ONCE, "cells": {"A1": lambda run: 100 + run}},
    {"file": "spare.job", **AT_ONCE, "cells": {"A1": 5}},
    {"file": "20slow.job", **AT_ONCE, "acquisition_time": 1, "cells": {"A1": lambda run: run}},
    {"file": "30free.job", **AT_ONCE, "rate": 10, "cells": {"A1": lambda run: run}},
    {
        "file": "40parts.job",
        **AT_ONCE,
        "cells": dict(
            zip(
                [f"{column}{row}" for row in (1, 2) for column in "ABCDEF"],
                ["bolt", 0.9, 0, 0.1, 0.2, 0.5, "nut", 0.8, 1, 0.3, 0.4, -0.5],
                strict=True,
            )
        ),
    },
]
ONLINE = Status.RUNNING | Status.WAITING_FOR_TRIGGER
SECOND = 1.0  # that an acquisition of 20slow.job takes


@contextlib.asynccontextmanager
async def insight(
    query: str = "?cells=A1", *, box: dict[str, Any] | None = None, **options: Any
) -> AsyncIterator[tuple[EmulatedInSight, Camera]]:
    """An emulated camera on a clock that stands still, and a client in a session with it.

    It does not reconnect by default.
    """
    options.setdefault("reconnect", None)
    async with (
        EmulatedInSight(JOBS, clock=ManualClock(), **{"online": True, **(box or {})}) as emulator,
        smartcam.connect(emulator.url + query, **options) as camera,
    ):
        yield emulator, camera


def pass_time(emulator: EmulatedInSight, seconds: float) -> None:
    """Let the emulated camera's time go on."""
    assert isinstance(emulator.clock, ManualClock)
    emulator.clock.advance(seconds)


def said(emulator: EmulatedInSight) -> list[str]:
    """Return the commands that the emulated camera heard."""
    return [entry.text for entry in emulator.log if entry.direction == "in"]


async def slow_trigger(emulator: EmulatedInSight, camera: Camera) -> asyncio.Task[Any]:
    """Trigger the slow job; returns when the camera has begun its run."""
    count = sum(line == "SW8" for line in said(emulator)) + 1
    task = asyncio.ensure_future(camera.trigger())
    await emulator.wait_heard("SW", count=count)
    return task


# ---------------------------------------------------------------------- connecting


async def test_connect_knows_the_camera() -> None:
    async with insight("?cells=A1,B2:C3,Part.Code") as (emulator, camera):
        assert camera.url == f"{emulator.url}?dialect=native&cells=A1,B2:C3,Part.Code"
        assert (camera.active_application, camera.status) == (7, ONLINE)
        names = ["switch", "load_file", "start_stop", "result_codes", "get_status", "read_image"]
        assert camera.capabilities.names == names
        assert camera.protocol_version == 1
        assert said(emulator)[:4] == ["admin", "***", "GO", "GJ"]
        again = parse_address(camera.url)
        assert (again.dialect, dict(again.parameters)) == (
            "native",
            {"cells": "A1,B2:C3,Part.Code"},
        )


async def test_connect_to_one_that_is_offline_leaves_it_so() -> None:
    async with insight(box={"online": False}) as (emulator, camera):
        assert camera.status == Status(0)
        assert not emulator.online


async def test_connect_with_an_application_has_it_online() -> None:
    async with insight(application=12, box={"online": False}) as (emulator, camera):
        assert (emulator.active, emulator.online) == ("12nuts.job", True)
        assert (await camera.trigger()).application == 12


async def test_connect_logs_in_with_user_and_password() -> None:
    async with EmulatedInSight(JOBS, users={"op": "p:w/@ \xe9"}) as emulator:
        url = emulator.url.replace("//", "//op:p%3Aw%2F%40%20%C3%A9@")
        async with smartcam.connect(url) as camera:
            assert camera.url == emulator.url.replace("//", "//op@") + "?dialect=native"
            assert emulator.sessions == emulator.links != []


async def test_connect_with_a_wrong_password_is_tried_once_and_shows_none(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.DEBUG)
    traced: list[TraceEntry] = []

    class Trace(Observer):
        def on_frame(self, entry: TraceEntry) -> None:
            traced.append(entry)

    async with EmulatedInSight(JOBS) as emulator:
        url = emulator.url.replace("//", "//admin:hunter2@")
        camera = smartcam.connect(url, observers=[Trace()])
        error = await gone(camera.open())
        assert isinstance(error, ConnectFailedError)
        address = emulator.url.partition("//")[2]
        refusal = "the camera refused the session: code -6 (the user or the password is wrong)"
        begin = f"{address}: no session with insight://admin@{address}: {address} (TCP) refuses: "
        assert str(error).startswith(f"{begin}{refusal}. ")
        assert error.attempts == (
            f"attempt 1: native over TCP: waiting for the answer to Connect: {refusal}",
        )
        assert said(emulator) == ["admin", "***"]
    shown = repr([camera, camera.settings, traced]) + str(error) + caplog.text
    assert "hunter2" not in shown
    assert "68756e74657232" not in shown  # nor in hex


async def test_connect_to_something_else_says_what_came() -> None:
    async def greet(peer: Peer, _: int) -> None:
        peer.write(b"220 FTP server ready\r\n")

    async with scripted(greet) as listener:
        error = await gone(smartcam.connect(f"insight://127.0.0.1:{listener.port}").open())
    assert isinstance(error, ConnectFailedError)
    assert "'220 FTP server ready' came, the greeting or the login of an In-Sight" in str(error)


@pytest.mark.parametrize(
    ("url", "text"),
    [
        (
            "insight://h?cells=A400",
            "'A400' is no cell: expected a column A to Z and a row 0 to 399",
        ),
        ("insight://h?cells=a-b", "'a-b' is no name of a cell"),
        ("insight://op:%E2%82%AC@h", "'insight://op:***@h': password: only Latin-1"),
        ("insight://op:se#cret@h", "'insight://op:***@h' is no URL; in a password write / ? #"),
        ("insight://op:cret@h:x", "'insight://op:***@h:x' is no URL"),
        ("insight://op%0A@h", "user: only Latin-1 without line ends can be sent"),
        ("insight://h?dialect=native&quirks=loud", "dialect native has no quirk 'loud'"),
        ("insight://h?dialect=handbook", "insight has no dialect 'handbook'; it has native"),
        ("insight://h?password=x", "unknown 'password'; known are 'dialect', 'quirks', 'cells'"),
    ],
)
def test_url_that_cannot_work_is_refused(url: str, text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        smartcam.connect(url)
    assert text in str(caught.value)
    assert "cret" not in f"{caught.value!r} {caught.value.__cause__!r}"


def test_url_has_the_telnet_port_by_default() -> None:
    assert smartcam.connect("insight://h").url == "insight://h:23"
    assert smartcam.connect("h", model="In-Sight").url == "insight://h:23"


# ---------------------------------------------------------------------- triggers


async def test_trigger_gives_cells_as_the_layout_says() -> None:
    layout = "x: real32 mm, name: string[4], n: int32 @sequence, ok: bool, code: string[3]"
    async with insight("?cells=A1,B2,C3,D4,Part.Code", interpret_as=layout) as (_, camera):
        for x, number, ok in ((0.0125, 1, True), (0.01275, 2, False), (0.0125, 3, True)):
            result = await camera.trigger()
            value = result.value
            assert (value.x, value.name, value.n, value.ok) == (x, "M6", number, ok)
            assert (value.code, result.sequence, result.application) == ("\xb05", number, 7)
            assert json.loads(result.raw)["A001"] == ("12.500" if ok else "12.750")
        statistics = camera.statistics()
        assert (statistics.triggered, statistics.extra_results) == (3, 0)
        balance(statistics)


async def test_trigger_gives_raw_cells_by_default() -> None:
    async with insight("?cells=A1,Z9") as (_, camera):
        result = await camera.trigger()
        assert result.value == result.raw == b'{"A001": "12.500", "Z009": null}'


async def test_trigger_without_cells_gives_none() -> None:
    async with insight("") as (_, camera):
        assert (await camera.trigger()).value == b"{}"


async def test_trigger_reads_a_range_as_localizations() -> None:
    async with insight("?cells=A1:F2", interpret_as="localizations") as (_, camera):
        parts = (await camera.trigger(40)).value
        assert all(isinstance(part, Localization) for part in parts)
        assert [part.feature_id for part in parts] == ["bolt", "nut"]
        assert [part.pose.position.x for part in parts] == pytest.approx([0.1, 0.3])
        assert camera.active_application == 7


async def test_trigger_reads_a_range_as_a_table() -> None:
    spec = "table: (name: string[4], q: real64, i: int8, x: real64 mm, y: real64, t: real64)*"
    async with insight("?cells=A1:F2", interpret_as=spec, application=40) as (_, camera):
        table = (await camera.trigger()).value
        assert table["x"].tolist() == [0.0001, 0.0003]
        assert table["i"].tolist() == [0, 1]


@pytest.mark.parametrize(
    ("cells", "layout", "text"),
    [
        ("A1", "x: int32", "field 'x' (int32): cell A001 holds '12.500': no whole number"),
        ("A1,B2", "x: real32", "2 cells came, the layout has 1 fields: x: real32"),
        ("Nobody", "x: real32", "field 'x' (real32): cell Nobody has no value"),
        (
            "B2",
            "x: string[1]",
            "cell B002 holds 'M6': at most 1 bytes of UTF-8 without a zero were expected",
        ),
    ],
)
async def test_trigger_that_does_not_fit_its_layout_names_the_cell(
    cells: str, layout: str, text: str
) -> None:
    async with insight(f"?cells={cells}", interpret_as=layout) as (_, camera):
        with pytest.raises(InterpretationError) as caught:
            await camera.trigger()
        assert text in str(caught.value)
        assert (await camera.trigger(interpret_as="raw")).application == 7
        assert camera.statistics().uninterpretable == 1


async def test_trigger_cell_in_error_is_no_value() -> None:
    jobs = [{"file": "1.job", **AT_ONCE, "cells": {"A1": lambda run: 1 / 0}}]
    async with (
        EmulatedInSight(jobs, online=True) as emulator,
        smartcam.connect(emulator.url + "?cells=A1", interpret_as="s: string[8]") as camera,
    ):
        with pytest.raises(InterpretationError, match="cell A001 has no value"):
            await camera.trigger()
        assert (await camera.trigger(interpret_as="raw")).value == b'{"A001": "#ERR"}'


async def test_trigger_while_offline_is_not_running() -> None:
    async with insight(box={"online": False}) as (emulator, camera):
        with pytest.raises(NotRunningError, match="application 7 is stopped: start it"):
            await camera.trigger()
        assert "SW8" not in said(emulator)


async def test_trigger_sees_that_an_operator_took_the_camera_offline() -> None:
    async with insight() as (emulator, camera):
        await camera.trigger()
        emulator.set_online(False)
        with pytest.raises(NotRunningError):
            await camera.trigger()
        emulator.set_online(True)
        assert (await camera.trigger()).value == b'{"A001": "12.750"}'


async def test_trigger_voided_by_an_operator_says_so() -> None:
    async with insight(application=20) as (emulator, camera):
        trigger = await slow_trigger(emulator, camera)
        emulator.set_online(False)
        error = await gone(trigger)
        assert isinstance(error, NotRunningError)
        assert "somebody else stopped application 20 during the inspection" in str(error)
        emulator.set_online(True)
        trigger = await slow_trigger(emulator, camera)
        pass_time(emulator, SECOND)
        assert (await trigger).value == b'{"A001": "1.000"}'


async def test_trigger_that_the_job_does_not_take_is_refused() -> None:
    async with insight(application=30) as (_, camera):
        with pytest.raises(CommandRejectedError, match="the camera answered code -2") as caught:
            await camera.trigger()
        assert caught.value.code == -2


async def test_trigger_of_a_camera_that_knows_none_is_unsupported() -> None:
    async with insight() as (emulator, camera):
        emulator.answer_next(0, command="SW")
        with pytest.raises(UnsupportedError, match="the camera does not know the command"):
            await camera.trigger()
        assert (await camera.trigger()).application == 7


async def test_trigger_refuses_where_it_is_to_and_the_camera_is_ready() -> None:
    async with insight() as (_, camera):
        result = await camera.trigger(when_busy="refuse")
        assert not isinstance(result, CameraBusyError)


async def test_late_result_is_never_taken_for_the_next_one() -> None:
    async with insight(application=20) as (emulator, camera):
        with pytest.raises(TriggerTimeoutError, match=r"no result within 0\.0\d s of the trigger"):
            await camera.trigger(timeout=SHORT)
        following = asyncio.ensure_future(camera.trigger())
        await asyncio.sleep(0)
        pass_time(emulator, SECOND)
        await emulator.wait_heard("SW", count=2)
        pass_time(emulator, SECOND)
        assert (await following).value == b'{"A001": "2.000"}'
        statistics = camera.statistics()
        assert (statistics.late, statistics.triggered) == (1, 1)
        balance(statistics)


async def test_trigger_behind_one_that_goes_on_sends_none_in_vain() -> None:
    async with insight(application=20) as (emulator, camera):
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=SHORT)
        with pytest.raises(TriggerTimeoutError, match="no trigger was sent"):
            await camera.trigger(timeout=SHORT)
        assert said(emulator).count("SW8") == 1
        pass_time(emulator, SECOND)
        assert await camera.query_application() == 20


async def test_cancelled_trigger_leaves_nothing_for_the_next() -> None:
    async with insight(application=20) as (emulator, camera):
        await cancelled(await slow_trigger(emulator, camera))
        following = asyncio.ensure_future(camera.trigger())
        pass_time(emulator, SECOND)
        await emulator.wait_heard("SW", count=2)
        pass_time(emulator, SECOND)
        assert (await following).value == b'{"A001": "2.000"}'


async def test_stop_behind_a_cancelled_trigger_waits_for_its_end() -> None:
    async with insight(application=20) as (emulator, camera):
        await cancelled(await slow_trigger(emulator, camera))
        stopping = asyncio.ensure_future(camera.stop())
        pass_time(emulator, SECOND)
        await stopping
        assert (emulator.online, camera.status) == (False, Status(0))


async def test_result_may_come_in_the_next_layout() -> None:
    layouts = {7: "x: real32", 12: "n: int32"}
    async with insight(interpret_as=layouts) as (_, camera):
        assert (await camera.trigger()).value.x == 12.5
        assert (await camera.trigger(12)).value.n == 101
        assert (await camera.trigger()).value.x == 12.5  # loaded anew


# ---------------------------------------------------------------------- jobs


@pytest.mark.parametrize("job", [12, "12nuts.job", "12nuts"])
async def test_switch_loads_by_id_or_by_name_and_is_online_again(job: int | str) -> None:
    async with insight() as (emulator, camera):
        await camera.switch_application(job)
        assert (emulator.active, emulator.online) == ("12nuts.job", True)
        assert camera.active_application == 12
        assert (await camera.trigger()).value == b'{"A001": "101.000"}'


async def test_switch_while_offline_stays_offline() -> None:
    async with insight(box={"online": False}) as (emulator, camera):
        await camera.switch_application(12)
        assert (emulator.active, emulator.online, camera.status) == ("12nuts.job", False, Status(0))


async def test_switch_to_a_job_without_an_id_has_none() -> None:
    async with insight() as (emulator, camera):
        await camera.switch_application("spare.job")
        assert (emulator.active, camera.active_application) == ("spare.job", -1)
        assert (await camera.trigger()).application == -1
        assert await camera.query_application() == -1
        await camera.switch_application(7)
        assert camera.active_application == 7


@pytest.mark.parametrize("job", [99, "nix.job"])
async def test_switch_refused_leaves_the_old_job_online(job: int | str) -> None:
    async with insight() as (emulator, camera):
        with pytest.raises(CommandRejectedError) as caught:
            await camera.switch_application(job)
        assert str(caught.value).endswith(
            f"the camera refused to switch to application {job}: code -2 (the camera is online, "
            "there is no such job, or it failed to load); application 7 is active"
        )
        assert (caught.value.code, caught.value.active_application) == (-2, 7)
        assert (emulator.active, emulator.online, camera.status) == ("7bolts.job", True, ONLINE)


async def test_switch_to_an_id_out_of_range_is_refused_at_once() -> None:
    async with insight() as (emulator, camera):
        with pytest.raises(ConfigurationError, match="application id 1000 is not 0 to 999"):
            await camera.switch_application(1000)
        assert "SO0" not in said(emulator)


@pytest.mark.parametrize("online", [True, False])
async def test_switch_sees_what_an_operator_did_to_the_mode(online: bool) -> None:
    async with insight(box={"online": not online}) as (emulator, camera):
        emulator.set_online(online)
        await camera.switch_application(12)
        assert (emulator.active, emulator.online) == ("12nuts.job", online)
        emulator.set_online(True)
        async with camera.application(7):
            assert emulator.active == "7bolts.job"
        assert (emulator.active, emulator.online) == ("12nuts.job", True)


@pytest.mark.parametrize("name", ["a\r\nSO1", "a\0", "\x1b[m"])
async def test_switch_to_what_is_no_name_changes_nothing(name: str) -> None:
    async with insight() as (emulator, camera):
        with pytest.raises(ConfigurationError, match="expected a file's name"):
            await camera.switch_application(name)
        assert "SO0" not in said(emulator)
        assert (await camera.trigger()).application == 7


async def test_application_is_loaded_for_a_while() -> None:
    async with insight() as (emulator, camera):
        async with camera.application(12):
            assert (await camera.trigger()).application == 12
        assert (emulator.active, camera.active_application) == ("7bolts.job", 7)
        assert (await camera.trigger()).application == 7


# ---------------------------------------------------------------------- online and offline


async def test_stop_and_start_take_the_camera_offline_and_online() -> None:
    async with insight() as (emulator, camera):
        await camera.stop()
        assert (emulator.online, camera.status) == (False, Status(0))
        await camera.start()
        assert (emulator.online, camera.status) == (True, ONLINE)


async def test_start_of_a_camera_that_is_held_offline_is_refused() -> None:
    async with insight() as (emulator, camera):
        emulator.set_online(False)
        with pytest.raises(CommandRejectedError, match="holds the camera offline") as caught:
            await camera.start()
        assert caught.value.code == -5
        emulator.set_online(True)
        await camera.start()


async def test_start_without_full_access_is_refused() -> None:
    async with insight() as (emulator, camera):
        emulator.answer_next(-6, command="SO")
        with pytest.raises(CommandRejectedError, match="the user has no full access"):
            await camera.stop()
        assert emulator.online


# ---------------------------------------------------------------------- the rest


async def test_read_image_is_the_bitmap() -> None:
    async with insight() as (emulator, camera):
        data = await camera.read_image()
        height, width = emulator.device.image.shape
        assert (data[:2], len(data)) == (b"BM", 54 + 1024 + height * width)


async def test_read_image_with_the_size_in_bytes_is_the_same() -> None:
    async with insight(box={"quirks": {"image_size": "bytes"}}) as (_, camera):
        assert (await camera.read_image())[:2] == b"BM"


async def test_read_image_that_an_older_camera_knows_as_bmp_only() -> None:
    async with insight() as (emulator, camera):
        emulator.answer_next(0, command="RI")
        assert (await camera.read_image())[:2] == b"BM"
        assert said(emulator)[-2:] == ["RI", "RB"]


async def test_read_image_refused_is_told() -> None:
    async with insight() as (emulator, camera):
        emulator.answer_next(-4, command="RI")
        with pytest.raises(CommandRejectedError, match="out of memory"):
            await camera.read_image()


async def test_request_is_any_command() -> None:
    async with insight(box={"evaluations": {"A1": "<x/>"}}) as (_, camera):
        assert await camera.request("GVB002") == b"M6"
        assert await camera.request("GF") == b"7bolts.job"
        assert await camera.request("SI", b"E0058") == b""
        assert await camera.request("gve005") == b"8.000"
        assert await camera.request("EV A1") == b"<x/>"
        info = await camera.request("GI")
        assert info is not None
        assert info.startswith(b"Serial Number: ")
        with pytest.raises(CommandRejectedError, match=r"SIE00511: the camera answered -2: out of"):
            await camera.request("SIE00511")
        assert await camera.request("GVB002", answered=False) is None
        assert await camera.request("GVE005") == b"8.000"


async def test_request_of_an_unknown_kind_is_unsupported() -> None:
    async with insight() as (_, camera):
        for message_id in ("RT", 0x30):
            with pytest.raises(UnsupportedError, match="begins with no command that is known"):
                await camera.request(message_id)


async def test_what_the_camera_has_not_is_unsupported_and_harmless() -> None:
    async with insight() as (_, camera):
        for call in (
            lambda: camera.get_clock(),
            lambda: camera.set_input(b"x"),
            lambda: camera.trigger(input=b"x"),
            lambda: camera.set_sequence_number(1),
            lambda: camera.reboot(),
            lambda: camera.reset_errors(),
        ):
            with pytest.raises(UnsupportedError, match=r"dialect native has no .*it can: switch"):
                await call()
        assert (await camera.trigger()).application == 7


async def test_query_status_asks_for_it() -> None:
    async with insight() as (emulator, camera):
        emulator.set_online(False)
        assert await camera.query_status() == Status(0)


async def test_wait_status_sees_what_an_operator_does() -> None:
    async with insight() as (emulator, camera):
        offline = asyncio.ensure_future(camera.wait_status(lambda status: not status))
        await emulator.wait_heard("GO", count=2)
        emulator.set_online(False)
        assert await offline == Status(0)


async def test_events_tell_of_changes_that_are_asked_for() -> None:
    async with EmulatedInSight(JOBS, online=True) as emulator:
        unopened = smartcam.connect(emulator.url)
        events = unopened.events()
        async with unopened as camera:
            emulator.set_online(False)
            await camera.wait_status(lambda status: not status)
            await camera.switch_application(12)
        seen = [event async for event in events]
    kinds = [Connected, StatusChanged, ApplicationChanged, StatusChanged, ApplicationChanged]
    assert [type(event) for event in seen] == [*kinds, Disconnected]


async def test_results_are_those_of_own_triggers() -> None:
    async with insight(interpret_as="x: real32") as (emulator, camera):
        stream = camera.results()
        emulator.trigger()  # of somebody else: nothing tells of it
        result = await camera.trigger()
        assert result.value.x == 12.75
        assert await anext(stream) is result
        assert camera.statistics().received == 1


async def test_clients_side_by_side_share_the_camera() -> None:
    async with insight() as (emulator, camera), smartcam.connect(emulator.url) as other:
        await other.stop()
        with pytest.raises(NotRunningError):
            await camera.trigger()
        await other.start()
        await camera.trigger()
        assert len(emulator.sessions) == 2


# ---------------------------------------------------------------------- ends


async def test_connection_lost_during_a_trigger_tells_it() -> None:
    async with insight(application=20) as (emulator, camera):
        trigger = await slow_trigger(emulator, camera)
        emulator.drop_connections()
        assert isinstance(await gone(trigger), ConnectionLostError)


async def test_connection_lost_is_made_again_and_logged_in() -> None:
    quick = Backoff(initial=0.0, maximum=0.0, jitter=0.0)
    async with insight("?cells=B2", reconnect=quick) as (emulator, camera):
        events = camera.events()
        emulator.drop_connections()
        while not isinstance(await anext(events), Reconnected):
            pass
        await camera.wait_connected()
        assert (await camera.trigger()).value == b'{"B002": "M6"}'
        assert said(emulator).count("***") == 2


async def test_connection_lost_again_soon_is_no_other_clients_doing() -> None:
    quick = Backoff(initial=0.0, maximum=0.0, jitter=0.0)
    async with insight(reconnect=quick) as (emulator, camera):
        for count in (1, 2, 3):
            emulator.drop_connections()
            await until(lambda: not camera.connected)
            await camera.wait_connected()
            assert camera.statistics().reconnects == count


async def test_reconnect_keeps_the_password() -> None:
    quick = Backoff(initial=0.0, maximum=0.0, jitter=0.0)
    async with EmulatedInSight(JOBS, users={"op": "secret"}) as emulator:
        url = emulator.url.replace("//", "//op:secret@")
        async with smartcam.connect(url, reconnect=quick) as camera:
            emulator.drop_connections()
            await until(lambda: not camera.connected)
            await camera.wait_connected()
            assert camera.statistics().reconnects == 1


async def test_reconnect_that_is_refused_is_not_tried_for_ever() -> None:
    quick = Backoff(initial=0.0, maximum=0.0, jitter=0.0)
    async with insight(reconnect=quick) as (emulator, camera):
        emulator.refuse_login = True
        emulator.drop_connections()
        await until(lambda: not camera.connected)
        with pytest.raises(ConnectionLostError, match="the user or the password is wrong"):
            await camera.wait_connected()
        assert said(emulator).count("***") == 2


async def test_camera_that_inspects_for_long_is_not_taken_for_a_silent_one() -> None:
    async with insight(request_timeout=SHORT) as (emulator, camera):
        await camera.switch_application("20slow")
        statuses = camera.statuses()  # so that it is asked all the time
        waiting = asyncio.create_task(camera.trigger(timeout=60.0))
        await until(lambda: said(emulator).count("SW8") == 1)
        await asyncio.sleep(20 * SHORT)
        pass_time(emulator, SECOND)
        assert (await waiting).application == 20
        assert camera.connected
        statuses.close()


async def test_silent_camera_is_given_up() -> None:
    async with insight(liveness_timeout=2 * SHORT) as (emulator, camera):
        events = camera.events()
        emulator.silent = True
        lost = await anext(events)
        assert isinstance(lost, Disconnected)
        assert "no sign of life" in lost.reason


async def test_silent_camera_costs_a_request_its_link() -> None:
    async with insight(liveness_timeout=20 * SHORT) as (emulator, camera):
        emulator.silent = True
        with pytest.raises(smartcam.ResponseTimeoutError, match=r"no answer to ReadImage \(RI\) "):
            await camera.read_image(timeout=SHORT)
        await until(lambda: not camera.connected)


async def test_garbage_ends_the_link_with_its_text() -> None:
    async with insight() as (emulator, camera):
        events = camera.events()
        emulator.answer_next(77, command="GJ")
        (client,) = emulator._clients.values()
        client.say("77")
        lost = await anext(events)
        assert isinstance(lost, Disconnected)
        # whoever looks at events has the camera asked for its status, perhaps at this moment
        assert lost.reason in {
            "'77' came, nothing was asked",
            "'77' came, 0 (offline) or 1 (online) was expected",
        }


async def test_close_leaves_the_camera_as_it_is() -> None:
    async with insight(application=12) as (emulator, camera):
        await camera.close()
        await until(lambda: not emulator.links)
        assert (emulator.active, emulator.online) == ("12nuts.job", True)


async def test_close_in_the_middle_of_a_trigger_says_nothing_more(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async def talk(peer: Peer, _: int) -> None:
        peer.write(b"Welcome to In-Sight\r\nUser: Password: User Logged In\r\n")
        while (line := await peer.reader.readline()) != b"SW8\r\n":
            peer.write({b"GO\r\n": b"1\r\n", b"GJ\r\n": b"1\r\n7\r\n"}.get(line, b""))
        triggered.set()
        heard.append(await peer.rest())
        peer.write(b"1\r\n")  # the cells would be read now
        peer.close()

    triggered, heard = asyncio.Event(), list[bytes]()
    async with scripted(talk) as listener:
        url = f"insight://127.0.0.1:{listener.port}?cells=A1"
        async with smartcam.connect(url, reconnect=None) as camera:
            trigger = asyncio.ensure_future(camera.trigger())
            await triggered.wait()
            await camera.close()
            assert isinstance(await gone(trigger), smartcam.ConnectionClosedError)
    assert heard == [b""]
    assert [record for record in caplog.records if record.name == "asyncio"] == []


async def test_probe_with_a_wrong_password_logs_in_once() -> None:
    async with EmulatedInSight(JOBS) as emulator:
        address = parse_address(emulator.url.replace("//", "//admin:hunter2@"))
        (trial,) = [trial async for trial in try_ways(address, timeout=5)]
        assert "the user or the password is wrong" in trial.outcome
        assert said(emulator) == ["admin", "***"]
        assert trial.received == sum(
            len(frame.hex) // 2 for frame in trial.frames if frame.direction == "<"
        )


async def test_probe_of_a_camera_that_falls_silent_repeats_no_password() -> None:
    async def talk(peer: Peer, number: int) -> None:
        peer.write(b"Welcome to In-Sight\r\nUser: ")
        heard[number] = await peer.reader.readline()
        peer.write(b"Password: ")
        heard[number] += await peer.reader.readline()
        peer.write(b"User Logged")
        await peer.rest()

    heard: dict[int, bytes] = {}
    async with scripted(talk) as listener:
        address = parse_address(f"insight://op:hunter2@127.0.0.1:{listener.port}")
        (trial,) = [trial async for trial in try_ways(address, timeout=4 * SHORT)]
    assert "then silence" in trial.outcome
    assert heard == {1: b"op\r\nhunter2\r\n"}


# ---------------------------------------------------------------------- cancellation

MAX_STEPS = 300
"""Bound of a sweep."""


async def in_application(camera: Camera) -> None:
    async with camera.application(12):
        await asyncio.sleep(0)


async def stop_and_start(camera: Camera) -> None:
    await camera.stop()
    await camera.start()


CALLS: dict[str, Call] = {
    "trigger": lambda camera: camera.trigger(),
    "trigger in another application": lambda camera: camera.trigger(12),
    "application": in_application,
    "switch by id": lambda camera: camera.switch_application(12),
    "switch by name": lambda camera: camera.switch_application("12nuts.job"),
    "stop and start": stop_and_start,
    "query_application": lambda camera: camera.query_application(),
    "query_status": lambda camera: camera.query_status(),
    "read_image": lambda camera: camera.read_image(),
    "request": lambda camera: camera.request("GVA001"),
    "wait_ready": lambda camera: camera.wait_ready(),
}


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("name", CALLS)
async def test_cancelled_after_any_step_the_camera_goes_on(name: str) -> None:
    runs = itertools.count(1)
    cells = {"A1": lambda _: next(runs)}
    jobs = [{"file": f"{one}.job", **AT_ONCE, "cells": cells} for one in (7, 12)]
    async with (
        EmulatedInSight(jobs, online=True, clock=ManualClock()) as emulator,
        smartcam.connect(emulator.url + "?cells=A1", interpret_as="n: int32") as camera,
    ):
        for count in range(MAX_STEPS):
            task = asyncio.ensure_future(CALLS[name](camera))
            await steps(count)
            over = task.done()
            task.cancel()
            await asyncio.wait({task})
            await camera.start()
            result = await camera.trigger()
            assert result.value.n == emulator.device.runs
            assert camera.active_application == result.application
            await camera.switch_application(7)
            if over:
                break
        else:
            pytest.fail(f"{name} did not end in {MAX_STEPS} steps")
        assert camera.statistics().reconnects == 0
        balance(camera.statistics())


# ---------------------------------------------------------------------- values of several runs


async def speak(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Be a camera whose cell C3 counts to 6 while the cells of the second trigger are read."""
    counts = iter(["5.000", "5.000", "5.000", "6.000", "6.000", "6.000"])
    answers = {b"SW8": "1", b"GJ": "1\r\n7", b"GO": "1", b"GVA001": "1\r\n12.5"}
    writer.write(b"Welcome to In-Sight(tm)\r\nUser: Password: User Logged In\r\n")
    await reader.readline()
    await reader.readline()
    while line := (await reader.readline()).strip():
        text = f"1\r\n{next(counts)}" if line == b"GVC003" else answers[line]
        writer.write(text.encode() + b"\r\n")
    writer.close()
    await writer.wait_closed()


async def test_trigger_values_of_more_than_one_run_are_no_result() -> None:
    server = await asyncio.start_server(speak, "127.0.0.1", 0)
    port = server.sockets[0].getsockname()[1]
    url = f"insight://127.0.0.1:{port}?cells=A1&counter=C3"
    async with server, smartcam.connect(url, reconnect=None) as camera:
        assert (await camera.trigger()).value == b'{"A001": "12.5"}'
        with pytest.raises(InterpretationError, match=r"C003, which .* from 5\.000 to 6\.000 "):
            await camera.trigger(interpret_as="x: real32")
        assert (await camera.trigger(interpret_as="x: real32")).value.x == 12.5
        balance(camera.statistics())


def test_counter_is_one_cell() -> None:
    assert smartcam.connect("insight://h?counter=C3").url == "insight://h:23?counter=C3"
    with pytest.raises(ConfigurationError, match="counter: one cell, not 2"):
        smartcam.connect("insight://h?counter=C3:C4")
