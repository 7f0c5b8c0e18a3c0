"""The messages that an agent keeps, and their order at a program: each number once."""

from __future__ import annotations

from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from tests.fleet.inside import AgentLog, Feed


class Things(NamedTuple):
    """Some things with consecutive numbers; each is what its agent's epoch and its number say."""

    epoch: int
    number: int
    next: int

    @property
    def size(self) -> int:
        return 10 * (self.next - self.number)

    def since(self, number: int) -> Things:
        return self._replace(number=max(number, self.number))

    @classmethod
    def read(cls, data: bytes) -> Things:
        epoch, number, following = map(int, data.split())
        return cls(epoch, number, following)

    @property
    def data(self) -> bytes:
        return b"%d %d %d" % self


# ---------------------------------------------------------------------- the log


def kept(log: AgentLog, first: int = 1, most_bytes: int = 1 << 20) -> list[int]:
    """Return the numbers that a part of a log has."""
    part = log.read_part(first, most_bytes)
    things = [Things.read(one) for one in part.data]
    return [number for one in things for number in range(one.number, one.next)]


def add(log: AgentLog, count: int, clock: float = 0.0) -> None:
    log.add(count, clock, Things(1, log.next_number, log.next_number + count).data)


@given(
    counts=st.lists(st.integers(1, 9), max_size=60),
    most=st.integers(1, 40),
    most_bytes=st.integers(1, 400),
)
def test_log_keeps_the_last_without_a_gap_and_within_its_bounds(
    counts: list[int], most: int, most_bytes: int
) -> None:
    log = AgentLog(most, most_bytes)
    sizes: list[tuple[int, int]] = []  # things and bytes of each entry
    for count in counts:
        before = log.next_number
        add(log, count)
        sizes.append((count, len(Things(1, before, before + count).data)))
        numbers = kept(log)
        assert numbers == [*range(log.first, log.next_number)]
        entries = len(log._entries)
        things, size = (sum(column) for column in zip(*sizes[-entries:], strict=True))
        assert log._bytes == size
        # what goes beyond the bounds is part of an entry, or one alone
        assert entries == 1 or (size <= most_bytes and things - sizes[-entries][0] < most)
        if size <= most_bytes:  # and nothing goes that has room
            assert len(numbers) >= min(most, log.next_number - 1) or entries < len(sizes)
    assert log.next_number == 1 + sum(counts)


def test_log_of_as_many_results_as_it_may_has_them_all() -> None:
    log = AgentLog(10, 1 << 20)
    for _ in range(1000):
        add(log, 1)
    assert kept(log) == [*range(991, 1001)]


@given(counts=st.lists(st.integers(1, 5), min_size=1, max_size=20), first=st.integers(-5, 120))
def test_part_begins_where_it_is_asked_to_or_says_where(counts: list[int], first: int) -> None:
    log = AgentLog(30, 1 << 20)
    for count in counts:
        add(log, count)
    part = log.read_part(first, 1 << 20)
    numbers = kept(log, first)
    assert part.next_number == log.next_number
    assert part.first == max(first, log.first)
    if first < log.next_number:
        assert numbers[0] <= part.first  # an entry comes whole
        assert numbers == [*range(numbers[0], log.next_number)]
    else:
        assert numbers == []


@given(most_bytes=st.integers(0, 100), first=st.integers(1, 20))
def test_part_is_as_much_as_fits_and_one_at_least(most_bytes: int, first: int) -> None:
    log = AgentLog(100, 1 << 20)
    for _ in range(20):
        add(log, 1)
    data = log.read_part(first, most_bytes).data
    assert len(data) == 1 or sum(map(len, data)) <= most_bytes
    asked, got = first, [*range(1, first)]
    while asked < log.next_number:  # in steps, everything comes
        more = kept(log, asked, most_bytes)
        got += more
        asked = more[-1] + 1
    assert got == [*range(1, 21)]


@pytest.mark.parametrize(
    ("clock", "first"), [(0.0, 1), (1.0, 1), (1.5, 4), (2.0, 4), (3.0, 7), (3.1, 10)]
)
def test_first_since_a_time(clock: float, first: int) -> None:
    log = AgentLog(100, 1 << 20)
    assert log.first_since(clock) == 1
    for at in (1.0, 2.0, 3.0):
        add(log, 3, at)
    assert log.first_since(clock) == first


# ---------------------------------------------------------------------- the feed


class Ear:
    """A feed, with all that it has to do with, by hand."""

    def __init__(self, max_held_bytes: int = 1 << 20) -> None:
        self.taken: list[tuple[int, int]] = []
        self.missed = 0
        self.asked = 0
        self.feed: Feed[Things] = Feed(
            self.take, self.miss, self.lack, max_held_bytes=max_held_bytes
        )

    def take(self, things: Things) -> None:
        self.taken += [(things.epoch, number) for number in range(things.number, things.next)]

    def miss(self, count: int, then: Things | None) -> None:
        assert count > 0
        assert then is None or then.number <= self.feed.expected + count <= then.next
        self.missed += count

    def lack(self) -> None:
        self.asked += 1

    @property
    def numbers(self) -> list[int]:
        return [number for _, number in self.taken]


def said(*numbers: int, epoch: int = 1) -> list[Things]:
    return [Things(epoch, number, number + 1) for number in numbers]


def test_feed_takes_nothing_before_it_is_said_where_to_begin() -> None:
    ear = Ear()
    ear.feed.receive(1, 8, said(5, 6, 7))
    assert ear.taken == []
    ear.feed.begin(1, 6, 8)
    assert (ear.numbers, ear.feed.has_gap, ear.missed) == ([6, 7], False, 0)


def test_gap_is_filled_in_order() -> None:
    ear = Ear()
    ear.feed.begin(1, 1, 1)
    ear.feed.receive(1, 4, said(3))
    ear.feed.receive(1, 5, said(4))
    assert (ear.taken, ear.feed.has_gap, ear.asked) == ([], True, 1)
    ear.feed.fill(1, 1, 5, said(1, 2))
    assert (ear.numbers, ear.feed.has_gap, ear.missed) == ([1, 2, 3, 4], False, 0)


def test_what_the_agent_no_longer_has_was_missed() -> None:
    ear = Ear()
    ear.feed.begin(1, 1, 1)
    ear.feed.receive(1, 11, [])
    ear.feed.fill(1, 8, 11, said(8, 9, 10))
    assert (ear.numbers, ear.missed, ear.feed.has_gap) == ([8, 9, 10], 7, False)


def test_agent_that_has_nothing_to_show_is_not_asked_for_ever() -> None:
    ear = Ear()
    ear.feed.begin(1, 1, 1)
    ear.feed.receive(1, 5, [])
    ear.feed.fill(1, 1, 5, [])
    assert (ear.missed, ear.feed.expected, ear.feed.has_gap) == (4, 5, False)


def test_last_one_is_missed_when_its_number_is_told_again() -> None:
    ear = Ear()
    ear.feed.begin(1, 1, 1)
    ear.feed.receive(1, 2, [])  # the reminder
    assert ear.feed.has_gap


def test_new_epoch_waits_for_its_beginning_and_the_old_one_is_over() -> None:
    ear = Ear()
    ear.feed.begin(1, 1, 1)
    ear.feed.receive(1, 3, said(1, 2))
    ear.feed.receive(2, 2, said(1, epoch=2))
    ear.feed.receive(1, 4, said(3))
    ear.feed.begin(2, 1, 2)
    ear.feed.receive(1, 5, said(4))
    assert ear.taken == [(1, 1), (1, 2), (1, 3), (2, 1)]
    ear.feed.fill(1, 9, 9, [])  # an answer to what was asked before
    assert (ear.feed.expected, ear.missed) == (2, 0)


def test_what_waits_is_bounded_and_comes_all_the_same() -> None:
    ear = Ear(max_held_bytes=100)
    ear.feed.begin(1, 1, 1)
    for number in range(2, 1000):
        ear.feed.receive(1, number + 1, said(number))
        assert len(ear.feed._held) <= 10
    ear.feed.fill(1, 1, 1000, said(1))
    assert ear.feed.has_gap
    ear.feed.fill(1, ear.feed.expected, 1000, said(*range(ear.feed.expected, 1000)))
    assert (ear.numbers, ear.missed) == ([*range(1, 1000)], 0)


def test_stopped_feed_takes_nothing() -> None:
    ear = Ear()
    ear.feed.begin(1, 1, 1)
    ear.feed.receive(1, 4, said(3))
    ear.feed.stop()
    ear.feed.fill(1, 1, 5, said(1, 2))
    assert (ear.taken, ear.missed, ear.feed.has_gap) == ([], 0, False)


def alternating() -> Ear:
    """An ear for agents that have a camera by turns."""
    ear = Ear()
    ear.feed = Feed(ear.take, ear.miss, ear.lack, resumes_epochs=True)
    return ear


def test_agent_that_comes_again_goes_on_where_it_was() -> None:
    ear = alternating()
    ear.feed.begin(1, 1, 1)
    ear.feed.receive(1, 3, said(1, 2))
    ear.feed.begin(2, 1, 1)
    ear.feed.receive(2, 2, said(1, epoch=2))
    ear.feed.begin(1, 1, 4)  # its log has all of them yet
    ear.feed.fill(1, 3, 4, said(3))
    assert ear.taken == [(1, 1), (1, 2), (2, 1), (1, 3)]
    assert ear.missed == 0


def test_what_an_agent_had_said_is_missed_when_another_goes_on() -> None:
    ear = alternating()
    ear.feed.begin(1, 1, 1)
    ear.feed.receive(1, 2, said(1))
    ear.feed.receive(1, 9, said(4, 5))  # 2 and 3 are missing, and it says that there is an 8
    ear.feed.begin(2, 1, 1)
    assert ear.taken == [(1, 1), (1, 4), (1, 5)]
    assert ear.missed == 2 + 3
    ear.feed.begin(1, 1, 9)
    assert not ear.feed.has_gap


def test_what_is_said_before_an_agent_s_turn_is_asked_for() -> None:
    ear = alternating()
    ear.feed.begin(2, 1, 1)
    ear.feed.receive(1, 7, said(5, 6))  # by one that was started before
    ear.feed.begin(1, 5, 5)  # as it had answered before that
    assert ear.feed.has_gap
    ear.feed.fill(1, 5, 7, said(5, 6))
    assert (ear.taken, ear.missed) == ([(1, 5), (1, 6)], 0)


class Hearing(RuleBasedStateMachine):
    """An agent that speaks, forgets and is restarted; a bus that loses, doubles and mixes up.

    What its program took and what it knows to have missed is what was said, always.
    """

    def __init__(self) -> None:
        super().__init__()
        self.ear = Ear(max_held_bytes=120)
        self.epoch = 1
        self.log = AgentLog(12, 1 << 20)
        self.way: list[tuple[int, int, list[Things]]] = []  # said, and not heard yet
        self.answers: list[tuple[int, int, int, list[Things]]] = []
        self.known: dict[int, int] = {}  # numbers of each epoch that are accounted for
        self.ear.feed.begin(self.epoch, 1, 1)

    @rule(counts=st.lists(st.integers(1, 4), min_size=1, max_size=4))
    def speak(self, counts: list[int]) -> None:
        fresh: list[Things] = []
        for count in counts:
            first = self.log.next_number
            fresh.append(Things(self.epoch, first, first + count))
            self.log.add(count, 0.0, fresh[-1].data)
        self.way.append((self.epoch, self.log.next_number, fresh))

    @rule()
    def remind(self) -> None:
        self.way.append((self.epoch, self.log.next_number, []))

    @precondition(lambda self: self.way)
    @rule(data=st.data())
    def hear(self, data: st.DataObject) -> None:
        place = data.draw(st.integers(0, len(self.way) - 1))
        fate = data.draw(st.sampled_from(("heard", "heard", "heard", "lost", "doubled")))
        message = self.way[place] if fate == "doubled" else self.way.pop(place)
        if fate != "lost":
            self.ear.feed.receive(*message)

    @rule()
    def ask(self) -> None:
        feed = self.ear.feed
        if feed.has_gap and feed.expected and feed.epoch == self.epoch:
            part = self.log.read_part(feed.expected, 25)
            things = [Things.read(one) for one in part.data]
            self.answers.append((self.epoch, part.first, part.next_number, things))

    @precondition(lambda self: self.answers)
    @rule(lost=st.booleans())
    def answer(self, lost: bool) -> None:
        answer = self.answers.pop(0)
        if not lost:
            self.ear.feed.fill(*answer)

    @rule()
    def restart(self) -> None:
        """Restart the agent: what the program had not heard of the old one, nobody has."""
        self.ear.feed.interrupt()
        self.epoch, self.log = self.epoch + 1, AgentLog(12, 1 << 20)

    @precondition(lambda self: self.ear.feed.epoch != self.epoch)
    @rule()
    def meet(self) -> None:
        self.settle_epoch()

    def settle_epoch(self) -> None:
        feed = self.ear.feed
        if feed.epoch != self.epoch:
            feed.begin(self.epoch, 1, self.log.next_number)

    @invariant()
    def each_once_and_in_order(self) -> None:
        assert self.ear.taken == sorted(set(self.ear.taken))

    @invariant()
    def nothing_is_lost_unseen(self) -> None:
        feed = self.ear.feed
        self.known[feed.epoch] = feed.expected - 1
        assert len(self.ear.taken) + self.ear.missed == sum(self.known.values())

    @invariant()
    def what_waits_is_bounded(self) -> None:
        assert sum(one.size for one in self.ear.feed._held) <= 120
        assert sum(one.size for one in self.ear.feed._held) == self.ear.feed._held_bytes

    def teardown(self) -> None:
        feed = self.ear.feed
        self.settle_epoch()
        feed.receive(self.epoch, self.log.next_number, [])
        for _ in range(1000):
            if not feed.has_gap:
                break
            part = self.log.read_part(feed.expected, 25)
            feed.fill(self.epoch, part.first, part.next_number, [*map(Things.read, part.data)])
        assert (feed.has_gap, feed.expected) == (False, self.log.next_number)
        self.nothing_is_lost_unseen()
        self.each_once_and_in_order()


Hearing.TestCase.settings = settings(stateful_step_count=60)
TestHearing = Hearing.TestCase
