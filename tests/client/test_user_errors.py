"""Exceptions of the user's own code are told where they belong, and cost nothing."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import Any

import pytest

import smartcam
from smartcam import Camera, ConnectionClosedError, ConnectionLostError, InterpretationError, Status
from smartcam.emulator import EmulatedCamera
from smartcam.interpreters import Context, PlainInterpreter
from tests.client.clientkit import SOON, balance, cancelled, gone
from tests.emulator.builtins import LOCALIZATIONS
from tests.handmade import until
from tests.insides import inside


class OwnError(BaseException):
    """As other libraries have: no Exception."""


class UntoldError(Exception):
    """An error whose text cannot be had."""

    def __str__(self) -> str:
        raise OwnError("no text")

    __repr__ = __str__


ERRORS: dict[str, Callable[[], BaseException]] = {
    "Exception": lambda: KeyError("n"),
    "BaseException": lambda: OwnError("own"),
    "GeneratorExit": GeneratorExit,
    "BaseExceptionGroup": lambda: BaseExceptionGroup("several", [OwnError("own"), KeyError("n")]),
    "pytest's": lambda: pytest.fail.Exception("failed"),
    "CancelledError": asyncio.CancelledError,
    "StopIteration": lambda: StopIteration(1),
    "StopAsyncIteration": StopAsyncIteration,
    "without a text": UntoldError,
}
"""Exceptions that user code may raise, whatever the sense of it."""

ANY_ERROR = pytest.mark.parametrize("error", ERRORS.values(), ids=ERRORS)


class Bad:
    """User code that raises while it is told to.

    Args:
        make: makes the error.
    """

    def __init__(self, make: Callable[[], BaseException]) -> None:
        self.make = make
        self.raising = False
        self.raised: BaseException | None = None

    def __call__(self) -> None:
        if self.raising:
            self.raised = self.make()
            raise self.raised


class BadObserver(smartcam.Observer):
    """Raises at everything that it sees."""

    def __init__(self, bad: Bad) -> None:
        self.on_frame = self.on_state = self.on_result = self.on_error = lambda *_: bad()  # type: ignore[method-assign,assignment]


class BadPlain(PlainInterpreter):
    """Reads many containers at once, or raises."""

    def __init__(self, bad: Bad) -> None:
        super().__init__()
        self.bad = bad

    def read(self, data: bytes, context: Context) -> int:
        self.bad()
        return int.from_bytes(data, "little")


class BadCalibration:
    """Leaves poses as they are, or raises."""

    def __init__(self, bad: Bad) -> None:
        self.bad = bad

    def to_robot(self, localizations: Any) -> Any:
        self.bad()
        return localizations


def numbers(bad: Bad) -> Callable[[Any], int]:
    def read(reader: Any) -> int:
        bad()
        return int(reader.get_int32(0))

    return read


READ_BY: dict[str, Callable[[Bad], dict[str, Any]]] = {
    "function": lambda bad: {"interpret_as": numbers(bad)},
    "interpreter": lambda bad: {"interpret_as": BadPlain(bad)},
    "calibration": lambda bad: {"calibration": BadCalibration(bad)},
}
"""Options of a client that have a container read by the user's code."""


def box(rate: float | None = None) -> EmulatedCamera:
    application = {"generator": "sequence", "layout": "n: int32", "rate": rate}
    parts = {"layout": LOCALIZATIONS, "constant": []}
    return EmulatedCamera(
        [{"id": 1, **application}, {"id": 2, **parts}], builtins=False, running=True
    )


@pytest.mark.sampled(every=3)
@ANY_ERROR
@pytest.mark.parametrize("read_by", READ_BY.values(), ids=READ_BY)
async def test_what_reads_a_result_raises_in_its_trigger(
    read_by: Callable[[Bad], dict[str, Any]], error: Callable[[], BaseException]
) -> None:
    bad = Bad(error)
    options = read_by(bad)
    if "calibration" in options:
        options |= {"interpret_as": "localizations"}
    application = 2 if "calibration" in options else 1
    async with box() as emulator, smartcam.connect(emulator.url, **options) as camera:
        await camera.trigger(application)
        bad.raising = True
        for _ in range(2):
            with pytest.raises(InterpretationError) as caught:
                await camera.trigger(application)
            assert caught.value.__cause__ is bad.raised
        waiting = camera.next_result()
        results = camera.results()
        assert isinstance(await gone(camera.trigger(application)), InterpretationError)
        for one in (waiting, anext(results)):
            assert isinstance(await gone(one), InterpretationError)
        bad.raising = False
        await camera.trigger(application)
        account = camera.statistics()
        assert (account.sessions, account.uninterpretable) == (1, 3)
        balance(account)


@pytest.mark.parametrize("raises", [False, True])
async def test_interpreter_may_cancel_the_trigger_that_it_reads_for(raises: bool) -> None:
    callers: list[asyncio.Task[Any]] = []

    def read(reader: Any) -> int:
        if callers:
            callers.pop().cancel()
            if raises:
                raise ValueError("the caller is gone")
        return int(reader.get_int32(0))

    async with box() as emulator, smartcam.connect(emulator.url, interpret_as=read) as camera:
        first = await camera.trigger(1)
        caller = asyncio.create_task(camera.trigger(1))
        callers.append(caller)
        await asyncio.wait({caller})
        assert caller.cancelled()
        second = await camera.trigger(1)
        account = camera.statistics()
        assert (account.sessions, account.uninterpretable) == (1, int(raises))
        assert second.value == first.value + 2
        balance(account)


@ANY_ERROR
async def test_what_reads_many_results_raises_in_the_stream(
    error: Callable[[], BaseException],
) -> None:
    bad = Bad(error)
    options: dict[str, Any] = {"application": 1, "interpret_as": BadPlain(bad)}
    async with box(rate=1000.0) as emulator, smartcam.connect(emulator.url, **options) as camera:
        results = camera.results()
        bad.raising = True
        for _ in range(5):
            with pytest.raises(InterpretationError):
                await asyncio.wait_for(anext(results), SOON)
        bad.raising = False
        async with asyncio.timeout(SOON):
            while isinstance(await gone(anext(results)), InterpretationError):  # those of before
                pass
        assert camera.statistics().sessions == 1


@ANY_ERROR
async def test_observer_is_logged(
    error: Callable[[], BaseException], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.ERROR)
    bad = Bad(error)
    bad.raising = True
    options: dict[str, Any] = {"observers": [BadObserver(bad)]}
    async with box() as emulator, smartcam.connect(emulator.url, **options) as camera:
        for _ in range(2):
            await camera.trigger(1)
        emulator.inject({"kind": "reset"})
        assert isinstance(await gone(camera.trigger(1)), ConnectionLostError)
        await camera.wait_connected()
        await camera.trigger(1)
    assert {record.message.partition(":")[0] for record in caplog.records} == {
        "! an observer failed"
    }


@ANY_ERROR
async def test_predicate_raises_where_it_was_given(error: Callable[[], BaseException]) -> None:
    bad = Bad(error)

    def never(_: Status) -> bool:
        bad()
        return False

    async with box() as emulator, smartcam.connect(emulator.url) as camera:
        waiting = asyncio.ensure_future(camera.wait_status(never))
        other = asyncio.ensure_future(camera.wait_status(lambda _: False, timeout=1.0))
        await until(lambda: len(inside(camera)._waits.status_waiters) == 2)
        bad.raising = True
        await camera.trigger(1)
        raised = await gone(waiting)
        if isinstance(bad.raised, StopIteration):  # no coroutine may raise that
            raised = raised.__cause__ if raised is not None else None
        assert raised is bad.raised or isinstance(bad.raised, asyncio.CancelledError)
        assert isinstance(await gone(other), smartcam.ResponseTimeoutError)
        assert camera.statistics().sessions == 1


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_what_ends_the_program_ends_it(error: type[BaseException]) -> None:
    ended: list[str] = []

    async def main() -> None:
        bad = Bad(error)
        options: dict[str, Any] = {"interpret_as": numbers(bad)}
        async with box() as emulator, smartcam.connect(emulator.url, **options) as camera:
            bad.raising = True
            try:
                await camera.trigger(1)
            finally:
                ended.append("the trigger")
        ended.append("all is closed")

    with pytest.raises(error):
        asyncio.run(main())
    assert ended == ["the trigger"]


async def test_client_whose_own_task_is_cancelled_says_so() -> None:
    async with box() as emulator, smartcam.connect(emulator.url) as camera:
        (supervisor,) = (t for t in asyncio.all_tasks() if t.get_name().endswith(".supervisor"))
        waiting = asyncio.ensure_future(camera.wait_status(lambda _: False))
        results = camera.results()
        await until(lambda: inside(camera)._waits.status_waiters)
        await cancelled(supervisor)
        for one in (waiting, anext(results), camera.trigger()):
            error = await gone(one)
            assert isinstance(error, ConnectionLostError)
            assert isinstance(error.__cause__, asyncio.CancelledError)
        assert not camera.connected


@pytest.mark.parametrize("turns", range(6))
async def test_close_ends_open_however_soon_it_comes(turns: int) -> None:
    async with box() as emulator:
        camera: Camera = smartcam.connect(emulator.url)
        opening = asyncio.ensure_future(camera.open())
        for _ in range(turns + 1):
            await asyncio.sleep(0)
        await camera.close()
        error = await gone(opening)
        assert error is None or isinstance(error, ConnectionClosedError)
        with pytest.raises(ConnectionClosedError):
            await camera.trigger()
