"""Checks: run mode and triggers."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from smartcam.conformance._dialects import SMART
from smartcam.conformance.camera._observations import (
    inspection_time,
    inspections,
    overtrigger,
    stopped_trigger,
)
from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._results import check
from smartcam.conformance.camera._verdicts import Differs, NotObserved
from smartcam.conformance.camera._wire import of_kind
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera._session_under_test import CameraUnderTest
    from smartcam.protocols.messages import Message


@check("MV31, SC-A30, published", needs=Allow.RUN, dialects=SMART)
def start_begins_run_mode(camera: CameraUnderTest) -> str:
    """Start sets Running, and a triggered application begins to wait."""
    bits = camera.wire.bits
    with camera.session() as client:
        camera.load(client, camera.application)
        camera.stop(client)
        began = client.send(m.Start())
        client.wait_status(
            lambda word: word & bits.running, camera.options.timeout, "a status with Running"
        )
        try:
            camera.once_waiting(client)
        except NotObserved as exc:
            return str(exc)
    camera.measured["start until waiting"] = time.monotonic() - began
    return ""


@check("SC-A28, published", needs=Allow.RUN, dialects=SMART)
def second_start_is_harmless(camera: CameraUnderTest) -> None:
    """Start is not answered, and changes nothing in run mode."""
    with camera.session() as client:
        camera.start(client)
    _changes_nothing(camera, m.Start())


@check({"": "SC-B33, MV27, published", "bid": "ID-b 213, ID-b 221, published"}, needs=Allow.TRIGGER)
def trigger_gives_one_result(camera: CameraUnderTest) -> str:
    """A trigger gives one result container, of the active application."""
    inspection_time(camera)  # raises if there are no results
    word = camera.wire.word
    for inspection in inspections(camera):
        if len(inspection.results) != 1:
            raise Differs("one result for each trigger", f"{len(inspection.results)} results")
        body = inspection.results[0].body
        named = int.from_bytes(body[:word], "little")
        if camera.dialect != "b16" and named != camera.application:
            raise Differs(
                f"the id {camera.application} in front of the result",
                camera.wire.spell(inspection.results[0]),
            )
    return f"{len(inspections(camera))} triggers"


@check("ID-b 221, published", needs=Allow.TRIGGER, dialects=("bid",))
def trigger_is_acknowledged(camera: CameraUnderTest) -> None:
    """A trigger is answered with the code 0."""
    for inspection in inspections(camera):
        answers = of_kind(inspection.frames, MessageId.TRIGGER)
        if [camera.wire.numbers(answer.body) for answer in answers] != [(0,)]:
            shown = "; ".join(map(camera.wire.spell, inspection.frames)) or "nothing"
            raise Differs("one answer to the trigger, the code 0", shown)


@check({"": "SC-A30, SC-C50, published", "bid": "ID-b 210, published"}, needs=Allow.TRIGGER)
def waiting_falls_and_rises(camera: CameraUnderTest) -> None:
    """Waiting for Trigger falls with a trigger and rises when the next would be taken."""
    for inspection in inspections(camera):
        if inspection.under_way is not None:
            fell = not inspection.under_way & inspection.waiting
            result = inspection.results[0] if inspection.results and not fell else None
            if result is not None and result.at - inspection.sent_at < camera.options.quiet:
                continue  # the inspection was over before the status came
            rose = True  # the observation has waited for it
        else:
            places = inspection.places()
            fell, rose = places[0] is not None, places[2] is not None
        if not (fell and rose):
            shown = "; ".join(map(camera.wire.spell, inspection.frames)) or "nothing"
            raise Differs("Waiting for Trigger falls with a trigger and rises again", shown)


@check("SC-A30, SC-B33, published", needs=Allow.TRIGGER, dialects=SMART)
def dropped_trigger_is_told(camera: CameraUnderTest) -> None:
    """One of two triggers at once is dropped, and a status with Overtriggered says so."""
    seen = overtrigger(camera)
    if seen.rose_at is None:
        if seen.results >= 2:
            raise NotObserved("the camera took both of two triggers at once")
        raise Differs("Overtriggered for a trigger that was dropped", seen.text)
    if seen.results != 1:
        raise Differs("one result for two triggers of which one was dropped", seen.text)


@check("SC-A30, published", needs=Allow.TRIGGER, dialects=SMART)
def overtriggered_falls_by_itself(camera: CameraUnderTest) -> None:
    """A status without Overtriggered comes later."""
    seen = overtrigger(camera)
    if seen.rose_at is None:
        raise NotObserved("no trigger was reported as dropped")
    if seen.fell_at is None:
        raise Differs("a status without Overtriggered later, by itself", seen.text)


@check("ID-a 227, published", needs=Allow.ERRORS, dialects=("bid",))
def reset_errors_brings_a_status(camera: CameraUnderTest) -> None:
    """Reset errors is answered with the code 0, and a status follows."""
    with camera.session() as client:
        client.fence()
        mark = len(client.received)
        answer = client.answer(m.ResetErrors())
        if camera.wire.numbers(answer.body) != (0,):
            raise Differs("the code 0", camera.wire.spell(answer))
        behind = client.received.index(answer) + 1
        client.until(
            MessageId.STATUS,
            camera.options.timeout,
            f"a status after the answer ({client.words(mark)})",
            mark=behind,
        )


@check("ID-a 227, published", needs=Allow.TRIGGER | Allow.ERRORS, dialects=("bid",))
def trigger_error_stays_until_reset(camera: CameraUnderTest) -> None:
    """A dropped trigger shows as Trigger Error, which stays until the errors are reset."""
    takes = inspection_time(camera)
    error = camera.wire.bits.overtriggered
    with camera.session() as client:
        camera.ready(client)
        mark = len(client.received)
        client.send(m.Trigger(), m.Trigger())
        client.listen(2 * takes + camera.options.quiet)
        word = client.look()
        results = len(of_kind(client.received[mark:], MessageId.RESULT_CONTAINER))
        if not word & error and results >= 2:
            raise NotObserved("the camera took both of two triggers at once")
        if not word & error:
            raise Differs("Trigger Error, which stays", client.words(mark))
        client.answer(m.ResetErrors())
        if client.look() & error:
            raise Differs("no Trigger Error after Reset errors", client.words(mark))


@check("MV31, published", needs=Allow.RUN, dialects=SMART)
def free_run_needs_no_trigger(camera: CameraUnderTest) -> None:
    """An application without triggers sends results in run mode, and none after Stop."""
    with camera.session() as client:
        try:
            camera.ready(client)
        except NotObserved:
            if not camera.running(client):
                raise
        else:
            raise NotObserved(f"application {camera.application} waits for triggers")
        client.until(
            MessageId.RESULT_CONTAINER,
            camera.options.timeout,
            "a result of the application that runs without triggers",
        )
        camera.stop(client)
        client.fence()
        mark = len(client.received)
        frames = client.listen(2 * camera.options.quiet)
        if of_kind(frames, MessageId.RESULT_CONTAINER):
            raise Differs("no result after Stop", client.words(mark))


@check("MV31, SC-A30, published", needs=Allow.RUN, dialects=SMART)
def stop_ends_run_mode(camera: CameraUnderTest) -> None:
    """Stop takes Running and Waiting for Trigger away."""
    bits = camera.wire.bits
    with camera.session() as client:
        camera.load(client, camera.application)
        camera.start(client)
        client.send(m.Stop())
        word = client.wait_status(
            lambda word: not word & bits.running, camera.options.timeout, "a status without Running"
        )
        if word & bits.waiting:
            raise Differs("a stopped camera that does not wait for triggers", f"{word:#x}")


@check("SC-A28, published", needs=Allow.RUN, dialects=SMART)
def second_stop_is_harmless(camera: CameraUnderTest) -> None:
    """Stop is not answered, and changes nothing out of run mode."""
    with camera.session() as client:
        camera.stop(client)
    _changes_nothing(camera, m.Stop())


def _changes_nothing(camera: CameraUnderTest, message: Message) -> None:
    with camera.session() as client:
        was = camera.running(client)
        mark = len(client.received)
        client.send(message)
        client.fence()
        client.listen(camera.options.quiet)
        now = camera.running(client)
        name = type(message).__name__
        if of_kind(client.received, camera.wire.dialect.message_id(message)):
            raise Differs(f"no answer to {name}", client.words(mark))
        if was != now:
            raise Differs(f"a second {name} changes nothing", client.words(mark))


@check("MV31, published", needs=Allow.RUN | Allow.TRIGGER, dialects=SMART)
def stopped_camera_ignores_triggers(camera: CameraUnderTest) -> None:
    """A trigger to a stopped camera gives no result."""
    seen = stopped_trigger(camera)
    if of_kind(seen.frames, MessageId.RESULT_CONTAINER):
        raise Differs("no result of a stopped camera", seen.text)
