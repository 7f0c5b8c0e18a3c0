"""Inspect the frames of a software camera's source by its programs."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import math
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam.backoff import Backoff
from smartcam.emulator._inside import Inspector
from smartcam.exceptions import FrameSourceError, SmartCamError
from smartcam.frames._inside import changed
from smartcam.inspection._camera.tool_thread import ToolThread
from smartcam.inspection._program import MAX_REASON_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from concurrent.futures import Future

    from smartcam.emulator._inside import InspectionOrder, Values
    from smartcam.frames import Frame, FrameSource, StreamFormat
    from smartcam.inspection._finding import Inspection
    from smartcam.inspection._program import Program

_log: Final = logging.getLogger("smartcam.inspection")

FIRST_FRAME_TIMEOUT: Final = 5.0
"""Seconds to wait for the first frame; afterwards the camera starts without a frame."""

FRAME_WAIT: Final = 10.0
"""Longest time, seconds, between a trigger and a frame exposed after it."""

TOOLS_TIMEOUT: Final = 60.0
"""Longest time, seconds, of a program's tools; a longer run gives a result that is not ok."""

MAX_HUNG_THREADS: Final = 4
"""Largest number of threads with hanging tools; at this number, new runs wait for the last."""

THREAD_GRACE: Final = 1.0
"""Longest time, seconds, that closing the camera waits for a running tool."""

RETRY: Final = Backoff(initial=0.1, maximum=5.0)
"""Delays before a lost source of frames is opened again."""


class Judged(NamedTuple):
    """An inspected picture with its findings.

    Attributes:
        number: sequence number of the run.
        frame: the inspected frame.
        inspection: inspection by the program; None if it failed.
        application: id of the program.
    """

    number: int
    frame: Frame
    inspection: Inspection | None
    application: int

    @property
    def marked_frame(self) -> Frame:
        """The frame, with the marks of the tools as its drawings."""
        if self.inspection is None:
            return self.frame
        return changed(self.frame, drawings=self.inspection.drawings)


@dataclass(eq=False, slots=True)
class _OrderedRun:
    """A run that waits for its frame or its tools."""

    order: InspectionOrder
    seen: Callable[[], None]
    done: Callable[[Values | None], None]
    moment: float  # earliest start of the frame's exposure, time.monotonic()
    deadline: asyncio.TimerHandle
    frame: Frame | None = None
    work: Future[Inspection] | None = None


class FrameInspector(Inspector):
    """Inspect the first frame that is exposed after a run has begun.

    A thread runs the tools, one picture at a time. If a run is cancelled while a tool works, the
    thread finishes this tool, and a new thread inspects the next picture.

    Args:
        name: name of the camera, for logs.
        make: function that returns the unopened source of frames.
        programs: programs by the ids of their applications.
        recorded: whether the source is a recording: each run gets its next picture, and after the
            last picture the first again.
        grey: whether the thread computes the grey levels of each picture for later use.
        on_trouble: function that is called with the reason when frames are lost, and with "" when
            they come again.

    Attributes:
        name: name of the camera.
        judged: the last inspected picture; None before the first.
        viewers: functions that are called with each inspected picture.
        format: format of the source's frames; None before it was opened.
        trouble: reason why there are no frames; "" if they come.
    """

    def __init__(
        self,
        name: str,
        make: Callable[[], FrameSource],
        programs: Mapping[int, Program],
        *,
        recorded: bool = False,
        grey: bool = False,
        on_trouble: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.judged: Judged | None = None
        self.trouble: str = "the source was not opened yet"
        self.on_trouble = on_trouble
        self.format: StreamFormat | None = None
        self.viewers: set[Callable[[Judged], None]] = set()
        self.name = name
        self._make, self._programs = make, programs
        self._recorded, self._grey = recorded, grey
        self._order: _OrderedRun | None = None
        self._frame_wanted = asyncio.Event()  # set while a run waits for a frame
        self._first_frame_done = asyncio.Event()  # set when the first frame came or cannot come
        self._task: asyncio.Task[None] | None = None
        self._thread: ToolThread | None = None
        self._hung_threads: list[ToolThread] = []  # abandoned threads that still run

    def _new_thread(self) -> ToolThread:
        return ToolThread(f"smartcam.inspection {self.name}")

    # ------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open the source, and wait for the first frame; without one, call ``on_trouble``.

        Cancellation: leaves it stopped.
        """
        if self._task is not None:
            return
        self._first_frame_done.clear()
        self._thread = self._new_thread()
        self._task = asyncio.create_task(self._watch(), name=f"inspector of {self.name}")
        try:
            async with asyncio.timeout(FIRST_FRAME_TIMEOUT):
                await self._first_frame_done.wait()
        except TimeoutError:
            self._frames_lost(f"no frame came within {FIRST_FRAME_TIMEOUT:g} s")
        except BaseException:
            await self.stop()
            raise

    async def stop(self) -> None:
        """Release the source; a tool that does not end stays in its thread. Idempotent.

        Cancellation: takes effect when the source is released.
        """
        self.cancel()
        task, self._task = self._task, None
        thread, self._thread = self._thread, None
        if task is not None:
            task.cancel()
            await asyncio.wait({task})
        if thread is not None:
            last = asyncio.wrap_future(thread.submit(lambda: None))
            thread.close()
            await asyncio.wait({last}, timeout=THREAD_GRACE)
            last.cancel()

    # ------------------------------------------------------------------ for the device

    def begin(
        self,
        order: InspectionOrder,
        seen: Callable[[], None],
        done: Callable[[Values | None], None],
    ) -> None:
        """Start a run, which inspects the first frame exposed from now on."""
        self.cancel()
        loop = asyncio.get_running_loop()
        deadline = loop.call_later(FRAME_WAIT, self._give_up)
        self._order = _OrderedRun(order, seen, done, time.monotonic(), deadline)
        self._frame_wanted.set()
        if self.trouble:  # a restart of the device has cleared it there
            loop.call_soon(self._report, self.trouble)

    def cancel(self) -> None:
        """Cancel the run; the next run does not wait for its thread."""
        order, self._order = self._order, None
        self._frame_wanted.clear()
        if order is not None:
            order.deadline.cancel()
            if order.work is not None:
                order.work.cancel()

    # ------------------------------------------------------------------ frames

    async def _watch(self) -> None:
        """Read the source, and open it again whenever it is lost."""
        delays = RETRY.delays()
        while True:
            try:
                async with self._make() as source:
                    self.format = source.format
                    if self._recorded:
                        self._frames_back()
                    while True:
                        if await self._follow(source):
                            delays = RETRY.delays()
                        if not self._recorded:
                            raise FrameSourceError(
                                f"{source.name}: no more frames", source=source.name
                            )
            except (SmartCamError, OSError) as exc:
                self._frames_lost(str(exc))
            except Exception as exc:  # noqa: BLE001 - a driver may be a plug-in
                _log.exception("%s ! the source of its frames failed", self.name)
                self._frames_lost(repr(exc))
            await asyncio.sleep(next(delays))

    async def _follow(self, source: FrameSource) -> bool:
        """Pass frames to waiting runs until the source ends; return whether any frame came."""
        arrived = False
        held: Frame | None = None  # frame of a recording, whose run was cancelled
        async with source.reader(timeout=None) as reader:
            while True:
                if self._recorded:
                    await self._frame_wanted.wait()
                try:
                    frame: Frame = await anext(reader) if held is None else held
                except StopAsyncIteration:
                    return arrived
                arrived, held = True, None
                if self._recorded and frame.lost:  # a run with a damaged picture has no result
                    held = dataclasses.replace(frame, lost=0)
                    why = f"{frame.lost} damaged pictures before picture {frame.sequence}"
                    self._frames_lost(why)
                    await asyncio.sleep(RETRY.initial)
                    self._frames_back()
                    continue
                self._frames_back()
                order = self._order
                if order is None or order.frame is not None:
                    held = frame if self._recorded else None
                elif self._recorded or frame.began >= order.moment:
                    self._inspect(order, frame)

    def _frames_back(self) -> None:
        """Note that frames come again."""
        if self.trouble:
            _log.info("%s = frames come again", self.name)
            self._report("")
        self._first_frame_done.set()

    def _frames_lost(self, why: str) -> None:
        """Note that no frames come, which cancels the run."""
        if why != self.trouble:
            _log.warning("%s ! no frames: %s", self.name, why)
        self._report(why)
        self._first_frame_done.set()

    def _report(self, trouble: str) -> None:
        self.trouble = trouble
        self.on_trouble(trouble)

    def _give_up(self) -> None:
        """End the run without a result, since no frame came in time."""
        order, self._order = self._order, None
        self._frame_wanted.clear()
        if order is not None:
            _log.warning(
                "%s ! no frame was exposed within %g s after the trigger: no result",
                self.name,
                FRAME_WAIT,
            )
            order.done(None)

    # ------------------------------------------------------------------ tools

    def _inspect(self, order: _OrderedRun, frame: Frame) -> None:
        """Run the tools on a frame in the thread."""
        thread = self._free_thread()
        if thread is None:
            return
        loop = asyncio.get_running_loop()
        order.deadline.cancel()
        order.deadline = loop.call_later(TOOLS_TIMEOUT, self._give_up_tools, order, frame)
        order.frame = frame
        self._frame_wanted.clear()
        program = self._programs[order.order.application]
        work = thread.submit(partial(_inspected, program, frame, order.order.input, self._grey))
        order.work = work

        def ended(_: Future[Inspection]) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(self._finish, order, frame, work)

        work.add_done_callback(ended)
        order.seen()

    def _free_thread(self) -> ToolThread | None:
        """Return the thread for tools, or a new thread if it is busy with a cancelled run."""
        thread = self._thread
        if thread is not None and thread.at_work:
            self._hung_threads = [hung for hung in self._hung_threads if hung.at_work]
            if len(self._hung_threads) < MAX_HUNG_THREADS:
                self._hung_threads.append(thread)
                thread.close()
                thread = self._thread = self._new_thread()
        return thread

    def _give_up_tools(self, order: _OrderedRun, frame: Frame) -> None:
        """End a run whose tools take too long; another thread will run the next."""
        if order is not self._order:
            return
        if order.work is not None:
            order.work.cancel()
        text = f"the tools did not end within {TOOLS_TIMEOUT:g} s"
        self._end(order, frame, None, TimeoutError(text))

    def _finish(self, order: _OrderedRun, frame: Frame, work: Future[Inspection]) -> None:
        """Report the tools' findings, unless the run was cancelled."""
        if order is not self._order:
            return
        error = work.exception()
        self._end(order, frame, work.result() if error is None else None, error)

    def _end(
        self,
        order: _OrderedRun,
        frame: Frame,
        inspection: Inspection | None,
        error: BaseException | None,
    ) -> None:
        self._order = None
        order.deadline.cancel()
        number, application = order.order.number, order.order.application
        values: Values | None = None
        try:
            if inspection is not None:
                values = inspection.values
            else:
                _log.error("%s ! application %d failed", self.name, application, exc_info=error)
                values = failed_values(self._programs[application], str(error))
        except Exception:  # noqa: BLE001 - the run has to end
            _log.exception("%s ! application %d has no result", self.name, application)
        self.judged = Judged(number, frame, inspection, application)
        order.done(values)
        for show in self.viewers:
            show(self.judged)


def _inspected(program: Program, frame: Frame, data: bytes, grey: bool) -> Inspection:
    """Return the inspection of a frame; values that do not fit the layout are an error."""
    inspection = program.inspect(frame, input=data)
    inspection.payload()
    if grey:
        _ = inspection.picture.grey  # computed here, since it would block the event loop
    return inspection


def failed_values(program: Program, reason: str) -> dict[str, Any]:
    """Return the values for a failed program: not ok, the reason, and empty fields."""
    layout = program.layout
    fields = layout.fields if layout.repeat is None else layout.head
    values = {
        field.name: _EMPTY.get(field.type, math.nan if "real" in field.type else 0)
        for field in fields
    }
    values |= {step.name: [] for step in program.steps if step.records}
    data = reason.replace("\0", "?").encode(errors="replace")
    return {
        **values,
        "ok": False,
        "reason": data[:MAX_REASON_BYTES].decode(errors="ignore"),
    }


_EMPTY: Final[dict[str, Any]] = {"bool": False, "string": ""}
