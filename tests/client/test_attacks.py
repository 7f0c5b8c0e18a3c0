"""Attacks on the promise that no late result is taken for a current one, step by step.

The camera does exactly what the promises assume of it; its line holds what the script says. No test
depends on how fast anything is: what is judged is whose the result is.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence
from typing import Any

import pytest

import smartcam
from smartcam.camera import Camera
from smartcam.exceptions import OvertriggeredError, SmartCamError, TriggerTimeoutError
from smartcam.models import Result
from tests.client.clientkit import TriggerEar, balance, cancelled, nothing_unheard
from tests.client.line_camera import AGAIN, LAYOUTS, LineCamera, Run, Step
from tests.handmade import until

SHORT = 0.05
"""Seconds of a timeout that is meant to fire."""

LONG = 30.0
"""Seconds of one that is not."""

IDLE = 100
"""Loop steps in which a client that has something to send without waiting sends it."""

FRAMED = ("handbook", "thesis", "b16")
WIDTHS = {"int32": 32, "int16": 16, "int8": 8}

AT_ONCE: Sequence[Step] = ((0.0, 0), (0.0, AGAIN))
LATE: Sequence[Step] = ((None, 0), (0.0, AGAIN))
"""The inspection takes until it is told to go on."""

LATE_RESULT: Sequence[Step] = ((0.0, AGAIN), (None, 0))
"""It waits for a trigger again at once; its result comes when it is told to, or at the next run."""

LATE_SECOND: Sequence[Step] = ((0.0, 0), (0.0, AGAIN), (None, 1))


class Attack:
    """A camera on a line, a client in a session with it, and who is asked whose a result is."""

    def __init__(self, box: LineCamera, camera: Camera, ear: TriggerEar) -> None:
        self.box = box
        self.camera = camera
        self.ear = ear

    def plans(self, *plans: Sequence[Step]) -> None:
        """Have the runs from now on go like this, those behind the last one at once."""
        planned = iter(plans)
        self.box.plan = lambda _: next(planned, AT_ONCE)

    def call(self, **options: Any) -> asyncio.Task[Result]:
        """Trigger in a task of its own."""
        return asyncio.create_task(self.camera.trigger(**{"timeout": LONG, **options}))

    async def triggered(self, count: int) -> None:
        """Wait until so many Trigger messages have come to the camera's socket."""
        await until(lambda: self.box.arrived >= count)

    async def heard(self, count: int) -> None:
        """Wait until so many containers have come to the client."""
        await until(lambda: self.camera.statistics().received >= count)

    async def rests(self) -> None:
        """Wait until the client has sent all that it sends without hearing anything."""
        steps, seen = 0, self.box.writes
        while steps < IDLE:
            await asyncio.sleep(0)
            steps, seen = (steps + 1 if seen == self.box.writes else 0), self.box.writes

    def run_of(self, result: Result) -> Run:
        return self.box.runs[result.value.run]

    def assert_own(self, result: Result) -> None:
        """Assert that the result is of the Trigger message that was sent last."""
        run = self.run_of(result)
        assert (run.session, run.trigger) == self.ear.last

    async def works(self, calls: int = 3) -> None:
        """Assert that triggers have their own results, and that no container was lost."""
        for _ in range(calls):
            self.assert_own(await self.camera.trigger(timeout=LONG))
        balance(self.camera.statistics())
        await until(lambda: self.box.idle)
        await self.camera.query_application()
        assert self.camera.statistics().received == self.box.sent_since(self.box.sessions)


@contextlib.asynccontextmanager
async def attack(number: str = "", *, seen: int = 1, **box: Any) -> AsyncIterator[Attack]:
    """Have a session in which ``seen`` triggers went well; ``number`` is that of the layout."""
    ear = TriggerEar()
    async with (
        nothing_unheard(),
        LineCamera(**box) as made,
        smartcam.connect(
            made.url, interpret_as=LAYOUTS[number], reconnect=None, observers=[ear]
        ) as camera,
    ):
        one = Attack(made, camera, ear)
        for _ in range(seen):
            one.assert_own(await camera.trigger(timeout=LONG))
        yield one


async def by_cancelling(_: Attack, call: asyncio.Task[Result]) -> None:
    await cancelled(call)


async def by_timeout(_: Attack, call: asyncio.Task[Result]) -> None:
    with pytest.raises(TriggerTimeoutError):
        await call


given_up = pytest.mark.parametrize(
    ("timeout", "ends"), [(LONG, by_cancelling), (SHORT, by_timeout)], ids=["cancelled", "timeout"]
)
framed = pytest.mark.parametrize("dialect", FRAMED)


# ---------------------------------------------------------------------- all triggers are ours


@given_up
@framed
async def test_second_result_does_not_pay_what_the_next_trigger_owes(
    dialect: str, timeout: float, ends: Any
) -> None:
    """D1."""
    async with attack(dialect=dialect) as one:
        one.plans(LATE_SECOND)
        one.assert_own(await one.camera.trigger(timeout=LONG))
        await until(lambda: smartcam.Status.WAITING_FOR_TRIGGER in one.camera.status)
        one.box.towards.hold()
        given_up = one.call(timeout=timeout)
        await one.triggered(3)
        await ends(one, given_up)  # the trigger is still on its way
        one.box.let_out()
        await one.heard(3)
        following = one.call()
        await one.rests()
        one.box.towards.release()
        one.assert_own(await following)
        await one.works()


@framed
async def test_second_results_of_each_trigger_shift_nothing(dialect: str) -> None:
    """D1, again and again: each second trigger is given up while a second result is in flight."""
    async with attack(dialect=dialect) as one:
        for _ in range(10):
            one.plans(LATE_SECOND)
            one.assert_own(await one.camera.trigger(timeout=LONG))
            await until(lambda: smartcam.Status.WAITING_FOR_TRIGGER in one.camera.status)
            one.box.towards.hold()
            given_up, came = one.call(), one.box.arrived
            await one.triggered(came + 1)
            await cancelled(given_up)
            received = one.camera.statistics().received
            one.box.let_out()
            await one.heard(received + 1)
            following = one.call()
            await one.rests()
            one.box.towards.release()
            one.assert_own(await following)
        await one.works()


@pytest.mark.parametrize(
    "plan",
    [
        LATE_SECOND,
        ((0.0, AGAIN), (0.0, 0), (None, 1)),
        ((0.0, 0), (None, AGAIN), (None, 1)),
        ((0.0, AGAIN), (None, 0), (None, 1)),
    ],
    ids=["second", "waiting, first, second", "first; waiting; second", "waiting; both"],
)
@pytest.mark.parametrize("dialect", FRAMED)
async def test_first_trigger_of_a_client_does_not_get_what_its_predecessor_left(
    dialect: str, plan: Sequence[Step]
) -> None:
    """D4."""
    ear = TriggerEar()
    layout = LAYOUTS[""]
    async with nothing_unheard(), LineCamera(dialect=dialect) as box:
        options: dict[str, Any] = {"interpret_as": layout, "observers": [ear]}
        async with smartcam.connect(box.url, **options) as camera:
            box.plan = lambda _: plan
            first = asyncio.create_task(camera.trigger(timeout=LONG))
            await until(lambda: box.triggers == 1)
            if plan[0][1] == AGAIN and plan[1][0] is None:  # the program ends without a result
                await cancelled(first)
            else:
                assert box.runs[(await first).value.run].trigger == 1
        box.plan = lambda _: AT_ONCE
        async with smartcam.connect(box.url, **options) as camera:
            one = Attack(box, camera, ear)

            def before(_: int, __: int | None) -> None:
                box.let_out()

            box.before = before  # what is left comes while the trigger is on its way
            following = one.call()
            await one.rests()
            if not box.takes_trigger:  # it waits for that
                box.let_out()
            one.assert_own(await following)
            await one.works()


# ---------------------------------------------------------------------- a sensor triggers too


@given_up
@framed
async def test_sensors_result_does_not_pay_what_a_trigger_owes(
    dialect: str, timeout: float, ends: Any
) -> None:
    """D2."""
    async with attack(dialect=dialect) as one:
        one.box.towards.hold()
        given_up = one.call(timeout=timeout)
        await one.triggered(2)
        await ends(one, given_up)  # the trigger is still on its way
        one.box.sensor()
        await one.heard(2)
        following = one.call()
        await one.rests()
        one.box.towards.release()
        one.assert_own(await following)
        await one.works()


@framed
async def test_sensors_inspection_in_front_of_a_trigger_is_not_taken_for_its_own(
    dialect: str,
) -> None:
    """D3: it is over and on the line when the trigger goes out; nothing is shifted by it."""
    async with attack(dialect=dialect, seen=3) as one:

        def sensor(trigger: int, _: int | None) -> None:
            if trigger == 4:
                one.box.sensor()

        one.box.before = sensor
        hit = await one.camera.trigger(timeout=LONG)
        assert [await shifted(one) for _ in range(10)] == [False] * 10
        assert one.run_of(hit).trigger == 4
        await one.works()


@framed
async def test_one_event_of_a_sensor_shifts_nothing(dialect: str) -> None:
    """D3: it triggers right before ours comes: nobody can tell whose the result is."""
    async with attack(dialect=dialect, seen=3) as one:
        box = one.box

        def sensor(trigger: int, _: int | None) -> None:
            if trigger == 4:
                box.sensor()
                box.flush()
                box.back.hold()  # our own inspection begins, and is on the line

        box.between = sensor
        hit = one.call()
        with pytest.raises(
            OvertriggeredError, match="it is unknown to which trigger the result belongs"
        ):
            await shifted(one, hit)
        assert [await shifted(one) for _ in range(10)] == [False] * 10
        box.back.release()
        await one.works()


async def shifted(one: Attack, call: asyncio.Task[Result] | None = None) -> bool:
    """Trigger, have what is on the line come one by one, say whether the result is another's."""
    call = call or one.call()
    await one.rests()
    while not call.done() and not one.box.back.empty:
        one.box.back.pass_on()
        await one.rests()
    if not call.done():
        one.box.back.release()
    run = one.run_of(await call)
    return (run.session, run.trigger) != one.ear.last


WORDS = {"handbook": 3, "thesis": 3, "b16": 3, "bid": 4}
"""Messages of the write that brings a trigger, without its number."""

SENSORS: dict[str, list[Sequence[Step]]] = {
    "one": [AT_ONCE],
    "two": [AT_ONCE, AT_ONCE],
    "a long one": [LATE],
    "one whose result waits": [LATE_RESULT],  # which in ``bid`` none does
}
"""Inspections that a sensor begins."""

BETWEEN = [
    pytest.param(dialect, number, word, runs, id=f"{dialect}-{number or 'no number'}-{word}-{name}")
    for dialect, words in WORDS.items()
    for number in (["", "int32", "int8"] if dialect != "bid" else [""])
    for word in range(words + bool(number))
    for name, runs in SENSORS.items()
    if not (dialect == "bid" and runs == [LATE_RESULT])
]


@pytest.mark.sampled(every=5)
@pytest.mark.parametrize(("dialect", "number", "word", "runs"), BETWEEN)
async def test_sensors_inspection_between_two_words_is_never_the_triggers(
    dialect: str, number: str, word: int, runs: list[Sequence[Step]]
) -> None:
    """It begins in front of one of the messages that a trigger is written with."""
    async with attack(number, dialect=dialect, seen=2) as one:
        box = one.box

        def sensor(trigger: int, at: int) -> None:
            if trigger == 3 and at == word:
                one.plans(*runs)
                for _ in runs:
                    box.sensor()
                    box.flush()

        box.at_word = sensor
        call = one.call()
        await one.rests()
        box.let_out()
        try:
            one.assert_own(await call)
        except OvertriggeredError:
            # behind the first Query nobody can tell whose it is; a long one has ours dropped
            assert word > 0 or runs == [LATE]
        box.let_out()
        await one.works()


ORDERS: dict[str, Sequence[Step]] = {
    "result first": AT_ONCE,
    "result last": ((0.0, AGAIN), (0.0, 0)),
    "two results": ((0.0, 0), (0.0, AGAIN), (0.0, 1)),
    "no result": ((0.0, AGAIN),),
}
MAX_SAID = 6
"""Messages that a camera says of a trigger, at most."""


@pytest.mark.sampled(every=4)
@pytest.mark.parametrize("heard", range(MAX_SAID + 1))
@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize(
    ("dialect", "number", "ends"),
    [
        ("handbook", "", by_cancelling),
        ("bid", "", by_cancelling),
        *(
            pytest.param(dialect, number, ends, marks=pytest.mark.long)
            for dialect in WORDS
            for number in (["", "int32", "int8"] if dialect != "bid" else [""])
            for ends in (by_cancelling, by_timeout)
        ),
    ],
)
async def test_trigger_given_up_behind_each_message_of_the_camera_leaves_the_next_its_own(
    dialect: str, number: str, ends: Any, order: str, heard: int
) -> None:
    """The next one is sent before the rest has come, or is said behind it."""
    async with attack(number, dialect=dialect, seen=2) as one:
        box = one.box
        box.says_singly = True

        def hold(trigger: int, at: int) -> None:
            if (trigger, at) == (3, 0):
                box.back.hold()

        box.at_word = hold
        one.plans(ORDERS[order])
        call = one.call(timeout=SHORT if ends is by_timeout else LONG)
        await one.triggered(3)
        for _ in range(heard):
            if not box.back.empty:
                box.back.pass_on()
                await one.rests()
        if call.done():
            one.assert_own(await call)
        else:
            await ends(one, call)
        balance(one.camera.statistics())
        following = one.call()
        await one.rests()
        box.back.release()
        one.assert_own(await following)
        await one.works()


# ---------------------------------------------------------------------- with a number


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("runs", [998, 999, 1000, 1001])
@pytest.mark.parametrize("dialect", ["handbook", "b16"])
async def test_thousandth_run_of_a_sensor_does_not_carry_our_next_number(
    dialect: str, runs: int
) -> None:
    """D5."""
    async with attack("int32", dialect=dialect, seen=2) as one:
        one.box.sensor_runs(runs - 1)
        await one.heard(2 + runs - 1)

        def last(trigger: int, _: int | None) -> None:
            if trigger == 3:
                one.box.sensor_runs(1)

        one.box.before = last  # it is on the line when our trigger goes out
        one.assert_own(await one.camera.trigger(timeout=LONG))
        await one.works()


NIGHT = 1_100
"""Runs of a sensor between two triggers, at most; those of a narrow field go round once."""


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("off", [-1, 0, 1])
@pytest.mark.parametrize("number", WIDTHS)
async def test_sensors_run_that_carries_our_next_number_is_not_ours(number: str, off: int) -> None:
    """D5: whatever number our next trigger has, a sensor's run that carries it is in flight."""
    bits = WIDTHS[number]
    # where a field is narrow all of its numbers come, in time
    night = max(NIGHT, 1 << bits) if bits < 32 else NIGHT
    async with attack(number, seen=2) as one:
        box = one.box

        def sensor(trigger: int, ours: int | None) -> None:
            if trigger == 3:
                assert ours is not None
                runs = (ours - box.next_number + 1 + off) % (1 << bits)
                box.sensor_runs(min(runs, night))

        box.before = sensor
        one.assert_own(await one.camera.trigger(timeout=LONG))
        await one.works()


@given_up
@framed
async def test_number_that_was_set_by_hand_is_not_set_again(
    dialect: str, timeout: float, ends: Any
) -> None:
    """D6: a trigger without number has it already."""
    async with attack("int32", dialect=dialect) as one:
        await one.camera.set_sequence_number(500)
        one.plans(LATE_RESULT)
        given_up = one.call(interpret_as=LAYOUTS[""], timeout=timeout)
        await until(lambda: one.box.triggers == 2)
        await ends(one, given_up)
        one.box.before = lambda _, __: one.box.let_out()
        one.assert_own(await one.camera.trigger(timeout=LONG))
        await one.works()


async def test_number_that_was_set_by_hand_is_the_next_runs() -> None:
    async with attack("int32") as one:
        await one.camera.set_sequence_number(500)
        result = await one.camera.trigger(interpret_as=LAYOUTS[""], timeout=LONG)
        one.assert_own(result)
        assert result.value.number == 500
        await one.works()


@pytest.mark.parametrize("number", ["", *WIDTHS])
@framed
async def test_trigger_behind_one_cancelled_right_after_its_sending_has_its_result(
    dialect: str, number: str
) -> None:
    """D8: its inspection takes its time, and nobody has heard yet that it has begun."""
    async with attack(number, dialect=dialect) as one:
        one.plans(LATE)
        one.box.back.hold()
        given_up = one.call()
        await one.triggered(2)
        await cancelled(given_up)
        following = one.call()
        await one.rests()
        one.box.back.release()
        for _ in range(10):  # it may have more to ask meanwhile
            await one.rests()
        one.box.let_out()
        one.assert_own(await following)
        await one.works()
        assert one.box.overtriggers == one.camera.statistics().overtriggers == 0


@pytest.mark.parametrize("copies", [2, 3])
async def test_doubled_datagram_is_no_second_result(copies: int) -> None:
    """D12."""
    async with attack("int32", transport="udp") as one:
        one.plans(((0.0, 0), (None, 1), (0.0, AGAIN)))
        one.box.network = lambda message_id: (0.0,) * (copies if message_id == 0x20 else 1)
        both = asyncio.create_task(one.camera.trigger(timeout=LONG, results_per_trigger=2))
        await one.triggered(2)
        await one.heard(1 + copies)
        one.box.let_out()
        results = await both
        for result in results:
            one.assert_own(result)
        assert [result.value.part for result in results] == [0, 1]


# ---------------------------------------------------------------------- bid


@given_up
async def test_bid_sensors_result_before_the_answer_to_a_trigger_is_not_ours(
    timeout: float, ends: Any
) -> None:
    """D3 and D2 in a dialect whose status is asked for."""
    async with attack(dialect="bid", seen=3) as one:
        box = one.box
        box.before = lambda trigger, _: box.sensor() if trigger == 4 else None
        one.assert_own(await one.camera.trigger(timeout=LONG))
        one.assert_own(await one.camera.trigger(timeout=LONG))
        one.plans(LATE)
        given_up = one.call(timeout=timeout)
        await until(lambda: box.triggers == 6)
        await ends(one, given_up)
        following = one.call()
        for _ in range(10):
            await one.rests()
        box.let_out()
        box.sensor()
        one.assert_own(await following)
        balance(one.camera.statistics())


async def test_bid_trigger_that_a_sensors_inspection_drops_has_no_result() -> None:
    """Its inspection was begun before ours came, and ends behind the answer to ours."""
    async with attack(dialect="bid", seen=3) as one:
        box = one.box

        def sensor(trigger: int, _: int | None) -> None:
            if trigger == 4:
                one.plans(((None, 0), (None, AGAIN)))
                box.sensor()

        box.before = sensor
        dropped = one.call()
        await until(lambda: box.triggers == 4)
        box.let_out()
        with contextlib.suppress(SmartCamError):
            result = await dropped
            one.assert_own(result)
        box.let_out()
        for _ in range(3):
            one.assert_own(await one.camera.trigger(timeout=LONG))


@pytest.mark.parametrize("give_up", [by_cancelling, by_timeout])
@pytest.mark.parametrize(
    ("dialect", "number"),
    [*((dialect, number) for dialect in FRAMED for number in ["", *WIDTHS]), ("bid", "")],
)
async def test_result_that_came_before_its_proof_is_not_the_next_triggers(
    dialect: str, number: str, give_up: Any
) -> None:
    """The call is given up between its result and the answer that would prove it."""
    async with attack(number, dialect=dialect) as one:
        box, last = one.box, WORDS[dialect] + bool(number) - 1

        def hold(trigger: int, at: int) -> None:
            if trigger == 2 and at == last:
                box.flush()
                box.back.hold()

        box.at_word = hold
        call = one.call(timeout=SHORT if give_up is by_timeout else LONG)
        await until(lambda: len(box.sent) == 2)
        await one.rests()
        await give_up(one, call)
        following = one.call()
        await one.rests()
        box.back.release()
        one.assert_own(await following)
        await one.works()
