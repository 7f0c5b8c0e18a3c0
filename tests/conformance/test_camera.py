"""The camera suite: documented cameras pass, each quirk is found out, each check can fail."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Iterator
from typing import Any, get_args

import pytest
import yaml

from smartcam._loop_thread import LoopThread
from smartcam.conformance.camera import Allow, ConformanceOptions, judge
from smartcam.conformance.camera._items import CHECKS, ITEMS, QUESTIONS
from smartcam.conformance.camera._judging import judge_item
from smartcam.conformance.camera._results import Check, CheckOutcome
from smartcam.conformance.camera._session_under_test import CameraUnderTest
from smartcam.emulator import Quirks, Scenario
from smartcam.emulator._inside import ClientLink
from smartcam.exceptions import ConfigurationError
from smartcam.models import Status
from smartcam.protocols import messages as m
from tests.conformance import camera_sins
from tests.conformance.camera_world import (
    APPLICATION,
    OTHER,
    WORLDS,
    Case,
    Judged,
    emulated,
    judge_all,
    loop_thread,
    short_options,
)
from tests.conformance.pace import at_any_pace, slowed
from tests.handmade import refusing

FAST = {"reboot_time": 0.2}

IMPATIENT = {"timeout": 0.4}
"""For cameras that leave something out: what does not come is waited for."""

EACH = {
    "code": ["b16"],
    "no_id": ["b16"],
    "big_endian_number": ["b16"],
    "disconnect_answer": ["bid"],
    "bad_message": ["bid"],
    "push_status": ["bid"],
    "busy_while_processing": ["handbook", "bid"],
    "bad_frame": ["handbook", "thesis"],
}
"""The dialects in which a quirk is tried; others in handbook."""

VALUES: dict[str, list[Any]] = {
    "overtriggered_time": [0.03, 0.6],
    "input_queue_depth": [1, 3, 20],
    "reboot_time": [0.6],
}


def settings() -> Iterator[tuple[str, Any, str]]:
    """Yield each quirk with each of its values, and the dialects."""
    for name, field in Quirks.model_fields.items():
        values = VALUES.get(name) or get_args(field.annotation) or (False, True)
        for value in values:
            yield from ((name, value, dialect) for dialect in EACH.get(name, ["handbook"]))


SETTINGS = [
    *((quirk, value, dialect, "tcp") for quirk, value, dialect in settings()),
    ("code", True, "b16", "udp"),
    ("no_id", True, "b16", "udp"),
    ("push_status", True, "bid", "udp"),
    ("bad_message", "ignore", "bid", "udp"),
    ("disconnect_answer", "silent", "bid", "udp"),
    ("waiting_before_result", True, "b16", "udp"),
    ("switch_while_running", "ignore", "thesis", "udp"),
]


@pytest.fixture(scope="module")
def judged() -> Iterator[Judged]:
    """Judge all cameras of this file together: they wait nearly always."""
    cases = [
        *(Case({"dialect": d, "transport": t, "quirks": FAST}) for d, t in WORLDS),
        *(
            Case({"dialect": d, "transport": t, "quirks": {**FAST, name: value}}, (name,))
            for name, value, d, t in SETTINGS
        ),
        *(
            Case(
                {"dialect": sin.dialect, "transport": sin.transport, "quirks": FAST, **sin.camera},
                (sin.check,),
                sin.do,
                IMPATIENT,
            )
            for sin in camera_sins.SINS
        ),
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ClientLink, "_handle_bytes", camera_sins.open_to_bytes)
        yield Judged(cases)


# ---------------------------------------------------------------------- documented cameras


@pytest.mark.parametrize("world", WORLDS, ids="-".join)
@at_any_pace
def test_judge_documented_camera_finds_nothing(world: tuple[str, str], judged: Judged) -> None:
    report = judged[WORLDS.index(world)]
    assert [(one.item.name, one.expected, one.observed) for one in report.differing] == []
    unseen = {one.item.name for one in report.findings if one.outcome is CheckOutcome.NOT_OBSERVED}
    assert unseen <= {"free-run-needs-no-trigger", "waiting_before_result"}
    assert report.camera.not_restored == ""


@pytest.mark.parametrize("world", WORLDS, ids="-".join)
@at_any_pace
def test_judge_documented_camera_gives_the_default_quirks(
    world: tuple[str, str], judged: Judged
) -> None:
    found = dict(judged[WORLDS.index(world)].quirks)
    assert found.pop("overtriggered_time", 0.1) == pytest.approx(0.1, abs=slowed(0.2))
    assert found.pop("reboot_time", slowed(0.2)) == pytest.approx(slowed(0.2), abs=slowed(0.4))
    assert found == {name: Quirks.model_fields[name].default for name in found}


@pytest.mark.parametrize("world", WORLDS, ids="-".join)
@at_any_pace
def test_report_yaml_makes_a_scenario(world: tuple[str, str], judged: Judged) -> None:
    report = judged[WORLDS.index(world)]
    scenario = Scenario.model_validate(yaml.safe_load(report.yaml()))
    assert scenario.quirks.model_dump(include=set(report.quirks)) == report.quirks


def test_every_quirk_has_a_question() -> None:
    asked = [item.quirk for item in QUESTIONS if item.quirk is not None]
    assert sorted(asked) == sorted(Quirks.model_fields)


def test_every_contradiction_that_shows_is_decided() -> None:
    decided = {name for item in ITEMS for name in item.contradictions}
    assert decided == {f"C{number}" for number in range(1, 10)}


# ---------------------------------------------------------------------- quirks


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda one: "-".join(map(str, one)))
@at_any_pace
def test_judge_quirk_is_found_out(setting: tuple[str, Any, str, str], judged: Judged) -> None:
    name, value, *_ = setting
    report = judged[len(WORLDS) + SETTINGS.index(setting)]
    slack = {"overtriggered_time": 0.45, "reboot_time": 0.5}.get(name, 0)
    got = report.quirks.get(name, report[name])
    assert got == (pytest.approx(slowed(value), abs=slowed(slack)) if slack else value)


@pytest.mark.long
@at_any_pace
def test_judge_b16_with_every_deviation_pins_them_in_the_url() -> None:
    quirks = {"no_id": True, "code": True, "big_endian_number": True}
    camera: dict[str, Any] = {"dialect": "b16", "quirks": {**FAST, **quirks}}
    with loop_thread() as thread, emulated(thread, **camera) as emulator:
        plain = emulator.url.partition("&")[0]
        report = judge(short_options(plain))
    assert report.url == f"{plain}&quirks=big_endian_number,code,no_id"
    assert [(one.item.name, one.observed) for one in report.differing] == []
    assert report.quirks.items() >= quirks.items()


@at_any_pace
def test_judge_bid_that_pushes_shows_the_order_of_status_and_result() -> None:
    quirks = {"push_status": True, "waiting_before_result": True}
    (report,) = judge_all([Case({"dialect": "bid", "quirks": quirks}, ("waiting_before_result",))])
    assert report.quirks == {"waiting_before_result": True}


@at_any_pace
def test_judge_free_running_application_is_not_triggered() -> None:
    names = (
        *("free-run-needs-no-trigger", "start-begins-run-mode"),
        *("trigger-gives-one-result", "overtriggered_time"),
    )
    case = Case(
        {**camera_sins.FREE_RUNNING}, names, options={"other_application": None, **IMPATIENT}
    )
    (report,) = judge_all([case])
    assert [report[name].outcome for name in names[:2]] == [CheckOutcome.AS_DOCUMENTED] * 2
    assert [report[name].outcome for name in names[2:]] == [CheckOutcome.NOT_OBSERVED] * 2
    assert "application 5 " in report[names[2]].text


# ---------------------------------------------------------------------- sins


@pytest.mark.parametrize(
    "number",
    range(len(camera_sins.SINS)),
    ids=[f"{sin.check}-{sin.dialect}-{sin.transport}" for sin in camera_sins.SINS],
)
@at_any_pace
def test_judge_sinful_camera_fails_the_check(number: int, judged: Judged) -> None:
    sin = camera_sins.SINS[number]
    finding = judged[len(WORLDS) + len(SETTINGS) + number][sin.check]
    assert finding.outcome is CheckOutcome.DIFFERS, finding
    assert sin.came in finding.observed
    assert finding.wire


def test_every_check_has_a_camera_that_fails_it() -> None:
    tried = {sin.check for sin in camera_sins.SINS} | {"silent-before-connect"}
    assert tried == {check.name for check in CHECKS}


@at_any_pace
def test_judge_camera_that_talks_before_connect_differs() -> None:
    status = bytes.fromhex("50535642 08000000 12000000 80020000 00000000")
    with socket.create_server(("127.0.0.1", 0)) as server:

        def talk() -> None:
            with server.accept()[0] as peer:
                peer.sendall(status)
                peer.recv(1)

        thread = threading.Thread(target=talk)
        thread.start()
        url = f"bvs://127.0.0.1:{server.getsockname()[1]}?dialect=handbook"
        report = judge(short_options(url), ["silent-before-connect"])
        thread.join()
    assert report["silent-before-connect"].observed.startswith("StatusReport(status=")


# ---------------------------------------------------------------------- what no setting describes

BOTH_SERVED = "the second client's Connect was answered; the first client is served on"


def _serve_everybody(emulator: Any) -> None:
    """Leave a client whose session is taken, and go on to answer its Query."""

    def answer(emulator: Any, link: Any, data: bytes) -> bytes:
        if data == emulator.wire_dialect.encode(m.Query()) and not emulator.serves(link):
            camera_sins.write(emulator, link, camera_sins.QUERY_ANSWER)
        return data

    camera_sins.takes(answer)(emulator)


def _stuck(_: Any, link: Any, data: bytes) -> bytes:
    """Receive nothing more after a wrong magic number."""
    link.stuck = getattr(link, "stuck", False) or data.startswith(b"\xaf")
    return b"" if link.stuck else data


UNDESCRIBED = [
    ("second_client", _serve_everybody, "handbook", BOTH_SERVED),
    ("bad_frame", camera_sins.takes(_stuck), "handbook", "after a wrong magic number: the st"),
    ("bad_message", camera_sins.deaf(m.MalformedMessage), "bid", "id 0x7f: 7f 00 02 00 13 00"),
    ("ready_bit", camera_sins.replaced(m.StatusReport, status=Status(0x210)), "bid", "0x0001"),
]


@pytest.mark.parametrize(("name", "sin", "dialect", "observed"), UNDESCRIBED)
@at_any_pace
def test_judge_answer_that_no_setting_describes_is_reported(
    name: str, sin: Any, dialect: str, observed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ClientLink, "_handle_bytes", camera_sins.open_to_bytes)
    monkeypatch.setattr(ClientLink, "dismiss", lambda *_: None)
    (report,) = judge_all([Case({"dialect": dialect}, (name,), sin, IMPATIENT)])
    finding = report[name]
    assert finding.outcome is CheckOutcome.UNDESCRIBED
    assert observed in finding.observed
    assert name not in report.quirks
    if name in Quirks.model_fields:
        assert report.yaml() == f"quirks: {{}}\n  # {name}: no setting fits"


# ---------------------------------------------------------------------- what is put back


@pytest.fixture(scope="module")
def thread() -> Iterator[LoopThread]:
    with loop_thread() as thread:
        yield thread


def broken_off(camera: CameraUnderTest) -> None:
    """Load the other application, and be interrupted."""
    with camera.session() as client:
        camera.load_application(client, OTHER)
        raise KeyboardInterrupt


@pytest.mark.parametrize("running", [False, True])
@pytest.mark.parametrize("dialect", ["handbook", "bid"])
@at_any_pace
def test_judge_item_interrupted_puts_application_and_run_mode_back(
    thread: LoopThread, dialect: str, running: bool
) -> None:
    item = Check(name="broken-off", about="", sources={"": "x, y"}, run=broken_off)
    with emulated(thread, dialect=dialect, running=running) as emulator:
        camera = CameraUnderTest(short_options(emulator.url))
        with pytest.raises(KeyboardInterrupt):
            judge_item(camera, item)
        thread.run_coroutine(
            lambda: emulator.wait_received(m.Disconnect, count=2, timeout=60), timeout=120
        )
        assert emulator.device.active_application == APPLICATION
        assert emulator.device.running == (running or dialect == "bid")
        assert not emulator.has_session
    assert camera.not_restored == ""


@at_any_pace
def test_judge_camera_that_dies_says_what_could_not_be_put_back(thread: LoopThread) -> None:
    def dies(camera: CameraUnderTest) -> None:
        with camera.session() as client:
            camera.ensure_stopped(client)
            thread.run_coroutine(emulator.stop)
            client.round_trip()

    item = Check(name="dies", about="", sources={"": "x, y"}, run=dies)
    with emulated(thread, running=True) as emulator:
        camera = CameraUnderTest(short_options(emulator.url))
        finding = judge_item(camera, item)
        later = judge_item(camera, CHECKS[2])
    assert finding.outcome is CheckOutcome.DIFFERS
    assert (finding.expected, camera.gone_reason[:22]) == (
        "the link stays up",
        "there is no connection",
    )
    assert camera.not_restored.startswith(
        "application 5, running, could not be put back: there is no sess"
    )
    assert later.text.startswith("the camera is gone: there is no connection to 127.0.0.1:")


@pytest.mark.parametrize("dialect", ["handbook", "bid"])
@at_any_pace
def test_judge_nothing_allowed_only_asks(thread: LoopThread, dialect: str) -> None:
    with emulated(thread, dialect=dialect) as emulator:
        report = judge(short_options(emulator.url, allow=Allow.read("nothing")))
        said = {type(one.message) for one in emulator.log if one.direction == "in"}
    assert not report.differing
    assert report.camera.options.allow.names == []
    assert said.isdisjoint({m.Start, m.Stop, m.Trigger, m.SetClock, m.SetInput, m.Reboot})
    reasons = {one.text for one in report.findings if one.outcome is CheckOutcome.NOT_OBSERVED}
    assert "--camera-allow does not have trigger" in reasons


@at_any_pace
def test_judge_nothing_there_fails_one_check_and_ends_soon() -> None:
    with refusing(socket.SOCK_STREAM) as port:
        report = judge(short_options(f"bvs://127.0.0.1:{port}"))
    assert [one.item.name for one in report.differing] == ["connect-is-answered"]
    assert report.differing[0].expected == "an answer to Connect in one of the dialects"
    assert "Connection refused" in report.differing[0].observed


# ---------------------------------------------------------------------- what is asked for


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("", ["run", "trigger", "switch"]),
        ("clock, reboot", ["run", "trigger", "switch", "clock", "reboot"]),
        ("nothing", []),
        ("nothing,run", ["run"]),
        ("all", ["run", "trigger", "switch", "clock", "number", "input", "errors", "reboot"]),
    ],
)
def test_allow_read_names_what_may_be_done(text: str, names: list[str]) -> None:
    assert Allow.read(text).names == names


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"timeout": 0}, "timeout: expected seconds, above 0 to 3600, got 0"),
        ({"silence": float("nan")}, "silence: expected seconds, above 0 to 3600, got nan"),
        ({"application": 0}, "application: expected an integer, 1 to 4294967295, got 0"),
        ({"application": 3, "other_application": 3}, "both applications are 3: name another one"),
        ({"sequence_offset": -1}, "sequence_offset: expected an integer, 0 to 65535, got -1"),
        ({"input_data": bytes(65_537)}, "input_data has 65537 bytes: 65536 at most"),
    ],
)
def test_plan_with_what_cannot_work_is_refused(fields: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError, match=re.escape(text)):
        ConformanceOptions(url="bvs://127.0.0.1", **fields)


def test_judge_unknown_name_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="there is no check or question 'connects'"):
        judge(ConformanceOptions(url="bvs://127.0.0.1"), ["connects"])


def test_bench_of_another_protocol_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="is not the address of a BVS camera: bvs://HOST"):
        CameraUnderTest(ConformanceOptions(url="insight://127.0.0.1"))


# ---------------------------------------------------------------------- odd cameras


@at_any_pace
def test_judge_what_is_no_camera_shows_the_bytes() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:

        def talk() -> None:
            for _ in range(2):
                with server.accept()[0] as peer:
                    peer.sendall(b"220 ready\r\n")
                    peer.recv(100)

        thread = threading.Thread(target=talk)
        thread.start()
        url = f"bvs://127.0.0.1:{server.getsockname()[1]}?dialect=handbook"
        report = judge(short_options(url), ["connect-is-answered"])
        thread.join()
    assert report["connect-is-answered"].observed == (
        "no frame of handbook begins with 32 32 30 20 72 65 61 64 79 0d 0a: expected 50 53 56 42"
    )


@pytest.mark.parametrize(
    ("options", "outcome", "text"),
    [
        (
            {"application": OTHER, "other_application": APPLICATION},
            CheckOutcome.AS_DOCUMENTED,
            " s",
        ),
        (
            {"other_application": APPLICATION},
            CheckOutcome.NOT_OBSERVED,
            "application 5 is the active one: name another application",
        ),
        (
            {"other_application": None},
            CheckOutcome.NOT_OBSERVED,
            "no other application was named: --camera-other-application",
        ),
        ({"application": 99, "timeout": 0.4}, CheckOutcome.AS_DOCUMENTED, " s"),
    ],
)
@at_any_pace
def test_judge_switch_needs_another_application(
    thread: LoopThread, options: dict[str, Any], outcome: CheckOutcome, text: str
) -> None:
    with emulated(thread, running=True) as emulator:
        report = judge(short_options(emulator.url, **options), ["switch-loads-the-application"])
        assert emulator.device.active_application == APPLICATION
        assert emulator.device.running
    finding = report["switch-loads-the-application"]
    assert finding.outcome is outcome
    assert finding.text.endswith(text)


@at_any_pace
def test_judge_application_that_is_not_there_is_reported(thread: LoopThread) -> None:
    with emulated(thread) as emulator:
        report = judge(short_options(emulator.url, application=99), ["trigger-gives-one-result"])
    assert report["trigger-gives-one-result"].text.startswith(
        "the camera does not load application 99: SwitchAnswer(code=1, application=5): "
    )
