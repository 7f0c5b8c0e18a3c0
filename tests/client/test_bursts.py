"""Results that come many at once: the same comes of them as if each came alone.

Most tests run twice: the frames in one write, where the client takes them for a burst, and each in
a delivery of its own.
"""

from __future__ import annotations

import asyncio
import gc
import os
import struct
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from smartcam import (
    Camera,
    InterpretationError,
    Observer,
    Result,
    SubscriberOverflowError,
    TriggerTimeoutError,
)
from smartcam.interpreters import Context, Interpreter, PlainInterpreter, Reader
from smartcam.models import Localization, Status
from smartcam.protocols import messages as m
from smartcam.protocols._inside import ResultBurst
from tests.client.camera_by_hand import NUMBER, READY, RUNNING, TRIGGER, WAITING, HandmadeCamera
from tests.client.clientkit import SHORT, balance, by_hand, cancelled, gone, hear, steps
from tests.client.inside import MAX_CHUNK_FRAMES, Chunk, split_chunk
from tests.handmade import until
from tests.insides import inside

BOLT = struct.pack("<50sfifff", b"bolt", 0.5, 1, 0.25, -0.5, 1.0)
NUT = struct.pack("<50sfifff", b"nut", 1.0, 2, 1.0, 2.0, 3.0)
EMPTY = bytes(len(BOLT))
NAN = struct.pack("<50sfifff", b"nan", 0.5, 1, 0.25, float("nan"), 1.0)

each_way = pytest.mark.parametrize("together", [True, False], ids=["together", "alone"])


async def say(camera: Camera, box: HandmadeCamera, *frames: bytes, together: bool) -> None:
    """Send frames in one write, or each in a delivery of its own; all are heard then."""
    heard = camera.statistics().frames_received
    for data in [b"".join(frames)] if together else frames:
        box.send(data)
        heard += len(box.split(data))
        await until(lambda: camera.statistics().frames_received == heard)  # noqa: B023
        link: Any = inside(camera)._connection.link
        await until(lambda: not link._chunks)  # noqa: B023


async def behind_its_answers(camera: Camera) -> None:
    """Wait until the Queries that went out with a trigger are answered."""
    await until(lambda: not inside(camera)._waits.is_pending(m.QueryAnswer))


def bursts(camera: Camera) -> list[int]:
    """Return where the sizes of the bursts that come will stand."""
    takers, sizes = inside(camera)._dispatch._handlers, list[int]()
    take = takers[ResultBurst]

    def note(burst: ResultBurst, *arguments: Any) -> None:
        sizes.append(len(burst.data))
        take(burst, *arguments)

    takers[ResultBurst] = note
    return sizes


async def queued(stream: Any) -> list[Any]:
    """Return what is queued: results and errors, one by one."""
    items: list[Any] = []
    while stream.statistics().queued:
        try:
            taken = await anext(stream)
        except InterpretationError as error:
            taken = error
        items += taken if isinstance(taken, list) else [taken]
    return items


def numbered(box: HandmadeCamera, count: int, first: int = 0) -> list[bytes]:
    """Return frames of results with a number each."""
    return [box.result_frame(struct.pack("<i", one)) for one in range(first, first + count)]


def fates(camera: Camera) -> dict[str, int]:
    """Return what became of the containers; the accounts balance."""
    statistics = camera.statistics()
    balance(statistics)
    names = "triggered streamed late wrong_application uninterpretable unclaimed extra_results"
    return {one: count for one in names.split() if (count := getattr(statistics, one))}


def shown(item: Any) -> object:
    """Return what of a result or an error must not depend on how it came."""
    if isinstance(item, InterpretationError):
        return (str(item), item.field, item.offset, item.expected, repr(item.got))
    assert type(item) is Result
    assert (item.triggered_at, item.latency) == (None, None)
    value = item.value
    if isinstance(value, list) and value and isinstance(value[0], Localization):
        for part in value:
            assert part.pose.header == (item.number, item.received_at, item.camera)
        value = [(part[:3], part.pose[1:], part.pose.header.seq) for part in value]
    return (item.number, item.camera, item.application, item.sequence, item.raw, repr(value))


# ---------------------------------------------------------------------- interpreters


class Size(PlainInterpreter):
    """Tells what it knows of a container."""

    def read(self, data: bytes, context: Context) -> object:
        context.empty_slots += data == EMPTY
        at = context.received_at.utcoffset()
        return (len(data), 70 // len(data), context.number, context.application, context.camera, at)


class Quick(Size):
    """The same for many at once."""

    def read_all(self, containers: Sequence[bytes], context: Context) -> Sequence[object]:
        number, values = context.number, []
        for context.number, data in enumerate(containers, number):
            values.append(Size.read(self, data, context))
        return tuple(values)


class Short(Size):
    """Of several it gives too few."""

    def read_all(self, containers: Sequence[bytes], context: Context) -> Sequence[object]:
        return [0]


class Nothing(Size):
    """Of several it gives nothing, which its type forbids: a slip is an outcome as any other."""

    def read_all(self, containers: Sequence[bytes], context: Context) -> Any:
        return None


class Whole(Size):
    """Wants a reader nevertheless, and tells a sequence number of its own."""

    def interpret(self, reader: Reader) -> object:
        return (reader.data, reader.context.number)

    def sequence(self, reader: Reader) -> int | None:
        return len(reader.data)


class Plainest(Interpreter):
    """Takes a reader."""

    def interpret(self, reader: Reader) -> object:
        return reader.get_string(0, 50), reader.context.number


def function(reader: Reader) -> object:
    reader.context.empty_slots += reader.data == EMPTY
    return reader.get_int8(3), reader.context.number, reader.context.camera


SPECS: dict[str, Any] = {
    "raw": None,
    "record": "feature_id: string[50], quality: real32, n: int32, x: real32, y: real32, t: real32",
    "table": "table: (feature_id: string[50], quality: real32, n: int32, xyt: int64, t: int32)*",
    "localizations": "localizations",
    "strings50": "strings50",
    "sequence": "feature_id: string[50], quality: real32, n: int32 @sequence, xyt: string[12]",
    "mapping": {7: "localizations", 3: "strings50"},
    "mapping that lacks one": {7: "localizations"},
    "plain": Size,
    "plain, all at once": Quick,
    "plain, too few": Short,
    "plain, nothing": Nothing,
    "plain with a reader": Whole(),
    "interpreter": Plainest,
    "function": function,
}


@pytest.mark.parametrize("name", SPECS)
async def test_burst_gives_what_its_containers_give_one_by_one(name: str) -> None:
    good = [BOLT, BOLT + EMPTY + NUT, EMPTY, NUT]
    runs = [
        (7, good),
        (3, [NUT, bytes(50), NUT]),  # of another application
        (7, [*good, b"?", *good]),  # one does not fit its layout
        (7, [b"", NAN, EMPTY, BOLT]),
        (7, [NUT, EMPTY, BOLT]),
    ]
    told: list[object] = []
    for together in (True, False):
        async with by_hand(interpret_as=SPECS[name], name="press 4") as (box, camera):
            sizes, results, batch = bursts(camera), camera.results(), camera.results(batch=True)
            for application, containers in runs:
                frames = [box.result_frame(data, application) for data in containers]
                await say(camera, box, *frames, together=together)
            assert sizes == ([len(containers) for _, containers in runs] if together else [])
            seen = await queued(results)
            assert [*map(id, await queued(batch))] == [*map(id, seen)]
            statistics = camera.statistics()
            told.append(([*map(shown, seen)], fates(camera), statistics.empty_slots))
            for one in statistics.subscribers:
                assert (one.offered, one.taken) == (len(seen), len(seen)) == (23, 23)
            assert camera.active_application == 7
            whole = [item for item in seen if isinstance(item, Result)]
            lacking = {place for place, item in enumerate(seen, 1) if item not in whole}
            assert [item.number for item in whole] == [
                number for number in range(1, 24) if number not in lacking
            ]
    assert told[0] == told[1]


@each_way
async def test_burst_of_localizations_has_its_numbers_and_counts_empty_slots(
    *, together: bool
) -> None:
    async with by_hand(interpret_as="localizations") as (box, camera):
        sizes, results = bursts(camera), camera.results(batch=True)
        frames = [box.result_frame(data) for data in (BOLT, EMPTY + NUT + EMPTY, EMPTY, NUT)]
        for turn in range(2):
            await say(camera, box, *frames, together=together)
            seen = await queued(results)
            assert [one.number for one in seen] == [4 * turn + n for n in (1, 2, 3, 4)]
            headers = [[part.pose.header.seq for part in one.value] for one in seen]
            assert headers == [[one.number] if one.number % 4 != 3 else [] for one in seen]
            assert camera.statistics().empty_slots == 3 * (turn + 1)
        assert sizes == ([4, 4] if together else [])


@each_way
async def test_burst_with_one_that_does_not_fit_raises_it_in_its_place(*, together: bool) -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        results, batch = camera.results(), camera.results(batch=True)
        frames = numbered(box, 5)
        frames[2] = box.result_frame(b"?")
        await say(camera, box, *frames, together=together)
        first, error, second = await anext(batch), await gone(anext(batch)), await anext(batch)
        assert [[one.value.n for one in part] for part in (first, second)] == [[0, 1], [3, 4]]
        assert isinstance(error, InterpretationError)
        seen = await queued(results)
        assert (seen[2], len(seen)) == (error, 5)
        assert fates(camera) == {"streamed": 4, "uninterpretable": 1}


# ---------------------------------------------------------------------- whose they are


@each_way
async def test_burst_of_another_application_in_the_middle_is_counted_and_not_delivered(
    *, together: bool
) -> None:
    async with by_hand(application=7, interpret_as="n: int32") as (box, camera):
        sizes, results = bursts(camera), camera.results()
        wrong = [box.result_frame(bytes(4), application=3)] * 2
        frames = [*numbered(box, 3), *wrong, *numbered(box, 2, 3)]
        await say(camera, box, *frames, together=together)
        assert [(one.value.n, one.number) for one in await queued(results)] == [
            *((0, 1), (1, 2), (2, 3)),
            *((3, 6), (4, 7)),
        ]
        assert fates(camera) == {"streamed": 5, "wrong_application": 2}
        assert camera.active_application == 7
        assert sizes == ([3, 2, 2] if together else [])


@each_way
async def test_trigger_takes_its_own_from_the_middle_of_bursts(*, together: bool) -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        box.container = bytes(4)
        await camera.trigger()  # the camera is seen to drop Waiting for Trigger
        sizes, results, batch = bursts(camera), camera.results(), camera.results(batch=True)
        box.script[TRIGGER] = lambda _: b""
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER, 2)
        await behind_its_answers(camera)
        older, own, extra = numbered(box, 2, 1), numbered(box, 1, 100), numbered(box, 3, 200)
        frames = [*older, box.status_frame(RUNNING), *own, *extra, box.status_frame(READY)]
        await say(camera, box, *frames, together=together)
        result = await triggering
        assert (result.value.n, result.number) == (100, 4)
        assert result.triggered_at is not None
        seen = await queued(results)
        assert [one.value.n for one in seen] == [1, 2, 100, 200, 201, 202]
        assert [one.number for one in seen] == [2, 3, 4, 5, 6, 7]
        assert seen[2] is result
        assert await queued(batch) == seen
        assert fates(camera) == {"triggered": 2, "streamed": 5, "extra_results": 3}
        assert sizes == ([2, 4] if together else [])


@each_way
async def test_trigger_takes_its_number_from_the_middle_of_a_burst(*, together: bool) -> None:
    async with by_hand(interpret_as="n: int32 @sequence") as (box, camera):
        sizes, results = bursts(camera), camera.results()
        box.script[TRIGGER] = lambda _: b""
        triggering = asyncio.create_task(camera.trigger())
        (ours,) = struct.unpack("<i", await box.wait_for(NUMBER))
        await box.wait_for(TRIGGER)
        await behind_its_answers(camera)
        frames = box.status_frame(RUNNING), *numbered(box, 5, ours - 2)
        await say(camera, box, *frames, together=together)
        assert (await triggering).sequence == ours
        seen = await queued(results)
        assert [one.sequence - ours for one in seen] == [-2, -1, 0, 1, 2]
        assert [one.triggered_at is not None for one in seen] == [0, 0, 1, 0, 0]
        assert fates(camera) == {"triggered": 1, "streamed": 4}
        assert sizes == ([5] if together else [])


@each_way
async def test_number_of_a_trigger_that_is_over_is_looked_for_in_a_burst(*, together: bool) -> None:
    async with by_hand(interpret_as="n: int32 @sequence") as (box, camera):
        sizes, results = bursts(camera), camera.results()
        box.script[TRIGGER] = lambda _: b""
        triggering = asyncio.create_task(camera.trigger())
        (ours,) = struct.unpack("<i", await box.wait_for(NUMBER))
        await box.wait_for(TRIGGER)
        await behind_its_answers(camera)
        frames = box.status_frame(RUNNING), *numbered(box, 1, ours)
        await say(camera, box, *frames, together=together)
        await triggering
        await say(camera, box, *numbered(box, 3, ours - 1), together=together)
        assert len(await queued(results)) == 4
        assert fates(camera) == {"triggered": 1, "streamed": 3, "extra_results": 1}
        assert sizes == ([3] if together else [])


@each_way
async def test_triggers_of_several_results_take_as_many_of_a_burst(*, together: bool) -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: b""
        triggering = asyncio.create_task(camera.trigger(results_per_trigger=3))
        await box.wait_for(TRIGGER)
        await behind_its_answers(camera)
        results = camera.results()
        await say(camera, box, box.status_frame(RUNNING), *numbered(box, 5), together=together)
        own = await triggering
        assert [one.number for one in own] == [1, 2, 3]
        assert (await queued(results))[:3] == own
        assert fates(camera) == {"triggered": 3, "streamed": 2, "extra_results": 2}


@each_way
async def test_next_result_takes_the_first_of_a_burst(*, together: bool) -> None:
    async with by_hand() as (box, camera):
        sizes, waiting, results = bursts(camera), camera.next_result(), camera.results()
        await say(camera, box, *numbered(box, 3), together=together)
        first = await waiting
        assert first.number == 1
        assert [one.number for one in await queued(results)] == [1, 2, 3]
        assert fates(camera) == {"streamed": 3}
        assert sizes == ([3] if together else [])


class Witness(Observer):
    def __init__(self) -> None:
        self.seen: list[Any] = []

    def on_result(self, result: Result) -> None:
        self.seen.append(result)

    def on_error(self, camera: str, error: Exception, triggered_at: object) -> None:
        self.seen.append(error)


@each_way
async def test_observer_sees_each_of_a_burst_in_order(*, together: bool) -> None:
    witness = Witness()
    async with by_hand(interpret_as="n: int32", observers=[witness]) as (box, camera):
        sizes, batch = bursts(camera), camera.results(batch=True)
        frames = numbered(box, 3)
        await say(camera, box, *frames, together=together)
        await say(camera, box, *frames, box.result_frame(b"?"), *frames, together=together)
        assert sizes == ([3, 7] if together else [])
        assert witness.seen == await queued(batch)
        assert len(witness.seen) == 10


class Subscriber(Witness):
    """Adds listeners, and closes others, from its hook."""

    def __init__(self) -> None:
        super().__init__()
        self.camera: Any = None
        self.streams: list[Any] = []
        self.waiting: list[Any] = []

    def on_result(self, result: Result) -> None:
        super().on_result(result)
        match result.number:
            case 2 | 4:
                self.streams.append(self.camera.results())
            case 3:
                self.streams[0].close()
            case 5 | 8:
                self.waiting.append(self.camera.next_result())
            case 6:
                self.streams.append(self.camera.results(batch=True))
                self.waiting.append(self.camera.next_result())


@each_way
async def test_listener_that_an_observer_adds_gets_that_result_and_later_ones(
    *, together: bool
) -> None:
    added = Subscriber()
    async with by_hand(interpret_as="n: int32", observers=[added]) as (box, camera):
        added.camera = camera
        first, sizes = camera.results(), bursts(camera)
        added.streams.append(first)
        await say(camera, box, *numbered(box, 8), together=together)
        assert sizes == ([8] if together else [])
        assert [one.number for one in added.seen] == [*range(1, 9)]
        assert first.statistics().queued == 0
        got = [[one.number for one in await queued(one)] for one in added.streams[1:]]
        assert got == [[2, 3, 4, 5, 6, 7, 8], [4, 5, 6, 7, 8], [6, 7, 8]]
        assert [(await one).number for one in added.waiting] == [5, 6, 8]
        assert fates(camera) == {"streamed": 8}


class Gatherer(Witness):
    def __init__(self) -> None:
        super().__init__()
        self.sizes: list[int] = []

    def on_results(self, results: Sequence[Result]) -> None:
        self.sizes.append(len(results))
        self.seen += results


@each_way
async def test_observer_of_several_results_is_given_a_burst_whole(*, together: bool) -> None:
    gatherer = Gatherer()
    async with by_hand(interpret_as="n: int32", observers=[gatherer]) as (box, camera):
        batch = camera.results(batch=True)
        frames = numbered(box, 3)
        await say(camera, box, *frames, together=together)
        await say(camera, box, *frames, box.result_frame(b"?"), *frames, together=together)
        assert gatherer.sizes == ([3, *[1] * 6] if together else [1] * 9)
        assert gatherer.seen == await queued(batch)
        assert fates(camera) == {"streamed": 9, "uninterpretable": 1}


@each_way
async def test_observer_of_several_results_beside_one_of_each_is_given_each(
    *, together: bool
) -> None:
    gatherer, witness = Gatherer(), Witness()
    async with by_hand(interpret_as="n: int32", observers=[gatherer, witness]) as (box, camera):
        batch = camera.results(batch=True)
        await say(camera, box, *numbered(box, 3), together=together)
        assert gatherer.sizes == [1, 1, 1]
        assert gatherer.seen == witness.seen == await queued(batch)


class Quiet(Observer):
    """Looks at errors only."""

    def __init__(self) -> None:
        self.seen: list[Any] = []

    def on_error(self, camera: str, error: Exception, triggered_at: object) -> None:
        self.seen.append(error)


class Looks(Quiet):
    """Looks at each result, too."""

    def on_result(self, result: Result) -> None:
        assert result.value.n in range(3)


@pytest.mark.parametrize("quiet", [Quiet(), Looks()], ids=["errors only", "each result"])
async def test_observer_leaves_bursts_whole(quiet: Quiet, monkeypatch: pytest.MonkeyPatch) -> None:
    async with by_hand(interpret_as="n: int32", observers=[quiet]) as (box, camera):
        results, alone = camera.results(), list[object]()
        kept = inside(camera)._results
        take = kept.on_result

        def note(*given: Any) -> None:
            alone.append(given)
            take(*given)

        monkeypatch.setattr(kept, "on_result", note)
        await say(camera, box, *numbered(box, 3), together=True)
        assert [one.value.n for one in await queued(results)] == [0, 1, 2]
        assert alone == []
        await say(camera, box, *numbered(box, 2), box.result_frame(b"?"), together=True)
        assert [type(one) for one in quiet.seen] == [InterpretationError]
        assert len(alone) == 3
        assert fates(camera) == {"streamed": 5, "uninterpretable": 1}


# ---------------------------------------------------------------------- statuses around each

INSPECTS, DONE = RUNNING, RUNNING | WAITING


def around(box: HandmadeCamera, results: list[bytes]) -> list[bytes]:
    """Return the frames of a camera that runs free: each result between two statuses."""
    statuses = box.status_frame(INSPECTS), box.status_frame(DONE)
    return [frame for one in results for frame in (statuses[0], one, statuses[1])]


@each_way
@pytest.mark.parametrize("observed", [False, True])
async def test_results_between_statuses_are_what_they_are_one_by_one(
    *, together: bool, observed: bool
) -> None:
    witness = Witness()
    observers = [witness] if observed else []
    async with by_hand(interpret_as="n: int32", observers=observers) as (box, camera):
        sizes, results, batch = bursts(camera), camera.results(), camera.results(batch=True)
        before = camera.statistics()
        for turn in range(3):
            await say(camera, box, *around(box, numbered(box, 4, 4 * turn)), together=together)
            assert camera.status == DONE
        seen = await queued(results)
        assert [(one.value.n, one.number) for one in seen] == [(n, n + 1) for n in range(12)]
        assert await queued(batch) == seen
        assert witness.seen == (seen if observed else [])
        assert fates(camera) == {"streamed": 12}
        after = camera.statistics()
        assert after.inspections_by_others - before.inspections_by_others == 12
        assert sizes == ([4, 4, 4] if together else [])


@each_way
async def test_result_between_statuses_that_does_not_fit_is_raised_in_its_place(
    *, together: bool
) -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        results = camera.results()
        frames = numbered(box, 4)
        frames[1] = box.result_frame(b"?")
        await say(camera, box, *around(box, frames), together=together)
        seen = await queued(results)
        assert [isinstance(one, InterpretationError) for one in seen] == [False, True, False, False]
        assert fates(camera) == {"streamed": 3, "uninterpretable": 1}


@each_way
async def test_results_around_a_status_of_the_other_byte_order_are_read_by_theirs(
    *, together: bool
) -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        sizes, results = bursts(camera), camera.results()
        little, big = (box.result_frame(struct.pack(code, 1)) for code in ("<i", ">i"))
        frames = [little, box.status_frame(DONE, endian=1), big, box.status_frame(INSPECTS), big]
        frames += [box.status_frame(DONE, endian=0), little, box.status_frame(INSPECTS)]
        await say(camera, box, *frames, together=together)
        assert [one.value.n for one in await queued(results)] == [1, 1, 1, 1]
        assert sizes == []


@each_way
async def test_statuses_that_somebody_waits_for_keep_their_place(*, together: bool) -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        sizes, results, statuses = bursts(camera), camera.results(), camera.statuses()
        frames = around(box, numbered(box, 3))
        await say(camera, box, *frames, together=together)
        assert await queued(statuses) == [INSPECTS, DONE] * 3
        statuses.close()
        del statuses
        seen: list[tuple[object, int]] = []

        def show(status: object) -> bool:
            seen.append((status, camera.statistics().received))
            return False

        waiting = asyncio.create_task(camera.wait_status(show))
        await steps(3)
        seen.clear()
        await say(camera, box, *frames, together=together)
        await cancelled(waiting)
        assert seen == [(one, 3 + n + (one == DONE)) for n in range(3) for one in (INSPECTS, DONE)]
        assert len(await queued(results)) == 6
        assert sizes == []


@each_way
async def test_extra_results_between_statuses_are_extra_until_an_inspection_begins(
    *, together: bool
) -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        await camera.trigger()
        frames = [*numbered(box, 2), *around(box, numbered(box, 4))]
        await say(camera, box, *frames, together=together)
        assert fates(camera) == {"triggered": 1, "streamed": 6, "extra_results": 2}
        assert [one.number for one in await queued(results)] == [*range(1, 8)]


@each_way
async def test_results_of_two_applications_between_statuses_are_told_apart(
    *, together: bool
) -> None:
    async with by_hand(application=7, interpret_as="n: int32") as (box, camera):
        results = camera.results()
        frames = numbered(box, 4)
        frames[2] = box.result_frame(bytes(4), application=3)
        await say(camera, box, *around(box, frames), together=together)
        assert [(one.value.n, one.number) for one in await queued(results)] == [
            *((0, 1), (1, 2), (3, 4))
        ]
        assert fates(camera) == {"streamed": 3, "wrong_application": 1}


@each_way
@pytest.mark.parametrize("listening", [True, False])
async def test_debt_is_paid_by_the_first_of_a_burst(*, together: bool, listening: bool) -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = box.takes
        triggering = asyncio.create_task(camera.trigger())
        await box.wait_for(TRIGGER)
        await behind_its_answers(camera)
        await cancelled(triggering)
        results = camera.results() if listening else None
        await say(camera, box, *numbered(box, 4), together=together)
        rest = "streamed" if listening else "unclaimed"
        assert fates(camera) == {"late": 1, rest: 3}
        assert results is None or len(await queued(results)) == 4


@each_way
async def test_burst_that_nobody_listens_to_is_unclaimed_and_not_interpreted(
    *, together: bool
) -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        left = camera.results()
        left.close()
        await say(camera, box, *[box.result_frame(b"?")] * 4, together=together)
        await say(camera, box, *numbered(box, 3), together=together)
        assert fates(camera) == {"unclaimed": 7}
        assert left.statistics().offered == 0
        results = camera.results()
        await say(camera, box, *numbered(box, 2), together=together)
        assert [one.number for one in await queued(results)] == [8, 9]
        assert fates(camera) == {"unclaimed": 7, "streamed": 2}


@each_way
async def test_extra_results_that_come_together_are_counted_each(*, together: bool) -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        await camera.trigger()
        sizes = bursts(camera)
        await say(camera, box, *numbered(box, 4), together=together)
        assert fates(camera) == {"triggered": 1, "streamed": 4, "extra_results": 4}
        # somebody else's inspection: what comes then is extra no longer
        frames = [box.status_frame(RUNNING), *numbered(box, 3), box.status_frame(RUNNING | WAITING)]
        await say(camera, box, *frames, together=together)
        assert fates(camera) == {"triggered": 1, "streamed": 7, "extra_results": 4}
        assert [one.number for one in await queued(results)] == [*range(1, 9)]
        assert sizes == ([4, 3] if together else [])


@each_way
async def test_burst_beyond_the_queue_drops_the_oldest_or_ends_the_stream(
    *, together: bool
) -> None:
    async with by_hand() as (box, camera):
        streams: list[Any] = [
            camera.results(max_queue=3, overflow=overflow, batch=batch)
            for overflow in ("drop_oldest", "error")
            for batch in (False, True)
        ]
        await say(camera, box, *numbered(box, 5), together=together)
        for stream, expected in zip(
            streams, [[3, 4, 5], [3, 4, 5], [1, 2, 3], [1, 2, 3]], strict=True
        ):
            assert [one.number for one in await queued(stream)] == expected
        for stream in streams[2:]:
            with pytest.raises(SubscriberOverflowError):
                await anext(stream)
        assert [one.statistics().dropped for one in streams] == [2, 2, 1, 1]
        assert fates(camera) == {"streamed": 5}


async def test_bursts_of_many_reads_all_come_in_order() -> None:
    async with by_hand(interpret_as="n: int32") as (box, camera):
        sizes = bursts(camera)
        results, batch = (
            camera.results(max_queue=50_000),
            camera.results(max_queue=50_000, batch=True),
        )
        await say(camera, box, b"".join(numbered(box, 10_000)), together=True)
        assert [one.value.n for one in await queued(batch)] == [*range(10_000)]
        assert [one.number for one in await queued(results)] == [*range(1, 10_001)]
        assert fates(camera) == {"streamed": 10_000}
        assert max(sizes) <= MAX_CHUNK_FRAMES


# ---------------------------------------------------------------------- a trigger's deadline


def at_the_deadline(camera: Camera, then: Callable[[], object]) -> None:
    """Have something happen in the same turn of the loop, right behind the trigger's deadline."""
    alarm = inside(camera)._results._timer
    expire = alarm._callback

    def both() -> None:
        expire()
        then()

    alarm._callback = both


@pytest.mark.parametrize("count", [1, 3])
async def test_result_in_the_delivery_right_behind_the_deadline_is_late(count: int) -> None:
    async with by_hand() as (box, camera):
        results = camera.results()
        box.script[TRIGGER] = lambda _: box.inspects()  # its results come later
        at_the_deadline(camera, lambda: hear(camera, b"".join(numbered(box, count))))
        with pytest.raises(TriggerTimeoutError):
            await camera.trigger(timeout=SHORT)
        expected = {"late": 1, "streamed": count - 1} if count > 1 else {"late": 1}
        await until(lambda: fates(camera) == expected)
        assert [one.triggered_at for one in await queued(results)] == [None] * count
        box.script[TRIGGER] = box._trigger
        assert (await camera.trigger()).raw == b"found"


PLAIN = os.environ.get("SMARTCAM_DOORBELL") == "plain"  # what comes is handed on a turn later


@pytest.mark.parametrize("first", ["deadline", "cancel", *([] if PLAIN else ["result"])])
async def test_deadline_and_cancellation_in_one_turn_of_the_loop_are_one_end(first: str) -> None:
    async with by_hand() as (box, camera):
        box.script[TRIGGER] = lambda _: box.inspects()  # its result comes later
        triggering = asyncio.create_task(camera.trigger(timeout=60))
        await box.wait_for(TRIGGER)
        await behind_its_answers(camera)
        expire = inside(camera)._results._timer._callback

        def at_once(cancel: Callable[[], object]) -> None:
            if first == "deadline":
                expire()
            if first == "result":
                hear(camera, box.result_frame())
            cancel()
            expire()

        asyncio.get_running_loop().call_soon(at_once, triggering.cancel)
        await asyncio.wait({triggering})
        # a result wakes its caller at once, who has it then
        assert triggering.cancelled() == (first != "result")
        del triggering
        gc.collect()  # an exception that nobody has retrieved would be reported now
        if first != "result":
            assert fates(camera) == {}
            asyncio.get_running_loop().call_soon(hear, camera, box.result_frame())
            await until(lambda: bool(fates(camera)))
        assert fates(camera) == ({"triggered": 1} if first == "result" else {"late": 1})
        box.script[TRIGGER] = box._trigger
        assert (await camera.trigger()).raw == b"found"


async def test_trigger_whose_deadline_passes_while_the_camera_takes_no_bytes_ends_once() -> None:
    async with by_hand(close_timeout=SHORT) as (box, camera):
        results = camera.results()
        box.stop_reading()
        error = await gone(camera.trigger(input=bytes(1 << 25), timeout=SHORT))
        assert isinstance(error, TriggerTimeoutError)
        assert error.waited == pytest.approx(SHORT, abs=0.02)
        assert inside(camera)._results.correlation.pending is None
        await say(camera, box, box.result_frame(b"older"), together=True)
        assert fates(camera) == {"streamed": 1}  # the trigger has not reached the camera
        assert len(await queued(results)) == 1
        del error
        gc.collect()


async def test_deadline_then_cancellation_of_a_trigger_that_is_stuck_are_one_end() -> None:
    async with by_hand(close_timeout=SHORT) as (box, camera):
        box.stop_reading()
        triggering = asyncio.create_task(camera.trigger(input=bytes(1 << 25), timeout=60))
        await until(lambda: inside(camera)._results.correlation.pending)
        await steps(3)
        inside(camera)._results._timer._callback()
        await steps(1)
        await cancelled(triggering)
        del triggering
        gc.collect()
        await say(camera, box, box.result_frame(b"older"), together=True)
        assert fates(camera) == {"unclaimed": 1}  # the trigger has not reached the camera


async def test_closed_client_leaves_no_timer_of_a_trigger() -> None:
    async with by_hand() as (_, camera):
        await camera.trigger(timeout=60)
        await camera.trigger(timeout=90)
        alarm = inside(camera)._results._timer
        assert alarm._timer is not None
    assert alarm._timer is None


@pytest.mark.parametrize("one_each", [True, False])
def test_answer_of_a_trigger_and_its_result_are_never_cut_apart(one_each: bool) -> None:
    """Whoever waits for the answer would send the next trigger before the result is judged."""
    answer, result = m.TriggerAnswer(), m.ResultContainer(application=1, data=b"x", requested=True)
    events = [m.StatusReport(status=Status(0))] * 3 + [answer, result] + [m.GetStatus()] * 3
    frames = len(events) if one_each else len(events) - 1
    first, rest = split_chunk(Chunk(0.0, [*events], frames, 1), 4)
    assert first.events == events[:5]
    assert rest.events == events[5:]
