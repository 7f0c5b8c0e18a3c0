"""The gate of commands: their order, reservations, and the end of waiting callers."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from random import Random

import pytest

from tests.client.clientkit import steps
from tests.fleet.inside import Gate
from tests.handmade import until


@contextlib.asynccontextmanager
async def turn(gate: Gate, program: str, timeout: float) -> AsyncIterator[None]:
    """A command of a program, as long as the body runs."""
    await gate.enter(program, timeout)
    try:
        yield
    finally:
        gate.leave(program)


class Work:
    """Commands and reservations of programs, as tasks; ``order`` has what was granted, in order."""

    def __init__(self) -> None:
        self.gate = Gate()
        self.order: list[str] = []
        self.tasks: list[asyncio.Task[None]] = []
        self.ends: dict[str, asyncio.Event] = {}

    def command(self, program: str, name: str, timeout: float = 60.0) -> asyncio.Task[None]:
        """Begin a command that lasts until it is told to end."""

        async def run() -> None:
            async with turn(self.gate, program, timeout):
                self.order.append(name)
                await self.ends[name].wait()

        return self._start(name, run())

    def reserve(self, program: str, name: str, timeout: float = 60.0) -> asyncio.Task[None]:
        """Begin a reservation that lasts until it is told to end."""

        async def run() -> None:
            await self.gate.reserve(program, name, timeout)
            self.order.append(name)
            try:
                await self.ends[name].wait()
            finally:
                self.gate.release(name)

        return self._start(name, run())

    def _start(self, name: str, work: object) -> asyncio.Task[None]:
        self.ends[name] = asyncio.Event()
        task = asyncio.ensure_future(work)  # type: ignore[call-overload]
        self.tasks.append(task)
        return task  # type: ignore[no-any-return]

    async def end(self, *names: str) -> None:
        """Have some end."""
        for name in names:
            self.ends[name].set()
        await steps(10)

    def check_clean(self) -> None:
        """See that nothing is left."""
        gate = self.gate
        assert gate.holder is None
        assert (len(gate._running_commands), len(gate._queue), len(gate._reservations)) == (0, 0, 0)


@pytest.fixture
async def work() -> AsyncIterator[Work]:
    made = Work()
    yield made
    for one in made.ends.values():
        one.set()
    for task in made.tasks:
        task.cancel()
    await asyncio.gather(*made.tasks, return_exceptions=True)
    made.check_clean()


async def test_commands_run_side_by_side_where_nobody_has_reserved(work: Work) -> None:
    for number in range(3):
        work.command(f"p{number}", f"c{number}")
    await steps(5)
    assert work.order == ["c0", "c1", "c2"]


async def test_reservation_waits_for_what_runs_and_keeps_out_what_comes(work: Work) -> None:
    work.command("a", "a1")
    work.command("b", "b1")
    await steps(5)
    work.reserve("a", "a2")
    work.command("b", "b2")
    await steps(5)
    assert work.order == ["a1", "b1"]
    await work.end("b1")
    assert work.order == ["a1", "b1", "a2"]
    assert work.gate.holder == "a"
    work.command("a", "a3")
    await steps(5)
    assert work.order[3:] == ["a3"]
    await work.end("a3", "a1")
    assert work.order[4:] == []
    await work.end("a2")
    assert work.order[4:] == ["b2"]


async def test_reservations_are_granted_in_order_and_none_overtakes(work: Work) -> None:
    for name in ("a", "b", "c"):
        work.reserve(name, f"r{name}")
    work.command("d", "cd")
    work.reserve("a", "ra2")  # it has the camera: no need to wait
    await steps(5)
    assert work.order == ["ra", "ra2"]
    await work.end("ra")
    assert work.order == ["ra", "ra2"]
    await work.end("ra2")
    await work.end("rb")
    await work.end("rc")
    assert work.order == ["ra", "ra2", "rb", "rc", "cd"]


async def test_wait_ends_with_its_timeout_and_leaves_the_others_their_places(work: Work) -> None:
    work.reserve("a", "ra")
    await steps(5)
    late = [work.command("b", "b", 1.0), work.reserve("c", "c", 2.0)]
    work.command("d", "d")
    await asyncio.wait(late)
    assert all(isinstance(task.exception(), TimeoutError) for task in late)
    assert work.order == ["ra"]
    await work.end("ra")
    assert work.order == ["ra", "d"]


async def test_command_is_not_kept_out_by_a_reservation_that_nobody_waits_for(work: Work) -> None:
    work.command("a", "a")
    await steps(5)
    waiting = work.reserve("b", "b", 1.0)
    work.command("c", "c")
    await steps(5)
    assert work.order == ["a"]
    await asyncio.wait({waiting})
    await steps(5)
    assert work.order == ["a", "c"]


async def test_release_ends_a_reservation_once_and_none_of_others(work: Work) -> None:
    work.reserve("a", "ra")
    work.reserve("b", "rb")
    await steps(5)
    work.gate.release("nobody's")
    assert work.gate.holder == "a"
    work.gate.release("ra")
    await steps(5)
    work.gate.release("ra")
    assert work.gate.holder == "b"


async def test_forgotten_program_has_no_reservation_any_more(work: Work) -> None:
    gone = [work.reserve("a", "ra"), work.reserve("a", "ra2"), work.command("a", "ca")]
    work.command("b", "cb")
    await steps(5)
    assert work.order == ["ra", "ra2", "ca"]
    for task in gone:  # as the agent does
        task.cancel()
    work.gate.lose_program("a")
    await asyncio.wait(gone)
    await steps(5)
    assert work.gate.holder is None
    assert work.order[3:] == ["cb"]


async def test_program_that_is_gone_while_it_waits_gets_nothing(work: Work) -> None:
    work.reserve("a", "ra")
    waiting = work.reserve("b", "rb")
    work.command("c", "cc")
    await steps(5)
    waiting.cancel()
    work.gate.lose_program("b")
    assert work.gate.holder == "a"
    await work.end("ra")
    assert work.order == ["ra", "cc"]


@pytest.mark.parametrize("kind", ["command", "reserve"])
@pytest.mark.parametrize("free_first", [True, False])
@pytest.mark.parametrize("count", range(8))
async def test_cancelled_at_any_await_leaves_the_gate_open(
    work: Work, kind: str, free_first: bool, count: int
) -> None:
    """Cancelled after so many steps, as the camera is just let go or not: granted or waiting."""
    work.reserve("a", "ra")
    await steps(5)
    one = getattr(work, kind)("b", "b")
    if free_first:
        work.ends["ra"].set()
    await steps(count)
    one.cancel()
    work.ends["ra"].set()
    with contextlib.suppress(asyncio.CancelledError):
        await one
    await steps(5)
    work.check_clean()
    work.command("c", "c")
    await until(lambda: "c" in work.order)


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("seed", range(20))
async def test_nobody_is_between_whatever_happens(seed: int) -> None:
    """Hundreds of programs that reserve, command, give up and go: nobody is ever between."""
    chance = Random(seed)  # noqa: S311
    gate, inside, done = Gate(), dict[str, int](), [0]
    held: str | None = None

    async def command(program: str) -> None:
        async with turn(gate, program, chance.uniform(0, 0.02)):
            assert held in {None, program}
            await asyncio.sleep(chance.uniform(0, 0.003))
            assert held in {None, program}
            done[0] += 1

    async def live(program: str) -> None:
        nonlocal held
        if chance.random() < 0.5:
            await command(program)
            return
        await gate.reserve(program, program, chance.uniform(0, 0.05))
        try:
            assert held is None
            held = program
            for _ in range(chance.randrange(4)):
                inside[program] = inside.get(program, 0) + 1
                await command(program)
        finally:
            held = None
            gate.release(program)

    tasks: list[asyncio.Task[None]] = []
    for number in range(200):
        program = f"p{number}"
        task = asyncio.create_task(live(program))
        tasks.append(task)
        if chance.random() < 0.2:
            asyncio.get_running_loop().call_later(chance.uniform(0, 0.02), task.cancel)
        await asyncio.sleep(chance.uniform(0, 0.002))
    ends = await asyncio.gather(*tasks, return_exceptions=True)
    odd = [end for end in ends if not isinstance(end, (TimeoutError, asyncio.CancelledError))]
    assert [end for end in odd if end is not None] == []
    assert done[0] > 20
    assert inside
    assert (gate.holder, len(gate._running_commands), len(gate._queue)) == (None, 0, 0)
