"""Inspect the frames of a software camera's source with the camera's programs."""

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
from smartcam.frames._inside import copy_with
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
"""Longest time, seconds, to wait for the first frame; then the camera starts without a frame."""

FRAME_WAIT: Final = 10.0
"""Longest time, seconds, between a trigger and a frame exposed after it."""

TOOLS_TIMEOUT: Final = 60.0
"""Longest time, seconds, that a program's tools may take; then the result is not ok."""

MAX_HUNG_THREADS: Final = 4
"""Largest number of threads in which tools hang; at this number, new runs wait for a thread."""

THREAD_GRACE: Final = 1.0
"""Longest time, seconds, that closing the camera waits for a running tool."""

RETRY: Final = Backoff(initial=0.1, maximum=5.0)
"""Delays before a lost source of frames is opened again."""


class InspectedPicture(NamedTuple):
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
    def frame_with_drawings(self) -> Frame:
        """The frame, with the marks of the tools beside its unchanged pixels."""
        if self.inspection is None:
            return self.frame
        return copy_with(self.frame, drawings=self.inspection.drawings)


@dataclass(eq=False, slots=True)
class _OrderedRun:
    """A run that waits for its frame or its tools."""

    order: InspectionOrder
    on_exposed: Callable[[], None]
    on_done: Callable[[Values | None], None]
    earliest_exposure: float  # earliest start of the frame's exposure, time.monotonic()
    deadline: asyncio.TimerHandle
    frame: Frame | None = None
    future: Future[Inspection] | None = None


class FrameInspector(Inspector):
    """Inspect, for each run, the first frame that is exposed after the run's start.

    A thread runs the tools, one picture at a time. If a run is cancelled while a tool works, the
    thread finishes this tool, and a new thread inspects the next picture.

    Args:
        name: name of the camera, for logs.
        make: function that returns the source of frames, not open.
        programs: programs by the ids of their applications.
        recorded: whether the source is a recording. Each run gets the next picture of a recording,
            which starts again after its last picture.
        grey: whether the thread computes the grey levels of each picture for later use.
        on_trouble: function that is called with the reason when no frames come, and with "" when
            frames come again.

    Attributes:
        name: name of the camera.
        last_picture: the last inspected picture, with its findings; None before the first.
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
        self.last_picture: InspectedPicture | None = None
        self.trouble: str = "the source was not opened yet"
        self.on_trouble = on_trouble
        self.format: StreamFormat | None = None
        self.viewers: set[Callable[[InspectedPicture], None]] = set()
        self.name = name
        self._make_source, self._programs = make, programs
        self._recorded, self._grey = recorded, grey
        self._run: _OrderedRun | None = None
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
        self._task = asyncio.create_task(self._read_source(), name=f"inspector of {self.name}")
        try:
            async with asyncio.timeout(FIRST_FRAME_TIMEOUT):
                await self._first_frame_done.wait()
        except TimeoutError:
            self._report_frames_lost(f"no frame came within {FIRST_FRAME_TIMEOUT:g} s")
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
        on_exposed: Callable[[], None],
        on_done: Callable[[Values | None], None],
    ) -> None:
        """Start a run, which inspects the first frame exposed from now on."""
        self.cancel()
        loop = asyncio.get_running_loop()
        deadline = loop.call_later(FRAME_WAIT, self._end_without_frame)
        self._run = _OrderedRun(order, on_exposed, on_done, time.monotonic(), deadline)
        self._frame_wanted.set()
        if self.trouble:  # in each run, since a restart of the device clears the device's condition
            loop.call_soon(self._set_trouble, self.trouble)

    def cancel(self) -> None:
        """Cancel the run; the next run does not wait for its thread."""
        run, self._run = self._run, None
        self._frame_wanted.clear()
        if run is not None:
            run.deadline.cancel()
            if run.future is not None:
                run.future.cancel()

    # ------------------------------------------------------------------ frames

    async def _read_source(self) -> None:
        """Read the source, and open it again whenever it is lost."""
        delays = RETRY.delays()
        while True:
            try:
                async with self._make_source() as source:
                    self.format = source.format
                    if self._recorded:
                        self._report_frames_back()
                    while True:
                        if await self._pass_frames(source):
                            delays = RETRY.delays()
                        if not self._recorded:
                            raise FrameSourceError(
                                f"{source.name}: no more frames", source=source.name
                            )
            except (SmartCamError, OSError) as exc:
                self._report_frames_lost(str(exc))
            except Exception as exc:  # noqa: BLE001 - a driver may be a plug-in
                _log.exception("%s ! the source of its frames failed", self.name)
                self._report_frames_lost(repr(exc))
            await asyncio.sleep(next(delays))

    async def _pass_frames(self, source: FrameSource) -> bool:
        """Pass frames to waiting runs until the source ends; return True if a frame came."""
        has_frames = False
        kept_frame: Frame | None = None  # frame of a recording that no run has inspected yet
        async with source.reader(timeout=None) as reader:
            while True:
                if self._recorded:
                    await self._frame_wanted.wait()
                try:
                    frame: Frame = await anext(reader) if kept_frame is None else kept_frame
                except StopAsyncIteration:
                    return has_frames
                has_frames, kept_frame = True, None
                if self._recorded and frame.lost:  # a damaged picture gives its run no result
                    kept_frame = dataclasses.replace(frame, lost=0)
                    reason = f"{frame.lost} damaged pictures before picture {frame.sequence}"
                    self._report_frames_lost(reason)
                    await asyncio.sleep(RETRY.initial)
                    self._report_frames_back()
                    continue
                self._report_frames_back()
                run = self._run
                if run is None or run.frame is not None:
                    kept_frame = frame if self._recorded else None
                elif self._recorded or frame.began >= run.earliest_exposure:
                    self._inspect(run, frame)

    def _report_frames_back(self) -> None:
        """Report that frames come again."""
        if self.trouble:
            _log.info("%s = frames come again", self.name)
            self._set_trouble("")
        self._first_frame_done.set()

    def _report_frames_lost(self, reason: str) -> None:
        """Report the reason why no frames come."""
        if reason != self.trouble:
            _log.warning("%s ! no frames: %s", self.name, reason)
        self._set_trouble(reason)
        self._first_frame_done.set()

    def _set_trouble(self, trouble: str) -> None:
        self.trouble = trouble
        self.on_trouble(trouble)

    def _end_without_frame(self) -> None:
        """End the run without a result, since no frame came in time."""
        run, self._run = self._run, None
        self._frame_wanted.clear()
        if run is not None:
            _log.warning(
                "%s ! no frame was exposed within %g s after the trigger: no result",
                self.name,
                FRAME_WAIT,
            )
            run.on_done(None)

    # ------------------------------------------------------------------ tools

    def _inspect(self, run: _OrderedRun, frame: Frame) -> None:
        """Run the tools on a frame in the thread."""
        thread = self._free_thread()
        if thread is None:
            return
        loop = asyncio.get_running_loop()
        run.deadline.cancel()
        run.deadline = loop.call_later(TOOLS_TIMEOUT, self._end_hung_run, run, frame)
        run.frame = frame
        self._frame_wanted.clear()
        program = self._programs[run.order.application]
        future = thread.submit(partial(_inspect_frame, program, frame, run.order.input, self._grey))
        run.future = future

        def hand_over(_: Future[Inspection]) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(self._report_findings, run, frame, future)

        future.add_done_callback(hand_over)
        run.on_exposed()

    def _free_thread(self) -> ToolThread | None:
        """Return the thread for tools; a new thread if the old one is busy with a cancelled run."""
        thread = self._thread
        if thread is not None and thread.is_busy:
            self._hung_threads = [hung for hung in self._hung_threads if hung.is_busy]
            if len(self._hung_threads) < MAX_HUNG_THREADS:
                self._hung_threads.append(thread)
                thread.close()
                thread = self._thread = self._new_thread()
        return thread

    def _end_hung_run(self, run: _OrderedRun, frame: Frame) -> None:
        """End a run whose tools take too long; another thread inspects the next picture."""
        if run is not self._run:
            return
        if run.future is not None:
            run.future.cancel()
        text = f"the tools did not end within {TOOLS_TIMEOUT:g} s"
        self._end_run(run, frame, None, TimeoutError(text))

    def _report_findings(self, run: _OrderedRun, frame: Frame, future: Future[Inspection]) -> None:
        """Report the tools' findings, unless the run was cancelled."""
        if run is not self._run:
            return
        error = future.exception()
        self._end_run(run, frame, future.result() if error is None else None, error)

    def _end_run(
        self,
        run: _OrderedRun,
        frame: Frame,
        inspection: Inspection | None,
        error: BaseException | None,
    ) -> None:
        self._run = None
        run.deadline.cancel()
        number, application = run.order.number, run.order.application
        values: Values | None = None
        try:
            if inspection is not None:
                values = inspection.values
            else:
                _log.error("%s ! application %d failed", self.name, application, exc_info=error)
                values = failed_values(self._programs[application], str(error))
        except Exception:  # noqa: BLE001 - the run has to end
            _log.exception("%s ! application %d has no result", self.name, application)
        self.last_picture = InspectedPicture(number, frame, inspection, application)
        run.on_done(values)
        for viewer in self.viewers:
            viewer(self.last_picture)


def _inspect_frame(program: Program, frame: Frame, data: bytes, grey: bool) -> Inspection:
    """Inspect a frame; raise an error if the values do not fit the layout."""
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
        field.name: _EMPTY_VALUES.get(field.type, math.nan if "real" in field.type else 0)
        for field in fields
    }
    values |= {step.name: [] for step in program.steps if step.records}
    data = reason.replace("\0", "?").encode(errors="replace")
    return {
        **values,
        "ok": False,
        "reason": data[:MAX_REASON_BYTES].decode(errors="ignore"),
    }


_EMPTY_VALUES: Final[dict[str, Any]] = {"bool": False, "string": ""}
