"""Whatever comes in whatever order: the device keeps its promises."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from smartcam.emulator import Application, Device, Quirks
from smartcam.emulator.application import BUILTIN_APPLICATIONS
from smartcam.models import Status
from smartcam.protocols import messages as m

ECHO = Application(
    id=4, layout="s: string[2], b: bool", input="s: string[2], b: bool", generator="input"
)
UINT32 = st.integers(0, 0xFFFFFFFF)
MESSAGES = st.one_of(
    st.sampled_from(
        [
            m.Connect(),
            m.Disconnect(),
            m.Query(),
            m.GetClock(),
            m.Trigger(),
            m.Start(),
            m.Stop(),
            m.Reboot(),
            m.UnknownMessage(message_id=0x99, payload=b"?"),
        ]
    ),
    st.builds(
        m.SwitchApplication, application=st.sampled_from([0, 1, 3, 4, 7, 9, 21, 22, 0xFFFFFFFF])
    ),
    st.builds(m.SetInput, data=st.binary(max_size=4)),
    st.builds(m.SetSequenceNumber, number=UINT32),
    st.builds(
        m.SetClock,
        year=UINT32 | st.integers(1970, 9999),
        month=st.integers(0, 13),
        day=st.integers(0, 32),
        hour=st.integers(0, 24),
        minute=st.integers(0, 60),
        second=st.integers(0, 60),
    ),
)
STEPS = st.lists(
    st.one_of(
        MESSAGES,
        st.floats(0, 2.0),
        st.sampled_from(["trigger", "start", "stop", "reboot", "hot", "error", "big", "switch"]),
    ),
    max_size=40,
)


def operate(device: Device, action: str) -> None:
    actions: dict[str, Any] = {
        "trigger": device.trigger,
        "start": device.start,
        "stop": device.stop,
        "reboot": device.reboot,
        "hot": lambda: device.set_condition(Status.OVERHEAT, not device.status & Status.OVERHEAT),
        "error": lambda: device.set_condition(
            Status.SYSTEM_ERROR, not device.status & Status.SYSTEM_ERROR
        ),
        "big": lambda: device.set_endian(1 - device.endian),
        "switch": lambda: device.switch_application(9, running=True),
    }
    actions[action]()


def drive(device: Device, steps: list[Any]) -> None:
    last: m.StatusReport | None = None
    for step in steps:
        session = device.connected
        match step:
            case str():
                operate(device, step)
            case float():
                device.tick(step)
            case _:
                device.handle(step)
        output = device.take_output()
        if output:
            assert session or isinstance(output[0], m.ConnectAnswer)
        for message in output:
            match message:
                case m.ConnectAnswer():
                    last = None
                case m.StatusReport():
                    assert message != last
                    last = message
                    both = Status.BUSY | Status.WAITING_FOR_TRIGGER
                    assert message.status & both != both
        due = device.next_event_in()
        assert due is None or due >= 0
        if device.connected:
            assert last is not None
            assert (last.status, last.endian) == (device.status, device.endian)


@given(steps=STEPS, reboot_time=st.floats(0, 3), depth=st.integers(1, 3))
def test_device_any_messages_and_ticks_keep_the_promises(
    steps: list[Any], reboot_time: float, depth: int
) -> None:
    quirks = Quirks(reboot_time=reboot_time, input_queue_depth=depth)
    device = Device([*BUILTIN_APPLICATIONS, ECHO], active=4, quirks=quirks)
    device.handle(m.Connect())
    device.take_output()
    drive(device, [m.Connect(), *steps])


@given(
    steps=STEPS,
    quirks=st.builds(
        Quirks,
        switch_while_running=st.sampled_from(["refuse", "ignore", "allow"]),
        switch_answer=st.sampled_from(["after_status", "before_status"]),
        waiting_before_result=st.booleans(),
        busy_while_processing=st.booleans(),
        overtriggered_time=st.sampled_from([0.0, 0.5]),
    ),
)
def test_device_with_any_quirks_keeps_the_promises(steps: list[Any], quirks: Quirks) -> None:
    drive(Device([*BUILTIN_APPLICATIONS, ECHO], quirks=quirks), steps)


@given(cuts=st.lists(st.floats(0, 0.3), max_size=30))
def test_device_ticks_cut_anyhow_give_the_same(cuts: list[float]) -> None:
    one, other = (Device(BUILTIN_APPLICATIONS, active=9, running=True) for _ in range(2))
    for device in (one, other):
        device.handle(m.Connect())
        device.take_output()
    for cut in cuts:
        one.tick(cut)
    other.tick(one.time)
    assert other.time == one.time
    assert other.take_output() == one.take_output()
