"""Every task of the package cancelled at every step, by somebody who does not own it.

A program does with the public objects what :data:`SCENES` says. The task factory numbers the tasks
that the package's code makes meanwhile; in each run one of them is cancelled, before its first
step or behind its first, second, ... step. Then no call of the program waits without end, whatever
it raises; all objects can be closed; no task and no socket is left; and the same program works once
more in the same event loop.

    python -m tests.proofs.task_sweep [--only client]
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import gc
import logging
import sys
import time
import traceback
from collections.abc import AsyncIterator, Awaitable, Coroutine, Generator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import smartcam
from tests.conftest import open_resources
from tests.proofs.task_scenes import SCENES, Scene
from tests.timed_loop import TimedLoop

T = TypeVar("T")

BOUND = 100.0
"""Seconds for one call; each has an end of its own well before, on the loop's own time."""

TURNS = 100
"""Turns of the loop in which what was closed is gone."""

PACKAGE = str(Path(smartcam.__file__).parent)


class Aim(NamedTuple):
    """The task that is cancelled, and the moment.

    Attributes:
        task: its number among those that the package made, from 0.
        step: behind which of its steps; 0: before the first.
    """

    task: int
    step: int


class StepCounter(Coroutine[Any, Any, Any]):
    """A coroutine whose steps are counted, and whose task is cancelled behind one of them.

    Args:
        inner: the coroutine.
        stop_at: behind which step; None for none.
    """

    def __init__(self, inner: Coroutine[Any, Any, Any], stop_at: int | None) -> None:
        self.__qualname__ = self.__name__ = getattr(inner, "__qualname__", str(inner))
        self.steps = 0
        self.task: asyncio.Task[Any] | None = None
        self._inner = inner
        self._stop_at = stop_at

    def send(self, value: Any) -> Any:
        return self._counted(self._inner.send(value))

    def throw(self, *error: Any) -> Any:
        return self._counted(self._inner.throw(*error))

    def close(self) -> None:
        self._inner.close()

    def __await__(self) -> Generator[Any, Any, Any]:
        return self._inner.__await__()

    def _counted(self, awaited: Any) -> Any:
        self.steps += 1
        if self.steps == self._stop_at and self.task is not None:
            self.task.cancel()
        return awaited


class Factory:
    """Makes tasks, numbers the package's own and cancels one.

    Args:
        aim: which; None for none.
    """

    def __init__(self, aim: Aim | None) -> None:
        self.made: list[StepCounter] = []
        self._aim = aim

    def __call__(
        self, loop: asyncio.AbstractEventLoop, coroutine: Any, **options: Any
    ) -> asyncio.Task[Any]:
        if not _made_by_the_package():
            return asyncio.Task(coroutine, loop=loop, **options)
        aim = self._aim if self._aim is not None and self._aim.task == len(self.made) else None
        counter = StepCounter(coroutine, None if aim is None else aim.step)
        task: asyncio.Task[Any] = asyncio.Task(counter, loop=loop, **options)
        counter.task = task
        self.made.append(counter)
        if aim is not None and aim.step == 0:
            task.cancel()
        return task

    def describe(self, aim: Aim) -> str:
        """Return in words which task was cancelled."""
        if aim.task >= len(self.made):
            return f"task {aim.task}, which was not made"
        counter = self.made[aim.task]
        name = counter.task.get_name() if counter.task is not None else ""
        return f"task {aim.task} ({name}: {counter.__qualname__}) behind step {aim.step}"


def _made_by_the_package() -> bool:
    """Return whether the first code outside of asyncio that has a task made is the package's."""
    frame = sys._getframe(2)
    while frame is not None and (
        "asyncio" in frame.f_code.co_filename or "contextlib" in frame.f_code.co_filename
    ):
        frame = frame.f_back  # type: ignore[assignment]
    return frame is not None and frame.f_code.co_filename.startswith(PACKAGE)


class Program:
    """A scene's calls: each of them is bounded.

    Args:
        strict: a call that fails ends the scene; else whatever it raises is as good as a result.
    """

    def __init__(self, *, strict: bool) -> None:
        self.strict = strict

    async def call(self, awaitable: Awaitable[T], *, fails: bool = False) -> T | None:
        """Return what comes of a call, None where it raises.

        Args:
            awaitable: the call.
            fails: it may raise although nothing was cancelled.
        """
        doing = asyncio.ensure_future(awaitable)
        _, late = await asyncio.wait({doing}, timeout=BOUND)
        if late:
            doing.cancel()
            raise AssertionError(f"{getattr(awaitable, '__qualname__', awaitable)} waits on and on")
        if self.strict and not fails:
            return doing.result()
        if not doing.cancelled() and (error := doing.exception()) is not None:
            if isinstance(error, AssertionError):
                raise error
            return None
        return None if doing.cancelled() else doing.result()

    @contextlib.asynccontextmanager
    async def entered(self, manager: Any) -> AsyncIterator[Any]:
        """Enter and leave an object by bounded calls; None where entering fails."""
        made = await self.call(manager.__aenter__())
        try:
            yield made
        finally:
            if made is not None:
                await self.call(manager.__aexit__(None, None, None))


async def _play(scene: Scene, aim: Aim | None) -> Factory:
    """Run a scene with one task cancelled, see that nothing is left, and run it once more."""
    loop = asyncio.get_running_loop()
    before = open_resources(loop)
    factory = Factory(aim)
    loop.set_task_factory(factory)
    try:
        try:
            await scene(Program(strict=aim is None))
        finally:
            loop.set_task_factory(None)
        await _nothing_left(before)
        if aim is not None:
            await scene(Program(strict=True))
            await _nothing_left(before)
    except BaseException as exc:
        if aim is not None:
            exc.add_note(factory.describe(aim))
        raise
    return factory


async def _nothing_left(before: set[Any]) -> None:
    loop = asyncio.get_running_loop()
    for _ in range(TURNS):
        if not open_resources(loop) - before:
            return
        await asyncio.sleep(0)
    gc.collect()
    left = sorted(map(repr, open_resources(loop) - before))
    assert not left, f"left behind: {left}"


def steps_of(scene: Scene) -> list[int]:
    """Return the steps that each task of the package takes when nothing is cancelled."""
    with asyncio.Runner(loop_factory=TimedLoop) as runner:
        return [one.steps for one in runner.run(_play(scene, None)).made]


def aims(steps: list[int], most: int | None) -> list[Aim]:
    """Return each task and step; of a task with more steps than ``most`` some of them."""
    found: list[Aim] = []
    for task, count in enumerate(steps):
        last = count if most is None else min(count, most)
        found += [Aim(task, step) for step in range(last + 1)]
    return found


def sweep(name: str, most: int | None = None) -> int:
    """Cancel each task of a scene at each step; return how many runs that took.

    The notes of what is raised say which task it was.
    """
    scene = SCENES[name]
    found = aims(steps_of(scene), most)
    for aim in found:
        with asyncio.Runner(loop_factory=TimedLoop) as runner:
            runner.run(_play(scene, aim))
    return len(found)


def main(arguments: list[str] | None = None) -> int:
    """Sweep everything and print what it was; 1 if something was left or waits."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", default="", help="scenes whose names contain this")
    parser.add_argument("--most", type=int, default=None, help="steps of each task at most")
    options = parser.parse_args(arguments)
    logging.disable()
    failed = 0
    for name, scene in SCENES.items():
        if options.only not in name:
            continue
        began = time.monotonic()
        try:
            steps = steps_of(scene)
        except Exception:  # noqa: BLE001 - reported, and the sweep goes on
            failed += 1
            print(f"FAILED {name}: {traceback.format_exc(limit=-3)}")  # noqa: T201
            continue
        found = aims(steps, options.most)
        bad: dict[str, list[str]] = {}
        for aim in found:
            try:
                with asyncio.Runner(loop_factory=TimedLoop) as runner:
                    runner.run(_play(scene, aim))
            except BaseException as exc:
                if isinstance(exc, KeyboardInterrupt):
                    raise
                bad.setdefault(repr(exc)[:300], []).append(" ".join(getattr(exc, "__notes__", [])))
        failed += len(bad)
        seconds = time.monotonic() - began
        print(f"{name}: {len(steps)} tasks, {len(found)} runs, {seconds:.0f} s")  # noqa: T201
        for error, where in bad.items():
            print(f"  FAILED {len(where)} times: {error}\n    {where[:4]}")  # noqa: T201
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
