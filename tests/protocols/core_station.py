"""The emulated device behind the camera's ends of all lines, beside its model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from camera_model import CameraModel, Options
from core_lines import Line, delivery
from core_model import framed, meaning, surplus
from machines import BY_LABEL

from smartcam.emulator import Application, Device, Quirks
from smartcam.emulator.bvs.behaviour import manner_of
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["Station"]

APPLICATIONS = (
    Application(
        id=1,
        layout="n: int32 @sequence",
        generator="sequence",
        load_time=0.1,
        processing_time=0.04,
    ),
    Application(
        id=2,
        layout="n: int32",
        input="n: int32",
        generator="input",
        load_time=0.06,
        processing_time=0.03,
    ),
    Application(
        id=3,
        layout="n: int32 @sequence",
        generator="sequence",
        rate=20.0,
        load_time=0.1,
        processing_time=0.01,
    ),
    Application(id=4, load_time=0.0, processing_time=0.025),
    Application(
        id=5,
        layout="n: int32",
        cycle=[{"n": 10}, {"n": -20}, {"n": 30}],
        load_time=0.15,
        processing_time=0.0,
    ),
)
"""The emulator's side of ``PROGRAMS``."""


class Station:
    """Passes messages from lines to the device and back, as the emulator does.

    Args:
        dialect: the label of what it speaks.
        options: the device's quirks.
        drop: what happens to a line that the camera lets go of.
    """

    def __init__(self, dialect: str, options: Options, drop: Callable[[Line], None]) -> None:
        self.model = CameraModel(
            options, is_bid=dialect == "bid", coded=dialect in {"bid", "b16 with quirk code"}
        )
        quirks = Quirks(
            reboot_time=0.3, overtriggered_time=0.1, input_queue_depth=2, **options._asdict()
        )
        self.device = Device(
            APPLICATIONS, quirks=quirks, manner=manner_of(BY_LABEL[dialect], quirks)
        )
        self.lines: list[Line] = []
        self.served: Line | None = None
        self._drop = drop

    def pass_time(self, milliseconds: int) -> None:
        self.device.tick(milliseconds / 1000)
        self.model.pass_time(milliseconds)
        self.collect()

    def operate(self, action: str, *args: Any, **options: Any) -> None:
        """Do the same to both."""
        done = getattr(self.device, action)(*args, **options)
        assert done == getattr(self.model, action)(*args, **options)
        self.collect()

    def give_camera(self, line: Line, data: bytes) -> None:
        expected = line.camera_end.hear(data)
        line.camera.receive_data(delivery(data))
        assert line.camera.events() == expected
        for message in expected:
            self.route(line, message)
        if self.model.mode == "rebooting":
            self.go_down()

    def route(self, line: Line, message: m.Message) -> None:
        """Pass a message on: the newcomer has the session from its Connect."""
        if isinstance(message, m.Connect) and line is not self.served:
            self.end_session()
            self.served = line
        if line is self.served:
            self.device.handle(message)
            self.model.hear(message)
            self.collect()
        if isinstance(message, m.Disconnect) and line is self.served:
            self.served = None

    def end_session(self) -> None:
        """Take the session away, and with it the link."""
        line, self.served = self.served, None
        if line is not None:
            self.device.disconnect()
            self.model.end_session()
            self._drop(line)

    def go_down(self) -> None:
        """The camera is off the network: every link is lost."""
        self.served = None
        for line in self.lines:
            self._drop(line)

    def collect(self) -> None:
        """What the device says is what the model says; put it on the wire."""
        said = self.device.take_output()
        assert said == self.model.take()
        assert self.served is not None or not said
        for message in said:
            self.put(message)

    def put(self, message: m.Message) -> None:
        line = self.served
        assert line is not None
        expected = line.camera_end.say(message)
        line.camera.send(message)
        assert line.camera.data_to_send() == [expected]
        line.pipes["down"].put(expected)
        frame = framed(line.wire, message)
        if surplus(line.wire, m.Sender.CAMERA, frame) < 0:
            line.said.append(message)  # a code alone, where an answer has more: nobody reads it
        else:
            line.said.append(meaning(line.wire, m.Sender.CAMERA, frame))

    def check(self) -> None:
        """Compare the device with its model."""
        device, model = self.device, self.model
        assert device.mode.value == model.mode
        assert device.status == model.status
        assert device.active_application == model.active
        assert device.connected == model.session
        assert device.next_number == model.number
        assert device.processing == (model.run is not None)
        assert device.queued_inputs == len(model.inputs)
        assert device.clock_time == model.clock
        due = device.next_event_in()
        assert (None if due is None else round(due * 1000)) == model.next_event_in
