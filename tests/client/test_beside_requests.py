"""A trigger beside what other tasks ask the same camera: it ends as the list of outcomes says."""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import Callable, Coroutine
from datetime import datetime
from functools import partial
from typing import Any, Literal

import pytest

import smartcam
from smartcam import Backoff, Camera
from smartcam.emulator import EmulatedCamera, EmulatedInSight
from smartcam.protocols import messages as m
from tests.client.clientkit import balance
from tests.timed_loop import TimedLoop

OUTCOMES = (
    smartcam.OvertriggeredError,
    smartcam.NotRunningError,
    smartcam.CameraBusyError,
    smartcam.CameraFaultError,
    smartcam.InputContainerError,
    smartcam.TriggerTimeoutError,
    smartcam.WrongApplicationError,
    smartcam.InterpretationError,
    smartcam.CommandRejectedError,
    smartcam.UnsupportedError,
    smartcam.ConnectionLostError,
    smartcam.ConnectionTakenError,
    smartcam.ConnectionClosedError,
)
"""The errors of docs/promises.md#one-outcome."""

FAMILIES = (smartcam.ResponseTimeoutError, *OUTCOMES)
"""Errors that any other request may end with."""

STEP = 0.001
"""Seconds that a turn of the loop takes: pauses of some turns fall anywhere in a command."""

TRIGGERS = 12

Ask = Callable[[Camera], Coroutine[Any, Any, object]]

ASKS: dict[type[m.Message], tuple[Ask, ...]] = {
    m.GetStatus: (
        lambda c: c.query_status(),
        lambda c: c.wait_status(lambda _: False, timeout=5 * STEP),
    ),
    m.Query: (lambda c: c.query_application(), lambda c: c.query_application(timeout=STEP)),
    m.GetClock: (lambda c: c.get_clock(), lambda c: c.get_clock(timeout=STEP)),
    m.SetClock: (lambda c: c.set_clock(datetime(2024, 1, 2)),),  # noqa: DTZ001 - the camera's
    m.ResetErrors: (lambda c: c.reset_errors(),),
    m.SetInput: (lambda c: c.set_input(b"\1\0\0\0"),),
    m.SetSequenceNumber: (lambda c: c.set_sequence_number(7),),
    m.SwitchApplication: (lambda c: c.switch_application(2),),
    m.Start: (lambda c: c.start(),),
    m.Stop: (lambda c: c.stop(),),
    m.ReadImage: (lambda c: c.read_image(),),
}
"""Questions beside triggers, where the dialect has the message."""

RAW: tuple[type[m.Message], ...] = (m.Query, m.GetStatus, m.GetClock, m.ResetErrors, m.Trigger)
"""Questions by their ids, where the dialect has ids."""


def bvs(dialect: str, transport: Literal["tcp", "udp"]) -> EmulatedCamera:
    application = {
        "layout": "n: int32",
        "input": "part: int32",
        "generator": "sequence",
        "load_time": 3 * STEP,
        "processing_time": 4 * STEP,
    }
    applications = [{"id": 1, **application}, {"id": 2, **application}]
    return EmulatedCamera(
        applications, dialect=dialect, transport=transport, running=True, builtins=False
    )


def insight() -> EmulatedInSight:
    jobs = [
        {
            "file": f"{n}.job",
            "load_time": 3 * STEP,
            "acquisition_time": 2 * STEP,
            "processing_time": 2 * STEP,
            "cells": {"A1": 1},
        }
        for n in (1, 2)
    ]
    return EmulatedInSight(jobs, online=True)


CAMERAS: dict[str, Callable[[], Any]] = {"in-sight": insight}
for one in ("handbook", "thesis", "b16", "bid"):
    CAMERAS |= {f"{one} over tcp": partial(bvs, one, "tcp")}
    CAMERAS |= {f"{one} over udp": partial(bvs, one, "udp")}


def asks_of(camera: Camera) -> list[Ask]:
    """Return all that can be asked of a camera beside its triggers."""
    dialect = camera._connection.dialect  # type: ignore[attr-defined]
    asks = [ask for kind, some in ASKS.items() if dialect.has(kind) for ask in some]
    for kind in RAW:
        if dialect.has(kind) and hasattr(dialect, "answer_id"):
            asks += [
                partial(_raw, dialect.message_id(kind), answered) for answered in (None, False)
            ]
    return asks


async def _raw(number: int, answered: bool | None, camera: Camera) -> object:
    return await camera.request(number, answered=answered, timeout=20 * STEP)


async def beside_each_other(made: Any, seed: int) -> tuple[Counter[str], Counter[str]]:
    """Trigger while three tasks ask; return how the triggers and the other calls ended."""
    chance = random.Random(seed)  # noqa: S311
    triggers, others = Counter[str](), Counter[str]()
    done = asyncio.Event()

    async def pause() -> None:
        for _ in range(chance.choice((0, 0, 1, 1, 2, 3, 5, 8))):
            await asyncio.sleep(0)

    async def ask(camera: Camera, asks: list[Ask]) -> None:
        while not done.is_set():
            await pause()
            try:
                await chance.choice(asks)(camera)
            except smartcam.SmartCamError as error:
                others[type(error).__name__] += 1
                assert isinstance(error, FAMILIES), error  # noqa: PT017 - any of them will do
            else:
                others["done"] += 1
            await asyncio.sleep(0)

    async def trigger(camera: Camera) -> None:
        for _ in range(TRIGGERS):
            await pause()
            data = chance.choice((None, b"\1\0\0\0")) if camera.capabilities.input_data else None
            timeout = chance.choice((30 * STEP, 1.0))
            application = chance.choice((None, None, 1, 2)) if camera.capabilities.switch else None
            try:
                await camera.trigger(application, input=data, timeout=timeout)
            except smartcam.SmartCamError as error:
                triggers[type(error).__name__] += 1
                assert isinstance(error, OUTCOMES), error  # noqa: PT017 - any of them will do
            else:
                triggers["result"] += 1

    async with made as box:
        query = "?cells=A1" if "insight" in box.url else ""
        async with smartcam.connect(
            box.url + query,
            request_timeout=0.4,
            switch_timeout=1.0,
            reconnect=Backoff(initial=5 * STEP, maximum=20 * STEP, jitter=0),
        ) as camera:
            asks = asks_of(camera)
            async with asyncio.TaskGroup() as group:
                for _ in range(3):
                    group.create_task(ask(camera, chance.sample(asks, 2)))
                await trigger(camera)
                done.set()
            balance(camera.statistics())
    return triggers, others


@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 10), marks=pytest.mark.long)])
@pytest.mark.parametrize("kind", CAMERAS)
def test_trigger_beside_any_request_has_an_outcome_of_the_list(kind: str, seeds: range) -> None:
    triggers = Counter[str]()
    for seed in seeds:
        with asyncio.Runner(loop_factory=lambda: TimedLoop(turn=STEP)) as runner:
            try:
                some, _ = runner.run(beside_each_other(CAMERAS[kind](), seed))
            except BaseException as exc:
                exc.add_note(f"with seed {seed}")
                raise
            triggers += some
    assert triggers["result"] > 0


@pytest.mark.parametrize(
    ("dialect", "processing_time"),
    [("handbook", 0.0), ("handbook", 0.02), ("b16", 0.0), ("bid", 0.0)],
)
async def test_triggers_and_queries_without_a_pause_take_turns(
    dialect: str, processing_time: float
) -> None:
    app = {"id": 1, "layout": "n: int32", "constant": {"n": 1}, "processing_time": processing_time}
    async with (
        EmulatedCamera([app], builtins=False, running=True, dialect=dialect) as emulator,
        smartcam.connect(emulator.url, application=1, interpret_as="n: int32") as camera,
    ):

        async def repeat(ask: Callable[[], Coroutine[Any, Any, object]]) -> None:
            while True:
                await ask()

        trigger, query = partial(camera.trigger, timeout=1.0), camera.query_application
        for rare, often in ((trigger, query), (query, trigger)):
            working = asyncio.create_task(repeat(often))
            for _ in range(10):
                await rare()
            assert not working.done()
            working.cancel()
            await asyncio.wait({working})
        balance(camera.statistics())
