"""Observations that several checks use: inspections, switches, a restart.

Inspections take time, so most observations are made only once for a camera.
"""

from __future__ import annotations

import functools
import time
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._raw_client import LinkClosedError, RawClient
from smartcam.conformance.camera._verdicts import Differs, NotObserved, Undescribed
from smartcam.conformance.camera._wire import frames_with_id
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.conformance.camera._session_under_test import CameraUnderTest
    from smartcam.conformance.camera._wire import ReceivedFrame

T = TypeVar("T")

INSPECTION_COUNT = 3
"""Number of observed inspections: more than one, to see whether the order of messages varies."""

REBOOT_POLL_INTERVAL = 0.25
"""Largest number of seconds between two Connects to a camera that restarts."""


def _observe_once(observation: Callable[[CameraUnderTest], T]) -> Callable[[CameraUnderTest], T]:
    """Make an observation once for a camera; later calls return, or raise, the same again."""

    @functools.wraps(observation)
    def observed(camera: CameraUnderTest) -> T:
        return camera.observe_once(observation.__name__, lambda: observation(camera))

    return observed


class ObservedRun(NamedTuple):
    """One trigger and its outcome."""

    sent_at: float  # time of sending
    frames: list[ReceivedFrame]  # frames until the camera waited for the next trigger
    status_under_way: int | None  # answer to Get status right after the trigger; ``bid`` only
    word_size: int  # size of a number, bytes
    waiting_mask: int  # mask of Waiting for Trigger

    @property
    def results(self) -> list[ReceivedFrame]:
        """The result containers."""
        return frames_with_id(self.frames, MessageId.RESULT_CONTAINER)

    def transition_indices(self) -> tuple[int | None, int | None, int | None]:
        """Return indices of the frames in which Waiting fell, the result came, and Waiting rose."""
        fall_index = result_index = rise_index = None
        for index, frame in enumerate(self.frames):
            if frame.message_id == MessageId.RESULT_CONTAINER and result_index is None:
                result_index = index
            elif frame.message_id == MessageId.STATUS:
                is_waiting = (
                    int.from_bytes(frame.body[: self.word_size], "little") & self.waiting_mask
                )
                if not is_waiting and fall_index is None:
                    fall_index = index
                elif is_waiting and fall_index is not None and rise_index is None:
                    rise_index = index
        return fall_index, result_index, rise_index


@_observe_once
def observe_inspections(camera: CameraUnderTest) -> list[ObservedRun]:
    """Trigger ``INSPECTION_COUNT`` times, one after the other.

    Raises:
        NotObserved: triggers are not allowed, or the application runs without triggers.
        Differs: the camera does not start or load the application, or sends no status.
    """
    camera.require_allowed(Allow.TRIGGER)
    runs: list[ObservedRun] = []
    with camera.session() as client:
        for _ in range(INSPECTION_COUNT):
            camera.ensure_ready(client)
            runs.append(_inspect_once(camera, client))
    times = [run.results[0].at - run.sent_at for run in runs if run.results]
    if times:
        camera.measured_times["trigger until result"] = max(times)
    return runs


def _inspect_once(camera: CameraUnderTest, client: RawClient) -> ObservedRun:
    start_index, status_under_way = len(client.received), None
    waiting_mask, word_size = camera.codec.bits.waiting, camera.codec.word_size
    sent_at = client.send(m.Trigger())
    if camera.codec.is_bid:
        client.send(m.GetStatus())
        answer = client.wait_for_frame(
            MessageId.STATUS,
            camera.options.timeout,
            "an answer to Get status",
            start_index=start_index,
        )
        status_under_way = camera.codec.read_numbers(answer.body)[0]
        _wait_result(camera, client, start_index)
        client.wait_status(
            lambda status: status & waiting_mask,
            camera.options.timeout,
            "a status with Waiting for Trigger",
        )
        return ObservedRun(
            sent_at, client.received[start_index:], status_under_way, word_size, waiting_mask
        )
    deadline = sent_at + camera.options.timeout
    while (remaining := deadline - time.monotonic()) > 0:
        run = ObservedRun(
            sent_at, client.received[start_index:], status_under_way, word_size, waiting_mask
        )
        if None not in run.transition_indices():
            break
        waits_again = run.transition_indices()[2] is not None  # a result may still come
        if (
            client.next_frame(min(remaining, camera.options.silence) if waits_again else remaining)
            is None
        ):
            break
    return ObservedRun(
        sent_at, client.received[start_index:], status_under_way, word_size, waiting_mask
    )


def _wait_result(camera: CameraUnderTest, client: RawClient, start_index: int) -> None:
    """Wait until a result has come, or until the timeout for one."""
    deadline = time.monotonic() + camera.options.timeout
    while (remaining := deadline - time.monotonic()) > 0:
        if frames_with_id(client.received[start_index:], MessageId.RESULT_CONTAINER):
            return
        client.next_frame(remaining)


@_observe_once
def observe_unasked_statuses(camera: CameraUnderTest) -> ObservedRun:
    """Trigger once and send nothing else, so that every status comes unasked.

    It is for ``bid``, since :func:`observe_inspections` sends Get status there. Raises as that
    function does, and NotObserved if no result comes.
    """
    inspection_time(camera)  # raises if there are no results
    with camera.session() as client:
        camera.ensure_ready(client)
        start_index = len(client.received)
        sent_at = client.send(m.Trigger())
        _wait_result(camera, client, start_index)
        client.listen(camera.silence_timeout)
        run = ObservedRun(
            sent_at,
            client.received[start_index:],
            None,
            camera.codec.word_size,
            camera.codec.bits.waiting,
        )
        if not run.results:
            raise NotObserved(
                f"no result came of a trigger: {client.describe_received(start_index)}"
            )
        return run


@_observe_once
def inspection_time(camera: CameraUnderTest) -> float:
    """Return the seconds from trigger to result of the longest observed inspection.

    Raises:
        NotObserved: no result comes from this application.
    """
    observe_inspections(camera)
    longest = camera.measured_times.get("trigger until result")
    if longest is None:
        raise NotObserved(f"application {camera.application} sends no results")
    return longest


def has_no_id(camera: CameraUnderTest) -> bool:
    """Return True if result containers do not begin with the application's id, as in some ``b16``.

    Raises:
        NotObserved: as :func:`inspection_time`.
        Undescribed: some containers begin with the id and others do not.
    """
    inspection_time(camera)  # raises if there are no results
    if camera.dialect != "b16":
        return False
    first_words = [
        int.from_bytes(inspection.results[0].body[: camera.codec.word_size], "little")
        for inspection in observe_inspections(camera)
        if inspection.results
    ]
    is_absent = camera.application not in first_words
    if not is_absent and len(set(first_words)) > 1:
        raise Undescribed("the same id at the beginning of each result", str(first_words))
    camera.learn_quirk("no_id", is_present=is_absent)
    return is_absent


# ---------------------------------------------------------------------- ignored triggers


class DoubleTrigger(NamedTuple):
    """Two triggers at once and their outcome."""

    results: int  # number of results that came
    rose_at: float | None  # time of the first status with Overtriggered, None if none came
    fell_at: float | None  # time of the next status without Overtriggered, None if none came
    text: str  # observation in words


def observe_double_trigger(camera: CameraUnderTest) -> DoubleTrigger:
    """Trigger twice at once and follow Overtriggered; raises as :func:`observe_inspections`.

    The camera has to send its status unasked.
    """
    inspection_seconds = inspection_time(camera)
    bits, rose_at, fell_at = camera.codec.bits, None, None
    with camera.session() as client:
        camera.ensure_ready(client)
        start_index = len(client.received)
        client.send(m.Trigger(), m.Trigger())
        client.round_trip()
        deadline = time.monotonic() + 2 * inspection_seconds + camera.options.silence
        index = start_index
        while fell_at is None:
            if index == len(client.received):
                remaining = deadline - time.monotonic()
                if remaining <= 0 or client.next_frame(remaining) is None:
                    break
            frame, index = client.received[index], index + 1
            if frame.message_id != MessageId.STATUS:
                continue
            if not camera.codec.read_numbers(frame.body)[0] & bits.overtriggered:
                fell_at = None if rose_at is None else frame.at
            elif rose_at is None:
                rose_at = frame.at
                deadline = rose_at + camera.options.timeout
        client.listen(inspection_seconds)
        results = len(frames_with_id(client.received[start_index:], MessageId.RESULT_CONTAINER))
        return DoubleTrigger(results, rose_at, fell_at, client.describe_received(start_index))


class StoppedTrigger(NamedTuple):
    """A trigger to a stopped camera and its outcome."""

    frames: list[ReceivedFrame]
    text: str  # observation in words


@_observe_once
def observe_stopped_trigger(camera: CameraUnderTest) -> StoppedTrigger:
    """Trigger a stopped camera; raises as :func:`observe_inspections`."""
    camera.require_allowed(Allow.RUN | Allow.TRIGGER)
    inspection_seconds = inspection_time(camera)
    with camera.session() as client:
        camera.ensure_stopped(client)
        start_index = len(client.received)
        client.send(m.Trigger())
        frames = client.listen(inspection_seconds + camera.options.silence)
        return StoppedTrigger(frames, client.describe_received(start_index))


# ---------------------------------------------------------------------- switch, reboot


class ObservedSwitch(NamedTuple):
    """A switch and its outcome."""

    application: int  # application that was asked for
    frames: list[ReceivedFrame]  # frames until the answer and a status without BUSY
    answer: ReceivedFrame
    active: int  # application that Query reported afterwards
    seconds: float  # seconds from the request to the answer


@_observe_once
def observe_switch(camera: CameraUnderTest) -> ObservedSwitch:
    """Load the other application on a stopped camera.

    Raises:
        NotObserved: no application was named, or loading is not allowed.
        Differs: no answer comes.
    """
    camera.require_allowed(Allow.SWITCH)
    other = camera.options.other_application
    if other is None:
        raise NotObserved("no other application was named: --camera-other-application")
    with camera.session() as client:
        if camera.active_application(client) == other:
            camera.load_application(client, camera.application)
        if camera.active_application(client) == other:
            raise NotObserved(f"application {other} is the active one: name another application")
        camera.ensure_stopped(client)
        start_index, started_at = len(client.received), time.monotonic()
        answer = client.ask(
            m.SwitchApplication(application=other), timeout=camera.options.switch_timeout
        )
        seconds = answer.at - started_at
        _wait_until_not_busy(camera, client, start_index)
        frames = client.received[start_index:]
        camera.measured_times["switch"] = seconds
        return ObservedSwitch(other, frames, answer, camera.active_application(client), seconds)


def _wait_until_not_busy(camera: CameraUnderTest, client: RawClient, start_index: int) -> None:
    """Wait for a status without BUSY if the last one had it."""
    busy = camera.codec.bits.busy
    words = camera.codec.status_words(client.received[start_index:])
    if busy and any(word & busy for word in words) and words[-1] & busy:
        client.wait_for_frame(
            lambda frame: (
                frame.message_id == MessageId.STATUS
                and not camera.codec.read_numbers(frame.body)[0] & busy
            ),
            camera.options.timeout,
            "a status without BUSY after the switch",
        )


class ObservedRestart(NamedTuple):
    """A restart."""

    seconds: float  # seconds from the request to the first answered Connect
    application: int  # active application afterwards
    running: bool  # run mode afterwards


@_observe_once
def observe_restart(camera: CameraUnderTest) -> ObservedRestart:
    """Restart the camera and wait until it answers again.

    Raises:
        NotObserved: a restart is not allowed.
        Differs: the camera does not go away, or does not come back.
    """
    camera.require_allowed(Allow.REBOOT)
    with camera.session() as client:
        started_at = client.send(m.Reboot())
        _wait_until_gone(camera, client)
    deadline = started_at + camera.options.reboot_timeout
    while time.monotonic() < deadline:
        tried_at = time.monotonic()
        if _is_connect_answered(camera):
            seconds = time.monotonic() - started_at
            with camera.session() as client:
                return ObservedRestart(
                    seconds, camera.active_application(client), camera.is_running(client)
                )
        pause = min(REBOOT_POLL_INTERVAL, camera.options.silence)
        time.sleep(max(0.0, tried_at + pause - time.monotonic()))
    camera.gone_reason = (
        f"it did not come back within {camera.options.reboot_timeout:g} s of a reboot"
    )
    raise Differs("the camera is back after a reboot", camera.gone_reason)


def _wait_until_gone(camera: CameraUnderTest, client: RawClient) -> None:
    deadline = time.monotonic() + camera.options.timeout
    try:
        while time.monotonic() < deadline:
            client.send(m.Query())
            if client.next_frame(camera.silence_timeout) is None:
                return
    except LinkClosedError:
        return
    raise Differs(
        "the camera restarts: the session ends",
        f"it still answers after {camera.options.timeout:g} s",
    )


def _is_connect_answered(camera: CameraUnderTest) -> bool:
    """Return True if the camera answers a Connect now."""
    try:
        with camera.link() as client:
            client.ask(m.Connect(), timeout=max(camera.options.silence, REBOOT_POLL_INTERVAL))
    except (NotObserved, Differs, LinkClosedError):
        return False
    return True
