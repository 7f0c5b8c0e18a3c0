"""Streams and waits: what a camera says, to many at once, and that nothing gets lost unseen."""

from __future__ import annotations

import asyncio
import collections
import gc
import struct
from traceback import format_exception
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam import (
    Camera,
    ConfigurationError,
    ConnectionLostError,
    InterpretationError,
    ResponseTimeoutError,
    Result,
    Status,
    StatusChanged,
    SubscriberOverflowError,
    TriggerTimeoutError,
)
from smartcam.interpreters import Interpreter, Reader
from smartcam.models import SubscriberStatistics
from smartcam.protocols import messages as m
from smartcam.streams import BatchSubscription
from tests.client.camera_by_hand import (
    BUSY,
    OVERTRIGGERED,
    READY,
    RUNNING,
    TRIGGER,
    WAITING,
    HandmadeCamera,
)
from tests.client.clientkit import SHORT, TRIGGER_IDS, balance, by_hand, cancelled, emulated, steps
from tests.client.inside import Chunk
from tests.handmade import until
from tests.insides import inside


class Failing(Interpreter):
    """Reads nothing."""

    def interpret(self, reader: Reader) -> object:
        raise KeyError(len(reader))


def account(camera: Camera) -> SubscriberStatistics:
    """Return the account of the only subscriber."""
    (one,) = camera.statistics().subscribers
    return one


# ---------------------------------------------------------------------- results


async def test_results_is_subscribed_when_it_is_called() -> None:
    async with by_hand() as (_, camera):
        results = camera.results()
        triggered = await camera.trigger()
        assert await anext(results) is triggered


async def test_results_side_by_side_each_get_everything() -> None:
    async with by_hand() as (box, camera):
        streams = [camera.results() for _ in range(3)]
        box.send(box.result_frame(b"one") + box.result_frame(b"two"))
        for stream in streams:
            assert [(await anext(stream)).raw for _ in range(2)] == [b"one", b"two"]
        assert camera.statistics().streamed == 2


async def test_results_of_a_free_running_application_keep_their_order() -> None:
    async with emulated(box={"active": 9}, interpret_as="n: int32 @sequence") as (_, clock, camera):
        await camera.start()
        results = camera.results()
        clock.advance(1.0)
        assert [(await anext(results)).sequence for _ in range(20)] == list(range(20))


async def test_results_end_when_the_client_closes() -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        box.send(box.result_frame(b"one"))
        await camera.get_clock()
        await camera.close()
        assert [result.raw async for result in results] == [b"one"]


async def test_results_of_a_lost_link_give_what_was_queued_first() -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        box.send(box.result_frame(b"one"))
        box.hang_up()
        await until(lambda: not camera.connected)
        assert (await anext(results)).raw == b"one"
        for _ in range(2):
            with pytest.raises(ConnectionLostError, match="the link is gone"):
                await anext(results)


async def test_results_that_do_not_fit_are_raised_and_the_iterator_goes_on() -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        results = camera.results()
        box.send(box.result_frame(b"?") + box.result_frame(bytes(4)))
        with pytest.raises(InterpretationError) as caught:
            await anext(results)
        assert caught.value.field == "n"
        assert (await anext(results)).value.n == 0
        one = account(camera)
        assert (one.offered, one.taken, one.dropped, one.queued) == (2, 2, 0, 0)


async def test_results_left_by_their_reader_are_no_subscription_any_more() -> None:
    async with by_hand() as (box, camera):
        async with camera.results():
            assert account(camera).name == "results"
        assert camera.statistics().subscribers == []
        stream = camera.results()
        del stream
        gc.collect()
        assert camera.statistics().subscribers == []
        box.send(box.result_frame())
        await camera.get_clock()
        assert camera.statistics().unclaimed == 1


async def test_result_that_nobody_wants_is_counted_and_not_interpreted() -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        box.send(box.result_frame(b"?"))
        await camera.get_clock()
        statistics = camera.statistics()
        assert (statistics.received, statistics.unclaimed, statistics.uninterpretable) == (1, 1, 0)


async def test_results_with_a_min_interval_drop_what_comes_sooner() -> None:
    async with by_hand() as (box, camera):
        results = camera.results(min_interval=60)
        box.send(box.result_frame(b"one") + box.result_frame(b"two") + box.result_frame(b"three"))
        assert (await anext(results)).raw == b"one"
        one = account(camera)
        assert (one.offered, one.taken, one.dropped, one.queued) == (3, 1, 2, 0)


async def test_results_beyond_max_queue_drop_the_oldest() -> None:
    async with by_hand() as (box, camera):
        results = camera.results(max_queue=2)
        box.send(b"".join(box.result_frame(bytes([number])) for number in range(5)))
        await camera.get_clock()
        one = account(camera)
        assert (one.policy, one.offered, one.dropped, one.queued) == ("drop_oldest", 5, 3, 2)
        assert [(await anext(results)).raw for _ in range(2)] == [b"\x03", b"\x04"]


async def test_results_beyond_max_queue_end_where_that_was_wanted() -> None:
    async with by_hand() as (box, camera):
        results = camera.results(max_queue=1, overflow="error")
        box.send(box.result_frame(b"one") + box.result_frame(b"two"))
        await camera.get_clock()
        assert (await anext(results)).raw == b"one"
        with pytest.raises(SubscriberOverflowError, match="more than 1 items were waiting"):
            await anext(results)
        assert (await camera.trigger()).raw == b"found"


@pytest.mark.parametrize("batch", [False, True])
@pytest.mark.parametrize("together", [False, True])
async def test_results_beyond_max_queue_bytes_drop_the_oldest(
    *, batch: bool, together: bool
) -> None:
    async with by_hand() as (box, camera):
        subscribe: Any = camera.results
        results = subscribe(max_queue_bytes=1000, batch=batch)
        frames = [box.result_frame(bytes([number] * 300)) for number in range(9)]
        for some in [b"".join(frames)] if together else frames:
            box.send(some)
            await camera.get_clock()
        one = account(camera)
        assert (one.offered, one.dropped, one.queued, one.queued_bytes) == (9, 6, 3, 900)
        taken = await anext(results) if batch else [await anext(results) for _ in range(3)]
        assert [result.raw[0] for result in taken] == [6, 7, 8]
        assert account(camera).queued_bytes == 0


async def test_results_beyond_max_queue_bytes_end_where_that_was_wanted() -> None:
    async with by_hand() as (box, camera):
        results = camera.results(max_queue_bytes=5, overflow="error")
        box.send(box.result_frame(b"three") + box.result_frame(b"more"))
        await camera.get_clock()
        assert (await anext(results)).raw == b"three"
        with pytest.raises(SubscriberOverflowError, match="more than 5 bytes were waiting"):
            await anext(results)


async def test_results_that_nobody_takes_hold_no_more_bytes_than_the_default() -> None:
    large = bytes((1 << 20) - 4)  # the id is payload, too
    async with by_hand() as (box, camera):
        results, batches = camera.results(), camera.results(batch=True)
        for _ in range(100):
            box.send(box.result_frame(large))
        await until(lambda: camera.statistics().received == 100)
        for one in camera.statistics().subscribers:
            assert (one.queued, one.dropped, one.queued_bytes) == (64, 36, 64 * len(large))
        assert (await anext(results)).number == (await anext(batches))[0].number == 37


async def test_results_that_do_not_fit_count_their_bytes_and_hold_no_others() -> None:
    async with by_hand(interpret_as={7: Failing()}, application=7) as (box, camera):
        results = camera.results()
        stranger = box.result_frame(b"a stranger's" * 9999, application=3)
        box.send(stranger + box.result_frame(b"mine") + stranger)
        await until(lambda: camera.statistics().received == 3)
        assert account(camera).queued_bytes == len(b"mine")
        gc.collect()
        containers = [one for one in gc.get_objects() if isinstance(one, m.ResultContainer)]
        assert [one for one in containers if one.data.startswith(b"a stranger's")] == []
        with pytest.raises(InterpretationError) as caught:
            await anext(results)
        assert "\nraised in Failing.interpret, " in "".join(format_exception(caught.value))


@pytest.mark.parametrize(
    "options",
    [{"max_queue": 0}, {"max_queue_bytes": 0}, {"min_interval": -1}, {"overflow": "block"}],
)
async def test_results_with_options_that_cannot_work_are_refused(options: dict[str, Any]) -> None:
    async with by_hand() as (_, camera):
        with pytest.raises(ConfigurationError, match=r"results\(\)"):
            camera.results(**options)
        assert camera.statistics().subscribers == []


async def test_result_cancelled_waiting_for_is_not_lost() -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        waiting = asyncio.ensure_future(anext(results))
        await steps(2)
        await cancelled(waiting)
        box.send(box.result_frame(b"one"))
        assert (await anext(results)).raw == b"one"


# ---------------------------------------------------------------------- statuses and events


async def test_statuses_in_one_segment_all_come_in_order() -> None:
    words = [RUNNING, BUSY, READY, READY, RUNNING | OVERTRIGGERED]
    async with by_hand() as (box, camera):
        statuses = camera.statuses()
        box.report(*words)
        assert [await anext(statuses) for _ in words] == [Status(word) for word in words]


async def test_events_tell_changes_only() -> None:
    async with by_hand() as (box, camera):
        events = camera.events(max_queue=1)
        box.report(READY, RUNNING, RUNNING, BUSY)
        await camera.get_clock()
        event = await anext(events)
        assert isinstance(event, StatusChanged)
        assert (event.previous, event.status) == (Status.RUNNING, Status.BUSY)
        one = account(camera)
        assert (one.name, one.offered, one.taken, one.dropped) == ("events", 2, 1, 1)


async def test_wait_status_takes_the_present_one() -> None:
    async with by_hand() as (_, camera):
        status = await camera.wait_status(lambda status: Status.WAITING_FOR_TRIGGER in status)
        assert status == Status(RUNNING | WAITING)


async def test_wait_status_is_shown_every_status_in_order() -> None:
    async with by_hand() as (box, camera):
        seen: list[Status] = []

        def wanted(status: Status) -> bool:
            seen.append(status)
            return Status.OVERTRIGGERED in status

        waiting = [
            asyncio.create_task(camera.wait_status(wanted)),
            asyncio.create_task(camera.wait_status(lambda status: status == Status.BUSY)),
        ]
        await steps(2)
        box.report(BUSY, RUNNING | OVERTRIGGERED, RUNNING)
        assert await asyncio.gather(*waiting) == [Status(RUNNING | OVERTRIGGERED), Status.BUSY]
        assert seen == [Status(one) for one in (READY, BUSY, RUNNING | OVERTRIGGERED)]
        assert camera.status == Status.RUNNING


async def test_wait_status_times_out_with_what_the_status_is() -> None:
    async with by_hand() as (_, camera):
        with pytest.raises(
            ResponseTimeoutError, match=r"waited 0\.05 s for the status wanted; status: RUNNING"
        ) as caught:
            await camera.wait_status(lambda _: False, timeout=SHORT)
        assert caught.value.waited == pytest.approx(SHORT, abs=0.01)
        assert caught.value.message_id is None


def _fail(status: Status) -> bool:
    if status == Status.BUSY:
        raise ZeroDivisionError
    return False


async def test_wait_status_raises_what_the_predicate_raises_and_nobody_else_is_hurt() -> None:
    async with by_hand() as (box, camera):
        bad = asyncio.create_task(camera.wait_status(_fail))
        good = asyncio.create_task(camera.wait_status(lambda status: status == Status.BUSY))
        await steps(2)
        box.report(BUSY, BUSY)
        with pytest.raises(ZeroDivisionError):
            await bad
        assert await good == Status.BUSY
        with pytest.raises(ZeroDivisionError):
            await camera.wait_status(_fail)


async def test_wait_ready_is_not_busy_where_no_start_was_asked_for() -> None:
    async with by_hand(box={"status": BUSY}) as (box, camera):
        waiting = asyncio.create_task(camera.wait_ready())
        await steps(3)
        assert not waiting.done()
        box.report(0)
        assert await waiting == Status(0)


async def test_wait_ready_is_running_where_a_start_was_asked_for() -> None:
    async with by_hand(application=7) as (box, camera):
        box.report(0)
        await camera.wait_status(lambda status: not status)
        waiting = asyncio.create_task(camera.wait_ready())
        await steps(3)
        assert not waiting.done()
        box.report(READY)
        assert await waiting == Status(READY)


async def test_wait_ready_times_out() -> None:
    async with by_hand(box={"status": BUSY}) as (_, camera):
        with pytest.raises(ResponseTimeoutError, match="for the camera to be ready; status: BUSY"):
            await camera.wait_ready(timeout=SHORT)


# ---------------------------------------------------------------------- next_result


async def test_next_result_is_registered_when_it_is_called() -> None:
    async with by_hand() as (box, camera):
        waiting = [camera.next_result(), camera.next_result()]
        box.send(box.result_frame(b"one") + box.result_frame(b"two"))
        await camera.get_clock()
        assert [(await one).raw for one in waiting] == [b"one", b"one"]
        assert (camera.statistics().streamed, camera.statistics().unclaimed) == (1, 1)


async def test_next_result_by_a_sensor_at_the_emulator() -> None:
    async with emulated(box={"running": True, "active": 21}) as (emulator, clock, camera):
        waiting = camera.next_result()
        emulator.device.trigger()
        clock.advance(0.05)
        result = await waiting
        assert (result.application, result.triggered_at, result.latency) == (21, None, None)


async def test_next_result_times_out_with_what_the_status_is() -> None:
    async with by_hand() as (box, camera):
        with pytest.raises(
            TriggerTimeoutError, match=r"no result came within 0\.05 s; status: RUNNING"
        ) as caught:
            await camera.next_result(timeout=SHORT)
        assert caught.value.waited == SHORT
        box.send(box.result_frame())
        await camera.get_clock()
        assert camera.statistics().unclaimed == 1


async def test_next_result_that_does_not_fit_raises() -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        waiting = camera.next_result()
        box.send(box.result_frame(b"?"))
        with pytest.raises(InterpretationError):
            await waiting
        assert camera.statistics().uninterpretable == 1


async def test_next_result_cancelled_leaves_the_result_to_the_streams() -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        waiting = asyncio.create_task(camera.next_result())
        await steps(2)
        await cancelled(waiting)
        box.send(box.result_frame(b"one"))
        assert (await anext(results)).raw == b"one"


async def test_next_result_cancelled_in_the_same_step_takes_nothing() -> None:
    async with by_hand() as (_, camera):
        first, second = (asyncio.create_task(camera.next_result()) for _ in range(2))
        await steps(2)
        first.cancel()
        inside(camera)._dispatch.dispatch(
            Chunk(0.0, [m.ResultContainer(application=7, data=b"one")])
        )
        assert (await second).raw == b"one"
        assert first.cancelled()


async def test_next_result_never_awaited_wants_nothing_any_more() -> None:
    async with by_hand() as (box, camera):
        waiting = asyncio.create_task(camera.next_result())
        await cancelled(waiting)  # before its first step
        del waiting
        box.send(box.result_frame())
        await camera.get_clock()
        assert camera.statistics().unclaimed == 1


# ---------------------------------------------------------------------- the account

ACTIONS = st.sampled_from(
    [
        *("trigger", "trigger garbage", "cancel", "result", "garbage", "burst", "mixed burst"),
        *("wrong application", "switch", "listen", "ignore", "read"),
    ]
)
GOOD, GARBAGE, WRONG = struct.pack("<i", 5), b"?", struct.pack("<i", 6)


class Story:
    """Plays what happens to a camera, and says by rules of its own what the account must be."""

    def __init__(self, box: HandmadeCamera, camera: Camera) -> None:
        self.box = box
        self.camera = camera
        self.fates: collections.Counter[str] = collections.Counter()
        self.owed = False
        self.streams: list[Any] = []
        self.trigger = box.script[TRIGGER]

    async def play(self, action: str) -> None:
        await getattr(self, "_" + action.replace(" ", "_"))()
        await self.camera.get_clock()  # what the camera said before was heard
        statistics = self.camera.statistics()
        balance(statistics)
        for fate in ("triggered", "streamed", "late", "uninterpretable", "unclaimed"):
            assert getattr(statistics, fate) == self.fates[fate], f"{fate} after {action}"
        assert statistics.wrong_application == self.fates["wrong_application"]

    async def _trigger(self) -> None:
        self.box.container, self.box.script[TRIGGER] = GOOD, self.trigger
        assert (await self.camera.trigger()).value.n == 5
        self.fates["triggered"] += 1
        self.owed = False

    async def _trigger_garbage(self) -> None:
        self.box.container, self.box.script[TRIGGER] = GARBAGE, self.trigger
        with pytest.raises(InterpretationError):
            await self.camera.trigger()
        self.fates["uninterpretable"] += 1
        self.owed = False

    async def _cancel(self) -> None:
        box, heard = self.box, self.camera.statistics().frames_received
        box.script[TRIGGER] = lambda _: box.inspects()  # its result comes later
        task = asyncio.create_task(self.camera.trigger(timeout=60))
        await until(lambda: box.ids[-3:] == TRIGGER_IDS and box.status == READY)
        await until(lambda: self.camera.statistics().frames_received >= heard + 4)
        await cancelled(task)
        self.owed = True

    async def _result(self) -> None:
        self._come(GOOD)

    async def _garbage(self) -> None:
        self._come(GARBAGE)

    async def _burst(self) -> None:
        self._come(GOOD, GOOD, GOOD)

    async def _mixed_burst(self) -> None:
        self._come(GOOD, GOOD, GARBAGE, WRONG, GOOD, GOOD)

    async def _wrong_application(self) -> None:
        self._come(WRONG)

    def _come(self, *containers: bytes) -> None:
        """Send containers in one write."""
        frames: list[bytes] = []
        for data in containers:
            frames.append(self.box.result_frame(data, 99 if data is WRONG else None))
            self.fates[self._fate(data)] += 1
        self.box.send(b"".join(frames))

    def _fate(self, data: bytes) -> str:
        if data is WRONG:
            return "wrong_application"
        if self.owed:
            self.owed = False
            return "late"
        if not self.streams:
            return "unclaimed"
        return "streamed" if data is GOOD else "uninterpretable"

    async def _switch(self) -> None:
        await self.camera.switch_application(3 if self.box.active == 7 else 7)
        self.owed = False

    async def _listen(self) -> None:
        self.streams.append(self.camera.results(max_queue=2))
        self.streams.append(self.camera.results(min_interval=60))
        self.streams.append(self.camera.results(max_queue=4, batch=True))

    async def _ignore(self) -> None:
        for stream in self.streams:
            stream.close()
        self.streams.clear()

    async def _read(self) -> None:
        for stream in self.streams:
            batch = isinstance(stream, BatchSubscription)
            if stream.statistics().queued:
                try:
                    taken = await anext(stream)
                    assert {type(one) for one in (taken if batch else [taken])} == {Result}
                except InterpretationError as error:
                    assert error.field == "n"  # noqa: PT017 - either may be queued


@given(actions=st.lists(ACTIONS, max_size=25))
async def test_accounts_balance_whatever_happens(actions: list[str]) -> None:
    async with by_hand(application=7, interpret_as="n: int32") as (box, camera):
        story = Story(box, camera)
        for action in actions:
            await story.play(action)
        assert camera.statistics().received == story.fates.total()


async def test_statistics_count_what_went_over_the_wire() -> None:
    async with by_hand() as (box, camera):
        before = camera.statistics()
        await camera.trigger()
        box.send(box.frame(0x30, bytes(8)))
        await camera.get_clock()
        after = camera.statistics()
    assert after.frames_sent - before.frames_sent == 4
    assert after.frames_received - before.frames_received == 7
    assert after.bytes_sent - before.bytes_sent == 4 * 12
    assert (after.sessions, after.long_bodies, after.ignored_datagrams) == (1, 1, 0)
    assert after.last_error is None


async def test_free_running_results_while_triggers_time_out_balance() -> None:
    async with emulated(box={"active": 9}) as (emulator, clock, camera):
        await camera.start()
        results = camera.results(max_queue=4)
        triggering = asyncio.create_task(camera.trigger(timeout=SHORT))
        await steps(3)
        clock.advance(2.0)
        with pytest.raises(TriggerTimeoutError):
            await triggering
        await camera.query_application()
        statistics = camera.statistics()
        balance(statistics)
        assert (statistics.received, statistics.streamed) == (40, 40)
        assert (await anext(results)).number == 37
        assert m.Trigger not in {type(entry.message) for entry in emulator.log}
