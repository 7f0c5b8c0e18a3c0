"""The places at a port and who keeps one, without sockets and clocks."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam._accepting import Places, is_loopback, share_of


class Guest:
    """A connection, as the policy sees it."""

    def __init__(self, *, keeps_place: bool = False) -> None:
        self.keeps_place = keeps_place
        self.why = ""

    def close_for(self, why: str) -> None:
        assert not self.why
        assert not self.keeps_place, "one with a session was turned away"
        self.why = why


def full(count: int, peer: str = "127.0.0.1", most: int = 0) -> tuple[Places[Guest], list[Guest]]:
    """Return places that are all taken, or as many of ``most``."""
    places: Places[Guest] = Places(most or count, timeout=10)
    guests = [Guest() for _ in range(count)]
    for moment, one in enumerate(guests):
        assert places.enter(one, peer, moment) == ""
    return places, guests


def test_the_one_without_a_session_for_longest_makes_room() -> None:
    places, guests = full(3)
    guests[0].keeps_place = True
    assert places.enter(newcomer := Guest(), "127.0.0.1", 3) == ""
    assert guests[1].why == "3 others are open, it was without a session for longest"
    assert list(places) == [guests[0], guests[2], newcomer]
    assert places.crowded_out == 1


def test_who_had_a_session_makes_room_last() -> None:
    places, guests = full(3)
    places.restart_idle_time(guests[0], 5)
    places.enter(Guest(), "127.0.0.1", 6)
    places.enter(Guest(), "127.0.0.1", 7)
    assert [bool(one.why) for one in guests] == [False, True, True]


def test_where_each_has_a_session_the_newcomer_has_no_place() -> None:
    places, guests = full(2)
    for one in guests:
        one.keeps_place = True
    newcomer = Guest()
    assert places.enter(newcomer, "127.0.0.1", 3) == "2 others are open, and each has a session"
    assert newcomer not in places
    assert places.crowded_out == 1


def test_one_address_has_three_quarters_and_its_own_make_room() -> None:
    places, guests = full(6, "10.0.0.1", 8)
    assert share_of(8) == 6
    assert places.enter(Guest(), "10.0.0.2", 7) == ""
    assert places.enter(Guest(), "10.0.0.1", 8) == ""
    assert guests[0].why == "6 others of 10.0.0.1 are open, it was without a session for longest"
    for one in guests:
        one.keeps_place = not one.why
    places.enter(Guest(keeps_place=True), "10.0.0.3", 9)
    for one in list(places):
        one.keeps_place = True
    assert places.enter(Guest(), "10.0.0.1", 10).startswith("8 others")


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "::ffff:127.0.0.1", "127.1.2.3"])
def test_programs_of_this_machine_may_have_all_places(host: str) -> None:
    places, guests = full(4, host)
    assert is_loopback(host)
    assert len(places) == 4
    assert not any(one.why for one in guests)


def test_time_without_a_session_is_bounded() -> None:
    places, guests = full(3)  # at 0, 1, 2; each for 10
    guests[1].keeps_place = True
    assert places.next_deadline() == 10
    places.end_overdue(11.5)
    assert guests[0].why == "no session within 10 s"
    assert [bool(one.why) for one in guests] == [True, False, False]
    guests[1].keeps_place = False
    places.end_overdue(20)
    assert guests[2].why
    assert not guests[1].why  # its time began anew when it was looked at
    places.end_overdue(21.5)
    assert guests[1].why
    assert places.next_deadline() == math.inf


def test_what_is_expected_can_be_set_and_be_nothing() -> None:
    places, (one, two) = full(2)
    places.set_time_limit(one, None, "", 2)
    places.set_time_limit(two, 3, "no end of a body", 2)
    assert places.next_deadline() == 5
    places.end_overdue(1e9)
    assert (one.why, two.why) == ("", "no end of a body within 3 s")
    places.set_time_limit(two, 1, "", 2)  # it is gone: harmless


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["enter", "settle", "unsettle", "leave", "wait"]),
            st.integers(0, 30),
            st.sampled_from(["127.0.0.1", "10.0.0.1", "10.0.0.2"]),
        ),
        max_size=80,
    )
)
def test_bounds_hold_whatever_happens(steps: list[tuple[str, int, str]]) -> None:
    places: Places[Guest] = Places(8, timeout=10)
    there: list[tuple[Guest, str]] = []
    now = 0.0
    for what, number, peer in steps:
        now += 0.1
        if what == "enter":
            newcomer = Guest()
            unsettled = [one for one, _ in there if not one.keeps_place]
            refusal = places.enter(newcomer, peer, now)
            if not refusal:
                there.append((newcomer, peer))
            elif unsettled:
                assert f"of {peer}" in refusal  # others may not make room for it
        elif what == "wait":
            now += number
            places.end_overdue(now)
            assert places.next_deadline() > now
        elif there:
            one, _ = there[number % len(there)]
            if what == "leave":
                places.leave(one)
                there = [row for row in there if row[0] is not one]
            else:
                one.keeps_place = what == "settle"
                places.restart_idle_time(one, now)
        there = [row for row in there if not row[0].why]
        assert set(places) == {one for one, _ in there}
        assert len(places) <= 8
        for host in ("10.0.0.1", "10.0.0.2"):
            assert sum(peer == host for _, peer in there) <= share_of(8)
