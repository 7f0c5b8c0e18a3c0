"""Bounded streams and their account."""

from __future__ import annotations

import asyncio
import gc
import sys
import weakref
from collections.abc import Callable
from types import FrameType
from typing import Any

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from smartcam.exceptions import (
    ConfigurationError,
    ConnectionLostError,
    InterpretationError,
    SmartCamError,
    SubscriberOverflowError,
)
from smartcam.models import SubscriberStatistics
from smartcam.streams import BatchSubscription, Overflow, Queue, Subscribers, Subscription


def subscription(
    max_queue: int = 3, overflow: str = "drop_oldest", min_interval: float = 0.0, **more: Any
) -> Subscription[int]:
    return Subscription(
        "results", max_queue=max_queue, overflow=overflow, min_interval=min_interval, **more
    )


def batches(
    max_queue: int = 9, overflow: str = "drop_oldest", min_interval: float = 0.0, **more: Any
) -> BatchSubscription[int]:
    return BatchSubscription(
        "results", max_queue=max_queue, overflow=overflow, min_interval=min_interval, **more
    )


def account(stream: Queue[int]) -> tuple[int, int, int, int]:
    """Return offered, taken, dropped, queued."""
    seen = stream.statistics()
    assert seen.offered == seen.taken + seen.dropped + seen.queued
    return seen.offered, seen.taken, seen.dropped, seen.queued


async def take(stream: Subscription[int], count: int) -> list[int]:
    return [await anext(stream) for _ in range(count)]


async def waiting(stream: Subscription[int]) -> asyncio.Task[int]:
    """Return a task that waits for the next item."""
    task = asyncio.create_task(anext(stream))
    await asyncio.sleep(0)
    assert not task.done()
    return task


# ---------------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"max_queue": 0}, "max_queue: expected an integer, 1 or more, got 0"),
        ({"min_interval": -0.1}, "min_interval: expected seconds, 0 to 1e+09, got -0.1"),
        ({"min_interval": float("inf")}, "got inf"),
        ({"min_interval": float("nan")}, "got nan"),
        ({"max_queue_bytes": 0}, "max_queue_bytes: expected an integer, 1 or more, got 0"),
        ({"overflow": "wait"}, "overflow: expected 'drop_oldest' or 'error', got 'wait'"),
    ],
)
def test_subscription_wrong_argument_is_named(options: dict[str, Any], text: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        subscription(**options)
    assert str(caught.value).startswith("results(): ")
    assert text in str(caught.value)


def test_subscription_statistics_name_what_it_is() -> None:
    assert subscription(overflow="error").statistics() == SubscriberStatistics(
        name="results", policy="error", offered=0, taken=0, dropped=0, queued=0
    )
    assert [one.value for one in Overflow] == ["drop_oldest", "error"]


# ---------------------------------------------------------------------- overflow


async def test_drop_oldest_full_queue_keeps_the_newest() -> None:
    stream = subscription(max_queue=3)
    for number in range(5):
        stream.offer(number, 0.0)
    assert account(stream) == (5, 0, 2, 3)
    assert await take(stream, 3) == [2, 3, 4]
    assert account(stream) == (5, 3, 2, 0)


async def test_error_full_queue_ends_after_what_is_queued() -> None:
    stream = subscription(max_queue=2, overflow="error")
    for number in range(5):
        stream.offer(number, 0.0)
    assert stream.ended
    assert account(stream) == (3, 0, 1, 2)
    assert await take(stream, 2) == [0, 1]
    for _ in range(2):
        with pytest.raises(SubscriberOverflowError) as caught:
            await anext(stream)
        assert str(caught.value) == "results(): more than 2 items were waiting"
    assert account(stream) == (3, 2, 1, 0)


async def test_error_queue_that_is_read_in_time_never_ends() -> None:
    stream = subscription(max_queue=1, overflow="error")
    for number in range(5):
        stream.offer(number, 0.0)
        assert await anext(stream) == number
    assert not stream.ended


async def test_min_interval_drops_what_comes_too_soon_after_the_last_kept() -> None:
    stream = subscription(max_queue=9, min_interval=1.0)
    for number, now in enumerate([10.0, 10.5, 10.99, 11.0, 11.9, 12.5]):
        stream.offer(number, now)
    assert account(stream) == (6, 0, 3, 3)
    assert await take(stream, 3) == [0, 3, 5]


async def test_min_interval_too_soon_never_overflows() -> None:
    stream = subscription(max_queue=1, overflow="error", min_interval=1.0)
    stream.offer(1, 0.0)
    stream.offer(2, 0.5)
    assert not stream.ended
    stream.offer(3, 1.0)
    assert stream.ended


async def test_min_interval_zero_keeps_items_of_the_same_moment() -> None:
    stream = subscription()
    stream.offer(1, 5.0)
    stream.offer(2, 5.0)
    assert await take(stream, 2) == [1, 2]


# ---------------------------------------------------------------------- reading


async def test_anext_waits_for_an_item() -> None:
    stream = subscription()
    task = await waiting(stream)
    stream.offer(7, 0.0)
    assert await task == 7


async def test_anext_several_subscribers_have_each_their_own_items() -> None:
    fast, slow = subscription(), subscription(max_queue=1)
    for number in range(3):
        fast.offer(number, 0.0)
        slow.offer(number, 0.0)
    assert await take(fast, 3) == [0, 1, 2]
    assert await take(slow, 1) == [2]
    assert (account(fast), account(slow)) == ((3, 3, 0, 0), (3, 1, 2, 0))


async def test_anext_two_readers_of_one_subscription_share_its_items() -> None:
    stream = subscription()
    tasks = [await waiting(stream), await waiting(stream)]
    stream.offer(1, 0.0)
    done, pending = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    assert (len(done), len(pending)) == (1, 1)
    stream.offer(2, 0.0)
    assert sorted(await asyncio.gather(*tasks)) == [1, 2]


async def test_anext_cancelled_loses_nothing() -> None:
    stream = subscription()
    for item_came in (False, True):
        task = await waiting(stream)
        if item_came:
            stream.offer(1, 0.0)
        task.cancel()
        await asyncio.wait({task})
        assert task.cancelled()
    assert account(stream) == (1, 0, 0, 1)
    assert await anext(stream) == 1


async def test_anext_item_that_is_an_error_is_raised_and_the_stream_goes_on() -> None:
    stream = subscription()
    stream.offer(InterpretationError("does not fit"), 0.0)
    stream.offer(2, 0.0)
    with pytest.raises(InterpretationError, match="does not fit"):
        await anext(stream)
    assert await anext(stream) == 2
    assert account(stream) == (2, 2, 0, 0)


# ---------------------------------------------------------------------- ends


async def test_end_with_an_error_comes_after_queued_items_and_stays() -> None:
    stream = subscription()
    stream.offer(1, 0.0)
    lost = ConnectionLostError("gone")
    stream.end(lost)
    stream.end(None)
    stream.offer(2, 0.0)
    assert account(stream) == (1, 0, 0, 1)
    assert await anext(stream) == 1
    for _ in range(2):
        with pytest.raises(ConnectionLostError) as caught:
            await anext(stream)
        assert caught.value is lost


async def test_end_without_an_error_ends_the_loop() -> None:
    stream = subscription()
    stream.offer(1, 0.0)
    stream.end(None)
    assert [item async for item in stream] == [1]


@pytest.mark.parametrize("error", [None, ConnectionLostError("gone")])
async def test_end_wakes_a_waiting_reader(error: SmartCamError | None) -> None:
    stream = subscription()
    task = await waiting(stream)
    stream.end(error)
    with pytest.raises(type(error) if error else StopAsyncIteration):
        await task


async def test_close_drops_what_is_queued_and_counts_it() -> None:
    stream = subscription()
    stream.offer(1, 0.0)
    stream.offer(2, 0.0)
    stream.close()
    stream.close()
    stream.offer(3, 0.0)
    assert stream.ended
    assert account(stream) == (2, 0, 2, 0)
    assert [item async for item in stream] == []


async def test_context_closes_at_its_end() -> None:
    stream = subscription()
    async with stream as entered:
        assert entered is stream
        stream.offer(1, 0.0)
    assert account(stream) == (1, 0, 1, 0)


async def test_context_left_by_an_error_closes_and_passes_it_on() -> None:
    stream = subscription()
    with pytest.raises(ZeroDivisionError):
        async with stream:
            stream.offer(1 // 0, 0.0)
    assert stream.ended


async def test_subscription_nobody_refers_to_is_collected() -> None:
    stream = subscription()
    known = weakref.WeakSet([stream])
    stream.offer(1, 0.0)
    async for _ in stream:
        break
    del stream
    gc.collect()
    assert not known


# ---------------------------------------------------------------------- batches


async def test_batch_is_everything_that_is_there() -> None:
    stream = batches()
    task = asyncio.create_task(anext(stream))
    await asyncio.sleep(0)
    stream.offer_all([1, 2, 3], 0.0)
    assert await task == [1, 2, 3]
    stream.offer(4, 0.0)
    stream.offer_all([5, 6], 0.0)
    stream.offer_all([], 0.0)
    assert await anext(stream) == [4, 5, 6]
    assert account(stream) == (6, 6, 0, 0)
    stream.offer(7, 0.0)
    stream.end(None)
    assert [batch async for batch in stream] == [[7]]


async def test_batch_errors_are_raised_in_their_place_and_the_rest_comes() -> None:
    stream, errors = batches(), [InterpretationError(str(number)) for number in range(3)]
    stream.offer_all([1, 2], 0.0)
    for error in errors[:2]:
        stream.offer(error, 0.0)
    stream.offer(3, 0.0)
    stream.offer(errors[2], 0.0)
    seen: list[object] = []
    while account(stream)[3]:
        try:
            seen.append(await anext(stream))
        except InterpretationError as error:
            seen.append(error)
    assert seen == [[1, 2], errors[0], errors[1], [3], errors[2]]
    stream.offer_all([4, 5], 0.0)
    assert await anext(stream) == [4, 5]
    assert account(stream) == (8, 8, 0, 0)


async def test_batch_error_that_was_dropped_leaves_the_others_whole() -> None:
    stream = batches(max_queue=3)
    for item in (0, InterpretationError("old"), InterpretationError("older"), 1, 2, 3):
        stream.offer(item, 0.0)
    assert await anext(stream) == [1, 2, 3]
    stream.offer_all([4, 5], 0.0)
    assert await anext(stream) == [4, 5]
    assert account(stream) == (8, 5, 3, 0)


async def test_batch_overflow_error_ends_after_what_is_queued() -> None:
    stream = batches(max_queue=3, overflow="error")
    stream.offer_all([1, 2], 0.0)
    stream.offer_all([3, 4, 5], 0.0)
    assert account(stream) == (4, 0, 1, 3)
    assert await anext(stream) == [1, 2, 3]
    for _ in range(2):
        with pytest.raises(SubscriberOverflowError, match="more than 3 items were waiting"):
            await anext(stream)


async def test_offer_all_keeps_the_min_interval() -> None:
    stream = batches(min_interval=1.0)
    for now in (10.0, 10.5, 11.0):
        stream.offer_all([int(10 * now), 0], now)
    assert await anext(stream) == [100, 110]
    assert account(stream) == (6, 2, 4, 0)


async def test_batch_cancelled_loses_nothing() -> None:
    stream = batches()
    for items in ([], [1, 2]):
        task = asyncio.create_task(anext(stream))
        await asyncio.sleep(0)
        stream.offer_all(items, 0.0)
        task.cancel()
        await asyncio.wait({task})
        assert task.cancelled()
    assert account(stream) == (2, 0, 0, 2)
    assert await anext(stream) == [1, 2]


@pytest.mark.parametrize("error", [None, ConnectionLostError("gone")])
async def test_batch_end_wakes_a_waiting_reader(error: SmartCamError | None) -> None:
    stream = batches()
    task = asyncio.create_task(anext(stream))
    await asyncio.sleep(0)
    stream.end(error)
    with pytest.raises(type(error) if error else StopAsyncIteration):
        await task


# ---------------------------------------------------------------------- bytes


def weighed(kind: Any = Subscription, **options: Any) -> Any:
    """Return a subscription that holds ten bytes; an item has as many as it says."""
    options = {"max_queue": 99, "overflow": "drop_oldest", "max_queue_bytes": 10} | options
    return kind("results", size_of=int, **options)


def put(stream: Queue[int], *sizes: int) -> None:
    for size in sizes:
        stream.offer(size, 0.0, size)


def put_all(stream: Queue[int], *sizes: int) -> None:
    stream.offer_all(sizes, 0.0, sum(sizes))


each_way = pytest.mark.parametrize("offer", [put, put_all])


@each_way
async def test_bytes_beyond_the_bound_drop_as_many_of_the_oldest_as_needed(offer: Any) -> None:
    stream = weighed()
    offer(stream, 1, 2, 3, 4)
    assert (account(stream), stream.statistics().queued_bytes) == ((4, 0, 0, 4), 10)
    offer(stream, 5)
    assert (account(stream), stream.statistics().queued_bytes) == ((5, 0, 3, 2), 9)
    assert await take(stream, 2) == [4, 5]
    assert stream.statistics().queued_bytes == 0


@each_way
async def test_bytes_beyond_the_bound_end_the_stream_where_that_was_wanted(offer: Any) -> None:
    stream = weighed(overflow="error")
    offer(stream, 4, 6, 1, 1)
    assert (account(stream), stream.statistics().queued_bytes) == ((3, 0, 1, 2), 10)
    assert await take(stream, 2) == [4, 6]
    with pytest.raises(SubscriberOverflowError, match="more than 10 bytes were waiting"):
        await anext(stream)


@each_way
@pytest.mark.parametrize("overflow", ["drop_oldest", "error"])
async def test_item_larger_than_the_bound_is_kept_if_no_other_is(offer: Any, overflow: str) -> None:
    stream = weighed(overflow=overflow)
    for _ in range(2):
        offer(stream, 11)
        assert stream.statistics().queued_bytes == 11
        assert await take(stream, 1) == [11]
    offer(stream, 3)
    offer(stream, 11)
    if overflow == "drop_oldest":
        assert await take(stream, 1) == [11]
        assert account(stream) == (4, 3, 1, 0)
    else:
        assert await take(stream, 1) == [3]
        assert account(stream) == (4, 3, 1, 0)
        assert stream.ended


@each_way
async def test_bytes_of_what_was_taken_are_free_again(offer: Any) -> None:
    stream = weighed()
    offer(stream, 2, 3, 4)
    assert await take(stream, 2) == [2, 3]
    assert stream.statistics().queued_bytes == 4
    offer(stream, 6)
    assert (account(stream), stream.statistics().queued_bytes) == ((4, 2, 0, 2), 10)


async def test_bytes_of_errors_count_in_batches_too() -> None:
    stream = weighed(BatchSubscription)
    put_all(stream, 1, 2)
    stream.offer(InterpretationError("no"), 0.0, 7)
    assert await anext(stream) == [1, 2]
    assert stream.statistics().queued_bytes == 7
    put_all(stream, 3, 1)
    assert (account(stream), stream.statistics().queued_bytes) == ((5, 2, 1, 2), 4)
    assert await anext(stream) == [3, 1]


def test_bytes_are_let_go_with_the_stream() -> None:
    stream = weighed()
    put(stream, 4, 4)
    stream.close()
    assert (account(stream), stream.statistics().queued_bytes) == ((2, 0, 2, 0), 0)


async def test_bytes_counted_do_not_pile_up_behind_a_reader_that_keeps_up() -> None:
    stream = weighed(max_queue_bytes=1 << 40)
    for number in range(1, 1000):
        (put if number % 2 else put_all)(stream, number)
        assert await take(stream, 1) == [number]
        assert len(stream._parcels) == 1


# ---------------------------------------------------------------------- who is subscribed


def test_subscribers_come_in_order_and_one_that_nobody_has_is_gone_at_once() -> None:
    subscribers = Subscribers[int]()
    assert not subscribers
    first, second, third = subscription(), batches(), subscription()
    for one in (first, second, third):
        subscribers.add(one)
    assert [*subscribers] == [first, second, third]
    del one, second
    assert [*subscribers] == [first, third]
    del first, third
    assert not subscribers


def test_subscribers_may_go_and_come_while_they_are_offered_something() -> None:
    subscribers = Subscribers[int]()
    streams = [subscription() for _ in range(4)]
    for one in streams:
        subscribers.add(one)
    late = subscription()
    offered: list[int] = []
    for turn, stream in enumerate(subscribers):
        stream.offer(turn, 0.0)
        offered.append(id(stream))
        if turn == 0:
            del streams[1], one
            subscribers.add(late)
    assert offered == [id(one) for one in streams]
    assert [*subscribers] == [*streams, late]
    assert account(late) == (0, 0, 0, 0)


@pytest.mark.parametrize("how", ["dropped", "closed and dropped", "newest first"])
def test_to_subscribe_and_to_leave_takes_the_same_work_among_many(how: str) -> None:
    def work(count: int) -> int:
        subscribers = Subscribers[int]()
        streams: list[Subscription[int]] = []

        def live() -> None:
            for _ in range(count):
                streams.append(subscription())
                subscribers.add(streams[-1])
            subscribers.offer(1, 0.0)
            if how == "newest first":
                while streams:
                    streams.pop()
            for stream in streams if how == "closed and dropped" else ():
                stream.close()
            streams.clear()

        assert not subscribers
        done = instructions(live)
        assert not subscribers
        return done

    assert work(400) < 2.1 * work(200)


def instructions(function: Callable[[], object]) -> int:
    """Return the instructions of Python that a call takes."""
    count = 0

    def trace(frame: FrameType, event: str, _: object) -> Any:
        nonlocal count
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        count += event == "opcode"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        function()
    finally:
        sys.settrace(before)
    return count


# ---------------------------------------------------------------------- the account, by a model


Item = int | SmartCamError


def size(item: Item) -> int:
    """Return the bytes of an item of the model: 0 to 4."""
    return int(str(item)) * 7 % 5


class AccountMachine(RuleBasedStateMachine):
    """Any order of offers, reads and ends against a plain model."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.last = float("-inf")
        self.model: list[Item] = []
        self.offered = self.taken = self.dropped = 0
        self.ended = False
        self.choose(
            kind=Subscription, overflow="drop_oldest", interval=0.0, most=3, most_bytes=1000
        )

    @precondition(lambda self: self.offered == 0 and not self.ended)
    @rule(
        kind=st.sampled_from([Subscription, BatchSubscription]),
        overflow=st.sampled_from(["drop_oldest", "error"]),
        interval=st.sampled_from([0.0, 0.0, 1.0]),
        most=st.integers(1, 6),
        most_bytes=st.sampled_from([1, 5, 9, 1000]),
    )
    def choose(self, kind: Any, overflow: str, interval: float, most: int, most_bytes: int) -> None:
        self.overflow, self.interval, self.most = overflow, interval, most
        self.most_bytes = most_bytes
        self.stream: Subscription[int] | BatchSubscription[int] = kind(
            "results",
            max_queue=most,
            overflow=overflow,
            min_interval=interval,
            max_queue_bytes=most_bytes,
            size_of=size,
        )

    @rule(step=st.sampled_from([0.0, 0.5, 1.0]), fits=st.booleans())
    def offer(self, step: float, fits: bool) -> None:
        self.now += step
        item: Item = self.offered if fits else InterpretationError(str(self.offered))
        self.stream.offer(item, self.now, size(item))
        self.expect(item)

    @rule(step=st.sampled_from([0.0, 0.5, 1.0]), count=st.integers(0, 8))
    def offer_all(self, step: float, count: int) -> None:
        self.now += step
        items = list(range(self.offered, self.offered + count))
        self.stream.offer_all(items, self.now, sum(map(size, items)))
        for item in items:
            self.expect(item)

    def expect(self, item: Item) -> None:
        if self.ended:
            return
        self.offered += 1
        if self.now - self.last < self.interval:
            self.dropped += 1
        elif self.has_room_for(item) or self.overflow == "drop_oldest":
            self.last = self.now
            while not self.has_room_for(item):
                del self.model[0]
                self.dropped += 1
            self.model.append(item)
        else:
            self.dropped += 1
            self.ended = True

    def has_room_for(self, item: Item) -> bool:
        fits = sum(map(size, (*self.model, item))) <= self.most_bytes
        return not self.model or (len(self.model) < self.most and fits)

    @precondition(lambda self: self.model or self.ended)
    @rule()
    def take(self) -> None:
        step = self.stream.__anext__()
        with pytest.raises((StopIteration, StopAsyncIteration, SmartCamError)) as caught:
            step.send(None)
        if not self.model:
            assert isinstance(caught.value, (StopAsyncIteration, SubscriberOverflowError))
            return
        errors = [place for place, item in enumerate(self.model) if not isinstance(item, int)]
        before = errors[0] if errors else len(self.model)
        if before == 0:
            assert caught.value is self.model[0]
            count = 1
        elif isinstance(self.stream, BatchSubscription):
            assert isinstance(caught.value, StopIteration)
            assert caught.value.value == self.model[:before]
            count = before
        else:
            assert isinstance(caught.value, StopIteration)
            assert caught.value.value == self.model[0]
            count = 1
        del self.model[:count]
        self.taken += count

    @rule()
    def look(self) -> None:
        assert account(self.stream)[3] == len(self.model)
        assert self.stream.statistics().queued_bytes == sum(map(size, self.model))

    @rule()
    def end(self) -> None:
        self.stream.end(None)
        self.ended = True

    @rule()
    def close(self) -> None:
        self.stream.close()
        self.dropped += len(self.model)
        self.model.clear()
        self.ended = True

    @invariant()
    def account_is_the_models(self) -> None:
        expected = (self.offered, self.taken, self.dropped, len(self.model))
        one = self.stream  # statistics() would count bytes that it puts off to count otherwise
        assert (one._offered, one._taken, one._dropped, len(one._items)) == expected
        assert self.stream.ended == self.ended
        errors = [item for item in self.model if not isinstance(item, int)]
        assert self.stream._errors == len(errors)  # where none is, a batch is taken at once


TestAccount = AccountMachine.TestCase
