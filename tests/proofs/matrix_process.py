"""Cells of the fault matrix whose camera is a process of its own: it is killed, or it freezes.

The command ``smartcam-emulator`` runs on a fixed port. It dies by SIGKILL or stands still by
SIGSTOP at each frame that a command says or hears, and is started or goes on afterwards.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Iterator, Sequence
from pathlib import Path
from typing import Any, Self

from smartcam import exceptions as e
from smartcam.models import Result
from tests.proofs.matrix_cells import AT_ONCE, LOST, SILENT, Cell, Fault, Place
from tests.proofs.matrix_world import (
    AWAY,
    HOME,
    PATIENT,
    SHORT,
    BenchBase,
    Bounds,
    World,
    own_host,
    tracked_tasks,
)

PROCESS_OPS = (
    *("open", "trigger", "elsewhere", "switch", "query", "clock", "set clock", "start", "stop"),
    *("reboot", "close"),
)

STARTING = 30.0
"""Seconds that the command has to come up."""

SIGNALS = hasattr(signal, "SIGKILL") and hasattr(signal, "SIGSTOP")
"""True if the system has what these cells need."""


class ProcessCamera:
    """The command, run again and again on one port."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.url = ""  # the camera's address
        # frozen: whether it is
        # killed: whether it was
        self.killed = self.frozen = False
        self._process: asyncio.subprocess.Process | None = None
        self._host, self._port = own_host(), 0
        self._folder = ""

    async def __aenter__(self) -> Self:
        self._folder = tempfile.mkdtemp(prefix="smartcam-matrix-")
        applications = [
            {
                "id": number,
                "layout": self.world.layout,
                "generator": "sequence",
                "processing_time": 0.01,
                "load_time": 0.01,
            }
            for number in (HOME, AWAY)
        ]
        scenario: dict[str, Any] = {
            "applications": applications,
            "running": True,
            "quirks": {"reboot_time": 0.05},
        }
        await asyncio.to_thread(
            Path(self._folder, "scenario.yaml").write_text, json.dumps(scenario), "utf-8"
        )
        try:
            await self.start()
        except BaseException:
            shutil.rmtree(self._folder)
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        try:
            if self._process is not None:
                self.kill()
                await self._process.wait()
        finally:
            shutil.rmtree(self._folder)

    async def start(self) -> None:
        """Start it; it listens when this returns."""
        command = Path(sys.executable).with_name("smartcam-emulator")
        self._process = await asyncio.create_subprocess_exec(
            str(command),
            str(Path(self._folder, "scenario.yaml")),
            *(
                "--host",
                self._host,
                "--port",
                str(self._port),
                "--dialect",
                self.world.dialect,
                "--json",
            ),
            stdout=asyncio.subprocess.PIPE,
        )
        assert self._process.stdout is not None
        try:
            async with asyncio.timeout(STARTING):
                said = json.loads(await self._process.stdout.readline())
        except BaseException:
            self.kill()
            raise
        self.url, self._port = said["url"], said["port"]
        self.killed = self.frozen = False

    def kill(self) -> None:
        """Let it die at once."""
        self.killed = True
        self._send(signal.SIGKILL)

    def freeze(self) -> None:
        """Let it stand still."""
        self.frozen = True
        self._send(signal.SIGSTOP)

    async def mend(self) -> None:
        """Have it running again."""
        if self.frozen:
            self._send(signal.SIGCONT)
            self.frozen = False
        if self.killed and self._process is not None:
            await self._process.wait()
            await self.start()

    def _send(self, number: int) -> None:
        assert self._process is not None
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)


class ProcessBench(BenchBase):
    """A bench whose camera tells nothing but what it says on the wire."""

    def __init__(self, bounds: Bounds, process: ProcessCamera, application: int) -> None:
        self.process = process
        super().__init__(process.world, bounds, process.url, application)

    async def trigger(self, application: int | None = None, **options: Any) -> Result:
        """Trigger; the result must carry the number that was set for it."""
        with self._one_trigger():
            result: Result = await self.camera.trigger(
                application, timeout=self.bounds.trigger, **options
            )
        self.demand(
            result.sequence == self.ear.number,
            f"number {result.sequence}, {self.ear.number} was set",
        )
        return result

    async def ask_application(self) -> int:
        """Query; the answer must be an application that is there."""
        answer = await self.camera.query_application()
        self.demand(answer in {HOME, AWAY}, f"application {answer} is told")
        return answer

    async def ask_clock(self) -> None:
        await self.camera.get_clock()

    def really_active(self) -> int:
        """Return the active application as the client was told it."""
        return self.camera.active_application or 0

    async def mend(self) -> None:
        """Have the camera running again."""
        await self.process.mend()


@contextlib.asynccontextmanager
async def process_bench(
    process: ProcessCamera, bounds: Bounds, application: int
) -> AsyncIterator[ProcessBench]:
    """Have a bench with this camera, which goes on afterwards."""
    await process.mend()
    made: ProcessBench | None = None
    async with tracked_tasks() as left:
        made = ProcessBench(bounds, process, application)
        try:
            yield made
        finally:
            await process.mend()
            await made.close()
    made.demand(not left, f"tasks were left: {left}")


def process_cells(world: World, name: str, found: Sequence[Place]) -> Iterator[Cell]:
    """Give each frame of a command as the moment at which the camera dies or freezes."""
    for index, place in enumerate(found):
        for what in ("kill", "freeze"):
            yield Cell(f"process {what}", world, name, place.name, _at_frame(index, what))


def _at_frame(index: int, what: str) -> Fault:
    def arm(bench: Any) -> None:
        left = iter(range(index + 1))

        def hook(_: object) -> None:
            if next(left, None) == index:
                getattr(bench.process, what)()
                bench.happened = True

        bench.ear.at_frame = hook

    def fired(bench: Any) -> bool:
        return bool(bench.happened)

    if what == "kill":
        return Fault(arm, fired, (*LOST, e.ConnectFailedError), PATIENT, at_once=AT_ONCE)
    return Fault(arm, fired, (*SILENT, e.ConnectFailedError), SHORT)
