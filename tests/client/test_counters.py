"""Counters of a client: times in bins, and wire counters over sessions."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam._client._inside import ClientCounters
from smartcam._client.counters import Times
from smartcam.models import HISTOGRAM_BOUNDS, Histogram, SubscriberStatistics
from smartcam.protocols._inside import Counters

SECONDS = st.one_of(st.floats(0, 100), st.sampled_from(HISTOGRAM_BOUNDS), st.just(0.0))


def histogram_of(*seconds: float) -> Histogram:
    times = Times()
    for one in seconds:
        times.add(one)
    return times.histogram()


# ---------------------------------------------------------------------- times


def test_histogram_of_nothing_has_no_shortest_and_no_longest() -> None:
    histogram = histogram_of()
    assert (histogram.count, histogram.total) == (0, 0.0)
    assert (histogram.shortest, histogram.longest) == (None, None)
    assert len(histogram.counts) == len(histogram.bounds) + 1


def test_histogram_bounds_are_three_in_a_decade() -> None:
    assert HISTOGRAM_BOUNDS[:4] == (0.0001, 0.0002, 0.0005, 0.001)
    assert HISTOGRAM_BOUNDS[-3:] == (10.0, 20.0, 50.0)
    assert len(HISTOGRAM_BOUNDS) == 18


@pytest.mark.parametrize(
    ("seconds", "place"), [(0.0, 0), (0.0001, 0), (0.00011, 1), (0.001, 3), (50.0, 17), (51.0, 18)]
)
def test_time_falls_into_the_bin_whose_upper_bound_it_does_not_pass(
    seconds: float, place: int
) -> None:
    counts = histogram_of(seconds).counts
    assert (counts.index(1), sum(counts)) == (place, 1)


@given(st.lists(SECONDS, max_size=60))
def test_histogram_is_numpys(seconds: list[float]) -> None:
    histogram = histogram_of(*seconds)
    # numpy's bins have their lower edge, ours the upper one: so both are mirrored
    edges = np.array([-np.inf, *(-bound for bound in reversed(HISTOGRAM_BOUNDS)), np.inf])
    counts, _ = np.histogram([-one for one in seconds], bins=edges)
    assert list(histogram.counts) == list(reversed(counts.tolist()))
    assert histogram.count == len(seconds)
    assert histogram.total == pytest.approx(sum(seconds))
    assert histogram.shortest == min(seconds, default=None)
    assert histogram.longest == max(seconds, default=None)


def test_histogram_once_taken_does_not_change() -> None:
    times = Times()
    times.add(1.0)
    before = times.histogram()
    times.add(2.0)
    assert (before.count, before.longest) == (1, 1.0)
    assert (times.histogram().count, times.histogram().total) == (2, 3.0)


# ---------------------------------------------------------------------- over sessions

COUNTERS = st.builds(
    Counters, **{field.name: st.integers(0, 1 << 40) for field in dataclasses.fields(Counters)}
)
OF_THE_WIRE = {
    **{field.name: field.name for field in dataclasses.fields(Counters)},
    "ignored_frames": "ignored_datagrams",
}


def wire_of(account: ClientCounters) -> dict[str, int]:
    statistics = account.statistics([])
    return {name: getattr(statistics, told) for name, told in OF_THE_WIRE.items()}


def test_account_of_a_client_that_was_never_connected_is_empty() -> None:
    statistics = ClientCounters().statistics([])
    assert (statistics.sessions, statistics.reconnects, statistics.received) == (0, 0, 0)
    assert statistics.last_error is None
    assert statistics.subscribers == []
    assert set(wire_of(ClientCounters()).values()) == {0}


def test_session_open_is_counted_as_it_goes() -> None:
    account, wire = ClientCounters(), Counters()
    account.begin_session(wire)
    assert account.statistics([]).frames_received == 0
    wire.frames_received += 3
    assert account.statistics([]).frames_received == 3


def test_reconnects_are_the_sessions_after_the_first() -> None:
    account = ClientCounters()
    for sessions in range(1, 4):
        account.begin_session(Counters())
        statistics = account.statistics([])
        assert (statistics.sessions, statistics.reconnects) == (sessions, sessions - 1)


def test_session_that_ended_counts_no_more() -> None:
    account, wire = ClientCounters(), Counters(bytes_sent=5)
    account.begin_session(wire)
    account.end_session()
    wire.bytes_sent += 1000
    assert account.statistics([]).bytes_sent == 5
    account.end_session()  # twice is the same as once
    assert account.statistics([]).bytes_sent == 5


@given(links=st.lists(COUNTERS, max_size=5), ended=st.booleans())
def test_counters_of_all_sessions_are_added_up(links: list[Counters], *, ended: bool) -> None:
    account = ClientCounters()
    for wire in links:
        account.begin_session(wire)
    if ended:
        account.end_session()
    total = {name: sum(getattr(wire, name) for wire in links) for name in OF_THE_WIRE}
    assert wire_of(account) == total
    assert wire_of(account) == total  # asking changes nothing
    assert account.statistics([]).sessions == len(links)


# ---------------------------------------------------------------------- what is told


def test_statistics_tell_fates_counts_times_and_subscribers() -> None:
    account = ClientCounters()
    account.received = 3
    account.fates.update({"triggered": 2, "late": 1})
    account.empty_slots, account.extra_results, account.overtriggers = 4, 5, 6
    account.last_error = "gone"
    account.round_trip.add(0.25)
    account.processing.add(0.5)
    one = SubscriberStatistics(
        name="results", policy="drop_oldest", offered=3, taken=1, dropped=1, queued=1
    )
    statistics = account.statistics(iter([one]))
    assert (statistics.received, statistics.triggered, statistics.late) == (3, 2, 1)
    assert (statistics.streamed, statistics.unclaimed, statistics.uninterpretable) == (0, 0, 0)
    assert (statistics.empty_slots, statistics.extra_results, statistics.overtriggers) == (4, 5, 6)
    assert statistics.last_error == "gone"
    assert (statistics.round_trip.longest, statistics.processing.longest) == (0.25, 0.5)
    assert statistics.subscribers == [one]


def test_fate_that_does_not_exist_is_a_mistake() -> None:
    account = ClientCounters()
    with pytest.raises(KeyError, match="lost"):
        account.count("lost")
    assert account.statistics([]).received == 0
