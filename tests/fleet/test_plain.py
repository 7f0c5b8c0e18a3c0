"""The fleet for programs without smartcam: the list of its cameras, and topics in JSON."""

from __future__ import annotations

import asyncio
import re
import socket
import struct
import sys
from datetime import UTC, datetime
from typing import Any

import pytest

import smartcam.fleet
from smartcam.emulator import EmulatedCamera
from smartcam.exceptions import ReservationLostError
from smartcam.fleet import MemoryBus
from tests import ROOT
from tests.fleet.plainkit import (
    COUNTER,
    LAYOUT,
    LOCALIZATIONS,
    NAME,
    PATIENCE,
    TEXTS,
    InProcess,
    fleet_file,
    plant,
)
from tests.handmade import refusing


@pytest.mark.both_buses
async def test_list_has_every_camera_under_its_key() -> None:
    async with plant() as place:
        ((key, said),) = await place.client.ask("cameras/**")
        assert key == f"cameras/{NAME}"
        assert said == {
            "camera": NAME,
            "agent": "one",
            "epoch": said["epoch"],
            "connected": True,
            "failure": "",
            "status": 0x280,
            "status_names": ["RUNNING", "WAITING_FOR_TRIGGER"],
            "application": COUNTER,
            "reserved_by": None,
            "url": place.server.shared_cameras[NAME].client.url,
            "protocol": "bvs",
            "dialect": "handbook",
            "protocol_version": 1,
            "capabilities": place.server.shared_cameras[NAME].client.capabilities.names,
            "interpret_as": {str(COUNTER): LAYOUT, str(TEXTS): "strings50"},
            "y_down": False,
            "lenient": False,
            "frames": None,
            "next_result": 1,
        }
        assert int(said["epoch"]) > 0


@pytest.mark.both_buses
@pytest.mark.parametrize(
    ("pattern", "there"),
    [
        (f"cameras/{NAME}", True),
        ("cameras/line1/*", True),
        ("cameras/*", False),
        ("cameras/line1/cam$*", True),
        ("cameras/line1/cam$*4", False),
        ("cameras/line2/**", False),
    ],
)
async def test_list_has_what_a_pattern_means(pattern: str, there: bool) -> None:
    async with plant() as place:
        answers = await place.client.ask(pattern)
        assert [key for key, _ in answers] == ([f"cameras/{NAME}"] if there else [])


async def test_list_says_why_there_is_no_session() -> None:
    memory = MemoryBus()
    with refusing(socket.SOCK_STREAM) as port:
        file = fleet_file(f"bvs://127.0.0.1:{port}", reconnect=False)
        async with smartcam.fleet.FleetServer(file, bus=memory.new_connection()) as server:
            await server.wait_first_attempts()
            end = await memory.new_connection().open(PATIENCE)
            ((_, said),) = await InProcess(end).ask("cameras/**")
            assert (said["connected"], said["status"], said["status_names"]) == (False, None, [])
            assert "nothing listens at" in said["failure"]
            assert said["capabilities"] is None
            await end.close()


async def test_list_never_has_a_password() -> None:
    memory = MemoryBus()
    file = fleet_file("insight://admin:secret@127.0.0.1:9", reconnect=False)
    async with smartcam.fleet.FleetServer(file, bus=memory.new_connection()) as server:
        await server.wait_first_attempts()
        end = await memory.new_connection().open(PATIENCE)
        ((_, said),) = await InProcess(end).ask("cameras/**")
        assert said["url"] == "insight://admin@127.0.0.1:9"
        assert "secret" not in str(said)
        await end.close()


# ---------------------------------------------------------------------- results


@pytest.mark.both_buses
async def test_results_topic_has_the_model_s_fields_and_the_value() -> None:
    async with plant() as place:
        results = await place.client.topic(f"topic/results/{NAME}")
        answer = await place.client.call("trigger")
        key, said = await results.next()
        assert key == f"topic/results/{NAME}"
        assert said == {"agent": "one", "epoch": said["epoch"], **answer["result"]}
        assert said["raw"] == struct.pack("<i", 1).hex()
        assert (said["camera"], said["application"], said["number"]) == (NAME, COUNTER, 1)
        assert (said["value"], said["error"], said["sequence"]) == ({"n": 1}, "", None)
        times = [datetime.fromisoformat(said[name]) for name in ("triggered_at", "received_at")]
        assert times[0].tzinfo == UTC
        assert (times[1] - times[0]).total_seconds() == pytest.approx(said["latency"], abs=PATIENCE)


@pytest.mark.both_buses
async def test_results_of_smartcam_s_programs_come_too_and_numbers_have_no_gap() -> None:
    async with plant() as place, place.fleet() as fleet:
        results = await place.client.topic("topic/results/**")
        for _ in range(3):
            await fleet[NAME].trigger()
            await place.client.call("trigger")
        came = await results.until(lambda said: said["number"] == 6)
        assert [said["number"] for said in came] == [1, 2, 3, 4, 5, 6]
        assert [said["value"]["n"] for said in came] == [1, 2, 3, 4, 5, 6]
        assert len({said["epoch"] for said in came}) == 1


@pytest.mark.both_buses
async def test_result_that_cannot_be_read_is_told_with_its_bytes() -> None:
    async with plant(interpret_as="n: int64") as place:
        results = await place.client.topic("topic/results/**")
        answer = await place.client.call("trigger")
        assert answer["kind"] == "InterpretationError"
        _, said = await results.next()
        assert (said["value"], said["kind"], said["raw"]) == (
            None,
            "InterpretationError",
            "01000000",
        )
        assert "expected" in said["error"]
        assert answer["error"] == said["error"] == answer["result"]["error"]


async def test_result_of_unknown_meaning_has_no_value() -> None:
    async with plant(interpret_as=None) as place:
        result = (await place.client.call("trigger"))["result"]
        assert (result["raw"], result["value"], result["error"]) == ("01000000", None, "")


async def test_result_of_an_application_that_nobody_described_says_so() -> None:
    async with plant() as place:
        answer = await place.client.call("trigger", application=LOCALIZATIONS)
        assert answer["kind"] == "WrongApplicationError"
        assert len(answer["result"]["raw"]) > 0


async def test_nothing_is_made_as_long_as_nobody_subscribes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[str] = []
    async with plant() as place:
        topics = place.server.shared_cameras[NAME].topics
        result = topics.result

        def counted(run: Any) -> dict[str, Any]:
            made.append("result")
            return result(run)

        monkeypatch.setattr(topics, "result", counted)
        await place.client.call("trigger")
        elsewhere = await place.client.topic("topic/results/line2/*")
        await place.client.call("trigger")
        assert made == []
        here = await place.client.topic("topic/results/line1/*")
        await place.client.call("trigger")
        assert (await here.next())[1]["number"] == 3
        assert made == ["result"]
        assert elsewhere.empty


@pytest.mark.both_buses
async def test_gap_is_filled_by_asking_for_what_is_kept() -> None:
    async with plant() as place:
        for _ in range(5):
            await place.client.call("trigger")
        answer = await place.client.call("results", first=2, most=3)
        assert [one["number"] for one in answer["results"]] == [2, 3, 4]
        assert [one["value"]["n"] for one in answer["results"]] == [2, 3, 4]
        assert (answer["first"], answer["next_result"]) == (2, 6)
        assert (await place.client.call("results", first=9))["results"] == []
        last = await place.client.call("results", most=2)
        assert [one["number"] for one in last["results"]] == [4, 5]


# ---------------------------------------------------------------------- status and events


@pytest.mark.both_buses
async def test_status_topic_says_each_status_and_the_loss_of_the_camera() -> None:
    async with plant() as place:
        statuses = await place.client.topic(f"topic/status/{NAME}")
        await place.client.call("stop")
        came = await statuses.until(lambda said: "RUNNING" not in said["status_names"])
        assert came[-1]["status"] == 0
        await place.camera.stop()
        came += await statuses.until(lambda said: not said["connected"])
        assert came[-1]["failure"]
        await place.camera.start()
        came += await statuses.until(lambda said: said["connected"])
        assert came[-1]["failure"] == ""
        numbers = [said["number"] for said in came]
        assert numbers == [*range(numbers[0], numbers[0] + len(numbers))]
        asked = await place.client.call("status")
        assert {**came[-1], "error": ""}.keys() == asked.keys()
        if asked["number"] > came[-1]["number"]:
            came += await statuses.until(lambda said: said["number"] == asked["number"])
        assert asked["number"] == came[-1]["number"]
        assert datetime.fromisoformat(asked["at"]) >= datetime.fromisoformat(came[-1]["at"])


@pytest.mark.both_buses
async def test_events_topic_has_the_camera_s_events() -> None:
    async with plant() as place:
        events = await place.client.topic("topic/events/**")
        await place.client.call("switch_application", application=TEXTS)
        came = await events.until(lambda said: said["event"] == "ApplicationChanged")
        assert (came[-1]["application"], came[-1]["previous"]) == (TEXTS, COUNTER)
        await place.camera.stop()
        came += await events.until(lambda said: said["event"] == "Disconnected")
        assert came[-1]["reason"]
        assert {said["event"] for said in came} >= {"StatusChanged", "ApplicationChanged"}
        numbers = [said["number"] for said in came]
        assert numbers == [*range(numbers[0], numbers[0] + len(numbers))]


@pytest.mark.both_buses
async def test_topics_tell_a_reservation_and_its_loss() -> None:
    async with plant() as place, place.fleet() as fleet:
        camera = fleet[NAME]
        await camera.wait_connected()
        events = await place.client.topic("topic/events/**")
        statuses = await place.client.topic(f"topic/status/{NAME}")
        async with camera.reserve(timeout=PATIENCE):
            holder = (await place.client.call("status"))["reserved_by"]
            assert holder
            await statuses.until(lambda said: said["reserved_by"] == holder)
        await statuses.until(lambda said: said["reserved_by"] is None)
        with pytest.raises(ReservationLostError):
            async with camera.reserve(timeout=PATIENCE):
                place.server.shared_cameras[NAME].lose_reservation()
        came = await events.until(lambda said: said["event"] == "ReservationLost")
        told = [said for said in came if said["event"].startswith(("Re", "Lost"))]
        kinds = ["Reserved", "Released", "Reserved", "ReservationLost"]
        assert [said["event"] for said in told] == kinds
        assert {(said["program"], said["camera"], said["agent"]) for said in told} == {
            (holder, NAME, "one")
        }
        numbers = [said["number"] for said in came]
        assert numbers == [*range(numbers[0], numbers[0] + len(numbers))]


# ---------------------------------------------------------------------- several agents


async def two_agents(memory: MemoryBus, *urls: str) -> list[Any]:
    """Return two agents of one fleet, not started."""
    return [
        smartcam.fleet.FleetServer(
            fleet_file(url).model_copy(
                update={
                    "agent": agent,
                    "cameras": {f"line/{agent}": fleet_file(url).cameras[NAME]},
                }
            ),
            bus=memory.new_connection(),
        )
        for agent, url in zip(("a", "b"), urls, strict=True)
    ]


async def test_each_agent_answers_for_its_own_cameras_and_one_for_those_that_nobody_has() -> None:
    memory = MemoryBus()
    async with EmulatedCamera() as left, EmulatedCamera() as right:
        first, second = await two_agents(memory, left.url, right.url)
        async with first, second:
            await asyncio.gather(first.wait_first_attempts(), second.wait_first_attempts())
            end = await memory.new_connection().open(PATIENCE)
            client = InProcess(end)
            listed = {key: said["agent"] for key, said in await client.ask("cameras/**")}
            assert listed == {"cameras/line/a": "a", "cameras/line/b": "b"}
            for agent in ("a", "b"):
                assert (await client.call("status", f"line/{agent}"))["agent"] == agent
            nobody = await client.call("status", "line/c")
            assert "has no camera 'line/c'" in nobody["error"]
            assert nobody["kind"] == "ConfigurationError"
            await end.close()


# ---------------------------------------------------------------------- the example

EXAMPLE = ROOT / "examples" / "plain-zenoh" / "plain_zenoh.py"


@pytest.mark.real_time
async def test_example_lists_triggers_and_hears_a_camera() -> None:
    async with plant() as place:
        endpoint = f"tcp/127.0.0.1:{place.server.address.port}"
        process = await asyncio.create_subprocess_exec(
            sys.executable, str(EXAMPLE), endpoint, stdout=asyncio.subprocess.PIPE
        )
        async with asyncio.timeout(PATIENCE):
            printed, _ = await process.communicate()
        assert printed.decode().splitlines() == [
            f"smartcam/plant/cameras/{NAME} ['RUNNING', 'WAITING_FOR_TRIGGER']",
            "{'n': 1}",
            "1",
        ]
        assert process.returncode == 0


def test_example_is_short_and_stands_on_the_page() -> None:
    source = EXAMPLE.read_text(encoding="utf-8")
    assert len(source.splitlines()) < 30
    assert "smartcam" not in re.findall(r"^import (\w+)", source, re.MULTILINE)
    function = source[source.index("def use") : source.index("\n\n\nif __name__")]
    assert function in (ROOT / "docs" / "bus.md").read_text(encoding="utf-8")
