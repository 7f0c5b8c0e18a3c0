"""Emulate a recorded camera that sends the recorded containers with the same timing.

The device is the emulator's own. Its applications send the recorded containers, byte for byte:

- The n-th trigger of an application gets the container of the n-th recorded trigger, after the same
  time. It has no result if the recorded one had none, and is dropped if the recorded one was.
- Containers without a trigger are sent without one: the first at its time after the start of the
  run, each other one at its time after the previous container. They wait while the camera is
  stopped or has another application; none is left out.
- Overheat and System Error rise and fall at their times after the start of the first session.

Sequence numbers differ from the recorded ones if the client sets them, as it does if its layout has
an ``@sequence`` field. Then containers have the client's numbers in that field; the
``interpret_as`` in the recording gives its offset.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pydantic import PrivateAttr

from smartcam._arguments import check_callable, check_flag, check_kind, check_number
from smartcam._extras import from_part
from smartcam.emulator import Application, EmulatedCamera, LineCamera
from smartcam.emulator._inside import check_options, emulated_class, wrap_number
from smartcam.exceptions import ConfigurationError
from smartcam.interpreters import resolve
from smartcam.protocols import messages as m
from smartcam.recording._reader import check_recording
from smartcam.recording._replays.lines import ReplayedLines
from smartcam.recording._replays.schedule import CONDITIONS, plan_replay
from smartcam.settings import is_fleet

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.emulator import TableScene
    from smartcam.emulator._inside import ClientLink, Clock, TimerHandle
    from smartcam.layout._inside import Field
    from smartcam.models import ByteOrder, Status
    from smartcam.recording._reader import Recording
    from smartcam.recording._replays.pictures import ReplayedPictures
from smartcam.recording._replays.schedule import ApplicationRuns, RecordedRun, ReplayPlan

MAX_SPEED = 1000.0
"""Largest factor of the speed; timers, which count milliseconds, are too coarse for more."""

MIN_INSPECTION_TIME = 1e-6
"""Duration, seconds, with which an inspection begins, until its recorded run is chosen."""

FREE_RUN_RATE = 0.0001
"""Rate of a free-running application, per second; the replay itself sends its containers."""

MAX_LOAD_TIME = 3600.0
"""Largest number of seconds of an emulated switch."""


@dataclass(slots=True, eq=False)
class _PendingRuns:
    """A list of runs that is played once, or over and over."""

    _runs: list[RecordedRun]
    _repeats: bool
    _next_index: int = 0

    @property
    def next_run(self) -> RecordedRun | None:
        """The next run; None after the last one."""
        return self._runs[self._next_index] if self._next_index < len(self._runs) else None

    @property
    def remaining(self) -> int:
        """Number of remaining runs of this round."""
        return len(self._runs) - self._next_index

    def pop(self) -> RecordedRun | None:
        """Remove and return the next run."""
        run = self.next_run
        self._next_index += run is not None
        if self._repeats and self._next_index >= len(self._runs):
            self._next_index = 0
        return run


class _SequenceField(NamedTuple):
    """The field of containers that has the sequence number."""

    field: Field  # field of the layout
    offset: int  # offset of its first byte

    def replace(self, data: bytes, number: int, byte_order: ByteOrder) -> bytes:
        """Return a container with another number; unchanged if it has no number."""
        end = self.offset + self.field.size
        if len(data) < end:
            return data
        low = self.field.wire.low
        value = wrap_number(self.field, number).to_bytes(
            self.field.size, byte_order, signed=low is not None and low < 0
        )
        return data[: self.offset] + value + data[end:]


@dataclass(slots=True)
class _ApplicationTrack:
    """The parts of a replay that belong to one application."""

    waits_for_triggers: bool
    triggered: _PendingRuns  # runs for triggers
    untriggered: _PendingRuns  # runs without a trigger
    current: RecordedRun | None = None  # run of the running inspection
    # further containers to be sent
    pending: list[bytes] = field(default_factory=list[bytes])
    # field that gets the client's numbers; None: containers keep their own numbers
    sequence_field: _SequenceField | None = None
    # function that is called with each recorded container when it is to be sent
    on_container: Callable[[bytes], None] = lambda _: None

    def end_inspection(self, number: int, byte_order: ByteOrder) -> bytes | None:
        """End the inspection and return its container; None if it sends nothing."""
        run, self.current = self.current, None
        if run is None or not run.containers:
            return None
        containers = run.containers
        for data in containers:
            self.on_container(data)
        if self.sequence_field is not None:
            containers = [
                self.sequence_field.replace(data, number, byte_order) for data in containers
            ]
        first, *self.pending = containers
        return first


class _PlayedApplication(Application):
    """An application that sends the containers of a track."""

    _track: _ApplicationTrack | None = PrivateAttr(default=None)

    def with_track(self, track: _ApplicationTrack) -> _PlayedApplication:
        """Set the track whose containers are sent; return this application."""
        self._track = track
        return self

    def container(
        self,
        *,
        number: int,
        run_index: int,
        time: float,
        scene: TableScene,
        values: Mapping[str, Any] | None = None,
        byte_order: ByteOrder = "little",
    ) -> bytes | None:
        """Return the track's next container."""
        return None if self._track is None else self._track.end_inspection(number, byte_order)


class ReplayedCamera(EmulatedCamera):
    """An emulated camera that replays a recording.

    It begins with the application of the first container, and runs if there are containers. After
    the end of the recording, triggers get no result and no containers are sent, unless ``loop``.
    All containers are kept in memory.

    Args:
        recording: recording to replay.
        camera: name of the camera in it; default the only one.
        speed: factor by which to replay faster than recorded, 0.001 to 1000.
        loop: whether to begin again at the end, separately for each application's runs.
        host: address to listen on.
        port: port to listen on, 0 for a free one.
        transport: default the recorded one.
        dialect: default the recorded one.
        quirks: behaviour of the camera, besides the recorded deviations of the dialect: fields of
            :class:`~smartcam.emulator.Quirks`.
        clock: clock of the replay; default: real time.
        name: name for logs; default the recorded one.
        on_over: function that is called once, in the event loop, at the end; never with
            ``loop``.

    Attributes:
        plan: plan of the replay.
        speed: factor of the speed.

    Raises:
        ConfigurationError: an argument is wrong, or the camera cannot be replayed.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        camera: str | None = None,
        speed: float = 1.0,
        loop: bool = False,
        host: str = "127.0.0.1",
        port: int = 0,
        transport: Literal["tcp", "udp"] | None = None,
        dialect: str | None = None,
        quirks: dict[str, Any] | None = None,
        clock: Clock | None = None,
        name: str | None = None,
        on_over: Callable[[], None] | None = None,
    ) -> None:
        check_recording(recording, "replay")
        speed, loop = check_speed(speed), check_flag(loop, "loop", "replay")
        on_over = None if on_over is None else check_callable(on_over, "on_over", "replay")
        self.plan: ReplayPlan = plan_replay(recording, camera)
        self.speed: float = speed
        self._repeats = loop
        self._on_over = None if loop else on_over
        self._tracks = {
            number: _ApplicationTrack(
                runs.waits,
                _PendingRuns(runs.triggered, loop),
                _PendingRuns(runs.untriggered, loop),
            )
            for number, runs in self.plan.applications.items()
        }
        recorded: dict[str, Any] = {}
        if quirks is None:
            quirks = {}
        check_kind(quirks, Mapping, "quirks", "fields of Quirks, or None", "replay")
        if dialect is None:
            dialect = self.plan.dialect
        if dialect == self.plan.dialect:
            recorded = dict.fromkeys(self.plan.quirks, True)
        super().__init__(
            [
                _application(runs, speed).with_track(self._tracks[number])
                for number, runs in self.plan.applications.items()
            ],
            builtins=False,
            host=host,
            port=port,
            transport=self.plan.transport if transport is None else transport,
            dialect=dialect,
            quirks={**recorded, **quirks},
            clock=clock,
            name=recording.camera(camera).name if name is None else name,
            active=self.plan.active,
            running=self.plan.running,
        )
        self._sequence_field = _sequence_field(recording.camera(camera).interpret_as)
        self.device.set_endian(self.plan.endian)
        self._set_conditions(self.plan.conditions)
        # run before which the device drops triggers
        self._armed_run: RecordedRun | None = None
        # application that may send without a trigger now
        self._free_application: int | None = None
        self._pause_start = 0.0  # time from which the pause before the next untriggered run counts
        self._run_timer: TimerHandle | None = None  # timer of the next untriggered run
        self._is_run_due = False  # whether an untriggered run should begin as soon as possible
        self._round_start: float | None = None  # time at which this round of changes began
        self._change_count = 0  # number of changes of conditions in this round so far
        self._change_timer: TimerHandle | None = None  # timer of the next change of a condition
        self._pictures: ReplayedPictures | None = None

    def _prepare_pictures(self, recording: Recording, camera: str) -> ReplayedPictures | None:
        """Return the recorded pictures, each shown with its result; None without pictures.

        Args:
            recording: recording that is replayed.
            camera: name of the camera in it.
        """
        if not recording.counts.pictures:
            return None
        with from_part("frames", "pictures need"):
            from smartcam.recording._replays.pictures import ReplayedPictures

        pictures = ReplayedPictures(recording, camera, self.plan.applications, self.speed)
        for number, track in self._tracks.items():
            track.on_container = partial(pictures.show_picture_of, number)
        self._pictures = None if pictures.first_picture is None else pictures
        return self._pictures

    @property
    def remaining(self) -> int:
        """Number of remaining inspections of this round."""
        return sum(
            track.triggered.remaining + track.untriggered.remaining
            for track in self._tracks.values()
        )

    async def stop(self) -> None:
        """Close the port and every connection; the replay pauses. Does nothing if stopped.

        Cancellation: everything is still closed.
        """
        self._pause()
        if self._change_timer is not None:
            self._change_timer.cancel()
            self._change_timer = None
        await super().stop()

    def handle_message(self, link: ClientLink, message: m.Message) -> None:
        """Handle a message; after a SetSequenceNumber, containers get the client's numbers."""
        if isinstance(message, m.SetSequenceNumber):
            for track in self._tracks.values():
                track.sequence_field = self._sequence_field
        super().handle_message(link, message)

    # ------------------------------------------------------------------ after each step

    def _end_step(self) -> None:
        if self._started:
            self._follow_device()
        super()._end_step()

    def _follow_device(self) -> None:
        """Do what the recording does next in the device's present state."""
        if self._change_timer is None and self.has_session:
            self._set_change_timer()
        track = self._tracks[self.device.active_application]
        if not self.device.processing:
            track.current = None
        elif track.waits_for_triggers and track.current is None:
            self._start_inspection(track, track.triggered.pop())
        if track.pending:
            pending, track.pending = track.pending, []
            self._send_containers(pending)
        self._arm_drops(track)
        self._play_untriggered(track)
        if self._on_over is not None and not self.remaining and not self.device.processing:
            on_over, self._on_over = self._on_over, None
            on_over()

    def _start_inspection(self, track: _ApplicationTrack, run: RecordedRun | None) -> None:
        """Give the inspection that has begun the duration of its run; None: no run is left."""
        track.current, self._armed_run = run, None
        if self._pictures is not None:
            self._pictures.start_inspection()
        if run is not None:
            self.device.change_inspection(
                late=max(0.0, run.seconds / self.speed - MIN_INSPECTION_TIME)
            )

    def _arm_drops(self, track: _ApplicationTrack) -> None:
        """Make the device drop the next triggers if the recorded triggers were dropped."""
        run = track.triggered.next_run
        if run is not None and run.drops and run is not self._armed_run:
            self._armed_run = run
            self.device.drop_triggers(run.drops)

    def _send_containers(self, containers: list[bytes]) -> None:
        """Send containers of the active application, after the device's own messages."""
        self._collect()
        number = self.device.active_application
        messages: list[m.Message] = [
            m.ResultContainer(application=number, data=data) for data in containers
        ]
        self._send_all(messages, fire_faults=True)

    # ------------------------------------------------------------------ without a trigger

    def _play_untriggered(self, track: _ApplicationTrack) -> None:
        """Begin the untriggered run that is due, and set the timer for the next one."""
        is_free = self.has_session and self.device.running
        application = self.device.active_application if is_free else None
        if application != self._free_application:
            self._pause()
            self._free_application, self._pause_start = application, self.clock.now
        run = track.untriggered.next_run
        if application is None or run is None:
            return
        if self._is_run_due and not (track.waits_for_triggers and self.device.processing):
            self._begin_untriggered(track, run)
            run = track.untriggered.next_run
        if run is not None and self._run_timer is None and not self._is_run_due:
            when = self._pause_start + run.pause / self.speed
            self._run_timer = self.clock.call_at(max(when, self.clock.now), self._on_run_timer)

    def _begin_untriggered(self, track: _ApplicationTrack, run: RecordedRun) -> None:
        if not track.waits_for_triggers:
            for data in run.containers:
                track.on_container(data)
            self._send_containers(run.containers)
        elif self.device.trigger():
            self._start_inspection(track, run)
        else:
            return  # the device accepts no trigger now; try later
        self._is_run_due = False
        self._pause_start += (run.pause + run.seconds) / self.speed
        track.untriggered.pop()

    def _on_run_timer(self) -> None:
        self._run_timer, self._is_run_due = None, True
        with self.step():
            pass

    def _pause(self) -> None:
        """Hold back runs without a trigger."""
        self._free_application, self._is_run_due = None, False
        if self._run_timer is not None:
            self._run_timer.cancel()
            self._run_timer = None

    # ------------------------------------------------------------------ conditions

    def _set_change_timer(self) -> None:
        """Set the timer for the next change; the first session begins the first round."""
        if self._round_start is None:
            self._round_start = self.clock.now
        changes = self.plan.changes
        if self._change_count == len(changes) and self._repeats and changes:
            self._change_count = 0
            self._round_start += self.plan.seconds / self.speed
        if self._change_count < len(changes):
            when = self._round_start + changes[self._change_count].at / self.speed
            self._change_timer = self.clock.call_at(when, self._on_change_timer)

    def _on_change_timer(self) -> None:
        self._change_timer = None
        change = self.plan.changes[self._change_count]
        self._change_count += 1
        with self.step():
            self.device.set_condition(change.condition, change.on)
            self._set_change_timer()

    def _set_conditions(self, conditions: Status) -> None:
        for condition in CONDITIONS:
            self.device.set_condition(condition, condition in conditions)


def _sequence_field(interpret_as: str | None) -> _SequenceField | None:
    """Return the field of the sequence number; None if it is unknown, or there is none."""
    try:
        layout = None if interpret_as is None else resolve(interpret_as).layout
    except ConfigurationError:  # a plug-in that is not installed, or a mapping
        return None
    if layout is None:
        return None
    offset = 0
    for part in (*layout.head, *layout.fields):
        if part.sequence:
            return _SequenceField(part, offset)
        offset += part.size
    return None


def _application(runs: ApplicationRuns, speed: float) -> _PlayedApplication:
    fields: dict[str, Any] = {"id": runs.application, "name": "recorded"}
    if runs.load_time is not None:
        fields["load_time"] = min(runs.load_time / speed, MAX_LOAD_TIME)
    if runs.waits:
        fields["processing_time"] = MIN_INSPECTION_TIME
    else:
        fields["rate"] = FREE_RUN_RATE
    return _PlayedApplication(**fields)


def replay(
    recording: Recording,
    *,
    camera: str | None = None,
    speed: float = 1.0,
    loop: bool = False,
    on_over: Callable[[], None] | None = None,
    **options: Any,
) -> ReplayedCamera | ReplayedLines:
    """Return an emulated camera that replays a recording, for any protocol.

    For bvs this is a :class:`ReplayedCamera`. With a protocol of text lines the n-th
    trigger gets the n-th recorded answer, after the same time, and other lines get the recorded
    answer of that moment. Of a fleet's camera, which has no recorded frames, results are replayed.

    Args:
        recording: recording to replay.
        camera: name of the camera in it; default the only one.
        speed: factor by which to replay faster than recorded, 0.001 to 1000.
        loop: begin again at the end.
        on_over: function that is called once, in the event loop, at the end; never with
            ``loop``.
        options: options of :class:`ReplayedCamera`, or of a :class:`~smartcam.emulator.LineCamera`.

    Raises:
        ConfigurationError: an argument is wrong, or the camera cannot be replayed.
        UnsupportedError: its protocol has no emulated camera.
    """
    check_recording(recording, "replay")
    speed, loop = check_speed(speed), check_flag(loop, "loop", "replay")
    on_over = None if on_over is None else check_callable(on_over, "on_over", "replay")
    recorded = recording.camera(camera)
    if not recorded.url:
        raise ConfigurationError(
            f"recording {recording.path}: there was no session with camera {recorded.name!r}"
        )
    camera_class = EmulatedCamera if is_fleet(recorded.url) else emulated_class(recorded.protocol)
    common: dict[str, Any] = {"camera": camera, "speed": speed, "loop": loop, "on_over": on_over}
    if issubclass(camera_class, LineCamera):
        check_options(LineCamera, options)
        return ReplayedLines(camera_class, recording, **common, **options)
    if issubclass(camera_class, EmulatedCamera):
        return ReplayedCamera(recording, **common, **options)
    raise ConfigurationError(
        f"recording {recording.path}: cameras of {recorded.protocol} cannot be replayed; "
        "cameras with a protocol of text lines, and of bvs, can"
    )


def check_speed(speed: float) -> float:
    """Return a speed; raise ConfigurationError if it is out of range."""
    return check_number(speed, "speed", 1 / MAX_SPEED, MAX_SPEED, "replay")
