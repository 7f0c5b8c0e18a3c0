"""The life cycle: its states and transitions, its services, and their effect on a camera."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smartcam
from smartcam.exceptions import CommandRejectedError, RosError, SmartCamError
from smartcam.ros2._node.lifecycle import FIRST_INTERNAL_ID, STATES, TRANSITIONS, Lifecycle
from tests.ros2.nodekit import COUNTER, OTHER, TYPES, NotedNode, away, box, seen, until

WAYS = {
    "unconfigured": [],
    "inactive": ["configure"],
    "active": ["configure", "activate"],
    "finalized": ["shutdown"],
}
"""Transitions that lead to each state."""

GOALS = {
    ("unconfigured", "configure"): "inactive",
    ("unconfigured", "shutdown"): "finalized",
    ("inactive", "cleanup"): "unconfigured",
    ("inactive", "activate"): "active",
    ("inactive", "shutdown"): "finalized",
    ("active", "deactivate"): "inactive",
    ("active", "shutdown"): "finalized",
}
"""Of all transitions that can be asked for, as the design article has them."""

STEMS = {
    "configuring": "CONFIGURE",
    "cleaningup": "CLEANUP",
    "activating": "ACTIVATE",
    "deactivating": "DEACTIVATE",
    "shuttingdown": "SHUTDOWN",
    "errorprocessing": "ERROR",
}
"""Names of lifecycle_msgs for the transitions behind these states."""

LABELS = ["configure", "cleanup", "activate", "deactivate", "shutdown", "create", "destroy"]
LABELS += ["transition_success", "transition_failure", "transition_error", "Configure", "x" * 99]


async def _in_state(state: str, work: Any = None, timeout: float = 5.0) -> Lifecycle:
    life = Lifecycle("/cam3", work or {}, timeout)
    for label in WAYS[state]:
        await life.change(label)
    assert life.state.label == state
    return life


# ---------------------------------------------------------------------- the states


def test_ids_are_those_of_lifecycle_msgs() -> None:
    states = TYPES.message("lifecycle_msgs/msg/State").new()
    for state in STATES:
        kind = "PRIMARY" if state.id < FIRST_INTERNAL_ID else "TRANSITION"
        assert getattr(states, f"{kind}_STATE_{state.label.upper()}") == state.id
    transitions = TYPES.message("lifecycle_msgs/msg/Transition").new()
    for one in TRANSITIONS:
        name = one.label.removeprefix("transition_").upper()
        if one.id >= FIRST_INTERNAL_ID:
            name = f"ON_{STEMS[one.start.label]}_{name}"
        elif name == "SHUTDOWN":
            name = f"{one.start.label.upper()}_SHUTDOWN"
        assert getattr(transitions, f"TRANSITION_{name}") == one.id
    assert len({one.id for one in TRANSITIONS}) == len(TRANSITIONS) == 25


@pytest.mark.parametrize("label", LABELS)
@pytest.mark.parametrize("state", WAYS)
async def test_a_transition_leads_where_it_should_or_is_refused(state: str, label: str) -> None:
    life = await _in_state(state)
    steps: list[str] = []
    life.listen(lambda one: steps.append(one.goal.label))
    goal = GOALS.get((state, label))
    if goal is None:
        with pytest.raises(RosError, match=rf"{label[:40]}.*it is {state}"):
            await life.change(label)
        assert (life.state.label, steps) == (state, [])
        return
    await life.change(label)
    assert life.state.label == goal
    assert len(steps) == 2
    assert steps[1] == goal
    assert life.active == (goal == "active")


async def test_ids_ask_for_the_same_as_labels() -> None:
    for state, number in itertools.product(WAYS, range(100)):
        life = await _in_state(state)
        own = [one for one in TRANSITIONS if one.id == number and one.start.label == state]
        goal = GOALS.get((state, own[0].label)) if own else None
        if goal is None:
            with pytest.raises(RosError, match=f"transition {number}: it is {state}"):
                await life.change(number=number)
        else:
            await life.change(number=number)
        assert life.state.label == (goal or state)


async def test_a_label_counts_before_an_id() -> None:
    life = await _in_state("inactive")
    await life.change("activate", 2)
    assert life.active
    with pytest.raises(RosError, match="cleanup"):
        await life.change("cleanup", 4)
    assert life.active


@pytest.mark.parametrize(
    ("error", "back", "steps"),
    [
        (SmartCamError("away"), "unconfigured", ["configuring", "unconfigured"]),
        (ValueError("odd"), "unconfigured", ["configuring", "errorprocessing", "unconfigured"]),
    ],
)
async def test_a_transition_that_fails_leads_back(
    error: Exception, back: str, steps: list[str]
) -> None:
    async def fail() -> None:
        raise error

    life = Lifecycle("/cam3", {"configure": fail}, 5.0)
    told: list[str] = []
    life.listen(lambda one: told.append(one.goal.label))
    with pytest.raises(SmartCamError, match=str(error)):
        await life.configure()
    assert (life.state.label, told) == (back, steps)


async def test_a_transition_has_an_end() -> None:
    life = Lifecycle("/cam3", {"configure": asyncio.Event().wait}, 5.0)  # type: ignore[dict-item]
    begun = asyncio.get_running_loop().time()
    with pytest.raises(smartcam.ResponseTimeoutError, match="configure: it took more than 5 s"):
        await life.configure()
    assert asyncio.get_running_loop().time() - begun == pytest.approx(5.0, abs=0.01)
    assert life.state.label == "unconfigured"


async def test_one_transition_at_a_time() -> None:
    gate, running = asyncio.Event(), 0

    async def work() -> None:
        nonlocal running
        running += 1
        assert running == 1
        await gate.wait()
        running -= 1

    life = Lifecycle("/cam3", {"configure": work, "cleanup": work}, 5.0)
    tasks = [asyncio.create_task(life.change("configure")) for _ in range(3)]
    cleanup = asyncio.create_task(life.change("cleanup"))
    await asyncio.sleep(1.0)
    assert life.state.label == "configuring"
    gate.set()
    outcomes = await asyncio.gather(*tasks, cleanup, return_exceptions=True)
    assert outcomes[0] is None
    assert all(isinstance(one, RosError) for one in outcomes[1:3])
    assert outcomes[3] is None
    assert life.state.label == "unconfigured"


@pytest.mark.parametrize("state", WAYS)
async def test_what_is_so_already_is_no_transition(state: str) -> None:
    """The methods say what is to be had, where services say what is to be done."""
    had = {
        "unconfigured": {"cleanup", "deactivate"},
        "inactive": {"configure", "deactivate"},
        "active": {"configure", "activate"},
        "finalized": {"shutdown"},
    }
    for label in LABELS[:5]:
        life = await _in_state(state)
        steps: list[Any] = []
        life.listen(steps.append)
        method = getattr(life, label)
        if label in had[state]:
            await method()
            assert (life.state.label, steps) == (state, [])
        elif (state, label) in GOALS:
            await method()
            assert life.state.label == GOALS[state, label]
        else:
            with pytest.raises(RosError, match=label):
                await method()


async def test_who_asks_while_it_starts_by_itself_waits_for_it() -> None:
    async with away(8, autostart=True) as one:
        await until(lambda: one.state == "configuring" or one.camera.connected)
        await one.seen.lifecycle.configure()
        await one.seen.lifecycle.activate()
        assert one.state == "active"


async def test_who_gives_up_does_not_end_a_transition() -> None:
    gate = asyncio.Event()
    life = Lifecycle("/cam3", {"configure": gate.wait}, 5.0)  # type: ignore[dict-item]
    asking = asyncio.create_task(life.configure())
    await asyncio.sleep(0.1)
    asking.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asking
    assert life.state.label == "configuring"
    gate.set()
    await life.wait_for_transition()
    assert life.state.label == "inactive"


async def test_closing_gives_up_what_is_under_way() -> None:
    life = Lifecycle("/cam3", {"configure": asyncio.Event().wait}, 5.0)  # type: ignore[dict-item]
    told: list[str] = []
    life.listen(lambda one: told.append(one.goal.label))
    asking = asyncio.create_task(life.configure())
    waiting = asyncio.create_task(life.shutdown())
    await asyncio.sleep(0.1)
    await life.close()
    await life.close()
    assert told == ["configuring", "unconfigured", "shuttingdown", "finalized"]
    with pytest.raises(asyncio.CancelledError):
        await asking
    with pytest.raises(RosError, match="it is closed"):
        await waiting


async def test_who_is_told_may_fail_and_may_leave(caplog: pytest.LogCaptureFixture) -> None:
    life = Lifecycle("/cam3", {}, 5.0)
    told: list[str] = []

    def fail(_: object) -> None:
        raise ValueError("mine")

    life.listen(fail)
    leave = life.listen(lambda one: told.append(one.goal.label))
    await life.configure()
    leave()
    leave()
    await life.activate()
    assert told == ["configuring", "inactive"]
    assert "mine" in caplog.text
    assert life.active


@given(
    st.lists(
        st.tuples(
            st.sampled_from(LABELS[:5]),
            st.sampled_from([0.0, 0.5, 1.5]),  # when it is asked for, after the one before
            st.sampled_from([None, 0.2, 1.2]),  # when who asks gives up
            st.sampled_from(["done", "refused", "broken", "endless"]),
        ),
        max_size=8,
    )
)
async def test_whatever_is_asked_for_it_goes_step_by_step(asked: list[Any]) -> None:
    outcomes = iter([one[3] for one in asked])
    running = 0

    async def work() -> None:
        nonlocal running
        assert running == 0
        running = 1
        try:
            outcome = next(outcomes)
            await asyncio.sleep(100 if outcome == "endless" else 1.0)
            if outcome == "refused":
                raise SmartCamError("no")
            if outcome == "broken":
                raise ValueError("odd")
        finally:
            running = 0

    life = Lifecycle("/cam3", dict.fromkeys(LABELS[:5], work), 3.0)
    steps: list[Any] = []
    life.listen(steps.append)
    tasks = []
    for label, pause, patience, _ in asked:
        await asyncio.sleep(pause)
        task = asyncio.create_task(life.change(label))
        if patience is not None:
            asyncio.get_running_loop().call_later(patience, task.cancel)
        tasks.append(task)
    await asyncio.gather(*tasks, return_exceptions=True)
    await life.wait_for_transition()
    assert life.state.id < FIRST_INTERNAL_ID
    assert all(before.goal is after.start for before, after in itertools.pairwise(steps))
    assert set(steps) <= set(TRANSITIONS)
    assert life.state is (steps[-1].goal if steps else STATES[1])
    await life.close()
    assert life.state.label == "finalized"


# ---------------------------------------------------------------------- of a camera


async def test_services_tell_the_states_and_the_ways_between_them() -> None:
    async with seen(autostart=False) as one:
        call = one.node.services
        state = (await call["~/get_state"].call()).current_state
        assert (state.id, state.label) == (1, "unconfigured")
        states = (await call["~/get_available_states"].call()).available_states
        assert [(each.id, each.label) for each in states] == list(STATES)
        graph = (await call["~/get_transition_graph"].call()).available_transitions
        assert [each.transition.id for each in graph] == [each.id for each in TRANSITIONS]
        ways = (await call["~/get_available_transitions"].call()).available_transitions
        assert [(each.transition.id, each.transition.label) for each in ways] == [
            (1, "configure"),
            (5, "shutdown"),
        ]
        assert await one.node.change("configure")
        assert await one.node.change(number=3)
        assert not await one.node.change("configure")
        assert one.seen.lifecycle.active
        assert one.node.steps() == [
            ("unconfigured", "configuring"),
            ("configuring", "inactive"),
            ("inactive", "activating"),
            ("activating", "active"),
        ]
        event = one.node.last("~/transition_event")
        assert (event.transition.id, event.transition.label) == (30, "transition_success")
        assert event.timestamp > 0


async def test_it_becomes_active_by_itself() -> None:
    async with seen() as one:
        await until(lambda: one.seen.lifecycle.active)
        assert one.node.steps()[-1] == ("activating", "active")
        assert await one.node.change("deactivate")
        await asyncio.sleep(30)
        assert one.state == "inactive"  # it is somebody's wish


async def test_it_waits_for_a_camera_that_is_away() -> None:
    async with away(100) as one:
        await asyncio.sleep(90)
        assert one.node.steps() == []  # it asks for nothing in vain
        await until(lambda: one.seen.lifecycle.active)
        assert len(one.node.steps()) == 4


async def test_who_takes_over_has_it() -> None:
    """The automatic start ends as soon as somebody asks for something."""
    async with away(20) as one:
        assert one.state == "unconfigured"
        begun = asyncio.get_running_loop().time()
        assert not await one.node.change("configure")
        assert asyncio.get_running_loop().time() - begun == pytest.approx(2.0, abs=0.1)
        await one.camera.wait_connected(60)
        await asyncio.sleep(30)
        assert one.state == "unconfigured"


async def test_configure_has_the_application_running_and_ready() -> None:
    async with seen(box(running=False), application=OTHER, autostart=False) as one:
        assert one.camera.active_application == COUNTER
        await one.seen.lifecycle.configure()
        assert one.camera.active_application == OTHER
        assert smartcam.Status.RUNNING in one.camera.status
        sent = one.camera.statistics().frames_sent
        await one.seen.lifecycle.cleanup()
        await one.seen.lifecycle.configure()
        assert one.camera.statistics().frames_sent - sent <= 2  # nothing is switched again


async def test_an_application_that_is_refused_is_not_tried_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Each try would stop a camera that others use."""
    async with seen(application=99) as one:
        await asyncio.sleep(60)
        assert one.node.steps() == [
            ("unconfigured", "configuring"),
            ("configuring", "unconfigured"),
        ]
        assert "refused to switch to application 99" in caplog.text
        assert not await one.node.change("configure")
        with pytest.raises(CommandRejectedError):
            await one.seen.lifecycle.configure()


async def test_a_camera_that_stays_busy_fails_in_time() -> None:
    async with seen(application=OTHER, autostart=False, client={"switch_timeout": 3.0}) as one:
        one.box.inject({"kind": "busy_for_ever"})
        with pytest.raises(smartcam.ResponseTimeoutError):
            await one.seen.lifecycle.configure()
        assert one.state == "unconfigured"


async def test_a_camera_that_is_lost_leaves_it_active() -> None:
    async with seen() as one:
        await until(lambda: one.seen.lifecycle.active)
        one.box.inject({"kind": "reset"})
        await until(lambda: one.camera.statistics().reconnects == 1)
        assert one.seen.lifecycle.active
        for label in ("deactivate", "cleanup", "shutdown"):
            assert await one.node.change(label)
        assert one.camera.connected  # the camera is its owner's
        assert one.state == "finalized"


async def test_a_node_of_ros_1_has_a_life_cycle_without_services() -> None:
    async with seen(node=NotedNode(ros1=True)) as one:
        await until(lambda: one.seen.lifecycle.active)
        assert not [name for name in one.node.services if name.endswith("_state")]
        assert "~/transition_event" not in one.node.topics
        await one.seen.lifecycle.deactivate()
        assert one.state == "inactive"
