"""Services for programs without smartcam, plain ones and the thesis'."""

from __future__ import annotations

import asyncio
import base64
import socket
import time
from functools import partial
from typing import Any

import pytest

from smartcam.emulator import EmulatedCamera
from smartcam.protocols import messages as m
from tests.fleet.inside import json_services as _services
from tests.fleet.plainkit import (
    COUNTER,
    LOCALIZATIONS,
    NAME,
    PATIENCE,
    PREFIX,
    SILENT,
    TEXTS,
    heard,
    is_virtual,
    plant,
)
from tests.handmade import refusing

# ---------------------------------------------------------------------- plain ones


@pytest.mark.both_buses
async def test_services_do_what_the_camera_s_methods_do() -> None:
    async with plant() as place:
        call = place.client.call
        assert (await call("query_application"))["application"] == COUNTER
        assert (await call("switch_application", application=TEXTS))["application"] == TEXTS
        assert place.active == TEXTS
        assert (await call("trigger"))["result"]["value"] == ["bolt", ""]
        assert await call("stop") == {"error": ""}
        assert (await call("status"))["status_names"] == []
        assert await call("start") == {"error": ""}
        ready = await call("wait_ready")
        assert ready["status_names"] == ["RUNNING", "WAITING_FOR_TRIGGER"]
        assert ready["status"] == 0x280
        await call("set_clock", when="2030-01-31T12:00:00")
        assert (await call("get_clock"))["clock"].startswith("2030-01-31T12:00")
        await call("set_input", input="00ff")
        await call("query_application")
        assert heard(place.camera, m.SetInput) == 1


@pytest.mark.both_buses
async def test_frame_comes_as_a_picture_with_what_is_known_of_it() -> None:
    async with plant(frames="synthetic://?size=300x200&fps=50&name=x") as place:
        assert (await place.client.ask("cameras/**"))[0][1]["frames"].startswith("synthetic://")
        call = partial(place.client.call, timeout=PATIENCE)
        frame = (await call("frame", quality=50, fresh=True))["frame"]
        picture = base64.b64decode(frame["data"])
        assert picture[:2] == b"\xff\xd8"
        assert len(picture) == frame["size"]
        assert (frame["format"], frame["width"], frame["height"]) == ("MJPEG", 300, 200)
        assert 0 <= frame["age"] < PATIENCE
        assert frame["moment"] == "EXPOSURE_START"
        assert frame["lost"] >= 0
        png = await call("frame", encoding="png", max_age=60)
        assert base64.b64decode(png["frame"]["data"])[1:4] == b"PNG"
        assert (await place.client.call("frame", encoding="bmp"))["kind"] == "ConfigurationError"
    async with plant() as place:
        assert (await place.client.call("frame"))["kind"] == "UnsupportedError"


@pytest.mark.both_buses
async def test_trigger_takes_what_the_method_takes() -> None:
    async with plant() as place:
        call = place.client.call
        answer = await call("trigger", application=TEXTS, timeout=PATIENCE)
        assert answer["result"]["application"] == TEXTS
        assert place.active == COUNTER  # it went back
        answer = await call("trigger", results_per_trigger=1, when_busy="refuse")
        assert [one["value"] for one in answer["results"]] == [{"n": 1}]
        answer = await call("trigger", interpret_as="k: uint16, l: uint16")
        assert answer["result"]["value"] == {"k": 2, "l": 0}
        answer = await call("trigger", interpret_as="k: uint17")
        assert answer["kind"] == "LayoutError"
        assert heard(place.camera, m.Trigger) == 3


@pytest.mark.both_buses
async def test_error_has_its_text_its_kind_and_what_is_known() -> None:
    async with plant() as place:
        answer = await place.client.call("switch_application", application=99)
        assert answer["kind"] == "CommandRejectedError"
        assert answer["attributes"]["active_application"] == COUNTER
        assert "refused to switch to application 99" in answer["error"]
        assert (await place.client.call("read_image"))["kind"] == "UnsupportedError"
        await place.client.call("switch_application", application=SILENT)
        answer = await place.client.call("trigger", timeout=0.2)
        assert answer["kind"] == "TriggerTimeoutError"


@pytest.mark.both_buses
@pytest.mark.parametrize(
    ("request_", "said"),
    [
        (b"{", "no JSON"),
        (b"\xff\xfe", "no JSON"),
        (b"[" * 100_000, "no JSON"),
        (b'{"timeout": Infinity}', "no JSON"),
        (b"[1]", "expected a JSON object, got list"),
        (b" " * (1 << 18) + b"{}", "at most 262144 are accepted"),
        ({"timeout": "5"}, "timeout"),
        ({"timeout": 0}, "timeout"),
        ({"timeout": 1e9}, "timeout"),
        ({"timeout": True}, "timeout"),
        ({"tiemout": 5}, "did you mean 'timeout'"),
        ({"application": "seven"}, "application"),
        ({"application": -1}, "application"),
        ({"input": "0g"}, "expected bytes as hex"),
        ({"results_per_trigger": 10**9}, "results_per_trigger"),
        ({"when_busy": "hope"}, "when_busy"),
        ({"id": []}, "id: Value error, expected a text of 1 to 200 bytes, or an integer"),
        ({"id": "x" * 201}, "id"),
        ({"id": ""}, "id"),
        ({"id": True}, "id"),
    ],
)
async def test_bad_request_is_told_and_nothing_is_done(request_: object, said: str) -> None:
    async with plant() as place:
        ((_, answer),) = await place.client.ask(f"service/{NAME}/trigger", request_)
        assert said in answer["error"]
        assert answer["kind"] == "ConfigurationError"
        assert heard(place.camera, m.Trigger) == 0
        assert (await place.client.call("trigger"))["result"]["value"] == {"n": 1}


@pytest.mark.both_buses
@pytest.mark.parametrize(
    "key",
    [
        "service/line1/*/trigger",
        "service/**/trigger",
        "service/**",
        f"service/{NAME}/*",
        f"service/{NAME}/trig$*",
        "thesis/*",
    ],
)
async def test_command_for_whoever_it_may_concern_is_refused(key: str) -> None:
    async with plant() as place:
        answers = await place.client.ask(key, {"camera_name": NAME})
        assert answers
        for _, answer in answers:
            assert "nothing was done" in answer["error"]
        assert heard(place.camera, m.Trigger) == 0


@pytest.mark.both_buses
async def test_what_is_not_there_is_told() -> None:
    async with plant() as place:
        answer = await place.client.call("triger")
        assert "did you mean 'trigger'" in answer["error"]
        for camera, said in [("line1/cam9", "has no camera"), ("Line1/cam3", "expected a name")]:
            answer = await place.client.call("trigger", camera)
            assert said in answer["error"]
            assert answer["kind"] == "ConfigurationError"


@pytest.mark.both_buses
async def test_camera_that_is_gone_is_told() -> None:
    async with plant(reconnect=False) as place:
        statuses = await place.client.topic("topic/status/**")
        await place.camera.stop()
        await statuses.until(lambda said: not said["connected"])
        assert (await place.client.call("trigger"))["kind"] == "ConnectionLostError"


# ---------------------------------------------------------------------- ids


@pytest.mark.both_buses
async def test_same_id_is_done_once_and_answered_the_same() -> None:
    async with plant() as place:
        same = {"id": "4f1c", "program": "cell"}
        answers = await asyncio.gather(*(place.client.call("trigger", **same) for _ in range(3)))
        answers.append(await place.client.call("trigger", **same, timeout=1))
        assert [answer["result"]["value"] for answer in answers] == [{"n": 1}] * 4
        assert heard(place.camera, m.Trigger) == 1
        other = await place.client.call("trigger", id="4f1c", program="another")
        assert other["result"]["value"] == {"n": 2}


@pytest.mark.both_buses
async def test_id_of_another_call_is_refused() -> None:
    async with plant() as place:
        await place.client.call("trigger", id=1)
        answer = await place.client.call("switch_application", id=1, application=TEXTS)
        assert answer["kind"] == "LocalProtocolError"
        assert place.active == COUNTER


@pytest.mark.both_buses
async def test_failure_is_remembered_too() -> None:
    async with plant() as place:
        first = await place.client.call("switch_application", id="a", application=99)
        assert first["kind"] == "CommandRejectedError"
        sent = heard(place.camera, m.SwitchApplication)
        assert await place.client.call("switch_application", id="a", application=99) == first
        assert heard(place.camera, m.SwitchApplication) == sent


@pytest.mark.both_buses
async def test_call_for_an_earlier_start_of_the_agent_is_not_done() -> None:
    async with plant() as place:
        epoch = (await place.client.call("status"))["epoch"]
        assert (await place.client.call("trigger", epoch=epoch))["error"] == ""
        answer = await place.client.call("trigger", epoch="1")
        assert answer["kind"] == "ConnectionLostError"
        assert "was not done" in answer["error"]
        assert heard(place.camera, m.Trigger) == 1


async def test_memory_of_answers_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_services, "MAX_ANSWERS_REMEMBERED", 3)
    async with plant() as place:
        for number in range(5):
            await place.client.call("trigger", id=number)
        await place.client.call("trigger", id=4)
        assert heard(place.camera, m.Trigger) == 5
        await place.client.call("trigger", id=0)  # forgotten
        assert heard(place.camera, m.Trigger) == 6


async def test_bytes_of_answers_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_services, "MAX_ANSWER_BYTES_REMEMBERED", 100)
    async with plant() as place:
        await place.client.call("trigger", id=1)
        await place.client.call("trigger", id=1)
        assert heard(place.camera, m.Trigger) == 2


# ---------------------------------------------------------------------- bounds, ends


@pytest.mark.both_buses
async def test_call_waits_for_a_reservation_within_its_time() -> None:
    async with plant() as place, place.fleet() as fleet:
        async with fleet[NAME].reserve(timeout=PATIENCE):
            holder = (await place.client.call("status"))["reserved_by"]
            answer = await place.client.call("trigger", timeout=0.2, program=holder)
            assert answer["kind"] == "TriggerTimeoutError"
            assert f"reserved by {holder}" in answer["error"]
            assert "was not done" in answer["error"]
            waiting = asyncio.ensure_future(place.client.call("trigger", timeout=PATIENCE))
            await fleet[NAME].trigger()
        assert (await waiting)["result"]["value"] == {"n": 2}
        assert (await place.client.call("status"))["reserved_by"] is None


async def test_number_of_calls_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_services, "MAX_CONCURRENT_CALLS", 2)
    async with plant() as place:
        await place.client.call("switch_application", application=SILENT)
        calls = [place.client.call("trigger", timeout=1) for _ in range(4)]
        kinds = [answer["kind"] for answer in await asyncio.gather(*calls)]
        assert kinds == ["TriggerTimeoutError"] * 2 + ["LocalProtocolError"] * 2
        assert (await place.client.call("status"))["error"] == ""


async def test_repeats_that_wait_are_bounded() -> None:
    async with plant() as place:
        await place.client.call("switch_application", application=SILENT)
        most = _services.MAX_WAITING_REPEATS
        calls = [place.client.call("trigger", timeout=1, id=1) for _ in range(most + 1)]
        kinds = [answer["kind"] for answer in await asyncio.gather(*calls)]
        assert kinds == ["TriggerTimeoutError"] * most + ["LocalProtocolError"]


@pytest.mark.both_buses
async def test_agent_that_ends_answers_calls_under_way() -> None:
    async with plant() as place:
        await place.client.call("switch_application", application=SILENT)
        statuses = await place.client.topic("topic/status/**")
        waiting = asyncio.ensure_future(place.client.call("trigger", timeout=PATIENCE))
        await statuses.until(lambda said: "WAITING_FOR_TRIGGER" not in said["status_names"])
        await place.server.stop()
        answer = await waiting
        assert answer["kind"] == "ConnectionClosedError"
        assert "unknown" in answer["error"]


@pytest.mark.both_buses
@pytest.mark.parametrize("service", ["trigger", "start"])
async def test_command_that_comes_after_its_deadline_is_not_done(service: str) -> None:
    """As behind an agent that was stopped for a while, whose queries wait for it."""
    async with plant() as place:
        listed = (await place.client.ask("cameras/**"))[0][1]["next_result"]
        answer = await place.client.call(service, timeout=5, deadline=time.time() - 0.1)
        assert "after its deadline" in answer["error"]
        assert "was not done" in answer["error"]
        assert answer["kind"].endswith("TimeoutError")
        assert (await place.client.ask("cameras/**"))[0][1]["next_result"] == listed
        answer = await place.client.call(service, timeout=5, deadline=time.time() + 60)
        assert answer["error"] == ""
        for wrong in ("soon", -1, True, float("1e999")):
            assert (await place.client.call(service, deadline=wrong))["kind"]


# ---------------------------------------------------------------------- the thesis' interface


@pytest.mark.both_buses
@pytest.mark.parametrize("host", ["as listed", "localhost"])
async def test_setup_takes_no_camera_that_the_fleet_has_under_another_name(host: str) -> None:
    async with plant() as place:
        where = place.camera.host if host == "as listed" else host
        fields: dict[str, Any] = {"con_address": where, "port": place.camera.port}
        answer = await place.client.thesis("Setup", "thief", **fields)
        assert answer["kind"] == "ConfigurationError"
        assert f"is the camera {NAME} of the agent one" in answer["error"]
        assert [key for key, _ in await place.client.ask("cameras/**")] == [f"cameras/{NAME}"]
        assert (await place.client.call("trigger"))["error"] == ""  # its session goes on


async def test_of_two_setups_of_one_address_one_adds_it() -> None:
    async with plant() as place, EmulatedCamera(active=LOCALIZATIONS, running=True) as other:
        fields = {"con_address": other.host, "port": other.port}
        answers = await asyncio.gather(
            *(place.client.thesis("Setup", name, **fields) for name in ("left", "right"))
        )
        assert sorted(bool(one["error"]) for one in answers) == [False, True]
        listed = [key for key, _ in await place.client.ask("cameras/**")]
        assert len(listed) == 2


async def test_setup_that_fails_behind_the_session_leaves_nothing_behind() -> None:
    async with plant() as place, EmulatedCamera(active=LOCALIZATIONS, running=True) as other:
        fields = {"con_address": other.host, "port": other.port}
        answer = await place.client.thesis("Setup", "new", application_id=99, **fields)
        assert answer["kind"]
        assert [key for key, _ in await place.client.ask("cameras/**")] == [f"cameras/{NAME}"]
        assert not other.has_session
        answer = await place.client.thesis("Setup", "new", interpret_as="nonsense(", **fields)
        assert answer["kind"]
        assert (await place.client.thesis("Setup", "other", **fields))["error"] == ""
        # a later one that fails takes away nothing
        assert (await place.client.thesis("Setup", "other", application_id=99))["kind"]
        assert len(await place.client.ask("cameras/**")) == 2


@pytest.mark.both_buses
@pytest.mark.parametrize("name", ["Setup", "SmartcameraSetup"])
async def test_setup_of_a_camera_that_is_there(name: str) -> None:
    async with plant() as place:
        answer = await place.client.thesis(
            name,
            camera_model_name="BVS002C",
            port=place.camera.port,
            con_address="127.0.0.1",
            application_id=LOCALIZATIONS,
            interpret_as="Localizations",
            topic_status="/cell/status",
        )
        assert answer == {"error": "", "topic": "smartcam/plant/thesis/topic/cell/status"}
        assert place.active == LOCALIZATIONS
        statuses = await place.client.topic("thesis/topic/cell/status")
        result = (await place.client.call("trigger"))["result"]
        assert result["value"][0]["feature_id"] == "big_triangle_1"
        _, said = await statuses.next()
        assert (said["camera"], said["application"]) == (NAME, LOCALIZATIONS)
        answer = await place.client.thesis(name, con_address="10.9.9.9")
        assert f"it is at bvs://127.0.0.1:{place.camera.port}" in answer["error"]
        wrongs: list[dict[str, Any]] = [
            {"interpret_as": "nonsense"},
            {"camera_model_name": "IN-SIGHT"},
            {"camera_model_name": "BVS003"},
            {"topic_status": "a b"},
            {"port": []},
        ]
        for wrong in wrongs:
            assert (await place.client.thesis(name, **wrong))["kind"]


@pytest.mark.both_buses
async def test_setup_adds_a_camera_and_stop_removes_it() -> None:
    async with (
        plant() as place,
        EmulatedCamera(active=LOCALIZATIONS, running=True) as other,
        place.fleet() as fleet,
    ):
        fields = {"con_address": other.host, "port": other.port, "camera_model_name": "BVS002C"}
        answer = await place.client.thesis("Setup", "line2/new", **fields)
        assert answer == {"error": "", "topic": ""}
        answer = await place.client.thesis("TriggerLocalization", "line2/new")
        assert answer["localizations"]
        listed = sorted(key for key, _ in await place.client.ask("cameras/**"))
        assert listed == [f"cameras/{NAME}", "cameras/line2/new"]
        camera = fleet["line2/new"]
        await camera.wait_connected(timeout=PATIENCE)
        assert (await camera.trigger()).number == 2
        assert await place.client.thesis("Stop", "line2/new") == {"error": ""}
        assert not other.has_session
        assert "has no camera" in (await place.client.thesis("Stop", "line2/new"))["error"]
        assert (await place.client.thesis("Setup", "line2/new", **fields))["error"] == ""
        await camera.wait_connected(timeout=PATIENCE)
        assert (await camera.trigger()).number == 3  # numbers go on


@pytest.mark.both_buses
async def test_setup_that_finds_no_camera_leaves_nothing() -> None:
    async with plant() as place:
        with refusing(socket.SOCK_STREAM) as port:
            answer = await place.client.thesis("Setup", "new", con_address="127.0.0.1", port=port)
        assert "nothing listens at" in answer["error"]
        assert [key for key, _ in await place.client.ask("cameras/**")] == [f"cameras/{NAME}"]
        answer = await place.client.thesis("Setup", "new")
        assert "expected con_address" in answer["error"]
        answer = await place.client.thesis(
            "Setup", "new", con_address="127.0.0.1", camera_model_name="BVS003"
        )
        assert "unknown camera model" in answer["error"]


@pytest.mark.both_buses
async def test_publishing_keeps_its_delay_and_its_queue() -> None:
    async with plant() as place:
        loop = asyncio.get_running_loop()
        answer = await place.client.thesis(
            "EnablePublishing", topic_for_outputs="outputs", min_delay=0.5, queue_size=2
        )
        assert answer == {"error": "", "topic": "smartcam/plant/thesis/topic/outputs"}
        outputs = await place.client.topic("thesis/topic/outputs")
        begun = loop.time()
        for _ in range(5):
            await place.client.call("trigger")
        came = await outputs.until(lambda said: said["number"] == 5)
        numbers = [said["number"] for said in came]
        assert loop.time() - begun >= 0.5 * (len(numbers) - 1)
        if is_virtual():
            assert numbers == [1, 4, 5]
        assert came[0]["value"] == {"n": 1}


@pytest.mark.both_buses
async def test_stop_ends_publishing_and_leaves_a_camera_of_the_file() -> None:
    async with plant() as place:
        await place.client.thesis("EnablePublishing", topic_for_outputs="outputs")
        await place.client.thesis("Setup", interpret_as="raw", topic_status="state")
        said = await place.client.topic("thesis/topic/**")
        mark = place.server._bus.publisher(f"{PREFIX}/thesis/topic/mark")
        assert (await place.client.call("trigger"))["result"]["value"] == "01000000"
        assert await place.client.thesis("SmartcameraStop") == {"error": ""}
        mark.put(b'{"mark": 1}')  # all that was said comes before, and maybe after any answer
        came = await said.until(lambda one: "mark" in one)
        assert any("raw" in one for one in came)
        assert (await place.client.call("trigger"))["result"]["value"] == {"n": 2}
        await place.client.call("status")
        mark.put(b'{"mark": 2}')
        assert (await said.next())[1] == {"mark": 2}
        mark.close()


@pytest.mark.both_buses
async def test_change_application() -> None:
    async with plant() as place:
        answer = await place.client.thesis("ChangeApplication", application_id=TEXTS)
        assert answer == {"error": ""}
        assert place.active == TEXTS
        answer = await place.client.thesis("ChangeApplication", application_id=99)
        assert "refused" in answer["error"]
        assert "application_id" in (await place.client.thesis("ChangeApplication"))["error"]


@pytest.mark.both_buses
async def test_one_trigger_for_each_type_of_result() -> None:
    async with plant() as place:
        thesis = place.client.thesis
        answer = await thesis("Trigger50ByteString", application_id=TEXTS, timeout=PATIENCE)
        assert answer == {"error": "", "strings": ["bolt", ""]}
        assert place.active == COUNTER  # it went back
        answer = await thesis("TriggerLocalization", application_id=LOCALIZATIONS)
        part = answer["localizations"][0]
        assert set(part) == {"feature_id", "quality", "photo_index", "pose"}
        assert set(part["pose"]) == {"header", "position", "orientation"}
        assert set(part["pose"]["header"]) == {"seq", "stamp", "frame_id"}
        assert part["pose"]["header"]["frame_id"] == NAME
        assert set(part["pose"]["orientation"]) == {"x", "y", "z", "w"}
        answer = await thesis("TriggerLocalization", timeout=0, application_id=0)
        assert answer["localizations"] == []
        assert answer["kind"] == "InterpretationError"
        answer = await thesis("Trigger50ByteString", "line1/cam9")
        assert answer["strings"] == []
        assert "has no camera" in answer["error"]


async def test_thesis_fields_that_are_empty_or_0_count_as_not_said() -> None:
    async with plant() as place:
        for empty in ("", 0):
            for _ in range(2):
                answer = await place.client.thesis(
                    "ChangeApplication", id=empty, epoch="", timeout=0, application_id=TEXTS
                )
                assert answer == {"error": ""}
                answer = await place.client.thesis(
                    "Trigger50ByteString", id=empty, epoch="", deadline=0
                )
                assert answer["error"] == ""
        assert heard(place.camera, m.Trigger) == 4


async def test_localizations_are_read_as_is_known() -> None:
    layout = "localizations: x: int16 mm, y: int16 mm"
    async with plant(interpret_as=layout) as place:
        answer = await place.client.thesis("TriggerLocalization")
        position = answer["localizations"][0]["pose"]["position"]
        assert position == {"x": 0.001, "y": 0.0, "z": 0.0}


@pytest.mark.both_buses
@pytest.mark.parametrize("request_", [{}, {"camera_name": ""}, {"camera_name": 5}, b"{", b""])
async def test_thesis_request_without_a_camera_is_told(request_: Any) -> None:
    async with plant() as place:
        ((_, answer),) = await place.client.ask("thesis/TriggerLocalization", request_)
        assert answer["localizations"] == []
        assert "camera_name" in answer["error"] or "no JSON" in answer["error"]
        ((_, answer),) = await place.client.ask("thesis/TriggerLocalisation", request_)
        assert "did you mean 'TriggerLocalization'" in answer["error"]
