"""Rate control over simulated links: limits, delay and calmness."""

from __future__ import annotations

import itertools
import logging
import math
import random
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam.exceptions import ConfigurationError
from smartcam.frames import RateControl

Course = Callable[[float], float]


class Sent(NamedTuple):
    """A frame that arrived."""

    there: float
    size: int
    latency: float
    quality: int
    fps: float


class Link:
    """A source of JPEGs, a link, and a viewer that requests one frame after the other.

    Args:
        control: rate control under test.
        rate: bits a second, at a time.
        content: bytes of a frame of quality 50, at a time.
        base: latency of the link itself, seconds.
        source: frames a second.
        noise: standard deviation of the frames' sizes, relative.
        steep: exponent of the size by the quality.
    """

    def __init__(
        self,
        control: RateControl,
        rate: Course,
        *,
        content: Course = lambda _: 30_000.0,
        base: float = 0.004,
        source: float = 30.0,
        noise: float = 0.05,
        steep: float = 0.7,
    ) -> None:
        self.control, self.rate, self.content = control, rate, content
        self.base, self.period, self.noise, self.steep = base, 1 / source, noise, steep
        self.chance = random.Random(1)  # noqa: S311 - a test
        self.now = self.due = 0.0
        self.sent: list[Sent] = []

    def run(self, until: float) -> None:
        while self.now < until:
            number = math.ceil(max(self.now, self.due - self.period / 2) / self.period - 1e-9)
            went = max(self.now, number * self.period)
            quality, fps = self.control.quality, self.control.fps
            assert 10 <= quality <= 90
            steps = 50 / quality if quality < 50 else (100 - quality) / 50
            size = self.content(went) * self.chance.lognormvariate(0, self.noise)
            size = max(600, int(size / steps**self.steep))
            took = self.base + self._through(size, went + self.base)
            self.control.record_arrival(size, went, took, age=0.001)
            self.now = went + took
            self.sent.append(Sent(self.now, size, took + 0.001, quality, fps))
            self.due = max(self.due, went - self.control.pause) + self.control.pause

    def _through(self, size: int, begun: float) -> float:
        """Return the duration of a transfer, over steps of the link."""
        left, at = 8.0 * size, begun
        while (through := self.rate(at) * 0.01) < left:
            left, at = left - through, at + 0.01
        return at - begun + left / self.rate(at)

    def last(self, begin: float, end: float) -> list[Sent]:
        return [one for one in self.sent if begin < one.there <= end]

    def bitrate(self, begin: float, end: float) -> float:
        first, *others = self.last(begin, end)
        return 8 * sum(one.size for one in others) / (others[-1].there - first.there)

    def latency(self, begin: float, end: float) -> float:
        found = sorted(one.latency for one in self.last(begin, end))
        return found[len(found) // 2]

    def bounds(self, begin: float, end: float) -> set[bool]:
        """Return whether quality and frame rate are at a limit."""
        return {
            one.quality == 90 or (one.quality == 10 and one.fps == 1.0)
            for one in self.last(begin, end)
        }


def turns(values: list[float], dead: float) -> int:
    """Return the share of values that turn back by more than ``dead``."""
    count, up, extreme = 0, None, values[0]
    for value in values:
        if up is not False and value < extreme * (1 - dead):
            count, up, extreme = count + (up is True), False, value
        elif up is not True and value > extreme * (1 + dead):
            count, up, extreme = count + (up is False), True, value
        elif up is not None and (value > extreme) == up:
            extreme = value
    return count


LINKS = st.floats(1e6, 100e6)


@given(
    target=st.floats(0.3e6, 8e6),
    source=st.floats(5.0, 60.0),
    steep=st.floats(0.5, 0.9),
    content=st.floats(10e3, 100e3),
    noise=st.floats(0.0, 0.15),
)
def test_bit_rate_is_kept(
    target: float, source: float, steep: float, content: float, noise: float
) -> None:
    link = Link(
        RateControl(bitrate=target),
        lambda _: 100e6,
        content=lambda _: content,
        source=source,
        steep=steep,
        noise=noise,
    )
    link.run(20.0)
    best = link.control.statistics().reason == "at the highest quality"
    fewest = link.control.statistics().reason.endswith("fewer")
    for begin in (10.0, 15.0):
        found = link.bitrate(begin, begin + 5.0) / target
        assert found <= 1.1 or fewest
        assert found >= 0.9 or best
    assert turns([one.quality for one in link.last(10.0, 20.0)], 0.2) <= 2


@given(
    rate=LINKS,
    target=st.floats(0.03, 0.5),
    steep=st.floats(0.5, 0.9),
    content=st.floats(10e3, 100e3),
    noise=st.floats(0.0, 0.15),
    base=st.floats(0.001, 0.02),
)
def test_latency_is_kept(
    rate: float, target: float, steep: float, content: float, noise: float, base: float
) -> None:
    link = Link(
        RateControl(latency=target),
        lambda _: rate,
        content=lambda _: content,
        steep=steep,
        noise=noise,
        base=base,
    )
    link.run(20.0)
    statistics = link.control.statistics()
    for begin in (10.0, 15.0):
        found = link.latency(begin, begin + 5.0) / target
        assert found <= 1.1 or "lowest" in statistics.reason or statistics.reason.endswith("fewer")
        assert found >= 0.9 or statistics.reason == "at the highest quality"
    if statistics.quality > 11:
        assert statistics.fps == 30.0
    assert turns([one.quality for one in link.last(10.0, 20.0)], 0.2) <= 2


@given(high=st.floats(10e6, 100e6), low=st.floats(1e6, 3e6))
def test_rate_follows_a_slower_link_in_a_second_and_recovers_slowly(
    high: float, low: float
) -> None:
    link = Link(RateControl(latency=0.1), lambda at: low if 10 <= at < 20 else high)
    link.run(40.0)
    first = next(one for one in link.sent if one.there > 10.0)  # sent before or at the change
    begin = max(10.0, first.there) + 1.0
    assert all(one.latency <= 0.125 for one in link.last(begin, 20.0))
    assert 0.09 <= link.latency(15.0, 20.0) <= 0.11
    rises = [one.size for one in link.last(20.0, 40.0)]
    assert max(link.last(20.0, 20.9), key=lambda one: one.quality).size < 2.2 * rises[0]
    statistics = link.control.statistics()
    assert statistics.reason == "at the highest quality" or 0.09 <= link.latency(35.0, 40.0) <= 0.11


@given(more=st.floats(1.5, 8.0))
def test_rate_follows_larger_frames_in_a_second(more: float) -> None:
    control = RateControl(bitrate=4e6)
    link = Link(control, lambda _: 100e6, content=lambda at: 3e4 * (more if at > 10 else 1))
    link.run(20.0)
    assert 0.9 <= link.bitrate(5.0, 10.0) / 4e6 <= 1.1
    assert 0.9 <= link.bitrate(11.0, 13.0) / 4e6 <= 1.1
    assert 0.9 <= link.bitrate(15.0, 20.0) / 4e6 <= 1.1


def test_quality_goes_first_then_the_frame_rate_and_back_in_reverse(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO, "smartcam.frames")
    control = RateControl(bitrate=1e6)
    link = Link(
        control,
        lambda _: 100e6,
        noise=0.0,
        content=lambda at: 8e3 * (8.0 if 10 < at < 20 else 1.0),
    )
    link.run(10.0)
    assert control.fps == 30.0
    assert control.statistics().reason == "bit rate"
    assert not caplog.messages
    link.run(19.9)
    statistics = control.statistics()
    assert (statistics.quality, statistics.reason) == (10, "bit rate, at the lowest quality")
    assert statistics.fps < 15.0
    assert statistics.bitrate == pytest.approx(1e6, rel=0.1)
    assert f"{statistics.fps:.1f}"[:1] in caplog.messages[-1]
    link.run(40.0)
    assert control.fps == 30.0
    assert caplog.messages[-1] == "frames: at most 30 per second: bit rate"
    for one, other in itertools.pairwise(link.sent):
        assert one.quality == other.quality or 30.0 in (one.fps, other.fps)
    assert len(caplog.messages) < 15


@given(target=st.floats(0.2e6, 2e6))
def test_reported_settings_are_the_used_ones(target: float) -> None:
    control = RateControl(bitrate=target)
    link = Link(control, lambda _: 100e6, content=lambda at: 2e4 * (4.0 if 5 < at < 10 else 1.0))
    for until in np.arange(0.1, 20.0, 0.1):
        link.run(until)
        statistics = control.statistics()
        fewer = "lowest" in statistics.reason or statistics.reason.endswith("fewer")
        assert fewer or statistics.fps == 30.0
        if fewer:
            assert statistics.quality == 10


def test_latency_of_the_link_itself_does_not_stop_the_frames() -> None:
    link = Link(RateControl(latency=0.05), lambda _: 100e6, base=0.15)
    link.run(20.0)
    statistics = link.control.statistics()
    assert statistics.reason == "latency, at the lowest quality"
    assert 3.0 < statistics.fps < 12.0
    assert statistics.latency == pytest.approx(0.151, abs=0.01)


def test_lower_of_both_limits_counts() -> None:
    link = Link(RateControl(bitrate=8e6, latency=0.1), lambda at: 1.5e6 if at > 10 else 100e6)
    link.run(9.5)
    assert link.control.statistics().reason == "bit rate"
    link.run(20.0)
    assert link.control.statistics().reason == "latency"
    assert 0.09 <= link.latency(15.0, 20.0) <= 0.11


def test_limit_that_cannot_be_kept_is_reported() -> None:
    link = Link(RateControl(bitrate=1e4), lambda _: 100e6)
    link.run(10.0)
    statistics = link.control.statistics()
    assert (statistics.quality, statistics.fps) == (10, 1.0)
    assert statistics.reason == "bit rate, at the lowest quality and frame rate"


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({}, "neither"),
        ({"bitrate": 0}, "bitrate"),
        ({"bitrate": math.nan}, "bitrate"),
        ({"latency": -1}, "latency"),
        ({"latency": 0.1, "quality": (50, 40)}, "quality"),
        ({"latency": 0.1, "quality": (0, 40)}, "quality"),
        ({"latency": 0.1, "quality": (10, 101)}, "quality"),
        ({"latency": 0.1, "fps": (0.0, 30.0)}, "fps"),
        ({"latency": 0.1, "fps": (30.0, 1.0)}, "fps"),
    ],
)
def test_values_out_of_range_are_refused(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigurationError, match=named):
        RateControl(**options)
