"""The device model: states, messages and time, without any socket."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import Any

import pytest

from smartcam.emulator import Application, Quirks
from smartcam.emulator._inside import Device
from smartcam.exceptions import ConfigurationError
from smartcam.models import Status
from smartcam.protocols import messages as m
from tests.emulator.camera_wire import heard

CHECK = Application(
    id=3, layout="n: uint8 @sequence", constant={"n": 0}, load_time=0.4, processing_time=0.05
)
SILENT = Application(id=5, processing_time=0.05, load_time=0.0)
FREE = Application(
    id=9, layout="n: uint32 @sequence", generator="sequence", rate=30.0, processing_time=0.01
)
ECHO = Application(id=4, layout="a: uint8", input="a: uint8", generator="input", load_time=0.1)


def make(active: int = 3, *, connected: bool = True, **options: Any) -> Device:
    quirks = Quirks(**{name: options.pop(name) for name in Quirks.model_fields if name in options})
    device = Device([CHECK, SILENT, FREE, ECHO], active=active, quirks=quirks, **options)
    if connected:
        device.handle(m.Connect())
        heard(device)
    return device


def say(device: Device, *messages: m.Message) -> list[str]:
    for message in messages:
        device.handle(message)
    return heard(device)


def switch(application: int) -> m.SwitchApplication:
    return m.SwitchApplication(application=application)


# ---------------------------------------------------------------------- session


def test_connect_is_answered_then_a_status_comes_whatever_it_is() -> None:
    device = make(connected=False)
    assert say(device, m.Connect()) == ["hello 1", "[]"]
    assert device.connected
    assert say(device, m.Start(), m.Connect()) == ["hello 1", "[run wait]"]


def test_disconnect_is_silent_and_the_application_goes_on() -> None:
    device = make(9, running=True)
    assert say(device, m.Disconnect()) == []
    assert not device.connected
    device.tick(1.0)
    assert heard(device) == []
    assert device.running
    assert device.next_number == 31
    assert say(device, m.Connect()) == ["hello 1", "[run]"]


def test_disconnect_drops_what_was_not_taken() -> None:
    device = make()
    device.handle(m.Query())
    assert say(device, m.Disconnect()) == []


REQUESTS: list[m.Message] = [
    m.Query(),
    switch(5),
    m.GetClock(),
    m.SetClock(year=2020, month=1, day=1, hour=0, minute=0, second=0),
    m.SetInput(data=b"1"),
    m.SetSequenceNumber(number=7),
    m.Trigger(),
    m.Start(),
    m.Stop(),
    m.Reboot(),
    m.Disconnect(),
    m.UnknownMessage(message_id=0x77, payload=b""),
]


@pytest.mark.parametrize("message", REQUESTS, ids=lambda message: type(message).__name__)
def test_requests_before_connect_are_ignored(message: m.Message) -> None:
    device = make(connected=False)
    assert say(device, message) == []
    assert device.mode.value == "stopped"
    assert device.next_number == 0
    assert device.clock_time.year == 1970
    assert device.next_event_in() is None


# ---------------------------------------------------------------------- state x input


def stopped() -> Device:
    return make()


def waiting() -> Device:
    device = make()
    say(device, m.Start())
    return device


def processing() -> Device:
    device = waiting()
    assert say(device, m.Trigger()) == ["[run]"]
    return device


def free() -> Device:
    device = make(9)
    say(device, m.Start())
    device.tick(0.02)
    heard(device)
    return device


def switching() -> Device:
    device = make()
    assert say(device, switch(9)) == ["[busy]"]
    return device


def rebooting() -> Device:
    device = make()
    assert say(device, m.Reboot()) == []
    return device


INPUTS: dict[str, m.Message] = {
    "Query": m.Query(),
    "Switch": switch(4),
    "Switch0": switch(0),
    "SwitchUnknown": switch(77),
    "Trigger": m.Trigger(),
    "Start": m.Start(),
    "Stop": m.Stop(),
    "Unknown": m.UnknownMessage(message_id=0x77, payload=b"x"),
    "GetClock": m.GetClock(),
    "Connect": m.Connect(),
    "Reboot": m.Reboot(),
}
NO_3, NO_9, NEW_CLOCK = "switched 1 3", "switched 1 9", "1970-1-1 0:0:0"
TABLE: dict[Callable[[], Device], tuple[str, ...]] = {  # what is said to INPUTS, in their order
    stopped: ("active 3", "[busy]", NO_3, NO_3, "", "[run wait]", "", "", NEW_CLOCK),
    waiting: ("active 3", NO_3, NO_3, NO_3, "[run]", "", "[]", "", NEW_CLOCK),
    processing: ("active 3", NO_3, NO_3, NO_3, "[run over]", "", "[]", "", NEW_CLOCK),
    free: ("active 9", NO_9, NO_9, NO_9, "", "", "[]", "", NEW_CLOCK),
    switching: ("active 3", "", "", "", "", "", "", "", NEW_CLOCK),
    rebooting: ("",) * len(INPUTS),
}


@pytest.mark.parametrize(
    ("state", "name", "expected"),
    [
        pytest.param(state, name, expected, id=f"{state.__name__}-{name}")
        for state, row in TABLE.items()
        for name, expected in zip(INPUTS, row, strict=False)
    ],
)
def test_state_and_input(state: Any, name: str, expected: str) -> None:
    assert say(state(), INPUTS[name]) == ([expected] if expected else [])


# ---------------------------------------------------------------------- trigger


def test_trigger_gives_the_result_then_waiting_rises() -> None:
    device = processing()
    assert device.processing
    assert device.next_event_in() == 0.05
    device.tick(0.049)
    assert heard(device) == []
    device.tick(0.001)
    assert heard(device) == ["result 3 00", "[run wait]"]
    assert not device.processing


def test_trigger_without_send_results_gives_no_container() -> None:
    device = make(5, running=True)
    assert say(device, m.Trigger()) == ["[run]"]
    device.tick(0.05)
    assert heard(device) == ["[run wait]"]


def test_trigger_quirk_waiting_before_result() -> None:
    device = make(running=True, waiting_before_result=True)
    say(device, m.Trigger())
    device.tick(0.05)
    assert heard(device) == ["[run wait]", "result 3 00"]


def test_trigger_quirk_busy_while_processing() -> None:
    device = make(running=True, busy_while_processing=True)
    assert say(device, m.Trigger()) == ["[busy run]"]
    device.tick(0.05)
    assert heard(device) == ["result 3 00", "[run wait]"]


def test_trigger_processing_time_zero_gives_the_result_at_once() -> None:
    app = Application(id=2, layout="n: uint8", constant=[1], processing_time=0)
    device = Device([app], running=True)
    say(device, m.Connect())
    assert say(device, m.Trigger()) == ["[run]", "result 2 01", "[run wait]"]


def test_trigger_while_processing_is_dropped_and_shows_for_a_while() -> None:
    device = make(running=True, overtriggered_time=0.2)
    assert say(device, m.Trigger(), m.Trigger()) == ["[run]", "[run over]"]
    device.tick(0.05)
    assert heard(device) == ["result 3 00", "[run over wait]"]
    device.tick(0.149)
    assert heard(device) == []
    device.tick(0.001)
    assert heard(device) == ["[run wait]"]
    assert device.next_number == 1


def test_trigger_dropped_again_keeps_overtriggered_longer() -> None:
    device = make(running=True, overtriggered_time=0.03)
    say(device, m.Trigger(), m.Trigger())
    device.tick(0.02)
    assert say(device, m.Trigger()) == []
    device.tick(0.029)
    assert heard(device) == []
    device.tick(0.001)
    assert heard(device) == ["result 3 00", "[run over wait]", "[run wait]"]


def test_trigger_overtriggered_time_zero_gives_two_statuses() -> None:
    device = make(running=True, overtriggered_time=0)
    assert say(device, m.Trigger(), m.Trigger()) == ["[run]", "[run over]", "[run]"]


def test_stop_voids_the_inspection_under_way() -> None:
    device = processing()
    assert say(device, m.Stop()) == ["[]"]
    assert device.next_event_in() is None
    device.tick(10.0)
    assert heard(device) == []
    assert say(device, m.Start(), m.Trigger()) == ["[run wait]", "[run]"]
    device.tick(0.05)
    assert heard(device) == ["result 3 01", "[run wait]"]


# ---------------------------------------------------------------------- free-running


def test_start_free_running_results_come_at_the_exact_rate() -> None:
    device = make(9)
    assert say(device, m.Start()) == ["[run]"]
    device.tick(10.0)
    results = heard(device)
    assert len(results) == 300
    assert results[-1] == f"result 9 {(299).to_bytes(4, 'little').hex()}"
    assert device.next_number == 301


def test_free_running_rate_does_not_depend_on_the_ticks() -> None:
    device = make(9)
    say(device, m.Start())
    times: list[float] = []
    for _ in range(4000):
        device.tick(0.0005)
        times.extend(device.time for _ in heard(device))
    assert len(times) == 60
    exact = [n / 30 + 0.01 for n in range(60)]
    assert all(-1e-9 < seen - due < 0.0006 for seen, due in zip(times, exact, strict=True))


def test_free_running_runs_that_touch_do_not_swallow_each_other() -> None:
    app = Application(
        id=2, layout="n: uint8 @sequence", constant=[0], rate=3.0, processing_time=0.3333333333
    )
    device = Device([app], running=True, quirks=Quirks(busy_while_processing=True))
    say(device, m.Connect())
    device.tick(100.0)
    assert sum(word.startswith("result") for word in heard(device)) == 300


def test_stop_free_running_goes_silent() -> None:
    device = make(9, running=True)
    device.tick(0.0)
    assert say(device, m.Stop()) == ["[]"]
    assert device.next_event_in() is None


def test_device_free_running_from_the_beginning_runs_at_once() -> None:
    device = make(9, running=True, connected=False)
    assert device.next_event_in() == 0.0
    device.tick(0.0)
    assert device.processing


# ---------------------------------------------------------------------- switch


def test_switch_says_busy_then_status_then_answer() -> None:
    device = make()
    assert say(device, switch(4)) == ["[busy]"]
    assert device.mode.value == "switching"
    device.tick(0.099)
    assert heard(device) == []
    device.tick(0.001)
    assert heard(device) == ["[]", "switched 0 4"]
    assert say(device, m.Query()) == ["active 4"]
    assert not device.running


def test_switch_quirk_answer_before_status() -> None:
    device = make(switch_answer="before_status")
    say(device, switch(4))
    device.tick(0.1)
    assert heard(device) == ["switched 0 4", "[]"]


def test_switch_load_time_zero_is_done_at_once() -> None:
    assert say(make(), switch(5)) == ["[busy]", "[]", "switched 0 5"]


def test_switch_to_the_active_one_loads_it_again() -> None:
    device = make()
    assert say(device, switch(3)) == ["[busy]"]
    device.tick(0.4)
    assert heard(device) == ["[]", "switched 0 3"]


def test_switch_quirk_ignore_while_running() -> None:
    device = make(running=True, switch_while_running="ignore")
    assert say(device, switch(4), m.Query()) == ["active 3"]
    assert say(device, switch(77)) == ["switched 1 3"]


@pytest.mark.parametrize("active", [3, 9])
def test_switch_quirk_allow_while_running_stops_it(active: int) -> None:
    device = make(active, running=True, switch_while_running="allow")
    say(device, m.Trigger())
    assert say(device, switch(4)) == ["[busy]"]
    device.tick(1.0)
    assert heard(device) == ["[]", "switched 0 4"]
    assert device.mode.value == "stopped"


def test_switch_goes_on_without_the_client() -> None:
    device = switching()
    assert say(device, m.Disconnect(), m.Connect()) == ["hello 1", "[busy]"]
    device.tick(0.3)
    assert heard(device) == ["[]"]  # the answer falls with the session that asked


def test_switch_starts_a_cycle_from_its_first_entry() -> None:
    app = Application(id=2, layout="n: uint8", cycle=[[1], [2]], processing_time=0, load_time=0)
    device = Device([app], running=True)
    say(device, m.Connect(), m.Trigger(), m.Stop(), switch(2), m.Start())
    assert "result 2 01" in say(device, m.Trigger())
    assert "result 2 02" in say(device, m.Trigger())


# ---------------------------------------------------------------------- numbers and clock


def test_sequence_number_set_is_the_next_runs_then_counts_on() -> None:
    device = make(running=True)
    assert say(device, m.SetSequenceNumber(number=0xFFFFFFFF)) == []
    for expected in ("result 3 ff", "result 3 00"):
        device.handle(m.Trigger())
        device.tick(0.05)
        assert expected in heard(device)


def test_sequence_number_set_while_processing_is_for_the_next_run() -> None:
    device = processing()
    device.handle(m.SetSequenceNumber(number=0x42))
    device.tick(0.05)
    assert "result 3 00" in heard(device)
    device.handle(m.Trigger())
    device.tick(0.05)
    assert "result 3 42" in heard(device)


def clock(year: int, month: int, day: int, hour: int, minute: int, second: int) -> m.SetClock:
    return m.SetClock(year=year, month=month, day=day, hour=hour, minute=minute, second=second)


def test_clock_set_goes_on() -> None:
    device = make()
    assert say(device, clock(2016, 6, 25, 10, 11, 12)) == []
    device.tick(50.5)
    assert say(device, m.GetClock()) == ["2016-6-25 10:12:2"]
    assert device.clock_time == datetime(2016, 6, 25, 10, 12, 2, 500_000, tzinfo=UTC)


@pytest.mark.parametrize(
    "wrong",
    [
        clock(2016, 13, 1, 0, 0, 0),
        clock(2015, 2, 29, 0, 0, 0),
        clock(0, 1, 1, 0, 0, 0),
        clock(10_000, 1, 1, 0, 0, 0),
        clock(2016, 1, 1, 24, 0, 0),
        clock(0xFFFFFFFF, 0xFFFFFFFF, 1, 0, 0, 0),
    ],
)
def test_clock_set_to_no_time_is_dropped(wrong: m.SetClock) -> None:
    device = make(clock_time=datetime(2020, 5, 17, 8, 0, 0))  # noqa: DTZ001  a camera has no zone
    assert say(device, wrong, m.GetClock()) == ["2020-5-17 8:0:0"]


def test_clock_stops_at_the_end_of_its_years() -> None:
    device = make()
    say(device, clock(9999, 12, 31, 23, 59, 59))
    device.tick(60.0)
    assert say(device, m.GetClock()) == ["9999-12-31 23:59:59"]


# ---------------------------------------------------------------------- input data


def run(device: Device) -> list[str]:
    device.handle(m.Trigger())
    device.tick(0.05)
    return heard(device)


def put(device: Device, *values: int) -> list[str]:
    return say(device, *(m.SetInput(data=bytes([value])) for value in values))


def test_input_is_used_by_one_inspection_each() -> None:
    device = make(4, running=True)
    assert put(device, 7, 8) == []
    assert device.queued_inputs == 2
    assert run(device) == ["[run]", "result 4 07", "[run wait]"]
    assert run(device) == ["[run]", "result 4 08", "[run wait]"]
    assert device.queued_inputs == 0


def test_input_underflow_uses_the_last_again_until_in_step() -> None:
    device = make(4, running=True)
    put(device, 7)
    run(device)
    assert run(device) == ["[input run]", "result 4 07", "[input run wait]"]
    assert put(device, 9) == []
    assert run(device) == ["[run]", "result 4 09", "[run wait]"]


def test_input_underflow_at_first_gives_zeros() -> None:
    device = make(4, running=True)
    assert run(device) == ["[input run]", "result 4 00", "[input run wait]"]


def test_input_overflow_drops_the_oldest_until_in_step() -> None:
    device = make(4, running=True, input_queue_depth=2)
    assert put(device, 1, 2) == []
    assert put(device, 3) == ["[input run wait]"]
    assert put(device, 4) == []
    assert run(device) == ["[run]", "result 4 03", "[run wait]"]
    assert run(device) == ["[run]", "result 4 04", "[run wait]"]


@pytest.mark.parametrize("data", [b"", b"12"])
def test_input_of_the_wrong_size_is_dropped(data: bytes) -> None:
    device = make(4, running=True)
    assert say(device, m.SetInput(data=data)) == []
    assert device.queued_inputs == 0


def test_input_without_receive_data_is_dropped() -> None:
    device = make(running=True)
    assert put(device, 1, 2) == []
    assert device.queued_inputs == 0


def test_input_during_a_switch_is_dropped_and_a_switch_empties_the_queue() -> None:
    device = make(4, input_queue_depth=1)
    put(device, 1, 2)
    say(device, switch(4))
    assert put(device, 3) == []
    device.tick(0.1)
    assert heard(device) == ["[]", "switched 0 4"]
    assert device.queued_inputs == 0


# ---------------------------------------------------------------------- reboot


def test_reboot_ends_the_session_and_comes_up_clean() -> None:
    device = make(9, running=True, reboot_time=30.0)
    say(device, clock(2020, 1, 1, 0, 0, 0), m.SetSequenceNumber(number=77))
    device.set_condition(Status.OVERHEAT | Status.SYSTEM_ERROR, True)
    heard(device)
    assert say(device, m.Reboot(), m.Query()) == []
    assert device.rebooting
    assert not device.connected
    assert device.next_event_in() == 30.0
    device.tick(29.0)
    assert device.rebooting
    device.tick(1.0)
    assert device.mode.value == "stopped"
    assert device.status == Status.OVERHEAT
    assert device.next_number == 0
    assert say(device, m.Connect(), m.Query()) == ["hello 1", "[hot]", "active 9"]
    assert say(device, m.GetClock()) == ["1970-1-1 0:0:0"]


def test_reboot_during_a_switch_keeps_the_old_application() -> None:
    device = switching()
    say(device, m.Reboot())
    device.tick(30.0)
    assert device.active_application == 3


# ---------------------------------------------------------------------- the operator


def test_operator_start_trigger_stop() -> None:
    device = make()
    assert device.trigger() is False
    device.start()
    assert device.trigger() is True
    assert device.trigger() is False
    device.stop()
    assert heard(device) == ["[run wait]", "[run]", "[run over]", "[over]"]


def test_operator_switch_is_not_answered() -> None:
    device = waiting()
    assert device.switch_application(4) is True
    assert device.switch_application(9) is False
    device.tick(0.1)
    assert heard(device) == ["[busy]", "[]"]
    assert say(device, m.Query()) == ["active 4"]


def test_operator_switch_running() -> None:
    device = make()
    device.switch_application(4, running=True)
    device.tick(0.1)
    assert heard(device) == ["[busy]", "[]", "[run wait]"]


def test_operator_switch_to_an_unknown_one_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="no application has the id 8; there are 3, 5, 9"):
        make().switch_application(8)


def test_operator_reboot() -> None:
    device = make()
    device.reboot()
    device.reboot()
    assert device.rebooting
    assert device.switch_application(4) is False
    assert heard(device) == []


def test_system_error_voids_and_refuses_inspections_until_cleared() -> None:
    device = processing()
    device.set_condition(Status.SYSTEM_ERROR, True)
    assert heard(device) == ["[error run]"]
    assert say(device, m.Trigger()) == []
    device.tick(1.0)
    assert heard(device) == []
    device.set_condition(Status.SYSTEM_ERROR, False)
    assert heard(device) == ["[run wait]"]


def test_system_error_halts_free_running_results() -> None:
    device = make(9, running=True)
    device.tick(1.0)
    heard(device)
    device.set_condition(Status.SYSTEM_ERROR, True)
    device.tick(0.99)
    assert heard(device) == ["[error run]"]
    device.set_condition(Status.SYSTEM_ERROR, False)
    device.tick(1.0)
    assert sum(word.startswith("result") for word in heard(device)) == 30


def test_overheat_is_a_bit_only() -> None:
    device = make(running=True)
    device.set_condition(Status.OVERHEAT, True)
    device.set_condition(Status.OVERHEAT, True)
    assert heard(device) == ["[hot run wait]"]


def test_condition_of_the_model_cannot_be_set() -> None:
    with pytest.raises(ConfigurationError, match=r"only OVERHEAT \+ SYSTEM_ERROR .* got BUSY"):
        make().set_condition(Status.BUSY, True)


def test_endian_is_reported_and_turns_containers_and_input() -> None:
    app = Application(
        id=2, layout="a: uint16", input="a: uint16", generator="input", processing_time=0
    )
    device = Device([app], running=True)
    say(device, m.Connect())
    device.set_endian(1)
    assert device.endian == 1
    assert heard(device) == ["[run wait] endian 1"]
    assert say(device, m.SetInput(data=b"\1\2"), m.Trigger())[1] == "result 2 0102"


def test_operators_actions_happen_inside_their_context() -> None:
    device = make()
    seen: list[str] = []

    @contextmanager
    def around() -> Iterator[None]:
        seen.append(f"before {device.status}")
        yield
        seen.append(f"after {device.status}")

    device.action_context = around
    device.start()
    assert seen == ["before no bit set", "after RUNNING + WAITING_FOR_TRIGGER"]


# ---------------------------------------------------------------------- the rest


def test_failing_generator_gives_no_result_and_a_log_line(caplog: pytest.LogCaptureFixture) -> None:
    calls: list[int] = []

    def fails_later(run: Any) -> list[int]:
        calls.append(1)
        return [1 // (2 - len(calls))]

    app = Application(id=2, layout="n: uint8", generator=fails_later, processing_time=0)
    device = Device([app], running=True)
    say(device, m.Connect())
    with caplog.at_level(logging.ERROR, logger="smartcam.emulator"):
        assert say(device, m.Trigger()) == ["[run]", "[run wait]"]
    assert "application 2, run 0: no result" in caplog.text


def test_containers_that_come_again_follow_turn_byte_order_and_application() -> None:
    quick: dict[str, Any] = {"layout": "n: uint16", "processing_time": 0, "load_time": 0}
    cycle = Application(id=1, cycle=[[1], [2]], **quick)
    device = Device([cycle, Application(id=2, constant=[7], **quick)], running=True)
    say(device, m.Connect())

    def results(count: int) -> list[str]:
        return [one for one in say(device, *[m.Trigger()] * count) if one.startswith("result")]

    assert results(3) == ["result 1 0100", "result 1 0200", "result 1 0100"]
    device.set_endian(1)
    assert results(3) == ["result 1 0002", "result 1 0001", "result 1 0002"]
    say(device, m.Stop(), switch(2), m.Start())
    assert results(2) == ["result 2 0007", "result 2 0007"]
    device.set_endian(0)
    assert results(2) == ["result 2 0700", "result 2 0700"]


def test_tick_backwards_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"device: dt: .* got -1"):
        make().tick(-1)


def test_device_without_applications_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="at least one application"):
        Device([])


def test_device_with_an_id_twice_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="application id 3 is there twice"):
        Device([CHECK, CHECK])


def test_device_with_an_unknown_active_one_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="no application has the id 4; there are 3"):
        Device([CHECK], active=4)


def test_device_starts_with_the_first_application() -> None:
    device = Device([FREE, CHECK])
    assert device.active_application == 9
    assert set(device.applications) == {3, 9}
    assert device.endian == 0
    assert device.time == 0.0
