"""Checks: run mode and triggers. Sources: the keys in docs/sources.md."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from smartcam.conformance._dialects import SMART_DIALECTS
from smartcam.conformance.camera._observations import (
    inspection_time,
    observe_double_trigger,
    observe_inspections,
    observe_stopped_trigger,
)
from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._results import check
from smartcam.conformance.camera._verdicts import Differs, NotObserved
from smartcam.conformance.camera._wire import frames_with_id
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera._session_under_test import CameraUnderTest
    from smartcam.protocols.messages import Message


@check("MV31, SC-A30, published", needs=Allow.RUN, dialects=SMART_DIALECTS)
def start_begins_run_mode(camera: CameraUnderTest) -> str:
    """Start sets Running, and a triggered application begins to wait."""
    bits = camera.codec.bits
    with camera.session() as client:
        camera.load_application(client, camera.application)
        camera.ensure_stopped(client)
        started_at = client.send(m.Start())
        client.wait_status(
            lambda word: word & bits.running, camera.options.timeout, "a status with Running"
        )
        try:
            camera.wait_until_waiting(client)
        except NotObserved as exc:
            return str(exc)
    camera.measured_times["start until waiting"] = time.monotonic() - started_at
    return ""


@check("SC-A28, published", needs=Allow.RUN, dialects=SMART_DIALECTS)
def second_start_is_harmless(camera: CameraUnderTest) -> None:
    """Start is not answered, and changes nothing in run mode."""
    with camera.session() as client:
        camera.ensure_running(client)
    _check_no_change(camera, m.Start())


@check({"": "SC-B33, MV27, published", "bid": "ID-b 213, ID-b 221, published"}, needs=Allow.TRIGGER)
def trigger_gives_one_result(camera: CameraUnderTest) -> str:
    """A trigger gives one result container, of the active application."""
    inspection_time(camera)  # raises if there are no results
    word_size = camera.codec.word_size
    for inspection in observe_inspections(camera):
        if len(inspection.results) != 1:
            raise Differs("one result for each trigger", f"{len(inspection.results)} results")
        body = inspection.results[0].body
        application = int.from_bytes(body[:word_size], "little")
        if camera.dialect != "b16" and application != camera.application:
            raise Differs(
                f"the id {camera.application} at the beginning of the result",
                camera.codec.describe(inspection.results[0]),
            )
    return f"{len(observe_inspections(camera))} triggers"


@check("ID-b 221, published", needs=Allow.TRIGGER, dialects=("bid",))
def trigger_is_acknowledged(camera: CameraUnderTest) -> None:
    """A trigger is answered with the code 0."""
    for inspection in observe_inspections(camera):
        answers = frames_with_id(inspection.frames, MessageId.TRIGGER)
        if [camera.codec.read_numbers(answer.body) for answer in answers] != [(0,)]:
            frames_text = "; ".join(map(camera.codec.describe, inspection.frames)) or "nothing"
            raise Differs("one answer to the trigger, the code 0", frames_text)


@check({"": "SC-A30, SC-C50, published", "bid": "ID-b 210, published"}, needs=Allow.TRIGGER)
def waiting_falls_and_rises(camera: CameraUnderTest) -> None:
    """Waiting for Trigger falls with a trigger and rises when the next would be taken."""
    for inspection in observe_inspections(camera):
        if inspection.status_under_way is not None:
            fell = not inspection.status_under_way & inspection.waiting_mask
            result = inspection.results[0] if inspection.results and not fell else None
            if result is not None and result.at - inspection.sent_at < camera.options.silence:
                continue  # the inspection was over before the status came
            rose = True  # observe_inspections() waits until it has risen
        else:
            indices = inspection.transition_indices()
            fell, rose = indices[0] is not None, indices[2] is not None
        if not (fell and rose):
            frames_text = "; ".join(map(camera.codec.describe, inspection.frames)) or "nothing"
            raise Differs("Waiting for Trigger falls with a trigger and rises again", frames_text)


@check("SC-A30, SC-B33, published", needs=Allow.TRIGGER, dialects=SMART_DIALECTS)
def dropped_trigger_is_reported(camera: CameraUnderTest) -> None:
    """One of two triggers at once is dropped, and a status with Overtriggered says so."""
    observed = observe_double_trigger(camera)
    if observed.rose_at is None:
        if observed.results >= 2:
            raise NotObserved("the camera took both of two triggers at once")
        raise Differs("Overtriggered for a trigger that was dropped", observed.text)
    if observed.results != 1:
        raise Differs("one result for two triggers of which one was dropped", observed.text)


@check("SC-A30, published", needs=Allow.TRIGGER, dialects=SMART_DIALECTS)
def overtriggered_falls_by_itself(camera: CameraUnderTest) -> None:
    """A status without Overtriggered comes later."""
    observed = observe_double_trigger(camera)
    if observed.rose_at is None:
        raise NotObserved("no trigger was reported as dropped")
    if observed.fell_at is None:
        raise Differs("a status without Overtriggered later, by itself", observed.text)


@check("ID-a 227, published", needs=Allow.ERRORS, dialects=("bid",))
def reset_errors_brings_a_status(camera: CameraUnderTest) -> None:
    """Reset errors is answered with the code 0, and a status follows."""
    with camera.session() as client:
        client.round_trip()
        start_index = len(client.received)
        answer = client.ask(m.ResetErrors())
        if camera.codec.read_numbers(answer.body) != (0,):
            raise Differs("the code 0", camera.codec.describe(answer))
        after_answer = client.received.index(answer) + 1
        client.wait_for_frame(
            MessageId.STATUS,
            camera.options.timeout,
            f"a status after the answer ({client.describe_received(start_index)})",
            start_index=after_answer,
        )


@check("ID-a 227, published", needs=Allow.TRIGGER | Allow.ERRORS, dialects=("bid",))
def trigger_error_stays_until_reset(camera: CameraUnderTest) -> None:
    """A dropped trigger shows as Trigger Error, which stays until the errors are reset."""
    inspection_seconds = inspection_time(camera)
    error = camera.codec.bits.overtriggered
    with camera.session() as client:
        camera.ensure_ready(client)
        start_index = len(client.received)
        client.send(m.Trigger(), m.Trigger())
        client.listen(2 * inspection_seconds + camera.options.silence)
        word = client.read_status()
        results = len(frames_with_id(client.received[start_index:], MessageId.RESULT_CONTAINER))
        if not word & error and results >= 2:
            raise NotObserved("the camera took both of two triggers at once")
        if not word & error:
            raise Differs("Trigger Error, which stays", client.describe_received(start_index))
        client.ask(m.ResetErrors())
        if client.read_status() & error:
            raise Differs(
                "no Trigger Error after Reset errors", client.describe_received(start_index)
            )


@check("MV31, published", needs=Allow.RUN, dialects=SMART_DIALECTS)
def free_run_needs_no_trigger(camera: CameraUnderTest) -> None:
    """An application without triggers sends results in run mode, and none after Stop."""
    with camera.session() as client:
        try:
            camera.ensure_ready(client)
        except NotObserved:
            if not camera.is_running(client):
                raise
        else:
            raise NotObserved(f"application {camera.application} waits for triggers")
        client.wait_for_frame(
            MessageId.RESULT_CONTAINER,
            camera.options.timeout,
            "a result of the application that runs without triggers",
        )
        camera.ensure_stopped(client)
        client.round_trip()
        start_index = len(client.received)
        frames = client.listen(2 * camera.options.silence)
        if frames_with_id(frames, MessageId.RESULT_CONTAINER):
            raise Differs("no result after Stop", client.describe_received(start_index))


@check("MV31, SC-A30, published", needs=Allow.RUN, dialects=SMART_DIALECTS)
def stop_ends_run_mode(camera: CameraUnderTest) -> None:
    """Stop takes Running and Waiting for Trigger away."""
    bits = camera.codec.bits
    with camera.session() as client:
        camera.load_application(client, camera.application)
        camera.ensure_running(client)
        client.send(m.Stop())
        word = client.wait_status(
            lambda word: not word & bits.running, camera.options.timeout, "a status without Running"
        )
        if word & bits.waiting:
            raise Differs("a stopped camera that does not wait for triggers", f"{word:#x}")


@check("SC-A28, published", needs=Allow.RUN, dialects=SMART_DIALECTS)
def second_stop_is_harmless(camera: CameraUnderTest) -> None:
    """Stop is not answered, and changes nothing out of run mode."""
    with camera.session() as client:
        camera.ensure_stopped(client)
    _check_no_change(camera, m.Stop())


def _check_no_change(camera: CameraUnderTest, message: Message) -> None:
    with camera.session() as client:
        running_before = camera.is_running(client)
        start_index = len(client.received)
        client.send(message)
        client.round_trip()
        client.listen(camera.options.silence)
        running_after = camera.is_running(client)
        name = type(message).__name__
        if frames_with_id(client.received, camera.codec.dialect.message_id(message)):
            raise Differs(f"no answer to {name}", client.describe_received(start_index))
        if running_before != running_after:
            raise Differs(f"a second {name} changes nothing", client.describe_received(start_index))


@check("MV31, published", needs=Allow.RUN | Allow.TRIGGER, dialects=SMART_DIALECTS)
def stopped_camera_ignores_triggers(camera: CameraUnderTest) -> None:
    """A trigger to a stopped camera gives no result."""
    observed = observe_stopped_trigger(camera)
    if frames_with_id(observed.frames, MessageId.RESULT_CONTAINER):
        raise Differs("no result of a stopped camera", observed.text)
