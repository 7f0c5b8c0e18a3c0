"""Observe events that several checks need: inspections, switches, a reboot.

Each observation is made at most once for a camera, since inspections take time.
"""

from __future__ import annotations

import functools
import time
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._raw_client import EndedError, RawClient
from smartcam.conformance.camera._verdicts import Differs, NotObserved, Undescribed
from smartcam.conformance.camera._wire import of_kind
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.conformance.camera._session_under_test import CameraUnderTest
    from smartcam.conformance.camera._wire import ReceivedFrame

T = TypeVar("T")

INSPECTION_COUNT = 3
"""Number of observed inspections; several show whether the order of messages varies."""

REBOOT_POLL_INTERVAL = 0.25
"""Largest number of seconds between two Connects to a camera that restarts."""


def _once(observe: Callable[[CameraUnderTest], T]) -> Callable[[CameraUnderTest], T]:
    """Make an observation at most once for a camera; an exception is raised again each time."""

    @functools.wraps(observe)
    def observed(camera: CameraUnderTest) -> T:
        return camera.once(observe.__name__, lambda: observe(camera))

    return observed


class ObservedRun(NamedTuple):
    """One trigger and its outcome."""

    sent_at: float  # time of sending
    frames: list[ReceivedFrame]  # frames until the camera waited for the next trigger
    under_way: int | None  # status word, asked for right after the trigger; ``bid`` only
    word: int  # size of a number, bytes
    waiting: int  # mask of Waiting for Trigger

    @property
    def results(self) -> list[ReceivedFrame]:
        """The result containers."""
        return of_kind(self.frames, MessageId.RESULT_CONTAINER)

    def places(self) -> tuple[int | None, int | None, int | None]:
        """Return the places where Waiting ended, the first result came, and Waiting began again."""
        fell = result = rose = None
        for place, frame in enumerate(self.frames):
            if frame.message_id == MessageId.RESULT_CONTAINER and result is None:
                result = place
            elif frame.message_id == MessageId.STATUS:
                set_ = int.from_bytes(frame.body[: self.word], "little") & self.waiting
                if not set_ and fell is None:
                    fell = place
                elif set_ and fell is not None and rose is None:
                    rose = place
        return fell, result, rose


@_once
def inspections(camera: CameraUnderTest) -> list[ObservedRun]:
    """Trigger a few times, one after the other.

    Raises:
        NotObserved: nothing may be triggered, or the application runs without triggers.
        Differs: the camera takes no trigger.
    """
    camera.require(Allow.TRIGGER)
    runs: list[ObservedRun] = []
    with camera.session() as client:
        for _ in range(INSPECTION_COUNT):
            camera.ready(client)
            runs.append(_inspect_once(camera, client))
    times = [run.results[0].at - run.sent_at for run in runs if run.results]
    if times:
        camera.measured["trigger until result"] = max(times)
    return runs


def _inspect_once(camera: CameraUnderTest, client: RawClient) -> ObservedRun:
    mark, under_way = len(client.received), None
    waiting, word = camera.wire.bits.waiting, camera.wire.word
    sent_at = client.send(m.Trigger())
    if camera.wire.is_bid:
        client.send(m.GetStatus())
        answer = client.until(
            MessageId.STATUS, camera.options.timeout, "an answer to Get status", mark=mark
        )
        under_way = camera.wire.numbers(answer.body)[0]
        _wait_result(camera, client, mark)
        client.wait_status(
            lambda status: status & waiting,
            camera.options.timeout,
            "a status with Waiting for Trigger",
        )
        return ObservedRun(sent_at, client.received[mark:], under_way, word, waiting)
    deadline = sent_at + camera.options.timeout
    while (left := deadline - time.monotonic()) > 0:
        so_far = ObservedRun(sent_at, client.received[mark:], under_way, word, waiting)
        if None not in so_far.places():
            break
        inspected = so_far.places()[2] is not None  # a result may still come
        if client.next(min(left, camera.options.quiet) if inspected else left) is None:
            break
    return ObservedRun(sent_at, client.received[mark:], under_way, word, waiting)


def _wait_result(camera: CameraUnderTest, client: RawClient, mark: int) -> None:
    """Wait for a result as long as one may take."""
    deadline = time.monotonic() + camera.options.timeout
    while (left := deadline - time.monotonic()) > 0:
        if of_kind(client.received[mark:], MessageId.RESULT_CONTAINER):
            return
        client.next(left)


@_once
def unasked(camera: CameraUnderTest) -> ObservedRun:
    """Trigger once without asking for anything, so that all statuses are unasked.

    For ``bid``, for which :func:`inspections` asks. Raises the same; NotObserved if no result
    comes.
    """
    inspection_time(camera)  # raises if there are no results
    with camera.session() as client:
        camera.ready(client)
        mark = len(client.received)
        sent_at = client.send(m.Trigger())
        _wait_result(camera, client, mark)
        client.listen(camera.patience)
        seen = ObservedRun(
            sent_at, client.received[mark:], None, camera.wire.word, camera.wire.bits.waiting
        )
        if not seen.results:
            raise NotObserved(f"no result came of a trigger: {client.words(mark)}")
        return seen


@_once
def inspection_time(camera: CameraUnderTest) -> float:
    """Return the time of the longest inspection, from trigger to result, seconds.

    Raises:
        NotObserved: no result comes from this application.
    """
    inspections(camera)
    longest = camera.measured.get("trigger until result")
    if longest is None:
        raise NotObserved(f"application {camera.application} sends no results")
    return longest


def no_id(camera: CameraUnderTest) -> bool:
    """Return True if result containers do not begin with the application's id, as in some ``b16``.

    Raises:
        NotObserved: as :func:`inspection_time`.
        Undescribed: some containers begin with the id and others do not.
    """
    inspection_time(camera)  # raises if there are no results
    if camera.dialect != "b16":
        return False
    first = [
        int.from_bytes(inspection.results[0].body[: camera.wire.word], "little")
        for inspection in inspections(camera)
        if inspection.results
    ]
    absent = camera.application not in first
    if not absent and len(set(first)) > 1:
        raise Undescribed("the same id in front of each result", str(first))
    camera.learn_quirk("no_id", on=absent)
    return absent


# ---------------------------------------------------------------------- triggers too many


class DoubleTrigger(NamedTuple):
    """Two triggers at once and their outcome."""

    results: int  # number of results that came
    rose_at: float | None  # time of the status with Overtriggered; None without one
    fell_at: float | None  # time of the status without it
    text: str  # observation in words


def overtrigger(camera: CameraUnderTest) -> DoubleTrigger:
    """Trigger twice at once and watch Overtriggered; raises as :func:`inspections`.

    For cameras that send their status unasked.
    """
    takes = inspection_time(camera)
    bits, rose_at, fell_at = camera.wire.bits, None, None
    with camera.session() as client:
        camera.ready(client)
        mark = len(client.received)
        client.send(m.Trigger(), m.Trigger())
        client.fence()
        deadline, place = time.monotonic() + 2 * takes + camera.options.quiet, mark
        while fell_at is None:
            if place == len(client.received):
                left = deadline - time.monotonic()
                if left <= 0 or client.next(left) is None:
                    break
            frame, place = client.received[place], place + 1
            if frame.message_id != MessageId.STATUS:
                continue
            if not camera.wire.numbers(frame.body)[0] & bits.overtriggered:
                fell_at = None if rose_at is None else frame.at
            elif rose_at is None:
                rose_at = frame.at
                deadline = rose_at + camera.options.timeout
        client.listen(takes)
        results = len(of_kind(client.received[mark:], MessageId.RESULT_CONTAINER))
        return DoubleTrigger(results, rose_at, fell_at, client.words(mark))


class Stopped(NamedTuple):
    """A trigger to a stopped camera and its outcome."""

    frames: list[ReceivedFrame]
    text: str  # observation in words


@_once
def stopped_trigger(camera: CameraUnderTest) -> Stopped:
    """Trigger a stopped camera; raises as :func:`inspections`."""
    camera.require(Allow.RUN | Allow.TRIGGER)
    takes = inspection_time(camera)
    with camera.session() as client:
        camera.stop(client)
        mark = len(client.received)
        client.send(m.Trigger())
        frames = client.listen(takes + camera.options.quiet)
        return Stopped(frames, client.words(mark))


# ---------------------------------------------------------------------- switch, reboot


class Switch(NamedTuple):
    """A switch and its outcome."""

    application: int  # application that was asked for
    frames: list[ReceivedFrame]  # the frames until the answer and the status that is not busy
    answer: ReceivedFrame
    active: int  # application that Query reported afterwards
    seconds: float  # seconds from the request to the answer


@_once
def switch(camera: CameraUnderTest) -> Switch:
    """Load the other application on a stopped camera.

    Raises:
        NotObserved: no application was named, or loading is not allowed.
        Differs: no answer comes.
    """
    camera.require(Allow.SWITCH)
    other = camera.options.other_application
    if other is None:
        raise NotObserved("no other application was named: --camera-other-application")
    with camera.session() as client:
        if camera.active(client) == other:
            camera.load(client, camera.application)
        if camera.active(client) == other:
            raise NotObserved(f"application {other} is the active one: name another application")
        camera.stop(client)
        mark, began = len(client.received), time.monotonic()
        answer = client.answer(
            m.SwitchApplication(application=other), within=camera.options.switch_timeout
        )
        took = answer.at - began
        _wait_not_busy(camera, client, mark)
        frames = client.received[mark:]
        camera.measured["switch"] = took
        return Switch(other, frames, answer, camera.active(client), took)


def _wait_not_busy(camera: CameraUnderTest, client: RawClient, mark: int) -> None:
    """Wait for a status without BUSY if the last one had it."""
    busy = camera.wire.bits.busy
    words = camera.wire.statuses(client.received[mark:])
    if busy and any(word & busy for word in words) and words[-1] & busy:
        client.until(
            lambda frame: (
                frame.message_id == MessageId.STATUS
                and not camera.wire.numbers(frame.body)[0] & busy
            ),
            camera.options.timeout,
            "a status without BUSY after the switch",
        )


class Downtime(NamedTuple):
    """A restart."""

    seconds: float  # seconds from the request to the first answered Connect
    application: int  # active application afterwards
    running: bool  # run mode afterwards


@_once
def downtime(camera: CameraUnderTest) -> Downtime:
    """Restart the camera and wait until it answers again.

    Raises:
        NotObserved: a restart is not allowed.
        Differs: the camera does not go away, or does not come back.
    """
    camera.require(Allow.REBOOT)
    with camera.session() as client:
        began = client.send(m.Reboot())
        _wait_gone(camera, client)
    deadline = began + camera.options.reboot_timeout
    while time.monotonic() < deadline:
        tried_at = time.monotonic()
        if _answers(camera):
            seconds = time.monotonic() - began
            with camera.session() as client:
                return Downtime(seconds, camera.active(client), camera.running(client))
        time.sleep(
            max(0.0, tried_at + min(REBOOT_POLL_INTERVAL, camera.options.quiet) - time.monotonic())
        )
    camera.gone = f"it did not come back within {camera.options.reboot_timeout:g} s of a reboot"
    raise Differs("the camera is back after a reboot", camera.gone)


def _wait_gone(camera: CameraUnderTest, client: RawClient) -> None:
    deadline = time.monotonic() + camera.options.timeout
    try:
        while time.monotonic() < deadline:
            client.send(m.Query())
            if client.next(camera.patience) is None:
                return
    except EndedError:
        return
    raise Differs(
        "the camera restarts: the session ends",
        f"it still answers after {camera.options.timeout:g} s",
    )


def _answers(camera: CameraUnderTest) -> bool:
    """Return True if a Connect is answered now."""
    try:
        with camera.link() as client:
            client.answer(m.Connect(), within=max(camera.options.quiet, REBOOT_POLL_INTERVAL))
    except (NotObserved, Differs, EndedError):
        return False
    return True
