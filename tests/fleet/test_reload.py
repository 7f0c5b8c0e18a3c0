"""Reloading a fleet file: changes are applied, the rest continues; a wrong file changes nothing."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from smartcam.exceptions import (
    ConfigurationError,
    ConnectionClosedError,
    ConnectionLostError,
    SmartCamError,
)
from smartcam.fleet import Fleet, FleetFile, FleetServer, MemoryBus
from smartcam.fleet._agent.reload import FleetChanges, LoadedFleet, changes_of, load_cameras
from smartcam.models import Disconnected
from smartcam.protocols import messages as m
from smartcam.settings import CameraSettings, parse_address
from tests.fleet.fleetkit import PATIENCE, NumberedCamera


class Line(NamedTuple):
    """Cameras on a port, and an agent of a file that has the first two."""

    boxes: dict[str, NumberedCamera]
    path: Path
    server: FleetServer
    fleet: Fleet

    def write(self, *names: str, more: dict[str, Any] | None = None, **other: Any) -> None:
        write(self.path, {name: self.boxes[name].url for name in names}, more, **other)


def write(
    path: Path, urls: dict[str, str], more: dict[str, Any] | None = None, **other: Any
) -> None:
    cameras = {name: {"url": url, **(more or {}).get(name, {})} for name, url in urls.items()}
    path.write_text(yaml.safe_dump({"agent": "a1", "cameras": cameras, **other}), "utf-8")


@contextlib.asynccontextmanager
async def line(folder: Path, *names: str, time: float = 0.001) -> AsyncIterator[Line]:
    async with contextlib.AsyncExitStack() as stack:
        boxes = {
            name: await stack.enter_async_context(NumberedCamera(time=time))
            for name in ("one", "two", "three")
        }
        path = folder / "fleet.yaml"
        write(path, {name: boxes[name].url for name in names or ("one", "two")})
        bus = MemoryBus()
        server = await stack.enter_async_context(FleetServer(path, bus=bus.new_connection()))
        await server.wait_first_attempts()
        fleet = Fleet(bus.new_connection(), None, "plant", None, PATIENCE, {})
        await stack.enter_async_context(fleet)
        yield Line(boxes, path, server, fleet)


def sessions(one: Line) -> dict[str, int]:
    return {
        name: host.client.statistics().sessions for name, host in one.server.shared_cameras.items()
    }


def life(box: NumberedCamera) -> tuple[int, int]:
    """Return how many sessions a camera was asked for, and how many ended with Disconnect."""
    came = sum(isinstance(entry.message, m.Connect) for entry in box.log)
    # a session begins with Disconnect, too
    return came, sum(isinstance(entry.message, m.Disconnect) for entry in box.log) - came


async def test_what_did_not_change_goes_on_and_the_rest_is_as_the_file_says(
    tmp_path: Path,
) -> None:
    async with line(tmp_path, time=5.0) as one:
        kept, box = one.server.shared_cameras["one"], one.boxes["one"]
        under_way = asyncio.create_task(one.fleet["one"].trigger(timeout=PATIENCE))
        await box.wait_received(m.Trigger)
        one.write("one", "three")
        changes = await one.server.reload()
        assert changes == FleetChanges("a1", ("three",), ("two",), (), 1)
        assert str(changes) == "1 added (three), 1 removed (two), 1 kept"
        assert not under_way.done()  # nobody waited for it
        assert (await under_way).camera == "one"
        assert one.server.shared_cameras["one"] is kept
        await one.server.wait_first_attempts()
        assert sessions(one) == {"one": 1, "three": 1}
        assert (life(box), life(one.boxes["two"])) == ((1, 0), (1, 1))
        assert not one.boxes["two"].sessions
        assert [camera.name for camera in one.fleet.cameras()] == ["one", "three"]
        assert (await one.fleet["three"].trigger(timeout=PATIENCE)).camera == "three"
        assert [*one.server.urls] == ["one", "three"]


async def test_a_camera_that_changed_is_opened_again_and_its_results_are_numbered_on(
    tmp_path: Path,
) -> None:
    async with line(tmp_path) as one:
        stream = one.fleet["one"].results()
        await one.fleet["one"].trigger()
        one.write("one", "two", more={"one": {"request_timeout": 4.0}})
        assert (await one.server.reload()).changed == ("one",)
        await one.server.wait_first_attempts()
        assert life(one.boxes["one"]) == (2, 1)
        assert one.server.shared_cameras["one"].settings.request_timeout == 4.0
        assert life(one.boxes["two"]) == (1, 0)
        await one.fleet["one"].trigger()
        numbers = [(await anext(stream)).value for _ in range(2)]
        assert len(numbers) == 2
        assert stream.statistics().missed == 0
        assert one.server.shared_cameras["one"].results.next_number == 3


async def test_cameras_may_change_names(tmp_path: Path) -> None:
    async with line(tmp_path) as one:
        urls = {"one": one.boxes["two"].url, "two": one.boxes["one"].url}
        write(one.path, urls)
        assert (await one.server.reload()).changed == ("one", "two")
        await one.server.wait_first_attempts()
        for name in urls:
            assert one.server.shared_cameras[name].connected
            assert [one.boxes[name].sessions != []] == [True]
        await one.fleet["one"].trigger()
        assert (one.boxes["one"].runs, one.boxes["two"].runs) == (0, 1)


async def test_an_emulated_camera_stays_where_others_are_added(tmp_path: Path) -> None:
    path = tmp_path / "fleet.yaml"

    def put(count: int, seed: int = 1) -> None:
        entry = {"emulated": {"count": count, "seed": seed}}
        file = {"agent": "a1", "cameras": {"e/**": entry}}
        path.write_text(yaml.safe_dump(file), "utf-8")

    put(2)
    async with FleetServer(path, bus=MemoryBus().new_connection()) as server:
        await server.wait_first_attempts()
        put(3)
        assert await server.reload() == FleetChanges("a1", ("e/cam3",), (), (), 2)
        await server.wait_first_attempts()
        urls = {name: host.client.url for name, host in server.shared_cameras.items()}
        put(1, seed=2)
        changes = await server.reload()
        assert changes == FleetChanges("a1", (), ("e/cam2", "e/cam3"), ("e/cam1",), 0)
        await server.wait_first_attempts()
        assert server.shared_cameras["e/cam1"].client.url != urls["e/cam1"]
        for name in ("e/cam2", "e/cam3"):
            place = parse_address(urls[name])
            with pytest.raises(ConnectionRefusedError):
                await asyncio.open_connection(place.host, place.port)


async def test_a_file_beside_it_that_changed_changes_its_camera(tmp_path: Path) -> None:
    async with line(tmp_path) as one:
        folder = tmp_path / "scenario.yaml"
        folder.write_text(SCENARIO, "utf-8")
        cameras = {"one": {"emulated": {"scenario": "scenario.yaml"}}}
        one.path.write_text(yaml.safe_dump({"agent": "a1", "cameras": cameras}), "utf-8")
        assert (await one.server.reload()).changed == ("one",)
        assert (await one.server.reload()).kept == 1
        folder.write_text(SCENARIO + "# later\n", "utf-8")
        assert (await one.server.reload()).changed == ("one",)


SCENARIO = """
applications:
  - id: 5
    name: five
    layout: "n: int32"
    constant: [1]
"""

WRONG = {
    "no YAML": ("cameras: [", "fleet.yaml"),
    "no camera": ("{}", "cameras"),
    "a field that there is not": ("agent: a1\ncameras: {one: {ur: x}}", "cameras.one"),
    "a camera twice": (
        "agent: a1\ncameras: {one: {url: 'bvs://h'}, two: {url: 'bvs://h'}}",
        "cameras.two.url",
    ),
    "another agent": ("agent: a2\ncameras: {one: {url: 'bvs://h'}}", "agent: it was changed"),
    "another place": (
        "agent: a1\nlisten: tcp/127.0.0.1:1\ncameras: {one: {url: 'bvs://h'}}",
        "listen: it was changed",
    ),
    "another bound": (
        "agent: a1\nhistory: {results: 1}\ncameras: {one: {url: 'bvs://h'}}",
        "history: it was changed",
    ),
    "other operations": (
        "agent: a1\noperations: {}\ncameras: {one: {url: 'bvs://h'}}",
        "operations: it was changed",
    ),
}


@pytest.mark.parametrize("case", WRONG)
async def test_a_wrong_file_leaves_all_as_it_was(tmp_path: Path, case: str) -> None:
    async with line(tmp_path) as one:
        hosts, file = dict(one.server.shared_cameras), one.server.file
        text, expected = WRONG[case]
        one.path.write_text(text, "utf-8")
        with pytest.raises(ConfigurationError, match=expected) as caught:
            await one.server.reload()
        assert one.server.reloads.last is caught.value
        assert one.server.shared_cameras == hosts
        assert one.server.file is file
        assert [life(box) for box in one.boxes.values()] == [(1, 0), (1, 0), (0, 0)]
        one.path.unlink()
        with pytest.raises(ConfigurationError, match=r"fleet\.yaml"):
            await one.server.reload()
        one.write("one")
        assert (await one.server.reload()).removed == ("two",)


async def test_an_emulated_camera_that_cannot_start_leaves_all_as_it_was(tmp_path: Path) -> None:
    async with line(tmp_path) as one:
        scenario = tmp_path / "scenario.yaml"
        scenario.write_text(SCENARIO, "utf-8")
        made: list[str] = []
        source = one.server._start_source

        async def fails_third(planned: Any, folder: Path) -> Any:
            made.append(planned.name)
            if len(made) == 3:
                raise ConfigurationError("no port is left")
            return await source(planned, folder)

        one.server.reloads._start_source = fails_third
        cameras = {"one": {"url": one.boxes["one"].url}, "e/**": {"emulated": {"count": 3}}}
        one.path.write_text(yaml.safe_dump({"agent": "a1", "cameras": cameras}), "utf-8")
        with pytest.raises(ConfigurationError, match="no port is left"):
            await one.server.reload()
        assert [*one.server.shared_cameras] == ["one", "two"]
        assert [*one.server.reloads.sources] == ["one", "two"]


async def test_what_nobody_foresaw_is_a_typed_error_and_the_next_one_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with line(tmp_path) as one:
        one.write("one")
        for fault, expected in (
            (OSError(24, "no file is left"), "no file is left"),
            (KeyError("x"), "a fault of ours"),
        ):
            with monkeypatch.context() as patched:
                patched.setattr("smartcam.fleet._agent.reload.load_fleet", failing(fault))
                with pytest.raises(SmartCamError, match=expected):
                    await one.server.reload()
                outcome = (await one.fleet.reload())["a1"]
                assert expected in str(outcome)
        assert [*one.server.shared_cameras] == ["one", "two"]
        assert (await one.server.reload()).removed == ("two",)


def failing(error: Exception) -> Any:
    def fail(_: object) -> None:
        raise error

    return fail


async def test_a_camera_that_a_program_added_stays_its(tmp_path: Path) -> None:
    async with line(tmp_path) as one:
        agent = one.server.agent
        assert agent is not None
        agent.share("three", CameraSettings.make(one.boxes["three"].url, None, {"name": "three"}))
        await one.server.wait_first_attempts()
        one.write("one", "three")
        with pytest.raises(ConfigurationError, match=r"cameras\.three: a program has added"):
            await one.server.reload()
        one.write("one")
        assert (await one.server.reload()).removed == ("two",)
        assert life(one.boxes["three"]) == (1, 0)


async def test_two_at_once_are_done_one_after_the_other(tmp_path: Path) -> None:
    async with line(tmp_path) as one:
        one.write("two", "three")
        first, second = await asyncio.gather(one.server.reload(), one.server.reload())
        assert (first.added, first.removed) == (("three",), ("one",))
        assert second == FleetChanges("a1", (), (), (), 2)
        await one.server.wait_first_attempts()
        assert sessions(one) == {"two": 1, "three": 1}


async def test_a_camera_that_is_being_connected_can_be_removed(tmp_path: Path) -> None:
    async with line(tmp_path) as one:
        silent = socket.create_server(("127.0.0.1", 0))  # which nobody accepts from
        port = silent.getsockname()[1]
        write(one.path, {"one": one.boxes["one"].url, "silent": f"bvs://127.0.0.1:{port}"})
        await one.server.reload()
        trigger = asyncio.create_task(one.fleet["silent"].trigger(timeout=PATIENCE))
        await asyncio.sleep(0.1)
        assert not one.server.shared_cameras["silent"].connected
        one.write("one")
        assert (await one.server.reload()).removed == ("silent",)
        with pytest.raises(SmartCamError):
            await trigger
        assert [*one.server.shared_cameras] == ["one"]
        silent.close()


async def test_cancelled_anywhere_it_is_done_or_not_and_the_next_one_works(
    tmp_path: Path,
) -> None:
    ways: set[tuple[str, ...]] = set()
    async with line(tmp_path) as one:
        for steps in (*range(60), None):  # the last one is not cancelled, however slow its thread
            one.write("one", "two")
            await one.server.reload()
            one.write("one", "three")
            task = asyncio.create_task(one.server.reload())
            if steps is None:
                await task
            for _ in range(steps or 0):
                await asyncio.sleep(0)
                if task.done():
                    break
            over = task.done()
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
            named = tuple(one.server.urls)
            ways.add(named)
            one.path.write_text("cameras: [", "utf-8")
            with pytest.raises(ConfigurationError):  # which waits for the one before
                await one.server.reload()
            assert tuple(one.server.shared_cameras) == named
            assert tuple(one.server.reloads.sources) == named
            if over:
                break
        assert ways == {("one", "two"), ("one", "three")}
        assert life(one.boxes["one"]) == (1, 0)


async def test_stopped_meanwhile_it_is_refused_or_done(tmp_path: Path) -> None:
    async with line(tmp_path) as one:
        one.write("one", "three")
        task = asyncio.create_task(one.server.reload())
        await asyncio.sleep(0)
        await one.server.stop()
        with pytest.raises(ConnectionClosedError, match="nothing was changed"):
            await task
        with pytest.raises(ConnectionClosedError, match="not started"):
            await one.server.reload()
        assert not any(box.sessions for box in one.boxes.values())


async def test_a_program_has_it_reloaded_over_the_bus(tmp_path: Path) -> None:
    async with line(tmp_path) as one:
        one.write("one")
        assert await one.fleet.reload() == {"a1": FleetChanges("a1", (), ("two",), (), 1)}
        one.path.write_text("cameras: [", "utf-8")
        outcome = (await one.fleet.reload("a1"))["a1"]
        assert isinstance(outcome, ConfigurationError)
        assert "fleet.yaml" in str(outcome)
        with pytest.raises(ConfigurationError, match="no agent 'a7'; there are a1"):
            await one.fleet.reload("a7")


def test_how_a_camera_is_seen_in_ros_wants_a_restart() -> None:
    def file(frame: str | None, ros: bool, *more: str) -> LoadedFleet:
        said = {} if frame is None else {"ros2": {"frame_id": frame}}
        cameras = {name: {"url": f"bvs://{name}", **said} for name in ("one", *more)}
        top = {"agent": "a1", "cameras": cameras, **({"ros2": {}} if ros else {})}
        return load_cameras(FleetFile.model_validate(top), Path())

    with pytest.raises(ConfigurationError, match=r"cameras\.one\.ros2: it was changed"):
        changes_of(file("base", True), file("table", True), "a1")
    with pytest.raises(ConfigurationError, match=r"cameras\.two\.ros2: it was changed"):
        changes_of(file("base", True), file("base", True, "two"), "a1")
    assert changes_of(file(None, True), file(None, True, "two"), "a1").added == ("two",)
    assert changes_of(file("base", False), file("table", False), "a1").changed == ("one",)
    with pytest.raises(ConfigurationError, match="ros2: it was changed"):
        changes_of(file(None, False), file(None, True), "a1")


@pytest.mark.parametrize(
    ("names", "more", "why"),
    [
        (("two",), {}, "it was removed from the fleet file"),
        (("one", "two"), {"one": {"lenient": True}}, "its entry in the fleet file has changed"),
    ],
    ids=["removed", "changed"],
)
async def test_program_is_told_why_its_camera_is_shared_no_more(
    tmp_path: Path, names: tuple[str, ...], more: dict[str, Any], why: str
) -> None:
    async with line(tmp_path) as one:
        camera = one.fleet["one"]
        events = camera.events()
        await camera.trigger()
        one.write(*names, more=more)
        await one.server.reload()
        lost = await anext(events)
        while not isinstance(lost, Disconnected):
            lost = await anext(events)
        said = f"the agent a1 shares the camera no more: {why}"
        assert said in lost.reason
        if "one" not in names:
            with pytest.raises(ConnectionLostError, match=said):
                await camera.query_status()
