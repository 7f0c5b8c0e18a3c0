"""Whose result is it: every branch by a table."""

from __future__ import annotations

import itertools
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smartcam
from smartcam import Status
from smartcam._client.correlation import (
    FEWEST_NUMBERS,
    MAX_OWED,
    NUMBER_STEP,
    Correlation,
    Debt,
    Match,
)
from smartcam._client.interpretation import MAX_NUMBER, Interpretation
from smartcam.protocols.messages import ResultContainer
from tests.client.correlation_line import READY, WORKING, Line, ready, shown
from tests.insides import inside

OURS = Match("triggered")
HELD = Match("held")
LATE = Match("late")
STREAMED = Match("streamed")
NOBODY = Match("nobody")
EXTRA = Match("nobody", extra=True)

RAW = Interpretation("raw", lenient=False, y_down=False)


# ---------------------------------------------------------------------- without a number


def test_container_without_a_trigger_is_nobodys() -> None:
    assert Line().result() == NOBODY


@pytest.mark.parametrize("ordered", [True, False])
def test_container_after_a_triggers_inspection_began_is_its_own(*, ordered: bool) -> None:
    line = Line(ordered=ordered)
    line.hear(READY)
    line.trigger()
    line.hear(WORKING)
    assert line.result() == OURS


# ---------------------------------------------------------------------- the fence


@pytest.mark.parametrize("knows", [True, False])
@pytest.mark.parametrize("number", [None, 41])
def test_container_before_the_fence_is_answered_is_older(
    number: int | None, *, knows: bool
) -> None:
    line = shown() if knows else Line()
    line.hear(READY)
    pending = line.send(number)
    line.hear(WORKING)  # somebody else's
    assert line.result(number).fate == "nobody"
    assert (pending.early, pending.progress.begun) == (1, False)
    line.hear(READY)
    line.answer()
    line.hear(WORKING)
    assert line.result(number) == OURS


@pytest.mark.parametrize("ordered", [True, False])
def test_container_behind_the_fence_and_before_waiting_drops_is_older(*, ordered: bool) -> None:
    """Where a status is not told, or may be lost, the fence is all."""
    line = shown(ordered=ordered)
    line.fences = True
    line.hear(READY)
    line.send()
    line.answer()
    assert line.result() == (NOBODY if ordered else OURS)
    line.hear(WORKING)
    assert line.result() == (OURS if ordered else NOBODY)


def test_trigger_without_a_fence_is_reached_at_once() -> None:
    line = Line(ordered=False)
    assert line.send().progress.reached
    assert line.result() == OURS


def test_fence_of_a_trigger_that_is_settled_says_nothing() -> None:
    line = Line()
    pending = line.send()
    line.give_up()
    line.at.settled()
    line.answer()
    assert not pending.progress.reached


def test_waiting_that_dropped_before_the_fence_is_not_this_triggers() -> None:
    line = shown()
    pending = line.send()
    line.hear(WORKING, READY)
    line.answer()
    run = pending.progress
    assert (run.reached, run.begun, run.shown) == (True, False, False)
    line.hear(WORKING)
    assert pending.progress.begun
    assert line.others == 1


def test_results_of_the_run_before_that_come_behind_the_fence_are_older() -> None:
    """The camera waits again before it has said them."""
    line = shown()
    line.send()
    line.hear(WORKING, READY)  # a sensor's
    line.answer()
    assert [line.result(), line.result()] == [NOBODY, NOBODY]
    line.hear(WORKING)
    assert line.result() == OURS


# ---------------------------------------------------------------------- held


def test_container_is_held_while_it_is_not_known_whether_the_camera_shows_a_trigger() -> None:
    line = ready()
    line.trigger()
    assert line.result() == HELD
    assert line.wants_query
    assert line.judged == []


def test_held_container_is_the_triggers_when_a_further_query_is_answered() -> None:
    line = ready()
    pending = line.trigger()
    line.result(None, "own")
    line.answer()
    assert line.judged == [("own", OURS)]
    assert pending.ended
    line.leave()
    for _ in range(3):  # it is known now that the camera shows nothing
        line.trigger()
        assert line.result() == OURS
        line.leave()


def test_held_container_is_older_when_waiting_drops_behind_it() -> None:
    line = ready()
    line.trigger()
    line.result(None, "old")
    line.hear(WORKING)
    assert line.judged == [("old", NOBODY)]
    assert line.result() == OURS


def test_held_container_stays_held_while_a_status_says_nothing_of_it() -> None:
    line = ready()
    line.trigger()
    line.result()
    line.hear(READY | Status.OVERHEAT)
    assert line.judged == []
    assert len(line.held) == 1


@pytest.mark.parametrize("how", ["give up", "lose the link"])
def test_held_container_of_a_trigger_that_is_given_up_pays_its_debt(how: str) -> None:
    line = ready()
    line.trigger()
    line.result(None, "own")
    line.give_up() if how == "give up" else line.reconnect()
    assert line.judged == [("own", LATE)]
    assert line.at.debt is None


def test_query_of_before_tells_nothing_of_what_the_camera_shows() -> None:
    line = ready()
    line.send()
    line.at.on_query_answer()  # its own fence is not answered
    line.answer()
    assert line.result() == HELD


@pytest.mark.parametrize("what", ["nothing under way", "begun"])
def test_query_tells_nothing_of_what_the_camera_shows_where_nothing_is_held(what: str) -> None:
    line = ready()
    if what == "begun":
        line.status = None
        line.trigger()
        line.hear(WORKING)  # the first status of a session: whether it dropped is not known
        line.result()
        line.leave()
    line.at.on_query_answer()
    line.hear(READY)
    line.trigger()
    assert line.result() == HELD


def test_camera_that_was_taken_for_one_that_shows_nothing_is_known_better_at_the_first_drop() -> (
    None
):
    line = ready()
    line.trigger()
    line.result()
    line.answer()
    line.leave()
    line.hear(WORKING, READY)
    line.trigger()
    assert line.result().fate == "nobody"


# ---------------------------------------------------------------------- shown


@pytest.mark.parametrize("knows", [None, False])
def test_camera_that_did_not_wait_at_the_fence_has_to_drop_waiting(knows: bool | None) -> None:
    """It can take the trigger only when it waits again, and that is said."""
    line = ready()
    if knows is False:
        line.trigger()
        line.result()
        line.answer()
        line.leave()
    line.send()
    line.hear(Status.RUNNING | Status.WAITING_FOR_TRIGGER | Status.BUSY)
    line.status = WORKING  # as the first status of a session might have been
    line.answer()
    assert line.pending is not None
    assert line.pending.progress.shown
    assert line.result().fate == "nobody"
    line.hear(READY)
    assert line.result().fate == "nobody"
    line.hear(WORKING)
    assert line.result() == OURS


def test_debt_of_a_trigger_that_has_to_drop_waiting_is_not_paid_before() -> None:
    line = Line()
    line.status = WORKING
    line.trigger()
    line.give_up()
    assert line.result() == NOBODY
    assert line.at.debt == "late"


# ---------------------------------------------------------------------- debts


@pytest.mark.parametrize("debt", ["late", "streamed"])
def test_container_after_a_trigger_was_given_up_pays_its_debt_once(debt: Debt) -> None:
    line = ready()
    line.trigger()
    line.give_up(debt)
    assert line.at.debt == debt
    assert line.result() == Match(debt)
    assert line.at.debt is None
    assert line.result() == NOBODY


def test_container_before_the_fence_of_a_trigger_given_up_does_not_pay_its_debt() -> None:
    """D1: the second result of the trigger before."""
    line = shown()
    line.send()
    line.give_up()
    assert line.result().fate == "nobody"
    assert line.at.debt == "late"
    line.answer()
    assert line.result().fate == "nobody"
    assert line.at.debt == "late"
    line.hear(WORKING)
    assert line.result() == LATE
    assert line.at.debt is None


def test_sensors_result_of_before_does_not_pay_a_debt() -> None:
    """D2: its inspection began before our trigger had come."""
    line = shown()
    line.send()
    line.give_up()
    line.hear(WORKING)
    assert line.result().fate == "nobody"
    line.hear(READY)
    line.answer()
    assert line.at.debt == "late"


def test_debts_are_paid_in_the_order_of_their_triggers() -> None:
    line = ready()
    for wanted, debt in enumerate(("late", "streamed"), 1):
        line.trigger(wanted=wanted)
        line.give_up(debt)  # type: ignore[arg-type]
    assert [line.result() for _ in range(4)] == [LATE, STREAMED, STREAMED, NOBODY]


def test_trigger_given_up_owes_the_results_that_it_has_not() -> None:
    line = Line(ordered=False)
    line.trigger(wanted=3)
    line.result()
    line.give_up()
    assert [line.result() for _ in range(3)] == [LATE, LATE, NOBODY]


def test_container_that_came_and_was_not_read_is_not_owed() -> None:
    line = Line(ordered=False)
    pending = line.trigger(wanted=2)
    line.at.give_up(pending, unread=1)
    line.leave()
    assert [line.result(), line.result()] == [LATE, NOBODY]
    line.at.give_up(line.trigger(), unread=1)
    line.leave()
    assert line.at.debt is None


def test_container_of_a_trigger_whose_caller_was_not_woken_yet_is_late() -> None:
    line = ready()
    line.trigger()
    line.cancel()
    assert line.result() == LATE


def test_trigger_given_up_twice_keeps_its_first_fate() -> None:
    line = Line()
    pending = line.trigger()
    line.at.give_up(pending, "streamed")
    line.give_up("late")
    assert line.at.debt == "streamed"


def test_trigger_that_has_its_results_owes_nothing() -> None:
    line = shown()
    line.trigger()
    line.hear(WORKING)
    line.result()
    line.give_up()
    assert line.at.debt is None
    assert not line.at.doubted


def test_settled_means_that_nothing_of_before_can_come() -> None:
    line = Line()
    line.trigger()
    line.give_up()
    line.at.settled()
    assert (line.at.debt, line.at.doubted, line.at.judge(None).extra) == (None, False, False)
    assert line.result() == NOBODY


# ---------------------------------------------------------------------- doubted, and what is heard


def test_status_is_in_doubt_behind_a_trigger_that_was_given_up_before_it_began() -> None:
    line = shown()
    line.trigger()
    assert not line.at.doubted
    line.give_up()
    assert line.at.doubted
    line.hear(READY)
    assert line.at.doubted
    line.hear(WORKING)
    assert not line.at.doubted
    assert line.others == 0  # it is that trigger's


def test_status_is_in_no_doubt_behind_a_trigger_that_has_begun() -> None:
    line = shown()
    line.trigger()
    line.hear(WORKING)
    line.give_up()
    assert not line.at.doubted


def test_debt_of_a_trigger_that_never_began_is_dropped_when_all_is_heard() -> None:
    line = shown()
    line.trigger()
    line.hear(WORKING)
    line.give_up()  # begun: it stays
    line.hear(READY)
    line.send(wanted=2)
    line.give_up("streamed")
    line.answer()
    line.at.heard()
    assert not line.at.doubted
    assert [one.fate for one in line.at.owed] == ["late"]
    line.hear(WORKING)
    assert line.others == 1  # no trigger of ours is left that it could be


@pytest.mark.parametrize("line", [ready(), shown(ordered=False)], ids=["unknown", "unordered"])
def test_debt_stays_where_it_is_not_known_that_it_would_have_shown(line: Line) -> None:
    line.trigger()
    line.give_up()
    line.at.heard()
    assert not line.at.doubted
    assert line.result() == LATE


# ---------------------------------------------------------------------- more than one result

ORDERS = {
    "result, result, waiting": ["result", "result", READY],
    "waiting, result, result": [READY, "result", "result"],
    "result, waiting, result": ["result", READY, "result"],
}


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS.keys())
def test_second_container_of_one_trigger_is_extra_in_each_order(order: list[Any]) -> None:
    line = ready()
    line.trigger()
    line.hear(WORKING)
    verdicts: list[Match] = []
    for one in order:
        if one == "result":
            verdicts.append(line.result())
        else:
            line.hear(one)
    assert verdicts == [OURS, EXTRA]


def test_second_container_that_comes_behind_the_next_trigger_is_not_its() -> None:
    line = shown()
    line.trigger()
    line.hear(WORKING)
    assert line.result() == OURS
    line.leave()
    line.hear(READY)
    pending = line.trigger()
    assert line.result().fate == "nobody"
    line.hear(WORKING)
    assert line.result() == OURS
    assert pending.ended


def test_several_results_are_all_the_triggers() -> None:
    line = shown()
    line.trigger(wanted=3)
    line.hear(WORKING)
    assert [line.result() for _ in range(5)] == [OURS, OURS, OURS, EXTRA, EXTRA]


def test_more_containers_than_are_wanted_are_not_held() -> None:
    line = ready()
    line.trigger(wanted=2)
    assert [line.result() for _ in range(3)] == [HELD, HELD, NOBODY]
    line.answer()
    assert [match for _, match in line.judged] == [NOBODY, OURS, OURS]


def test_container_of_somebody_elses_inspection_is_not_extra() -> None:
    line = shown()
    line.hear(WORKING)
    assert line.result() == NOBODY


# ---------------------------------------------------------------------- somebody else's


def test_inspection_that_no_trigger_of_ours_began_is_somebody_elses() -> None:
    line = shown()
    assert line.at.judge(None).extra
    line.hear(WORKING)
    assert line.others == 1
    assert not line.at.judge(None).extra


@pytest.mark.parametrize(
    "status", [Status(0), Status.BUSY, READY, READY | Status.BUSY, Status.OVERHEAT]
)
def test_status_that_begins_no_inspection_is_nobodys(status: Status) -> None:
    line = shown()
    line.hear(status)
    assert line.others == 0
    assert line.at.judge(None).extra
    pending = line.trigger()
    line.hear(status)
    assert not pending.progress.begun


def test_status_that_goes_on_working_begins_no_inspection() -> None:
    line = shown()
    line.hear(WORKING, WORKING | Status.OVERHEAT)
    assert line.others == 1


def test_first_status_of_a_session_tells_of_no_drop() -> None:
    line = Line()
    line.hear(WORKING)
    assert line.others == 0
    line.hear(READY)
    line.trigger()
    assert line.result() == HELD


def test_first_status_of_a_session_may_be_that_of_the_trigger() -> None:
    line = Line()
    pending = line.trigger()
    line.hear(WORKING)
    assert pending.progress.begun
    assert line.result() == OURS


@pytest.mark.parametrize("ordered", [True, False])
def test_second_inspection_behind_a_trigger_is_somebody_elses(*, ordered: bool) -> None:
    """Where a status may be lost nothing is told of others."""
    line = shown(ordered=ordered)
    line.trigger()
    line.hear(WORKING, READY, WORKING)
    assert line.others == int(ordered)
    assert not line.at.judge(None).extra


def test_inspection_that_owes_us_a_result_is_ours() -> None:
    line = ready()
    line.trigger()
    line.give_up()
    line.hear(WORKING)
    assert line.others == 0
    assert line.result() == LATE


def test_somebody_elses_inspection_has_the_number_that_the_user_has_set() -> None:
    line = shown()
    line.at.give_number(41)
    line.hear(WORKING)
    assert line.at.take_number(MAX_NUMBER)[0] != 41


# ---------------------------------------------------------------------- confirmed


def test_trigger_is_confirmed_by_a_status_behind_its_answer() -> None:
    line = Line(ordered=False, fences=True)
    pending = line.send(confirms=True)
    line.answer()
    line.hear(READY)
    assert line.result() == OURS
    line.hear(READY)
    assert not pending.progress.confirmed
    line.at.on_answer()
    assert not pending.ended
    assert line.result().fate == "nobody"  # it has all that it wants
    line.hear(WORKING)
    assert pending.progress.confirmed
    assert pending.ended


def test_answer_without_a_trigger_confirms_none() -> None:
    line = shown()
    line.at.on_answer()  # of one that has its results
    assert not line.send(confirms=True).progress.answered


def test_status_of_before_the_answer_does_not_confirm_the_next_trigger() -> None:
    line = Line(ordered=False, fences=True)
    first = line.send(confirms=True)
    line.answer()
    line.at.on_answer()
    line.give_up()
    second = line.send(confirms=True)
    line.hear(WORKING)
    assert (first.progress.confirmed, second.progress.confirmed) == (False, False)


# ---------------------------------------------------------------------- with a number


@pytest.mark.parametrize("ordered", [True, False])
def test_container_with_a_number_of_ours_alone_is_its_own_in_any_order(*, ordered: bool) -> None:
    line = shown(ordered=ordered)
    line.send(5000, fenced=False, certain=True)
    assert line.result(5000) == OURS


def test_container_with_a_number_that_others_may_have_is_its_own_behind_the_drop() -> None:
    """A sensor's run took the number that the user had set, and it waits before it is told."""
    line = shown()
    line.send(41)
    line.hear(WORKING, READY)  # the sensor's
    line.answer()
    assert line.result(41) == NOBODY
    line.hear(WORKING)
    assert line.result(42) == NOBODY
    assert line.result(41) == OURS


def test_container_with_a_number_that_others_may_have_is_its_own_behind_a_sensors_run() -> None:
    """The sensor's began between our Query and our SentTrigger, and was over by the SentTrigger."""
    line = shown()
    line.trigger(41)
    line.hear(WORKING, READY)  # the sensor's
    assert line.result(7) == NOBODY
    line.hear(WORKING)
    assert line.result(41) == OURS


def test_container_with_a_number_that_others_may_have_is_held_where_nothing_is_known() -> None:
    line = ready()
    line.trigger(41)
    assert line.result(41) == HELD
    line.answer()
    assert [match for _, match in line.judged] == [OURS]


def test_container_with_a_number_that_others_may_have_is_its_own_over_udp() -> None:
    line = shown(ordered=False)
    line.send(41)
    assert line.result(41) == OURS


def test_container_with_another_number_is_nobodys() -> None:
    line = Line()
    line.send(5000, certain=True)
    line.answer()
    assert line.result(4999) == NOBODY
    assert line.result(5001) == NOBODY
    assert line.result(5000) == OURS


@pytest.mark.parametrize("debt", ["late", "streamed"])
def test_container_with_the_number_of_a_trigger_given_up_is_known(debt: Debt) -> None:
    line = Line()
    line.trigger(1000)
    line.give_up(debt)
    line.send(2000, certain=True, fenced=False)
    assert line.result(1000) == Match(debt)
    assert line.result(2000) == OURS
    assert line.at.debt is None


def test_containers_of_several_triggers_given_up_may_come_in_any_order() -> None:
    line = Line(ordered=False)
    fates: list[Debt] = ["late", "streamed", "late"]
    for number, debt in enumerate(fates, 1):
        line.trigger(number * 1000)
        line.give_up(debt)
    line.trigger(4000)
    assert [line.result(number) for number in (2000, 4000, 3000, 1000)] == [
        STREAMED,
        OURS,
        LATE,
        LATE,
    ]
    assert line.at.debt is None


def test_debt_stays_until_every_number_that_is_owed_has_come() -> None:
    line = Line()
    for number in (1000, 2000):
        line.trigger(number)
        line.give_up()
    line.result(2000)
    assert line.at.debt == "late"
    line.result(1000)
    assert line.at.debt is None


def test_somebody_elses_number_does_not_pay_a_debt() -> None:
    line = Line()
    line.trigger(1000)
    line.give_up()
    assert line.result(77) == NOBODY
    assert line.at.debt == "late"


def test_second_container_with_the_number_of_the_last_trigger_is_extra() -> None:
    line = Line()
    line.send(1000, certain=True, fenced=False)
    line.result(1000)
    line.leave()
    line.send(2000, certain=True, fenced=False)
    assert line.result(1000) == EXTRA
    assert line.result(2000) == OURS


def test_container_without_a_number_is_judged_by_the_order() -> None:
    line = shown()
    line.trigger(5000)
    assert line.result(None).fate == "nobody"
    line.hear(WORKING)
    assert line.result(None) == OURS


def test_container_without_a_number_pays_a_debt() -> None:
    line = ready()
    line.trigger(1000)
    line.give_up()
    assert line.result(None) == LATE


def test_container_with_a_number_pays_the_debt_of_a_trigger_without() -> None:
    line = ready()
    line.send(1000, certain=True, fenced=False)
    line.result(1000)
    line.leave()
    line.trigger()
    line.give_up()
    assert line.result(1001) == LATE


def test_number_of_a_trigger_given_up_is_known_when_nothing_is_owed_any_more() -> None:
    line = Line()
    line.trigger(1000)
    line.give_up()
    line.at.settled()
    assert [line.result(1000), line.result(1000)] == [LATE, LATE]
    assert line.at.debt is None


def test_numbers_owed_are_bounded_and_the_oldest_are_forgotten() -> None:
    line = Line()
    for number in range(MAX_OWED + 10):
        line.trigger(number)
        line.give_up()
    assert len(line.at.owed) == len(line.at._given_up) == MAX_OWED
    assert line.result(9) == NOBODY
    assert line.result(10) == LATE


# ---------------------------------------------------------------------- over sessions


def test_trigger_of_a_lost_session_is_owed_in_the_next() -> None:
    line = shown()
    line.send()
    line.reconnect()
    line.hear(READY)  # it may have begun, and ended, while nobody listened
    assert line.result() == LATE


def test_drop_in_the_next_session_is_not_the_lost_triggers() -> None:
    line = shown()
    pending = line.send()
    line.reconnect()
    line.hear(READY, WORKING)
    assert not pending.progress.begun
    assert line.others == 1


def test_session_begins_without_doubt_and_without_an_old_fence() -> None:
    line = shown()
    pending = line.send()
    line.give_up()
    assert line.at.doubted
    line.reconnect()
    assert (line.at.doubted, line.at.judge(None).extra, line.fence_open) == (False, False, False)
    line.at.on_fence(int(READY))
    line.at.on_answer()
    assert not pending.progress.reached


def test_what_the_camera_shows_is_known_over_sessions() -> None:
    line = shown()
    line.reconnect()
    line.hear(READY)
    line.trigger()
    assert line.result().fate == "nobody"


def test_numbers_owed_in_a_lost_session_are_known_in_the_next() -> None:
    line = Line()
    line.trigger(1000)
    line.reconnect()
    line.send(2000, certain=True, fenced=False)
    assert line.result(1000) == LATE
    assert line.result(2000) == OURS


def test_extra_container_is_not_told_over_sessions() -> None:
    line = shown()
    assert line.result() == EXTRA
    line.reconnect()
    assert line.result() == NOBODY


# ---------------------------------------------------------------------- taking numbers

FIELDS = {
    "int8": (1 << 7) - 1,
    "uint8": (1 << 8) - 1,
    "int16": (1 << 15) - 1,
    "uint16": (1 << 16) - 1,
    "int32": MAX_NUMBER,
    "uint32": MAX_NUMBER,
    "int64": MAX_NUMBER,
    "uint64": MAX_NUMBER,
}


@pytest.mark.parametrize(("field_type", "highest"), FIELDS.items())
def test_numbering_of_a_field_is_as_wide_as_it_and_the_wire(field_type: str, highest: int) -> None:
    interpretation = Interpretation(f"n: {field_type} @sequence", lenient=False, y_down=False)
    assert interpretation.numbering(7) == (highest, True)
    size = int(field_type.lstrip("uint")) // 8
    container = ResultContainer(application=7, data=highest.to_bytes(size, "little"))
    assert interpretation.number(container, 0) == highest


@pytest.mark.parametrize("highest", sorted(set(FIELDS.values())))
def test_numbers_fit_and_do_not_come_again_soon(highest: int) -> None:
    attribution = Correlation(chance=0.5)
    taken = [attribution.take_number(highest) for _ in range(4 * FEWEST_NUMBERS)]
    numbers = [number for number, _ in taken]
    assert {certain for _, certain in taken} == {highest == MAX_NUMBER}
    assert all(0 <= number <= highest for number in numbers)
    for first in range(len(numbers) - FEWEST_NUMBERS):
        assert len(set(numbers[first : first + FEWEST_NUMBERS])) == FEWEST_NUMBERS
    step = min(NUMBER_STEP, (highest + 1) // FEWEST_NUMBERS)
    assert {(a - b) % (highest + 1) for a, b in itertools.pairwise(numbers)} == {step}


@pytest.mark.parametrize("highest", sorted(set(FIELDS.values())))
@pytest.mark.parametrize("chance", [0.0, 1e-9, 0.5, 1.0])
def test_runs_of_others_count_away_from_the_next_number(highest: int, chance: float) -> None:
    """D5: they meet it after so many as the range has numbers, less a step."""
    attribution = Correlation(chance)
    step = min(NUMBER_STEP, (highest + 1) // FEWEST_NUMBERS)
    for _ in range(FEWEST_NUMBERS):
        number, _ = attribution.take_number(highest)
        following = (number - step) % (highest + 1)
        runs = (following - number) % (highest + 1)
        assert runs == highest + 1 - step
    if highest <= 1 << 16:  # once more by counting
        first, _ = attribution.take_number(highest)
        following, _ = attribution.take_number(highest)
        others = itertools.takewhile(
            lambda one: one != following, (n % (highest + 1) for n in itertools.count(first + 1))
        )
        assert sum(1 for _ in others) == highest - step


def test_number_wraps_around_below_zero() -> None:
    attribution = Correlation(chance=0.0)
    assert attribution.take_number(MAX_NUMBER) == (MAX_NUMBER + 1 - NUMBER_STEP, True)
    assert attribution.take_number(MAX_NUMBER) == (MAX_NUMBER + 1 - 2 * NUMBER_STEP, True)


def test_number_the_user_has_set_is_taken_once_and_may_be_anybodys() -> None:
    attribution = Correlation(chance=0.5)
    attribution.give_number(41)
    assert attribution.take_number(MAX_NUMBER) == (41, False)
    number, certain = attribution.take_number(MAX_NUMBER)
    assert number != 41
    assert certain


def test_number_the_user_has_set_that_does_not_fit_the_field_is_not_taken() -> None:
    attribution = Correlation(chance=0.5)
    attribution.give_number(200)
    assert 0 <= attribution.take_number(127)[0] <= 127
    assert attribution.take_number(MAX_NUMBER)[0] != 200


@pytest.mark.parametrize("highest", [127, MAX_NUMBER])
def test_number_the_user_has_set_may_be_the_highest(highest: int) -> None:
    attribution = Correlation(chance=0.5)
    attribution.give_number(highest)
    assert attribution.take_number(highest) == (highest, False)


def test_number_the_user_has_set_again_while_its_result_is_owed_is_not_taken() -> None:
    line = Line()
    line.at.give_number(41)
    line.trigger(line.at.take_number(MAX_NUMBER)[0])
    line.give_up()
    line.at.give_number(41)
    number, certain = line.at.take_number(MAX_NUMBER)
    assert (number != 41, certain) == (True, True)
    line.send(number, certain=certain, fenced=False)
    assert line.result(41) == LATE
    assert line.result(number) == OURS


def test_number_of_the_last_trigger_that_the_user_has_set_again_is_not_taken() -> None:
    """A second result of that trigger may still come."""
    line = shown()
    line.at.give_number(41)
    line.trigger(line.at.take_number(MAX_NUMBER)[0])
    line.hear(WORKING)
    assert line.result(41) == OURS
    line.leave()
    line.at.give_number(41)
    assert line.at.take_number(MAX_NUMBER)[0] != 41


def test_number_the_user_has_set_that_a_trigger_without_a_number_took_is_not_taken_again() -> None:
    """D6: its result carries that number, and may be late."""
    line = Line()
    line.at.give_number(500)
    line.trigger()
    line.give_up()
    assert line.at.take_number(MAX_NUMBER)[0] != 500


def test_two_clients_begin_at_different_numbers() -> None:
    cameras = [smartcam.connect("bvs://127.0.0.1") for _ in range(5)]
    first = {inside(one)._results.correlation.take_number(MAX_NUMBER)[0] for one in cameras}
    assert len(first) > 1


def test_field_in_a_record_that_may_be_missing_does_not_always_decide() -> None:
    for layout, always in {
        "n: int32 @sequence, (x: int32)*": True,
        "(n: int32 @sequence)*": False,
        "(n: int32 @sequence)[2]": False,
        "count: int32, (n: int32 @sequence)[count]": False,
    }.items():
        numbering = Interpretation(layout, lenient=False, y_down=False).numbering(7)
        assert numbering == (MAX_NUMBER, always), layout
    nothing = ResultContainer(application=7, data=b"")
    missing = Interpretation("(n: int32 @sequence)*", lenient=False, y_down=False)
    assert missing.number(nothing, 0) is None


@given(st.binary(max_size=12), st.integers(0, 3))
def test_number_of_any_bytes_is_a_number_or_none(data: bytes, endian: int) -> None:
    layout = Interpretation("n: int16 @sequence, (x: int8)*", lenient=False, y_down=False)
    number = layout.number(ResultContainer(application=7, data=data), endian)
    if endian > 1 or len(data) < 2:
        assert number is None
    else:
        order: Literal["little", "big"] = "big" if endian else "little"
        assert number == int.from_bytes(data[:2], order, signed=True)


def test_container_behind_anothers_inspection_is_not_the_triggers_second() -> None:
    """An inspection says everything before the next one shows; ours has said one result of two."""
    line = shown()
    line.trigger(wanted=2)
    line.hear(WORKING)
    assert line.result() == OURS
    line.hear(READY, WORKING)
    assert line.result().fate == "nobody"
