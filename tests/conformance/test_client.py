"""Judging clients: good ones pass every check, and each check has a bad one that fails it."""

from __future__ import annotations

import asyncio
import itertools
import shutil
from pathlib import Path

import pytest

import smartcam
from smartcam.conformance._dialects import EVERY_DIALECT
from smartcam.conformance.client import CHECKS, Task
from smartcam.conformance.client._checks import Grade
from smartcam.conformance.client._report import ClientFinding, judge
from tests.client.clientkit import ask_again_after
from tests.conformance.inside import (
    SCENES,
    Client,
    ClientRun,
    CommandClient,
    FunctionClient,
    run_scene,
)
from tests.conformance.pace import at_any_pace, is_first, slowed
from tests.conformance.plain_client import plain_client

pytestmark = [pytest.mark.long, pytest.mark.real_time]

HERE = Path(__file__).parent
AT_ONCE = 24
"""Tasks that are done side by side: most of them wait for something that never comes."""

BY_NAME = {check.name: check for check in CHECKS}


async def findings(
    client: Client, dialect: str = "handbook", transport: str = "tcp", *, room: asyncio.Semaphore
) -> list[str]:
    """Return the findings of all checks."""
    checks = [check for check in CHECKS if check.applies(dialect, transport)]

    async def one(name: str) -> ClientRun:
        async with room:
            return await run_scene(
                client, SCENES[name], dialect=dialect, transport=transport, timeout=slowed(15)
            )

    names = {check.scene.name for check in checks}
    runs = dict(zip(names, await asyncio.gather(*map(one, names)), strict=True))
    found = [judge(check, runs[check.scene.name]) for check in checks]
    return [str(finding) for finding in found if finding is not None]


# ---------------------------------------------------------------------- good clients


async def ours(task: Task) -> list[bytes]:
    """Do a task with smartcam's own client."""
    camera = smartcam.connect(
        task.url,
        application=task.number if task.verb == "switch" else None,
        connect_timeout=slowed(2.0),
        switch_timeout=slowed(3.0),
        close_timeout=slowed(0.2),
        reconnect=None,
    )
    stream = camera.results()
    async with camera:
        if task.verb == "watch":
            return [(await anext(stream)).raw for _ in range(task.number or 1)]
        count = task.number if task.verb == "trigger" and task.number else 1
        return [(await camera.trigger(timeout=slowed(2.0))).raw for _ in range(count)]


KINDS = [*itertools.product(EVERY_DIALECT, ("tcp", "udp"))]


@at_any_pace
async def test_checks_of_our_own_client_find_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    ask_again_after(monkeypatch, slowed(0.5))  # what seems lost
    room, client = asyncio.Semaphore(AT_ONCE), FunctionClient(ours)
    found = await asyncio.gather(*(findings(client, *kind, room=room) for kind in KINDS))
    assert dict(zip(KINDS, found, strict=True)) == {kind: [] for kind in KINDS}


@at_any_pace
async def test_checks_of_a_plain_client_find_nothing() -> None:
    client = FunctionClient(plain_client(seconds=slowed(1)))
    assert await findings(client, room=asyncio.Semaphore(AT_ONCE)) == []


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js")
@at_any_pace
async def test_checks_of_a_client_in_another_language_find_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CLIENT_SECONDS", str(slowed(1.5)))
    client = CommandClient(f"node {HERE / 'client.mjs'} {{host}} {{port}} {{task}}")
    assert await findings(client, room=asyncio.Semaphore(AT_ONCE)) == []


# ---------------------------------------------------------------------- bad ones

HANGS = "it was still under way after "
SINS: dict[str, tuple[str, str]] = {
    "triggers": ("id too", "is 12 bytes long; expected 8"),
    "triggers_three_times": ("one for all", "is of the same inspection as the one before"),
    "sends_whole_messages": ("unknown request", "the camera ignores 50 53 56 42"),
    "sends_whole_messages_in_a_switch": ("unknown request", "no such message"),
    "connects_first": ("query first", "Query came before Connect was answered"),
    "disconnects": ("no disconnect", "its last word was Trigger"),
    "triggers_as_often_as_told": ("triggers twice", "it sent 2 triggers, 3 were asked for"),
    "asks_one_at_a_time": ("two queries", "Query came although the one before was not answered"),
    "watches": ("watches too little", "all is well, and gave 0 of 5 results"),
    "watches_without_triggers": ("triggers", "it sent 1 triggers"),
    "switches": ("does not switch", "is of application 21, not of 3"),
    "stops_before_a_switch": ("switches in run mode", "SwitchApplication came while the"),
    "waits_for_the_switch": ("starts at once", "Start came 0.0"),
    "waits_for_a_late_switch_answer": ("starts at once", "before its answer"),
    "switches_with_a_late_answer": ("next is the answer", "it failed: TaskError: 0x12 came"),
    "waits_until_busy_falls": ("ignores busy", "s after BUSY was sent"),
    "switches_with_busy_after_it": ("ignores busy", "it failed: TimeoutError"),
    "reports_refused_switch": ("believes", "all is well, and gave 1 result"),
    "reads_byte_by_byte": ("a message is what comes", "it failed: IndexError"),
    "reads_several_at_once": ("a message is what comes", "it failed: "),
    "passes_over_unknown_messages": ("knows all", "it failed: TaskError: message 0x77"),
    "passes_over_unknown_status_bits": ("knows all", "it failed: TaskError: status 0x2c0"),
    "takes_no_status_for_an_answer": ("next is the answer", "0x12 came, 0x30 was expected"),
    "takes_no_other_applications_result": ("any application", "is of application 99, not of 21"),
    "takes_no_earlier_result": ("does not wait, looks away", "under way before the client's"),
    "triggers_when_the_camera_waits": ("does not wait", "Trigger came when the status was"),
    "takes_no_result_twice": ("does not wait, looks away", "of the same inspection as"),
    "fails_where_triggers_are_dropped": ("waits for ever", HANGS),
    "fails_without_a_result": ("all is well", "all is well, and gave 0 results"),
    "fails_where_busy_never_falls": ("waits for ever", HANGS),
    "ends_where_the_camera_is_stopped": ("waits for ever", HANGS),
    "fails_where_connect_is_not_answered": ("waits for ever", HANGS),
    "ends_where_query_is_not_answered": ("waits for ever", HANGS),
    "fails_where_nothing_listens": ("all is well", "all is well, and gave 0 results"),
    "fails_where_the_camera_closes": ("all is well", "all is well, and gave 0 results"),
    "fails_where_the_camera_resets": ("all is well", "all is well, and gave 0 results"),
    "fails_where_the_camera_is_gone": ("waits for ever", HANGS),
    "reports_cut_result": ("all is well", "all is well, and gave 0 results"),
    "fails_where_garbage_comes": ("waits for ever", HANGS),
    "reports_impossible_length": ("waits for ever", HANGS),
}
"""For each check a client that fails it: its sin, and the text of the finding."""


class Convictions:
    """Findings of checks in their bad clients: of all together, at a slower pace of each."""

    def __init__(self) -> None:
        self._found = asyncio.run(self._find(*SINS))

    def __getitem__(self, name: str) -> ClientFinding | None:
        found = self._found if is_first() else asyncio.run(self._find(name))
        return found[name]

    async def _find(self, *names: str) -> dict[str, ClientFinding | None]:
        room = asyncio.Semaphore(AT_ONCE)

        async def one(name: str) -> ClientRun:
            client = FunctionClient(plain_client(*SINS[name][0].split(", "), seconds=slowed(1)))
            timeout = 1.0 if SINS[name][1] == HANGS else 15.0
            async with room:
                return await run_scene(client, BY_NAME[name].scene, timeout=slowed(timeout))

        runs = await asyncio.gather(*map(one, names))
        return {name: judge(BY_NAME[name], run) for name, run in zip(names, runs, strict=True)}


@pytest.fixture(scope="module")
def convictions() -> Convictions:
    return Convictions()


def test_every_check_has_a_client_that_fails_it() -> None:
    assert [*SINS] == [check.name for check in CHECKS]


@pytest.mark.parametrize("name", SINS)
@at_any_pace
def test_check_finds_its_sinner(name: str, convictions: Convictions) -> None:
    finding = convictions[name]
    assert finding is not None
    assert SINS[name][1] in finding.wrong
    assert (finding.check, finding.grade) == (name, BY_NAME[name].grade.value)
    assert ClientFinding.from_json(finding.as_json()) == finding


@at_any_pace
def test_finding_shows_the_wire_the_source_and_what_the_client_said(
    convictions: Convictions,
) -> None:
    text = str(convictions["passes_over_unknown_messages"])
    lines = text.splitlines()
    assert lines[0] == (
        "passes_over_unknown_messages (should; handbook, tcp): it failed: TaskError: message 0x77"
    )
    assert lines[1] == ("  task: trigger; camera: messages with an unknown id come in between")
    assert "  source: inferred (docs/sources.md)" in lines
    assert any(line.endswith("> Connect()  50 53 56 42 00 00 00 00 01 00 00 00") for line in lines)
    assert any(" < ?  50 53 56 42 14 00 00 00 77" in line for line in lines)
    assert lines[-2:] == ["  the client said:", "    TaskError: message 0x77"]


def test_source_of_every_check_is_in_the_documents() -> None:
    page = (HERE.parents[1] / "docs" / "sources.md").read_text(encoding="utf-8")
    families = ("SC-A", "SC-B", "SC-C", "MV", "ID-a", "ID-b", "HAL", "KB-")
    for check in CHECKS:
        assert check.source.startswith("inferred") or check.source.startswith(families), check.name
        assert any(word in check.source for word in ("published", "derived", "inferred"))
        for word in check.source.replace(",", " ").replace(":", " ").split():
            if word.startswith(("SC-", "KB-")):
                assert f"| {word} |" in page, word


def test_names_of_checks_are_unique_and_scenes_are_all_used() -> None:
    assert len({check.name for check in CHECKS}) == len(CHECKS)
    assert {check.scene.name for check in CHECKS} == {*SCENES}
    grades = {grade: [one for one in CHECKS if one.grade is grade] for grade in Grade}
    assert all(grades.values())


def test_checks_apply_where_dialect_and_transport_have_their_scene() -> None:
    applying = {
        (dialect, transport): [one.name for one in CHECKS if one.applies(dialect, transport)]
        for dialect, transport in itertools.product(EVERY_DIALECT, ("tcp", "udp"))
    }
    assert len(applying["handbook", "tcp"]) == len(CHECKS)
    assert "reads_byte_by_byte" not in applying["handbook", "udp"]
    assert "stops_before_a_switch" not in applying["bid", "tcp"]
