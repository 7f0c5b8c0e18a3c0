"""The owner of each result: every branch by a table."""

from __future__ import annotations

import itertools
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smartcam
from smartcam import Status
from smartcam._client._inside import Interpretation
from smartcam.protocols.messages import ResultContainer
from tests.client.correlation_line import READY, WORKING, Line, after_one, ready
from tests.client.inside import Correlation, Match, OwedFate
from tests.insides import inside

FEWEST_NUMBERS = 64
MAX_NUMBER = 2_147_483_647
MAX_OWED = 1 << 10
NUMBER_STEP = 1000


OURS = Match("triggered")
LATE = Match("late")
STREAMED = Match("streamed")
NOBODY = Match("nobody")
EXTRA = Match("nobody", extra=True)

OVERTRIGGERED = Status.OVERTRIGGERED
STOPPED = Status(0)

numbers_of_any_width = pytest.mark.parametrize("number", [None, 41, MAX_NUMBER])
"""None: the layout has none."""


# ---------------------------------------------------------------------- the evidence


def test_container_without_a_trigger_is_nobodys() -> None:
    assert Line().result() == NOBODY


@numbers_of_any_width
def test_trigger_ends_by_its_result_when_the_camera_has_shown_that_it_took_it(
    number: int | None,
) -> None:
    line = ready()
    pending = line.trigger(number)
    line.hear(WORKING)
    assert line.result(number, "own") == OURS
    assert not pending.ended  # another inspection may be said before the second answer
    line.answer()
    assert pending.ended
    assert line.returned == ["own"]


@numbers_of_any_width
def test_result_that_comes_behind_the_second_answer_is_the_triggers(number: int | None) -> None:
    line = ready()
    pending = line.begin(number)
    assert not pending.ended
    assert line.result(number) == OURS
    assert pending.ended


@numbers_of_any_width
@pytest.mark.parametrize("answers", [0, 1, 2])
def test_result_without_a_shown_inspection_is_not_the_triggers(
    answers: int, number: int | None
) -> None:
    line = ready()
    pending = line.send(number)
    for _ in range(answers):
        line.answer()
    assert line.result(number) == NOBODY
    line.hear(READY | Status.OVERHEAT)  # that is no beginning
    assert line.result(number) == NOBODY
    assert (pending.early_count, pending.received, pending.ended) == (2, 0, False)


@numbers_of_any_width
def test_inspection_before_the_first_answer_is_somebody_elses(number: int | None) -> None:
    line = ready()
    pending = line.send(number)
    line.hear(WORKING)
    assert line.result(number) == NOBODY
    line.hear(READY)
    line.answer()
    assert (line.others, pending.early_count, pending.evidence.begin_count) == (1, 1, 0)
    assert line.result(number) == NOBODY  # the camera waits again before it has said all of it
    line.hear(WORKING)
    line.answer()
    assert line.result(number) == OURS
    assert pending.ended


@numbers_of_any_width
@pytest.mark.parametrize("when", ["at once", "behind its result"])
def test_two_inspections_between_the_answers_cannot_be_told_apart(
    when: str, number: int | None
) -> None:
    line = ready()
    pending = line.trigger(number)
    line.hear(WORKING)
    if when == "behind its result":
        assert line.result(number) == OURS  # until it is known better
    line.hear(READY, WORKING)
    assert (pending.ended, line.doubts, line.returned) == (True, 1, [])
    assert line.result(number).fate != "triggered"
    line.answer()
    assert line.returned == []


def test_inspection_behind_the_second_answer_is_the_triggers_where_none_was_before() -> None:
    """A camera may say that it took the trigger a moment later."""
    line = ready()
    pending = line.trigger()
    line.answer()
    line.hear(WORKING)
    assert line.result() == OURS
    assert pending.ended


def test_second_inspection_behind_the_second_answer_is_somebody_elses() -> None:
    line = ready()
    pending = line.begin()
    line.hear(READY, WORKING)
    assert (line.others, line.doubts, pending.ended) == (1, 0, False)
    assert line.result() == NOBODY
    assert not pending.ended


@pytest.mark.parametrize("answers", [0, 1, 2])
def test_overtriggered_that_rises_ends_the_trigger(answers: int) -> None:
    line = ready()
    pending = line.send()
    for _ in range(answers):
        line.answer()
    line.hear(WORKING)
    line.result()
    if answers == 2:
        assert pending.ended
        return
    line.hear(WORKING | OVERTRIGGERED, WORKING)
    for _ in range(2 - answers):
        line.answer()
    assert (pending.ended, line.returned) == (True, [])


def test_application_that_is_stopped_ends_the_trigger() -> None:
    """An inspection that begins behind the next start is somebody else's."""
    line = ready()
    line.trigger()
    line.hear(STOPPED)
    line.answer()
    line.hear(READY, WORKING)
    assert line.result().fate != "triggered"


@pytest.mark.parametrize("number", [None, 41])
def test_trigger_over_udp_needs_no_evidence(number: int | None) -> None:
    line = ready(gets_every_status=False)
    pending = line.send(number)
    assert line.result(number) == OURS
    assert pending.ended


def test_answers_of_a_trigger_that_is_settled_say_nothing() -> None:
    line = ready()
    pending = line.send()
    line.give_up()
    line.at.forget_owed()
    line.answer()
    line.hear(WORKING)
    assert pending.evidence.begin_count == 0
    assert line.others == 1


# ---------------------------------------------------------------------- where a trigger is answered


def polled() -> Line:
    """A camera of ``bid`` over TCP."""
    line = Line(gets_every_status=False, polled=True)
    line.hear(READY)
    return line


def test_trigger_that_is_answered_ends_by_its_result_and_a_status_behind_it() -> None:
    line = polled()
    pending = line.trigger()
    line.hear(READY)
    line.trigger_answer()
    assert line.result() == OURS
    assert not pending.ended
    line.hear(WORKING)
    assert pending.ended


def test_result_of_a_trigger_that_is_answered_may_come_behind_the_status() -> None:
    line = polled()
    pending = line.trigger()
    line.hear(READY)
    line.trigger_answer()
    line.hear(WORKING)
    assert not pending.ended
    assert line.result() == OURS
    assert pending.ended


@pytest.mark.parametrize("queried", [True, False])
def test_result_before_the_trigger_is_answered_is_older(*, queried: bool) -> None:
    line = polled()
    pending = line.send()
    if queried:
        line.answer()
        line.hear(READY)
    assert line.result() == NOBODY
    assert (pending.early_count, pending.received) == (1, 0)


BEFORE = {
    "none": [],
    "none behind the answer to the Query": [READY, None],
    "does not wait": [None, WORKING],
    "does not wait, and then it does": [None, WORKING, READY],
    "has dropped one": [None, READY | OVERTRIGGERED],
}


@pytest.mark.parametrize("statuses", BEFORE.values(), ids=BEFORE.keys())
def test_trigger_of_which_no_status_in_front_says_that_the_camera_waits_is_in_doubt(
    statuses: list[Status | None],
) -> None:
    """None: the answer to the Query."""
    line = polled()
    line.hear(READY | OVERTRIGGERED)  # in no change of it a rise shows
    pending = line.send()
    for status in statuses:
        line.hear(status) if status is not None else line.answer()
    assert not pending.ended
    line.trigger_answer()
    assert (pending.ended, line.doubts) == (True, 1)
    assert line.result().fate != "triggered"


def test_status_in_front_that_says_that_the_camera_waits_counts_whatever_comes_then() -> None:
    line = polled()
    pending = line.trigger()
    line.hear(READY, WORKING)
    line.trigger_answer()
    assert (pending.ended, line.doubts) == (False, 0)


@pytest.mark.parametrize("result", [True, False])
def test_overtriggered_behind_the_answer_to_the_trigger_is_in_doubt(*, result: bool) -> None:
    """Set before as well: no change of it shows."""
    line = polled()
    pending = line.trigger()
    line.hear(READY)
    line.status = READY | OVERTRIGGERED
    line.trigger_answer()
    if result:
        assert line.result() == OURS  # until it is known better
    line.hear(WORKING | OVERTRIGGERED)
    assert (pending.ended, line.doubts, line.returned) == (True, 1, [])


def test_answer_without_a_trigger_says_nothing() -> None:
    line = polled()
    line.at.on_trigger_answer()
    line.at.on_trigger_query_answer()
    pending = line.trigger()
    assert not pending.evidence.takes_containers


def test_answer_of_the_trigger_before_says_nothing_of_the_next() -> None:
    line = polled()
    first = line.trigger()
    line.hear(READY)
    line.trigger_answer()
    line.give_up()
    second = line.send()
    line.hear(WORKING)
    assert (first.evidence.proven, second.evidence.proven) == (False, False)


# ---------------------------------------------------------------------- where nothing shows it


def test_container_behind_the_answer_in_front_is_the_triggers_where_nothing_shows_it() -> None:
    line = Line(gets_every_status=False, by_round_trip=True)
    pending = line.send()
    assert line.result() == NOBODY
    line.answer()
    assert line.result() == OURS
    assert pending.ended


# ---------------------------------------------------------------------- debts


@pytest.mark.parametrize("debt", ["late", "streamed"])
def test_container_after_a_trigger_was_given_up_pays_its_debt_once(debt: OwedFate) -> None:
    line = ready()
    line.begin()
    line.give_up(debt)
    assert line.at.owed_fate == debt
    assert line.result() == Match(debt)
    assert line.at.owed_fate is None
    assert line.result() == NOBODY


def test_container_before_a_trigger_given_up_began_does_not_pay_its_debt() -> None:
    """The second result of the trigger before."""
    line = after_one()
    line.send()
    line.give_up()
    assert line.result().fate == "nobody"
    line.answer()
    assert line.result().fate == "nobody"
    assert line.at.owed_fate == "late"
    line.hear(WORKING)
    assert line.result() == LATE
    assert line.at.owed_fate is None


def test_sensors_result_of_before_does_not_pay_a_debt() -> None:
    """Its inspection began before our trigger had come."""
    line = ready()
    line.send()
    line.give_up()
    line.hear(WORKING)
    assert line.result().fate == "nobody"
    line.hear(READY)
    line.answer()
    assert line.at.owed_fate == "late"


def test_debts_are_paid_in_the_order_of_their_triggers() -> None:
    line = ready()
    for wanted, debt in enumerate(("late", "streamed"), 1):
        line.begin(wanted=wanted)
        line.give_up(debt)  # type: ignore[arg-type]
        line.hear(READY)
    assert [line.result() for _ in range(4)] == [LATE, STREAMED, STREAMED, NOBODY]


def test_trigger_given_up_owes_the_results_that_it_has_not() -> None:
    line = Line(gets_every_status=False)
    line.send(wanted=3)
    line.result()
    line.give_up()
    assert [line.result() for _ in range(3)] == [LATE, LATE, NOBODY]


def test_container_that_came_and_was_not_read_is_not_owed() -> None:
    line = Line(gets_every_status=False)
    pending = line.send(wanted=2)
    line.at.give_up(pending, unread=1)
    line.leave()
    assert [line.result(), line.result()] == [LATE, NOBODY]
    line.at.give_up(line.send(), unread=1)
    line.leave()
    assert line.at.owed_fate is None


def test_container_of_a_trigger_whose_caller_was_not_woken_yet_is_late() -> None:
    line = ready()
    line.begin()
    line.cancel()
    assert line.result() == LATE


def test_trigger_given_up_twice_keeps_its_first_fate() -> None:
    line = Line()
    pending = line.trigger()
    line.at.give_up(pending, "streamed")
    line.give_up("late")
    assert line.at.owed_fate == "streamed"


def test_trigger_that_has_its_results_owes_nothing() -> None:
    line = ready()
    line.begin()
    line.result()
    line.give_up()
    assert line.at.owed_fate is None
    assert not line.at.status_may_be_old


def test_trigger_whose_results_were_not_proven_owes_them_still() -> None:
    """They may be somebody else's, and its own may still come."""
    line = ready()
    line.trigger()
    line.hear(WORKING)
    line.result()
    line.give_up()
    assert line.at.owed_fate == "late"


def test_settled_means_that_nothing_of_before_can_come() -> None:
    line = Line()
    line.trigger()
    line.give_up()
    line.at.forget_owed()
    assert (line.at.owed_fate, line.at.status_may_be_old, line.at.judge(None).extra) == (
        None,
        False,
        False,
    )
    assert line.result() == NOBODY


# ---------------------------------------------------------------------- status_may_be_old


def test_status_is_in_doubt_behind_a_trigger_that_was_given_up_before_it_began() -> None:
    line = ready()
    line.trigger()
    assert not line.at.status_may_be_old
    line.give_up()
    assert line.at.status_may_be_old
    line.hear(READY)
    assert line.at.status_may_be_old
    line.hear(WORKING)
    assert not line.at.status_may_be_old
    assert line.others == 0  # it is that trigger's


def test_status_is_in_no_doubt_behind_a_trigger_that_has_begun() -> None:
    line = ready()
    line.begin()
    line.give_up()
    assert not line.at.status_may_be_old


def test_debt_of_a_trigger_that_never_began_is_dropped_when_all_is_heard() -> None:
    line = ready()
    line.begin()
    line.give_up()  # begun: it stays
    line.hear(READY)
    line.send(wanted=2)
    line.give_up("streamed")
    line.answer()
    line.answer()
    line.at.note_query_answered()
    assert not line.at.status_may_be_old
    assert [one.fate for one in line.at.owed] == ["late"]
    line.hear(WORKING)
    assert line.others == 1  # no trigger of ours is left that it could be


@pytest.mark.parametrize("kind", ["udp", "polled"])
def test_debt_stays_where_not_every_status_is_told(kind: str) -> None:
    line = ready(gets_every_status=False) if kind == "udp" else polled()
    line.trigger() if kind == "polled" else line.send()
    if kind == "polled":
        line.hear(READY)
        line.trigger_answer()
    line.give_up()
    line.at.note_query_answered()
    assert not line.at.status_may_be_old
    assert line.result() == LATE


# ---------------------------------------------------------------------- more than one result

ORDERS = {
    "result, result, waiting": ["result", "result", READY],
    "waiting, result, result": [READY, "result", "result"],
    "result, waiting, result": ["result", READY, "result"],
}


@pytest.mark.parametrize("answered", [0, 1, 2, 3])
@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS.keys())
def test_second_container_of_one_trigger_is_extra_in_each_order(
    order: list[Any], answered: int
) -> None:
    """The second answer comes before, between or behind them."""
    line = ready()
    pending = line.trigger()
    line.hear(WORKING)
    verdicts: list[Match] = []
    for count, one in enumerate([*order, None]):
        if count == answered:
            line.answer()
        if one == "result":
            verdicts.append(line.result())
        elif one is not None:
            line.hear(one)
    assert verdicts == [OURS, EXTRA]
    assert pending.ended


def test_second_container_that_comes_behind_the_next_trigger_is_not_its() -> None:
    line = after_one()
    pending = line.trigger()
    assert line.result().fate == "nobody"
    line.hear(WORKING)
    assert line.result() == OURS
    line.answer()
    assert pending.ended


def test_several_results_are_all_the_triggers() -> None:
    line = ready()
    line.begin(wanted=3)
    assert [line.result() for _ in range(5)] == [OURS, OURS, OURS, EXTRA, EXTRA]


def test_container_of_somebody_elses_inspection_is_not_extra() -> None:
    line = after_one()
    line.hear(WORKING)
    assert line.result() == NOBODY


def test_container_behind_anothers_inspection_is_not_the_triggers_second() -> None:
    """An inspection says everything before the next one shows; ours has said one result of two."""
    line = ready()
    line.begin(wanted=2)
    assert line.result() == OURS
    line.hear(READY, WORKING)
    assert line.result().fate == "nobody"


# ---------------------------------------------------------------------- somebody else's


def test_inspection_that_no_trigger_of_ours_began_is_somebody_elses() -> None:
    line = after_one()
    assert line.at.judge(None).extra
    line.hear(WORKING)
    assert line.others == 1
    assert not line.at.judge(None).extra


@pytest.mark.parametrize(
    "status", [STOPPED, Status.BUSY, READY, READY | Status.BUSY, Status.OVERHEAT]
)
def test_status_that_begins_no_inspection_is_nobodys(status: Status) -> None:
    line = after_one()
    line.hear(status)
    assert line.others == 0
    assert line.at.judge(None).extra
    pending = line.trigger()
    line.hear(status)
    assert not pending.evidence.begin_count


def test_status_that_goes_on_working_begins_no_inspection() -> None:
    line = ready()
    line.hear(WORKING, WORKING | Status.OVERHEAT)
    assert line.others == 1


def test_first_status_of_a_session_tells_of_no_drop() -> None:
    line = Line()
    line.hear(WORKING)
    assert line.others == 0


@pytest.mark.parametrize("complete", [True, False])
def test_second_inspection_behind_a_trigger_is_somebody_elses(*, complete: bool) -> None:
    """Nothing is told of others' inspections where a status may be lost."""
    line = ready(gets_every_status=complete)
    line.begin() if complete else line.send()
    line.hear(WORKING, READY, WORKING)
    assert line.others == int(complete)
    assert not line.at.judge(None).extra


def test_inspection_that_owes_us_a_result_is_ours() -> None:
    line = ready()
    line.trigger()
    line.give_up()
    line.hear(WORKING)
    assert line.others == 0
    assert line.result() == LATE


def test_somebody_elses_inspection_has_the_number_that_the_user_has_set() -> None:
    line = ready()
    line.at.set_next_number(41)
    line.hear(WORKING)
    assert line.at.take_number(MAX_NUMBER) != 41


# ---------------------------------------------------------------------- with a number


@pytest.mark.parametrize("complete", [True, False])
def test_container_with_another_number_is_nobodys(*, complete: bool) -> None:
    line = ready(gets_every_status=complete)
    line.begin(5000) if complete else line.send(5000)
    assert line.result(4999) == NOBODY
    assert line.result(5001) == NOBODY
    assert line.result(5000) == OURS


@numbers_of_any_width
def test_container_of_a_sensors_run_that_took_our_number_is_not_the_triggers(
    number: int | None,
) -> None:
    """It came between our two words; ours has the next number."""
    line = ready()
    line.trigger(number)
    line.hear(WORKING)  # the sensor's
    line.result(number)
    line.hear(READY, WORKING)  # ours
    assert (line.doubts, line.returned) == (1, [])


@pytest.mark.parametrize("debt", ["late", "streamed"])
def test_container_with_the_number_of_a_trigger_given_up_is_known(debt: OwedFate) -> None:
    line = ready()
    line.trigger(1000)
    line.give_up(debt)
    line.begin(2000)
    assert line.result(1000) == Match(debt)
    assert line.result(2000) == OURS
    assert line.at.owed_fate is None


def test_containers_of_several_triggers_given_up_may_come_in_any_order() -> None:
    line = Line(gets_every_status=False)
    fates: list[OwedFate] = ["late", "streamed", "late"]
    for number, debt in enumerate(fates, 1):
        line.send(number * 1000)
        line.give_up(debt)
    line.send(4000)
    assert [line.result(number) for number in (2000, 4000, 3000, 1000)] == [
        STREAMED,
        OURS,
        LATE,
        LATE,
    ]
    assert line.at.owed_fate is None


def test_debt_stays_until_every_number_that_is_owed_has_come() -> None:
    line = Line()
    for number in (1000, 2000):
        line.trigger(number)
        line.give_up()
    line.result(2000)
    assert line.at.owed_fate == "late"
    line.result(1000)
    assert line.at.owed_fate is None


def test_somebody_elses_number_does_not_pay_a_debt() -> None:
    line = ready()
    line.begin(1000)
    line.give_up()
    assert line.result(77) == NOBODY
    assert line.at.owed_fate == "late"


def test_second_container_with_the_number_of_the_last_trigger_is_extra() -> None:
    line = ready()
    line.begin(1000)
    line.result(1000)
    line.leave()
    line.hear(READY)
    line.begin(2000)
    assert line.result(1000) == EXTRA
    assert line.result(2000) == OURS


def test_container_without_a_number_is_judged_by_the_order() -> None:
    line = ready()
    line.trigger(5000)
    assert line.result(None).fate == "nobody"
    line.hear(WORKING)
    assert line.result(None) == OURS


def test_container_without_a_number_pays_a_debt() -> None:
    line = ready()
    line.begin(1000)
    line.give_up()
    assert line.result(None) == LATE


def test_container_with_a_number_pays_the_debt_of_a_trigger_without() -> None:
    line = ready()
    line.begin(1000)
    line.result(1000)
    line.leave()
    line.hear(READY)
    line.begin()
    line.give_up()
    assert line.result(1001) == LATE


def test_number_of_a_trigger_given_up_is_known_when_nothing_is_owed_any_more() -> None:
    line = Line()
    line.trigger(1000)
    line.give_up()
    line.at.forget_owed()
    assert [line.result(1000), line.result(1000)] == [LATE, LATE]
    assert line.at.owed_fate is None


def test_numbers_owed_are_bounded_and_the_oldest_are_forgotten() -> None:
    line = Line()
    for number in range(MAX_OWED + 10):
        line.trigger(number)
        line.give_up()
    assert len(line.at.owed) == len(line.at._given_up_fates) == MAX_OWED
    assert line.result(9) == NOBODY
    assert line.result(10) == LATE


# ---------------------------------------------------------------------- over sessions


def test_trigger_of_a_lost_session_is_owed_in_the_next() -> None:
    line = ready()
    line.send()
    line.reconnect()
    line.hear(READY)  # it may have begun, and ended, while nobody listened
    assert line.result() == LATE


def test_drop_in_the_next_session_is_not_the_lost_triggers() -> None:
    line = ready()
    pending = line.send()
    line.reconnect()
    line.hear(READY, WORKING)
    assert not pending.evidence.begin_count
    assert line.others == 1


def test_session_begins_without_doubt_and_without_answers_of_before() -> None:
    line = ready()
    pending = line.trigger()
    line.give_up()
    assert line.at.status_may_be_old
    line.reconnect()
    assert (line.at.status_may_be_old, line.at.judge(None).extra) == (False, False)
    line.at.on_trigger_query_answer()
    line.at.on_trigger_answer()
    line.hear(READY, WORKING)
    assert (pending.evidence.begin_count, pending.evidence.proven) == (0, False)


def test_numbers_owed_in_a_lost_session_are_known_in_the_next() -> None:
    line = ready()
    line.trigger(1000)
    line.reconnect()
    line.hear(READY)
    line.begin(2000)
    assert line.result(1000) == LATE
    assert line.result(2000) == OURS


def test_extra_container_is_not_told_over_sessions() -> None:
    line = after_one()
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
    assert interpretation.sequence_number(container, 0) == highest


@pytest.mark.parametrize("highest", sorted(set(FIELDS.values())))
def test_numbers_fit_and_do_not_come_again_soon(highest: int) -> None:
    attribution = Correlation(first_number_share=0.5)
    numbers = [attribution.take_number(highest) for _ in range(4 * FEWEST_NUMBERS)]
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
        number = attribution.take_number(highest)
        following = (number - step) % (highest + 1)
        runs = (following - number) % (highest + 1)
        assert runs == highest + 1 - step
    if highest <= 1 << 16:  # once more by counting
        first = attribution.take_number(highest)
        following = attribution.take_number(highest)
        others = itertools.takewhile(
            lambda one: one != following, (n % (highest + 1) for n in itertools.count(first + 1))
        )
        assert sum(1 for _ in others) == highest - step


def test_number_wraps_around_below_zero() -> None:
    attribution = Correlation(first_number_share=0.0)
    assert attribution.take_number(MAX_NUMBER) == MAX_NUMBER + 1 - NUMBER_STEP
    assert attribution.take_number(MAX_NUMBER) == MAX_NUMBER + 1 - 2 * NUMBER_STEP


def test_number_the_user_has_set_is_taken_once() -> None:
    attribution = Correlation(first_number_share=0.5)
    attribution.set_next_number(41)
    assert attribution.take_number(MAX_NUMBER) == 41
    assert attribution.take_number(MAX_NUMBER) != 41


def test_number_the_user_has_set_that_does_not_fit_the_field_is_not_taken() -> None:
    attribution = Correlation(first_number_share=0.5)
    attribution.set_next_number(200)
    assert 0 <= attribution.take_number(127) <= 127
    assert attribution.take_number(MAX_NUMBER) != 200


@pytest.mark.parametrize("highest", [127, MAX_NUMBER])
def test_number_the_user_has_set_may_be_the_highest(highest: int) -> None:
    attribution = Correlation(first_number_share=0.5)
    attribution.set_next_number(highest)
    assert attribution.take_number(highest) == highest


def test_number_the_user_has_set_again_while_its_result_is_owed_is_not_taken() -> None:
    line = ready()
    line.at.set_next_number(41)
    line.trigger(line.at.take_number(MAX_NUMBER))
    line.give_up()
    line.at.set_next_number(41)
    number = line.at.take_number(MAX_NUMBER)
    assert number != 41
    line.begin(number)
    assert line.result(41) == LATE
    assert line.result(number) == OURS


def test_number_of_the_last_trigger_that_the_user_has_set_again_is_not_taken() -> None:
    """A second result of that trigger may still come."""
    line = ready()
    line.at.set_next_number(41)
    line.begin(line.at.take_number(MAX_NUMBER))
    assert line.result(41) == OURS
    line.leave()
    line.at.set_next_number(41)
    assert line.at.take_number(MAX_NUMBER) != 41


def test_number_the_user_has_set_that_a_trigger_without_a_number_took_is_not_taken_again() -> None:
    """D6: its result carries that number, and may be late."""
    line = Line()
    line.at.set_next_number(500)
    line.trigger()
    line.give_up()
    assert line.at.take_number(MAX_NUMBER) != 500


def test_two_clients_begin_at_different_numbers() -> None:
    cameras = [smartcam.connect("bvs://127.0.0.1") for _ in range(5)]
    first = {inside(one)._results.correlation.take_number(MAX_NUMBER) for one in cameras}
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
    assert missing.sequence_number(nothing, 0) is None


@given(st.binary(max_size=12), st.integers(0, 3))
def test_number_of_any_bytes_is_a_number_or_none(data: bytes, endian: int) -> None:
    layout = Interpretation("n: int16 @sequence, (x: int8)*", lenient=False, y_down=False)
    number = layout.sequence_number(ResultContainer(application=7, data=data), endian)
    if endian > 1 or len(data) < 2:
        assert number is None
    else:
        order: Literal["little", "big"] = "big" if endian else "little"
        assert number == int.from_bytes(data[:2], order, signed=True)
