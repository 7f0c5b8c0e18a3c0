"""Whose result is it: every branch by a table."""

from __future__ import annotations

import itertools
from typing import Any, Literal

import pytest
from attribution_line import RAW, READY, WORKING, Line, shown
from hypothesis import given
from hypothesis import strategies as st

from smartcam import Status
from smartcam.attribution import (
    FEWEST_NUMBERS,
    MAX_OWED,
    NUMBER_STEP,
    Attribution,
    Debt,
    Verdict,
)
from smartcam.interpretation import MAX_NUMBER, Interpretation
from smartcam.protocols.messages import ResultContainer

OURS = Verdict("triggered")
LATE = Verdict("late")
STREAMED = Verdict("streamed")
NOBODY = Verdict("nobody")
EXTRA = Verdict("nobody", extra=True)


# ---------------------------------------------------------------------- without a number


def test_container_without_a_trigger_is_nobodys() -> None:
    assert Line().result() == NOBODY


@pytest.mark.parametrize("ordered", [True, False])
def test_container_after_a_trigger_is_its_own(*, ordered: bool) -> None:
    line = Line(ordered=ordered)
    line.trigger()
    assert line.result() == OURS


def test_container_before_waiting_drops_is_older_where_the_camera_drops_it() -> None:
    line = shown()
    line.trigger()
    assert line.result().fate == "nobody"
    line.hear(WORKING)
    assert line.result() == OURS


def test_container_before_waiting_drops_is_taken_over_udp_where_a_status_may_be_lost() -> None:
    line = shown(ordered=False)
    line.trigger()
    assert line.result() == OURS


def test_container_is_taken_where_waiting_was_never_seen_to_drop() -> None:
    line = Line()
    line.hear(READY)
    for _ in range(3):
        line.trigger()
        assert line.result() == OURS
        line.leave()


@pytest.mark.parametrize("debt", ["late", "streamed"])
def test_container_after_a_trigger_was_given_up_pays_its_debt_once(debt: Debt) -> None:
    line = Line()
    line.trigger()
    line.give_up(debt)
    assert line.at.debt == debt
    assert line.result() == Verdict(debt)
    assert line.at.debt is None
    assert line.result() == NOBODY


def test_container_of_a_trigger_whose_caller_was_not_woken_yet_is_late() -> None:
    line = Line()
    pending = line.trigger()
    pending.outcome.cancel()
    assert line.result() == LATE


def test_trigger_given_up_twice_keeps_its_first_fate() -> None:
    line = Line()
    pending = line.trigger()
    line.at.give_up(pending, "streamed")
    line.give_up("late")
    assert line.at.debt == "streamed"


def test_trigger_that_has_its_results_owes_nothing() -> None:
    line = Line()
    line.trigger()
    line.result()
    line.give_up()
    assert line.at.debt is None


def test_settled_means_that_nothing_of_before_can_come() -> None:
    line = Line()
    line.trigger()
    line.give_up()
    line.at.unsettled = True
    line.at.settled()
    assert (line.at.debt, line.at.unsettled) == (None, False)
    assert line.result() == NOBODY


# ---------------------------------------------------------------------- more than one result

ORDERS = {
    "result, result, waiting": ["result", "result", READY],
    "waiting, result, result": [READY, "result", "result"],
    "result, waiting, result": ["result", READY, "result"],
}


@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS.keys())
def test_second_container_of_one_trigger_is_extra_in_each_order(order: list[Any]) -> None:
    line = Line()
    line.hear(READY)
    line.trigger()
    line.hear(WORKING)
    verdicts: list[Verdict] = []
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
    assert pending.outcome.done()


def test_several_results_are_all_the_triggers() -> None:
    line = Line()
    line.trigger(wanted=3)
    assert [line.result() for _ in range(5)] == [OURS, OURS, OURS, EXTRA, EXTRA]


def test_container_of_somebody_elses_inspection_is_not_extra() -> None:
    line = shown()
    line.hear(WORKING)
    assert line.result() == NOBODY


# ---------------------------------------------------------------------- somebody else's


def test_inspection_of_somebody_else_unsettles() -> None:
    line = shown()
    assert not line.at.unsettled
    line.hear(WORKING)
    assert line.at.unsettled


@pytest.mark.parametrize("status", [Status(0), Status.BUSY, READY, READY | Status.BUSY])
def test_status_that_begins_no_inspection_unsettles_nothing(status: Status) -> None:
    line = shown()
    line.hear(status)
    assert not line.at.unsettled


def test_status_that_goes_on_working_unsettles_nothing() -> None:
    line = shown()
    line.at.unsettled = False
    line.status = WORKING
    line.hear(WORKING | Status.OVERHEAT)
    assert not line.at.unsettled


def test_session_that_begins_with_a_working_camera_is_unsettled() -> None:
    line = Line()
    line.hear(WORKING)
    assert line.at.unsettled


def test_inspection_that_owes_us_a_result_unsettles_nothing() -> None:
    line = Line()
    line.hear(READY)
    line.trigger()
    line.give_up()
    line.hear(WORKING)
    assert not line.at.unsettled
    assert line.result() == LATE


def test_own_inspection_unsettles_nothing() -> None:
    line = Line()
    line.hear(READY)
    line.trigger()
    line.hear(WORKING)
    assert not line.at.unsettled


# ---------------------------------------------------------------------- with a number


@pytest.mark.parametrize("ordered", [True, False])
def test_container_with_the_triggers_number_is_its_own_in_any_order(*, ordered: bool) -> None:
    line = shown(ordered=ordered)
    line.trigger(5000)
    assert line.result(5000) == OURS


def test_container_with_another_number_is_nobodys() -> None:
    line = Line()
    line.trigger(5000)
    assert line.result(4999) == NOBODY
    assert line.result(5001) == NOBODY
    assert line.result(5000) == OURS


@pytest.mark.parametrize("debt", ["late", "streamed"])
def test_container_with_the_number_of_a_trigger_given_up_is_known(debt: Debt) -> None:
    line = Line()
    line.trigger(1000)
    line.give_up(debt)
    line.trigger(2000)
    assert line.result(1000) == Verdict(debt)
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
    line.trigger(1000)
    line.result(1000)
    line.leave()
    line.trigger(2000)
    assert line.result(1000) == EXTRA
    assert line.result(2000) == OURS


def test_container_without_a_number_is_judged_by_the_order() -> None:
    line = shown()
    line.trigger(5000)
    assert line.result(None).fate == "nobody"
    line.hear(WORKING)
    assert line.result(None) == OURS


def test_container_without_a_number_pays_a_debt() -> None:
    line = Line()
    line.trigger(1000)
    line.give_up()
    assert line.result(None) == LATE


def test_container_with_a_number_pays_the_debt_of_a_trigger_without() -> None:
    line = Line()
    line.trigger(1000)
    line.result(1000)
    line.leave()
    line.trigger()
    line.give_up()
    assert line.result(1001) == LATE


def test_numbering_is_that_of_the_last_trigger_with_a_number() -> None:
    line = Line()
    line.trigger()
    assert line.at.numbering is None
    line.trigger(1000)
    line.trigger()
    assert line.at.numbering is RAW


def test_numbers_owed_are_bounded_and_the_oldest_are_forgotten() -> None:
    line = Line()
    for number in range(MAX_OWED + 10):
        line.trigger(number)
        line.give_up()
    assert len(line.at._owed) == MAX_OWED
    assert line.result(9) == NOBODY
    assert line.result(10) == LATE


# ---------------------------------------------------------------------- over sessions


def test_trigger_of_a_lost_session_is_owed_in_the_next() -> None:
    line = shown()
    line.trigger()
    line.reconnect()
    line.hear(WORKING)
    assert line.result() == LATE


def test_numbers_owed_in_a_lost_session_are_known_in_the_next() -> None:
    line = Line()
    line.trigger(1000)
    line.reconnect()
    line.trigger(2000)
    assert line.result(1000) == LATE
    assert line.result(2000) == OURS


def test_extra_container_is_not_told_over_sessions() -> None:
    line = Line()
    line.trigger()
    line.result()
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
    attribution = Attribution()
    numbers = [attribution.take_number(highest) for _ in range(4 * FEWEST_NUMBERS)]
    assert all(0 <= number <= highest for number in numbers)
    for first in range(len(numbers) - FEWEST_NUMBERS):
        assert len(set(numbers[first : first + FEWEST_NUMBERS])) == FEWEST_NUMBERS
    steps = {(b - a) % (highest + 1) for a, b in itertools.pairwise(numbers)}
    assert min(steps) >= min(NUMBER_STEP, (highest + 1) // FEWEST_NUMBERS)


def test_number_wraps_around_at_the_highest() -> None:
    attribution = Attribution()
    attribution._turn = MAX_NUMBER // NUMBER_STEP
    around = attribution.take_number(MAX_NUMBER)
    assert around == NUMBER_STEP - (MAX_NUMBER + 1) % NUMBER_STEP
    assert attribution.take_number(MAX_NUMBER) == around + NUMBER_STEP


def test_number_the_user_has_set_is_taken_once() -> None:
    attribution = Attribution()
    attribution.give_number(41)
    assert attribution.take_number(MAX_NUMBER) == 41
    assert attribution.take_number(MAX_NUMBER) != 41


def test_number_the_user_has_set_that_does_not_fit_the_field_is_not_taken() -> None:
    attribution = Attribution()
    attribution.give_number(200)
    assert 0 <= attribution.take_number(127) <= 127
    assert attribution.take_number(MAX_NUMBER) != 200


def test_number_the_user_has_set_again_while_its_result_is_owed_is_not_taken() -> None:
    line = Line()
    line.at.give_number(41)
    line.trigger(line.at.take_number(MAX_NUMBER))
    line.give_up()
    line.at.give_number(41)
    number = line.at.take_number(MAX_NUMBER)
    line.trigger(number)
    assert line.result(41) == LATE
    assert line.result(number) == OURS


def test_two_clients_begin_at_different_numbers() -> None:
    assert len({Attribution().take_number(MAX_NUMBER) for _ in range(5)}) > 1


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
