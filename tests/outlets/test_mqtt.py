"""Results, states and commands over MQTT, against Debian's mosquitto."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from smartcam.exceptions import CameraBusyError, ConfigurationError
from smartcam.outlets import Outlets
from tests.outlets.broker import broker, listener, needs_mosquitto
from tests.outlets.outletkit import result, until

pytest.importorskip("aiomqtt")
pytestmark = [pytest.mark.real_time, needs_mosquitto]


def section(url: str, **more: Any) -> dict[str, dict[str, Any]]:
    return {"mqtt": {"broker": url, "timeout": 5, **more}}


async def test_results_and_errors_arrive_with_their_ids_and_the_state_is_retained(
    tmp_path: Path,
) -> None:
    async with broker(tmp_path) as there, listener(there.port, "smartcam/#") as heard:
        async with Outlets(section(there.url), tmp_path) as outlets:
            outlets.state_changed("line1/cam1", {"connected": True, "application": 1})
            outlets.offer_result(result(5))
            await until(lambda: outlets.states["mqtt"].counts.delivered == 1)
            await until(lambda: any("result" in str(one.topic) for one in heard))
            (got,) = [one for one in heard if str(one.topic) == "smartcam/result/line1/cam1"]
            said = json.loads(got.payload)
            assert said["value"] == {"n": 5}
            assert said["id"].startswith("line1/cam1/")
            assert got.qos == 1
            async with listener(there.port, "smartcam/state/#") as late:
                await until(lambda: bool(late))
            assert late[0].retain
            assert json.loads(late[0].payload)["connected"] is True
        await until(lambda: json.loads(heard[-1].payload) == {"online": False})


async def test_what_comes_while_the_broker_is_dead_is_delivered_when_it_is_back(
    tmp_path: Path,
) -> None:
    async with broker(tmp_path) as there, Outlets(section(there.url), tmp_path) as outlets:

        def account() -> Any:
            found = outlets.states["mqtt"].counts
            assert found.balanced
            return found

        outlets.offer_result(result(0))
        await until(lambda: account().delivered == 1)
        await there.kill()
        for number in range(1, 31):
            outlets.offer_result(result(number))
        await until(lambda: outlets.states["mqtt"].trouble != "")
        assert account().spooled == 30
        await there.start()
        async with listener(there.port, "smartcam/result/#") as heard:
            await until(lambda: account().delivered == 31)
            await until(lambda: bool(heard))


async def test_over_a_line_that_is_cut_again_and_again_every_result_arrives_and_repeats_have_its_id(
    tmp_path: Path,
) -> None:
    links: set[asyncio.StreamWriter] = set()
    async with broker(tmp_path) as there, listener(there.port, "smartcam/result/#") as heard:

        async def copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            with contextlib.suppress(OSError):
                while data := await reader.read(4096):
                    writer.write(data)
            writer.close()

        async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            inward, outward = await asyncio.open_connection("127.0.0.1", there.port)
            links.update((writer, outward))
            await asyncio.gather(copy(reader, outward), copy(inward, writer))

        line = await asyncio.start_server(relay, "127.0.0.1", 0)
        port = line.sockets[0].getsockname()[1]
        async with Outlets(section(f"mqtt://127.0.0.1:{port}"), tmp_path) as outlets:
            for number in range(300):
                outlets.offer_result(result(number))
                await asyncio.sleep(0.002)
                if number % 75 == 40:
                    for link in links:
                        link.transport.abort()
                    links.clear()
            await until(lambda: outlets.states["mqtt"].counts.delivered == 300)
            await until(lambda: len({one.payload for one in heard}) == 300)
        line.close()
    said = [json.loads(one.payload) for one in heard]
    assert {one["id"]: one["value"]["n"] for one in said}.keys() == {one["id"] for one in said}
    assert sorted({one["value"]["n"] for one in said}) == [*range(300)]
    assert len({one["id"] for one in said}) == 300


async def test_what_the_broker_refuses_is_told_and_not_lost(tmp_path: Path) -> None:
    (tmp_path / "acl").write_text("topic write smartcam/outlet/#\n")
    lines = f"allow_anonymous true\nacl_file {tmp_path}/acl\n"
    async with broker(tmp_path, lines) as there, Outlets(section(there.url), tmp_path) as outlets:
        outlets.offer_result(result(1))
        await until(lambda: "Not authorized" in outlets.states["mqtt"].trouble)
        assert outlets.states["mqtt"].counts.spooled == 1


async def test_a_camera_whose_name_is_no_topic_keeps_nothing_back(tmp_path: Path) -> None:
    async with broker(tmp_path) as there, listener(there.port, "smartcam/+/#") as heard:
        async with Outlets(section(there.url), tmp_path) as outlets:
            outlets.state_changed("a+b", {"connected": True})
            for name in ("a+b/#", "c"):
                outlets.offer_result(result(1, name))
            await until(lambda: outlets.states["mqtt"].counts.delivered == 2)
        await until(lambda: sum("result" in str(one.topic) for one in heard) == 2)
        topics = {str(one.topic): json.loads(one.payload) for one in heard}
    assert topics["smartcam/result/a_b/_"]["camera"] == "a+b/#"
    assert topics["smartcam/state/a_b"]["camera"] == "a+b"


async def test_each_of_many_commands_at_once_is_answered(tmp_path: Path) -> None:
    import aiomqtt

    async def command(_camera: str, _verb: str, _given: Mapping[str, Any]) -> dict[str, Any]:
        await asyncio.sleep(0.5)
        return {}

    async with (
        broker(tmp_path) as there,
        listener(there.port, "smartcam/outlet/mqtt") as online,
        listener(there.port, "smartcam/reply/#") as replies,
        Outlets(section(there.url, commands=True), tmp_path, command=command),
    ):
        await until(lambda: bool(online))
        async with aiomqtt.Client(
            "127.0.0.1", there.port, protocol=aiomqtt.ProtocolVersion.V5
        ) as client:
            client.pending_calls_threshold = 500
            topic = "smartcam/command/trigger"
            await asyncio.gather(
                *(client.publish(f"{topic}/cam{n}", f'{{"id": {n}}}', qos=1) for n in range(300))
            )
        await until(lambda: len(replies) >= 300)
    said = [json.loads(one.payload) for one in replies]
    assert sorted(one["id"] for one in said) == [*range(300)]
    assert all(one["ok"] for one in said)


async def test_an_answer_that_the_broker_refuses_keeps_no_result_back(tmp_path: Path) -> None:
    import aiomqtt
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    done = asyncio.Event()

    async def command(_camera: str, _verb: str, _given: Mapping[str, Any]) -> dict[str, Any]:
        done.set()
        return {}

    (tmp_path / "acl").write_text("topic readwrite smartcam/#\n")  # and not answers/#
    lines = f"allow_anonymous true\nacl_file {tmp_path}/acl\n"
    settings = {"commands": True}
    async with (
        broker(tmp_path, lines) as there,
        listener(there.port, "smartcam/result/#") as heard,
        listener(there.port, "smartcam/outlet/mqtt") as online,
        Outlets(section(there.url, **settings), tmp_path, command=command) as outlets,
    ):
        await until(lambda: bool(online))
        async with aiomqtt.Client(
            "127.0.0.1", there.port, protocol=aiomqtt.ProtocolVersion.V5
        ) as client:
            make: Any = Properties  # paho has no types
            asked = make(PacketTypes.PUBLISH)
            asked.ResponseTopic = "answers/mine"
            topic = "smartcam/command/trigger/line1/cam1"
            await client.publish(topic, "", qos=1, properties=asked)
            await asyncio.wait_for(done.wait(), 30)
            for number in range(1, 51):
                outlets.offer_result(result(number))
                await asyncio.sleep(0.005)
        await until(lambda: outlets.states["mqtt"].counts.delivered == 50)
        await until(lambda: len(heard) >= 50)
    assert [json.loads(one.payload)["value"]["n"] for one in heard] == [*range(1, 51)]
    assert len(online) == 2  # it came, and left at the end


async def test_a_message_that_is_too_large_is_dropped_and_counted(tmp_path: Path) -> None:
    async with (
        broker(tmp_path) as there,
        Outlets(section(there.url, largest=2000), tmp_path) as outlets,
    ):
        for n, text in enumerate(["a", "x" * 5000, "b"]):
            outlets.offer_result(result(n, value={"text": text}))
        await until(lambda: outlets.states["mqtt"].counts.spooled == 0)
        found = outlets.states["mqtt"].counts
        assert (found.delivered, found.dropped) == (2, {"refused": 1})


async def test_what_is_too_large_for_the_broker_keeps_nothing_else_back(tmp_path: Path) -> None:
    lines = "allow_anonymous true\nmax_packet_size 2000\n"  # which it tells
    async with broker(tmp_path, lines) as there, Outlets(section(there.url), tmp_path) as outlets:
        for length in (1000, 5000, *range(1600, 1900, 3)):
            outlets.offer_result(result(1, value={"text": "x" * length}))
        await until(lambda: outlets.states["mqtt"].counts.spooled == 0)
        found = outlets.states["mqtt"].counts
        assert not outlets.states["mqtt"].trouble
    assert found.results == 102
    assert 2 < found.dropped["refused"] < found.delivered


async def test_a_message_that_the_broker_never_takes_has_those_before_it_sent_once(
    tmp_path: Path,
) -> None:
    lines = "allow_anonymous true\nmessage_size_limit 2000\n"  # which it does not tell
    async with (
        broker(tmp_path, lines) as there,
        listener(there.port, "smartcam/outlet/mqtt") as online,
        listener(there.port, "smartcam/result/#") as heard,
        Outlets(section(there.url), tmp_path) as outlets,
    ):
        for number in range(20):
            value = {"n": number, "text": "x" * (5000 if number == 15 else 1)}
            outlets.offer_result(result(number, value=value))
        await until(lambda: outlets.states["mqtt"].counts.delivered == 15)
        await until(lambda: sum(b"true" in one.payload for one in online) > 7)
        assert outlets.states["mqtt"].trouble
        assert outlets.states["mqtt"].counts.spooled == 5
    assert len(heard) < 3 * 20  # and not all of them with each of 8 tries


async def test_the_last_will_tells_that_the_process_was_killed(tmp_path: Path) -> None:
    program = (
        "import asyncio, sys\nfrom pathlib import Path\nfrom smartcam.outlets import Outlets\n"
        "async def main():\n"
        "    async with Outlets({'mqtt': {'broker': sys.argv[1]}}, Path(sys.argv[2])):\n"
        "        await asyncio.sleep(600)\n"
        "asyncio.run(main())\n"
    )
    async with broker(tmp_path) as there, listener(there.port, "smartcam/outlet/mqtt") as heard:
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-c", program, there.url, str(tmp_path)
        )
        await until(lambda: bool(heard))
        os.kill(process.pid, signal.SIGKILL)
        await process.wait()
        await until(lambda: len(heard) > 1)
    assert [json.loads(one.payload)["online"] for one in heard] == [True, False]


async def test_a_trigger_by_topic_is_done_once_and_answered_where_it_was_asked_for(
    tmp_path: Path,
) -> None:
    import aiomqtt
    from paho.mqtt.packettypes import PacketTypes
    from paho.mqtt.properties import Properties

    done: list[tuple[str, str, Mapping[str, Any]]] = []

    async def command(camera: str, verb: str, given: Mapping[str, Any]) -> dict[str, Any]:
        done.append((camera, verb, given))
        if verb == "switch":
            raise CameraBusyError("it is busy")
        return {"result": {"value": 7}}

    async with broker(tmp_path) as there, listener(there.port, "answers/#") as answers:  # noqa: SIM117
        async with aiomqtt.Client(
            "127.0.0.1", there.port, protocol=aiomqtt.ProtocolVersion.V5
        ) as client:
            topic = "smartcam/command/trigger/line1/cam1"
            await client.publish(topic, "{}", qos=1, retain=True)  # of before
            made = Outlets(section(there.url, commands=True), tmp_path, command=command)
            async with made as outlets, listener(there.port, "smartcam/reply/#") as replies:
                await until(lambda: not outlets._pumps["mqtt"].trouble)
                async with listener(there.port, "smartcam/outlet/mqtt") as online:
                    await until(lambda: bool(online))
                make: Any = Properties  # paho has no types
                asked = make(PacketTypes.PUBLISH)
                asked.ResponseTopic, asked.CorrelationData = "answers/mine", b"\1\2"
                await client.publish(topic, '{"timeout": 2, "id": 9}', qos=1, properties=asked)
                await until(lambda: bool(answers))
                said = json.loads(answers[0].payload)
                assert said == {
                    "camera": "line1/cam1",
                    "id": 9,
                    "ok": True,
                    "result": {"value": 7},
                }
                assert answers[0].properties.CorrelationData == b"\1\2"
                for text in ('{"application": 3}', "[]", "x" * 70_000):
                    await client.publish("smartcam/command/switch/line1/cam1", text, qos=1)
                await until(lambda: len(replies) == 3)
                kinds = sorted(json.loads(one.payload)["kind"] for one in replies)
                assert kinds == ["CameraBusyError", "ConfigurationError", "ConfigurationError"]
    assert [one[:2] for one in done] == [("line1/cam1", "trigger"), ("line1/cam1", "switch")]
    assert done[0][2] == {"timeout": 2}


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"broker": "http://a"}, "expected mqtt://HOST"),
        ({"broker": "mqtt://u:geheim@a"}, "no user in the address"),
        ({"broker": "mqtt://a", "password": "geheim"}, "a secret is never in this file itself"),
        ({"broker": "mqtt://a", "password": {}}, "either file or variable"),
        ({"broker": "mqtt://a", "topic": "a/#"}, "without"),
    ],
)
def test_wrong_settings_are_told_and_secrets_never(
    tmp_path: Path, settings: dict[str, Any], told: str
) -> None:
    with pytest.raises(ConfigurationError, match=told) as caught:
        Outlets({"mqtt": settings}, tmp_path)
    assert "geheim" not in str(caught.value)


async def test_a_password_comes_from_a_file_or_a_variable_and_is_in_no_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("MQTT_SECRET", "geheim")
    (tmp_path / "word").write_text("geheim\n")
    process = await asyncio.create_subprocess_exec(
        "mosquitto_passwd", "-b", "-c", str(tmp_path / "users"), "cell", "geheim"
    )
    assert await process.wait() == 0
    lines = f"allow_anonymous false\npassword_file {tmp_path}/users\n"
    caplog.set_level("DEBUG")
    async with broker(tmp_path, lines) as there:
        for where in ({"file": "word"}, {"variable": "MQTT_SECRET"}):
            made = section(there.url, user="cell", password=where)
            async with Outlets(made, tmp_path) as outlets:
                before = outlets.states["mqtt"].counts.delivered
                outlets.offer_result(result(1))
                await until(lambda: outlets.states["mqtt"].counts.delivered > before)  # noqa: B023
        made = section(there.url, user="cell", password={"variable": "MISSING_SECRET"})
        async with Outlets(made, tmp_path) as outlets:
            await until(lambda: "MISSING_SECRET is not set" in outlets.states["mqtt"].trouble)
    assert "geheim" not in caplog.text
