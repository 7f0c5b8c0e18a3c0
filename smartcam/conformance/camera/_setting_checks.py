"""Checks: switching applications, the clock, the sequence number, input data, a restart."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from smartcam.conformance._dialects import SMART_DIALECTS
from smartcam.conformance.camera._observations import (
    has_no_id,
    inspection_time,
    observe_restart,
    observe_switch,
)
from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._results import check
from smartcam.conformance.camera._verdicts import Differs, NotObserved
from smartcam.conformance.camera._wire import frames_with_id
from smartcam.protocols import messages as m
from smartcam.protocols._inside import MessageId

if TYPE_CHECKING:
    from smartcam.conformance.camera._raw_client import RawClient
    from smartcam.conformance.camera._session_under_test import CameraUnderTest
    from smartcam.conformance.camera._wire import ReceivedFrame

UNKNOWN_APPLICATION = 0xFFFD
"""An id that most probably no application has; it fits 16 bits."""

CLOCK_TOLERANCE = timedelta(seconds=3)
"""Largest difference of a clock right after it was set: the transmission, and a new second."""

EXAMPLE_DATE = datetime(2016, 6, 25, 10, 11, 12, tzinfo=UTC)
"""The date of the published examples (MV30, ID-b 218). The camera has no time zone."""


# ---------------------------------------------------------------------- switching

_B16 = "bodies as in the dialects of 32 bits, with numbers of 16 bits, inferred"
_SWITCH = {"": "SC-B34, published", "b16": _B16, "bid": "ID-a 229, published"}


@check(_SWITCH, needs=Allow.SWITCH)
def application_0_is_refused(camera: CameraUnderTest) -> None:
    """A switch to the id 0 is refused, and the active application stays."""
    _check_refusal(camera, 0)


@check(_SWITCH, needs=Allow.SWITCH)
def unknown_application_is_refused(camera: CameraUnderTest) -> None:
    """A switch to an id that no application has is refused, and the active one stays."""
    _check_refusal(camera, UNKNOWN_APPLICATION)


def _check_refusal(camera: CameraUnderTest, application: int) -> None:
    with camera.session() as client:
        code = 0x1A if camera.codec.dialect.coded else 1
        active = camera.active_application(client)
        camera.ensure_stopped(client)
        answer = client.ask(m.SwitchApplication(application=application))
        if camera.codec.read_numbers(answer.body) != (code, active):
            raise Differs(
                f"the code {code:#x} and the application that stays active, {active}",
                camera.codec.describe(answer),
            )
        if camera.active_application(client) != active:
            raise Differs(f"application {active} stays active", client.describe_received())


@check(_SWITCH, needs=Allow.SWITCH)
def switch_loads_the_application(camera: CameraUnderTest) -> str:
    """A switch is answered when it is done, with the id that is active then."""
    observed = observe_switch(camera)
    if camera.codec.read_numbers(observed.answer.body) != (0, observed.application):
        raise Differs(
            f"the code 0 and the id {observed.application}", camera.codec.describe(observed.answer)
        )
    if observed.active != observed.application:
        raise Differs(
            f"application {observed.application} is active",
            f"Query reports application {observed.active}",
        )
    return f"{observed.seconds:.3f} s"


@check("SC-B33, published", needs=Allow.SWITCH, dialects=SMART_DIALECTS)
def busy_during_a_switch(camera: CameraUnderTest) -> None:
    """BUSY is set during a switch."""
    observed = observe_switch(camera)
    busy = camera.codec.bits.busy
    words = camera.codec.status_words(observed.frames)
    if not any(word & busy for word in words) or words[-1] & busy:
        frames_text = "; ".join(map(camera.codec.describe, observed.frames))
        raise Differs("a status with BUSY during the switch, and one without it after", frames_text)


@check(
    {"": "no document, inferred", "bid": "ID-a 229, ID-b 216, published"},
    about="during a switch a second one is not answered and Query reports the old application; "
    "a BVS ID answers both with Busy",
    needs=Allow.SWITCH,
)
def second_switch_meanwhile(camera: CameraUnderTest) -> None:
    """Ask for a second switch, and for the active application, while the first is under way."""
    other = observe_switch(camera).application
    with camera.session() as client:
        active = camera.active_application(client)
        if active == other:
            camera.load_application(client, camera.application)
            active = camera.active_application(client)
        camera.ensure_stopped(client)
        start_index = len(client.received)
        request = m.SwitchApplication(application=other)
        client.send(request, request, m.Query())
        first = client.wait_for_frame(
            MessageId.QUERY_APPLICATION,
            camera.options.switch_timeout,
            "an answer to a Query during a switch",
            start_index=start_index,
        )
        switch_done = (0, other)
        client.wait_for_frame(
            lambda message: (
                camera.codec.read_numbers(message.body) == switch_done
                and message.message_id == MessageId.SWITCH_APPLICATION
            ),
            camera.options.switch_timeout,
            "the answer to the first switch",
            start_index=start_index,
        )
        client.listen(camera.options.silence)
        _judge_second_switch(camera, client, start_index, first, active)


def _judge_second_switch(
    camera: CameraUnderTest, client: RawClient, start_index: int, query: ReceivedFrame, active: int
) -> None:
    switched = frames_with_id(client.received[start_index:], MessageId.SWITCH_APPLICATION)
    answers = [camera.codec.read_numbers(message.body) for message in switched]
    numbers = camera.codec.read_numbers(query.body)
    if camera.codec.is_bid:
        if numbers != (0x16, 0) or answers[0] != (0x16, active) or len(answers) != 2:
            raise Differs(
                f"the code 0x16 and 0 to the Query, 0x16 and {active} to the second switch",
                client.describe_received(start_index),
            )
    elif numbers[-1] != active or len(answers) != 1:
        raise Differs(
            f"the old application's id, {active}, and no answer to the second switch",
            client.describe_received(start_index),
        )


# ---------------------------------------------------------------------- clock


def _read_clock(camera: CameraUnderTest, client: RawClient) -> datetime:
    answer = client.ask(m.GetClock())
    numbers = camera.codec.read_numbers(answer.body)
    if camera.codec.dialect.coded:
        code, numbers = numbers[0], numbers[1:]
        if code != 6:
            raise Differs("the code 6", camera.codec.describe(answer))
    try:
        year, month, day, hour, minute, second = numbers
        return datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError as exc:
        raise Differs(
            "year, month, day, hour, minute, second", camera.codec.describe(answer)
        ) from exc


def _set_clock(camera: CameraUnderTest, client: RawClient, time: datetime) -> None:
    request = m.SetClock(
        year=time.year,
        month=time.month,
        day=time.day,
        hour=time.hour,
        minute=time.minute,
        second=time.second,
    )
    _send_setting(camera, client, request, (0,))


def _send_setting(
    camera: CameraUnderTest, client: RawClient, request: m.Request, code: tuple[int, ...]
) -> None:
    """Send a request that a BVS ID acknowledges and a smart camera does not answer."""
    if not camera.codec.is_bid:
        message_id = camera.codec.dialect.message_id(request)
        client.send(request)
        if frames_with_id(client.round_trip(), message_id):
            raise Differs(f"no answer to {type(request).__name__}", client.describe_received())
        return
    answer = client.ask(request)
    if camera.codec.read_numbers(answer.body) != code:
        raise Differs(f"the code {code[0]:#x}", camera.codec.describe(answer))


@check({"": "MV29, published", "b16": _B16, "bid": "ID-b 218, published"})
def clock_is_reported(camera: CameraUnderTest) -> str:
    """The command "Get the time stamp" is answered with a date and a time."""
    with camera.session() as client:
        return f"{_read_clock(camera, client):%Y-%m-%d %H:%M:%S}"


@check({"": "MV29, MV30, published", "b16": _B16, "bid": "ID-a 231, published"}, needs=Allow.CLOCK)
def clock_is_set(camera: CameraUnderTest) -> None:
    """The clock goes on from the time that is set."""
    with camera.session() as client:
        old_time, read_at = _read_clock(camera, client), time.monotonic()
        try:
            _set_clock(camera, client, EXAMPLE_DATE)
            new_time = _read_clock(camera, client)
        finally:
            _set_clock(camera, client, old_time + timedelta(seconds=time.monotonic() - read_at))
        if not EXAMPLE_DATE <= new_time < EXAMPLE_DATE + CLOCK_TOLERANCE:
            raise Differs(f"{EXAMPLE_DATE:%Y-%m-%d %H:%M:%S} or a moment later", f"{new_time:%c}")


@check({"": "MV30, published", "bid": "ID-a 52, derived"}, needs=Allow.CLOCK)
def impossible_date_is_harmless(camera: CameraUnderTest) -> None:
    """A time that is not valid is dropped or converted; a BVS ID refuses it."""
    request = m.SetClock(year=2016, month=13, day=32, hour=25, minute=61, second=61)
    with camera.session() as client:
        old_time, read_at = _read_clock(camera, client), time.monotonic()
        try:
            _send_setting(camera, client, request, (0x10,))
            _read_clock(camera, client)  # raises if it is no date
        finally:
            _set_clock(camera, client, old_time + timedelta(seconds=time.monotonic() - read_at))


# ---------------------------------------------------------------------- number, input, reboot


def read_next_number(camera: CameraUnderTest, client: RawClient) -> bytes:
    """Trigger once and return the four bytes of the sequence number in the result.

    Raises:
        NotObserved: the number's offset is not known, or no result comes.
    """
    offset = camera.options.sequence_offset
    if offset is None:
        raise NotObserved(
            "the offset of the sequence number in a result is not known: --camera-sequence-offset"
        )
    camera.wait_until_waiting(client)
    result = client.trigger()
    begin = offset + (0 if "no_id" in camera.codec.dialect.quirks else camera.codec.word_size)
    field = result.body[begin : begin + 4]
    if len(field) < 4:
        raise NotObserved(f"a result is too short for {offset}: {camera.codec.describe(result)}")
    return field


@check(
    {"": "SC-C50, inferred", "b16": "SC-C50, published"},
    needs=Allow.NUMBER | Allow.TRIGGER,
    dialects=SMART_DIALECTS,
    contradictions=("C6",),
)
def sequence_number_is_set(camera: CameraUnderTest) -> None:
    """The number of the command "Set sequence number" is that of the next run, which counts on."""
    number = 0x01020304
    has_no_id(camera)  # raises if the number's offset is unknown
    little, big = number.to_bytes(4, "little"), number.to_bytes(4, "big")
    with camera.session() as client:
        camera.ensure_ready(client)
        client.write(camera.codec.make_frame(MessageId.SET_SEQUENCE_NUMBER, little))
        first = read_next_number(camera, client)
        second = read_next_number(camera, client)
    if camera.dialect == "b16" and first == big:
        return  # the question big_endian_number reports it
    next_number = (number + 1).to_bytes(4, "little")
    if (first, second) != (little, next_number):
        raise Differs(
            f"{little.hex(' ')} and, in the next run, {next_number.hex(' ')}",
            f"{first.hex(' ')} and {second.hex(' ')}",
        )


@check(
    {"": "SC-A30, SC-B33, MV30, published", "bid": "ID-a 232, ID-b 220, published"},
    needs=Allow.INPUT | Allow.TRIGGER,
)
def input_data_is_taken(camera: CameraUnderTest) -> None:
    """Input data before each trigger keeps containers and inspections in step."""
    data = camera.options.input_data
    if data is None:
        raise NotObserved("it is not known what input data the application takes: --camera-input")
    inspection_seconds = inspection_time(camera)
    bits = camera.codec.bits
    with camera.session() as client:
        camera.ensure_ready(client)
        start_index = len(client.received)
        for _ in range(2):  # the first trigger clears the bit's history
            _send_setting(camera, client, m.SetInput(data=data), (0,))
            camera.wait_until_waiting(client)
            start_index = len(client.received)
            timeout = inspection_seconds + camera.options.timeout
            client.trigger("a result of a trigger with input data", timeout=timeout)
        if client.read_status() & bits.input_container:
            raise Differs(
                "no Input Container where each trigger had its input data",
                client.describe_received(start_index),
            )


@check("MV31, published", needs=Allow.REBOOT, dialects=SMART_DIALECTS, contradictions=("C9",))
def reboot_restarts_the_camera(camera: CameraUnderTest) -> str:
    """0x43 restarts the camera: the session ends, and it comes back."""
    return f"{observe_restart(camera).seconds:.1f} s"


@check("no document, inferred", needs=Allow.REBOOT, dialects=SMART_DIALECTS)
def stopped_after_a_reboot(camera: CameraUnderTest) -> None:
    """A camera that has restarted is stopped."""
    observed = observe_restart(camera)
    if observed.running:
        raise Differs("the last application, stopped", f"application {observed.application} runs")
