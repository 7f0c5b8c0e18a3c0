"""Containers of triggers, and those without a trigger."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import pytest

from smartcam.exceptions import ConfigurationError
from smartcam.models import (
    ApplicationChanged,
    CameraEvent,
    Connected,
    Disconnected,
    Reconnected,
    Result,
    Status,
    StatusChanged,
)
from smartcam.observers import TraceEntry
from tests.recording.inside import Change, RecordedRun, ReplayPlan, plan_replay
from tests.recording.recordingkit import URL, at, container, frame, session, status, write

WAITS = ("RUNNING", "WAITING_FOR_TRIGGER")


def happened(text: str) -> Iterator[TraceEntry]:
    """Read ``1 > Trigger, 1.5 RUNNING, 2 'a'``: after which second a frame, status or container."""
    for one in text.split(", "):
        seconds, what = one.split(" ", 1)
        if what.startswith(">"):
            yield frame(float(seconds), what)
        elif what.startswith("'"):
            yield container(float(seconds), what.strip("'").encode())
        else:
            yield status(float(seconds), *what.replace("WAITS", " ".join(WAITS)).split())


def plan(
    path: Path, *items: TraceEntry | CameraEvent | str, first: tuple[str, ...] = WAITS
) -> ReplayPlan:
    """Return the plan of a session that begins at 0 s and has these items, or what texts say."""
    read = [happened(one) if isinstance(one, str) else [one] for one in items]
    return plan_replay(write(path / "run.mcap", [*session(URL, *first), *chain(*read)]))


def rounded(takes: list[RecordedRun]) -> list[tuple[list[bytes], float, float, int]]:
    return [
        (take.containers, round(take.seconds, 6), round(take.pause, 6), take.drops)
        for take in takes
    ]


def test_plan_trigger_has_its_container_and_latency(tmp_path: Path) -> None:
    made = plan(tmp_path, "1 > Trigger, 1 RUNNING, 1.25 'a', 1.25 WAITS, 2 > Trigger, 2.5 'b'")
    app = made.applications[5]
    assert rounded(app.triggered) == [([b"a"], 0.25, 0, 0), ([b"b"], 0.5, 0, 0)]
    assert (app.untriggered, app.waits) == ([], True)
    assert (made.active, made.running, made.dialect, made.transport) == (5, True, "handbook", "tcp")
    assert round(made.seconds, 6) == 2.5


def test_plan_from_a_time_on_has_what_came_then_also_where_the_clock_was_set_back(
    tmp_path: Path,
) -> None:
    items = happened("1 'a', 5 'b', 3 'c', 6 'd'")
    recording = write(tmp_path / "run.mcap", [*session(URL, "RUNNING"), *items])
    made = plan_replay(dataclasses.replace(recording, since=at(4)))
    taken = [take.containers for take in made.applications[5].untriggered]
    assert taken == [[b"b"], [b"d"]]


def test_plan_more_containers_of_one_trigger_stay_together(tmp_path: Path) -> None:
    made = plan(tmp_path, "1 > Trigger, 1 RUNNING, 1.1 'a', 1.2 'b', 1.2 WAITS")
    assert rounded(made.applications[5].triggered) == [([b"a", b"b"], 0.1, 0, 0)]


def test_plan_late_container_belongs_to_its_trigger(tmp_path: Path) -> None:
    made = plan(tmp_path, "1 > Trigger, 7 'late', 8 > Trigger, 8.1 'b'")
    assert rounded(made.applications[5].triggered) == [([b"late"], 6, 0, 0), ([b"b"], 0.1, 0, 0)]


@pytest.mark.parametrize(
    "end", [frame(3, "> Stop"), status(3, "BUSY"), status(3, "SYSTEM_ERROR", "RUNNING")]
)
def test_plan_trigger_whose_inspection_is_void_has_no_result(
    tmp_path: Path, end: TraceEntry
) -> None:
    made = plan(tmp_path, frame(1, "> Trigger"), end)
    assert rounded(made.applications[5].triggered) == [([], 2, 0, 0)]


@pytest.mark.parametrize("following", [frame(3, "> Trigger"), frame(3, "> Stop")])
def test_plan_trigger_that_gave_nothing_lasts_until_the_camera_waits(
    tmp_path: Path, following: TraceEntry
) -> None:
    made = plan(tmp_path, "1 > Trigger, 1 RUNNING, 1.25 WAITS", following, "4 > Trigger, 4.5 'b'")
    takes = rounded(made.applications[5].triggered)
    assert (takes[0], takes[-1]) == (([], 0.25, 0, 0), ([b"b"], 0.5, 0, 0))


def test_plan_trigger_under_way_at_the_end_is_left_out(tmp_path: Path) -> None:
    assert plan(tmp_path, frame(1, "> Trigger")).applications[5].triggered == []


def test_plan_trigger_of_a_lost_link_is_left_out(tmp_path: Path) -> None:
    made = plan(
        tmp_path,
        frame(1, "> Trigger"),
        Disconnected(camera="left", at=at(1), reason="gone", expected=False),
        frame(2, "> Connect"),
        frame(2, "< ConnectAnswer"),
        Reconnected(camera="left", at=at(2), url=URL),
        "3 > Trigger, 3.5 'b'",
    )
    assert rounded(made.applications[5].triggered) == [([b"b"], 0.5, 0, 0)]


def test_plan_dropped_trigger_is_noted_before_the_next(tmp_path: Path) -> None:
    made = plan(tmp_path, "1 > Trigger, 1 WAITS OVERTRIGGERED, 1.1 WAITS, 2 > Trigger, 2.5 'a'")
    assert rounded(made.applications[5].triggered) == [([b"a"], 0.5, 0, 1)]


def test_plan_trigger_dropped_by_the_one_before_needs_no_help(tmp_path: Path) -> None:
    made = plan(
        tmp_path, "1 > Trigger, 1 RUNNING, 1.1 > Trigger, 1.1 RUNNING OVERTRIGGERED, 1.5 'a'"
    )
    assert rounded(made.applications[5].triggered) == [([b"a"], 0.5, 0, 0)]


def test_plan_sensor_result_counts_from_the_one_before(tmp_path: Path) -> None:
    made = plan(tmp_path, "1 RUNNING, 1.25 'a', 1.25 WAITS, 3 'b'")  # no status showed the last
    app = made.applications[5]
    assert (app.triggered, app.waits) == ([], True)
    assert rounded(app.untriggered) == [([b"a"], 0.25, 1, 0), ([b"b"], 0, 1.75, 0)]


def test_plan_trigger_dropped_by_a_sensor_leaves_the_container_to_it(tmp_path: Path) -> None:
    made = plan(tmp_path, "1 > Trigger, 1 RUNNING, 1 RUNNING OVERTRIGGERED, 1.5 'sensor'")
    app = made.applications[5]
    assert app.triggered == []
    assert rounded(app.untriggered) == [([b"sensor"], 0.5, 1, 0)]


def test_plan_free_run_counts_from_its_start_and_ignores_triggers(tmp_path: Path) -> None:
    made = plan(tmp_path, "1 > Start, 2 RUNNING, 2 > Trigger, 2.5 'a', 3.5 'b'", first=())
    app = made.applications[5]
    assert (app.triggered, app.waits) == ([], False)
    assert rounded(app.untriggered) == [([b"a"], 0, 0.5, 0), ([b"b"], 0, 1, 0)]


def test_plan_switch_has_its_time_and_each_application_its_list(tmp_path: Path) -> None:
    made = plan(
        tmp_path,
        frame(1, "> SwitchApplication", application=7),
        "1 BUSY, 1.4 WAITS",
        frame(1.5, "< SwitchAnswer", code=0, application=7),
        frame(2, "> SwitchApplication", application=8),
        frame(2.1, "< SwitchAnswer", code=1, application=7),  # refused
        frame(3, "> Trigger"),
        container(3.5, b"a", application=7),
    )
    assert list(made.applications) == [5, 7]
    assert made.applications[7].load_time == pytest.approx(0.5)
    assert made.applications[5].load_time is None
    assert made.active == 7


def test_plan_conditions_come_with_their_times(tmp_path: Path) -> None:
    changes = "1 WAITS, 2 WAITS SYSTEM_ERROR, 3 WAITS OVERHEAT"
    made = plan(tmp_path, changes, first=(*WAITS, "OVERHEAT"))
    assert made.conditions == Status.OVERHEAT
    assert made.changes == (
        Change(1, Status.OVERHEAT, on=False),
        Change(2, Status.SYSTEM_ERROR, on=True),
        Change(3, Status.OVERHEAT, on=True),
        Change(3, Status.SYSTEM_ERROR, on=False),
    )


def test_plan_without_a_container_is_as_the_camera_was(tmp_path: Path) -> None:
    stopped = plan_replay(write(tmp_path / "a.mcap", session(URL, endian=1)))
    running = plan_replay(write(tmp_path / "b.mcap", session(URL, "RUNNING")))
    assert (stopped.active, stopped.running, stopped.endian) == (5, False, 1)
    assert (running.active, running.running, running.endian) == (5, True, 0)


def test_plan_url_tells_dialect_quirks_and_transport(tmp_path: Path) -> None:
    url = "bvs+udp://192.168.0.10:36701?dialect=b16&quirks=code,no_id"
    nameless = frame(1.5, "< ResultContainer", application=-1, data="61")
    items = [*session(url, *WAITS), frame(1, "> Trigger"), nameless]
    made = plan_replay(write(tmp_path / "run.mcap", items))
    assert (made.dialect, made.quirks, made.transport) == ("b16", ("code", "no_id"), "udp")
    assert rounded(made.applications[5].triggered) == [([b"a"], 0.5, 0, 0)]


def test_plan_application_id_nobody_can_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="application id 0 cannot be emulated in dialect"):
        plan(tmp_path, container(1, b"a", application=0))
    nothing = plan(tmp_path / "..", frame(1, "< QueryAnswer", application=0))
    assert list(nothing.applications) == [5]


@pytest.mark.parametrize(
    ("items", "text"),
    [
        ([frame(0, "> Connect")], "there was no session with camera 'left'"),
        (
            [*session(), frame(1, "< ResultContainer", application=5)],
            "wrong fields of a ResultContainer: {'application': 5}",
        ),
        (
            [Connected(camera="left", at=at(0), url="bvs://h:1?dialect=new")],
            "bvs has no dialect 'new'",
        ),
        (
            [Connected(camera="left", at=at(0), url="insight://h:23?dialect=native")],
            "camera 'left' speaks insight, not bvs; use smartcam.recording.replay..",
        ),
        ([Connected(camera="left", at=at(0), url=URL)], "it has no answer of camera 'left'"),
    ],
)
def test_plan_camera_that_cannot_be_emulated_is_refused(
    tmp_path: Path, items: list[Any], text: str
) -> None:
    with pytest.raises(ConfigurationError, match=text):
        plan_replay(write(tmp_path / "run.mcap", items))


# ---------------------------------------------------------------------- without frames

FLEET = "fleet://plant-server:7447/left"
RUNS = Status.RUNNING | Status.WAITING_FOR_TRIGGER


def shared(seconds: float, data: bytes, latency: float | None = None, ago: float = 0.0) -> Result:
    """Return a result of application 5; ``ago``: how long before it that its trigger was sent."""
    trigger = None if latency is None else at(seconds - (ago or latency))
    return Result("left", 5, None, 1, trigger, at(seconds), latency, data, None)


def met(status: Status = RUNS) -> list[CameraEvent | Result]:
    """Return what a program is told first, at 0 s of its own clock."""
    return [
        Connected(camera="left", at=at(0), url=FLEET),
        ApplicationChanged(camera="left", at=at(0), application=5, previous=None),
        StatusChanged(camera="left", at=at(0), status=status, previous=None),
    ]


def changed(seconds: float, status: Status) -> StatusChanged:
    return StatusChanged(camera="left", at=at(seconds), status=status, previous=None)


@pytest.mark.parametrize("ahead", [0.0, 3600.0, -3600.0])
def test_plan_of_a_fleets_camera_has_its_results_whatever_the_agents_clock_says(
    tmp_path: Path, ahead: float
) -> None:
    items = [
        *met(),
        changed(1.01, Status.RUNNING),
        shared(1.5 + ahead, b"a", 0.5),
        shared(1.6 + ahead, b"b", 0.6, 0.6),  # of the same trigger
        changed(1.61, RUNS | Status.OVERHEAT),
        shared(3.0 + ahead, b"c"),
        shared(4.25 + ahead, b"d", 0.25),
        Disconnected(camera="left", at=at(5), reason="closed", expected=True),
    ]
    made = plan_replay(write(tmp_path / "run.mcap", items, dialect="b16", endian=1))
    app = made.applications[5]
    assert rounded(app.triggered) == [([b"a", b"b"], 0.5, 0, 0), ([b"d"], 0.25, 0, 0)]
    assert [take.containers for take in app.untriggered] == [[b"c"]]
    assert app.untriggered[0].pause == pytest.approx(3.0, abs=0.05)
    assert (made.active, made.running, made.endian) == (5, True, 1)
    assert (made.dialect, made.transport) == ("b16", "tcp")
    assert [(one.condition, one.on) for one in made.changes] == [(Status.OVERHEAT, True)]
    assert made.changes[0].at == pytest.approx(1.61, abs=0.05)


def test_plan_of_a_fleets_free_run_counts_from_the_one_before(tmp_path: Path) -> None:
    items = [*met(Status.RUNNING), shared(-0.001, b"a"), shared(0.1, b"b"), shared(0.3, b"c")]
    app = plan_replay(write(tmp_path / "run.mcap", items)).applications[5]
    assert not app.waits
    gaps = [take.pause for take in app.untriggered]
    assert gaps == pytest.approx([0.0, 0.101, 0.2], abs=1e-6)


@pytest.mark.parametrize(
    ("facts", "text"),
    [
        ({"dialect": "native"}, "of a fleet speaks dialect native"),
        ({"endian": 2}, "endian: expected 0 or 1, got 2"),
    ],
)
def test_plan_of_a_fleets_camera_that_cannot_be_played_is_refused(
    tmp_path: Path, facts: dict[str, Any], text: str
) -> None:
    recording = write(tmp_path / "run.mcap", [*met(), shared(1, b"a")], **facts)
    with pytest.raises(ConfigurationError, match=text):
        plan_replay(recording)


def test_plan_unasked_under_a_constant_waiting_are_each_for_itself(tmp_path: Path) -> None:
    """The status says nothing of them: 20,000 of them are no single inspection of that many."""
    items = [container(1 + place / 1000, place.to_bytes(4, "little")) for place in range(200)]
    app = plan(tmp_path, *items).applications[5]
    assert [take.containers for take in app.untriggered] == [
        [place.to_bytes(4, "little")] for place in range(200)
    ]
    assert {round(take.pause, 6) for take in app.untriggered[1:]} == {0.001}
    assert (app.triggered, app.waits) == ([], True)


def test_plan_unasked_behind_a_trigger_under_a_constant_waiting(tmp_path: Path) -> None:
    made = plan(tmp_path, "1 > Trigger, 1.2 'a', 1.25 'b', 2 'c', 3 'd', 4 > Trigger, 4.1 'e'")
    app = made.applications[5]
    assert [take.containers for take in app.triggered] == [[b"a", b"b"], [b"e"]]
    assert [take.containers for take in app.untriggered] == [[b"c"], [b"d"]]
